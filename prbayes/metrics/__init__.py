"""PLACEHOLDER package metrics."""
