"""Comparison, diagnosis and prediction from the results of any route."""
