"""Curves of weighted samples: densities, distributions; outlines in a plane."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module

import numpy as np
from scipy.ndimage import gaussian_filter

from prbayes._stats import cumulated, positive_scale, quantile
from prbayes._validate import ArrayPair, Arrays, Floats
from prbayes.metrics.density import GaussianKDE, silverman

# number of points of a curve; a step is one or two pixels of a panel
GRID_POINTS = 257


def _finite_samples(values: Floats, weights: Floats) -> Iterator[ArrayPair]:
    """Yield finite values with positive weight, and weights of sum one, of each sample, (P, n)."""
    rows = np.broadcast_to(values, weights.shape)
    for row, w in zip(rows, weights, strict=True):
        used = np.isfinite(row) & (w > 0)
        if used.any():
            yield row[used], w[used] / w[used].sum()


def smooth_densities(values: Floats, weights: Floats, grid: Floats) -> Floats:
    """Return kernel densities, (P, g), of weighted samples, (P, n), with one bandwidth.

    It is the median of Silverman's bandwidths of the first 40 samples.
    """
    samples = _finite_samples(values[:40], weights[:40])
    bandwidths = [silverman(row, w) for row, w in samples]
    bandwidth = float(np.median(bandwidths)) if bandwidths else 0.0
    return densities(values, weights, grid, bandwidth)


def measured_density(observed: Floats, weights: Floats, grid: Floats) -> Floats:
    """Return the density of measured values, (n,), on a grid, (g,), by the normal reference rule.

    Its bandwidth is 1.06 standard deviations times n^(-1/5) (Scott, Multivariate Density
    Estimation, 1992): by a robust spread as in Silverman's, a few close values make a high peak.
    """
    ((values, w),) = _finite_samples(observed[None], weights[None])
    deviation = np.sqrt(w @ (values - w @ values) ** 2)
    bandwidth = 1.06 * deviation * np.sum(w**2) ** 0.2
    return densities(observed, weights, grid, float(bandwidth))


def densities(values: Floats, weights: Floats, grid: Floats, bandwidth: float) -> Floats:
    """Return kernel densities, (..., g), of samples, (..., n); the area is the finite share."""
    # The kernel gives densities at the centres of its cells. The bandwidth is at least half of the
    # grid's step, because a narrower peak would not be visible.
    ends = grid[[0, -1]]
    kernel = GaussianKDE(max(bandwidth, 2e-3 * float(np.ptp(ends))))
    cells = kernel.cells(ends, np.array([0.5, 0.5]))
    centers = cells.centers
    rows = np.broadcast_to(values, weights.shape)
    heights = cells.density(rows, weights)[..., : centers.size]

    # Interpolate linearly between the centres.
    at = np.clip(np.searchsorted(centers, grid) - 1, 0, centers.size - 2)
    fraction = (grid - centers[at]) / np.diff(centers)[at]
    between = heights[..., at] * (1 - fraction) + heights[..., at + 1] * fraction
    return np.maximum(between, 0.0)


def bounded_density(draws: Floats, grid: Floats) -> Floats:
    """Return ArviZ's kernel density of draws, (n,), on a grid; NaN if all draws are equal."""
    if not np.ptp(draws) > 0:
        return np.full(grid.shape, np.nan)
    stats = import_module("arviz_stats")  # heavy, and only needed for pictures
    x, density, _ = stats.base.array_stats.kde(draws)
    return np.asarray(np.interp(grid, x, density, left=0.0, right=0.0))


def pointwise_band(curves: Floats, prob: float) -> ArrayPair:
    """Return the sides between which the share ``prob`` of curves, (P, g), lies at each point."""
    low, high = np.quantile(curves, central_levels(prob), axis=0)
    return low, high


def central_levels(prob: float) -> tuple[float, float]:
    """Return the levels of the two quantiles with the probability ``prob`` between them."""
    return (1 - prob) / 2, (1 + prob) / 2


def central_range(values: Floats, weights: Floats, tail: float) -> tuple[float, float]:
    """Return a range that contains all but the tails of nine tenths of samples, (P, n).

    A tail has the probability ``tail`` at either end.
    """
    samples = list(_finite_samples(values, weights))
    low = np.quantile([quantile(row, w, tail) for row, w in samples], 0.1)
    high = np.quantile([quantile(row, w, 1 - tail) for row, w in samples], 0.9)
    return float(low), float(high)


