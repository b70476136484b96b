"""Posterior uncertainty of the hyperparameters: importance sampling, SMC, epsilon, bootstrap."""

from prbayes.posterior.kernel import BatchedKernel

__all__ = ["BatchedKernel"]
