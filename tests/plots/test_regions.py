"""Regions of weighted points hold what they say, along any direction."""

import numpy as np
import pytest

from prbayes.plots._regions import White, outlines

RNG = np.random.default_rng(1)
NORMAL = RNG.standard_normal((4000, 2))


@pytest.mark.parametrize("correlation", [0.0, 0.9, -0.999])
def test_regions_do_not_depend_on_units_and_correlation(correlation: float) -> None:
    root = np.linalg.cholesky([[1.0, correlation], [correlation, 1.0]])
    turned = NORMAL @ root.T * [1e3, 1e-3] + [5.0, 7.0]
    for share, line in zip((0.5, 0.89), outlines(turned, np.ones(4000), (0.5, 0.89)), strict=True):
        at = np.linalg.solve(root, ((line.T - [5.0, 7.0]) / [1e3, 1e-3]).T)
        squares = np.nansum(at**2, axis=0)[np.isfinite(at[0])]
        assert squares.mean() == pytest.approx(-2 * np.log(1 - share), rel=0.06)


def test_weights_count_as_so_many_points() -> None:
    centers = NORMAL / 10 + np.where(np.arange(4000) % 2, 3.0, -3.0)[:, None] * [1.0, 0.0]
    weights = np.where(np.arange(4000) % 2, 0.9, 0.1)
    (line,) = outlines(centers, weights, (0.5,))
    assert np.nanmin(line[0]) > 2


def test_two_clusters_have_two_lines() -> None:
    centers = NORMAL / 10 + np.where(np.arange(4000) % 2, 3.0, -3.0)[:, None] * [1.0, 0.0]
    (line,) = outlines(centers, np.ones(4000), (0.89,))
    assert np.isnan(line[0]).sum() == 1


def test_points_on_a_line_have_a_thin_region() -> None:
    x = NORMAL[:, 0]
    (line,) = outlines(np.column_stack([x, 2 * x]), np.ones(4000), (0.5,))
    assert np.nanmax(np.abs(line[1] - 2 * line[0])) < 0.02
    (dot,) = outlines(np.ones((10, 2)), np.ones(10), (0.5,))
    assert np.nanmax(np.abs(dot - 1)) < 0.01


def test_coordinates_are_white() -> None:
    weights = np.linspace(1, 2, 4000) / np.linspace(1, 2, 4000).sum()
    points = NORMAL @ [[2.0, 1.0], [0.0, 0.5]]
    white = White.of(points, weights)
    inside = white.of_points(points)
    np.testing.assert_allclose(inside.T @ (weights[:, None] * inside), np.eye(2), atol=0.05)
    np.testing.assert_allclose(white.points(inside), points)


def test_a_far_tail_does_not_widen_a_region() -> None:
    far = NORMAL.copy()
    far[:20] *= 1e6
    for share, line in zip((0.5, 0.89), outlines(far, np.ones(4000), (0.5, 0.89)), strict=True):
        squares = np.nansum(line**2, axis=0)[np.isfinite(line[0])]
        assert squares.mean() == pytest.approx(-2 * np.log(1 - share), rel=0.1)
