"""PLACEHOLDER package surrogate."""
