"""All roots of f(x) = y: the inputs with which a response reproduces each measured specimen.

A mirror root that the error of the comparison does not exclude is kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats

# Coordinates (k, d) -> values (k, m), Jacobian (k, m, d). NaN where there is no response.
Response = Callable[[Floats], tuple[Floats, Floats]]


@dataclass(frozen=True, eq=False)
class Roots:
    """Roots of all specimens, one row each."""

    specimen: NDArray[np.intp]  # (R,): row of the specimen; sorted
    z: Floats  # (R, d)
    misfit: Floats  # (R,): half the squared standardised residual, in nats
    # (R, m): measured minus simulated outputs, in units of the comparison's standard deviation
    residual: Floats
    jacobian: Floats  # (R, m, d): of the outputs in the same units


def find_roots(
    response: Response, y: Floats, sd: Floats, starts: Floats, box: Floats, *, gap: float = 20.0
) -> Roots:
    """Find the roots of each specimen by Levenberg-Marquardt [1]_ from several starts, (N, S, d).

    ``y``, (N, m), are measured outputs, ``sd``, (m,) or (N, m), the standard deviations of the
    comparison, and ``box``, (2, d), bounds of the search. A root has a misfit of at most ``gap``
    nats above the specimen's best. Specimens whose starts all have no response have no root.

    References
    ----------
    .. [1] Moré, J. J. (1978), The Levenberg-Marquardt algorithm, doi:10.1007/BFb0067700.

    Examples
    --------
    >>> import numpy as np
    >>> def square(z):
    ...     return z**2, 2 * z[:, :, None]
    >>> starts = np.array([[[-2.0], [2.0], [3.0]]])
    >>> box = np.array([[-5.0], [5.0]])
    >>> find_roots(square, np.array([[1.0]]), np.array([0.01]), starts, box).z.ravel().round(6)
    array([-1.,  1.])
    """
    n, count, d = starts.shape
    specimen = np.repeat(np.arange(n), count)
    target = y[specimen]
    scale = np.broadcast_to(sd, y.shape)[specimen]

    def evaluate(z: Floats, rows: Any) -> tuple[Floats, Floats, Floats]:
        values, jacobian = response(z)
        residual = (target[rows] - values) / scale[rows]
        misfit = np.einsum("km,km->k", residual, residual) / 2
        misfit = np.where(np.isnan(misfit), np.inf, misfit)
        return residual, jacobian / scale[rows][:, :, None], misfit

    z = starts.reshape(-1, d).copy()
    residual, jacobian, misfit = evaluate(z, slice(None))
    damping = np.full(len(z), 1e-3)
    active = np.flatnonzero(np.isfinite(misfit))
    width = box[1] - box[0]
    for _ in range(60):
        if not active.size:
            break
        step = _damped_step(jacobian[active], residual[active], damping[active], width)
        trial = np.clip(z[active] + step, box[0], box[1])
        length = (np.abs(trial - z[active]) / width).max(axis=1)
        new_residual, new_jacobian, new_misfit = evaluate(trial, active)
        better = new_misfit < misfit[active]
        rows = active[better]
        z[rows], residual[rows] = trial[better], new_residual[better]
        jacobian[rows], misfit[rows] = new_jacobian[better], new_misfit[better]
        damping[active] = np.clip(damping[active] * np.where(better, 0.1, 8.0), 1e-12, 1e12)
        # A misfit of 1e-8 nats is zero; a rejected step that is this short is rounding.
        unfinished = (misfit[active] > 1e-8) & (length > 1e-11) & (damping[active] < 1e11)
        active = active[unfinished]
    rows = _distinct(specimen, z, misfit, jacobian, gap, width)
    # By place: misfits of nearly zero are in an order of rounding.
    rows = rows[np.lexsort((*z[rows].T[::-1], specimen[rows]))]
    return Roots(specimen[rows], z[rows], misfit[rows], residual[rows], jacobian[rows])


def _damped_step(jacobian: Floats, residual: Floats, damping: Floats, width: Floats) -> Floats:
    """Return the step of Levenberg-Marquardt, at most a quarter of the box."""
    normal = np.einsum("kmd,kme->kde", jacobian, jacobian)
    diagonal = np.einsum("kdd->kd", normal)
    # A coordinate without influence keeps its place.
    floor = 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-300
    added = damping[:, None] * np.maximum(diagonal, floor) + floor
    normal = normal + added[:, :, None] * np.eye(jacobian.shape[2])
    slope = np.einsum("kmd,km->kd", jacobian, residual)
    step = np.linalg.solve(normal, slope[..., None])[..., 0]
    return np.clip(step, -width / 4, width / 4)


def _distinct(
    specimen: NDArray[np.intp],
    z: Floats,
    misfit: Floats,
    jacobian: Floats,
    gap: float,
    width: Floats,
) -> NDArray[np.intp]:
    """Return the rows of different roots within the gap of the specimen's best."""
    least = np.full(specimen.max() + 1, np.inf)
    np.minimum.at(least, specimen, misfit)
    candidates = np.flatnonzero(np.isfinite(misfit) & (misfit <= least[specimen] + gap))
    candidates = candidates[np.lexsort((misfit[candidates], specimen[candidates]))]
    if not len(candidates):
        return candidates
    slots = rows_by_specimen(specimen[candidates])
    table = np.where(slots >= 0, candidates[slots], -1)
    is_root = table >= 0
    for k in range(1, table.shape[1]):
        # Each specimen's k-th candidate, beside the better ones.
        better = table[:, :k]
        difference = z[table[:, k], None] - z[better]
        # In units of the box, and in standard deviations of the Gauss-Newton approximation.
        distance = np.abs(difference / width).max(axis=2)
        standard = np.einsum("nkmd,nkd->nkm", jacobian[better], difference)
        is_within_error = (standard**2).sum(axis=2) < 1.0
        is_same = (distance < 1e-6) | (is_within_error & (distance < 1e-2))
        is_root[:, k] &= ~(is_same & is_root[:, :k]).any(axis=1)
    return table[is_root]


