"""Stiffness of springs from their deflections: prbayes."""

import numpy as np
import pymc as pm

import prbayes as prb

deflections = 3.0 / np.exp(np.random.default_rng(7).normal(1.0, 0.15, 20))
with pm.Model() as model:
    mu, sigma = pm.Normal("mu", 1.0, 0.3), pm.HalfNormal("sigma", 0.3)
    stiffness = pm.LogNormal.dist(mu, sigma)  # varies from spring to spring
    prb.Simulator("deflection", lambda k: 3.0 / k, stiffness, observed=deflections)
    posterior = prb.sample(random_seed=1)  # some 50 runs

print(
    "means of mu and sigma:",
    posterior.posterior["mu"].values.mean(),
    posterior.posterior["sigma"].values.mean(),
)
