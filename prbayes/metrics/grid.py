"""Cells on which densities are compared: a grid for Gaussian kernels, and the bins of a histogram.

A density is linear in the weights of the sample, and on a grid it is smooth in the sample's values;
both derivatives are given.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, update_wrapper
from typing import cast

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import AT_ONCE, Floats

# The four uniform cubic B-splines that reach a point at fraction t between two nodes: coefficients
# of 1, t, t^2, t^3 (any textbook on splines).
_SPLINE = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6


def product(weights: Floats, matrix: Floats) -> Floats:
    """Return weights @ matrix, shapes (..., n), (n, m) -> (..., m), as one product of two matrices.

    NumPy would multiply a batch of vectors one after the other, many times slower.
    """
    *batch, n = weights.shape
    m = matrix.shape[-1]
    rows = weights.reshape(int(np.prod(batch, dtype=int)), n)
    found = rows @ matrix
    return found.reshape(*batch, m)


@dataclass(frozen=True, eq=False)
class Cells(ABC):
    """Cells on which densities are compared, the last two for the mass below and above all else."""

    # (m,): length that each cell stands for; the outer two are as long as documented by the
    # estimator.
    widths: Floats
    centers: Floats  # (m - 2,): positions of the inner cells, in units of the response
    smooth: bool  # whether the density has derivatives with respect to the sample's values

    @abstractmethod
    def density(self, sample: Floats, weights: Floats) -> Floats:
        """Return the density of weighted samples, (..., n) -> (..., m); NaN counts nowhere."""

    def basis(self, sample: Floats) -> Floats:
        """Return A, shape (n, m), with ``density(sample, w) == w @ A``."""
        return self.density(sample[:, None], np.ones(1))

    def reading(self, points: Floats, weights: Floats) -> Floats:
        """Return r such that ``r @ g`` is the weighted mean at points of g, given on the cells.

        Shapes (n,), (..., n) -> (..., m).
        """
        # A matrix of points by cells is held for some points at a time.
        some = max(1, AT_ONCE // self.widths.size)
        total = self._reading(points[:some], weights[..., :some])
        for first in range(some, points.size, some):
            part = slice(first, first + some)
            total = total + self._reading(points[part], weights[..., part])
        return total

    @abstractmethod
    def _reading(self, points: Floats, weights: Floats) -> Floats:
        """Return the same for some of the points."""

    @abstractmethod
    def value(self, sample: Floats, cotangent: Floats) -> Floats:
        """Return the derivatives of a sum over the density, for the weights.

        The sum is ``(density(sample, weights) * cotangent).sum()``. Shapes (..., n), (..., m) ->
        (..., n), with as many leading axes in both.
        """

    @abstractmethod
    def slope(self, sample: Floats, cotangent: Floats) -> Floats:
        """Return the derivatives of the same sum for the sample, where all weights are one."""


@dataclass(frozen=True, eq=False)
class KernelCells(Cells):
    """Nodes of a regular grid; mass outside counts as one tight cluster on either side.

    The cluster is a single kernel, which is where that mass is most conspicuous. A value's kernel
    is divided between grid and cluster where the grid ends, so that all is smooth in the values
    there as well. The sample is binned on some nodes more than the grid has: those that kernels
    reach from.
    """

    bandwidth: float  # standard deviation of the kernel, in units of the response
    step: float  # distance of two nodes
    kernel: Floats  # (2 k + 1,): the kernel that smooths counts at nodes into densities

    @property
    def _low(self) -> float:
        """Return the position of the first node, in steps."""
        return float(self.centers[0] / self.step)

    @property
    def _before(self) -> int:
        """Return how many nodes before the first, and behind the last, values are binned on.

        From farther out a kernel reaches no node, whichever of four its spline brings it to.
        """
        return self.kernel.size // 2 + 2

    @cached_property
    def _beyond(self) -> Floats:
        """Return which part of a kernel at each node that values are binned on is off the grid.

        Below and above, shape (2, g + 2 before).
        """
        nodes = self.centers.size + 2 * self._before
        at = np.arange(nodes) - self._before
        # The mass of a kernel up to each of its nodes, and none before the first of them.
        up_to = np.cumsum(self.kernel * self.step)
        mass = np.concatenate([[0.0], up_to])
        half = self.kernel.size // 2
        off = np.clip(half - at, 0, mass.size - 1)
        below = mass[off]
        return np.stack([below, below[::-1]])

    def density(self, sample: Floats, weights: Floats) -> Floats:
        """Return densities at the nodes, then mass below and above divided by a cluster's width."""
        *batch, n = sample.shape
        rows = int(np.prod(batch, dtype=int))
        nodes = self.centers.size
        before = self._before
        # Equal weights, the usual case, are passed as a single number.
        equal = _are_equal(weights)
        each = weights if equal else np.broadcast_to(weights, sample.shape)
        each = each.ravel()
        # Bin the sample on the grid; values that all rows share are passed once.
        shared = not any(sample.strides[:-1])
        values = sample.reshape(rows, n)[:1] if shared else sample.reshape(rows, n)
        values = np.ascontiguousarray(values, dtype=np.float64)
        counts = np.zeros((rows, nodes + 2 * before))
        outside = np.zeros((rows, 2))
        count(values, each, equal, self._low, 1 / self.step, before, counts, outside)
        # Smooth what is binned, within the grid and beyond its ends.
        inner = np.zeros((rows, nodes))
        smooth(counts, self.kernel, -before, inner)
        for side, beyond in enumerate(self._beyond):
            reached = np.flatnonzero(beyond)
            part = slice(reached[0], reached[-1] + 1)
            outside[:, side] += (counts[:, part] * beyond[part]).sum(axis=-1)
        outer = outside / self.widths[-1]
        density = np.concatenate([inner, outer], axis=-1)
        return density.reshape(*batch, nodes + 2)

    def _reading(self, points: Floats, weights: Floats) -> Floats:
        """Return cubic convolution weights (Keys 1981), which are exact for parabolas.

        Points off the grid are read at the cell of the mass on their side.
        """
        # Where the points are: a node, and a fraction of a step beyond it.
        t = points / self.step - self._low
        last = self.centers.size - 2
        below = t < 1
        above = t >= last
        inside = (t >= 1) & (t < last)
        t = np.where(inside, t, 1.0)
        node = t.astype(np.intp)
        t -= node
        s = 1 - t
        # What the four nodes around a point contribute.
        keys = (
            -t * s**2 / 2,
            1 - 2.5 * t**2 + 1.5 * t**3,
            1 - 2.5 * s**2 + 1.5 * s**3,
            -s * t**2 / 2,
        )
        row = np.arange(points.size)
        each = np.zeros((points.size, self.widths.size))
        for k, share in enumerate(keys):
            at = node - 1 + k
            each[row, at] += np.where(inside, share, 0.0)
        each[below, -2] = 1.0
        each[above, -1] = 1.0
        return product(weights, each)

    def value(self, sample: Floats, cotangent: Floats) -> Floats:
        """Return the smoothed cotangent at the sample; the kernel is its own transpose."""
        outer = cotangent[..., -2:] / self.widths[-1]
        return self._interpolated(sample, cotangent, _SPLINE, outer)

    def slope(self, sample: Floats, cotangent: Floats) -> Floats:
        """Return the derivative of the smoothed cotangent at the sample."""
        powers = [1, 2, 3]
        derivatives = _SPLINE[:, 1:] * powers / self.step
        quadratics = np.pad(derivatives, [(0, 0), (0, 1)])
        constant = np.zeros(2)
        return self._interpolated(sample, cotangent, quadratics, constant)

    def _interpolated(
        self, sample: Floats, cotangent: Floats, spline: Floats, outer: Floats
    ) -> Floats:
        """Return at a sample the splines whose coefficients are a smoothed cotangent's.

        Parameters
        ----------
        sample : ndarray, shape (..., n)
        cotangent : ndarray, shape (..., g + 2)
        spline : ndarray, shape (4, 4)
            Coefficients of powers of the fraction of a step, for the four splines that reach a
            point.
        outer : ndarray, shape (..., 2)
            What values below and above the grid get.
        """
        batch = np.broadcast_shapes(sample.shape[:-1], cotangent.shape[:-1])
        rows = int(np.prod(batch, dtype=int))
        n = sample.shape[-1]
        smoothed = self._spread(cotangent)
        nodes = smoothed.shape[-1]
        smoothed = np.broadcast_to(smoothed, (*batch, nodes))
        cubics = _cubics(smoothed.reshape(rows, nodes), spline)
        # Values that all rows share are passed once.
        values = sample if sample.ndim == 1 else np.broadcast_to(sample, (*batch, n))
        values = np.ascontiguousarray(values, dtype=np.float64)
        values = values.reshape(-1, n)
        # Read the cubics at the values.
        ends = np.broadcast_to(outer, (*batch, 2))
        ends = np.ascontiguousarray(ends.reshape(rows, 2))
        out = np.empty((rows, n))
        read(values, cubics, ends, self._low, 1 / self.step, self._before, out)
        return out.reshape(*batch, n)

    def _spread(self, cotangent: Floats) -> Floats:
        """Return what a unit at each node that values are binned on adds to a sum over the density.

        The transpose of the smoothing, shapes (..., g + 2) -> (..., g + 2 before).
        """
        nodes = self.centers.size
        inner = np.ascontiguousarray(cotangent[..., :nodes])
        rows = inner.reshape(-1, nodes)
        spread = np.zeros((len(rows), nodes + 2 * self._before))
        smooth(rows, self.kernel, self._before, spread)
        outer = cotangent[..., -2:] / self.widths[-1]
        spread = spread.reshape(*cotangent.shape[:-1], -1)
        for side, beyond in enumerate(self._beyond):
            spread = spread + outer[..., side, None] * beyond
        return spread


