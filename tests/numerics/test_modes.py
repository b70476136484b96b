"""Laplace approximations of known densities, and starts that are far apart."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from prbayes._validate import Floats, Indices
from prbayes.numerics.modes import (
    Laplace,
    distinct_modes,
    far_apart,
    laplace,
    modes_each,
    rows_by_mode,
)

MEAN = np.array([1.0, -2.0, 0.5])
COVARIANCE = np.array([[1.0, 0.6, 0.0], [0.6, 0.5, -0.1], [0.0, -0.1, 0.3]])
SCALE = np.array([3.0, 5.0, 2.0])
NORMAL = multivariate_normal(MEAN, COVARIANCE)


def normal(thetas: Floats) -> Floats:
    return np.asarray(7.0 + NORMAL.logpdf(thetas))


def test_laplace_is_exact_for_a_normal_density() -> None:
    (mode,) = laplace(normal, MEAN[None] + [2.0, 1.0, -1.0], SCALE)
    np.testing.assert_allclose(mode.mode, MEAN, atol=1e-3)
    np.testing.assert_allclose(mode.covariance, COVARIANCE, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(mode.log_mass, 7.0, atol=1e-3)


def test_a_direction_without_curvature_has_ten_times_the_scale() -> None:
    (mode,) = laplace(lambda t: -0.5 * t[:, 0] ** 2, np.zeros((1, 2)), np.array([1.0, 2.0]))
    np.testing.assert_allclose(np.sqrt(np.diag(mode.covariance)), [1.0, 20.0], rtol=1e-3)


def test_laplace_refuses_the_end_of_a_support() -> None:
    with pytest.raises(ValueError, match="not finite"):
        laplace(
            lambda t: np.where(t[:, 0] > 0, -t[:, 0], -np.inf), np.full((1, 1), 1e-3), np.ones(1)
        )


def test_starts_are_far_apart_in_their_unit() -> None:
    candidates = np.array([[0.0, 0.0], [0.0, 9.0], [1.0, 0.0], [2.0, 0.0]])
    starts = far_apart(candidates, 2, np.array([1.0, 10.0]))
    assert starts.tolist() == [[0.0, 0.0], [2.0, 0.0]]
    assert len(far_apart(candidates, 9, np.ones(2))) == 4


def test_modes_half_a_standard_deviation_apart_are_distinct() -> None:
    """The one with the larger mass remains; one that has not converged is the last."""
    modes = [
        Laplace(np.array([place]), np.eye(1), log_mass, converged)
        for place, log_mass, converged in [(0.0, 1.0, True), (0.4, 2.0, True), (3.0, 3.0, False)]
    ]
    assert [mode.log_mass for mode in distinct_modes(modes)] == [2.0, 3.0]


@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_draws_of_one_mode_stay_together(shift: float) -> None:
    """Of normal, heavy-tailed, skewed and bent densities, and of normals a deviation apart."""
    rng = np.random.default_rng(0)
    x = rng.standard_normal((2000, 4))
    x[:, 1] = rng.standard_t(3, 2000)
    x[:, 2] = np.exp(x[:, 2])
    x[:, 3] = 0.3 * x[:, 3] + x[:, 0] ** 2
    x[:700] += shift
    (rows,) = rows_by_mode(x)
    np.testing.assert_array_equal(rows, np.arange(2000))


def test_draws_are_split_into_their_modes() -> None:
    """Three modes that only an oblique direction separates, with their masses."""
    rng = np.random.default_rng(1)
    place = rng.choice(3, 2000, p=[0.1, 0.3, 0.6])
    x = rng.standard_normal((2000, 2)) * [3.0, 0.5] + np.array([0.0, 5.0])[None] * place[:, None]
    turned = x @ np.array([[1.0, -1.0], [1.0, 1.0]])
    modes = rows_by_mode(turned)
    assert len(modes) == 3
    assert sorted(np.concatenate(modes).tolist()) == list(range(2000))
    for rows in modes:
        # A normal exceeds the middle, five standard deviations away, in no draw.
        assert len(np.unique(place[rows])) == 1


def test_several_densities_have_the_modes_that_they_have_alone() -> None:
    """Although one of them takes more steps, and another has two modes."""

    def log_density(points: Floats, numbers: Indices) -> Floats:
        x = points[..., 0] - numbers[:, None]
        return np.asarray(np.where(numbers[:, None] == 1, -((x**2 - 4) ** 2) / 8, -(x**4) / 4 - x))

    starts = [np.array([[-1.0], [4.0]]), np.array([[-3.0], [2.0], [5.0]]), np.array([[9.0], [8.0]])]
    together = modes_each(log_density, starts, np.ones(1))
    for number, of_density in enumerate(together):
        alone = modes_each(
            lambda points, _, number=number: log_density(points, np.full(len(points), number)),
            [starts[number]],
            np.ones(1),
        )[0]
        assert len(of_density) == (2 if number == 1 else 1)
        for first, second in zip(of_density, alone, strict=True):
            np.testing.assert_allclose(first.mode, second.mode, rtol=1e-12)
            np.testing.assert_allclose(first.covariance, second.covariance, rtol=1e-9)
