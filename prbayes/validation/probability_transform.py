"""The probability integral transform, and the area between the ECDF of u-values and the identity.

Czado, Gneiting and Held (2009), doi:10.1111/j.1541-0420.2009.01191.x; Ferson, Oberkampf and
Ginzburg (2008), doi:10.1016/j.cma.2007.07.030.
"""

from __future__ import annotations

import numpy as np

from prbayes._stats import cumulated
from prbayes._validate import Floats


class Predictive:
    """The pooled predictive distribution of all draws and samples.

    ``values`` of any shape, of which NaN are left out and +inf is the largest, have equal weights
    or ``weights`` of the same shape.
    """

    def __init__(self, values: Floats, weights: Floats | None = None) -> None:
        is_number = ~np.isnan(values)
        numbers = values[is_number]
        if weights is None:
            self._values = np.sort(numbers)
            # An empty pool has probability zero everywhere.
            self._cumulative = np.arange(numbers.size + 1) / max(1, numbers.size)
            return
        order = np.argsort(numbers)
        self._values = numbers[order]
        cumulative = cumulated(weights[is_number], order)
        self._cumulative = cumulative / cumulative[-1]

    def steps(self, y: Floats) -> tuple[Floats, Floats]:
        """Return P(Y < y) and P(Y <= y), of the shape of y; NaN where y is."""
        nan = np.where(np.isnan(y), np.nan, 0.0)
        n_smaller = np.searchsorted(self._values, y, side="left")
        n_not_larger = np.searchsorted(self._values, y, side="right")
        return self._cumulative[n_smaller] + nan, self._cumulative[n_not_larger] + nan

    def transform(self, y: Floats, rng: np.random.Generator | None) -> Floats:
        """Return the middle between P(Y < y) and P(Y <= y), or a uniform number between them."""
        lower, upper = self.steps(y)
        return between(lower, upper, rng)


def between(lower: Floats, upper: Floats, rng: np.random.Generator | None) -> Floats:
    """Return the middle of the two, or with a generator uniform numbers between them."""
    fraction = 0.5 if rng is None else rng.random(lower.shape)
    return np.asarray(lower + fraction * (upper - lower))


def area(u: Floats) -> Floats:
    r"""Return the exact areas between ECDFs of u, (..., n), and the identity on [0, 1], (...).

    .. math:: A = \int_0^1 |F_n(v) - v| \, dv

    Between two values the ECDF is constant, and the integral of an absolute value of a line
    follows from that of :math:`|v|`, which is :math:`v |v| / 2`.
    """
    *leading, n = u.shape
    zeros, ones = np.zeros((*leading, 1)), np.ones((*leading, 1))
    ends = np.concatenate([zeros, np.sort(u, axis=-1), ones], axis=-1)
    ecdf = np.arange(n + 1) / n
    above = ends[..., 1:] - ecdf
    below = ends[..., :-1] - ecdf
    doubled = above * np.abs(above) - below * np.abs(below)
    return np.asarray(doubled.sum(axis=-1) / 2)
