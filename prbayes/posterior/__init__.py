"""Posterior uncertainty of the hyperparameters: importance sampling, SMC, epsilon, bootstrap."""

from prbayes.posterior.kernel import BatchedKernel
from prbayes.posterior.sampler import Sampler

__all__ = ["BatchedKernel", "Sampler"]
