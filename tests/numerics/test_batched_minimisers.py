"""BFGS and the simplex on many rows in step."""

from typing import Any

import numpy as np
import pytest
from scipy import optimize

from prbayes._validate import Floats
from prbayes.numerics.batched_minimisers import _updated, descend, descend_by_simplex


def test_quadratics_with_their_own_data() -> None:
    rng = np.random.default_rng(1)
    centers = rng.normal(size=(30, 3))
    roots = rng.normal(size=(30, 3, 3))
    curvatures = roots @ roots.transpose(0, 2, 1) + 0.3 * np.eye(3)

    def value(x: Floats, rows: Any) -> Floats:
        gap = x - centers[rows][:, None]
        return np.einsum("bsi,bij,bsj->bs", gap, curvatures[rows], gap) + rows[:, None]

    x, values, converged = descend(
        value, np.zeros((30, 3)), np.eye(3), step=1e-3, tolerance=1e-10, is_central=True
    )
    assert converged.all()
    # A promise below 2 tol leaves |x - c|^2 < tol / curvature, at least 0.3, by a Hessian that is
    # not quite learned.
    np.testing.assert_allclose(x, centers, atol=1e-3)
    np.testing.assert_allclose(values, np.arange(30), atol=1e-6)


def test_a_curved_valley_and_a_wall() -> None:
    # Rosenbrock's function, infinite on one side: steps have to be shortened, and the valley
    # followed.
    def value(x: Floats, rows: Any) -> Floats:
        f = 5 * (x[..., 1] - x[..., 0] ** 2) ** 2 + (1 - x[..., 0]) ** 2
        return np.where(x[..., 0] > 1.5, np.inf, f)

    starts = np.array([[-1.2, 1.0], [1.4, -1.0], [0.0, 0.0], [2.0, 2.0]])
    x, values, converged = descend(
        value, starts, np.eye(2), step=1e-4, tolerance=1e-9, max_iterations=200, is_central=True
    )
    np.testing.assert_allclose(x[:3], 1.0, atol=1e-3)
    assert converged[:3].all()
    # Where the function is infinite nothing is known, and it says so.
    assert not converged[3]
    assert np.isinf(values[3])
    np.testing.assert_array_equal(x[3], starts[3])


def test_too_few_iterations_are_not_convergence() -> None:
    _, _, converged = descend(lambda x, rows: (x**2).sum(-1), np.full((2, 1), 50.0), np.eye(1), step=1e-3,
                              tolerance=1e-9, max_iterations=2)  # fmt: skip
    assert not converged.any()


def test_inverse_hessians_satisfy_the_secant_equation_or_stay() -> None:
    rng = np.random.default_rng(2)
    inverse = np.repeat(np.diag([1.0, 2.0])[None], 5, axis=0)
    s, y = rng.normal(size=(5, 2)), rng.normal(size=(5, 2))
    y *= np.sign((s * y).sum(-1, keepdims=True))
    y[4] *= -1  # negative curvature
    new = _updated(inverse, s, y)
    np.testing.assert_allclose(np.einsum("bij,bj->bi", new, y)[:4], s[:4], atol=1e-12)
    np.testing.assert_array_equal(new[4], inverse[4])
    assert (np.linalg.eigvalsh(new) > 0).all()


def test_a_first_guess_of_the_wrong_size_costs_few_steps() -> None:
    # Eight functions of about the ellipse that was guessed, each steeper or flatter.
    shape = np.array([[2.0, 0.6, 0.0], [0.6, 1.0, 0.2], [0.0, 0.2, 0.5]])
    other = np.random.default_rng(1).uniform(-0.2, 0.4, (8, 3))
    sizes = np.geomspace(0.1, 10.0, 8)
    curvatures = np.array([z * (shape + np.diag(d)) for z, d in zip(sizes, other, strict=True)])
    at = np.array([1.0, -0.5, 0.7])
    calls = []

    def value(x: Floats, rows: Any) -> Floats:
        calls.append(len(rows))
        gap = x - at
        return np.asarray(np.einsum("bsi,bij,bsj->bs", gap, curvatures[rows], gap) / 2)

    x, _, converged = descend(value, np.zeros((8, 3)), shape, step=1e-4, tolerance=1e-9)
    assert converged.all()
    np.testing.assert_allclose(x, np.tile(at, (8, 1)), atol=1e-3)
    # The first step tells the size; without that it takes half as many steps again.
    assert sum(calls) <= 8 * 8


