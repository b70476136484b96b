"""Hyperparameters that the data bound from one side, and the posterior near an edge."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytest
from four_metrics import METRICS, R256, same
from scipy.stats import norm

import prbayes as prb
from prbayes._validate import Floats
from prbayes.inference.checks.one_sided import bounds_by_metric, one_sided_bounds
from prbayes.inference.refits import SamplingDistribution
from prbayes.model.evaluator import Evaluator

LEVELS = norm.ppf((np.arange(40) + 0.5) / 40)


def known_scatter(name: str, observed: Any) -> Evaluator:
    """Return a spread of the inputs beside a known one of .5."""
    with pm.Model() as model:
        sigma = pm.HalfNormal("sigma", 1)
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), pm.math.sqrt(sigma**2 + 0.25))
        prb.Simulator("y", same, x, metric=METRICS[name], observed=observed, propagation=R256)
    return Evaluator.of(model)


@pytest.mark.parametrize("name", sorted(METRICS))
def test_a_spread_that_may_be_zero_has_an_upper_limit(name: str) -> None:
    evaluator = known_scatter(name, 0.5 * LEVELS)
    theta = np.array([np.log(0.05), 0.0])
    sampling = SamplingDistribution.of(evaluator, theta, np.ones(1))
    (bound,) = bounds_by_metric(sampling)
    assert (bound.name, bound.is_upper, bound.end) == ("sigma", True, 0.0)
    # The variance of 40 normal data is .25: 95% of data sets have a larger one if that of the
    # population is above .25 / (1 - 1.645 sqrt(2 / 40)), by the normal approximation.
    exact = np.sqrt(0.25 / (1 - 1.645 * np.sqrt(2 / 40)) - 0.25)
    assert bound.limit == pytest.approx(exact, rel=0.2)
    text = bound.finding.text
    assert "The data bound sigma from above only: got 0.05, at most 0." in text
    assert "values down to 0 are compatible" in text


def test_two_limits_or_none_are_no_bound() -> None:
    evaluator = known_scatter("kl", 0.5 * LEVELS)
    theta, first = np.zeros(2), np.array([True, False])

    def limits(statistic: Any) -> list[Any]:
        return one_sided_bounds(evaluator, theta, first, lambda x, i: float(statistic(x[i])))

    assert not limits(lambda x: 2 * abs(x))
    assert not limits(lambda x: 0.1)
    assert not limits(lambda x: np.nan)
    # log sigma at a limit of 1.645 / 2
    (above,) = limits(lambda x: 2 * x)
    assert above.limit == pytest.approx(np.exp(1.6449 / 2), rel=1e-3)
    (below,) = limits(lambda x: -2 * x)
    assert below.limit == pytest.approx(np.exp(-1.6449 / 2), rel=1e-3)
    assert "from below only: got 1, at least 0.439 (95%)" in below.finding.text


def exact_moments(y: Floats) -> tuple[float, float]:
    """Return mean and standard deviation of sigma by a grid, sigma ~ HalfNormal(1), mu ~ N(0, 1)."""
    sigma, mu = np.linspace(1e-3, 4, 400)[:, None], np.linspace(-1, 1, 201)
    scale = np.sqrt(sigma**2 + 0.25)
    logs = norm.logpdf(y[:, None, None], mu, scale).sum(axis=0)
    logs += norm.logpdf(sigma) + norm.logpdf(mu)
    mass = np.exp(logs - logs.max()).sum(axis=1)
    mass /= mass.sum()
    mean = float(mass @ sigma[:, 0])
    return mean, float(np.sqrt(mass @ (sigma[:, 0] - mean) ** 2))


@pytest.mark.parametrize("scatter", [0.45, pytest.param(0.55, marks=pytest.mark.long)])
def test_the_posterior_of_an_area_is_not_the_prior_near_zero(scatter: float) -> None:
    """The prior's mean is .8, and its standard deviation .6."""
    y = scatter * LEVELS[::2]
    evaluator = known_scatter("area", y)
    optimum = prb.minimize(evaluator.model, starts=0, progressbar=False)
    draws = prb.sample(500, model=evaluator.model, optimum=optimum, progressbar=False)
    sigma = draws.posterior["sigma"].values
    mean, sd = exact_moments(y)
    assert abs(sigma.mean() - mean) < 0.4 * sd
    assert sigma.std() == pytest.approx(sd, rel=0.25)
