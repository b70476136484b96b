"""PLACEHOLDER package posterior."""
