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
)
from prbayes.inference.refits import SamplingDistribution
from prbayes.model.evaluator import Evaluator

LEVELS = norm.ppf((np.arange(30) + 0.5) / 30)


def added(x: Any, z: Any) -> Any:
    return x + z


def model(
    observed: Any,
    mu: Any,
    sd: Any,
    metric: prb.Metric = METRICS["kl"],
    propagation: prb.Reweighted = R256,
) -> pm.Model:
    with pm.Model() as found:
        x = pm.Normal.dist(mu("mu"), sd("sd"))
        prb.Simulator("y", same, x, metric=metric, observed=observed, propagation=propagation)
    return found


def unit(name: str) -> Any:
    return pm.Uniform(name, 0, 1)


def narrow(name: str) -> Any:
    return pm.HalfNormal(name, 0.3)


def ends(found: pm.Model, theta: Any) -> list[PriorEnd]:
    evaluator = Evaluator.of(found)
    sampling = SamplingDistribution.of(evaluator, np.array(theta), np.ones(1))
    return ends_by_metric(sampling)


@pytest.mark.parametrize("name", sorted(METRICS))
@pytest.mark.parametrize(("place", "bound"), [(2.85, 1.0), (-1.85, 0.0)])
def test_data_beyond_a_prior_push_to_its_end_and_draws_stay_there(
    name: str, place: float, bound: float
) -> None:
    problem = model(place + 0.3 * LEVELS, unit, narrow, METRICS[name], prb.Reweighted(1024))
    optimum = prb.minimize(problem, progressbar=False)
    (finding,) = optimum.findings
    assert finding.code == "prior-end"
    assert "The data push mu to" in finding.text
    assert f"next to the end of its prior at {bound:.4g}" in finding.text
    if (name, bound) in {("kl", 1.0), ("area", 0.0)}:
        # Refits of the area metric are at an edge, where its estimate has no density.
        adjustment: Any = None if name == "area" else "estimate"
        sampler: dict[str, Any] = {"draws": 300, "chains": 2, "random_seed": 1}
        tree = prb.sample_smc(
            model=problem, optimum=optimum, adjustment=adjustment, progressbar=False, **sampler
        )
        # They went back to the prior, whose mean is a half, where estimates have no density.
        assert abs(float(tree.posterior["mu"].mean()) - bound) < 0.15


def test_the_middle_of_a_prior_is_no_end_and_nor_is_a_population_without_scatter() -> None:
    assert not ends(model(0.5 + 0.3 * LEVELS, unit, narrow), [0.0, np.log(0.3)])
    # A standard deviation that is small beside the kernel, whose prior ends at zero.
    assert not ends(model(0.5 + 0.01 * LEVELS, unit, narrow), [0.0, np.log(1e-5)])
    # At the other end than the data's the middle is better, so that these do not push there.
    assert not ends(model(2.85 + 0.3 * LEVELS, unit, narrow), [-6.0, np.log(1.8)])


def test_two_that_only_stand_for_each_other_are_not_pushed() -> None:
    with pm.Model() as found:
        x = pm.Normal.dist(pm.Uniform("a", 0, 1), 0.3)
        z = pm.Normal.dist(pm.Uniform("b", 0, 1), 0.3)
        prb.Simulator(
            "y", added, x, z, metric=METRICS["kl"], observed=1.2 + 0.42 * LEVELS, propagation=R256
        )
    # One at its upper end, the other at its lower one, or elsewhere.
    assert not ends(found, [4.0, -4.0])
    assert not ends(found, [4.0, 0.0])


def estimates(mu: Floats, sd: Floats, n: int, rng: np.random.Generator) -> Floats:
    """Return means and log standard deviations of samples of normal populations, (S, 2)."""
    y = mu[:, None] + sd[:, None] * rng.standard_normal((len(mu), n))
    return np.stack([y.mean(axis=1), np.log(y.std(axis=1))], axis=1)


