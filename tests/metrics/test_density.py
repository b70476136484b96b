"""Bandwidth rules, grids and bins."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from prbayes import AreaMetric, KullbackLeibler, LogLikelihood, ProbabilityResidual
from prbayes.metrics import density
from prbayes.metrics.density import (
    GaussianKDE,
    Histogram,
    likelihood_bandwidth,
    silverman,
    spread,
    twice_silverman,
    with_common_bandwidths,
)

INF, NAN = np.inf, np.nan
OBSERVED = np.array([-2.0, -0.3, 0.1, 0.7, 2.1])
EQUAL = np.full(5, 0.2)


@pytest.mark.parametrize("bandwidth", [0.01, 0.37, 20.0])
def test_kernel_grid_covers_six_bandwidths_or_half_the_range_at_either_side(
    bandwidth: float,
) -> None:
    cells: Any = GaussianKDE(bandwidth).cells(OBSERVED, EQUAL)
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


def test_no_observed_value_falls_outside_its_histogram() -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        x = rng.normal(10 ** rng.uniform(-3, 3), 10 ** rng.uniform(-3, 3), rng.integers(2, 40))
        w = np.full(x.size, 1 / x.size)
        q = Histogram(int(rng.integers(1, 60))).cells(x, w).density(x, w)
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


@pytest.mark.parametrize("seed", range(2))
def test_bandwidth_rules_by_hand(seed: int) -> None:
    x = np.random.default_rng(seed).standard_t(2, 40)
    w = np.full(40, 1 / 40)
    width = min(x.std(), np.subtract(*np.quantile(x, [0.75, 0.25], method="hazen")) / 1.34)
    np.testing.assert_allclose(spread(x, w), width, rtol=1e-12)
    tied = np.r_[np.zeros(38), 1.0, -1.0]  # no IQR: the sd alone
    np.testing.assert_allclose(spread(tied, w), tied.std(), rtol=1e-12)
    expected = width * np.array([0.9 * 40**-0.2, 1.8 * 40**-0.2, 0.35 * 40**-0.25])
    order = np.random.default_rng(9).permutation(40)
    for rule, size in zip(
        (silverman, twice_silverman, likelihood_bandwidth), expected, strict=True
    ):
        found = [rule(x, w), rule(7 - 3 * x, w) / 3, rule(x[order], w)]
        np.testing.assert_allclose(found, size, rtol=1e-12)
    default: Any = GaussianKDE().cells(x, w)
    assert default.bandwidth == twice_silverman(x, w)
    given: Any = GaussianKDE(lambda x, w: float(x @ w) + w.size).cells(OBSERVED, EQUAL)
    assert given.bandwidth == OBSERVED @ EQUAL + 5


@pytest.mark.parametrize(("rule", "power"), [(silverman, 0.2), (likelihood_bandwidth, 0.25)])
def test_weights_change_a_bandwidth_through_the_effective_size(rule: Any, power: float) -> None:
    x = np.r_[-1.1, -1.0, -0.9, 0.9, 1.0, 1.1]  # two heaps: the sd decides, not the IQR
    repeats = np.array([1, 2, 3, 3, 2, 1])
    w = repeats / 12
    ratio = (12 * (w**2).sum()) ** power
    repeated = rule(np.repeat(x, repeats), np.full(12, 1 / 12))
    np.testing.assert_allclose(rule(x, w), ratio * repeated, rtol=1e-12)
    # Which of equal values comes first does not matter.
    tied, weights = np.array([0.0, 1.0, 1.0, 2.0]), np.array([0.1, 0.1, 0.6, 0.2])
    assert rule(tied, weights) == rule(tied, weights[[0, 2, 1, 3]])


@pytest.mark.parametrize("bandwidth", [0, -0.5, NAN, INF])
def test_bandwidths_that_are_not_positive(bandwidth: float) -> None:
    with pytest.raises(ValueError, match=r"bandwidth: got .* from 5 observed"):
        GaussianKDE(lambda x, w: bandwidth).cells(OBSERVED, EQUAL)


@pytest.mark.parametrize(("value", "n"), [(0.0, 1), (1 / 3, 7), (1e6 + 0.1, 3), (-7e10 - 0.3, 49)])
def test_equal_observed_values_have_no_bandwidth_and_no_bins(value: float, n: int) -> None:
    x, w = np.full(n, value), np.full(n, 1 / n)
    for rule in (twice_silverman, likelihood_bandwidth):
        with pytest.raises(ValueError, match=f"bandwidth: got 0 from {n} observed.*use AreaMetric"):
            GaussianKDE(rule).cells(x, w)
    with pytest.raises(ValueError, match=f"histogram: got {n} observed values, all"):
        Histogram().cells(x, w)


@pytest.mark.parametrize("kde", [GaussianKDE(), GaussianKDE(0.1)])
def test_a_grid_that_an_outlier_makes_too_long_is_refused_with_advice(kde: GaussianKDE) -> None:
    x = np.r_[np.random.default_rng(0).normal(size=99), 1e9]
    with pytest.raises(ValueError, match=r"span 1e\+09.* below 1024 bandwidths; look for outliers"):
        kde.cells(x, np.full(100, 0.01))
    longest = GaussianKDE(1.0).cells(np.array([0.0, 1023.0]), np.full(2, 0.5))
    assert longest.centers.size < density._MAX_CELLS


@pytest.mark.parametrize("estimator", [GaussianKDE(), Histogram()])
def test_values_without_weight_are_as_if_left_out(estimator: Any) -> None:
    observed = np.array([0.0, 1.0, 1.0, 2.5, 4.0])
    weights = np.array([0.2, 0.3, 0.1, 0.2, 0.2])
    alone = estimator.cells(observed, weights)
    beside = estimator.cells(np.r_[-50.0, observed, 1.0, 9.0], np.r_[0.0, weights, 0.0, 0.0])
    np.testing.assert_array_equal(beside.widths, alone.widths)
    np.testing.assert_array_equal(beside.centers, alone.centers)


PARTS = np.random.default_rng(701).normal(1, 0.5, (5, 4))
POPULATION = norm.ppf((np.arange(4001) + 0.5) / 4001)


def log_spread_of_minimum(targets: Any) -> float:
    """Return log of the spread of the best normal population, relative to that of all parts."""
    logs = np.linspace(-1, 0.5, 301)
    values = PARTS.mean() + PARTS.std() * np.exp(logs)[:, None] * POPULATION
    weights = np.full(values.shape, 1 / values.shape[1])
    total = sum(target.n_effective * target.of(values, weights) for target in targets)
    return float(logs[np.argmin(total)])


def test_one_bandwidth_for_all_parts_gives_the_spread_of_all() -> None:
    targets = [KullbackLeibler().against(part) for part in PARTS]
    assert log_spread_of_minimum(targets) < -0.05
    common = with_common_bandwidths(targets, [0] * 5, [0] * 5)
    assert log_spread_of_minimum(common) == pytest.approx(0.0, abs=0.006)
    pooled: Any = KullbackLeibler().against(PARTS.ravel())
    for target in common:
        assert target.cells.bandwidth == pytest.approx(pooled.cells.bandwidth)
        assert target.metric == KullbackLeibler()
    again = with_common_bandwidths(common, [0] * 5, [0] * 5)
    assert all(x is y for x, y in zip(again, common, strict=True))


@pytest.mark.parametrize("metric", [KullbackLeibler(), LogLikelihood(density=GaussianKDE())])
def test_conditions_of_a_response_with_like_spreads_have_one_bandwidth(metric: Any) -> None:
    shifted = PARTS + 100 * np.arange(5)[:, None]
    targets = [metric.against(part) for part in shifted]
    widths = [t.cells.bandwidth for t in with_common_bandwidths(targets, [0] * 5, range(5))]
    np.testing.assert_allclose(widths, widths[0])
    middle = np.concatenate([part - part.mean() for part in PARTS])
    assert widths[0] == pytest.approx(metric.against(middle).cells.bandwidth)
    # In units of their own, and with another spread, data have a bandwidth of their own.
    assert with_common_bandwidths(targets, range(5), range(5)) == targets
    targets[-1] = metric.against(1000 * PARTS[-1])
    assert with_common_bandwidths(targets, [0] * 5, range(5)) == targets
    # Data of one condition are pooled nevertheless.
    widths = [t.cells.bandwidth for t in with_common_bandwidths(targets, [0] * 5, [0, 0, 1, 2, 3])]
    assert widths[0] == widths[1] != widths[2]


@pytest.mark.parametrize(
    "metric",
    [
        AreaMetric(),
        ProbabilityResidual(),
        KullbackLeibler(GaussianKDE(0.3)),
        KullbackLeibler(Histogram()),
    ],
)
def test_bandwidths_that_do_no_harm_or_were_given_stay(metric: Any) -> None:
    targets = [metric.against(part) for part in PARTS]
    assert with_common_bandwidths(targets, [0] * 5, [0] * 5) == targets
