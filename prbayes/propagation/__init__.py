"""PLACEHOLDER package propagation."""