def sharp_prior(size: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    return 10 + 0.3 * rng.standard_normal(size), np.exp(0.2 * rng.standard_normal(size))


@pytest.mark.parametrize(
    ("n", "mu_off", "column", "power"),
    [(10, 4, 0, 0.86), (20, 4, 0, 0.98), (10, 2, 0, 0.21), (20, 3, 0, 0.83)],
)
def test_power_for_a_mean_off_the_prior(n: int, mu_off: int, column: int, power: float) -> None:
    rng = np.random.default_rng(n)
    predictive = estimates(*sharp_prior(1000, rng), n, rng)
    observed = estimates(np.full(300, 10 + 0.3 * mu_off), np.ones(300), n, rng)
    p = [prior_conflict(t, np.ones(2), t, predictive).p_values[column] for t in observed]
    # standard error .029 at most, and .03 of the 1000 simulated estimates
    assert np.mean(np.array(p) <= 0.05) == pytest.approx(power, abs=0.16)


def test_size_of_single_and_of_adjusted_p_values() -> None:
    rng = np.random.default_rng(0)
    predictive = estimates(*sharp_prior(2000, rng), 20, rng)
    observed = estimates(*sharp_prior(1000, rng), 20, rng)
    tests = [prior_conflict(t, np.ones(2), t, predictive) for t in observed]
    single = np.array([test.p_values for test in tests])
    # standard error .007, and .005 of the simulated estimates
    assert (single <= 0.05).mean(axis=0) == pytest.approx([0.05, 0.05], abs=0.035)
    family = np.array([test.adjusted.min() for test in tests])
    assert np.mean(family <= 0.05) == pytest.approx(0.05, abs=0.035)


def test_holm() -> None:
    predictive = np.tile(np.arange(999.0)[:, None], (1, 4))
    # p = 2 (k + 1) / 1000 for k simulated estimates as far out
    test = prior_conflict(np.array([4.5, 994.5, 9.5, 499.0]), np.ones(4), np.zeros(4), predictive)
    assert test.p_values == pytest.approx([0.012, 0.01, 0.022, 1.0])
    assert test.adjusted == pytest.approx([0.04, 0.04, 0.044, 1.0])  # never decreasing
    assert test.pulls == pytest.approx([4.5, 994.5, 9.5, 499.0])  # in standard errors


def test_a_conflict_needs_both_p_value_and_pull() -> None:
    rng = np.random.default_rng(2)
    prior = rng.normal(10, 0.3, (1000, 1))
    predictive = prior + rng.normal(0, 0.2, prior.shape)

    def codes(estimate: float, posterior: float) -> list[str]:
        values = (np.array([v]) for v in (estimate, 0.2, posterior))
        findings = conflict_findings(["mu"], prior, *values, predictive)
        return [finding.code for finding in findings]

    assert codes(11.6, 11.2) == ["prior-conflict"]
    assert codes(11.6, 11.55) == []
    assert codes(10.1, 10.4) == []
    assert codes(8.4, 8.8) == ["prior-conflict"]


def test_the_text_has_both_sides_and_the_unit_is_the_users() -> None:
    rng = np.random.default_rng(3)
    prior = rng.normal(10, 0.3, (1000, 1))
    predictive = prior + rng.normal(0, 0.2, prior.shape)
    arguments = [np.array([11.8]), np.array([0.2]), np.array([11.2])]
    (finding,) = conflict_findings(["mu"], prior, *arguments, predictive)
    assert finding.text.startswith("mu: got prior 10 +- 0.3, data 11.8 +- 0.2 (p = 0.002); ")
    assert "the prior pulls the posterior mean to 11.2, 3.0 standard errors" in finding.text
    scaled = [1000 * v for v in arguments]
    (other,) = conflict_findings(["mu"], 1000 * prior, *scaled, 1000 * predictive)
    assert "3.0 standard errors" in other.text
    assert "(p = 0.002)" in other.text


def test_failed_estimates_are_left_out() -> None:
    at = np.array([4.5]), np.ones(1), np.zeros(1)
    predictive = np.arange(999.0)[:, None]
    failed = np.concatenate([predictive, np.full((50, 1), np.nan), np.full((9, 1), -np.inf)])
    assert prior_conflict(*at, failed).p_values == prior_conflict(*at, predictive).p_values
    assert prior_conflict(*at, np.full((3, 1), np.nan)).p_values == 1
