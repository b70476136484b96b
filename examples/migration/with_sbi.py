"""The same by neural posterior estimation with sbi: a network learns from simulated data sets."""

import numpy as np
import torch
from sbi.inference import NPE
from sbi.utils import MultipleIndependent
from torch.distributions import HalfNormal, Normal

torch.manual_seed(1)
deflections = 3.0 / np.exp(np.random.default_rng(7).normal(1.0, 0.15, 20))
one = torch.ones(1)
prior = MultipleIndependent([Normal(one, 0.3 * one), HalfNormal(0.3 * one)])
theta = prior.sample((2000,))
stiffness = torch.exp(theta[:, :1] + theta[:, 1:] * torch.randn(2000, 20))
# 40 000 runs; the order of springs has no meaning
data_sets = torch.sort(3.0 / stiffness).values
inference = NPE(prior)
inference.append_simulations(theta, data_sets).train()
observed = torch.sort(torch.tensor(deflections, dtype=torch.float32)).values
posterior = inference.build_posterior()
draws = posterior.sample((4000,), x=observed, show_progress_bars=False)

print("\nmeans of mu and sigma:", *draws.mean(dim=0).tolist())
