"""PLACEHOLDER package response."""
