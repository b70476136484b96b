"""PLACEHOLDER package plots."""
