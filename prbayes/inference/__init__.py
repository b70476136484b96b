"""Sampling distribution of the estimate: covariances, refits, goodness of fit and checks."""
