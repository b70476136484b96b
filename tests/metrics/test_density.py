from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from prbayes._checks import Floats
from prbayes.metrics import density
from prbayes.metrics.cells import KernelCells
from prbayes.metrics.density import GaussianKDE, Histogram, likelihood_bandwidth, silverman, spread

H, INF, NAN = 0.5, np.inf, np.nan
OBSERVED = np.array([-2.0, -0.3, 0.1, 0.7, 2.1])
EQUAL = np.full(5, 0.2)
ESTIMATORS = {"kde": GaussianKDE(H), "histogram": Histogram(6)}
both = pytest.mark.parametrize("estimator", ESTIMATORS.values(), ids=ESTIMATORS)


def kernel_cells(bandwidth: float = H, observed: Floats = OBSERVED) -> KernelCells:
    cells = GaussianKDE(bandwidth).cells(observed, np.full(observed.size, 1 / observed.size))
    assert isinstance(cells, KernelCells)
    return cells


def draw(seed: int, *shape: int) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=shape), rng.dirichlet(np.ones(shape[-1]), shape[:-1])


@pytest.mark.parametrize("n", [1, 2, 7, 300])
@pytest.mark.parametrize("bandwidth", [0.03, 0.5, 4.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_kde_is_the_exact_sum_of_gaussians_to_a_few_parts_in_1e5(n: int, bandwidth: float, seed: int) -> None:
    x, w = draw(seed, n)
    cells = kernel_cells(bandwidth, np.array([-5.0, 5.0]))
    x[0] = cells.centers[1] + 0.3 * cells.step  # near the edge
    exact = w @ norm.pdf(cells.centers, x[:, None], bandwidth)
    np.testing.assert_allclose(cells.density(x, w)[:-2], exact, rtol=0, atol=3e-5 * exact.max())


@pytest.mark.parametrize("seed", range(4))
def test_kde_has_the_exact_mass_mean_and_variance(seed: int) -> None:
    x, w = draw(seed, 9)
    cells = kernel_cells(observed=np.array([-5.0, 5.0]))
    mass = cells.density(x, w) * cells.widths
    mean = w @ x
    np.testing.assert_allclose(mass.sum(), 1, rtol=1e-10)
    np.testing.assert_allclose(mass[:-2] @ cells.centers, mean, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(mass[:-2] @ (cells.centers - mean) ** 2, w @ (x - mean) ** 2 + H**2, rtol=1e-9)


@pytest.mark.parametrize("bandwidth", [0.01, 0.37, 20.0])
def test_kernel_grid_covers_six_bandwidths_or_half_the_range_at_either_side(bandwidth: float) -> None:
    cells = kernel_cells(bandwidth)
    margin = max(6 * bandwidth, 4.1 / 2)
    low, high = OBSERVED.min() - margin, OBSERVED.max() + margin
    assert cells.smooth
    np.testing.assert_allclose(cells.centers[0], low, rtol=1e-12)
    assert high <= cells.centers[-1] * (1 + 1e-12) < high + 1.001 * bandwidth / 4
    np.testing.assert_allclose(np.diff(cells.centers), bandwidth / 4, rtol=1e-9)
    np.testing.assert_allclose(cells.widths[:-2], bandwidth / 4)
    np.testing.assert_allclose(cells.widths[-2:], 2 * np.sqrt(np.pi) * bandwidth)
    narrowed = np.sqrt(bandwidth**2 - cells.step**2 / 3)
    assert 7 * narrowed <= cells.kernel.size // 2 * cells.step < 7 * narrowed + cells.step
    np.testing.assert_array_equal(cells.kernel, cells.kernel[::-1])


@both
def test_mass_outside_goes_to_the_last_two_cells_and_nan_nowhere(estimator: Any) -> None:
    cells = estimator.cells(OBSERVED, EQUAL)
    x = np.array([0.2, -99.0, 1.0, 99.0, INF, NAN, -1e300, 1e300])
    w = np.arange(1.0, 9.0) / 36
    mass = cells.density(x, w) * cells.widths
    np.testing.assert_allclose(mass[-2], w[[1, 6]].sum(), rtol=1e-14)
    np.testing.assert_allclose(mass[-1], w[[3, 4, 7]].sum(), rtol=1e-14)
    np.testing.assert_allclose(mass.sum(), 1 - w[5], rtol=1e-10)
    assert (cells.density(np.full(3, INF), np.full(3, 1 / 3))[:-1] == 0).all()
    assert (cells.density(np.full(3, NAN), np.full(3, 1 / 3)) == 0).all()


@both
@pytest.mark.parametrize("batch", [(1,), (3,), (2, 3), (2, 1, 3)])
def test_batches_equal_a_loop(estimator: Any, batch: tuple[int, ...]) -> None:
    cells = estimator.cells(OBSERVED, EQUAL)
    x, w = draw(5, *batch, 11)
    expected = np.array([cells.density(x[i], w[i]) for i in np.ndindex(*batch)])
    shared = np.array([cells.density(x[i], w[(0,) * len(batch)]) for i in np.ndindex(*batch)])
    np.testing.assert_allclose(cells.density(x, w), expected.reshape(*batch, -1), rtol=1e-12, atol=1e-15)
    result = cells.density(x, w[(0,) * len(batch)])
    np.testing.assert_allclose(result, shared.reshape(*batch, -1), rtol=1e-12, atol=1e-15)


@both
def test_a_long_sample_is_the_sum_of_its_parts(estimator: Any) -> None:
    n = (1 << 17) + 17
    x = 3 * np.random.default_rng(3).normal(size=n)
    cells = estimator.cells(OBSERVED, EQUAL)
    parts = sum(cells.density(part, np.full(part.size, 1 / n)) for part in np.array_split(x, 7))
    np.testing.assert_allclose(cells.density(x, np.full(n, 1 / n)), parts, rtol=1e-9, atol=1e-14)


@both
def test_basis_turns_weights_into_the_density(estimator: Any) -> None:
    cells = estimator.cells(OBSERVED, EQUAL)
    x = np.r_[draw(6, 20)[0], -50, 60, INF, OBSERVED]
    w = draw(7, 4, x.size)[1]
    a = cells.basis(x)
    assert a.shape == (x.size, cells.widths.size)
    np.testing.assert_allclose(w @ a, cells.density(np.broadcast_to(x, w.shape), w), rtol=1e-12, atol=1e-15)


@both
@pytest.mark.parametrize("batch", [(), (3,), (2, 2)])
def test_pullback_equals_finite_differences(estimator: Any, batch: tuple[int, ...]) -> None:
    cells = estimator.cells(OBSERVED, EQUAL)
    rng = np.random.default_rng(8)
    x, w = draw(9, *batch, 8)
    x[..., :4] = -40.0, 50.0, INF, cells.centers[1] + 0.3 * cells.widths[0]
    cotangent = rng.normal(size=(*batch, cells.widths.size))
    for_sample, for_weights = w * cells.slope(x, cotangent), cells.value(x, cotangent)
    assert for_sample.shape == for_weights.shape == x.shape

    def objective(sample: Floats, weights: Floats) -> float:
        return float((cells.density(sample, weights) * cotangent).sum())

    e = 1e-5
    for i in np.ndindex(x.shape):
        d = np.zeros(x.shape)
        d[i] = e
        slope = (objective(x + d, w) - objective(x - d, w)) / (2 * e)
        np.testing.assert_allclose(for_sample[i], slope, rtol=1e-6, atol=1e-8)
        slope = (objective(x, w + d) - objective(x, w - d)) / (2 * e)
        np.testing.assert_allclose(for_weights[i], slope, rtol=1e-6, atol=1e-8)
    assert (for_sample[..., :3] == 0).all()


def test_second_derivative_is_continuous_across_nodes_and_that_of_a_gaussian() -> None:
    cells = kernel_cells()
    e, at = 1e-3 * H, cells.centers.size // 2
    z = cells.centers[at]
    exact = norm.pdf(0) / H**3  # the largest second derivative

    def curvature(x: float) -> float:
        f = [cells.density(np.array([v]), np.ones(1))[at] for v in (x - e, x, x + e)]
        return float((f[0] - 2 * f[1] + f[2]) / e**2)

    for node in range(at - 8, at + 9):
        below, above = (curvature(float(cells.centers[node]) + d) for d in (-2 * e, 2 * e))
        assert abs(above - below) < 2e-2 * exact
        u = (cells.centers[node] - z) / H
        assert abs(below - (u**2 - 1) * norm.pdf(u) / H**3) < 3e-2 * exact


@pytest.mark.parametrize("function", [lambda z: 0 * z + 3, lambda z: 2 * z - 1, lambda z: z**2 - z + 2])
@pytest.mark.parametrize("seed", [0, 1])
def test_kernel_reading_is_exact_up_to_parabolas(function: Callable[[Floats], Floats], seed: int) -> None:
    cells = kernel_cells()
    points, w = draw(seed, 12)
    points[:3] = cells.centers[[2, 10, -3]] + np.array([0, 0, -1e-9])  # on nodes, and at the last one
    on_cells = np.r_[function(cells.centers), 1e6, -1e6]
    reading = cells.reading(points, w)
    assert reading.shape == on_cells.shape
    np.testing.assert_allclose(reading @ on_cells, w @ function(points), rtol=1e-10)


def test_kernel_reading_of_a_gaussian_is_close_and_of_points_outside_is_zero() -> None:
    cells = kernel_cells()
    points, w = draw(2, 12)
    on_cells = np.r_[norm.pdf(cells.centers, 0.3, 1), 0, 0]
    np.testing.assert_allclose(cells.reading(points, w) @ on_cells, w @ norm.pdf(points, 0.3, 1), rtol=1e-3)
    assert (cells.reading(np.array([-99.0, 99.0]), np.full(2, 0.5)) == 0).all()


def test_histogram_reading_is_the_mass_in_each_bin() -> None:
    cells = Histogram(6).cells(OBSERVED, EQUAL)
    points, w = draw(3, 12)
    cell = np.clip(np.floor((points + 2.0) / (4.1 / 6)), -1, 6).astype(int)
    values = np.random.default_rng(4).normal(size=8)  # below is cell 6, above is cell 7
    expected = w @ values[np.where(cell < 0, 6, np.where(cell == 6, 7, cell))]
    np.testing.assert_allclose(cells.reading(points, w) @ values, expected, rtol=1e-12)


@pytest.mark.parametrize("bins", [1, 2, 7, 50])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_histogram_equals_numpy(bins: int, seed: int) -> None:
    x, w = draw(seed, 60)
    cells = Histogram(bins).cells(x, w)
    expected, edges = np.histogram(x, bins, weights=w, density=True)
    np.testing.assert_allclose(cells.density(x, w), [*expected, 0, 0], rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(cells.centers, (edges[1:] + edges[:-1]) / 2, rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(cells.widths, np.diff(edges)[0], rtol=1e-10)
    assert (cells.widths.size, cells.smooth) == (bins + 2, False)


def test_histogram_bins_are_closed_on_the_left_and_the_last_on_both_sides() -> None:
    cells = Histogram(4).cells(np.array([0.0, 4.0]), np.full(2, 0.5))
    x = np.array([0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 4.0, -1e-6, 4 + 1e-6, np.nextafter(1.0, 0.0)])
    np.testing.assert_allclose(cells.density(x, np.ones(10)), [3, 1, 1, 3, 1, 1], rtol=1e-12)


@pytest.mark.parametrize("seed", range(8))
def test_no_observed_value_falls_outside_its_histogram(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(25):
        x = rng.normal(10 ** rng.uniform(-3, 3), 10 ** rng.uniform(-3, 3), rng.integers(2, 40))
        cells = Histogram(int(rng.integers(1, 60))).cells(x, np.full(x.size, 1 / x.size))
        q = cells.density(x, np.full(x.size, 1 / x.size))
        assert (q[-2:] == 0).all()
        assert min(q[0], q[-3]) > 0


@pytest.mark.parametrize(("n", "seed"), [(8, 0), (50, 1), (4000, 2)])
def test_default_bins_follow_freedman_and_diaconis_with_at_least_five(n: int, seed: int) -> None:
    x = np.random.default_rng(seed).exponential(size=n)
    w = np.full(n, 1 / n)
    iqr = min(np.subtract(*np.percentile(x, [75, 25], method="hazen")), 1.34 * x.std())
    expected = max(5, np.ceil(np.ptp(x) / (2 * iqr * n ** (-1 / 3))))
    assert Histogram().cells(x, w).centers.size == expected
    assert Histogram().cells(np.r_[x, 1e9], np.r_[w, 0]).centers.size == density._MAX_CELLS


@pytest.mark.parametrize("seed", range(3))
def test_bandwidth_rules_by_hand(seed: int) -> None:
    x = np.random.default_rng(seed).standard_t(2, 40)
    w = np.full(40, 1 / 40)
    q = [0.0, 0.25, 0.5, 0.75, 1.0]
    hazen = np.quantile(x, q, method="hazen")
    np.testing.assert_allclose([density.weighted_quantile(x, w, p) for p in q], hazen, rtol=1e-12)
    width = min(x.std(), (hazen[3] - hazen[1]) / 1.34)
    np.testing.assert_allclose(spread(x, w), width, rtol=1e-12)
    tied = np.r_[np.zeros(38), 1.0, -1.0]  # no IQR: the sd alone
    np.testing.assert_allclose(spread(tied, w), tied.std(), rtol=1e-12)
    np.testing.assert_allclose(silverman(x, w), 0.9 * width * 40**-0.2, rtol=1e-12)
    np.testing.assert_allclose(density.twice_silverman(x, w), 1.8 * width * 40**-0.2, rtol=1e-12)
    np.testing.assert_allclose(likelihood_bandwidth(x, w), 0.35 * width * 40**-0.25, rtol=1e-12)
    for rule in (silverman, density.twice_silverman, likelihood_bandwidth):
        np.testing.assert_allclose(rule(7 - 3 * x, w), 3 * rule(x, w), rtol=1e-12)
    default = GaussianKDE().cells(x, w).widths[0] * 4
    np.testing.assert_allclose(default, density.twice_silverman(x, w), rtol=1e-15)


@pytest.mark.parametrize(("rule", "power"), [(silverman, 0.2), (likelihood_bandwidth, 0.25)])
def test_weights_change_a_bandwidth_through_the_effective_size(rule: Any, power: float) -> None:
    x = np.r_[-1.1, -1.0, -0.9, 0.9, 1.0, 1.1]  # two heaps: the sd decides, not the IQR
    repeats = np.array([1, 2, 3, 3, 2, 1])
    w = repeats / 12
    ratio = (12 * (w**2).sum()) ** power
    repeated = rule(np.repeat(x, repeats), np.full(12, 1 / 12))
    np.testing.assert_allclose(rule(x, w), ratio * repeated, rtol=1e-12)


def test_a_rule_gets_the_observed_values_and_their_weights() -> None:
    kde = GaussianKDE(lambda x, w: float(x @ w) + w.size)
    np.testing.assert_array_equal(kde.cells(OBSERVED, EQUAL).widths[0] * 4, OBSERVED @ EQUAL + 5)


@pytest.mark.parametrize("bandwidth", [0, -0.5, NAN, INF])
def test_bandwidths_that_are_not_positive(bandwidth: float) -> None:
    with pytest.raises(ValueError, match=r"bandwidth: got .*, expected a positive finite number"):
        GaussianKDE(bandwidth)
    with pytest.raises(ValueError, match=r"bandwidth: got .* from 5 observed .*GaussianKDE\(bandwidth="):
        GaussianKDE(lambda x, w: bandwidth).cells(OBSERVED, EQUAL)
    with pytest.raises(TypeError, match="bandwidth: got str 'silverman', expected a positive number"):
        GaussianKDE("silverman")  # type: ignore[arg-type]


@pytest.mark.parametrize("value", [0.0, 0.1, 1 / 3, 1e6 + 0.1, -7e10 - 0.3])
@pytest.mark.parametrize("n", [1, 2, 3, 6, 7, 10, 49])
@pytest.mark.parametrize("rule", [density.twice_silverman, likelihood_bandwidth])
def test_equal_observed_values_have_no_bandwidth_and_no_bins(value: float, n: int, rule: Any) -> None:
    x, w = np.full(n, value), np.full(n, 1 / n)
    with pytest.raises(ValueError, match=f"bandwidth: got 0 from {n} observed.*use AreaMetric"):
        GaussianKDE(rule).cells(x, w)
    with pytest.raises(ValueError, match=f"histogram: got {n} observed values, all .*use AreaMetric"):
        Histogram().cells(x, w)


@pytest.mark.parametrize("bins", [0, -1, 2.5, True, "fd"])
def test_wrong_bins(bins: Any) -> None:
    error = ValueError if type(bins) is int else TypeError
    with pytest.raises(error, match=rf"bins: got .*{bins}.*, expected an integer >= 1"):
        Histogram(bins)


@pytest.mark.parametrize("kde", [GaussianKDE(), GaussianKDE(0.1)])
def test_a_grid_that_an_outlier_makes_too_long_is_refused_with_advice(kde: GaussianKDE) -> None:
    x = np.r_[np.random.default_rng(0).normal(size=99), 1e9]
    with pytest.raises(ValueError, match=r"bandwidth: got .* span 1e\+09.* below 1024 bandwidths; look for outliers"):
        kde.cells(x, np.full(100, 0.01))
    assert kernel_cells(1.0, np.array([0.0, 1023.0])).centers.size < density._MAX_CELLS
