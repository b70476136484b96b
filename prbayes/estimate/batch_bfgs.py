"""Many small minimisations at once: BFGS on rows that share an objective's form but not its data."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats

_HALVINGS = 8
_LONGEST = 3.0  # of a step, in the units of the parameters


def descend(
    value: Callable[[Floats, Any], Floats],
    start: Floats,
    inverse_hessian: Floats,
    *,
    step: float,
    tolerance: float,
    max_iterations: int = 40,
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Minimise B functions of r parameters of order one, each from its own start, all in step.

    Gradients are central differences. A row has converged when its next step promises to gain less than
    ``tolerance``, or when no shorter step gains anything.

    Parameters
    ----------
    value : callable
        ``value(x, rows)``, shapes (A, s, r), (A,) -> (A, s): function ``rows[a]`` at s points each.
    start : ndarray, shape (B, r)
    inverse_hessian : ndarray, shape (r, r)
        A first guess, positive definite.
    step : float
        Of the differences.
    tolerance : float
        In units of the functions.
    max_iterations : int

    Returns
    -------
    x : ndarray, shape (B, r)
    values : ndarray, shape (B,)
    converged : ndarray of bool, shape (B,)

    Examples
    --------
    >>> import numpy as np
    >>> centers = np.array([[0.0], [2.0]])
    >>> x, *_ = descend(lambda x, rows: ((x - centers[rows, None]) ** 2).sum(-1), np.zeros((2, 1)), np.eye(1),
    ...                 step=1e-3, tolerance=1e-9)
    >>> np.abs(x - centers).max() < 1e-4
    np.True_
    """
    size, r = start.shape
    x, inverse = start.copy(), np.repeat(inverse_hessian[None], size, axis=0)
    stencil = step * np.concatenate([np.zeros((1, r)), np.eye(r), -np.eye(r)])

    def look(points: Floats, rows: NDArray[np.intp]) -> tuple[Floats, Floats]:
        found = value(points[:, None] + stencil, rows)
        with np.errstate(invalid="ignore"):
            return found[:, 0], (found[:, 1 : 1 + r] - found[:, 1 + r :]) / (2 * step)

    active = np.arange(size)
    f, g = look(x, active)
    converged = np.zeros(size, dtype=bool)
    active = active[np.isfinite(f) & np.isfinite(g).all(axis=-1)]
    for _ in range(max_iterations):
        with np.errstate(over="ignore", invalid="ignore"):
            move = -np.einsum("bij,bj->bi", inverse[active], g[active])
            promise = -(move * g[active]).sum(axis=-1)
            length = np.abs(move).max(axis=-1)
        astray = ~np.isfinite(promise) | ~np.isfinite(length)
        active, move, promise, length = active[~astray], move[~astray], promise[~astray], length[~astray]
        done = promise < 2 * tolerance
        converged[active[done]] = True
        active, move, promise, length = active[~done], move[~done], promise[~done], length[~done]
        if not active.size:
            break
        move *= (_LONGEST / np.maximum(length, _LONGEST))[:, None]
        moved, new_f, new_g = x[active].copy(), f[active].copy(), g[active].copy()
        waiting, share = np.arange(active.size), 1.0
        for _ in range(_HALVINGS):
            trial = x[active[waiting]] + share * move[waiting]
            trial_f, trial_g = look(trial, active[waiting])
            with np.errstate(invalid="ignore"):
                ok = (trial_f <= f[active[waiting]] - 1e-4 * share * promise[waiting]) & np.isfinite(trial_g).all(-1)
            at = waiting[ok]
            moved[at], new_f[at], new_g[at] = trial[ok], trial_f[ok], trial_g[ok]
            waiting, share = waiting[~ok], share / 2
            if not waiting.size:
                break
        inverse[active] = _updated(inverse[active], moved - x[active], new_g - g[active])
        x[active], f[active], g[active] = moved, new_f, new_g
        converged[active[waiting]] = True
        active = np.delete(active, waiting)
    return x, f, converged


def _updated(inverse: Floats, s: Floats, y: Floats) -> Floats:
    """Return the BFGS update of inverse Hessians, shape (B, r, r), where it keeps them positive definite."""
    sy = (s * y).sum(axis=-1)
    good = sy > 1e-4 * np.linalg.norm(s, axis=-1) * np.linalg.norm(y, axis=-1)
    rho = np.where(good, 1 / np.where(good, sy, 1.0), 0.0)[:, None, None]
    left = np.eye(s.shape[-1]) - rho * s[:, :, None] * y[:, None, :]
    return np.asarray(left @ inverse @ np.swapaxes(left, -1, -2) + rho * s[:, :, None] * s[:, None, :])
