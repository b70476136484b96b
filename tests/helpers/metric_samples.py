"""Metrics by name and samples of the identities that all metrics have."""

from __future__ import annotations

import numpy as np
from scipy.stats import norm

from prbayes._validate import Floats
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Metric
from prbayes.metrics.density import GaussianKDE, Histogram
from prbayes.metrics.divergence import KullbackLeibler, ProbabilityResidual
from prbayes.metrics.likelihood import LogLikelihood


def make(h: float = 0.4) -> dict[str, Metric]:
    """Return all metrics by name, for a bandwidth."""
    return {
        "area": AreaMetric(),
        "pr": ProbabilityResidual(GaussianKDE(h)),
        "pr-bins": ProbabilityResidual(Histogram(7)),
        "kl": KullbackLeibler(GaussianKDE(h)),
        "kl-reverse": KullbackLeibler(GaussianKDE(h), reverse=True),
        "kl-bins": KullbackLeibler(Histogram(7)),
        "ll": LogLikelihood(density=GaussianKDE(h)),
        "ll-bins": LogLikelihood(density=Histogram(7)),
    }


def normal(mu: float, sd: float, n: int = 4000) -> Floats:
    """Return quantiles of a normal distribution; hardly any tails: hence the tolerances."""
    return mu + sd * norm.ppf((np.arange(n) + 0.5) / n)


def draw(seed: int, n: int = 23, n_observed: int = 17) -> tuple[Floats, Floats, Floats, Floats]:
    """Return simulated values, their weights, observed values, their weights."""
    rng = np.random.default_rng(seed)
    w, u = rng.dirichlet(np.ones(n)), rng.dirichlet(np.ones(n_observed))
    return rng.normal(0.3, 1.2, n), w, rng.normal(size=n_observed), u