def _cubics(coefficients: Floats, spline: Floats) -> Floats:
    """Return the cubic beyond each node, from the splines around: (rows, g) -> (rows, g, 4)."""
    nodes = coefficients.shape[1]
    padded = np.pad(coefficients, [(0, 0), (1, 2)])
    near = [padded[:, k : k + nodes] for k in range(4)]
    return np.stack(near, axis=-1) @ spline


def _are_equal(weights: Floats) -> bool:
    """Return whether there are weights, and all are the same number."""
    if weights.size == 0:
        return False
    broadcast = not any(weights.strides)
    return broadcast or bool(weights.min() == weights.max())


@dataclass(frozen=True, eq=False)
class BinCells(Cells):
    """Equal bins, closed on the left, the last one on both sides."""

    def density(self, sample: Floats, weights: Floats) -> Floats:
        """Return the normalised frequency per unit length of each bin, then of the outer two."""
        *batch, n = sample.shape
        rows = int(np.prod(batch, dtype=int))
        # Every row has cells of its own: the bins, below, above, and NaN.
        cells = self.centers.size + 3
        first = cells * np.arange(rows)
        cell = self._cell(sample).reshape(rows, n)
        cell = cell + first[:, None]
        # Count in all rows at once.
        w = np.broadcast_to(weights, sample.shape)
        counts = np.bincount(cell.ravel(), w.ravel(), rows * cells)
        counts = counts.reshape(*batch, cells)
        without_nan = counts[..., :-1]
        return cast(Floats, without_nan / self.widths[0])

    def _reading(self, points: Floats, weights: Floats) -> Floats:
        """Return the weight of the points in each bin."""
        density = weights @ self.basis(points)
        return np.asarray(density * self.widths)

    def _cell(self, sample: Floats) -> NDArray[np.intp]:
        """Return cell numbers: bins, then below, above, and NaN."""
        bins = self.centers.size
        below = bins
        above = bins + 1
        nowhere = bins + 2
        # Where the values are, in widths from the lower edge.
        width = self.widths[0]
        low = self.centers[0] - width / 2
        position = (sample - low) / width
        known = np.isfinite(position)
        finite = np.where(known, position, 0.0)
        # The upper edge belongs to the last bin, also after rounding in low + bins * width.
        inner = np.clip(finite, 0, bins - 1)
        cell = inner.astype(np.intp)
        # Edges are rounded to parts in 1e16 of their size, and there are some thousands at most.
        too_high = position > bins + 1e-9
        too_low = position < -1e-9
        cell = np.where(too_high, above, cell)
        cell = np.where(too_low, below, cell)
        return np.where(np.isnan(position), nowhere, cell)

    def value(self, sample: Floats, cotangent: Floats) -> Floats:
        """Return the cell's cotangent."""
        for_nan = np.zeros_like(cotangent[..., :1])
        padded = np.concatenate([cotangent, for_nan], axis=-1)
        per_width = padded / self.widths[0]
        return np.take_along_axis(per_width, self._cell(sample), axis=-1)

    def slope(self, sample: Floats, cotangent: Floats) -> Floats:
        """Return zero: a step function."""
        batch = np.broadcast_shapes(sample.shape[:-1], cotangent.shape[:-1])
        shape = (*batch, sample.shape[-1])
        return np.zeros(shape)


