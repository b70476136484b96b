"""BFGS for many small minimisations at once.

The minimisations of hundreds of data sets are small and alike, and calls of NumPy dominate their
cost: one call evaluates every row. `batched_simplex` does so for functions without slopes.
"""

from __future__ import annotations

from collections.abc import Callable
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
