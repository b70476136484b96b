"""Minimisers of many small functions at once: BFGS, and the simplex of Nelder and Mead.

The minimisations of hundreds of data sets are small and alike, and calls of NumPy dominate their
cost: one call evaluates every row. BFGS needs slopes. A user's discrepancy may have kinks, as the
largest difference of two distribution functions, or flat pieces; a simplex only compares values.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats


@dataclass(frozen=True, eq=False)
class _Differences:
    """B functions and the differences that give their gradients."""

    value: Callable[[Floats, Any], Floats]
    step: float
    stencil: Floats  # (1 + r, r): center and neighbours; of central differences (1 + 2 r, r)
    to_gradient: Floats  # (r, r): slopes along the stencil's axes -> gradients
    bias: float  # of one-sided differences for a function of typical curvature

    @classmethod
    def of(
        cls,
        value: Callable[[Floats, Any], Floats],
        step: float,
        curvature: Floats,
        is_central: bool,
    ) -> _Differences:
        r = len(curvature)
        # Axes, of a mean length of one, along which a typical function has equal curvature: along
        # the coordinates of correlated parameters it is larger, and a one-sided difference would
        # move the minimum by as much.
        axes = np.linalg.inv(np.linalg.cholesky(curvature))
        axes *= np.sqrt(r) / np.linalg.norm(axes)
        mean_curvature = float(np.trace(axes @ curvature @ axes.T)) / r
        sides = [step * axes, -step * axes] if is_central else [step * axes]
        return cls(
            value=value,
            step=step,
            stencil=np.concatenate([np.zeros((1, r)), *sides]),
            to_gradient=np.linalg.inv(axes).T,
            bias=step * mean_curvature / 2,
        )

    def __call__(self, x: Floats, rows: NDArray[np.intp]) -> tuple[Floats, Floats]:
        """Return values (A,) and gradients (A, r) of selected rows at a point each, (A, r)."""
        values = self.value(x[:, None] + self.stencil, rows)
        center, up, down = np.split(values, [1, 1 + x.shape[-1]], axis=1)
        with np.errstate(invalid="ignore"):
            if down.size:
                slopes = (up - down) / (2 * self.step)
            else:
                slopes = (up - center) / self.step - self.bias
            return center[:, 0], slopes @ self.to_gradient


class Minima(NamedTuple):
    """Ends of descents."""

    x: Floats  # (B, r)
    values: Floats  # (B,)
    converged: NDArray[np.bool_]  # (B,)


def descend(
    value: Callable[[Floats, Any], Floats],
    start: Floats,
    curvature: Floats,
    *,
    step: float,
    tolerance: float,
    max_iterations: int = 40,
    is_central: bool = False,
) -> Minima:
    """Minimise B functions of r parameters of order one, each from its start, all in step.

    Gradients are one-sided differences, along axes of equal ``curvature``, less their bias for it:
    minima are off by half a step, times the relative deviation of a function's Hessian. A row has
    converged when its next step is predicted to gain less than ``tolerance``, or when no shorter
    step gains anything.

    Parameters
    ----------
    value : callable
        ``value(x, rows)``, shapes (A, s, r), (A,) -> (A, s): function ``rows[a]`` at s points each.
    start : ndarray, shape (B, r)
    curvature : ndarray, shape (r, r)
        The Hessian of a typical function, positive definite.
    step : float
        Of the differences.
    tolerance : float
        In units of the functions.
    max_iterations : int
    is_central : bool
        Whether differences are central, at twice the cost: minima are then exact where functions
        have other Hessians than the typical one.

    References
    ----------
    .. [1] Nocedal, J. and S. J. Wright (2006), Numerical Optimization, chapter 6,
       doi:10.1007/978-0-387-40065-5.

    Examples
    --------
    >>> import numpy as np
    >>> centers = np.array([[0.0], [2.0]])
    >>> value = lambda x, rows: ((x - centers[rows, None]) ** 2).sum(-1)
    >>> minima = descend(value, np.zeros((2, 1)), 2 * np.eye(1), step=1e-3, tolerance=1e-9)
    >>> np.abs(minima.x - centers).max() < 1e-4
    np.True_
    """
    size, r = start.shape
    problem = _Differences.of(value, step, curvature, is_central)
    x = start.copy()
    inverse = np.broadcast_to(np.linalg.inv(curvature), (size, r, r)).copy()
    rows = np.arange(size)
    f, g = problem(x, rows)
    converged = np.zeros(size, dtype=bool)
    # Rows without a finite value and gradient at the start stay there.
    rows = rows[np.isfinite(f) & np.isfinite(g).all(axis=-1)]
    for iteration in range(max_iterations):
        steps, gain, is_finite = _quasi_newton_steps(inverse[rows], g[rows])
        is_flat = is_finite & (gain < 2 * tolerance)
        converged[rows[is_flat]] = True
        moves = is_finite & ~is_flat
        rows, steps, gain = rows[moves], steps[moves], gain[moves]
        if not rows.size:
            break
        new_x, new_f, new_g, stuck = _line_search(problem, rows, steps, gain, x, f, g)
        motion = new_x - x[rows]
        change = new_g - g[rows]
        estimate = inverse[rows]
        if iteration == 0:  # the form of a first guess may be better than its size
            estimate = _scaled(estimate, motion, change)
        inverse[rows] = _updated(estimate, motion, change)
        x[rows], f[rows], g[rows] = new_x, new_f, new_g
        # No shorter step helps these rows.
        converged[rows[stuck]] = True
        rows = np.delete(rows, stuck)
    return Minima(x, f, converged)


@dataclass(frozen=True, eq=False)
class Descent:
    """A minimiser of many functions of coordinates at once."""

    curvature: Floats  # (r, r): the Hessian of a typical function
    tolerance: float  # gain that a minimum may miss
    step: float  # of the differences

    def __call__(self, value: Callable[[Floats, Any], Floats], start: Floats) -> Minima:
        """Return minimisers from starts (B, r) on."""
        return descend(value, start, self.curvature, step=self.step, tolerance=self.tolerance)


def _quasi_newton_steps(inverse: Floats, g: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return steps of limited length, twice their predicted gain, and which are finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        steps = -np.einsum("bij,bj->bi", inverse, g)
        gain = -(steps * g).sum(axis=-1)
        length = np.abs(steps).max(axis=-1)
        # A quadratic model is wrong beyond a few standard errors, or prior standard deviations.
        longest = 3.0
        steps = steps * (longest / np.maximum(length, longest))[:, None]
    return steps, gain, np.isfinite(gain) & np.isfinite(length)


def _line_search(
    problem: _Differences,
    rows: NDArray[np.intp],
    steps: Floats,
    gain: Floats,
    x: Floats,
    f: Floats,
    g: Floats,
) -> tuple[Floats, Floats, Floats, NDArray[np.intp]]:
    """Halve the steps of rows until they gain enough; last come the rows that gain nothing."""
    new_x, new_f, new_g = x[rows].copy(), f[rows].copy(), g[rows].copy()
    waiting = np.arange(rows.size)
    factor = 1.0
    # A 1/256 of a step is no worse than none.
    for _ in range(8):
        waiting_rows = rows[waiting]
        trial = x[waiting_rows] + factor * steps[waiting]
        trial_f, trial_g = problem(trial, waiting_rows)
        with np.errstate(invalid="ignore"):
            # Sufficient decrease: Nocedal and Wright, eq. 3.4.
            decreases = trial_f <= f[waiting_rows] - 1e-4 * factor * gain[waiting]
        accepted = decreases & np.isfinite(trial_g).all(-1)
        places = waiting[accepted]
        new_x[places] = trial[accepted]
        new_f[places] = trial_f[accepted]
        new_g[places] = trial_g[accepted]
        waiting = waiting[~accepted]
        factor = factor / 2
        if not waiting.size:
            break
    return new_x, new_f, new_g, waiting


def _scaled(inverse: Floats, s: Floats, y: Floats) -> Floats:
    """Return first guesses of inverse Hessians, (B, r, r), in the size of a first step.

    Nocedal and Wright, eq. 6.20, with the guess in place of the identity.
    """
    sy, is_curved = _curvature(s, y)
    expected = np.einsum("bi,bij,bj->b", y, inverse, y)
    factors = np.where(is_curved, sy, 1.0) / np.where(is_curved, expected, 1.0)
    return np.asarray(factors[:, None, None] * inverse)


def _updated(inverse: Floats, s: Floats, y: Floats) -> Floats:
    """Return the BFGS update of inverse Hessians, (B, r, r), if they stay positive definite.

    Nocedal and Wright, eq. 6.17.
    """
    sy, is_curved = _curvature(s, y)
    # rho = 0 leaves the matrix as it is.
    reciprocal = np.where(is_curved, 1 / np.where(is_curved, sy, 1.0), 0.0)
    column = reciprocal[:, None, None] * s[:, :, None]
    left = np.eye(s.shape[-1]) - column * y[:, None, :]
    right = np.swapaxes(left, -1, -2)
    return np.asarray(left @ inverse @ right + column * s[:, None, :])


def _curvature(s: Floats, y: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the products of steps and changes of slopes, and which show a curvature, (B,)."""
    sy = (s * y).sum(axis=-1)
    # Nearly orthogonal steps and changes would spoil the inverse Hessian.
    lengths = np.linalg.norm(s, axis=-1)
    changes = np.linalg.norm(y, axis=-1)
    return sy, sy > 1e-4 * lengths * changes


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
