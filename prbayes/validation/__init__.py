"""PLACEHOLDER package validation."""
