"""`Joint`: directions, invariance, missing outputs, failures, and surfaces."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from prbayes._validate import Floats
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Discrepancy, Metric, is_additive, is_likelihood
from prbayes.metrics.density import GaussianKDE
from prbayes.metrics.divergence import KullbackLeibler, ProbabilityResidual
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.multivariate import (
    Joint,
    directions,
    failure_caps,
    patterns,
    repelled,
    sufficient_directions,
)

INF, NAN = np.inf, np.nan


def by_basis(d: Discrepancy, weights: Floats, basis: Any) -> Floats:
    return np.asarray(d.outer(*basis.features(weights), xp=np))


# -- directions ------------------------------------------------------------------------------------


def largest_cosine(u: Floats) -> float:
    cosine = np.abs(u @ u.T)
    np.fill_diagonal(cosine, 0.0)
    return float(cosine.max())


# In the plane the best are at equal angles; then those of an icosahedron, of the 24-cell and of E6.
@pytest.mark.parametrize(
    ("m", "number", "best"),
    [(2, 5, np.cos(np.pi / 5)), (3, 6, 5**-0.5), (4, 12, 0.5), (6, 36, 0.5)],
)
def test_known_best_arrangements_are_found(m: int, number: int, best: float) -> None:
    assert largest_cosine(directions(m, number, 0)) == pytest.approx(best, abs=2e-3)
    assert np.allclose(directions(m, number, 0), directions(m, number, 1)) == (m == 2)
    assert directions(m, 1, 0).shape == (1, m)


@pytest.mark.parametrize("m", [3, 5, 8])
def test_directions_are_of_unit_length_and_cover_all_directions_alike(m: int) -> None:
    u = directions(m, sufficient_directions(m), 0)
    assert u.shape == ((m - 1) * (m + 2), m)
    np.testing.assert_allclose(np.linalg.norm(u, axis=-1), 1, rtol=1e-15)
    np.testing.assert_allclose(u.T @ u * m / len(u), np.eye(m), atol=0.03)
    # All symmetric matrices differ on them, and so all covariances.
    i, j = np.tril_indices(m)
    assert np.linalg.matrix_rank(u[:, i] * u[:, j], tol=0.3) == i.size


@pytest.mark.parametrize(("m", "number"), [(3, 10), (8, 70)])
def test_neither_rounding_nor_more_steps_decide_the_directions(m: int, number: int) -> None:
    start = np.random.default_rng(0).standard_normal((number, m))
    noise = 1e-14 * np.random.default_rng(1).standard_normal((number, m))
    again = repelled(start * (1 + noise), 400)
    np.testing.assert_allclose(repelled(start, 400), again, atol=1e-9)
    if m < 8:
        difference = largest_cosine(repelled(start)) - largest_cosine(repelled(start, 4000))
        assert abs(difference) < 0.03


# -- a metric of one output, lifted ----------------------------------------------------------------

LIFTED: dict[str, Metric] = {
    "pr": ProbabilityResidual(),
    "kl": KullbackLeibler(),
    "kl-reverse": KullbackLeibler(reverse=True),
    "ll": LogLikelihood(density=GaussianKDE()),
    "area": AreaMetric(),
}
by_metric = pytest.mark.parametrize("metric", LIFTED.values(), ids=LIFTED)


def sample(n: int, m: int = 2, rho: float = 0.9, seed: int = 0) -> Floats:
    y = np.random.default_rng(seed).standard_normal((n, m))
    y[:, 1] = rho * y[:, 0] + np.sqrt(1 - rho**2) * y[:, 1]
    return y


@by_metric
def test_one_output_is_the_metric_itself(metric: Metric) -> None:
    x, z = sample(40)[:, 0], sample(20, seed=1)[:, 0]
    x[0] = INF
    w, u = np.random.default_rng(2).dirichlet(np.ones(40)), np.arange(1.0, 21.0)
    flat, column = Joint(metric).against(z, u), Joint(metric).against(z[:, None], u)
    expected = metric.against(z, u)
    assert type(flat) is type(expected)
    assert flat(x, w) == expected(x, w) == column(x[:, None], w)
    assert (column.event, column.scale) == ((1,), expected.scale)
    assert is_likelihood(column) == metric.likelihood
    rows = np.stack([w, w[::-1]])
    found = by_basis(column, rows, column.basis(x[:, None]))
    np.testing.assert_array_equal(found, by_basis(expected, rows, expected.basis(x)))
    others = column.with_observed(x[1:9, None]), expected.with_observed(x[1:9])
    assert others[0](x[:, None], w) == others[1](x, w)


@by_metric
def test_a_joint_metric_declares_what_its_inner_one_does(metric: Metric) -> None:
    joint = Joint(metric, directions=5)
    for name in ("minimum", "additive", "takes_weights", "tail_responses", "distance"):
        assert getattr(joint, name) == getattr(metric, name)
    d = joint.against(sample(30))
    assert (is_likelihood(d), is_additive(d)) == (False, metric.additive)
    assert (joint.takes_outputs, joint.likelihood) == (True, False)
    assert joint.like(KullbackLeibler()) == Joint(KullbackLeibler(), directions=5)
    assert metric.like(AreaMetric()) == AreaMetric()
    assert pickle.loads(pickle.dumps(joint)).additive == metric.additive
    for other in (3, AreaMetric, joint):
        with pytest.raises(TypeError, match="expected a metric of one output"):
            Joint(other)  # type: ignore[arg-type]


@by_metric
@pytest.mark.parametrize(("m", "rho"), [(2, -0.995), (3, 0.9)])
def test_no_affine_map_of_the_outputs_changes_it(metric: Metric, m: int, rho: float) -> None:
    x, z = sample(60, m, rho), sample(30, m, rho, seed=1)
    w, u = np.random.default_rng(2).dirichlet(np.ones(60)), np.arange(1.0, 31.0)
    rng = np.random.default_rng(m)
    expected = Joint(metric).against(z, u)(x, w)
    shift = rng.normal(0, 10, m)
    for matrix in (
        rng.standard_normal((m, m)),
        -np.eye(m)[rng.permutation(m)],
        np.diag([-1e150, 1e-150, 37.0][:m]),
    ):
        shifted = shift * np.abs(matrix).sum(axis=1)
        found = Joint(metric).against(z @ matrix.T + shifted, u)(x @ matrix.T + shifted, w)
        assert found == pytest.approx(expected, rel=1e-7)


@by_metric
def test_a_wrong_correlation_counts_where_marginals_are_right(metric: Metric) -> None:
    d = Joint(metric).against(sample(200))
    right, wrong = (d(sample(2000, rho=rho, seed=1)) for rho in (0.9, 0.6))
    assert wrong > right + 0.02
    if metric.distance:
        assert d(d.observed) == pytest.approx(0, abs=1e-12)
        assert right > 1e-3


def test_projections_of_the_residual_have_one_factor() -> None:
    y = np.random.default_rng(0).standard_normal((60, 2))
    metric = ProbabilityResidual(GaussianKDE(0.05))
    parts: Any = Joint(metric, directions=12).against(y).parts
    alone: Any = [metric.against(part.observed_of(y)[0]) for part in parts]
    factors = {d.scale_factor for d in alone}
    assert len(factors) > 1
    assert {part.target.scale_factor for part in parts} == {min(factors)}


# -- missing outputs and failures ------------------------------------------------------------------


def test_missing_outputs_are_compared_with_all_specimens_that_have_the_others() -> None:
    x, y = sample(50, 3), sample(24, 3, seed=1)
    y[:6, 0] = NAN
    y[6:12, 1:] = NAN
    area, residual = Joint(AreaMetric()), Joint(ProbabilityResidual())
    whole = area.against(y)
    assert [is_additive(residual.against(z)) for z in (y[12:], y)] == [True, False]
    (alone,) = [part for part in whole.parts if part.label == "direction 1 of outputs 0"]
    values, rows = alone.observed_of(y)
    assert alone.share == pytest.approx(0.25)
    np.testing.assert_array_equal(rows, np.r_[6:24])
    last_two = np.delete(y[:, 1:], np.s_[6:12], axis=0)
    expected = 0.5 * area.against(y[12:])(x) + 0.25 * area.against(last_two)(x[:, 1:])
    expected += 0.25 * alone.target(alone.of(x))
    assert whole(x) == pytest.approx(expected, rel=1e-9)
    unit = np.diff(values) / np.diff(y[6:, 0])
    np.testing.assert_allclose(unit, unit[0], err_msg="in robust units")
    assert 0.5 < abs(unit[0]) < 2
    with pytest.raises(ValueError, match=r"all outputs of a component.* those of 'direction 1'"):
        area.against(y[12:]).with_observed(y[:6])
    assert area.against(np.ma.masked_invalid(y))(x) == whole(x)


def test_sets_of_outputs_are_merged_where_they_are_rare_or_many() -> None:
    y = sample(40, 4)
    y[0, 0] = y[1, 1] = y[2, 2] = NAN
    found = patterns(y, np.full(40, 1 / 40))
    assert [tuple(key) for key, _ in found] == [(0, 1, 2, 3), (0, 1, 3), (0, 2, 3), (1, 2, 3)]
    np.testing.assert_allclose([share for _, share in found], [37 / 40] + 3 * [1 / 40])
    few = patterns(y[:5], np.full(5, 0.2))  # two specimens have all four: too few
    assert all(len(key) + 2 <= 5 for key, _ in few)
    rng = np.random.default_rng(0)
    many = np.where(rng.random((200, 6)) < 0.4, NAN, rng.standard_normal((200, 6)))
    many = many[~np.isnan(many).all(axis=1)]
    merged = patterns(many, np.full(len(many), 1 / len(many)))
    assert len(merged) == 8
    for sets in (few, merged):
        assert sum(share for _, share in sets) == pytest.approx(1)
    assert np.isfinite(Joint(AreaMetric()).against(many)(rng.standard_normal((50, 6))))


def test_failures_count_above_all_others_on_both_sides() -> None:
    caps = failure_caps(np.array([[1.0, NAN], [4.0, -2.0], [INF, -1.0], [3.0, -5.0]]))
    np.testing.assert_array_equal(caps, [7.0, 3.0])
    x, y = sample(60), sample(40, seed=1)
    y[:4, 1] = INF
    d = Joint(AreaMetric()).against(y)
    cap = 2 * y[4:, 1].max() - y[4:, 1].min()
    np.testing.assert_allclose(d(np.where(np.isinf(y), cap, y)), 0, atol=1e-14)
    assert d(y) == pytest.approx(0, abs=1e-14)
    values = []
    for n_failed in (0, 6, 18):
        failing = x.copy()
        failing[:n_failed, 1] = INF
        values.append(d(failing))
    assert values[1] < min(values[0], values[2])
    far = x + np.array([0, 50])
    assert d(far + 1) > d(far), "finite values beyond that are not cut off"


Y = sample(20)


@pytest.mark.parametrize(
    ("observed", "message"),
    [
        (Y[None], r"shape \(1, 20, 2\), expected \(N, m\)"),
        (np.where(np.arange(20)[:, None] == 3, NAN, Y), r"1 specimens without any output \(row 3"),
        (np.where([False, True], INF, Y), r"1 outputs in which every specimen failed \(column 1"),
        (np.where(Y[0, 0] == Y, -INF, Y), "got -inf, expected numbers; NaN is an output"),
    ],
)
def test_wrong_data_are_refused(observed: Any, message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        Joint(AreaMetric()).against(observed)
    with pytest.raises(ValueError, match=r"simulated: got shape \(5, 3\), expected \(..., n, 2\)"):
        Joint(AreaMetric()).against(Y)(np.ones((5, 3)))


# -- fewer inputs than outputs ---------------------------------------------------------------------


def bent(size: int, bend: float, seed: int = 0) -> Floats:
    """Return three outputs of two inputs: a plane, and something across it."""
    a, b = np.random.default_rng(seed).standard_normal((2, size))
    return np.stack([a + b, a - b, a + 0.5 * b + bend * (a**2 - 1)], axis=-1)


def test_a_surface_is_compared_on_itself() -> None:
    y, other = bent(60, 0.05), bent(40, 0.05, 1)
    metric = Joint(ProbabilityResidual())
    beside = metric.for_inputs(metric.against(y), 2)
    assert len(beside.parts) == 4
    # As the plane alone, and in any units.
    plane = Joint(ProbabilityResidual()).against(y[:, :2])
    assert beside(other) == pytest.approx(plane(other[:, :2]), rel=0.15)
    scale = np.array([1e3, 1.0, 1e-6])
    scaled = metric.for_inputs(metric.against(y * scale), 2)
    assert scaled(other * scale) == pytest.approx(beside(other), rel=1e-6)
    # Other outputs are compared as they are.
    for bend, inputs in ((0.05, 3), (0.5, 2)):
        y, other = bent(60, bend), bent(40, bend, 1)
        target = metric.against(y)
        beside = metric.for_inputs(target, inputs)
        assert len(beside.parts) == len(target.parts) == 10
        assert beside(other) == target(other)
