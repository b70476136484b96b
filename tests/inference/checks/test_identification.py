"""Model discrepancies that are confounded with the inputs' scatter, and optima at an edge."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytest
from one_input import one_input

import prbayes as prb
from prbayes.inference.asymptotics import Local
from prbayes.inference.checks.identification import (
    breakdown_findings,
    canonical_correlation,
    confounding_findings,
    correlated_estimates,
    elements_at_edge,
    mixed_directions,
    unknown_error_findings,
)
from prbayes.inference.refits import SamplingDistribution
from prbayes.model.evaluator import Evaluator


def local(identified: Any, variances: Any, size: int) -> Local:
    """Return what data identify along some directions, with variances."""
    axes = np.array(identified, dtype=float).reshape(size, -1)
    whole, _ = np.linalg.qr(np.concatenate([axes, np.eye(size)], axis=1))
    rank = axes.shape[1]
    return Local(np.ones(size), axes, whole[:, rank:], np.diag(np.atleast_1d(variances)))


def test_the_canonical_correlation_is_the_largest_of_all_combinations() -> None:
    root = np.random.default_rng(1).normal(size=(5, 5))
    covariance = root @ root.T
    rows, columns = np.array([0, 3]), np.array([1, 2, 4])
    correlation, of_rows, of_columns = canonical_correlation(covariance, rows, columns)
    first, second = covariance[np.ix_(rows, rows)], covariance[np.ix_(columns, columns)]
    between = covariance[np.ix_(rows, columns)]
    # Its square is the largest eigenvalue of S11^-1 S12 S22^-1 S21.
    explained = np.linalg.solve(first, between) @ np.linalg.solve(second, between.T)
    assert correlation**2 == pytest.approx(np.linalg.eigvals(explained).real.max())
    # The loadings are the covariances with the best combinations.
    best, other = np.linalg.solve(first, of_rows), np.linalg.solve(second, of_columns)
    assert best @ between @ other == pytest.approx(correlation)
    pair = np.array([[4.0, -1.8], [-1.8, 1.0]])
    assert canonical_correlation(pair, rows[:1], columns[:1])[0] == pytest.approx(0.9)


NAMES = ["mu", "lift", "sigma"]
OWN, OTHERS = np.array([1]), np.array([0, 2])


def test_directions_of_both_blocks_are_named() -> None:
    sum_only = local([[1, 0], [1, 0], [0, np.sqrt(2)]] / np.sqrt(2), [0.01, 0.01], 3)
    text = mixed_directions(sum_only, OWN, OTHERS, NAMES)
    assert text in {"mu - lift is not identified", "lift - mu is not identified"}
    for missing in range(3):
        axes = np.delete(np.eye(3), missing, axis=1)
        assert mixed_directions(local(axes, [0.01, 0.01], 3), OWN, OTHERS, NAMES) == ""
    assert mixed_directions(local(np.zeros((3, 0)), [], 3), OWN, OTHERS, NAMES) == ""


def test_correlated_estimates_are_named() -> None:
    axes = np.array([[1, 1, 0], [1, -1, 0], [0, 0, np.sqrt(2)]]) / np.sqrt(2)
    text = correlated_estimates(local(axes, [1e-5, 0.02, 0.01], 3), OWN, OTHERS, NAMES)
    assert text == "estimates of lift and mu have a correlation of 0.999 in size"
    assert correlated_estimates(local(axes, [1e-2, 0.02, 0.01], 3), OWN, OTHERS, NAMES) == ""


@pytest.mark.parametrize(
    ("conditions", "prior_sd", "is_confounded"),
    [([2.0], 5.0, True), ([0.0, 2.0], 5.0, False), ([2.0], 0.02, False)],
)
def test_a_second_condition_or_a_narrow_prior_separates_a_discrepancy(
    conditions: list[float], prior_sd: float, is_confounded: bool
) -> None:
    rng = np.random.default_rng(1)
    x, b = rng.normal(1, 0.2, 40), rng.normal(3, 0.4, 40)
    rise = prb.response.Additive([0.0, 2.0])
    observed = np.stack([x + b * c / 2 for c in conditions], axis=-1)
    if len(conditions) == 1:
        response = rise.of(lambda x: x, conditions[0])
        metric: Any = prb.KullbackLeibler()
        observed = observed[:, 0]
    else:
        response = rise.of(lambda x: np.stack([x] * len(conditions), axis=-1), conditions)
        metric = prb.Joint(prb.KullbackLeibler())
    with pm.Model() as model:
        x_dist = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        b_dist = pm.Normal.dist(pm.Normal("lift", 3, prior_sd), 0.4)
        data = {"observed": observed, "propagation": prb.Resimulated(128)}
        prb.Simulator("y", response, x_dist, b_dist, metric=metric, **data)
    evaluator = Evaluator.of(model)
    sampling = SamplingDistribution.of(evaluator, np.array([1.0, np.log(0.2), 3.0]), np.ones(1))
    findings = confounding_findings(evaluator, sampling.local)
    assert [finding.code for finding in findings] == ["discrepancy-confounded"] * is_confounded
    for finding in findings:
        assert "lift" in finding.text
        assert "measure under more conditions" in finding.text


def test_a_model_without_a_discrepancy_confounds_nothing() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2) + pm.Normal("nu", 0, 2), 1.0)
        prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=[0.0, 1.0, 2.0])
    assert confounding_findings(Evaluator.of(model), local([[1.0], [1.0]], [0.1], 2)) == []


def test_standard_errors_that_are_not_known_are_reported_with_the_reason() -> None:
    stderr = {"mu": 0.1, "tau": np.array([np.inf, 0.2])}
    assert unknown_error_findings(stderr, None) == []
    (finding,) = unknown_error_findings(stderr | {"s": np.nan, "v": np.array([1.0, np.nan])}, "y")
    assert finding.code == "no-standard-error"
    assert "of s, v are not known (NaN): y; " in finding.text
    (finding,) = unknown_error_findings({"s": np.nan}, None)
    assert "end of a support" in finding.text


def test_an_optimum_without_standard_errors_has_a_finding() -> None:
    metric = prb.FunctionMetric(lambda s, o: (s.mean(axis=-1) - o.mean(axis=-1)) ** 2)
    model = one_input(np.linspace(0, 2, 9), metric, prb.Resimulated(64), mu=(1, 1), sd=1.0)
    optimum = prb.minimize(model, progressbar=False)
    assert np.isnan(optimum.stderr["mu"])
    (finding,) = [f for f in optimum.findings if f.code == "no-standard-error"]
    assert "refits" in finding.text
    assert not prb.diagnose(optimum).ok


def test_what_breaks_down_is_said_by_name_and_only_then() -> None:
    assert breakdown_findings((), ()) == []
    edge, jump = breakdown_findings(("sigma", "tau"), ("y",))
    assert edge.text.startswith("sigma, tau reached the edge of the support")
    assert jump.text.startswith("y: points lose their response at the optimum")


def edges(response: Any, mu: Any, observed: Any, metric: prb.Metric, theta: Any) -> tuple[str, ...]:
    with pm.Model() as model:
        x = pm.Normal.dist(mu("mu"), pm.HalfNormal("sigma", 0.3))
        data = {"observed": observed, "propagation": prb.Resimulated(64)}
        prb.Simulator("y", response, x, metric=metric, **data)
    options: dict[str, Any] = {"size": 1.0, "tolerance": 1e-6, "seed": 0}
    return elements_at_edge(Evaluator.of(model), np.array(theta), np.ones(1), **options)


@pytest.mark.parametrize(
    ("out", "at_edge"), [(-12.0, ("sigma",)), (-42.0, ("sigma",)), (-300.0, ("sigma",)), (3.0, ())]
)
def test_a_population_that_collapsed_is_known_however_far_out(
    out: float, at_edge: tuple[str, ...]
) -> None:
    """From a spread of 1e-16 of the values on they are one number, and change no more.

    As far out to the other side, populations are wide, and fit worse.
    """
    observed = np.random.default_rng(1).normal(1.5, 0.1, 20)
    metric = prb.LogLikelihood(density=prb.GaussianKDE(0.5))
    assert (
        edges(np.positive, lambda n: pm.Normal(n, 1.5, 0.5), observed, metric, [1.5, out])
        == at_edge
    )


@pytest.mark.parametrize("out", [-12.0, -42.0])
def test_a_mean_at_the_bound_of_its_prior_is_at_no_edge(out: float) -> None:
    """There the population stands still as soon as the discrepancy does."""
    observed = np.random.default_rng(1).normal(-1.0, 0.3, 20)
    metric = prb.ProbabilityResidual()
    theta = [out, -1.0]
    assert edges(lambda x: x - 0.5, lambda n: pm.Uniform(n, 0, 3), observed, metric, theta) == ()
