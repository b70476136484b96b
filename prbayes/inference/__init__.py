"""Inference checks of the hyperparameters, on arrays without PyMC."""
