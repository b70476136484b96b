"""The pooled predictive distribution, through which measured values become u-values."""

from __future__ import annotations

import numpy as np

from prbayes._stats import cumulated
from prbayes._validate import Floats


class Predictive:
    """The pooled predictive distribution, all draws and samples together.

    Parameters
    ----------
    values : ndarray, any shape
        NaN are left out; +inf counts as the largest value.
    weights : ndarray, same shape, optional
    """

    def __init__(self, values: Floats, weights: Floats | None = None) -> None:
        is_known = ~np.isnan(values)
        known = values[is_known]
        if weights is None:
            self._values = np.sort(known)
            n = known.size
            # Below nothing at all there is nothing.
            self._below = np.arange(n + 1) / max(1, n)
            return
        order = np.argsort(known)
        self._values = known[order]
        below = cumulated(weights[is_known], order)
        self._below = below / below[-1]

    def steps(self, y: Floats) -> tuple[Floats, Floats]:
        """Return P(Y < y) and P(Y <= y), of the shape of y; NaN where y is."""
        nan = np.where(np.isnan(y), np.nan, 0.0)
        smaller = np.searchsorted(self._values, y, side="left")
        not_larger = np.searchsorted(self._values, y, side="right")
        left = self._below[smaller] + nan
        right = self._below[not_larger] + nan
        return left, right

    def transform(self, y: Floats, rng: np.random.Generator | None) -> Floats:
        """Return the middle between P(Y < y) and P(Y <= y), or a uniform number between them."""
        left, right = self.steps(y)
        return between(left, right, rng)


def between(left: Floats, right: Floats, rng: np.random.Generator | None) -> Floats:
    """Return the middle of the two, or with a generator uniform numbers between them."""
    share = 0.5 if rng is None else rng.random(left.shape)
    return np.asarray(left + share * (right - left))
