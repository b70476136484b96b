"""Many small minimisations at once where nothing is known of the functions.

Nelder and Mead's simplex.

`batch_bfgs` needs slopes. A user's own discrepancy may have kinks, as the largest difference of two
distribution functions, or flat pieces; a simplex only asks which of two values is the smaller.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats

# Range of values over a simplex, as a share of what the minimisations have gained on average, from
# which it is small enough. At a parabola's minimum a thousandth of the gain is 3% of the way.
_LEVEL = 1e-3
# Length of a simplex, as a share of its first, from which it is small enough whatever the values.
_SMALL = 1e-3
# Iterations for each parameter, in which a simplex shrinks about a millionfold.
_PATIENCE = 60


@dataclass(frozen=True)
class Moves:
    """How far a simplex goes beyond its centre, for r parameters (Gao and Han's choice)."""

    expand: float
    contract: float
    shrink: float

    @classmethod
    def of(cls, r: int) -> Moves:
        """Return the moves; from two parameters on they depend on their number."""
        n = max(r, 2)
        return cls(expand=1 + 2 / n, contract=0.75 - 1 / (2 * n), shrink=1 - 1 / n)


def descend_by_simplex(
    value: Callable[[Floats, Any], Floats], start: Floats, *, sizes: Sequence[float]
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Minimise B functions of r parameters, each from its own start, all in step.

    A row has converged when the values over its simplex are about equal, or the simplex is small.
    It may come to rest with equal values on both sides of a minimum: another one, turned round and
    smaller, then goes on from the best point.

    Parameters
    ----------
    value : callable
        ``value(x, rows)``, shapes (A, s, r), (A,) -> (A, s): function ``rows[a]`` at s points each.
    start : ndarray, shape (B, r)
    sizes : sequence of float
        Lengths of the first edges of one simplex after the other; negative ones are turned round.

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
    rows = np.arange(len(start))
    first = value(start[:, None], rows)[:, 0]
    x, values = start, first
    converged = np.ones(len(start), dtype=bool)
    if start.shape[1] == 0:
        return x, values, converged
    for size in sizes:
        x, values, converged = _one_descent(value, x, first, size)
    return x, values, converged


def _one_descent(
    value: Callable[[Floats, Any], Floats], start: Floats, first: Floats, size: float
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Let one simplex per row come to rest; ``first`` has the values before all descents."""
    n_rows, r = start.shape
    moves = Moves.of(r)
    # Points and values of the simplices, (B, r + 1, r) and (B, r + 1), the best point first.
    corners = np.concatenate([np.zeros((1, r)), size * np.eye(r)])
    points = start[:, None] + corners
    values = value(points, np.arange(n_rows))
    points, values = _sorted(points, values)
    converged = np.zeros(n_rows, dtype=bool)
    for _ in range(_PATIENCE * r):
        # Rows that have come to rest are left alone from then on.
        gains = np.where(np.isfinite(first), first, values[:, 0]) - values[:, 0]
        gain = float(np.nan_to_num(gains).mean())
        converged |= _at_rest(points, values, gain, abs(size))
        rows = np.flatnonzero(~converged)
        if not rows.size:
            break
        moved = _step(value, points[rows], values[rows], rows, moves)
        points[rows], values[rows] = _sorted(*moved)
    return points[:, 0], values[:, 0], converged


def _at_rest(points: Floats, values: Floats, gain: float, size: float) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        level = values[:, -1] - values[:, 0] <= _LEVEL * gain
    length = np.abs(points - points[:, :1]).max(axis=(1, 2))
    return np.asarray(level | (length <= _SMALL * size))


def _sorted(points: Floats, values: Floats) -> tuple[Floats, Floats]:
    order = np.argsort(values, axis=1, kind="stable")
    return np.take_along_axis(points, order[..., None], axis=1), np.take_along_axis(
        values, order, axis=1
    )


def _step(
    value: Callable[[Floats, Any], Floats],
    points: Floats,
    values: Floats,
    rows: NDArray[np.intp],
    moves: Moves,
) -> tuple[Floats, Floats]:
    """Replace the worst point of each simplex, or shrink it towards the best."""
    points, values = points.copy(), values.copy()
    center, worst = points[:, :-1].mean(axis=1), points[:, -1]
    away = center - worst
    # All four trials are looked at in one call, which costs less than four calls for some rows
    # each.
    lengths = np.array([1.0, moves.expand, moves.contract, -moves.contract])
    trials = center[:, None] + lengths[:, None] * away[:, None]
    found = value(trials, rows)
    reflected, expanded = found[:, 0], found[:, 1]
    best, second, last = values[:, 0], values[:, -2], values[:, -1]
    # Which of the trials is taken, by their place above: the reflected point, a further one if that
    # is better still, a nearer one on either side if it is not.
    chosen = np.where(reflected < second, 0, 2)
    chosen = np.where((reflected < best) & (expanded < reflected), 1, chosen)
    chosen = np.where(reflected >= last, 3, chosen)
    taken = np.take_along_axis(found, chosen[:, None], axis=1)[:, 0]
    to_beat = np.where(chosen == 3, last, np.where(chosen == 2, reflected, np.inf))
    accepted = (taken <= to_beat) & (taken < last)
    every = np.arange(len(points))
    points[accepted, -1] = trials[every, chosen][accepted]
    values[accepted, -1] = taken[accepted]
    # Where no trial helps, the simplex shrinks.
    stuck = ~accepted
    if stuck.any():
        towards = points[stuck, :1] + moves.shrink * (points[stuck, 1:] - points[stuck, :1])
        points[stuck, 1:] = towards
        values[stuck, 1:] = value(towards, rows[stuck])
    return points, values
