"""Minimisers of many small functions at once: BFGS, and the simplex of Nelder and Mead.

The minimisations of hundreds of data sets are small and alike, and calls of NumPy dominate their
cost: one call evaluates every row. BFGS needs slopes. A user's discrepancy may have kinks, as the
largest difference of two distribution functions, or flat pieces; a simplex only compares values.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from prbayes._validate import ArrayPair, Bools, Floats, Indices

# function of points, (A, s, r), and of the rows of the functions there, (A,), that returns values,
# (A, s)
type Values = Callable[[Floats, Any], Floats]


class Minima(NamedTuple):
    """Minima at the ends of descents."""

    x: Floats  # (B, r): ends of the descents
    values: Floats  # (B,)
    converged: Bools  # (B,)


# function of points, (A, r), and of the rows of the functions there, (A,), that returns values and
# gradients, (A,) and (A, r)
type Slopes = Callable[[Floats, Indices], tuple[Floats, Floats]]

# minimiser of functions from starts, (B, r)
type Descent = Callable[[Values, Floats], Minima]


def descend(
    value: Values,
    start: Floats,
    curvature: Floats,
    *,
    step: float,
    tolerance: float,
    max_iterations: int = 40,
    is_central: bool = False,
) -> Minima:
    """Minimise B functions of r parameters of order one by BFGS, from starts (B, r), all in step.

    ``value(x, rows)``, (A, s, r) and (A,) -> (A, s), evaluates function ``rows[a]`` at s points;
    ``curvature``, (r, r), is the Hessian of a typical function. Gradients are differences: central
    ones, at twice the cost, or one-sided ones less their bias for the curvature. Minima are then
    off by half a step, times the relative deviation of a function's Hessian.
    """
    problem = _by_differences(value, step, curvature, is_central)
    return descend_by_slopes(
        problem, start, curvature, tolerance=tolerance, max_iterations=max_iterations
    )


def descend_by_slopes(
    problem: Slopes,
    start: Floats,
    curvature: Floats,
    *,
    tolerance: float,
    max_iterations: int = 40,
) -> Minima:
    """Minimise B functions as `descend` does, with gradients of their own.

    A row has converged when its next step is predicted to gain less than ``tolerance``, or when no
    shorter step gains anything. Source: Nocedal and Wright (2006), Numerical Optimization,
    chapter 6, doi:10.1007/978-0-387-40065-5.
    """
    size, r = start.shape
    x = start.copy()
    inverse = np.broadcast_to(np.linalg.inv(curvature), (size, r, r)).copy()
    rows = np.arange(size)
    f, g = problem(x, rows)
    converged = np.zeros(size, dtype=bool)
    # Leave rows without a finite value and gradient at their start.
    rows = rows[np.isfinite(f) & np.isfinite(g).all(axis=-1)]
    for iteration in range(max_iterations):
        # The product of a quasi-Newton step and the gradient is twice the predicted gain.
        with np.errstate(over="ignore", invalid="ignore"):
            steps = -np.einsum("bij,bj->bi", inverse[rows], g[rows])
            gain = -(steps * g[rows]).sum(axis=-1)
            length = np.abs(steps).max(axis=-1)
            # Limit the length, because a quadratic model is wrong beyond a few units of the
            # parameters.
            steps = steps * (3.0 / np.maximum(length, 3.0))[:, None]
        is_finite = np.isfinite(gain) & np.isfinite(length)
        is_flat = is_finite & (gain < 2 * tolerance)
        converged[rows[is_flat]] = True
        moves = is_finite & ~is_flat
        rows, steps, gain = rows[moves], steps[moves], gain[moves]
        if not rows.size:
            break
        # Line search: halve the steps of rows until they gain enough.
        new_x, new_f, new_g = x[rows], f[rows], g[rows]
        waiting = np.arange(rows.size)
        for halvings in range(8):  # a step of 1/256 is as good as none
            factor = 0.5**halvings
            trial = x[rows[waiting]] + factor * steps[waiting]
            trial_f, trial_g = problem(trial, rows[waiting])
            with np.errstate(invalid="ignore"):
                # Sufficient decrease: Nocedal and Wright, eq. 3.4.
                decreases = trial_f <= f[rows[waiting]] - 1e-4 * factor * gain[waiting]
            accepted = decreases & np.isfinite(trial_g).all(-1)
            places = waiting[accepted]
            new_x[places] = trial[accepted]
            new_f[places] = trial_f[accepted]
            new_g[places] = trial_g[accepted]
            waiting = waiting[~accepted]
            if not waiting.size:
                break
        # The first update also scales the guess of the Hessian, whose form may be better than its
        # size.
        inverse[rows] = _bfgs(inverse[rows], new_x - x[rows], new_g - g[rows], iteration == 0)
        x[rows], f[rows], g[rows] = new_x, new_f, new_g
        # Rows that still wait have converged, because no shorter step gains enough.
        converged[rows[waiting]] = True
        rows = np.delete(rows, waiting)
    return Minima(x, f, converged)


def _by_differences(value: Values, step: float, curvature: Floats, is_central: bool) -> Slopes:
    """Return values and gradients at points (A, r) from values at several points of each row."""
    r = len(curvature)
    # Difference along axes of a mean length of one, along which a typical function has equal
    # curvature. The curvature along the coordinates of correlated parameters is larger, and the
    # bias of one-sided differences as well.
    axes = np.linalg.inv(np.linalg.cholesky(curvature))
    axes *= np.sqrt(r) / np.linalg.norm(axes)
    mean_curvature = float(np.trace(axes @ curvature @ axes.T)) / r
    sides = [step * axes, -step * axes] if is_central else [step * axes]
    stencil = np.concatenate([np.zeros((1, r)), *sides])
    to_gradient = np.linalg.inv(axes).T
    # bias of one-sided differences of a function with typical curvature
    bias = step * mean_curvature / 2

    def problem(x: Floats, rows: Indices) -> ArrayPair:
        values = value(x[:, None] + stencil, rows)
        center, up, down = np.split(values, [1, 1 + r], axis=1)
        with np.errstate(invalid="ignore"):
            slopes = (up - down) / (2 * step) if is_central else (up - center) / step - bias
            return center[:, 0], slopes @ to_gradient

    return problem


def _bfgs(inverse: Floats, s: Floats, y: Floats, is_first: bool) -> Floats:
    """Return updated inverse Hessians, (B, r, r), from steps s and changes y of gradients, (B, r).

    Nocedal and Wright, eq. 6.17; first guesses get the size of a first step, eq. 6.20, with the
    guess in place of the identity. Hessians are not updated where they would not be positive
    definite.
    """
    sy = (s * y).sum(axis=-1)
    # Update only if step and change of the gradient are not nearly orthogonal, which would spoil
    # the inverse Hessian.
    is_curved = sy > 1e-4 * np.linalg.norm(s, axis=-1) * np.linalg.norm(y, axis=-1)
    sy = np.where(is_curved, sy, 1.0)
    if is_first:
        expected = np.einsum("bi,bij,bj->b", y, inverse, y)
        inverse = (sy / np.where(is_curved, expected, 1.0))[:, None, None] * inverse
    # With rho = 0 the inverse Hessian does not change.
    rho = np.where(is_curved, 1 / sy, 0.0)
    column = rho[:, None, None] * s[:, :, None]
    projector = np.eye(s.shape[-1]) - column * y[:, None, :]
    transposed = np.swapaxes(projector, -1, -2)
    return projector @ inverse @ transposed + column * s[:, None, :]


def descend_by_simplex(value: Values, start: Floats, *, sizes: Sequence[float]) -> Minima:
    """Minimise B functions of r parameters by simplices, from starts (B, r), all in step.

    ``value`` is as in `descend`; ``sizes`` are lengths of the first edges of one simplex after the
    other, reversed if negative. A row has converged when the values over its simplex are about
    equal, or the simplex is small. It may end with equal values on both sides of a minimum: a
    smaller simplex with reversed edges then continues from the best point.

    Source: Gao and Han (2012), Implementing the Nelder-Mead simplex algorithm with adaptive
    parameters, doi:10.1007/s10589-010-9329-3.
    """
    n_rows, r = start.shape
    x = start
    values = first = value(start[:, None], np.arange(n_rows))[:, 0]
    converged = np.ones(n_rows, dtype=bool)
    if r == 0:
        return Minima(x, values, converged)
    for size in sizes:
        # Points and values of the simplices, (B, r + 1, r) and (B, r + 1), the best point first.
        simplices = x[:, None] + np.concatenate([np.zeros((1, r)), size * np.eye(r)])
        points, all_values = _best_first(simplices, value(simplices, np.arange(n_rows)))
        converged = np.zeros(n_rows, dtype=bool)
        # A simplex shrinks about a millionfold in 60 iterations for each parameter.
        for _ in range(60 * r):
            best = all_values[:, 0]
            # infinite less infinite is NaN, and counts as no gain
            with np.errstate(invalid="ignore"):
                gains = np.where(np.isfinite(first), first, best) - best
                spread = all_values[:, -1] - best
            # Near the minimum of a parabola a thousandth of the mean gain is 3 % of the distance.
            is_level = spread <= 1e-3 * float(np.nan_to_num(gains).mean())
            length = np.abs(points - points[:, :1]).max(axis=(1, 2))
            # Continue with the rows that have not converged.
            converged |= is_level | (length <= 1e-3 * abs(size))
            rows = np.flatnonzero(~converged)
            if not rows.size:
                break
            points[rows], all_values[rows] = _step(value, points[rows], all_values[rows], rows)
        x, values = points[:, 0], all_values[:, 0]
    return Minima(x, values, converged)


def _best_first(points: Floats, values: Floats) -> ArrayPair:
    """Return simplices with their best point first."""
    order = np.argsort(values, axis=1, kind="stable")
    ordered = np.take_along_axis(values, order, axis=1)
    return np.take_along_axis(points, order[..., None], axis=1), ordered


def _step(
    value: Values,
    points: Floats,
    values: Floats,
    rows: Indices,
) -> ArrayPair:
    """Replace the worst point of each sorted simplex, or shrink it towards the best."""
    # The factors are those of Gao and Han (2012) for r parameters, at least two.
    n = max(points.shape[-1], 2)
    expansion = 1 + 2 / n
    contraction = 0.75 - 1 / (2 * n)
    # One call evaluates four trials, (A, 4, r): the worst point reflected at the centre of the
    # others, then farther, nearer, and nearer on its own side.
    center = points[:, :-1].mean(axis=1)
    lengths = np.array([1.0, expansion, contraction, -contraction])
    steps = lengths[:, None] * (center - points[:, -1])[:, None]
    trials = center[:, None] + steps
    trial_values = value(trials, rows)
    # Take the reflected point, the farther one if that is better still, else a nearer one on either
    # side.
    reflected, expanded = trial_values[:, 0], trial_values[:, 1]
    best, second, worst = values[:, 0], values[:, -2], values[:, -1]
    trial = np.where(reflected < second, 0, 2)
    trial = np.where((reflected < best) & (expanded < reflected), 1, trial)
    trial = np.where(reflected >= worst, 3, trial)
    selected = np.arange(len(points)), trial
    # A nearer point has to be better than the reflected one, or than the worst if the reflected one
    # is not better.
    limit = np.where(trial == 2, reflected, np.inf)
    limit = np.where(trial == 3, worst, limit)
    is_accepted = (trial_values[selected] <= limit) & (trial_values[selected] < worst)
    points[is_accepted, -1] = trials[selected][is_accepted]
    values[is_accepted, -1] = trial_values[selected][is_accepted]
    shrinks = ~is_accepted
    if shrinks.any():
        vertex = points[shrinks, :1]
        nearer = vertex + (1 - 1 / n) * (points[shrinks, 1:] - vertex)
        points[shrinks, 1:] = nearer
        values[shrinks, 1:] = value(nearer, rows[shrinks])
    return _best_first(points, values)
