"""Hyperparameters that the data push to an end of their prior, and conflicts of prior and data."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytest
from four_metrics import METRICS, R256, same
from scipy.stats import norm

import prbayes as prb
from prbayes._validate import Floats
from prbayes.inference.checks.prior import (
    PriorEnd,
    conflict_findings,
    ends_by_metric,
    prior_conflict,
    prior_end_findings,
)
from prbayes.inference.prior_continuation import ends_of_prior
from prbayes.inference.refits import SamplingDistribution
from prbayes.model.evaluator import Evaluator

LEVELS = norm.ppf((np.arange(30) + 0.5) / 30)


def model(observed: Any, name: str = "kl") -> pm.Model:
    with pm.Model() as result:
        mu = pm.Uniform("mu", 0, 1)
        x = pm.Normal.dist(mu, pm.HalfNormal("sd", 0.3))
        pm.Deterministic("twice", 2 * mu)
        data = {"observed": observed, "propagation": R256}
        prb.Simulator("y", same, x, metric=METRICS[name], **data)
    return result


def ends(problem: pm.Model, *theta: float) -> list[PriorEnd]:
    evaluator = Evaluator.of(problem)
    return ends_by_metric(SamplingDistribution.of(evaluator, np.array(theta), np.ones(1)))


@pytest.mark.parametrize(
    ("name", "place", "bound"),
    [("kl", 1.6, 1.0), ("area", -0.6, 0.0), ("ll", 1.6, 1.0), ("pr", -0.6, 0.0)],
)
def test_data_beyond_a_prior_push_to_its_end(name: str, place: float, bound: float) -> None:
    problem = model(place + 0.3 * LEVELS, name)
    (end,) = ends(problem, np.copysign(9.0, place), np.log(0.65))
    assert (end.name, end.bound) == ("mu", bound)
    assert end.value == pytest.approx(bound, abs=1e-3)
    (finding,) = prior_end_findings([end])
    expected = f"The data push mu to {end.value:.4g}, next to the end of its prior at {bound:.4g}: "
    assert finding.text.startswith(expected)
    (both,) = prior_end_findings([end, PriorEnd("sd", 0.1, 0.2)])
    assert "and sd to 0.1, next to the end of its prior at 0.2: widen" in both.text


@pytest.mark.long
@pytest.mark.parametrize(("name", "place", "bound"), [("kl", 2.85, 1.0), ("area", -1.85, 0.0)])
def test_an_optimum_at_an_end_says_so_and_draws_stay_there(
    name: str, place: float, bound: float
) -> None:
    problem = model(place + 0.3 * LEVELS, name)
    optimum = prb.minimize(problem, starts=0, progressbar=False)
    (finding,) = optimum.findings
    assert finding.code == "prior-end"
    # Refits of the area metric are at an edge, where its estimate has no density.
    given: dict[str, Any] = {"adjustment": None} if name == "area" else {}
    given |= {"draws": 300, "chains": 2, "random_seed": 1, "progressbar": False}
    tree = prb.sample_smc(model=problem, optimum=optimum, **given)
    # Back at the prior, the mean would be a half.
    assert abs(float(tree.posterior["mu"].mean()) - bound) < 0.15


@pytest.mark.parametrize(
    ("place", "scatter", "theta"),
    [
        (0.5, 0.3, (0.0, np.log(0.3))),  # in the middle of the prior
        # A standard deviation that is small beside the kernel, whose prior ends at zero.
        (0.5, 0.01, (0.0, np.log(1e-5))),
        # At the other end than the data's the middle is better, so that these do not push there.
        (2.85, 0.3, (-6.0, np.log(1.8))),
        # A prior that ends .04 beyond the mean of the data allows what they ask for.
        (0.96, 0.3, (np.log(0.96 / 0.04), np.log(0.3))),
    ],
)
def test_what_does_not_push_to_an_end(
    place: float, scatter: float, theta: tuple[float, float]
) -> None:
    assert not ends(model(place + scatter * LEVELS), *theta)


def test_two_that_only_stand_for_each_other_are_not_pushed() -> None:
    with pm.Model() as problem:
        x, z = (pm.Normal.dist(pm.Uniform(name, 0, 1), 0.3) for name in "ab")
        data = {"observed": 1.2 + 0.42 * LEVELS, "propagation": R256}
        prb.Simulator("y", lambda x, z: x + z, x, z, metric=METRICS["kl"], **data)
    # One at its upper end, the other at its lower one, or elsewhere.
    assert not ends(problem, 4.0, -4.0)
    assert not ends(problem, 4.0, 0.0)


def test_ends_of_the_ranges_of_elements() -> None:
    with pm.Model() as problem:
        x = pm.Normal.dist(pm.Uniform("u", -1, 3) + pm.Normal("n"), pm.HalfNormal("h"))
        prb.Simulator("y", same, x, metric=METRICS["area"], observed=LEVELS, propagation=R256)
    hyperparameters = Evaluator.of(problem).hyperparameters
    values, lower, upper = ends_of_prior(hyperparameters, np.array([0.0, 0.4, np.log(0.3)]))
    np.testing.assert_allclose(values, [1.0, 0.4, 0.3])
    np.testing.assert_array_equal(lower, [-1.0, np.nan, 0.0])
    np.testing.assert_array_equal(upper, [3.0, np.nan, np.nan])
    with problem:  # the elements of a simplex have no values of their own
        pm.Dirichlet("w", np.ones(3))
    hyperparameters = Evaluator.of(problem).hyperparameters
    assert np.isnan(ends_of_prior(hyperparameters, np.zeros(5))).all()


def estimates(mu: Floats, sd: Floats, n: int, rng: np.random.Generator) -> Floats:
    """Return means and log standard deviations of samples of normal populations, (S, 2)."""
    y = mu[:, None] + sd[:, None] * rng.standard_normal((len(mu), n))
    return np.stack([y.mean(axis=1), np.log(y.std(axis=1))], axis=1)


def sharp_prior(size: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    return 10 + 0.3 * rng.standard_normal(size), np.exp(0.2 * rng.standard_normal(size))


def test_size_of_single_and_of_adjusted_p_values() -> None:
    rng = np.random.default_rng(0)
    predictive = estimates(*sharp_prior(2000, rng), 20, rng)
    observed = estimates(*sharp_prior(1000, rng), 20, rng)
    tests = [prior_conflict(t, predictive) for t in observed]
    single = np.array([p_values for p_values, _ in tests])
    # standard error .007, and .005 of the simulated estimates
    assert (single <= 0.05).mean(axis=0) == pytest.approx([0.05, 0.05], abs=0.035)
    family = np.array([adjusted.min() for _, adjusted in tests])
    assert np.mean(family <= 0.05) == pytest.approx(0.05, abs=0.035)


def test_p_values_of_finite_estimates_are_adjusted_by_holm() -> None:
    predictive = np.tile(np.arange(999.0)[:, None], (1, 4))
    failed = np.concatenate([predictive, np.full((50, 4), np.nan), np.full((9, 4), -np.inf)])
    # p = 2 (k + 1) / 1000 for k simulated estimates as far out
    estimate = np.array([4.5, 994.5, 9.5, 499.0])
    for estimated in (predictive, failed):
        p_values, adjusted = prior_conflict(estimate, estimated)
        assert p_values == pytest.approx([0.012, 0.01, 0.022, 1.0])
        assert adjusted == pytest.approx([0.04, 0.04, 0.044, 1.0])  # never decreasing
    unknown = np.full((3, 4), np.nan)
    assert (prior_conflict(estimate, unknown)[0] == 1).all()


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_a_conflict_needs_both_p_value_and_pull(unit: float) -> None:
    rng = np.random.default_rng(3)
    prior = rng.normal(10, 0.3, (1000, 1))
    predictive = prior + rng.normal(0, 0.2, prior.shape)

    def texts(estimate: float, posterior: float) -> list[str]:
        values = (np.array([unit * v]) for v in (estimate, 0.2, posterior))
        findings = conflict_findings(["mu"], unit * prior, *values, unit * predictive)
        return [finding.text for finding in findings]

    (text,) = texts(11.8, 11.2)
    assert "(p = 0.002); " in text
    assert ", 3.0 standard errors from the data" in text
    if unit == 1.0:
        assert text.startswith("mu: got prior 10 +- 0.3, data 11.8 +- 0.2 (p = 0.002); ")
        assert "the prior pulls the posterior mean to 11.2, 3.0 standard errors" in text
    assert texts(11.6, 11.55) == []
    assert texts(10.1, 10.4) == []
    assert len(texts(8.4, 8.8)) == 1
