"""Model inadequacy that cannot be told from the inputs' scatter, and optima at an edge."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.inference.asymptotics import Local
from prbayes.inference.checks.identification import (
    breakdown_findings,
    canonical_correlation,
    confounding_findings,
    correlated_estimates,
    elements_at_edge,
    mixed_directions,
)
from prbayes.model.evaluator import Evaluator


def local(identified: Any, variances: Any, size: int) -> Local:
    """Return what data identify along some directions, with variances."""
    axes = np.array(identified, dtype=float).reshape(size, -1)
    whole, _ = np.linalg.qr(np.concatenate([axes, np.eye(size)], axis=1))
    rank = axes.shape[1]
    return Local(np.ones(size), axes, whole[:, rank:], np.diag(np.atleast_1d(variances)))


def test_the_canonical_correlation_of_two_numbers_is_their_correlation() -> None:
    covariance = np.array([[4.0, -1.8], [-1.8, 1.0]])
    found, _, _ = canonical_correlation(covariance, np.array([0]), np.array([1]))
    assert found == pytest.approx(0.9)


def test_it_is_the_largest_over_all_combinations() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(5, 5))
    covariance = root @ root.T
    own, others = np.array([0, 3]), np.array([1, 2, 4])
    found, of_own, of_others = canonical_correlation(covariance, own, others)
    both = rng.normal(size=(20_000, 5))
    a, b = both[:, own], both[:, others]
    top = np.einsum("ki,ij,kj->k", a, covariance[np.ix_(own, others)], b)
    left = np.einsum("ki,ij,kj->k", a, covariance[np.ix_(own, own)], a)
    right = np.einsum("ki,ij,kj->k", b, covariance[np.ix_(others, others)], b)
    tried = np.abs(top) / np.sqrt(left * right)
    assert 0.97 * found < tried.max() <= found * (1 + 1e-9)
    # The loadings are the covariances with the best combinations.
    best = np.linalg.solve(covariance[np.ix_(own, own)], of_own)
    other = np.linalg.solve(covariance[np.ix_(others, others)], of_others)
    assert best @ covariance[np.ix_(own, others)] @ other == pytest.approx(found)


NAMES = ["mu", "lift", "sigma"]
OWN, OTHERS = np.array([1]), np.array([0, 2])


def test_what_is_not_identified_of_both_is_named() -> None:
    sum_only = local([[1, 0], [1, 0], [0, np.sqrt(2)]] / np.sqrt(2), [0.01, 0.01], 3)
    assert mixed_directions(sum_only, OWN, OTHERS, NAMES) in {
        "mu - lift is not identified",
        "lift - mu is not identified",
    }


def test_what_is_not_identified_of_one_alone_is_notmixed_directions() -> None:
    for missing in range(3):
        axes = np.delete(np.eye(3), missing, axis=1)
        assert mixed_directions(local(axes, [0.01, 0.01], 3), OWN, OTHERS, NAMES) == ""
    assert mixed_directions(local(np.zeros((3, 0)), [], 3), OWN, OTHERS, NAMES) == ""


@pytest.mark.parametrize(("along", "told"), [(1e-5, True), (1e-2, False)])
def test_estimates_that_are_alike_are_named(along: float, told: bool) -> None:
    axes = np.array([[1, 1, 0], [1, -1, 0], [0, 0, np.sqrt(2)]]) / np.sqrt(2)
    found = correlated_estimates(local(axes, [along, 0.02, 0.01], 3), OWN, OTHERS, NAMES)
    assert bool(found) is told
    if told:
        assert found == "estimates of lift and mu have a correlation of 0.999 in size"


@pytest.fixture(scope="module")
def study() -> Any:
    def calibrated(conditions: list[float], prior_sd: float = 5.0) -> Any:
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
            prb.Simulator(
                *("y", response, x_dist, b_dist),
                metric=metric, observed=observed, propagation=prb.Resimulated(128),
            )  # fmt: skip
        return prb.minimize(model, progressbar=False)

    return calibrated


@pytest.mark.parametrize(
    ("conditions", "prior_sd", "told"), [([2.0], 5.0, True), ([0.0, 2.0], 5.0, False)]
)
def test_one_condition_does_not_tell_them_two_do(
    study: Any, conditions: list[float], prior_sd: float, told: bool
) -> None:
    optimum = study(conditions, prior_sd)
    lines = [f.text for f in optimum.findings if f.code == "discrepancy-confounded"]
    assert len(lines) == told
    assert all("lift" in line and "measure under more conditions" in line for line in lines)


def test_a_narrow_prior_tells_them(study: Any) -> None:
    codes = {finding.code for finding in study([2.0], 0.02).findings}
    assert "discrepancy-confounded" not in codes


def test_a_model_without_an_inadequacy_has_nothing_to_tell() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
        y = pm.Normal.dist(pm.Normal("nu", 0, 2), 1.0)
        prb.Simulator(
            *("y", lambda x, y: x + y, x, y),
            metric=prb.AreaMetric(), observed=[0.0, 1.0, 2.0], propagation=prb.Resimulated(64),
        )  # fmt: skip
    optimum = prb.minimize(model, progressbar=False)
    sampling = local(np.array([[1.0], [1.0]]) / np.sqrt(2), [0.1], 2)
    assert confounding_findings(optimum.evaluator, sampling) == []


def test_what_breaks_down_is_said_by_name_and_only_then() -> None:
    assert breakdown_findings((), ()) == []
    (finding,) = breakdown_findings(("sigma", "tau"), ())
    assert finding.text.startswith("sigma, tau ran to the edge of the support")
    (finding,) = breakdown_findings((), ("y",))
    assert finding.text.startswith("y: points lose their response at the optimum")
    assert len(breakdown_findings(("sigma",), ("y",))) == 2


def edges(model: pm.Model, *theta: float) -> tuple[str, ...]:
    found = elements_at_edge(
        Evaluator.of(model), np.array(theta), np.ones(1), size=1.0, tolerance=1e-6, seed=0
    )
    return found


@pytest.mark.parametrize("out", [-12.0, -20.0, -42.0, -70.0, -300.0])
def test_a_population_that_collapsed_is_known_however_far_out(out: float) -> None:
    """From a spread of 1e-16 of the values on they are one number, and change no more."""
    observed = np.random.default_rng(1).normal(1.5, 0.1, 20)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1.5, 0.5), pm.HalfNormal("sigma", 0.3))
        density = prb.GaussianKDE(0.5)
        metric = prb.LogLikelihood(density=density)
        prb.Simulator(
            "y", np.positive, x, metric=metric, observed=observed, propagation=prb.Resimulated(64)
        )
    assert edges(model, 1.5, out) == ("sigma",)


@pytest.mark.parametrize("out", [-8.0, -12.0, -20.0, -42.0])
def test_a_mean_at_the_bound_of_its_prior_is_at_no_edge(out: float) -> None:
    """There the population stands still as soon as the discrepancy does."""

    def mean(x: Any) -> Any:
        return x - 0.5

    observed = np.random.default_rng(1).normal(-1.0, 0.3, 20)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Uniform("mu", 0, 3), pm.HalfNormal("sigma", 0.3))
        metric = prb.ProbabilityResidual()
        prb.Simulator(
            "y", mean, x, metric=metric, observed=observed, propagation=prb.Resimulated(64)
        )
    assert edges(model, out, -1.0) == ()
