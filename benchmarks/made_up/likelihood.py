"""Made-up problems of the log-likelihood by specimen."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pymc as pm
from scipy import stats

import prbayes as prb
from benchmarks.made_up import moments, on_grid, problem


@problem
def cubic_of_a_normal() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(11)
    x = rng.normal(0.4, 0.3, 15)

    def response(x: Any) -> Any:
        return x + 2.0 * x**3

    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 2.0), pm.HalfNormal("sigma", 1.0)
        prb.Simulator(
            "y",
            response,
            pm.Normal.dist(mu, sigma),
            metric=prb.LogLikelihood(),
            observed=response(x),
        )
        idata = prb.sample(draws=4000, random_seed=1)

    def log_posterior(mu: Any, sigma: Any) -> Any:
        logs = stats.norm(mu[:, None], sigma[:, None]).logpdf(x).sum(axis=1)
        return logs + stats.norm(0, 2).logpdf(mu) + stats.halfnorm(scale=1).logpdf(sigma)

    values, weights = on_grid(
        log_posterior, mu=np.linspace(-0.2, 1.0, 301), sigma=np.linspace(0.05, 1.2, 301)
    )
    yield from moments(idata.posterior, values, weights)