def test_a_kink_is_the_end_of_a_line_search() -> None:
    # |x - c| has no second derivative; the minimum is found to a few steps of the differences.
    centers = np.array([[-0.7], [0.2], [1.9]])

    def value(x: Floats, rows: Any) -> Floats:
        return np.asarray(np.abs(x - centers[rows][:, None]).sum(axis=-1))

    x, _, converged = descend(value, np.zeros((3, 1)), np.eye(1), step=1e-3, tolerance=1e-9)
    assert converged.all()
    np.testing.assert_allclose(x, centers, atol=0.02)


@pytest.mark.parametrize("correlation", [0.0, 0.95])
@pytest.mark.parametrize("stiffer", [1.0, 1.5])
def test_one_sided_differences_arrive_within_a_fraction_of_a_step(
    correlation: float, stiffer: float
) -> None:
    centers = np.array([[0.0, 1.0], [2.0, -1.5]])
    curvature = np.linalg.inv([[1.0, correlation], [correlation, 1.0]])
    points = []

    def value(x: Floats, rows: Any) -> Floats:
        points.append(x.shape[1])
        away = x - centers[rows, None]
        return stiffer * np.einsum("...i,ij,...j->...", away, curvature, away) / 2

    step = 0.02
    x, _, converged = descend(
        value,
        np.zeros((2, 2)),
        curvature,
        step=step,
        tolerance=1e-9,
    )
    assert converged.all()
    # Half a step, times by how much the typical curvature is another one: to one side along the
    # coordinates it was twenty times that much where they hang together.
    expected = step / 2 * abs(1 / stiffer - 1) * np.sqrt(2) + 1e-3
    assert np.abs(x - centers).max() < expected
    assert set(points) == {3}  # here, and one step along each axis


CENTERS = np.random.default_rng(1).normal(size=(20, 3))
SIZES = (1.0, -0.5)


def gap(x: Floats, rows: Any) -> Floats:
    return np.asarray(x - CENTERS[rows][:, None, : x.shape[-1]])


FUNCTIONS = {
    "parabola": lambda x, rows: (gap(x, rows) ** 2 * [1.0, 3.0, 0.5][: x.shape[-1]]).sum(axis=-1),
    "kink": lambda x, rows: np.abs(gap(x, rows)).max(axis=-1),
    "edges": lambda x, rows: np.abs(gap(x, rows)).sum(axis=-1),
}


@pytest.mark.parametrize("r", [1, 2, 3])
@pytest.mark.parametrize("name", list(FUNCTIONS))
def test_every_row_finds_its_own_minimum(name: str, r: int) -> None:
    value = FUNCTIONS[name]
    x, values, converged = descend_by_simplex(value, np.zeros((20, r)), sizes=SIZES)
    assert converged.all()
    # A hundredth of the mean gain is the range over the last simplex, whose middle is not looked
    # at.
    gain = value(np.zeros((20, 1, r)), np.arange(20)).mean()
    assert values.max() < 0.06 * gain
    np.testing.assert_array_equal(values, value(x[:, None], np.arange(20))[:, 0])


def test_a_row_does_not_depend_on_the_others_path() -> None:
    alone = optimize.minimize(
        lambda t: FUNCTIONS["parabola"](t[None, None], np.array([4]))[0, 0],
        np.zeros(2),
        method="Nelder-Mead",
    )
    x, _, _ = descend_by_simplex(FUNCTIONS["parabola"], np.zeros((20, 2)), sizes=SIZES)
    np.testing.assert_allclose(x[4], alone.x, atol=0.2)


def test_what_is_flat_stays_and_what_is_infinite_is_left() -> None:
    x, values, _ = descend_by_simplex(
        lambda x, rows: np.zeros(x.shape[:2]), np.ones((3, 2)), sizes=[1.0]
    )
    np.testing.assert_array_equal(values, 0)
    np.testing.assert_array_equal(x, 1)

    def half(x: Floats, rows: Any) -> Floats:
        return np.where(x[..., 0] < 0.1, np.inf, x[..., 0] ** 2)

    x, values, _ = descend_by_simplex(half, np.full((2, 1), 2.0), sizes=[-1.0])
    assert (x >= 0.1).all()
    assert (x < 0.3).all()


def test_no_parameters() -> None:
    x, values, converged = descend_by_simplex(
        lambda x, rows: np.full(x.shape[:2], 7.0), np.empty((3, 0)), sizes=SIZES
    )
    assert x.shape == (3, 0)
    np.testing.assert_array_equal(values, 7)
    assert converged.all()
