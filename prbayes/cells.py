"""Cells on which densities are compared: a grid for Gaussian kernels, and the bins of a histogram.

A density is linear in the weights of the sample, and on a grid it is smooth in the sample's values; both
derivatives are given.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from prbayes._arrays import Floats

_CHUNK = 1 << 16  # sample values binned at a time: bounds memory, stays in cache
# The four cubic B-splines that reach a point at fraction t between two nodes: coefficients of 1, t, t^2, t^3.
_SPLINE = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6

NDArrayInt = NDArray[np.intp]
NDArrayBool = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Cells(ABC):
    """Cells on which densities are compared, the last two for the mass below and above all others.

    Attributes
    ----------
    widths : ndarray, shape (m,)
        Length that each cell stands for; the outer two are as long as documented by the estimator.
    centers : ndarray, shape (m - 2,)
        Positions of the inner cells, in units of the response.
    smooth : bool
        Whether the density has derivatives with respect to the sample's values.
    """

    widths: Floats
    centers: Floats
    smooth: bool

    @abstractmethod
    def density(self, sample: Floats, weights: Floats) -> Floats:
        """Return the density of weighted samples, shape (..., n) -> (..., m); NaN values count nowhere."""

    def basis(self, sample: Floats) -> Floats:
        """Return A, shape (n, m), with ``density(sample, w) == w @ A``."""
        return self.density(sample[:, None], np.ones(1))

    @abstractmethod
    def reading(self, points: Floats, weights: Floats) -> Floats:
        """Return r, shape (..., m), such that ``r @ g`` is the weighted mean of g (given on the cells) at the points.

        The points have shape (n,), their weights (..., n).
        """

    @abstractmethod
    def value(self, sample: Floats, cotangent: Floats) -> Floats:
        """Return the derivatives of ``(density(sample, weights) * cotangent).sum()`` for the weights."""

    @abstractmethod
    def slope(self, sample: Floats, cotangent: Floats) -> Floats:
        """Return its derivatives for the sample where all weights are one."""


@dataclass(frozen=True, eq=False)
class KernelCells(Cells):
    """Nodes of a regular grid; mass outside counts as one tight cluster on either side, at its most conspicuous."""

    bandwidth: float
    step: float
    kernel: Floats

    def _locate(self, sample: Floats, rows: int = 1) -> tuple[NDArrayInt, Floats, NDArrayBool | None]:
        """Return the node below each value, the fraction of a step beyond it, and which are off the grid, if any.

        Values off the grid, and NaN, are said to be at the first node, where no value of the grid is. With several
        rows, each has its own nodes.
        """
        with np.errstate(invalid="ignore"):
            t = np.multiply(sample, 1 / self.step)
            t -= self.centers[0] / self.step
            off = None
            if not (t.min(initial=1) >= 1 and t.max(initial=1) < self.centers.size - 2):
                off = ~((t >= 1) & (t < self.centers.size - 2))
                t[off] = 0.0
        node = t.astype(np.intp)
        t -= node
        if rows > 1:
            node += self.centers.size * np.arange(rows)[:, None]
        return node, t, off

    def _below(self, sample: Floats) -> NDArrayBool:
        return np.asarray(sample < self.centers[0] + self.step)  # of those off the grid

    def density(self, sample: Floats, weights: Floats) -> Floats:
        """Return densities at the nodes, then mass below and above divided by the width of a cluster."""
        batch, n, g = sample.shape[:-1], sample.shape[-1], self.centers.size
        rows = int(np.prod(batch, dtype=int))
        flat = sample.reshape(rows, n)
        equal = bool(weights.size) and weights.min() == weights.max()
        w = np.broadcast_to(weights, (*batch, n)).reshape(rows, n) if not equal else None
        counts = np.empty((rows, g))
        outside = np.zeros((rows, 2))
        rows_at_once = max(1, min(_CHUNK // n, 4 * _CHUNK // g))
        for r in range(0, rows, rows_at_once):
            moments = np.zeros((4, len(counts[r : r + rows_at_once]), g))
            for i in range(0, n, _CHUNK):
                block = np.s_[r : r + rows_at_once, i : i + _CHUNK]
                moments += self._moments(flat[block], None if w is None else w[block], outside[r : r + rows_at_once])
            counts[r : r + rows_at_once] = self._counted(moments)
        if equal:
            counts *= weights.flat[0]
            outside *= weights.flat[0]
        grid = self._smooth(counts)
        return np.concatenate([grid, outside / self.widths[-1]], axis=-1).reshape(*batch, g + 2)

    def _smooth(self, counts: Floats) -> Floats:
        from scipy.ndimage import convolve1d  # takes longer to import than the whole package

        return np.asarray(convolve1d(counts, self.kernel, axis=-1, mode="constant"))

    def _moments(self, sample: Floats, weights: Floats | None, outside: Floats) -> Floats:
        """Return the sums of 1, t, t^2, t^3 beyond each node, shape (4, rows, g), without weights of one each."""
        rows, g = len(sample), self.centers.size
        node, t, off = self._locate(sample, rows)
        if off is not None:
            each = np.ones_like(sample) if weights is None else weights
            off &= ~np.isnan(sample)
            below = off & self._below(sample)
            outside[:, 0] += np.where(below, each, 0.0).sum(axis=-1)
            outside[:, 1] += np.where(off & ~below, each, 0.0).sum(axis=-1)
        at, fraction, size = node.ravel(), t.ravel(), rows * g
        w = None if weights is None else weights.ravel()
        sums = [np.bincount(at, w, size)]
        power = fraction if w is None else fraction * w
        for _ in range(3):
            sums.append(np.bincount(at, power, size))
            power = power * fraction
        found = np.array(sums, dtype=np.float64).reshape(4, rows, g)
        found[:, :, 0] = 0.0
        return found

    def _counted(self, moments: Floats) -> Floats:
        """Return the counts at the nodes, shape (rows, g), with cubic B-spline weights."""
        parts = np.tensordot(_SPLINE, moments, axes=1)
        counts = np.zeros(parts.shape[1:])
        for k, part in enumerate(parts):
            counts[:, max(0, k - 1) : counts.shape[1] + min(0, k - 1)] += part[
                :, max(0, 1 - k) : part.shape[1] + min(0, 1 - k)
            ]
        return counts

    def reading(self, points: Floats, weights: Floats) -> Floats:
        """Return cubic convolution weights (Keys 1981), which interpolate and are exact for parabolas."""
        node, t, off = self._locate(points)
        inside = True if off is None else ~off
        node = np.maximum(node, 1)
        s = 1 - t
        keys = (-t * s**2 / 2, 1 - 2.5 * t**2 + 1.5 * t**3, 1 - 2.5 * s**2 + 1.5 * s**3, -s * t**2 / 2)
        each = np.zeros((points.size, self.widths.size))
        for k, b in enumerate(keys):
            each[np.arange(points.size), node - 1 + k] += np.where(inside, b, 0.0)
        flat = weights.reshape(-1, points.size) @ each
        return flat.reshape(*weights.shape[:-1], each.shape[1])

    def value(self, sample: Floats, cotangent: Floats) -> Floats:
        """Return the smoothed cotangent at the sample; the smoothing kernel is its own transpose."""
        return self._interpolated(sample, cotangent, _SPLINE, cotangent[..., -2:] / self.widths[-1])

    def slope(self, sample: Floats, cotangent: Floats) -> Floats:
        """Return the derivative of the smoothed cotangent at the sample."""
        return self._interpolated(sample, cotangent, _SPLINE[:, 1:] * [1, 2, 3] / self.step)

    def _interpolated(self, sample: Floats, cotangent: Floats, spline: Floats, outer: Floats | None = None) -> Floats:
        """Evaluate the splines whose coefficients are a smoothed cotangent's; ``outer`` is for values off the grid."""
        batch = np.broadcast_shapes(sample.shape[:-1], cotangent.shape[:-1])
        rows, n, g = int(np.prod(batch, dtype=int)), sample.shape[-1], self.centers.size
        values = np.broadcast_to(sample, (*batch, n)).reshape(rows, n)
        c = np.broadcast_to(self._smooth(cotangent[..., :-2]), (*batch, g)).reshape(rows, g)
        near = np.pad(c, [(0, 0), (1, 2)])
        powers = np.tensordot(spline.T, np.array([near[:, k : k + g] for k in range(4)]), axes=1)
        powers[:, :, 0] = 0.0
        out = np.empty((rows, n))
        for r in range(rows):
            edge = None if outer is None else np.broadcast_to(outer, (*batch, 2)).reshape(rows, 2)[r]
            for i in range(0, n, _CHUNK):
                part = values[r, i : i + _CHUNK]
                node, t, off = self._locate(part)
                total = powers[-1, r].take(node)
                for p in powers[-2::-1, r]:
                    total *= t
                    total += p.take(node)
                if off is not None and edge is not None:
                    total[off] = np.where(self._below(part[off]), edge[0], edge[1])
                    total[np.isnan(part)] = 0.0
                out[r, i : i + _CHUNK] = total
        return out.reshape(*batch, n)


