"""Nelder and Mead's simplex for many small minimisations at once.

`batched_bfgs` needs slopes. A user's discrepancy may have kinks, as the largest difference of two
distribution functions, or flat pieces; a simplex only compares values.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats


def descend_by_simplex(
    value: Callable[[Floats, Any], Floats], start: Floats, *, sizes: Sequence[float]
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Minimise B functions of r parameters, each from its start, all in step.

    A row has converged when the values over its simplex are about equal, or the simplex is small.
    It may end with equal values on both sides of a minimum: a smaller simplex with reversed edges
    then continues from the best point.

    Parameters
    ----------
    value : callable
        ``value(x, rows)``, shapes (A, s, r), (A,) -> (A, s): function ``rows[a]`` at s points each.
    start : ndarray, shape (B, r)
    sizes : sequence of float
        Lengths of the first edges of one simplex after the other; negative ones are reversed.

    Returns
    -------
    x : ndarray, shape (B, r)
    values : ndarray, shape (B,)
    converged : ndarray of bool, shape (B,)

    References
    ----------
    .. [1] Gao, F. and L. Han (2012), Implementing the Nelder-Mead simplex algorithm with adaptive
       parameters, Comput. Optim. Appl. 51, 259-277, doi:10.1007/s10589-010-9329-3.

    Examples
    --------
    >>> import numpy as np
    >>> centers = np.array([[0.0], [2.0]])
    >>> value = lambda x, rows: abs(x - centers[rows, None]).sum(-1)
    >>> x, *_ = descend_by_simplex(value, np.ones((2, 1)), sizes=[1.0, -0.5])
    >>> np.abs(x - centers).max() < 0.01
    np.True_
    """
    n_rows, r = start.shape
    first = value(start[:, None], np.arange(n_rows))[:, 0]
    x = start
    values = first
    converged = np.ones(n_rows, dtype=bool)
    if r == 0:
        return x, values, converged
    for size in sizes:
        x, values, converged = _one_descent(value, x, first, size)
    return x, values, converged


def _one_descent(
    value: Callable[[Floats, Any], Floats], start: Floats, first: Floats, size: float
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return the ends of a simplex per row; ``first`` has the values at the first start."""
    n_rows, r = start.shape
    # Points and values of the simplices, (B, r + 1, r) and (B, r + 1), the best point first.
    points = start[:, None] + np.concatenate([np.zeros((1, r)), size * np.eye(r)])
    points, values = _sorted(points, value(points, np.arange(n_rows)))
    converged = np.zeros(n_rows, dtype=bool)
    # In 60 iterations for each parameter a simplex shrinks about a millionfold.
    for _ in range(60 * r):
        best = values[:, 0]
        with np.errstate(invalid="ignore"):  # infinite less infinite counts as nothing
            gains = np.where(np.isfinite(first), first, best) - best
            spread = values[:, -1] - best
        # At a parabola's minimum a thousandth of the mean gain is 3% of the distance.
        is_level = spread <= 1e-3 * float(np.nan_to_num(gains).mean())
        length = np.abs(points - points[:, :1]).max(axis=(1, 2))
        # Rows that have converged stay as they are.
        converged |= is_level | (length <= 1e-3 * abs(size))
        rows = np.flatnonzero(~converged)
        if not rows.size:
            break
        points[rows], values[rows] = _sorted(*_step(value, points[rows], values[rows], rows))
    return points[:, 0], values[:, 0], converged


def _sorted(points: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Return simplices with their best point first."""
    order = np.argsort(values, axis=1, kind="stable")
    ordered = np.take_along_axis(values, order, axis=1)
    return np.take_along_axis(points, order[..., None], axis=1), ordered


def _step(
    value: Callable[[Floats, Any], Floats],
    points: Floats,
    values: Floats,
    rows: NDArray[np.intp],
) -> tuple[Floats, Floats]:
    """Replace the worst point of each simplex, or shrink it towards the best.

    The factors are those of Gao and Han (2012) for r parameters, at least two.
    """
    points = points.copy()
    values = values.copy()
    n = max(points.shape[-1], 2)
    expansion = 1 + 2 / n
    contraction = 0.75 - 1 / (2 * n)
    # Four trials, (A, 4, r), in one call: the worst point reflected at the centre of the others,
    # farther, nearer, and nearer on its side.
    center = points[:, :-1].mean(axis=1)
    lengths = np.array([1.0, expansion, contraction, -contraction])
    steps = lengths[:, None] * (center - points[:, -1])[:, None]
    trials = np.asarray(center[:, None] + steps)
    trial, trial_values, is_accepted = _choice(value(trials, rows), values)
    best = trials[np.arange(len(points)), trial]
    points[is_accepted, -1] = best[is_accepted]
    values[is_accepted, -1] = trial_values[is_accepted]
    shrinks = ~is_accepted
    if shrinks.any():
        vertex = points[shrinks, :1]
        nearer = vertex + (1 - 1 / n) * (points[shrinks, 1:] - vertex)
        points[shrinks, 1:] = nearer
        values[shrinks, 1:] = value(nearer, rows[shrinks])
    return points, values


def _choice(
    trial_values: Floats, values: Floats
) -> tuple[NDArray[np.intp], Floats, NDArray[np.bool_]]:
    """Return the trial of each simplex, its value, and whether it is good enough, (A,) each.

    From values of the trials, (A, 4), and sorted ones of the simplices, (A, r + 1).
    """
    reflected, expanded = trial_values[:, 0], trial_values[:, 1]
    best, second, last = values[:, 0], values[:, -2], values[:, -1]
    # The reflected point, a farther one if that is better still, else a nearer one on either side.
    trial = np.where(reflected < second, 0, 2)
    trial = np.where((reflected < best) & (expanded < reflected), 1, trial)
    trial = np.where(reflected >= last, 3, trial)
    taken = trial_values[np.arange(len(trial_values)), trial]
    # A nearer point has to beat the reflected one, or the worst where that was not better either.
    limit = np.where(trial == 2, reflected, np.inf)
    limit = np.where(trial == 3, last, limit)
    return trial, taken, (taken <= limit) & (taken < last)
