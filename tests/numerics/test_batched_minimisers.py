"""BFGS and the simplex on many rows in step."""

from typing import Any

import numpy as np
import pytest
from scipy import optimize

from prbayes._validate import Floats
from prbayes.numerics.batched_minimisers import (
    _best_first,
    _bfgs,
    _step,
    descend,
    descend_by_simplex,
)

CENTERS = np.random.default_rng(1).normal(size=(20, 3))


def gap(x: Floats, rows: Any) -> Floats:
    return np.asarray(x - CENTERS[rows][:, None, : x.shape[-1]])


def parabola(x: Floats, rows: Any) -> Floats:
    return np.asarray((gap(x, rows) ** 2 * [1.0, 3.0, 0.5][: x.shape[-1]]).sum(axis=-1))


def edges(x: Floats, rows: Any) -> Floats:
    return np.abs(gap(x, rows)).sum(axis=-1)


def test_quadratics_with_their_own_hessians() -> None:
    roots = np.random.default_rng(1).normal(size=(20, 3, 3))
    curvatures = roots @ roots.transpose(0, 2, 1) + 0.3 * np.eye(3)

    def value(x: Floats, rows: Any) -> Floats:
        away = gap(x, rows)
        return np.einsum("bsi,bij,bsj->bs", away, curvatures[rows], away) + rows[:, None]

    x, values, converged = descend(
        value, np.zeros((20, 3)), np.eye(3), step=1e-3, tolerance=1e-10, is_central=True
    )
    assert converged.all()
    # A predicted gain below 2 tol leaves |x - c|^2 < tol / curvature, at least 0.3, by a Hessian
    # that is not quite learned.
    np.testing.assert_allclose(x, CENTERS, atol=1e-3)
    np.testing.assert_allclose(values, np.arange(20), atol=1e-6)


def test_a_curved_valley_and_a_wall() -> None:
    """Rosenbrock's function, infinite on one side: steps are shortened along the valley."""

    def value(x: Floats, rows: Any) -> Floats:
        f = 5 * (x[..., 1] - x[..., 0] ** 2) ** 2 + (1 - x[..., 0]) ** 2
        return np.where(x[..., 0] > 1.5, np.inf, f)

    starts = np.array([[-1.2, 1.0], [1.4, -1.0], [0.0, 0.0], [2.0, 2.0]])
    x, values, converged = descend(
        value, starts, np.eye(2), step=1e-4, tolerance=1e-9, max_iterations=200, is_central=True
    )
    np.testing.assert_allclose(x[:3], 1.0, atol=1e-3)
    # A row that starts where the function is infinite stays there, and has not converged.
    assert converged.tolist() == [True, True, True, False]
    assert np.isinf(values[3])
    np.testing.assert_array_equal(x[3], starts[3])


def test_too_few_iterations_are_not_convergence() -> None:
    start, hessian = np.full((2, 1), 50.0), np.eye(1)
    minima = descend(parabola, start, hessian, step=1e-3, tolerance=1e-9, max_iterations=2)
    assert not minima.converged.any()


def test_inverse_hessians_satisfy_the_secant_equation_or_stay() -> None:
    rng = np.random.default_rng(2)
    inverse = np.repeat(np.diag([1.0, 2.0])[None], 5, axis=0)
    s, y = rng.normal(size=(5, 2)), rng.normal(size=(5, 2))
    y *= np.sign((s * y).sum(-1, keepdims=True))
    y[4] *= -1  # negative curvature
    new = _bfgs(inverse, s, y, is_first=False)
    np.testing.assert_allclose(np.einsum("bij,bj->bi", new, y)[:4], s[:4], atol=1e-12)
    np.testing.assert_array_equal(new[4], inverse[4])
    assert (np.linalg.eigvalsh(new) > 0).all()


def test_a_first_guess_of_the_wrong_size_costs_few_steps() -> None:
    shape = np.array([[2.0, 0.6, 0.0], [0.6, 1.0, 0.2], [0.0, 0.2, 0.5]])
    deviations = np.random.default_rng(1).uniform(-0.2, 0.4, (8, 3))
    sizes = np.geomspace(0.1, 10.0, 8)
    curvatures = sizes[:, None, None] * (shape + np.eye(3) * deviations[:, None])
    evaluations = []

    def value(x: Floats, rows: Any) -> Floats:
        evaluations.append(len(rows))
        return np.asarray(
            np.einsum("bsi,bij,bsj->bs", gap(x, rows), curvatures[rows], gap(x, rows)) / 2
        )

    x, _, converged = descend(value, np.zeros((8, 3)), shape, step=1e-4, tolerance=1e-9)
    assert converged.all()
    np.testing.assert_allclose(x, CENTERS[:8], atol=1e-3)
    # The first step shows the size; otherwise it takes half as many steps again.
    assert sum(evaluations) <= 8 * 8