def rows_by_specimen(specimen: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the rows of each specimen, (N, most), filled up with -1; specimens are ascending."""
    count = np.bincount(specimen)
    slot = np.arange(len(specimen)) - np.repeat(np.cumsum(count) - count, count)
    table = np.full((len(count), count.max()), -1)
    table[specimen, slot] = np.arange(len(specimen))
    return table


def gabriel_neighbours(z: Floats, most: int = 32) -> NDArray[np.bool_]:
    """Return which pairs of points have no third point in the sphere between them, (n, n).

    Among the `most` nearest points of each. Gabriel and Sokal (1969), doi:10.2307/2412323.
    """
    squares = ((z[:, None] - z) ** 2).sum(axis=2)
    near = np.argsort(squares, axis=1, kind="stable")[:, 1 : most + 1]
    length = np.take_along_axis(squares, near, axis=1)
    by_third = length[:, :, None] + squares[near[:, :, None], near[:, None, :]]
    by_third += np.diag(np.full(near.shape[1], np.inf))
    is_neighbour = by_third.min(axis=1, initial=np.inf) >= length
    result = np.zeros(squares.shape, dtype=bool)
    np.put_along_axis(result, near, is_neighbour, axis=1)
    return result | result.T


def nearest_starts(
    run_z: Floats,
    run_y: Floats,
    y: Floats,
    spread: Floats,
    count: int,
    neighbours: NDArray[np.bool_],
) -> Floats:
    """Return starts of the search among the runs, by specimen, (N, S, d).

    First the runs whose outputs are nearer to the specimen's than those of all their neighbours,
    then those with the nearest outputs. The spread is infinite for outputs without a reading.
    """
    unit = np.broadcast_to(spread, y.shape)
    distance = np.zeros((len(y), len(run_y)))
    for measured, simulated, scale in zip(y.T, run_y.T, unit.T, strict=True):
        distance += ((measured[:, None] - simulated) / scale[:, None]) ** 2
    nearest = [distance[:, row].min(axis=1, initial=np.inf) for row in neighbours]
    least = np.array(nearest).T
    is_minimum = distance <= least
    order = np.lexsort((distance, ~is_minimum), axis=1)
    return run_z[order[:, : max(count, int(is_minimum.sum(axis=1).max()))]]
