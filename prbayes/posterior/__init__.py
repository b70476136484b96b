"""Posterior uncertainty of the hyperparameters: epsilon, SMC-ABC, adjustment, bootstrap."""
