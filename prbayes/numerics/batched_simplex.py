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

from prbayes._validate import Floats

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
        return cls(
            expand=1 + 2 / n,
            contract=0.75 - 1 / (2 * n),
            shrink=1 - 1 / n,
        )


def descend_by_simplex(
    value: Callable[[Floats, Any], Floats], start: Floats, *, sizes: Sequence[float]
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Minimise B functions of r parameters, each from its own start, all in step.

    A row has converged when the values over its simplex are about equal, or the simplex is small.
    It may end with equal values on both sides of a minimum: another one, turned round and smaller,
    then goes on from the best point.

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
    n_rows, r = start.shape
    rows = np.arange(n_rows)
    first = value(start[:, None], rows)[:, 0]
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
    """Let one simplex per row converge; ``first`` has the values before all descents."""
    n_rows, r = start.shape
    moves = Moves.of(r)
    # Points and values of the simplices, (B, r + 1, r) and (B, r + 1), the best point first.
    edges = size * np.eye(r)
    here = np.zeros((1, r))
    corners = np.concatenate([here, edges])
    points = start[:, None] + corners
    values = value(points, np.arange(n_rows))
    points, values = _sorted(points, values)
    converged = np.zeros(n_rows, dtype=bool)
    for _ in range(_PATIENCE * r):
        # Rows that have converged are left alone from then on.
        gain = _mean_gain(first, values[:, 0])
        converged |= _small(points, values, gain, abs(size))
        rows = np.flatnonzero(~converged)
        if not rows.size:
            break
        # Make the step.
        stepped = _step(
            value,
            points[rows],
            values[rows],
            rows,
            moves,
        )
        ordered = _sorted(*stepped)
        points[rows], values[rows] = ordered
    return points[:, 0], values[:, 0], converged


def _small(points: Floats, values: Floats, gain: float, size: float) -> NDArray[np.bool_]:
    """Return which simplices, (B,), are short, or have about equal values."""
    with np.errstate(invalid="ignore"):
        spread = values[:, -1] - values[:, 0]
        level = spread <= _LEVEL * gain
    best = points[:, :1]
    edges = np.abs(points - best)
    length = edges.max(axis=(1, 2))
    short = length <= _SMALL * size
    return np.asarray(level | short)


def _sorted(points: Floats, values: Floats) -> tuple[Floats, Floats]:
    order = np.argsort(values, axis=1, kind="stable")
    ordered = np.take_along_axis(values, order, axis=1)
    places = order[..., None]
    return np.take_along_axis(points, places, axis=1), ordered


def _trials(points: Floats, moves: Moves) -> Floats:
    """Return the four points, (A, 4, r), that may replace the worst one of each simplex.

    Reflected at the centre of the others, farther than that, nearer, and nearer on its own side.
    """
    center = points[:, :-1].mean(axis=1)
    worst = points[:, -1]
    away = center - worst
    farther = moves.expand
    nearer = moves.contract
    lengths = np.array([1.0, farther, nearer, -nearer])
    steps = lengths[:, None] * away[:, None]
    return np.asarray(center[:, None] + steps)


def _choice(found: Floats, values: Floats) -> tuple[NDArray[np.intp], Floats, NDArray[np.bool_]]:
    """Return which trial each simplex takes, its value, and whether it is good enough, (A,) each.

    Parameters
    ----------
    found : ndarray, shape (A, 4)
        Values of the trials.
    values : ndarray, shape (A, r + 1)
        Of the simplices, sorted.
    """
    reflected = found[:, 0]
    expanded = found[:, 1]
    best = values[:, 0]
    second = values[:, -2]
    last = values[:, -1]
    # The reflected point, a farther one if that is better still, a nearer one on either side if it
    # is not.
    chosen = np.where(reflected < second, 0, 2)
    farther = (reflected < best) & (expanded < reflected)
    chosen = np.where(farther, 1, chosen)
    chosen = np.where(reflected >= last, 3, chosen)
    every = np.arange(len(found))
    taken = found[every, chosen]
    # A nearer point has to beat the reflected one, or the worst where that was not better either.
    to_beat = np.where(chosen == 2, reflected, np.inf)
    to_beat = np.where(chosen == 3, last, to_beat)
    accepted = (taken <= to_beat) & (taken < last)
    return chosen, taken, accepted


def _mean_gain(first: Floats, values: Floats) -> float:
    """Return by how much values are better than the first ones on average; none where not known."""
    known = np.isfinite(first)
    before = np.where(known, first, values)
    # Infinite less infinite counts as nothing.
    with np.errstate(invalid="ignore"):
        gains = before - values
    return float(np.nan_to_num(gains).mean())


def _step(
    value: Callable[[Floats, Any], Floats],
    points: Floats,
    values: Floats,
    rows: NDArray[np.intp],
    moves: Moves,
) -> tuple[Floats, Floats]:
    """Replace the worst point of each simplex, or shrink it towards the best."""
    points = points.copy()
    values = values.copy()
    # All four trials are looked at in one call, which costs less than four for some rows each.
    trials = _trials(points, moves)
    found = value(trials, rows)
    chosen, taken, accepted = _choice(found, values)
    every = np.arange(len(points))
    best = trials[every, chosen]
    points[accepted, -1] = best[accepted]
    values[accepted, -1] = taken[accepted]
    # Where no trial helps, the simplex shrinks.
    stuck = ~accepted
    if stuck.any():
        first = points[stuck, :1]
        others = points[stuck, 1:]
        nearer = first + moves.shrink * (others - first)
        points[stuck, 1:] = nearer
        values[stuck, 1:] = value(nearer, rows[stuck])
    return points, values