def compiled[**P](loop: Callable[P, None]) -> Callable[P, None]:
    """Compile at the first call, since Numba takes long to import; keep the result on disk."""

    @cache
    def compiled() -> Callable[P, None]:
        from numba import njit

        try:
            return njit(cache=True, nogil=True)(loop)
        except RuntimeError:  # there is no folder where it can be kept
            return njit(nogil=True)(loop)

    def call(*args: P.args, **kwargs: P.kwargs) -> None:
        compiled()(*args, **kwargs)

    return update_wrapper(call, loop)


@compiled
def count(
    sample: Floats,
    weights: Floats,
    equal: bool,
    low: float,
    inverse: float,
    before: int,
    counts: Floats,
    outside: Floats,
) -> None:
    """Add weights at the nodes of a grid, spread by cubic B-splines, and those outside it.

    Node k is at ``(low + k - before) / inverse``. The sample has shape (1 or rows, n), the counts
    (rows, g), ``outside`` (rows, 2); the weights are flat, and only the first counts if they are
    equal. NaN counts nowhere.
    """
    n = sample.shape[1]
    rows, g = counts.shape
    moments = np.zeros((g, 4))  # sums of 1, t, t^2, t^3 beyond each node
    for r in range(rows):
        values = sample[r % len(sample)]
        # Sum the powers of the fractions of all values beyond a node.
        for i in range(n):
            t = values[i] * inverse - low
            w = weights[0] if equal else weights[r * n + i]
            if 1 - before <= t < g - 2 - before:
                left = math.floor(t)
                t -= left
                for power in range(4):
                    moments[left + before, power] += w
                    w *= t
            elif t < 1 - before:
                outside[r, 0] += w
            elif t >= g - 2 - before:
                outside[r, 1] += w
        # Four splines reach these values: the nodes around them get their shares.
        for node in range(1, g - 2):
            m = moments[node]
            if m.any():
                for k in range(4):
                    for power in range(4):
                        counts[r, node - 1 + k] += _SPLINE[k, power] * m[power]
                m[:] = 0


