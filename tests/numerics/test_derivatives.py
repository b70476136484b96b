"""Differences against derivatives in closed form, and at the edge of a support."""

import numpy as np
import pytest

from prbayes._validate import Floats
from prbayes.numerics.derivatives import cross, differences, second_differences, slopes

STEP = np.array([1e-4, 3e-4])


def cubic(thetas: Floats) -> Floats:
    return thetas[:, 0] ** 3 - 2 * thetas[:, 0] * thetas[:, 1]


def test_a_cross_is_theta_then_all_up_then_all_down() -> None:
    points = cross(np.array([1.0, 2.0]), np.array([0.5, 0.25]))
    np.testing.assert_array_equal(points, [[1, 2], [1.5, 2], [1, 2.25], [0.5, 2], [1, 1.75]])


def test_first_differences() -> None:
    theta = np.array([2.0, 0.5])
    value, gradient, evaluations = differences(cubic, STEP)(theta)
    assert (value, evaluations) == (6.0, 5)
    np.testing.assert_allclose(gradient, [11.0, -4.0], rtol=1e-7)
    # Slopes of arrays have the derivative last.
    values = cubic(cross(theta, STEP))
    found = slopes(np.stack([values, -values], axis=-1), STEP)
    np.testing.assert_allclose(found, [[11.0, -4.0], [-11.0, 4.0]], rtol=1e-7)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_differences_at_an_edge_are_one_sided(side: float) -> None:
    def values(thetas: Floats) -> Floats:
        inside = side * thetas[:, 0] <= 1.0
        return np.where(inside, thetas[:, 0] ** 2 + thetas[:, 1], np.inf)

    _, gradient, _ = differences(values, np.array([1e-4, 1e-4]))(np.array([side, 3.0]))
    np.testing.assert_allclose(gradient, [2.0 * side, 1.0], rtol=1e-3)


def test_second_differences_of_a_parabola() -> None:
    exact = np.array([[3.0, 1.0, 0.5], [1.0, -2.0, 0.0], [0.5, 0.0, 1.0]])
    found = second_differences(
        lambda x: 0.5 * np.einsum("bsi,ij,bsj->s", x, exact, x) + x.sum(axis=(0, 2)), 3
    )
    np.testing.assert_allclose(found, exact, atol=1e-12)
