"""Loops over the values of a sample, compiled by Numba when they are first called.

They read a sample once and keep nothing but the result, which NumPy's passes over whole arrays do
not. Numba is PyTensor's default backend, so it is there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, update_wrapper

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats

# The four uniform cubic B-splines that reach a point at fraction t between two nodes: coefficients
# of 1, t, t^2, t^3 (any textbook on splines).
SPLINE = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6


def _compiled[**P](loop: Callable[P, None]) -> Callable[P, None]:
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


@_compiled
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
                        counts[r, node - 1 + k] += SPLINE[k, power] * m[power]
                m[:] = 0


@_compiled
def sum_below(
    weights: Floats, order: NDArray[np.intp], below: NDArray[np.intp], out: Floats
) -> None:
    """Put the sums of the first ``below`` weights in an order, shape (rows, m), into ``out``.

    The weights have shape (rows, n), the order (n,), ``below`` (m,).
    """
    sums = np.zeros(len(order) + 1)
    for r in range(len(weights)):
        total = 0.0
        for i in range(len(order)):
            total += weights[r, order[i]]
            sums[i + 1] = total
        for k in range(len(below)):
            out[r, k] = sums[below[k]]


@_compiled
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


@_compiled
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
