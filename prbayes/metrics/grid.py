"""Cells of densities: a grid for Gaussian kernels, and the bins of a histogram.

A density is linear in the weights of the sample, and on a grid it is smooth in the sample's values;
both derivatives are given.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import update_wrapper
from typing import Any, cast

import numpy as np

from prbayes._validate import AT_ONCE, Floats, Indices, Shape

# Coefficients of 1, t, t^2, t^3 of the four uniform cubic B-splines that are not zero at fraction t
# between two nodes.
_SPLINE = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6


def product(weights: Floats, matrix: Floats) -> Floats:
    """Return weights @ matrix, shapes (..., n), (n, m) -> (..., m), as one product of two matrices.

    NumPy multiplies a batch of vectors one after another, many times slower.
    """
    *batch, n = weights.shape
    rows = weights.reshape(math.prod(batch), n)
    return (rows @ matrix).reshape(*batch, matrix.shape[-1])


def as_rows(values: Floats, shape: Shape) -> Floats:
    """Return values, broadcast to a shape (..., n), as contiguous rows (rows, n) for a loop."""
    *batch, n = shape
    rows = np.broadcast_to(values, shape).reshape(math.prod(batch), n)
    return np.ascontiguousarray(rows, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Cells(ABC):
    """Cells on which densities are compared; the last two are for the mass below and above."""

    widths: Floats  # length of each cell, (m,); the estimator chooses that of the outer two
    centers: Floats  # positions of the inner cells, (m - 2,), in units of the response
    smooth: bool  # whether the density has derivatives with respect to the sample's values
    floor: float  # density of a small share of the mass that is spread evenly over all cells

    @abstractmethod
    def density(self, sample: Floats, weights: Floats) -> Floats:
        """Return the density of weighted samples, (..., n) -> (..., m); NaN counts nowhere."""

    def basis(self, sample: Floats) -> Floats:
        """Return A, shape (n, m), with ``density(sample, w) == w @ A``."""
        return self.density(sample[:, None], np.ones(1))

    @abstractmethod
    def reading(self, points: Floats, weights: Floats) -> Floats:
        """Return r such that ``r @ g`` is the weighted mean of a function g of the cells at points.

        Shapes (n,), (..., n) -> (..., m).
        """

    @abstractmethod
    def adjoint(self, sample: Floats, cotangent: Floats, *, for_sample: bool = False) -> Floats:
        """Return derivatives of ``(density(sample, weights) * cotangent).sum()`` by the weights.

        With ``for_sample`` they are those by the sample, for weights of one. Shapes (..., n),
        (..., m) -> (..., n), with as many leading axes in both.
        """


@dataclass(frozen=True, eq=False)
class KernelCells(Cells):
    """Nodes of a regular grid; mass outside counts as one tight cluster on either side.

    The cluster has the density of a single kernel, so that mass outside counts as much as possible.
    The kernel of a value near the end of the grid is divided between grid and cluster, so that the
    density is smooth in the values there, too. The sample is binned on more nodes than the grid
    has: all nodes whose kernels reach the grid.
    """

    bandwidth: float  # standard deviation of the kernel, in units of the response
    step: float  # distance of two nodes
    kernel: Floats  # kernel that smooths counts at nodes into densities, (2 k + 1,)
    low: float  # position of the first node, in steps
    # Number of additional nodes on either side on which values are binned. The kernel of a value
    # farther out reaches no node of the grid, also after its spline has spread it to four nodes.
    margin: int
    # Mass below and above the grid of a kernel at each node and additional node, (2, g + 2 margin).
    mass_outside: Floats

    def density(self, sample: Floats, weights: Floats) -> Floats:
        """Return densities at the nodes, then mass below and above over the width of a cluster."""
        *batch, _ = sample.shape
        nodes = self.centers.size
        # Bin the sample on the grid and the additional nodes.
        values = as_rows(sample, sample.shape)
        counts = np.zeros((len(values), nodes + 2 * self.margin))
        outside = np.zeros((len(values), 2))
        scale = 1 / self.step
        rows_of_weights = as_rows(weights, sample.shape)
        count(values, rows_of_weights, self.low, scale, self.margin, counts, outside)
        # Smooth the counts into densities on the grid, and into mass beyond its ends.
        inner = np.zeros((len(values), nodes))
        smooth(counts, self.kernel, -self.margin, inner)
        for side, mass in enumerate(self.mass_outside):
            reached = np.flatnonzero(mass)
            block = slice(reached[0], reached[-1] + 1)
            outside[:, side] += (counts[:, block] * mass[block]).sum(axis=-1)
        density = np.concatenate([inner, outside / self.widths[-1]], axis=-1)
        return density.reshape(*batch, nodes + 2)

    def reading(self, points: Floats, weights: Floats) -> Floats:
        """Return cubic convolution weights (Keys 1981), which are exact for parabolas.

        Points off the grid take the value of the outer cell on their side.
        """
        last = self.centers.size - 2
        total: Any = 0.0
        # Work in blocks of points, so that their matrices fit into memory.
        size = max(1, AT_ONCE // self.widths.size)
        for start in range(0, max(1, points.size), size):
            block = slice(start, start + size)
            # A point is a node and a fraction of a step beyond it.
            t = points[block] / self.step - self.low
            inside = (t >= 1) & (t < last)
            below = t < 1
            above = t >= last
            t = np.where(inside, t, 1.0)
            node = t.astype(np.intp)
            t -= node
            s = 1 - t
            keys = (
                -t * s**2 / 2,
                1 - 2.5 * t**2 + 1.5 * t**3,
                1 - 2.5 * s**2 + 1.5 * s**3,
                -s * t**2 / 2,
            )
            row = np.arange(t.size)
            matrix = np.zeros((t.size, self.widths.size))
            for k, contribution in enumerate(keys):
                matrix[row, node - 1 + k] += np.where(inside, contribution, 0.0)
            matrix[below, -2] = 1.0
            matrix[above, -1] = 1.0
            total = total + product(weights[..., block], matrix)
        return np.asarray(total)

    def adjoint(self, sample: Floats, cotangent: Floats, *, for_sample: bool = False) -> Floats:
        """Return the smoothed cotangent at the sample, or its derivative there."""
        batch = np.broadcast_shapes(sample.shape[:-1], cotangent.shape[:-1])
        n = sample.shape[-1]
        inner = self.centers.size
        nodes = inner + 2 * self.margin
        # Smooth the cotangent with the same kernel, because it is symmetric.
        flat = as_rows(cotangent[..., :inner], (*cotangent.shape[:-1], inner))
        smoothed = np.zeros((len(flat), nodes))
        smooth(flat, self.kernel, self.margin, smoothed)
        ends = cotangent[..., -2:] / self.widths[-1]
        smoothed = smoothed.reshape(*cotangent.shape[:-1], nodes)
        for side, mass in enumerate(self.mass_outside):
            smoothed = smoothed + ends[..., side, None] * mass
        # The coefficients of the cubic beyond each node, (rows, g, 4), from the splines around it.
        spline = _SPLINE
        if for_sample:
            spline = np.pad(_SPLINE[:, 1:] * [1, 2, 3] / self.step, [(0, 0), (0, 1)])
            ends = np.zeros(2)
        padded = np.pad(as_rows(smoothed, (*batch, nodes)), [(0, 0), (1, 2)])
        cubics = np.stack([padded[:, k : k + nodes] for k in range(4)], axis=-1) @ spline
        values = as_rows(sample, (*batch, n))
        ends = as_rows(ends, (*batch, 2))
        out = np.empty(values.shape)
        evaluate_cubics(values, cubics, ends, self.low, 1 / self.step, self.margin, out)
        return out.reshape(*batch, n)


@dataclass(frozen=True, eq=False)
class BinCells(Cells):
    """Equal bins, closed on the left, the last one on both sides."""

    def density(self, sample: Floats, weights: Floats) -> Floats:
        """Return the normalised frequency per unit length of each bin, then of the outer two."""
        *batch, n = sample.shape
        rows = math.prod(batch)
        # Count the cells of all rows at once. Each row has its bins, below, above, and NaN.
        cells = self.centers.size + 3
        first = cells * np.arange(rows)
        cell = self._cell(sample).reshape(rows, n) + first[:, None]
        w = np.broadcast_to(weights, sample.shape)
        counts = np.bincount(cell.ravel(), w.ravel(), rows * cells)
        counts = counts.reshape(*batch, cells)
        return cast(Floats, counts[..., :-1] / self.widths[0])

    def reading(self, points: Floats, weights: Floats) -> Floats:
        """Return the weight of the points in each bin."""
        return self.density(np.broadcast_to(points, weights.shape), weights) * self.widths

    def _cell(self, sample: Floats) -> Indices:
        """Return cell numbers: bins, then below, above, and NaN."""
        bins = self.centers.size
        # Positions in widths from the lower edge.
        width = self.widths[0]
        low = self.centers[0] - width / 2
        position = (sample - low) / width
        finite = np.where(np.isfinite(position), position, 0.0)
        # The upper edge belongs to the last bin, also if low + bins * width is rounded.
        cell = np.clip(finite, 0, bins - 1).astype(np.intp)
        # The tolerance exceeds the rounding of the edges of some thousand bins.
        cell = np.where(position > bins + 1e-9, bins + 1, cell)
        cell = np.where(position < -1e-9, bins, cell)
        return np.where(np.isnan(position), bins + 2, cell)

    def adjoint(self, sample: Floats, cotangent: Floats, *, for_sample: bool = False) -> Floats:
        """Return the cotangent of the cell of each value; zero by the sample: steps are flat."""
        if for_sample:
            batch = np.broadcast_shapes(sample.shape[:-1], cotangent.shape[:-1])
            return np.zeros((*batch, sample.shape[-1]))
        of_nan = np.zeros_like(cotangent[..., :1])
        padded = np.concatenate([cotangent, of_nan], axis=-1)
        by_weight = padded / self.widths[0]
        return np.take_along_axis(by_weight, self._cell(sample), axis=-1)


def compiled(loop: Callable[..., None]) -> Callable[..., None]:
    """Compile a loop with Numba at its first call, since Numba takes long to import."""
    function = None

    def call(*args: Any) -> None:
        nonlocal function
        if function is None:
            from numba import njit

            try:
                function = njit(cache=True, nogil=True)(loop)
            except RuntimeError:  # there is no folder for the cache on disk
                function = njit(nogil=True)(loop)
        function(*args)

    return update_wrapper(call, loop)


@compiled
def count(
    sample: Floats,
    weights: Floats,
    low: float,
    inverse: float,
    margin: int,
    counts: Floats,
    outside: Floats,
) -> None:
    """Add weights at the nodes of a grid, spread by cubic B-splines, and those outside it.

    Node k is at ``(low + k - margin) / inverse``. Sample and weights have the shape (rows, n),
    counts (rows, g), and ``outside`` (rows, 2). NaN counts nowhere.
    """
    rows, n = sample.shape
    g = counts.shape[1]
    moments = np.zeros((g, 4))  # sums of 1, t, t^2, t^3 beyond each node
    for r in range(rows):
        # For each node sum the powers of the fractions t of all values beyond it.
        for i in range(n):
            t = sample[r, i] * inverse - low
            w = weights[r, i]
            if 1 - margin <= t < g - 2 - margin:
                index = math.floor(t)
                t -= index
                for power in range(4):
                    moments[index + margin, power] += w
                    w *= t
            elif t < 1 - margin:
                outside[r, 0] += w
            elif t >= g - 2 - margin:
                outside[r, 1] += w
        # Four splines are not zero at these values: distribute the weights to their nodes.
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

    The rows have the shape (rows, g), and ``out`` (rows, m). The first of the g numbers is at index
    ``first_at`` of the m, which may be outside them.
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
def evaluate_cubics(
    sample: Floats,
    coefficients: Floats,
    outside: Floats,
    low: float,
    inverse: float,
    margin: int,
    out: Floats,
) -> None:
    """Evaluate piecewise cubics at a sample, (rows, n), into ``out`` of the same shape.

    The coefficients of 1, t, t^2, t^3 beyond each node of `count` have the shape (rows, g, 4).
    Values below and above the grid get the numbers of ``outside``, (rows, 2), and NaN gets zero.
    """
    rows, n = out.shape
    g = coefficients.shape[1]
    for r in range(rows):
        for i in range(n):
            t = sample[r, i] * inverse - low
            if 1 - margin <= t < g - 2 - margin:
                index = math.floor(t)
                t -= index
                c = coefficients[r, index + margin]
                value = c[2] + t * c[3]
                value = c[1] + t * value
                out[r, i] = c[0] + t * value
            elif t < 1 - margin:
                out[r, i] = outside[r, 0]
            elif t >= g - 2 - margin:
                out[r, i] = outside[r, 1]
            else:
                out[r, i] = 0.0
