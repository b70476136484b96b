"""Metrics and samples of the identities that all metrics have."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import norm

from prbayes._validate import Floats
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Metric
from prbayes.metrics.density import GaussianKDE, Histogram
from prbayes.metrics.divergence import KullbackLeibler, ProbabilityResidual
from prbayes.metrics.likelihood import LogLikelihood


def _metrics(h: float = 0.4) -> dict[str, Metric]:
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


def _normal(mu: float, sd: float, n: int = 4000) -> Floats:
    return mu + sd * norm.ppf((np.arange(n) + 0.5) / n)


def _draw(seed: int, n: int = 23, n_observed: int = 17) -> tuple[Floats, Floats, Floats, Floats]:
    rng = np.random.default_rng(seed)
    w, u = rng.dirichlet(np.ones(n)), rng.dirichlet(np.ones(n_observed))
    return rng.normal(0.3, 1.2, n), w, rng.normal(size=n_observed), u


@pytest.fixture
def make() -> Callable[..., dict[str, Metric]]:
    """All metrics by name, for a given bandwidth."""
    return _metrics


@pytest.fixture(params=sorted(_metrics()))
def name(request: pytest.FixtureRequest) -> str:
    """The name of every metric, one after the other."""
    return str(request.param)


@pytest.fixture
def metric(name: str) -> Metric:
    """Every metric, one after the other."""
    return _metrics()[name]


@pytest.fixture
def normal() -> Callable[..., Floats]:
    """Quantiles of a normal distribution; hardly any tails: hence the tolerances."""
    return _normal


@pytest.fixture
def draw() -> Callable[..., tuple[Floats, Floats, Floats, Floats]]:
    """Simulated values, their weights, observed values, their weights."""
    return _draw
