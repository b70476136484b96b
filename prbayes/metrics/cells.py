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

from prbayes._checks import Floats
from prbayes.metrics._loops import SPLINE, count, read, smooth

NDArrayInt = NDArray[np.intp]


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

    @property
    def _low(self) -> float:
        return float(self.centers[0] / self.step)

    def density(self, sample: Floats, weights: Floats) -> Floats:
        """Return densities at the nodes, then mass below and above divided by the width of a cluster."""
        batch, n, g = sample.shape[:-1], sample.shape[-1], self.centers.size
        rows = int(np.prod(batch, dtype=int))
        equal = bool(weights.size) and (not any(weights.strides) or weights.min() == weights.max())
        w = weights.ravel()[:1] if equal else np.broadcast_to(weights, (*batch, n)).ravel()
        counts, outside = np.zeros((rows, g)), np.zeros((rows, 2))
        flat = np.ascontiguousarray(sample, dtype=np.float64).reshape(rows, n)
        count(flat, w, equal, self._low, 1 / self.step, counts, outside)
        grid = self._smooth(counts)
        return np.concatenate([grid, outside / self.widths[-1]], axis=-1).reshape(*batch, g + 2)

    def _smooth(self, values: Floats) -> Floats:
        rows = np.ascontiguousarray(values).reshape(-1, self.centers.size)
        out = np.zeros_like(rows)
        smooth(rows, self.kernel, out)
        return out.reshape(values.shape)

    def reading(self, points: Floats, weights: Floats) -> Floats:
        """Return cubic convolution weights (Keys 1981), which interpolate and are exact for parabolas."""
        t = points / self.step - self._low
        inside = (t >= 1) & (t < self.centers.size - 2)
        t = np.where(inside, t, 1.0)
        node = t.astype(np.intp)
        t -= node
        s = 1 - t
        keys = (-t * s**2 / 2, 1 - 2.5 * t**2 + 1.5 * t**3, 1 - 2.5 * s**2 + 1.5 * s**3, -s * t**2 / 2)
        each = np.zeros((points.size, self.widths.size))
        for k, b in enumerate(keys):
            each[np.arange(points.size), node - 1 + k] += np.where(inside, b, 0.0)
        flat = weights.reshape(-1, points.size) @ each
        return flat.reshape(*weights.shape[:-1], each.shape[1])

    def value(self, sample: Floats, cotangent: Floats) -> Floats:
        """Return the smoothed cotangent at the sample; the smoothing kernel is its own transpose."""
        return self._interpolated(sample, cotangent, SPLINE, cotangent[..., -2:] / self.widths[-1])

    def slope(self, sample: Floats, cotangent: Floats) -> Floats:
        """Return the derivative of the smoothed cotangent at the sample."""
        slopes = np.pad(SPLINE[:, 1:] * [1, 2, 3] / self.step, [(0, 0), (0, 1)])
        return self._interpolated(sample, cotangent, slopes, np.zeros(2))

    def _interpolated(self, sample: Floats, cotangent: Floats, spline: Floats, outer: Floats) -> Floats:
        """Evaluate the splines whose coefficients are a smoothed cotangent's; ``outer`` is for values off the grid."""
        batch = np.broadcast_shapes(sample.shape[:-1], cotangent.shape[:-1])
        rows, n, g = int(np.prod(batch, dtype=int)), sample.shape[-1], self.centers.size
        values = sample if sample.ndim == 1 else np.broadcast_to(sample, (*batch, n))
        c = np.broadcast_to(self._smooth(cotangent[..., :-2]), (*batch, g)).reshape(rows, g)
        near = np.pad(c, [(0, 0), (1, 2)])
        powers = np.stack([near[:, k : k + g] for k in range(4)], axis=-1) @ spline
        edge = np.ascontiguousarray(np.broadcast_to(outer, (*batch, 2)).reshape(rows, 2))
        out = np.empty((rows, n))
        flat = np.ascontiguousarray(values, dtype=np.float64).reshape(-1, n)
        read(flat, powers, edge, self._low, 1 / self.step, out)
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