@compiled
def smooth(values: Floats, kernel: Floats, first_at: int, out: Floats) -> None:
    """Add the convolution of rows, zero beyond their ends, with a kernel to ``out``.

    The rows have shape (rows, g), ``out`` (rows, m); the first of g stands at ``first_at`` among
    the m, which may be before or behind them all.
    """
    rows, g = values.shape
    m = out.shape[1]
    half = len(kernel) // 2
    for r in range(rows):
        for node in range(g):
            value = values[r, node]
            at = node + first_at
            first = max(0, at - half)
            last = min(m, at + half + 1)
            if value != 0 and first < last:
                target = out[r, first:last]
                weights = kernel[first - at + half :]
                for k in range(last - first):
                    target[k] += value * weights[k]


@compiled
def read(
    sample: Floats,
    coefficients: Floats,
    outside: Floats,
    low: float,
    inverse: float,
    before: int,
    out: Floats,
) -> None:
    """Evaluate piecewise cubics at a sample, shape (1 or rows, n), into ``out``, shape (rows, n).

    The coefficients of 1, t, t^2, t^3 beyond each node, which are those of `count`, have shape
    (rows, g, 4); values below and above the grid get those of ``outside``, shape (rows, 2), and NaN
    gets zero.
    """
    rows, n = out.shape
    g = coefficients.shape[1]
    for r in range(rows):
        values = sample[r % len(sample)]
        for i in range(n):
            t = values[i] * inverse - low
            if 1 - before <= t < g - 2 - before:
                left = math.floor(t)
                t -= left
                c = coefficients[r, left + before]
                value = c[2] + t * c[3]
                value = c[1] + t * value
                out[r, i] = c[0] + t * value
            elif t < 1 - before:
                out[r, i] = outside[r, 0]
            elif t >= g - 2 - before:
                out[r, i] = outside[r, 1]
            else:
                out[r, i] = 0.0
