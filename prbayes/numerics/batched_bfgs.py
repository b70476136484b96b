"""Many small minimisations at once: BFGS on rows that share an objective's form but not its data.

Single minimisations run scipy's methods. Those of hundreds of data sets are small and alike, and
what they cost is calls of NumPy, so that all of them go in step: one call evaluates every row. No
library at hand does that, which is why the package has this minimiser of its own, and beside it
`batch_simplex` for functions without slopes.
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
    stencil: Floats  # (1 + r, r): here, and beside; of central differences (1 + 2 r, r)
    back: Floats  # (r, r): slopes along the stencil's axes -> gradients
    bend: float  # excess of one-sided differences for a function of typical curvature

    @classmethod
    def of(
        cls,
        value: Callable[[Floats, Any], Floats],
        step: float,
        curvature: Floats,
        is_central: bool,
    ) -> _Differences:
        r = len(curvature)
        # Axes along which a typical function is bent alike, of a mean length of one: along others a
        # function of coordinates that hang together is bent by much more than it is across them,
        # and a difference to one side would move its minimum by as much.
        axes = np.linalg.inv(np.linalg.cholesky(curvature))
        axes *= np.sqrt(r) / np.linalg.norm(axes)
        bent = float(np.trace(axes @ curvature @ axes.T)) / r
        sides = [step * axes, -step * axes] if is_central else [step * axes]
        return cls(
            value=value,
            step=step,
            stencil=np.concatenate([np.zeros((1, r)), *sides]),
            back=np.linalg.inv(axes).T,
            bend=step * bent / 2,
        )

    def __call__(self, x: Floats, rows: NDArray[np.intp]) -> tuple[Floats, Floats]:
        """Return values (A,) and gradients (A, r) of some rows at one point each, (A, r)."""
        points = x[:, None] + self.stencil
        values = self.value(points, rows)
        here, up, down = np.split(values, [1, 1 + x.shape[-1]], axis=1)
        with np.errstate(invalid="ignore"):
            if down.size:
                slopes = (up - down) / (2 * self.step)
            else:
                slopes = (up - here) / self.step - self.bend
            return here[:, 0], slopes @ self.back


@dataclass(frozen=True, eq=False)
class _Steps:
    """What some of the rows are to do next."""

    rows: NDArray[np.intp]  # (A,)
    steps: Floats  # (A, r)
    promise: Floats  # (A,): twice the gain that a quadratic model promises

    def only(self, these: NDArray[np.bool_]) -> _Steps:
        """Return those of some rows."""
        rows = self.rows[these]
        steps = self.steps[these]
        return _Steps(rows, steps, self.promise[these])


@dataclass(frozen=True, eq=False)
class _Accepted:
    """Where a line search arrived: points, values and gradients, and which rows gained nothing."""

    x: Floats
    f: Floats
    g: Floats
    stuck: NDArray[np.intp]


class Minima(NamedTuple):
    """Where descents ended."""

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
    """Minimise B functions of r parameters of order one, each from its own start, all in step.

    Gradients are one-sided differences, along axes that ``curvature`` makes alike, and freed of
    what it bends them by: minima are off by half a step, times the relative deviation of a
    function's Hessian. A row has converged when its next step promises to gain less than
    ``tolerance``, or when no shorter step gains anything.

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
    >>> found = descend(value, np.zeros((2, 1)), 2 * np.eye(1), step=1e-3, tolerance=1e-9)
    >>> np.abs(found.x - centers).max() < 1e-4
    np.True_
    """
    size, r = start.shape
    problem = _Differences.of(value, step, curvature, is_central)
    x = start.copy()
    inverse = np.broadcast_to(np.linalg.inv(curvature), (size, r, r)).copy()
    active = np.arange(size)
    f, g = problem(x, active)
    converged = np.zeros(size, dtype=bool)
    # Where nothing is known at the start, nothing can be done.
    sound = np.isfinite(f)
    sound &= np.isfinite(g).all(axis=-1)
    active = active[sound]
    for iteration in range(max_iterations):
        # Rows whose step is no number stop; those that promise next to nothing have converged.
        plan = _planned(active, inverse, g)
        done = plan.promise < 2 * tolerance
        converged[plan.rows[done]] = True
        plan = plan.only(~done)
        active = plan.rows
        if not active.size:
            break
        # Make the step, and learn from it.
        accepted = _line_search(problem, plan, x, f, g)
        motion = accepted.x - x[active]
        change = accepted.g - g[active]
        known = inverse[active]
        if iteration == 0:  # a first guess may be of the wrong size, if of the right form
            known = _scaled(known, motion, change)
        inverse[active] = _updated(known, motion, change)
        # Book-keeping.
        x[active] = accepted.x
        f[active] = accepted.f
        g[active] = accepted.g
        # Rows that no shorter step helped stay where they are.
        stuck = accepted.stuck
        converged[active[stuck]] = True
        active = np.delete(active, stuck)
    return Minima(x, f, converged)


@dataclass(frozen=True, eq=False)
class Descent:
    """How functions of coordinates are minimised, many at once."""

    curvature: Floats  # (r, r): the Hessian of a typical function
    tolerance: float  # gain that is left on the table
    step: float  # of the differences

    def __call__(self, value: Callable[[Floats, Any], Floats], start: Floats) -> Minima:
        """Return minimisers from starts (B, r) on."""
        return descend(value, start, self.curvature, step=self.step, tolerance=self.tolerance)


def _planned(active: NDArray[np.intp], inverse: Floats, g: Floats) -> _Steps:
    """Return quasi-Newton steps of the active rows, none too long."""
    slopes = g[active]
    with np.errstate(over="ignore", invalid="ignore"):
        steps = -np.einsum("bij,bj->bi", inverse[active], slopes)
        promise = -(steps * slopes).sum(axis=-1)
        length = np.abs(steps).max(axis=-1)
        # Beyond a few standard errors, or prior standard deviations, a quadratic model says
        # nothing.
        longest = 3.0
        shorter = longest / np.maximum(length, longest)
        steps = steps * shorter[:, None]
    sound = np.isfinite(promise) & np.isfinite(length)
    plan = _Steps(active, steps, promise)
    return plan.only(sound)


def _line_search(problem: _Differences, plan: _Steps, x: Floats, f: Floats, g: Floats) -> _Accepted:
    """Halve the steps until they keep enough of what they promise."""
    rows = plan.rows
    new_x = x[rows].copy()
    new_f = f[rows].copy()
    new_g = g[rows].copy()
    waiting = np.arange(rows.size)
    share = 1.0
    # A 1/256 of a step is no worse than none.
    for _ in range(8):
        these = rows[waiting]
        steps = plan.steps[waiting]
        trial = x[these] + share * steps
        trial_f, trial_g = problem(trial, these)
        finite = np.isfinite(trial_g).all(-1)
        with np.errstate(invalid="ignore"):
            # Of the promised gain, that a step has to keep: Nocedal and Wright, eq. 3.4.
            promised = 1e-4 * share * plan.promise[waiting]
            enough = trial_f <= f[these] - promised
        # Rows that keep the step are done; the others wait for half of it.
        kept = enough & finite
        at = waiting[kept]
        new_x[at] = trial[kept]
        new_f[at] = trial_f[kept]
        new_g[at] = trial_g[kept]
        waiting = waiting[~kept]
        share = share / 2
        if not waiting.size:
            break
    return _Accepted(new_x, new_f, new_g, waiting)


def _scaled(inverse: Floats, s: Floats, y: Floats) -> Floats:
    """Return first guesses of inverse Hessians, (B, r, r), in the size that a first step found.

    Nocedal and Wright, eq. 6.20, with the guess in place of the identity.
    """
    sy, good = _curved(s, y)
    expected = np.einsum("bi,bij,bj->b", y, inverse, y)
    factors = np.where(good, sy, 1.0) / np.where(good, expected, 1.0)
    return np.asarray(factors[:, None, None] * inverse)


def _updated(inverse: Floats, s: Floats, y: Floats) -> Floats:
    """Return the BFGS update of inverse Hessians, (B, r, r), where it keeps them positive definite.

    Nocedal and Wright, eq. 6.17.
    """
    sy, good = _curved(s, y)
    # The others have rho = 0, which leaves them as they are.
    safe = np.where(good, sy, 1.0)
    inverted = np.where(good, 1 / safe, 0.0)
    rho = inverted[:, None, None]
    # The products s y' and s s' of each row.
    column = rho * s[:, :, None]
    across = column * y[:, None, :]
    along = column * s[:, None, :]
    left = np.eye(s.shape[-1]) - across
    right = np.swapaxes(left, -1, -2)
    turned = left @ inverse @ right
    return np.asarray(turned + along)


def _curved(s: Floats, y: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the products of steps and changes of slopes, and which tell of a curvature, (B,)."""
    sy = (s * y).sum(axis=-1)
    lengths = np.linalg.norm(s, axis=-1)
    changes = np.linalg.norm(y, axis=-1)
    # Steps and changes that are nearly orthogonal would spoil the inverse Hessian.
    return sy, sy > 1e-4 * lengths * changes