def axis_range(
    observed: Floats,
    calibrated: tuple[float, float],
    earlier: tuple[float, float] | None,
    margin: float = 0.03,
) -> tuple[float, float]:
    """Return the range of an axis for the data, the calibrated and the earlier population.

    The earlier population widens the range of the others by at most half at either end.
    """
    finite = observed[np.isfinite(observed)]
    low = min(calibrated[0], float(finite.min(initial=np.inf)))
    high = max(calibrated[1], float(finite.max(initial=-np.inf)))
    if earlier is not None:
        room = 0.5 * (high - low)
        first = max(earlier[0], low - room)
        last = min(earlier[1], high + room)
        low = min(low, first)
        high = max(high, last)
    width = margin * (high - low) or 0.01 * max(abs(low), 1.0)
    return low - width, high + width


def staircase(observed: Floats, weights: Floats, low: float, high: float) -> ArrayPair:
    """Return the corners of the distribution function of weighted values from low to high."""
    order = np.argsort(observed, kind="stable")
    values = observed[order]
    finite = np.isfinite(values)
    heights = cumulated(weights, order)[np.append(True, finite)]
    x = np.concatenate([[low], np.repeat(values[finite], 2), [high]])
    return x, np.repeat(heights, 2)


# -- highest-density regions in a plane ------------------------------------------------------


def outlines(points: Floats, weights: Floats, probs: tuple[float, ...]) -> list[Floats]:
    """Return for each probability the outline, (2, k), of the smallest region that contains it."""
    from matplotlib.figure import Figure  # heavy, and only needed for pictures

    # Coordinates in which the points have unit covariance: a column of ``axes`` is a unit step.
    # The tails beyond 1% at either end are clipped: where responses diverge, a few specimens
    # would decide the width.
    w = weights / weights.sum()
    clipped = []
    for column in points.T:
        order = np.argsort(column, kind="stable")
        low, high = np.searchsorted(np.cumsum(w[order]), [0.01, 0.99])
        ends = column[order[[low, min(high, column.size - 1)]]]
        clipped.append(np.clip(column, ends[0], ends[1]))
    central = np.column_stack(clipped)
    center = w @ central
    deviations = central - center
    spread = np.sqrt(w @ deviations**2)
    unit = positive_scale(spread)
    scaled = deviations / unit
    variances, vectors = np.linalg.eigh(scaled.T @ (w[:, None] * scaled))
    # Points on a line have no second axis. A short one gives them a region that is thinner than
    # its outline.
    least = max(float(variances[-1]), 1e-300) * 1e-3**2
    axes = unit[:, None] * vectors * np.sqrt(np.maximum(variances, least))
    x, y = np.linalg.solve(axes, (points - center).T)

    # A Gaussian kernel along the principal axes, by Scott's rule for the effective sample size.
    # The cells cover 4.2 standard deviations, which contain all but 2e-4 of a normal population. A
    # cell is a fifth of the narrowest kernel whose width is visible.
    edges = np.linspace(-4.2, 4.2, 161)
    masses, *_ = np.histogram2d(x, y, bins=[edges, edges], weights=w)
    bandwidth = np.sum(w**2) ** (1 / 6)  # n ** (-1 / 6)
    density = gaussian_filter(masses, bandwidth / (edges[1] - edges[0]), mode="constant")

    # A region is where the density exceeds the level above which the probability lies. The kernel
    # inflates the spread. The outlines are deflated by as much, so that the regions of a normal
    # population are its ellipses.
    descending = np.sort(density.ravel())[::-1]
    last = np.count_nonzero(descending) - 1
    middles = (edges[:-1] + edges[1:]) / 2
    deflation = 1 / np.sqrt(1 + bandwidth**2)
    joined = []
    for prob in probs:
        level = descending[min(np.searchsorted(np.cumsum(descending), prob), last)]
        contours = Figure().add_subplot().contour(middles, middles, density.T, levels=[level])
        lines = [deflation * np.asarray(line) for line in contours.allsegs[0] if len(line) > 1]
        joined.append(with_gaps([center + line @ axes.T for line in lines]))
    return joined


def with_gaps(lines: Arrays) -> Floats:
    """Join lines, (k, 2) each, into one, (2, k), with NaN between them."""
    gap = np.full((1, 2), np.nan)
    parts = [part for line in lines for part in (line, gap)]
    return np.concatenate(parts[:-1]).T if parts else np.empty((2, 0))
