"""Curves behind the pictures, as numbers: densities, distribution functions, bands, histograms."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from prbayes._stats import cumulated, distribution_function, quantile
from prbayes._validate import Floats
from prbayes.metrics.density import GaussianKDE, Histogram, silverman

# Points of a curve, 256 steps: a step is about a pixel or two of a panel, by judgement.
GRID_POINTS = 257


def _finite_samples(values: Floats, weights: Floats) -> Iterator[tuple[Floats, Floats]]:
    """Yield what is finite and has a weight, of samples of shape (P, n), with weights of sum 1."""
    rows = np.broadcast_to(values, weights.shape)
    for row, w in zip(rows, weights, strict=True):
        used = np.isfinite(row) & (w > 0)
        if used.any():
            share = w[used]
            yield row[used], share / share.sum()


def typical_bandwidth(values: Floats, weights: Floats) -> float:
    """Return the median of Silverman's bandwidths of weighted samples, shapes (P, n).

    What is not finite is left out. The effective number of values is that of the weights, so that
    uneven weights are smoothed more.
    """
    found = []
    for row, w in _finite_samples(values, weights):
        found.append(silverman(row, w))
    return float(np.median(found)) if found else 0.0


def smooth_densities(values: Floats, weights: Floats, grid: Floats) -> Floats:
    """Return densities, shape (P, g), of weighted samples, (P, n), smoothed by one bandwidth."""
    # A median of 40 will do: bandwidths differ little beside what a bandwidth changes.
    some = slice(40)
    bandwidth = typical_bandwidth(values[some], weights[some])
    return densities(values, weights, grid, bandwidth)


def densities(values: Floats, weights: Floats, grid: Floats, bandwidth: float) -> Floats:
    """Return Gaussian kernel densities of weighted samples, shapes (..., n), on a grid: (..., g).

    What is not finite keeps its weight and appears nowhere: the area under the curve is the share
    of the finite values.
    """
    # Densities at the centres of the kernel's own cells
    ends = grid[[0, -1]]
    # Half of the grid's step, so that a narrower curve could not be drawn anyway.
    smallest = 2e-3 * float(np.ptp(ends))
    kernel = GaussianKDE(max(bandwidth, smallest))
    cells = kernel.cells(ends, np.array([0.5, 0.5]))
    centers = cells.centers
    rows = np.broadcast_to(values, weights.shape)
    found = cells.density(rows, weights)[..., : centers.size]

    # Linear between them
    at = np.searchsorted(centers, grid) - 1
    at = np.clip(at, 0, centers.size - 2)
    left = found[..., at]
    right = found[..., at + 1]
    widths = np.diff(centers)
    share = (grid - centers[at]) / widths[at]
    between = left * (1 - share) + right * share
    return np.asarray(np.maximum(between, 0.0))


def bounded_density(draws: Floats, grid: Floats) -> Floats:
    """Return the density of draws, shape (n,), on a grid, without a dip at the ends of their range.

    Draws are mirrored at the smallest and the largest, which matters where a bound of the support
    cuts the density; outside their range it is zero. Draws that are all the same have none: NaN.
    """
    weights = np.full(draws.size, 1 / draws.size)
    bandwidth = silverman(draws, weights)
    if not bandwidth > 0:
        return np.full(grid.shape, np.nan)

    # Mirrored draws have their own weight: the area within the range is one
    low = float(draws.min())
    high = float(draws.max())
    at_low = 2 * low - draws
    at_high = 2 * high - draws
    mirrored = np.concatenate([draws, at_low, at_high])
    found = densities(mirrored, np.tile(weights, 3), grid, bandwidth)
    inside = (grid >= low) & (grid <= high)
    return np.where(inside, found, 0.0)


def distribution_functions(values: Floats, weights: Floats, grid: Floats) -> Floats:
    """Return the weight of values, shape (P, n), not above each point of a grid: (P, g)."""
    return np.ascontiguousarray(distribution_function(values, weights, grid))


def pointwise_band(curves: Floats, prob: float) -> tuple[Floats, Floats]:
    """Return the sides between which the share ``prob`` of curves, (P, g), lies at each point."""
    low, high = np.quantile(curves, central_levels(prob), axis=0)
    return low, high


def central_levels(prob: float) -> tuple[float, float]:
    """Return the levels of the two quantiles that hold the share ``prob`` between them."""
    return (1 - prob) / 2, (1 + prob) / 2


def central_range(values: Floats, weights: Floats, tail: float) -> tuple[float, float]:
    """Return the range between quantiles, at ``tail`` and ``1 - tail``, of most of the samples.

    Values and weights have shape (P, n); what is not finite is left out.
    """
    lows, highs = [], []
    for row, w in _finite_samples(values, weights):
        lows.append(quantile(row, w, tail))
        highs.append(quantile(row, w, 1 - tail))
    # A tenth of the populations need not fit on the axis, on each side.
    low = np.quantile(lows, 0.1)
    high = np.quantile(highs, 0.9)
    return float(low), float(high)


def histogram(observed: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return the corners of a histogram's bars; their area is the share of finite values."""
    finite = np.isfinite(observed)
    values = observed[finite]
    w = weights[finite]
    area = w.sum()
    if not np.ptp(values) > 0:
        return _one_bar(values[0], area)
    cells = Histogram().cells(values, w / area)
    heights = cells.density(values, w)[:-2]  # without what is below and above
    half = cells.widths[0] / 2
    left = cells.centers - half
    end = cells.centers[-1] + half
    right = np.append(left[1:], end)

    # Up at the left of each bar, down at its right
    zero = np.zeros(heights.size)
    x = np.column_stack([left, left, right, right])
    y = np.column_stack([zero, heights, heights, zero])
    return x.ravel(), y.ravel()


def _one_bar(middle: float, area: float) -> tuple[Floats, Floats]:
    """Return the corners of a bar around equal values, as wide as a fiftieth of them."""
    half = max(abs(middle), 1.0) / 100
    height = area / (2 * half)
    left = middle - half
    right = middle + half
    x = np.array([left, left, right, right])
    return x, np.array([0.0, height, height, 0.0])


def staircase(observed: Floats, weights: Floats, low: float, high: float) -> tuple[Floats, Floats]:
    """Return the corners of the distribution function of weighted values from low to high."""
    order = np.argsort(observed, kind="stable")
    values = observed[order]
    finite = np.isfinite(values)
    heights = cumulated(weights, order)[np.append(True, finite)]
    return steps(values[finite], heights, low, high)


def steps(values: Floats, heights: Floats, low: float, high: float) -> tuple[Floats, Floats]:
    """Return the corners of a step function from low to high, which steps at sorted values.

    It has one height more than values: the first is that before the first value.
    """
    twice = np.repeat(values, 2)
    x = np.concatenate([[low], twice, [high]])
    return x, np.repeat(heights, 2)
