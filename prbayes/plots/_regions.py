"""Highest-density regions of weighted points in a plane, as lines around them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from prbayes._validate import Floats


@dataclass(frozen=True, eq=False)
class White:
    """Coordinates in which weighted points have unit covariance."""

    center: Floats  # (2,)
    axes: Floats  # (2, 2): a column is a unit step along one of them

    @classmethod
    def of(cls, points: Floats, weights: Floats) -> White:
        """Return the coordinates of points, (n, 2), with weights of sum 1.

        The tails beyond 1% at either end are clipped: where responses diverge, a few specimens
        would decide the width.
        """
        clipped = []
        for column in points.T:
            order = np.argsort(column, kind="stable")
            low, high = np.searchsorted(np.cumsum(weights[order]), [0.01, 0.99])
            ends = column[order[[low, min(high, column.size - 1)]]]
            clipped.append(np.clip(column, ends[0], ends[1]))
        points = np.column_stack(clipped)
        center = weights @ points
        deviations = points - center
        spread = np.sqrt(weights @ deviations**2)
        unit = np.where(spread > 0, spread, 1.0)
        scaled = deviations / unit
        covariance = scaled.T @ (weights[:, None] * scaled)
        variances, vectors = np.linalg.eigh(covariance)
        # Points on a line have a region too, thinner than its outline.
        least = max(float(variances[-1]), 1e-300) * 1e-3**2
        return cls(center, unit[:, None] * vectors * np.sqrt(np.maximum(variances, least)))

    def of_points(self, points: Floats) -> Floats:
        """Return coordinates of points, (n, 2)."""
        return np.linalg.solve(self.axes, (points - self.center).T).T

    def points(self, coordinates: Floats) -> Floats:
        """Return the points of coordinates, (n, 2)."""
        return self.center + coordinates @ self.axes.T


def outlines(points: Floats, weights: Floats, probs: tuple[float, ...]) -> list[Floats]:
    """Return for each probability the outline of the smallest region that contains it.

    The density is that of a Gaussian kernel along the points' principal axes, by Scott's rule for
    the effective number of points. The kernel's inflation of the spread is removed: the regions of
    a normal population are its ellipses.

    Parameters
    ----------
    points : ndarray, shape (n, 2)
        Finite.
    weights : ndarray, shape (n,)
    probs : tuple of float

    Returns
    -------
    list of ndarray, shape (2, k)
        Lines one after the other, with NaN between them.
    """
    w = weights / weights.sum()
    white = White.of(points, w)
    # Cells on a plane of 4.2 standard deviations: 2e-4 of a normal population are beyond. A cell is
    # a fifth of the narrowest kernel for which the plane matters.
    edges = np.linspace(-4.2, 4.2, 161)
    x, y = white.of_points(points).T
    masses, *_ = np.histogram2d(x, y, bins=[edges, edges], weights=w)
    bandwidth = np.sum(w**2) ** (1 / 6)  # n ** (-1 / 6)
    density = gaussian_filter(masses, bandwidth / (edges[1] - edges[0]), mode="constant")

    deflation = 1 / np.sqrt(1 + bandwidth**2)
    middles = (edges[:-1] + edges[1:]) / 2
    joined = []
    for prob in probs:
        lines = _contour(middles, density, _threshold(density, prob))
        joined.append(_joined([white.points(deflation * line) for line in lines]))
    return joined


def _threshold(density: Floats, prob: float) -> float:
    """Return the density above which a probability lies, of a density that sums to at most one."""
    descending = np.sort(density.ravel())[::-1]
    last = np.count_nonzero(descending) - 1
    return float(descending[min(np.searchsorted(np.cumsum(descending), prob), last)])


def _contour(middles: Floats, density: Floats, level: float) -> list[Floats]:
    """Return lines of one height, (k, 2) each, of a density over (x, y)."""
    from matplotlib.figure import Figure  # heavy, and only needed for pictures

    contours = Figure().add_subplot().contour(middles, middles, density.T, levels=[level])
    return [np.asarray(line) for line in contours.allsegs[0] if len(line) > 1]


def _joined(lines: list[Floats]) -> Floats:
    """Return lines, (k, 2) each, as one with gaps: (2, k)."""
    gap = np.full((1, 2), np.nan)
    parts = [part for line in lines for part in (line, gap)]
    return np.concatenate(parts[:-1]).T if parts else np.empty((2, 0))
