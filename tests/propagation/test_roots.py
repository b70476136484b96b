"""All roots of f(x) = y: counts and places in closed form, bounds, invariances."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from prbayes._validate import Floats
from prbayes.numerics.points import sobol
from prbayes.propagation.roots import Roots, find_roots, gabriel_neighbours, nearest_starts

BOX = np.array([[-3.0], [3.0]])
SQUARE = np.array([[-2.0, -2.0], [2.0, 2.0]])


def fold(z: Floats) -> tuple[Floats, Floats]:
    return z**2, 2 * z[:, :, None]


def frame(z: Floats) -> tuple[Floats, Floats]:
    """Two stiffnesses of a frame with two outputs that a mirror root gives back exactly."""
    k, g = np.exp(z[:, 0]), np.exp(z[:, 1])
    # Eigenvalues of [[k + g, -g], [-g, g]]
    trace, determinant = k + 2 * g, k * g
    values = np.stack([trace, determinant], axis=1)
    jacobian = np.empty((len(z), 2, 2))
    jacobian[:, 0, 0], jacobian[:, 0, 1] = k, 2 * g
    jacobian[:, 1, 0] = jacobian[:, 1, 1] = k * g
    return values, jacobian


def line(a: Floats) -> Any:
    return lambda z: (z @ a.T, np.broadcast_to(a, (len(z), *a.shape)))


def spread_starts(n: int, count: int, box: Floats) -> Floats:
    points = box[0] + (box[1] - box[0]) * sobol(count, box.shape[1], 0)
    return np.broadcast_to(points, (n, *points.shape)).copy()


def of(roots: Roots, i: int) -> Floats:
    z = roots.z[roots.specimen == i]
    return z[np.lexsort(z.T[::-1])]


def test_a_folded_response_has_both_roots() -> None:
    y = np.array([[0.25], [1.0], [4.0]])
    roots = find_roots(fold, y, np.array([0.01]), spread_starts(3, 8, BOX), BOX)
    assert np.bincount(roots.specimen).tolist() == [2, 2, 2]
    for i, root in enumerate(np.sqrt(y[:, 0])):
        assert np.allclose(of(roots, i).ravel(), [-root, root], atol=1e-5)
    assert roots.misfit.max() < 1e-6


def test_a_frame_has_its_root_and_the_mirror_root() -> None:
    truth = np.array([[0.6, 0.9], [0.2, -1.2]])
    y, _ = frame(truth)
    roots = find_roots(frame, y, 1e-3 * y.std(axis=0), spread_starts(2, 16, SQUARE), SQUARE)
    for i, (k, g) in enumerate(np.exp(truth)):
        # k' + 2 g' = k + 2 g and k' g' = k g: the other solution is (2 g, k / 2)
        exact = np.log([[k, g], [2 * g, k / 2]])
        assert np.allclose(of(roots, i), exact[np.lexsort(exact.T[::-1])], atol=1e-5)


def test_more_outputs_than_inputs_are_least_squares() -> None:
    rng = np.random.default_rng(3)
    a, y, sd = rng.normal(size=(5, 2)), rng.normal(size=(4, 5)), rng.uniform(0.5, 2, 5)
    roots = find_roots(line(a), y, sd, spread_starts(4, 6, 5 * SQUARE), 5 * SQUARE)
    assert roots.specimen.tolist() == [0, 1, 2, 3]
    for i in range(4):
        exact, *_ = np.linalg.lstsq(a / sd[:, None], y[i] / sd, rcond=None)
        assert np.allclose(roots.z[i], exact, atol=1e-6)
        residual = (y[i] - a @ exact) / sd
        assert np.allclose(roots.residual[i], residual, atol=1e-6)
        assert roots.misfit[i] == pytest.approx((residual**2).sum() / 2, abs=1e-8)
        assert np.allclose(roots.jacobian[i], -(-a / sd[:, None]))


def test_beyond_a_turning_point_the_root_is_there() -> None:
    """The response reaches 0 and no less: the nearest input is that of the turning point."""
    y, sd = np.array([[-0.1]]), np.array([0.1])
    roots = find_roots(fold, y, sd, spread_starts(1, 8, BOX), BOX)
    assert np.abs(roots.z).max() < 2e-3
    assert roots.misfit[0] == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize("y", [1e-4, 1e-3, 1e-2])
def test_roots_beside_a_fold_are_different_where_the_error_separates_them(y: float) -> None:
    starts = spread_starts(1, 16, BOX)
    fine = find_roots(fold, np.array([[y]]), np.array([1e-3 * y]), starts, BOX)
    assert np.allclose(of(fine, 0).ravel(), [-np.sqrt(y), np.sqrt(y)], rtol=1e-4)
    # The error of the comparison covers both, and the distance is below a hundredth of the box.
    coarse = find_roots(fold, np.array([[y]]), np.array([10 * y]), starts, BOX)
    if 2 * np.sqrt(y) < 0.06:
        assert len(coarse.z) == 1


def test_where_no_response_exists_no_root_is_found() -> None:
    def right(z: Floats) -> tuple[Floats, Floats]:
        values, jacobian = fold(z)
        values[z[:, 0] < 0], jacobian[z[:, 0] < 0] = np.nan, np.nan
        return values, jacobian

    starts = np.array([[[-1.0], [-2.0]], [[1.0], [-2.0]], [[1.0], [2.0]]])
    roots = find_roots(right, np.array([[1.0], [1.0], [4.0]]), np.array([0.01]), starts, BOX)
    assert roots.specimen.tolist() == [1, 2]
    assert np.allclose(roots.z.ravel(), [1, 2], atol=1e-5)


def test_roots_stay_within_the_box() -> None:
    box = np.array([[-0.5], [1.5]])
    y = np.array([[1.0], [9.0]])
    roots = find_roots(fold, y, np.array([0.1]), spread_starts(2, 8, box), box)
    assert roots.z.min() >= -0.5
    assert roots.z.max() <= 1.5
    # The second is not reached: its best is the end of the box.
    assert of(roots, 1).ravel().tolist() == [1.5]
    assert roots.misfit[-1] == pytest.approx((9 - 1.5**2) ** 2 / 0.02)


def test_poorer_roots_are_kept_within_the_gap_alone() -> None:
    def tilted(z: Floats) -> tuple[Floats, Floats]:
        """Two outputs: the second separates both roots of the first by .2."""
        values = np.stack([z[:, 0] ** 2, 0.1 * z[:, 0]], axis=1)
        return values, np.stack([2 * z, np.full_like(z, 0.1)], axis=1)

    y, starts = np.array([[1.0, 0.1]]), spread_starts(1, 16, BOX)
    # The misfit of the mirror root is .2^2 / 2 sd^2: 2 nats, and 200.
    for sd, count in ((0.1, 2), (0.01, 1)):
        roots = find_roots(tilted, y, np.array([sd, sd]), starts, BOX)
        assert len(roots.z) == count
    assert len(find_roots(tilted, y, np.array([0.1, 0.1]), starts, BOX, gap=1.0).z) == 1


def test_specimens_have_the_same_roots_alone_and_in_another_order() -> None:
    y, _ = frame(np.random.default_rng(0).uniform(-1, 1, (9, 2)))
    sd, starts = np.array([0.01, 0.01]), spread_starts(9, 12, SQUARE)
    together = find_roots(frame, y, sd, starts, SQUARE)
    backwards = find_roots(frame, y[::-1], sd, starts[::-1], SQUARE)
    for i in range(9):
        alone = find_roots(frame, y[i : i + 1], sd, starts[i : i + 1], SQUARE)
        assert np.allclose(of(alone, 0), of(together, i), atol=1e-10)
        assert np.allclose(of(backwards, 8 - i), of(together, i), atol=1e-10)


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_units_of_outputs_and_coordinates_do_not_matter(unit: float) -> None:
    y, _ = frame(np.random.default_rng(0).uniform(-1, 1, (9, 2)))
    sd, starts = np.array([0.01, 0.01]), spread_starts(9, 12, SQUARE)

    def other(z: Floats) -> tuple[Floats, Floats]:
        values, jacobian = frame(z / unit)
        return values / unit, jacobian / unit**2

    first = find_roots(frame, y, sd, starts, SQUARE)
    second = find_roots(other, y / unit, sd / unit, unit * starts, unit * SQUARE)
    assert np.array_equal(first.specimen, second.specimen)
    assert np.allclose(first.z, second.z / unit, atol=1e-6)
    assert np.allclose(first.misfit, second.misfit, atol=1e-6)


def test_a_coordinate_without_influence_stays_where_it_starts() -> None:
    def first_alone(z: Floats) -> tuple[Floats, Floats]:
        jacobian = np.zeros((len(z), 2, 2))
        jacobian[:, :, 0] = [1.0, 2.0]
        return z[:, :1] * [1.0, 2.0], jacobian

    starts = np.array([[[1.0, 0.7]]])
    roots = find_roots(first_alone, np.array([[0.5, 1.0]]), np.ones(2), starts, SQUARE)
    assert np.allclose(roots.z, [[0.5, 0.7]], atol=1e-6)


EVERYONE = ~np.eye(6, dtype=bool)
RUN_Y = np.array([[0, 0], [1, 0], [2, 0], [0, 100], [1, 100], [2, 100]], dtype=float)


@pytest.mark.parametrize(
    ("y", "spread", "expected"),
    [
        ([0.9, 0.0], [1.0, 100.0], [1, 0]),
        ([1.9, 100.0], [1.0, 100.0], [5, 4]),
        # In units of the spread: 100 in the second output is as far as 1 in the first.
        ([2.0, 60.0], [1.0, 100.0], [5, 2]),
        # Outputs without a reading do not count.
        ([1.2, 0.0], [1.0, np.inf], [1, 4]),
        ([0.0, 90.0], [np.inf, 1.0], [3, 4, 5]),  # a tie: all nearest runs
    ],
)
def test_starts_are_the_runs_with_the_nearest_outputs(y: Any, spread: Any, expected: Any) -> None:
    run_z = np.arange(6.0)[:, None]
    starts = nearest_starts(run_z, RUN_Y, np.array([y]), np.array([spread]), 2, EVERYONE)
    assert starts.ravel().tolist() == expected


def test_the_nearest_run_of_every_basin_comes_first() -> None:
    # One flat branch with many runs near the output, and one steep branch with none.
    z = np.concatenate([np.linspace(-1, -0.5, 20), [-0.25], np.linspace(0, 1, 6)])
    run_y = np.where(z < -0.25, 1 + 0.1 * z, np.abs(20 * z))
    order = np.random.default_rng(0).permutation(len(z))
    z, run_y = z[order, None], run_y[order, None]
    neighbours = gabriel_neighbours(z)
    starts = nearest_starts(z, run_y, np.array([[0.93]]), np.ones(1), 2, neighbours)
    assert np.abs(starts.ravel() - [-0.7, 0.0]).max() < 0.03
    # All of them, even if one start is asked for.
    again = nearest_starts(z, run_y, np.array([[0.93]]), np.ones(1), 1, neighbours)
    assert np.array_equal(again, starts)


def test_neighbours_in_a_plane_have_an_empty_circle_between_them() -> None:
    z = np.random.default_rng(1).normal(size=(30, 2))
    middle = (z[:, None] + z) / 2
    radius = np.linalg.norm(z[:, None] - z, axis=2) / 2
    inside = np.linalg.norm(middle[:, :, None] - z, axis=3) < radius[..., None] - 1e-9
    expected = ~inside.any(axis=2) & ~np.eye(30, dtype=bool)
    assert np.array_equal(gabriel_neighbours(z), expected)
