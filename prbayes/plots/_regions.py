"""Highest-density regions of weighted points in a plane, as lines around them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from prbayes._validate import Floats

# Cells along each axis of the plane; a cell is a fifth of the narrowest kernel that has them all
# within sight, and an outline looks smooth.
_CELLS = 160
# How far the plane reaches, in standard deviations of the points: 1.8e-4 of a normal population are
# beyond, and those of a longer tail are outside any region that is drawn.
_PLANE = 4.2
# Part of the largest spread that the narrowest one is taken for, so that points on a line have a
# region: thinner than the line it is drawn with.
_NARROWEST = 1e-3
# Part of a population, at either end, that does not tell how wide it is: where responses diverge, a
# few specimens would decide the kernel's width. A normal spread is then known to 3%.
_FAR_TAIL = 0.01


@dataclass(frozen=True, eq=False)
class White:
    """Coordinates in which weighted points have unit covariance."""

    center: Floats  # (2,)
    axes: Floats  # (2, 2): a column is a unit step along one of them

    @classmethod
    def of(cls, points: Floats, weights: Floats) -> White:
        """Return the coordinates of points, (n, 2), with weights of sum 1; without far tails."""
        points = _within(points, weights)
        center = weights @ points
        deviations = points - center
        spread = np.sqrt(weights @ deviations**2)
        unit = np.where(spread > 0, spread, 1.0)
        scaled = deviations / unit
        covariance = scaled.T @ (weights[:, None] * scaled)
        variances, vectors = np.linalg.eigh(covariance)
        largest = max(float(variances[-1]), 1e-300)
        least = largest * _NARROWEST**2
        steps = np.sqrt(np.maximum(variances, least))
        return cls(center, unit[:, None] * vectors * steps)

    def of_points(self, points: Floats) -> Floats:
        """Return coordinates of points, (n, 2)."""
        return np.linalg.solve(self.axes, (points - self.center).T).T

    def points(self, coordinates: Floats) -> Floats:
        """Return the points of coordinates, (n, 2)."""
        return self.center + coordinates @ self.axes.T


def _within(points: Floats, weights: Floats) -> Floats:
    """Return points with what is far out moved to where few are, in each coordinate."""
    moved = []
    for column in points.T:
        order = np.argsort(column, kind="stable")
        below = np.cumsum(weights[order])
        low, high = np.searchsorted(below, [_FAR_TAIL, 1 - _FAR_TAIL])
        ends = column[order[[low, min(high, column.size - 1)]]]
        moved.append(np.clip(column, ends[0], ends[1]))
    return np.column_stack(moved)


def outlines(points: Floats, weights: Floats, shares: tuple[float, ...]) -> list[Floats]:
    """Return for each share the outline of the smallest region that holds it.

    The density is that of a Gaussian kernel along the points' own principal axes, by Scott's rule
    for the effective number of points, whose inflation of their spread is taken back: of a normal
    population the regions are its ellipses.

    Parameters
    ----------
    points : ndarray, shape (n, 2)
        Finite.
    weights : ndarray, shape (n,)
    shares : tuple of float

    Returns
    -------
    list of ndarray, shape (2, k)
        Lines one after the other, with NaN between them.
    """
    w = weights / weights.sum()
    white = White.of(points, w)
    coordinates = white.of_points(points)

    # Weights in cells, smoothed
    edges = np.linspace(-_PLANE, _PLANE, _CELLS + 1)
    x, y = coordinates.T
    masses, *_ = np.histogram2d(x, y, bins=[edges, edges], weights=w)
    bandwidth = np.sum(w**2) ** (1 / 6)  # n ** (-1 / 6)
    step = edges[1] - edges[0]
    density = gaussian_filter(masses, bandwidth / step, mode="constant")

    shrunk = 1 / np.sqrt(1 + bandwidth**2)
    middles = (edges[:-1] + edges[1:]) / 2
    found = []
    for share in shares:
        lines = _contour(middles, density, _threshold(density, share))
        placed = [white.points(shrunk * line) for line in lines]
        found.append(_joined(placed))
    return found


def _threshold(density: Floats, share: float) -> float:
    """Return the density above which a share is, where all sums to one, or less on the plane."""
    # What is beyond the plane is thinner than all on it
    descending = np.sort(density.ravel())[::-1]
    total = np.cumsum(descending)
    last = np.count_nonzero(descending) - 1
    return float(descending[min(np.searchsorted(total, share), last)])


def _contour(middles: Floats, density: Floats, level: float) -> list[Floats]:
    """Return lines of one height, (k, 2) each, of a density over (x, y)."""
    from matplotlib.figure import Figure  # heavy, and only needed for pictures

    drawn = Figure().add_subplot().contour(middles, middles, density.T, levels=[level])
    return [np.asarray(line) for line in drawn.allsegs[0] if len(line) > 1]


def _joined(lines: list[Floats]) -> Floats:
    """Return lines, (k, 2) each, as one with gaps: (2, k)."""
    gap = np.full((1, 2), np.nan)
    parts = [part for line in lines for part in (line, gap)]
    return np.concatenate(parts[:-1]).T if parts else np.empty((2, 0))
