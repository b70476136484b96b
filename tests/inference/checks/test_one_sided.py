"""Hyperparameters that the data bound from one side, and the posterior near an edge."""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import pymc as pm
import pytest
from four_metrics import METRICS, R256, same
from scipy.stats import norm

import prbayes as prb
from prbayes._validate import Floats
from prbayes.inference.checks.identification import unidentified_findings
from prbayes.inference.checks.one_sided import bound_findings, bounds_by_metric, one_sided_bounds
from prbayes.inference.refits import SamplingDistribution
from prbayes.model.evaluator import Evaluator
from prbayes.posterior.target import estimate_target
from prbayes.response.budget import limited

LEVELS = norm.ppf((np.arange(40) + 0.5) / 40)


def known_scatter(name: str, observed: Any, propagation: Any = R256) -> Evaluator:
    """Return a spread of the inputs beside a known one of .5."""
    with pm.Model() as model:
        sigma = pm.HalfNormal("sigma", 1)
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), pm.math.sqrt(sigma**2 + 0.25))
        y = {"metric": METRICS[name], "observed": observed, "propagation": propagation}
        prb.Simulator("y", same, x, **y)
    return Evaluator.of(model)


COMPUTED = prb.Resimulated(256)


# The last optima are collapsed: seven and four standard deviations of the prior from its median.
@pytest.mark.parametrize(
    ("name", "propagation", "spread"),
    [
        ("kl", R256, 0.05),
        ("ll", R256, 0.05),
        ("pr", COMPUTED, 0.05),
        ("pr", COMPUTED, 1e-4),
        ("area", R256, 0.003),
    ],
)
def test_a_spread_that_may_be_zero_has_an_upper_limit(
    name: str, propagation: Any, spread: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Responses cost next to nothing, also where the machine is busy.
    monkeypatch.setattr("time.perf_counter", lambda: 0.0)
    evaluator = known_scatter(name, 0.5 * LEVELS, propagation)
    theta = np.array([np.log(spread), 0.0])
    sampling = SamplingDistribution.of(evaluator, theta, np.ones(1))
    (bound,) = bounds_by_metric(sampling) or []
    assert (bound.name, bound.is_upper, bound.end) == ("sigma", True, 0.0)
    # The variance of 40 normal data is .25: 95% of data sets have a larger one if that of the
    # population is above .25 / (1 - 1.645 sqrt(2 / 40)), by the normal approximation.
    exact = np.sqrt(0.25 / (1 - 1.645 * np.sqrt(2 / 40)) - 0.25)
    assert bound.limit == pytest.approx(exact, rel=0.2)
    (finding,) = bound_findings([bound])
    text = f"The data bound a hyperparameter from above only. sigma: got {spread:.3g}, at most 0."
    assert finding.text.startswith(text)
    assert "values down to 0 are compatible" in finding.text


def test_bounds_are_not_searched_if_they_cost_too_much(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a budget of responses, by their time, or by refits."""
    evaluator = known_scatter("pr", 0.5 * LEVELS, COMPUTED)
    theta = np.array([np.log(0.05), 0.0])
    sampling = SamplingDistribution.of(evaluator, theta, np.ones(1))
    with limited(None, 10**6):
        assert bounds_by_metric(sampling) is None
    clock = count(0.0, 1.0)
    with monkeypatch.context() as patch:
        patch.setattr("time.perf_counter", lambda: next(clock))
        assert bounds_by_metric(sampling) is None
    text = "Bounds from one side were not searched"
    (finding,) = unidentified_findings(evaluator, sampling.local, has_bounds=False)
    assert text in finding.text
    (finding,) = unidentified_findings(evaluator, sampling.local)
    assert text not in finding.text


def test_propagations_have_the_same_posterior_near_zero() -> None:
    """Of log densities on a grid, with the optimum of sigma at zero."""
    y = 0.4 * LEVELS[::2]
    sigma, mu = np.geomspace(0.01, 4, 12), np.linspace(-0.5, 0.5, 7)
    thetas = np.stack(np.meshgrid(np.log(sigma), mu, indexing="ij"), axis=-1).reshape(-1, 2)
    moments = []
    for propagation in (R256, COMPUTED):
        evaluator = known_scatter("pr", y, propagation)
        optimum = prb.minimize(evaluator.model, starts=0, progressbar=False)
        target = estimate_target(optimum.evaluator, optimum)
        logs = target.log_posterior(thetas)
        mass = np.exp(logs - logs.max()).reshape(len(sigma), -1).sum(axis=1)
        mass /= mass.sum()
        mean = mass @ sigma
        moments.append((mean, np.sqrt(mass @ (sigma - mean) ** 2)))
    assert moments[0] == pytest.approx(moments[1], rel=0.03)


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
    # One finding for each side, with all hyperparameters.
    first, second = bound_findings([below, above, replace(above, name="tau")])
    assert "sigma: got 1, at most 2.28 (95%), and values down to 0" in first.text
    assert "; tau: got 1, at most 2.28 (95%), and values" in first.text
    assert "from below only. sigma: got 1, at least 0.439 (95%)" in second.text


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


def test_the_posterior_of_an_area_is_not_the_prior_near_zero() -> None:
    """The prior's mean is .8, and its standard deviation .6."""
    y = 0.45 * LEVELS[::2]
    evaluator = known_scatter("area", y)
    optimum = prb.minimize(evaluator.model, starts=0, progressbar=False)
    draws = prb.sample(500, model=evaluator.model, optimum=optimum, progressbar=False)
    sigma = draws.posterior["sigma"].values
    mean, sd = exact_moments(y)
    assert abs(sigma.mean() - mean) < 0.4 * sd
    assert sigma.std() == pytest.approx(sd, rel=0.25)
