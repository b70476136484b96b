"""The statistic of the area test."""

from __future__ import annotations

import numpy as np

from prbayes._validate import Floats


def area(u: Floats) -> Floats:
    r"""Return the areas between the ECDFs of u and the identity on [0, 1], exactly.

    .. math:: A = \int_0^1 |F_n(v) - v| \, dv

    Between two values the ECDF is constant, and the integral is that of an absolute value of a
    line.

    Parameters
    ----------
    u : ndarray, shape (..., n)

    Returns
    -------
    ndarray, shape (...)
    """
    *leading, n = u.shape
    zero = np.zeros((*leading, 1))
    one = np.ones((*leading, 1))
    ends = np.concatenate([zero, np.sort(u, axis=-1), one], axis=-1)
    # Of the ECDF between two ends.
    height = np.arange(n + 1) / n
    above = ends[..., 1:] - height
    below = ends[..., :-1] - height
    # The integral of |v| is v |v| / 2.
    upper = above * np.abs(above)
    lower = below * np.abs(below)
    doubled = upper - lower
    return np.asarray(doubled.sum(axis=-1) / 2)
