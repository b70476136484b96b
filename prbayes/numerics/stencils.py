"""Second derivatives from a stencil of unit steps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from prbayes._validate import Floats
from prbayes.numerics.derivatives import cross


def stencil(r: int) -> Floats:
    """Return the cross of unit steps around zero, then the four corners of each pair of axes.

    Returns
    -------
    ndarray, shape (1 + 2 r + 2 r (r - 1), r)
    """
    unit = np.eye(r)
    rows = list(cross(np.zeros(r), np.ones(r)))
    for i, j in _pairs(r):
        one = unit[i]
        other = unit[j]
        rows += [one + other, one - other, other - one, -one - other]
    return np.array(rows)


def hessian_of(values: Floats, r: int) -> Floats:
    """Return the Hessian, (r, r), from values at the points of `stencil`, by unit differences."""
    here = values[0]
    cross_ends = [1, 1 + r, 1 + 2 * r]
    _, up, down, corners = np.split(values, cross_ends)
    # What is not finite gives what is not a number, and is the caller's to judge.
    with np.errstate(invalid="ignore"):
        along = up - 2 * here + down
        out = np.diag(along)
        mixed = corners.reshape(-1, 4)
        for (i, j), around in zip(_pairs(r), mixed, strict=True):
            pp, pm, mp, mm = around
            twist = (pp - pm - mp + mm) / 4
            out[i, j] = twist
            out[j, i] = twist
    return out


def second_differences(value: Callable[[Floats], Floats], r: int) -> Floats:
    """Return the Hessian at zero of a function of r parameters by differences of one unit.

    Parameters
    ----------
    value : callable
        ``value(x)``, shapes (1, s, r) -> (s,).
    r : int

    Returns
    -------
    ndarray, shape (r, r)
    """
    points = stencil(r)
    values = value(points[None])
    return hessian_of(values, r)


def _pairs(r: int) -> list[tuple[int, int]]:
    """Return the pairs of different axes."""
    rows, columns = np.tril_indices(r, -1)
    return list(zip(rows.tolist(), columns.tolist(), strict=True))
