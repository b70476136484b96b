"""Numerical methods on arrays."""
