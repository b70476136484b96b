from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from prbayes._stats import quantile
from prbayes._validate import Floats
from prbayes.metrics import density
from prbayes.metrics.density import (
    GaussianKDE,
    Histogram,
    density_estimator,
    likelihood_bandwidth,
    silverman,
    spread,
)
from prbayes.metrics.grid import KernelCells

H, INF, NAN = 0.5, np.inf, np.nan
OBSERVED = np.array([-2.0, -0.3, 0.1, 0.7, 2.1])
EQUAL = np.full(5, 0.2)


def kernel_cells(bandwidth: float = H, observed: Floats = OBSERVED) -> KernelCells:
    cells = GaussianKDE(bandwidth).cells(observed, np.full(observed.size, 1 / observed.size))
    assert isinstance(cells, KernelCells)
    return cells


@pytest.mark.parametrize("bandwidth", [0.01, 0.37, 20.0])
def test_kernel_grid_covers_six_bandwidths_or_half_the_range_at_either_side(
    bandwidth: float,
) -> None:
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
    assert Histogram().cells(np.r_[x, 1e9], np.r_[w, 1e-12]).centers.size == density._MAX_CELLS


@pytest.mark.parametrize("seed", range(3))
def test_bandwidth_rules_by_hand(seed: int) -> None:
    x = np.random.default_rng(seed).standard_t(2, 40)
    w = np.full(40, 1 / 40)
    q = [0.0, 0.25, 0.5, 0.75, 1.0]
    hazen = np.quantile(x, q, method="hazen")
    np.testing.assert_allclose([quantile(x, w, p) for p in q], hazen, rtol=1e-12)
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
    with pytest.raises(
        ValueError, match=r"bandwidth: got .* from 5 observed .*GaussianKDE\(bandwidth="
    ):
        GaussianKDE(lambda x, w: bandwidth).cells(OBSERVED, EQUAL)
    with pytest.raises(
        TypeError, match="bandwidth: got str 'silverman', expected a positive finite number"
    ):
        GaussianKDE("silverman")  # type: ignore[arg-type]


@pytest.mark.parametrize("value", [0.0, 0.1, 1 / 3, 1e6 + 0.1, -7e10 - 0.3])
@pytest.mark.parametrize("n", [1, 2, 3, 6, 7, 10, 49])
@pytest.mark.parametrize("rule", [density.twice_silverman, likelihood_bandwidth])
def test_equal_observed_values_have_no_bandwidth_and_no_bins(
    value: float, n: int, rule: Any
) -> None:
    x, w = np.full(n, value), np.full(n, 1 / n)
    with pytest.raises(ValueError, match=f"bandwidth: got 0 from {n} observed.*use AreaMetric"):
        GaussianKDE(rule).cells(x, w)
    with pytest.raises(
        ValueError, match=f"histogram: got {n} observed values, all .*use AreaMetric"
    ):
        Histogram().cells(x, w)


@pytest.mark.parametrize("bins", [0, -1, 2.5, True, "fd"])
def test_wrong_bins(bins: Any) -> None:
    error = ValueError if type(bins) is int else TypeError
    with pytest.raises(error, match=rf"bins: got .*{bins}.*, expected an integer >= 1"):
        Histogram(bins)


@pytest.mark.parametrize("kde", [GaussianKDE(), GaussianKDE(0.1)])
def test_a_grid_that_an_outlier_makes_too_long_is_refused_with_advice(kde: GaussianKDE) -> None:
    x = np.r_[np.random.default_rng(0).normal(size=99), 1e9]
    with pytest.raises(
        ValueError,
        match=r"bandwidth: got .* span 1e\+09.* below 1024 bandwidths; look for outliers",
    ):
        kde.cells(x, np.full(100, 0.01))
    assert kernel_cells(1.0, np.array([0.0, 1023.0])).centers.size < density._MAX_CELLS


@pytest.mark.parametrize("rule", [silverman, density.twice_silverman, likelihood_bandwidth])
def test_the_order_of_the_observed_values_does_not_matter(rule: Any) -> None:
    rng = np.random.default_rng(9)
    x, w = np.round(rng.normal(size=30), 1), rng.dirichlet(np.ones(30))
    order = rng.permutation(30)
    np.testing.assert_allclose(rule(x[order], w[order]), rule(x, w), rtol=1e-12)


@pytest.mark.parametrize("estimator", [GaussianKDE(), Histogram()])
def test_values_without_weight_are_as_if_left_out(estimator: Any) -> None:
    observed = np.array([0.0, 1.0, 1.0, 2.5, 4.0])
    weights = np.array([0.2, 0.3, 0.1, 0.2, 0.2])
    alone = estimator.cells(observed, weights)
    beside = estimator.cells(np.r_[-50.0, observed, 1.0, 9.0], np.r_[0.0, weights, 0.0, 0.0])
    np.testing.assert_array_equal(beside.widths, alone.widths)
    np.testing.assert_array_equal(beside.centers, alone.centers)


@pytest.mark.parametrize("rule", [silverman, likelihood_bandwidth])
def test_which_of_equal_values_comes_first_does_not_matter(rule: Any) -> None:
    observed = np.array([0.0, 1.0, 1.0, 2.0])
    weights = np.array([0.1, 0.1, 0.6, 0.2])
    swapped = weights[[0, 2, 1, 3]]
    assert rule(observed, weights) == rule(observed, swapped)


def test_only_estimators_are_taken_for_estimators() -> None:
    density_estimator(Histogram())
    with pytest.raises(
        TypeError, match=r"density: got the class Histogram, expected .*Histogram\(\)"
    ):
        density_estimator(Histogram)
    with pytest.raises(TypeError, match="density: got int 7, expected prb"):
        density_estimator(7)
