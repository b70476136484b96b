"""Posterior uncertainty of the hyperparameters: epsilon, SMC-ABC, adjustment, bootstrap."""

from prbayes.posterior.adjustment import Affine
from prbayes.posterior.given_estimate import GivenEstimate
from prbayes.posterior.smc_kernel import BatchedKernel

__all__ = ["Affine", "BatchedKernel", "GivenEstimate"]
