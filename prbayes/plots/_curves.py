"""Curves behind the pictures, as numbers: densities, distribution functions, bands, ticks of logarithms."""

from __future__ import annotations

import numpy as np

from prbayes._checks import Floats
from prbayes._weighted import cumulated, distribution_function, quantile
from prbayes.metrics.density import GaussianKDE, Histogram, silverman


def typical_bandwidth(values: Floats, weights: Floats) -> float:
    """Return the median of Silverman's bandwidths of weighted samples, shapes (P, n), leaving out what is not finite.

    The effective number of values is that of the weights, so that uneven weights are smoothed more.
    """
    found = []
    for row, w in zip(np.broadcast_to(values, weights.shape), weights, strict=True):
        used = np.isfinite(row) & (w > 0)
        if used.any():
            found.append(silverman(row[used], w[used] / w[used].sum()))
    return float(np.median(found)) if found else 0.0


def densities(values: Floats, weights: Floats, grid: Floats, bandwidth: float) -> Floats:
    """Return Gaussian kernel densities of weighted samples, shapes (..., n), on a grid, shape (g,): (..., g).

    What is not finite keeps its weight and appears nowhere: the area under the curve is the share of the rest.
    """
    ends = np.array([grid[0], grid[-1]])
    # Grids of kernels have a limited number of nodes.
    cells = GaussianKDE(max(bandwidth, 2e-3 * float(np.ptp(ends)))).cells(ends, np.array([0.5, 0.5]))
    found = cells.density(np.broadcast_to(values, weights.shape), weights)[..., : cells.centers.size]
    at = np.clip(np.searchsorted(cells.centers, grid) - 1, 0, cells.centers.size - 2)
    part = (grid - cells.centers[at]) / np.diff(cells.centers)[at]
    return np.asarray(np.maximum(found[..., at] * (1 - part) + found[..., at + 1] * part, 0.0))


def bounded_density(draws: Floats, grid: Floats) -> Floats:
    """Return the density of draws, shape (n,), on a grid, zero outside their range and without a dip at its ends.

    Draws are mirrored at the smallest and the largest, which matters where a bound of the support cuts the density.
    """
    low, high = float(draws.min()), float(draws.max())
    mirrored = np.concatenate([draws, 2 * low - draws, 2 * high - draws])
    h = silverman(draws, np.full(draws.size, 1 / draws.size))
    if not h > 0:
        return np.full(grid.shape, np.nan)
    found = densities(mirrored, np.full(mirrored.size, 1 / draws.size), grid, h)
    return np.where((grid >= low) & (grid <= high), found, 0.0)


def distribution_functions(values: Floats, weights: Floats, grid: Floats) -> Floats:
    """Return the weight of values not above each point of a grid: shapes (P, n), (P, n), (g,) -> (P, g)."""
    return np.ascontiguousarray(distribution_function(values, weights, grid))


def pointwise_band(curves: Floats, level: float) -> tuple[Floats, Floats]:
    """Return the two sides between which the share ``level`` of curves, shape (P, g), lies at each point."""
    low, high = np.quantile(curves, [(1 - level) / 2, (1 + level) / 2], axis=0)
    return low, high


def central_range(values: Floats, weights: Floats, tail: float) -> tuple[float, float]:
    """Return the quantiles at ``tail`` and ``1 - tail`` of weighted samples, (P, n), wide enough for most of them."""
    ends = []
    for row, w in zip(np.broadcast_to(values, weights.shape), weights, strict=True):
        used = np.isfinite(row) & (w > 0)
        if used.any():
            share = w[used] / w[used].sum()
            ends.append([quantile(row[used], share, p) for p in (tail, 1 - tail)])
    low, high = np.array(ends).T
    return float(np.quantile(low, 0.1)), float(np.quantile(high, 0.9))


def histogram(observed: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return the corners of a histogram's bars, one after the other; their area is the share of finite values."""
    finite = np.isfinite(observed)
    values, w = observed[finite], weights[finite]
    if not np.ptp(values) > 0:
        middle, half = values[0], max(abs(values[0]), 1.0) / 100
        return np.repeat([middle - half, middle + half], 2), np.array([0.0, 1.0, 1.0, 0.0]) * w.sum() / (2 * half)
    cells = Histogram().cells(values, w / w.sum())
    heights = cells.density(values, w)[:-2]
    half = cells.widths[0] / 2
    edges = np.append(cells.centers - half, cells.centers[-1] + half)
    x = np.stack([edges[:-1], edges[:-1], edges[1:], edges[1:]], axis=1).ravel()
    return x, (np.array([0.0, 1.0, 1.0, 0.0]) * heights[:, None]).ravel()


def staircase(observed: Floats, weights: Floats, low: float, high: float) -> tuple[Floats, Floats]:
    """Return the corners of the distribution function of weighted values, from ``low`` to ``high``."""
    order = np.argsort(observed, kind="stable")
    finite = np.isfinite(observed[order])
    values, height = observed[order][finite], cumulated(weights, order)[np.append(True, finite)]
    return np.concatenate([[low], np.repeat(values, 2), [high]]), np.repeat(height, 2)


def normal_density(x: Floats, mean: float, sd: float) -> Floats:
    """Return the density of a normal distribution."""
    return np.asarray(np.exp(-0.5 * ((x - mean) / sd) ** 2) / (sd * np.sqrt(2 * np.pi)))


def round_ticks(low: float, high: float, most: int = 5) -> tuple[list[float], list[str]]:
    """Return at most so many round numbers within a range, and their labels."""
    raw = max(high - low, 1e-300) / most
    power = 10.0 ** np.floor(np.log10(raw))
    step = next(f * power for f in (1.0, 2.0, 2.5, 5.0, 10.0) if f * power >= raw)
    found = step * np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1)
    return [float(x) for x in found], [f"{0.0 if abs(x) < step / 2 else x:.12g}" for x in found]


def spans_decades(values: Floats) -> bool:
    """Whether a logarithm shows values better: all positive, the largest more than twenty times the smallest."""
    finite = values[np.isfinite(values)]
    return bool(finite.size and finite.min() > 0 and finite.max() > 20 * finite.min())


def log_ticks(values: Floats) -> tuple[list[float], list[str]]:
    """Return positions, as base-10 logarithms, and labels of ticks for positive values: powers, or 1, 2, 5."""
    finite = values[np.isfinite(values) & (values > 0)]
    low, high = np.log10(finite.min()), np.log10(finite.max())
    powers = np.arange(np.floor(low), np.ceil(high) + 1)
    step = max(1, int(np.ceil(powers.size / 6)))
    factors = (1, 2, 5) if high - low < 2 else (1,)
    found = [(p + np.log10(f), f * 10.0**p) for p in powers[::step] for f in factors]
    slack = 0.05 * (high - low) + 1e-9
    kept = [(float(at), f"{value:g}") for at, value in found if low - slack <= at <= high + slack]
    return [at for at, _ in kept], [text for _, text in kept]
