"""Which directions the data identify, and the names of those they do not."""

from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.inference.asymptotics import Information, identified_by_area
from prbayes.inference.identifiability import (
    identified_by_curvature,
    oriented,
    unidentified_directions,
    without,
)
from prbayes.model.evaluator import Evaluator

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 50)
METRICS: dict[str, prb.Metric] = {
    "ll": prb.LogLikelihood(density=prb.GaussianKDE()),
    "kl": prb.KullbackLeibler(),
    "pr": prb.ProbabilityResidual(),
}
R256 = prb.Reweighted(256)


def slow(name: str) -> Any:
    return pytest.param(name, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("unidentified", "lines"),
    [
        ([[0, 1, 0]], ["b"]),
        ([[1, -1, 0]], ["a - b"]),
        ([[1, 1, 0]], ["a + b"]),
        ([[1, -0.5, 0.05]], ["a - 0.5 b"]),  # the smallest is not mentioned
        ([[0.2, 0, -1]], ["c - 0.2 a"]),  # the largest comes first, with a plus
        ([[1, 1, 1], [1, 1, -1]], ["c", "a + b"]),  # rotated so that c stands alone
        ([[1, 0, 0], [0, 1, 0], [0, 0, 1]], ["a", "b", "c"]),
    ],
)
def test_directions_have_names(unidentified: Any, lines: list[str]) -> None:
    assert [
        sorted_signs(d)
        for d in unidentified_directions(
            np.linalg.qr(np.array(unidentified, dtype=float).T)[0], ["a", "b", "c"]
        )
    ] == lines


def sorted_signs(line: str) -> str:
    # Where two are equally large, rounding decides which comes first.
    return {"b - a": "a - b", "b + a": "a + b"}.get(line, line)


def test_where_all_is_identified_nothing_is_named() -> None:
    assert unidentified_directions(np.zeros((2, 0)), ["a", "b"]) == []


def test_rounding_errors_are_not_information() -> None:
    noise = np.diag([0.5, 1e-13])
    # Curvature and noise of the second direction are rounding errors; their ratio looks like a
    # standard error of 0.1.
    assert list(identified_by_curvature(np.diag([5.0, 3e-6]), noise)[2]) == [
        False,
        True,
    ]  # sorted by curvature
    # A direction that says a little more than the prior is seen beside one that says much more.
    assert identified_by_curvature(np.diag([500.0, 0.15]), np.diag([50.0, 0.015]))[2].all()
    # Where nothing changes, nothing is seen.
    assert not identified_by_curvature(np.zeros((2, 2)), np.zeros((2, 2)))[2].any()


@pytest.mark.parametrize("name", [slow("ll"), slow("kl"), "pr"])
def test_a_sum_hides_a_difference(name: str) -> None:
    # Both priors have the same spread, hence coefficients of one in its units; the response weighs
    # b twice.
    with pm.Model() as model:
        a, b = pm.Normal("a", 0, 1), pm.Normal("b", 0, 1, shape=1)
        x, z = pm.Normal.dist(a, 0.5), pm.Normal.dist(b[0], 0.5)
        prb.Simulator(
            "y", lambda x, z: x + 2 * z, x, z, metric=METRICS[name], observed=3 * OBSERVED,
            propagation=prb.Resimulated(256),
        )  # fmt: skip
    optimum = prb.minimize(model)
    (finding,) = optimum.findings
    assert finding.text.startswith(
        "The data tell less than the prior about a - 0.5 b[0] (in units of the priors'"
    )
    assert np.isinf(optimum.stderr["a"])
    assert np.isinf(optimum.stderr["b"]).all()


@pytest.mark.parametrize("n", [256, 1024])
def test_a_ridge_under_the_area_metric_is_seen_through_few_points(n: int) -> None:
    """Two sources of scatter, of which only the sum is measured: what tells them apart is the points' own error."""
    with pm.Model() as model:
        u = pm.Normal.dist(1, pm.HalfNormal("sigma", 1))
        v = pm.Normal.dist(0, pm.HalfNormal("noise", 1))
        keywords = {
            "metric": prb.AreaMetric(),
            "observed": OBSERVED,
            "propagation": prb.Resimulated(n),
        }
        prb.Simulator("y", lambda u, v: u + v, u, v, **keywords)
    optimum = prb.minimize(model)
    assert all(np.isinf(optimum.stderr[name]) for name in ("sigma", "noise"))
    (finding,) = optimum.findings
    assert "sigma" in finding.text
    assert "noise" in finding.text