def test_a_kink_is_the_end_of_a_line_search() -> None:
    minima = descend(edges, np.zeros((3, 1)), np.eye(1), step=1e-3, tolerance=1e-9)
    assert minima.converged.all()
    np.testing.assert_allclose(minima.x, CENTERS[:3, :1], atol=0.02)


@pytest.mark.parametrize("correlation", [0.0, 0.95])
@pytest.mark.parametrize("stiffer", [1.0, 1.5])
def test_one_sided_differences_arrive_within_a_fraction_of_a_step(
    correlation: float, stiffer: float
) -> None:
    curvature = np.linalg.inv([[1.0, correlation], [correlation, 1.0]])
    step = 0.02

    def value(x: Floats, rows: Any) -> Floats:
        assert x.shape[1] == 3  # the point, and one step along each axis
        away = gap(x, rows)
        return stiffer * np.einsum("...i,ij,...j->...", away, curvature, away) / 2

    x, _, converged = descend(value, np.zeros((2, 2)), curvature, step=step, tolerance=1e-9)
    assert converged.all()
    # Half a step, times the relative deviation from the typical curvature: along coordinates that
    # are correlated it was twenty times that much.
    expected = step / 2 * abs(1 / stiffer - 1) * np.sqrt(2) + 1e-3
    assert np.abs(x - CENTERS[:2, :2]).max() < expected


@pytest.mark.parametrize("r", [1, 2, 3])
@pytest.mark.parametrize("value", [parabola, edges, lambda *x: np.abs(gap(*x)).max(axis=-1)])
def test_every_simplex_finds_the_minimum_of_its_row(value: Any, r: int) -> None:
    x, values, converged = descend_by_simplex(value, np.zeros((20, r)), sizes=(1.0, -0.5))
    assert converged.all()
    # A hundredth of the mean gain is the range over the last simplex, without its middle.
    gain = value(np.zeros((20, 1, r)), np.arange(20)).mean()
    assert values.max() < 0.06 * gain
    np.testing.assert_array_equal(values, value(x[:, None], np.arange(20))[:, 0])
    if value is parabola:
        alone = optimize.minimize(
            lambda t: parabola(t[None, None], np.array([4]))[0, 0],
            np.zeros(r),
            method="Nelder-Mead",
        )
        np.testing.assert_allclose(x[4], alone.x, atol=0.2)


def test_simplices_on_flat_and_infinite_functions() -> None:
    x, values, _ = descend_by_simplex(
        lambda x, rows: np.zeros(x.shape[:2]), np.ones((3, 2)), sizes=[1.0]
    )
    np.testing.assert_array_equal(values, 0)
    np.testing.assert_array_equal(x, 1)

    def half(x: Floats, rows: Any) -> Floats:
        return np.where(x[..., 0] < 0.1, np.inf, x[..., 0] ** 2)

    x, values, _ = descend_by_simplex(half, np.full((2, 1), 2.0), sizes=[-1.0])
    assert ((x >= 0.1) & (x < 0.3)).all()


def test_a_simplex_without_parameters() -> None:
    x, _, converged = descend_by_simplex(parabola, np.empty((3, 0)), sizes=(1.0,))
    assert x.shape == (3, 0)
    assert converged.all()


@pytest.mark.parametrize("r", [2, 3])
def test_steps_are_those_of_scipys_adaptive_simplex(r: int) -> None:
    def value(x: Floats, rows: Any) -> Floats:
        # Curved valleys, in other places by row: all kinds of steps, and shrinking.
        away = gap(x, rows)
        bend = (away[..., 1:] - away[..., :-1] ** 2) ** 2
        return np.asarray(5 * bend.sum(axis=-1) + ((away + 0.3) ** 2).sum(axis=-1))

    rows = np.arange(len(CENTERS))
    simplices = np.tile(np.vstack([np.zeros(r), 2.0 * np.eye(r)]), (len(rows), 1, 1))
    points, values = _best_first(simplices, value(simplices, rows))
    for _ in range(40):
        points, values = _step(value, points, values, rows)
    for row in rows:
        alone = optimize.minimize(
            lambda t, row=row: value(t[None, None], np.array([row]))[0, 0],
            np.zeros(r),
            method="Nelder-Mead",
            options={
                "adaptive": True, "initial_simplex": simplices[row], "maxiter": 41, "xatol": 0.0,
                "fatol": 0.0,
            },
        )  # fmt: skip
        np.testing.assert_allclose(points[row], alone.final_simplex[0], atol=1e-8)
        np.testing.assert_allclose(values[row], alone.final_simplex[1], atol=1e-10)
