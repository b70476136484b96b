"""Numbers behind the pictures, against closed forms; regions hold what they say."""

import numpy as np
import pytest
from scipy import stats

from prbayes.plots import curves
from prbayes.plots.curves import White, outlines

QUANTILES = stats.norm.ppf((np.arange(1000) + 0.5) / 1000)
EQUAL = np.full(1000, 1e-3)
GRID = np.linspace(-5, 9, 301)


# -- densities -------------------------------------------------------------------------------------


def test_a_weighted_density_is_that_of_the_target() -> None:
    """N(0, 2) weighted by N(1, 1) over N(0, 2): smoothed, the density of N(1, sqrt(1 + h^2))."""
    x = 2 * QUANTILES
    w = stats.norm.pdf(x, 1, 1) / stats.norm.pdf(x, 0, 2)
    w /= w.sum()
    found = curves.densities(x, w, GRID, 0.3)
    np.testing.assert_allclose(found, stats.norm.pdf(GRID, 1, np.hypot(1, 0.3)), atol=2e-3)
    assert np.trapezoid(found, GRID) == pytest.approx(1, abs=1e-3)


def test_what_is_not_finite_is_missing_from_the_area() -> None:
    x = QUANTILES.copy()
    x[:100], x[-50:] = np.inf, np.nan
    assert np.trapezoid(curves.densities(x, EQUAL, GRID, 0.2), GRID) == pytest.approx(
        0.85, abs=2e-3
    )
    found = curves.distribution_functions(x[None], EQUAL[None], np.array([-9.0, 9.0]))
    np.testing.assert_allclose(found, [[0, 0.85]], atol=1e-12)


def test_rows_have_their_own_weights_and_values() -> None:
    mixed = np.random.default_rng(1).permutation(QUANTILES)
    shared = np.broadcast_to(mixed, (2, 1000))
    tilted = np.exp(0.7 * mixed)
    weights = np.stack([EQUAL, tilted / tilted.sum()])
    expected = stats.norm.cdf(GRID - np.array([[0], [0.7]]))
    np.testing.assert_allclose(
        curves.distribution_functions(shared, weights, GRID), expected, atol=6e-3
    )
    own = np.stack([QUANTILES, QUANTILES[::-1] + 0.7])
    np.testing.assert_allclose(
        curves.distribution_functions(own, np.stack([EQUAL, EQUAL]), GRID), expected, atol=2e-3
    )
    both = curves.densities(own, np.stack([EQUAL, EQUAL]), GRID, 0.1)
    np.testing.assert_allclose(
        both, stats.norm.pdf(GRID, [[0], [0.7]], np.hypot(1, 0.1)), atol=4e-3
    )


def test_the_bandwidth_is_silvermans_of_the_effective_number() -> None:
    weights = np.where(np.arange(1000) % 2, 2e-3, 0.0)
    expected = 0.9 * 1000**-0.2, 0.9 * 500**-0.2
    found = [curves.typical_bandwidth(QUANTILES, w[None]) for w in (EQUAL, weights)]
    np.testing.assert_allclose(found, expected, rtol=0.02)
    with_inf = np.append(QUANTILES, [np.inf, np.nan])
    assert curves.typical_bandwidth(with_inf, np.full((3, 1002), 1 / 1002)) == pytest.approx(
        expected[0], rel=0.02
    )


def test_a_density_does_not_dip_at_a_bound() -> None:
    draws = np.abs(QUANTILES)
    found = curves.bounded_density(draws, np.array([-0.1, 0.01, 0.5, 1.0]))
    np.testing.assert_allclose(found, [0, *(2 * stats.norm.pdf([0.01, 0.5, 1.0]))], atol=0.03)


def test_the_band_has_the_quantiles_of_the_level() -> None:
    rows = np.arange(101.0)[:, None] * np.array([1.0, -2.0])
    low, high = curves.pointwise_band(rows, 0.9)
    np.testing.assert_allclose([low, high], [[5, -190], [95, -10]])


def test_ranges_are_quantiles_of_most_samples() -> None:
    rows = np.stack([QUANTILES + k for k in range(11)])
    found = curves.central_range(rows, np.full(rows.shape, 1e-3), 0.05)
    np.testing.assert_allclose(found, [1 - 1.645, 9 + 1.645], atol=0.02)


# -- data ------------------------------------------------------------------------------------------


def test_the_histogram_has_the_area_of_what_is_finite() -> None:
    data = np.array([0.0, 0.1, 0.2, 0.9, 1.0, np.inf])
    x, y = curves.histogram(data, np.full(6, 1 / 6))
    assert np.trapezoid(y, x) == pytest.approx(5 / 6)
    assert x.min() == 0
    assert x.max() == 1
    np.testing.assert_allclose(y[1::4] * np.diff(x)[1::4], [2 / 6, 1 / 6, 0, 0, 2 / 6], atol=1e-12)
    x, y = curves.histogram(np.array([3.0, 3.0]), np.full(2, 0.5))
    assert np.trapezoid(y, x) == pytest.approx(1)
    assert x.mean() == pytest.approx(3)


def test_the_staircase_goes_up_by_the_weight_at_each_value() -> None:
    x, y = curves.staircase(np.array([2.0, 1.0, np.inf]), np.array([0.5, 0.2, 0.3]), 0.0, 4.0)
    np.testing.assert_allclose(x, [0, 1, 1, 2, 2, 4])
    np.testing.assert_allclose(y, [0, 0, 0.2, 0.2, 0.7, 0.7])


def test_a_density_of_equal_draws_is_unknown() -> None:
    assert np.isnan(curves.bounded_density(np.ones(10), GRID)).all()


def test_populations_of_one_picture_have_one_bandwidth() -> None:
    rows = np.stack([QUANTILES, 3 * QUANTILES, 3 * QUANTILES])
    weights = np.stack([EQUAL] * 3)
    found = curves.smooth_densities(rows, weights, GRID)
    h = curves.typical_bandwidth(3 * QUANTILES, EQUAL[None])
    np.testing.assert_allclose(found[0], stats.norm.pdf(GRID, 0, np.hypot(1, h)), atol=4e-3)


def test_steps_go_from_low_to_high_with_a_height_before_the_first() -> None:
    x, y = curves.steps(np.array([1.0, 3.0]), np.array([5.0, 6.0, 7.0]), 0.0, 4.0)
    np.testing.assert_array_equal(x, [0, 1, 1, 3, 3, 4])
    np.testing.assert_array_equal(y, [5, 5, 6, 6, 7, 7])


# -- regions ---------------------------------------------------------------------------------


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
