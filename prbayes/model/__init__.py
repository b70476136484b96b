"""Simulators in a PyMC model, and the evaluator of a model."""