@dataclass(frozen=True, eq=False)
class BinCells(Cells):
    """Equal bins, closed on the left, the last one on both sides."""

    def density(self, sample: Floats, weights: Floats) -> Floats:
        """Return the normalised frequency per unit length of each bin, then of the outer two."""
        bins, width = self.centers.size, self.widths[0]
        batch, n = sample.shape[:-1], sample.shape[-1]
        rows = int(np.prod(batch, dtype=int))
        cell = self._cell(sample).reshape(rows, n) + (bins + 3) * np.arange(rows)[:, None]
        w = np.broadcast_to(weights, (*batch, n)).reshape(rows, n)
        counts = np.bincount(cell.ravel(), w.ravel(), rows * (bins + 3)).reshape(*batch, bins + 3)
        return cast(Floats, counts[..., :-1] / width)

    def reading(self, points: Floats, weights: Floats) -> Floats:
        """Return the weight of the points in each bin."""
        return np.asarray(weights @ self.basis(points) * self.widths)

    def _cell(self, sample: Floats) -> NDArrayInt:
        """Return cell numbers: bins, then below, above, and NaN."""
        bins, width = self.centers.size, self.widths[0]
        low = self.centers[0] - width / 2
        position = (sample - low) / width
        # The upper edge belongs to the last bin, also after rounding in low + bins * width.
        slack = 1e-9
        inner = np.clip(np.where(np.isfinite(position), position, 0.0), 0, bins - 1).astype(np.intp)
        outer = np.where(position < -slack, bins, np.where(position > bins + slack, bins + 1, inner))
        return np.where(np.isnan(position), bins + 2, outer)

    def value(self, sample: Floats, cotangent: Floats) -> Floats:
        """Return the cell's cotangent."""
        padded = np.concatenate([cotangent, np.zeros_like(cotangent[..., :1])], axis=-1) / self.widths[0]
        return np.take_along_axis(padded, self._cell(sample), axis=-1)

    def slope(self, sample: Floats, cotangent: Floats) -> Floats:
        """Return zero: a step function."""
        return np.zeros(np.broadcast_shapes(sample.shape[:-1], cotangent.shape[:-1]) + sample.shape[-1:])