def test_what_is_seen_under_the_area_metric_is_seen_through_few_points_as_well() -> None:
    with pm.Model() as model:
        u = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        v = pm.Normal.dist(0, 0.2)
        keywords = {
            "metric": prb.AreaMetric(),
            "observed": OBSERVED,
            "propagation": prb.Resimulated(256),
        }
        prb.Simulator("y", lambda u, v: u + v, u, v, **keywords)
    optimum = prb.minimize(model)
    assert all(np.isfinite(optimum.stderr[name]) for name in ("mu", "sigma"))
    assert optimum.findings == ()


def test_a_standard_error_of_the_priors_spread_is_the_limit() -> None:
    # H = 1: the standard error is the root of J.
    hessian = np.eye(2)
    noise = np.diag([0.9, 1.1])
    assert sorted(identified_by_curvature(hessian, noise)[2]) == [False, True]
    assert identified_by_curvature(hessian, noise, weakest=1.1)[2].all()
    assert not identified_by_curvature(hessian, noise, weakest=0.9)[2].any()


def test_turned_matrices_have_turned_directions() -> None:
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    hessian = turn @ np.diag([1.0, 9.0]) @ turn.T
    noise = turn @ np.diag([4.0, 4.0]) @ turn.T
    values, vectors, seen = identified_by_curvature(hessian, noise)
    np.testing.assert_allclose(values, [1.0, 9.0])
    np.testing.assert_allclose(np.abs(vectors.T @ turn), np.eye(2), atol=1e-12)
    assert list(seen) == [False, True]


def test_a_maximum_identifies_nothing() -> None:
    assert not identified_by_curvature(-np.eye(2), np.diag([0.01, 0.01]))[2].any()


def test_of_a_sum_of_two_means_an_area_identifies_only_the_sum() -> None:
    with pm.Model() as model:
        a, b = pm.Normal("a", 0, 1), pm.Normal("b", 0, 1)
        x = pm.Normal.dist(a + b, 0.5)
        prb.Simulator(
            "y", np.positive, x, metric=prb.AreaMetric(), observed=OBSERVED, propagation=R256
        )
    information = Information(Evaluator.of(model), 0, np.array([0.5, 0.5]), n_sets=50)
    seen = identified_by_area(information)
    assert seen.shape == (2, 1)
    # In units of the priors' spreads, which are known from draws to some per cent.
    assert abs(seen[:, 0] @ np.sqrt([0.5, 0.5])) > 0.99


def test_directions_of_other_elements_are_left_out() -> None:
    # The first two elements are not identified, and the sum of the others is not.
    hidden = np.zeros((4, 3))
    hidden[:2, :2] = [[0.6, 0.8], [-0.8, 0.6]]
    hidden[2:, 2] = np.sqrt(0.5)
    others = np.array([True, True, False, False])
    left = without(hidden, others)
    assert unidentified_directions(left, ["m", "tau", "a", "b"]) == ["a + b"]
    assert without(hidden, np.zeros(4, dtype=bool)) is hidden


def test_what_is_looked_at_stays_when_the_design_grows() -> None:
    """Populations around an optimum are those of the design as it was."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        y = pm.Normal.dist(pm.Normal("nu", 0, 2), 0.5)
        prb.Simulator(
            "y", lambda x, y: x + y, x, y, metric=prb.AreaMetric(), observed=OBSERVED,
            propagation=prb.Reweighted(1024, emulator=None),
        )  # fmt: skip
    evaluator = Evaluator.of(model)
    theta = evaluator.hyperparameters.initial
    information = Information(evaluator, 0, theta, n_sets=20)
    before = identified_by_area(information)
    (bound,) = evaluator.reweighted.values()
    bound.add([np.atleast_1d(values) for values in evaluator.roots(theta[None], 0)], 512)
    assert bound.n_points == 1536
    np.testing.assert_array_equal(identified_by_area(information), before)


def test_signs_of_axes_do_not_matter() -> None:
    axes, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(5, 3)))
    turned = oriented(axes * np.array([1.0, -1.0, -1.0]))
    np.testing.assert_array_equal(turned, oriented(axes))
    np.testing.assert_array_equal(np.abs(turned), np.abs(axes))
