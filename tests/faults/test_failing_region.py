"""Responses that are NaN in a region: what metrics compare, what is refused, what is reported."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes._validate import Floats
from prbayes.inference.checks.population import lost_mass_shift
from prbayes.model.data_checks import check_failing_region
from prbayes.model.evaluator import Evaluator, compiled_objective
from prbayes.propagation.base import DesignError, responding_weights

OBSERVED = np.random.default_rng(5).normal(10, 2, 40)  # mean 9.356, sd 1.648, from 6.54
TWO = np.column_stack([OBSERVED, np.random.default_rng(6).normal(2 * OBSERVED, 1)])
STORED = prb.Reweighted(256)
COMMON = prb.Resimulated(256)


def model(limit: float, metric: Any, propagation: Any = STORED, failed: float = np.nan) -> pm.Model:
    """Return a normal population whose response fails below a limit."""

    def response(x: Floats) -> Floats:
        return np.where(x < limit, failed, x)

    def outputs(x: Floats) -> Floats:
        return np.stack([x, 2 * response(x)], axis=-1)

    several = metric.takes_outputs
    with pm.Model() as built:
        x = pm.Normal.dist(pm.Normal("mu", 9, 3), pm.HalfNormal("sigma", 3))
        prb.Simulator(
            *("y", outputs if several else response, x),
            metric=metric,
            observed=TWO if several else OBSERVED,
            propagation=propagation,
        )
    return built


def mean_difference(simulated: Floats, observed: Floats, weights: Floats) -> Any:
    used = np.where(weights > 0, simulated, 0.0)
    return np.abs((weights * used).sum(axis=-1) - observed.mean())


METRICS = [
    prb.KullbackLeibler(),
    prb.ProbabilityResidual(),
    prb.AreaMetric(),
    prb.FunctionMetric(mean_difference, weighted=True),
    prb.Joint(prb.KullbackLeibler()),
]


@pytest.mark.parametrize("propagation", [STORED, COMMON], ids=["stored", "common"])
@pytest.mark.parametrize("metric", METRICS, ids=lambda metric: type(metric).__name__)
def test_metrics_compare_the_specimens_with_a_response(metric: Any, propagation: Any) -> None:
    evaluator = Evaluator.of(model(6.0, metric, propagation))
    node = evaluator.nodes[0]
    thetas = np.array([[9.0, np.log(1.5)], [10.0, np.log(2.5)]])
    values, weights = node.bound.populations(evaluator.parents(thetas, 0))
    expected = []
    for y, w in zip(values, weights, strict=True):
        is_used = ~np.isnan(y).reshape(len(y), -1).any(axis=1)
        assert 0.005 < w[~is_used].sum() < 0.2
        part = w[is_used] / w[is_used].sum()
        expected.append(node.target.of(y[is_used], part))
    evaluated = evaluator.discrepancies(thetas, 0)
    np.testing.assert_allclose(evaluated, expected, rtol=1e-9)
    if metric.symbolic:
        graph = compiled_objective(evaluator, prior=False, gradient=False)
        compiled = [graph(theta, np.ones(1))[0] for theta in thetas]
        np.testing.assert_allclose(compiled, expected, rtol=1e-9)


def test_gradients_with_a_failing_region_are_those_of_differences() -> None:
    evaluator = Evaluator.of(model(7.0, prb.KullbackLeibler()))
    objective = compiled_objective(evaluator, prior=False, gradient=True)
    theta = np.array([9.3, 0.6])
    steps = 1e-5 * np.eye(2)
    upper, lower = (evaluator.discrepancies(theta + s * steps, 0) for s in (1, -1))
    _, gradient = objective(theta, np.ones(1))
    np.testing.assert_allclose(gradient, (upper - lower) / 2e-5, rtol=1e-5)


def test_weights_without_any_response_stay_zero() -> None:
    values = np.array([[np.nan, np.nan], [np.nan, 1.0]])
    weights = responding_weights(values, np.full((2, 2), 0.5))
    np.testing.assert_array_equal(weights, [[0, 0], [0, 1]])


@cache
def complete(metric: Any) -> prb.Optimum:
    return prb.minimize(model(-np.inf, metric), starts=0)


@pytest.mark.parametrize("metric", METRICS[:2], ids=lambda metric: type(metric).__name__)
def test_a_small_failing_region_hardly_moves_the_optimum(metric: Any) -> None:
    """No observed value is in the region, where .4 % of the population are."""
    partial, whole = prb.minimize(model(5.0, metric), starts=0), complete(metric)
    for name in ("mu", "sigma"):
        assert abs(partial.point[name] - whole.point[name]) < 0.3 * whole.stderr[name]


@pytest.mark.parametrize("propagation", [STORED, COMMON], ids=["stored", "common"])
@pytest.mark.parametrize("metric", METRICS[1:3], ids=lambda metric: type(metric).__name__)
def test_populations_that_lose_specimens_are_refused(metric: Any, propagation: Any) -> None:
    """Without responses below the limit, 5 of 40 specimens could not be measured."""
    with pytest.raises(DesignError, match=r"no run has a finite|lost mass: .* of "):
        prb.minimize(model(7.5, metric, propagation))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("route", [prb.minimize, prb.sample, prb.sample_smc])
def test_the_likelihood_refuses_populations_without_response(route: Any) -> None:
    with pytest.raises(DesignError, match="observed responses where no run has a finite"):
        route(model=model(8.0, prb.LogLikelihood()))


def test_readings_where_the_response_fails_stay_in_the_findings_of_an_optimum() -> None:
    built = model(7.5, prb.KullbackLeibler(), prb.Reweighted(256, max_lost=0.9))
    assert prb.minimize(built, refine=False).findings[0].code == "failing-data"


@pytest.mark.parametrize("metric", METRICS[::2][:2], ids=lambda metric: type(metric).__name__)
def test_standard_errors_of_common_responses_are_those_of_a_truncated_population(
    metric: Any,
) -> None:
    """Against the Fisher information of a normal population above 6, at 9.2 and 1.8, N = 40."""
    optimum = prb.minimize(model(6.0, metric, prb.Resimulated(512)), starts=0)
    assert optimum.stderr["mu"] == pytest.approx(0.33, rel=0.15)
    assert optimum.stderr["sigma"] == pytest.approx(0.26, rel=0.2)


def test_an_allowed_share_is_not_refused_by_the_likelihood() -> None:
    prb.minimize(model(5.0, prb.LogLikelihood(), prb.Reweighted(64, max_lost=0.2)), starts=0)


# -- observed values where runs fail ---------------------------------------------------------


def region(limit: float, d: int = 1, end: float = np.inf) -> tuple[Floats, Floats, Floats]:
    """Return inputs, responses that fail between limits, and complete responses, of 512 runs."""
    x = np.random.default_rng(0).normal(10, 3, (512, d))
    y = x[:, 0] + 0.2 * x[:, 1:].sum(axis=1)
    return x, np.where((x[:, 0] > limit) & (x[:, 0] < end), np.nan, y), y


@pytest.mark.parametrize("failed", [np.nan, np.inf])
@pytest.mark.parametrize(("limit", "end"), [(12.0, np.inf), (-np.inf, 8.0), (9.0, 10.0)])
def test_observed_values_in_a_failing_region_are_refused(
    limit: float, end: float, failed: float
) -> None:
    x, y, _ = region(limit, end=end)
    y = np.where(np.isnan(y), failed, y)
    inside = 9.5 if end == 10 else (13.0 if limit == 12 else 7.0)
    observed = np.array([10.5, 11.0, 8.5, inside])
    with pytest.raises(DesignError, match=rf"got 1 of 4 observed .* such as {inside:.4g}:"):
        check_failing_region("y", observed, [x], y, 0.05)


def test_a_few_observed_values_in_a_failing_region_are_reported() -> None:
    x, y, _ = region(12.0)
    findings = check_failing_region("y", np.r_[np.linspace(8, 11.5, 39), 14.0], [x], y, 0.05)
    assert [finding.code for finding in findings] == ["failing-data"]


def test_observed_values_beside_finite_responses_are_accepted() -> None:
    x, y, complete_values = region(12.0, d=2)
    observed = np.r_[np.random.default_rng(1).normal(9, 1, 40)]
    assert not check_failing_region("y", observed, [x[:, :1], x[:, 1:]], y, 0.05)
    # Values outside the responses are not in a failing region without failing runs nearby.
    assert not check_failing_region("y", np.array([-20.0, 9.0]), [x[:, :1], x[:, 1:]], y, 0.05)
    assert not check_failing_region("y", np.array([99.0]), [x], complete_values, 0.05)
    assert not check_failing_region("y", np.array([99.0]), [x[:20]], y[:20], 0.05)
    assert not check_failing_region("y", np.array([np.inf, np.nan]), [x[:, :1], x[:, 1:]], y, 0.05)


# -- specimens without response that count -----------------------------------------------------


def test_the_shift_is_that_of_specimens_far_from_the_data() -> None:
    optimum = prb.minimize(
        model(6.0, prb.AreaMetric(), prb.Reweighted(256, max_lost=0.3)), starts=0
    )
    stderr = np.sqrt(np.diag(optimum.covariance))
    shift = lost_mass_shift(optimum.evaluator, optimum.theta, np.ones(1), stderr)
    far = prb.minimize(model(6.0, prb.KullbackLeibler(), failed=1e6), starts=0)
    kld = prb.minimize(
        model(6.0, prb.KullbackLeibler(), prb.Reweighted(256, max_lost=0.3)), starts=0
    )
    stderr = np.sqrt(np.diag(kld.covariance))
    counted = kld.theta + stderr * lost_mass_shift(kld.evaluator, kld.theta, np.ones(1), stderr)
    np.testing.assert_allclose(counted, far.theta, atol=0.05 * stderr.min())
    assert shift[1] < -0.5
    texts = {finding.code: finding.text for finding in prb.diagnose(kld).findings}
    assert "minus the data, if they fail at the low end" in texts["lost-mass-matters"]


def test_a_tiny_lost_share_does_not_matter() -> None:
    optimum = prb.minimize(model(3.0, prb.KullbackLeibler()), starts=0)
    assert "lost-mass-matters" not in [finding.code for finding in prb.diagnose(optimum).findings]
