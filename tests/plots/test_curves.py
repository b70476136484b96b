"""Densities, distributions and regions against closed forms."""

import numpy as np
import pytest
from scipy import stats

from prbayes.plots import curves
from prbayes.plots.curves import outlines

QUANTILES = stats.norm.ppf((np.arange(1000) + 0.5) / 1000)
EQUAL = np.full(1000, 1e-3)
GRID = np.linspace(-5, 9, 301)


def test_a_weighted_density_is_that_of_the_target() -> None:
    """N(0, 2) weighted by N(1, 1) over N(0, 2): smoothed, the density of N(1, sqrt(1 + h^2))."""
    x = 2 * QUANTILES
    w = stats.norm.pdf(x, 1, 1) / stats.norm.pdf(x, 0, 2)
    w /= w.sum()
    density = curves.densities(x, w, GRID, 0.3)
    np.testing.assert_allclose(density, stats.norm.pdf(GRID, 1, np.hypot(1, 0.3)), atol=2e-3)
    assert np.trapezoid(density, GRID) == pytest.approx(1, abs=1e-3)
    rows = np.stack([QUANTILES, QUANTILES[::-1] + 0.7])
    both = curves.densities(rows, np.stack([EQUAL, EQUAL]), GRID, 0.1)
    expected = stats.norm.pdf(GRID, [[0], [0.7]], np.hypot(1, 0.1))
    np.testing.assert_allclose(both, expected, atol=4e-3)


def test_the_area_is_the_share_of_finite_values() -> None:
    x = QUANTILES.copy()
    x[:100], x[-50:] = np.inf, np.nan
    area = np.trapezoid(curves.densities(x, EQUAL, GRID, 0.2), GRID)
    assert area == pytest.approx(0.85, abs=2e-3)


@pytest.mark.parametrize(("step", "n"), [(1, 1000), (2, 500)])
def test_the_bandwidth_is_silvermans_of_the_effective_number(step: int, n: int) -> None:
    """One bandwidth, the median, smooths all populations of a picture."""
    weights = np.where(np.arange(1000) % step, 0.0, step * 1e-3)
    rows = np.stack([QUANTILES, 3 * QUANTILES, 3 * QUANTILES])
    rows = np.column_stack([rows, np.full((3, 2), [np.inf, np.nan])])
    weights = np.append(weights, [0.0, 0.0])
    density, *_ = curves.smooth_densities(rows, np.stack([weights] * 3), GRID)
    h = 3 * 0.9 * n**-0.2
    np.testing.assert_allclose(density, stats.norm.pdf(GRID, 0, np.hypot(1, h)), atol=6e-3)


def test_a_density_does_not_dip_at_a_bound() -> None:
    density = curves.bounded_density(np.abs(QUANTILES), np.array([-0.1, 0.01, 0.5, 1.0]))
    expected = [0, *(2 * stats.norm.pdf([0.01, 0.5, 1.0]))]
    np.testing.assert_allclose(density, expected, atol=0.03)
    assert np.isnan(curves.bounded_density(np.ones(10), GRID)).all()


def test_bands_and_ranges_are_quantiles() -> None:
    rows = np.arange(101.0)[:, None] * np.array([1.0, -2.0])
    np.testing.assert_allclose(curves.pointwise_band(rows, 0.9), [[5, -190], [95, -10]])
    rows = np.stack([QUANTILES + k for k in range(11)])
    ends = curves.central_range(rows, np.full(rows.shape, 1e-3), 0.05)
    np.testing.assert_allclose(ends, [1 - 1.645, 9 + 1.645], atol=0.02)


def test_the_density_of_measured_values_has_the_area_of_finite_ones() -> None:
    grid = np.linspace(-3, 4, 2001)
    weights = np.full(6, 1 / 6)
    y = curves.measured_density(np.array([0.0, 0.1, 0.2, 0.9, 1.0, np.inf]), weights, grid)
    assert np.trapezoid(y, grid) == pytest.approx(5 / 6, abs=1e-3)
    y = curves.measured_density(np.array([-1.0, 1.0]), np.full(2, 0.5), grid)
    h = 1.06 * 2**-0.2
    expected = 0.5 * (stats.norm.pdf(grid, -1, h) + stats.norm.pdf(grid, 1, h))
    np.testing.assert_allclose(y, expected, atol=2e-3)


def test_the_staircase_goes_up_by_the_weight_at_each_value() -> None:
    x, y = curves.staircase(np.array([2.0, 1.0, np.inf]), np.array([0.5, 0.2, 0.3]), 0.0, 4.0)
    np.testing.assert_allclose(x, [0, 1, 1, 2, 2, 4])
    np.testing.assert_allclose(y, [0, 0, 0.2, 0.2, 0.7, 0.7])


# -- regions ---------------------------------------------------------------------------------


NORMAL = np.random.default_rng(1).standard_normal((4000, 2))
CLUSTERS = NORMAL / 10 + np.where(np.arange(4000) % 2, 3.0, -3.0)[:, None] * [1.0, 0.0]


@pytest.mark.parametrize("correlation", [0.0, 0.9, -0.999])
def test_regions_do_not_depend_on_units_and_correlation(correlation: float) -> None:
    root = np.linalg.cholesky([[1.0, correlation], [correlation, 1.0]])
    turned = NORMAL @ root.T * [1e3, 1e-3] + [5.0, 7.0]
    lines = outlines(turned, np.ones(4000), (0.5, 0.89))
    for share, line in zip((0.5, 0.89), lines, strict=True):
        places = np.linalg.solve(root, ((line.T - [5.0, 7.0]) / [1e3, 1e-3]).T)
        squares = np.nansum(places**2, axis=0)[np.isfinite(places[0])]
        assert squares.mean() == pytest.approx(-2 * np.log(1 - share), rel=0.06)


def test_clusters_have_lines_of_their_own_and_count_by_weight() -> None:
    (line,) = outlines(CLUSTERS, np.ones(4000), (0.89,))
    assert np.isnan(line[0]).sum() == 1
    (line,) = outlines(CLUSTERS, np.where(np.arange(4000) % 2, 0.9, 0.1), (0.5,))
    assert np.nanmin(line[0]) > 2


def test_a_far_tail_does_not_widen_a_region_and_points_on_a_line_have_a_thin_one() -> None:
    far = NORMAL.copy()
    far[:20] *= 1e6
    (line,) = outlines(far, np.ones(4000), (0.89,))
    squares = np.nansum(line**2, axis=0)[np.isfinite(line[0])]
    assert squares.mean() == pytest.approx(-2 * np.log(0.11), rel=0.1)
    x = NORMAL[:, 0]
    (line,) = outlines(np.column_stack([x, 2 * x]), np.ones(4000), (0.5,))
    assert np.nanmax(np.abs(line[1] - 2 * line[0])) < 0.02
    (dot,) = outlines(np.ones((10, 2)), np.ones(10), (0.5,))
    assert np.nanmax(np.abs(dot - 1)) < 0.01
