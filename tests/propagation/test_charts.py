"""Charts of fibres: Newton solves, coordinates, cover, density of the mixture."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.special import ndtri

from prbayes.numerics.points import sobol
from prbayes.propagation.charts import (
    Charts,
    Fibres,
    ReferencePopulation,
    charts_at_modes,
    cover,
    solve_each,
)

Array = np.ndarray[Any, np.dtype[np.float64]]
STANDARD = ReferencePopulation(np.zeros(2), np.eye(2))


def circle(x: Array) -> tuple[Array, Array]:
    return (x**2).sum(axis=1, keepdims=True), 2 * x[:, None, :]


def parabola(x: Array) -> tuple[Array, Array]:
    """Return y = x2 + x1^2 / 2, whose fibres are graphs over x1."""
    return x[:, 1:] + x[:, :1] ** 2 / 2, np.stack([x[:, 0], np.ones(len(x))], axis=1)[:, None, :]


def two_sheets(x: Array) -> tuple[Array, Array]:
    return x[:, :1] ** 2, np.stack([2 * x[:, 0], np.zeros(len(x))], axis=1)[:, None, :]


def unscaled(response: Any, y: Array) -> Fibres:
    return Fibres(response, STANDARD, np.ones(1), y)


def test_steps_of_least_norm_end_at_the_nearest_point_of_a_linear_fibre() -> None:
    a = np.array([[3.0, 4.0]])
    fibres = unscaled(lambda x: (x @ a.T, np.broadcast_to(a, (len(x), 1, 2))), np.array([[10.0]]))
    z, jacobian, converged = fibres.solve(
        np.zeros(2, dtype=int), np.array([[0.0, 0.0], [4.0, -3.0]])
    )
    np.testing.assert_allclose(z, [[1.2, 1.6], [5.2, -1.4]])
    np.testing.assert_array_equal(jacobian, [a, a])
    assert converged.all()


def test_solves_fail_at_a_singular_jacobian_and_where_the_response_has_no_value() -> None:
    def response(x: Array) -> tuple[Array, Array]:
        values, jacobian = circle(x)
        return np.where(x[:, :1] < -1, np.nan, values), jacobian

    start = np.array([[0.0, 0.0], [-2.0, 0.0], [1.5, 0.0], [0.9, 0.1]])
    z, _, converged = unscaled(response, np.array([[1.0]])).solve(np.zeros(4, dtype=int), start)
    np.testing.assert_array_equal(converged, [False, False, True, True])
    np.testing.assert_allclose((z[2:] ** 2).sum(axis=1), 1)


def test_a_chart_maps_free_coordinates_to_the_fibre_and_back() -> None:
    fibres = unscaled(parabola, np.array([[0.5], [-1.0]]))
    charts = charts_at_modes(fibres, 8, 4)
    i, slot = np.array([0, 1, 1]), np.zeros(3, dtype=int)
    u = np.array([[0.3], [-0.2], [0.8]])
    z, jacobian, converged = charts.points(fibres, i, slot, u)
    assert converged.all()
    np.testing.assert_allclose(parabola(z)[0], fibres.y[i])
    np.testing.assert_allclose(jacobian[:, 0, 0], z[:, 0])
    np.testing.assert_allclose(charts.coordinates(i, slot, z), u)
    assert charts.reach(fibres, i, slot, z, jacobian).all()
    beside = z + np.array([0.0, 0.1])
    assert not charts.reach(fibres, i, slot, beside, parabola(beside)[1]).any()
    axes = np.concatenate([charts.solved, charts.free], axis=3)[:, 0]
    np.testing.assert_allclose(axes.transpose(0, 2, 1) @ axes, [np.eye(2)] * 2, atol=1e-12)


def test_charts_stand_at_all_modes() -> None:
    charts = charts_at_modes(unscaled(two_sheets, np.array([[1.0], [4.0], [-1.0]])), 8, 4)
    np.testing.assert_allclose(charts.share, [[0.5, 0.5, 0, 0], [0.5, 0.5, 0, 0], [0, 0, 0, 0]])
    np.testing.assert_allclose(np.sort(charts.centre[:2, :2, 0]), [[-1, 1], [-2, 2]])
    np.testing.assert_allclose(charts.centre[:2, :2, 1], 0, atol=0.01)


def test_the_laplace_approximation_is_that_of_a_parabola() -> None:
    # log p(u) = -(u^2 + (y - u^2 / 2)^2) / 2 at u = 0, where the curvature is 1 - y.
    y = np.array([0.3, -0.5, -9.0])
    charts = charts_at_modes(unscaled(parabola, y[:, None]), 1, 1)
    variance = np.clip(1 / (1 - y), 0.3, 1.5)
    np.testing.assert_allclose(
        charts.scale[:, 0, 0, 0] ** 2, Charts.inflation * variance, rtol=1e-3
    )
    np.testing.assert_allclose(charts.location[:, 0], 0, atol=1e-3)


def test_the_location_follows_the_slope_of_the_density() -> None:
    def response(x: Array) -> tuple[Array, Array]:
        growth = np.exp(0.3 * x[:, 1:])
        values = (x[:, :1] + 3) * growth
        return values, np.concatenate([growth, 0.3 * values], axis=1)[:, None, :]

    fibres = unscaled(response, np.array([[2.5], [4.0]]))
    charts = charts_at_modes(fibres, 1, 1)
    i, slot, step = np.arange(2), np.zeros(2, dtype=int), 1e-4
    log_density = []
    for u in (-step, step):
        z, jacobian, _ = charts.points(fibres, i, slot, np.full((2, 1), u))
        determinant = np.linalg.det(jacobian @ charts.solved[:, 0])
        log_density.append(-(z**2).sum(axis=1) / 2 - np.log(np.abs(determinant)))
    slope = (log_density[1] - log_density[0]) / (2 * step)
    assert (np.abs(slope) > 0.05).all()
    variance = charts.scale[:, 0, 0, 0] ** 2 / Charts.inflation
    np.testing.assert_allclose(charts.location[:, 0, 0], variance * slope, rtol=1e-4)


def test_cover_adds_charts_where_points_of_the_fibre_have_none() -> None:
    y = np.array([[1.0], [4.0]])
    fibres = unscaled(circle, y)
    charts = charts_at_modes(fibres, 2, 8)
    normal = ndtri(sobol(128, 2, 0)).reshape(2, 64, 2)
    more = cover(fibres, charts, normal)
    assert ((more.share > 0).sum(axis=1) > (charts.share > 0).sum(axis=1)).all()
    np.testing.assert_allclose(more.share.sum(axis=1), 1)
    # Angles of the circle are within arccos(.3) of some chart's centre.
    angle = np.linspace(0, 2 * np.pi, 100)
    points = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    for i in range(2):
        centres = more.centre[i, more.share[i] > 0]
        assert (points @ centres.T / np.sqrt(y[i]) > 0.3).any(axis=1).all()
    # Nothing is added to fibres that are covered.
    linear = unscaled(parabola, y)
    charts = charts_at_modes(linear, 8, 8)
    np.testing.assert_array_equal(cover(linear, charts, normal * 0.5).share, charts.share)


@pytest.mark.parametrize("m", [1, 2, 3])
def test_singular_systems_have_no_solution(m: int) -> None:
    rng = np.random.default_rng(m)
    matrices = rng.standard_normal((5, m, m))
    matrices[1], matrices[3] = 0, np.nan
    right = rng.standard_normal((5, m))
    solution = solve_each(matrices, right)
    good = [0, 2, 4]
    assert not np.isfinite(solution[[1, 3]]).any()
    np.testing.assert_allclose((matrices[good] @ solution[good, :, None])[..., 0], right[good])
