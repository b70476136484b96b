"""Directions are unit vectors far from each other, the same on every machine."""

from __future__ import annotations

import numpy as np
import pytest

from prbayes._validate import Floats
from prbayes.metrics.multivariate import directions, repelled, sufficient_directions


def largest_cosine(u: Floats) -> float:
    cosine = np.abs(u @ u.T)
    np.fill_diagonal(cosine, 0.0)
    return float(cosine.max())


def test_two_outputs_have_equal_angles() -> None:
    u = directions(2, 5, 0)
    angles = np.sort(np.arctan2(u[:, 1], u[:, 0]) % np.pi)
    np.testing.assert_allclose(np.diff(angles), np.pi / 5)
    np.testing.assert_array_equal(u, directions(2, 5, 7))


# The best arrangements of lines: of an icosahedron, of the 24-cell, and of the roots of E6.
@pytest.mark.parametrize(("m", "number", "best"), [(3, 6, 5**-0.5), (4, 12, 0.5), (6, 36, 0.5)])
def test_known_best_arrangements_are_found(m: int, number: int, best: float) -> None:
    assert largest_cosine(directions(m, number, 0)) == pytest.approx(best, abs=2e-3)


@pytest.mark.parametrize("m", [3, 4, 5, 8])
def test_they_are_of_unit_length_and_see_every_direction_alike(m: int) -> None:
    u = directions(m, sufficient_directions(m), 0)
    assert u.shape == ((m - 1) * (m + 2), m)
    np.testing.assert_allclose(np.linalg.norm(u, axis=-1), 1, rtol=1e-15)
    np.testing.assert_allclose(u.T @ u * m / len(u), np.eye(m), atol=0.03)
    # All symmetric matrices differ on them: each covariance is told from every other.
    i, j = np.tril_indices(m)
    assert np.linalg.matrix_rank(u[:, i] * u[:, j], tol=0.3) == i.size


def test_rounding_does_not_decide_where_they_are() -> None:
    for m, number in ((3, 100), (4, 18), (4, 40), (8, 70)):
        start = np.random.default_rng(0).standard_normal((number, m))
        noise = np.random.default_rng(1).standard_normal((number, m))
        np.testing.assert_allclose(
            repelled(start, 400), repelled(start * (1 + 1e-14 * noise), 400), atol=1e-9
        )


def test_more_steps_change_little() -> None:
    for m, number in ((3, 10), (4, 18), (6, 40)):
        start = np.random.default_rng(0).standard_normal((number, m))
        assert abs(largest_cosine(repelled(start)) - largest_cosine(repelled(start, 4000))) < 0.03


def test_a_seed_is_another_arrangement() -> None:
    assert not np.allclose(directions(3, 10, 0), directions(3, 10, 1))
    np.testing.assert_array_equal(directions(3, 1, 0).shape, (1, 3))
