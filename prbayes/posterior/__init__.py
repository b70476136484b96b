"""Posterior uncertainty of the hyperparameters: importance sampling, SMC, epsilon, bootstrap."""

from prbayes.posterior.smc_kernel import BatchedKernel

__all__ = ["BatchedKernel"]
