"""Other optima of the discrepancy, such as mirror solutions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from prbayes._checks import Floats
from prbayes.estimate.batch_bfgs import descend
from prbayes.estimate.sampling import Local
from prbayes.model.evaluator import Evaluator

# Points looked at between two optima; a barrier narrower than a tenth of the way is missed. By
# judgement.
_BETWEEN = 9
# Height of the barrier, in units of the noise, that separates two optima.
_BARRIER = 1.0
# Difference, in units of the noise, up to which data could come from either optimum; three of them
# are about the noise floor, since the noise is a third of it.
_COMPARABLE = 3.0
# Difference, in units of the noise, from which one is better than what was thought the best.
_BETTER = 0.1
# What the descents leave on the table, in units of the noise: far below both.
_TOLERANCE = 0.01
# Step of their differences, in spreads of the prior.
_STEP = 1e-3
# Points of the prior for each start: of the better half of them every fourth by rank is taken.
_CANDIDATES = 8
_EVERY = 4


@dataclass(frozen=True, eq=False)
class Rival:
    """An optimum of the discrepancy other than the best.

    Attributes
    ----------
    theta : ndarray, shape (d,)
    value : float
        The objective there.
    comparable : bool
        Whether it is as good as the best one up to sampling noise.
    better : bool
        Whether it is better than what was thought the best.
    """

    theta: Floats
    value: float
    comparable: bool
    better: bool


def rivals(
    evaluator: Evaluator,
    best: Floats,
    scales: Floats,
    local: Local,
    noise: float,
    *,
    starts: int,
    seed: int,
) -> list[Rival]:
    """Descend from points of the prior, all at once, and return the optima that a barrier separates from each other.

    Parameters
    ----------
    evaluator : Evaluator
    best : ndarray, shape (d,)
    scales : ndarray, shape (k,)
    local : Local
        What the data see at ``best``; where they are blind, rivals are reported at the same place
        as ``best``.
    noise : float
        A difference of the objective that sampling explains.
    starts : int
    seed : int

    Returns
    -------
    list of Rival
        Sorted by value; without ``best``.
    """

    def objective(thetas: Floats) -> Floats:
        flat = thetas.reshape(-1, thetas.shape[-1])
        return evaluator.total(flat, scales).reshape(thetas.shape[:-1])

    # Starts: the better half of points of the prior, without crowding.
    units = local.prior_sd
    points = evaluator.prior_points(_CANDIDATES * starts, seed)
    first = objective(points)
    ranked = np.argsort(first, kind="stable")
    chosen = points[ranked[::_EVERY][:starts]]
    quantiles = np.quantile(first[np.isfinite(first)], [0.0, 0.5])
    size = max(float(np.ptp(quantiles)), noise)
    if not size > 0:
        return []

    # Descend, all at once.
    ends, values, _ = descend(
        lambda x, rows: objective(best + x * units),
        (chosen - best) / units,
        np.eye(best.size) / size,
        step=_STEP,
        tolerance=_TOLERANCE * noise,
    )
    lowest = float(objective(best[None])[0])
    ends, values = _in_line(objective, best, units, local.unidentified, ends, values, noise)

    # Keep those that a barrier separates from all that are kept already.
    kept = [(best, lowest)]
    for i in np.argsort(values):
        end, value = best + ends[i] * units, float(values[i])
        if not np.isfinite(value):
            continue
        if all(_separate(objective, end, value, *other, noise) for other in kept):
            kept.append((end, value))
    return [_rival(theta, value, lowest, noise) for theta, value in kept[1:]]


def _in_line(
    objective: Callable[[Floats], Floats],
    best: Floats,
    units: Floats,
    unidentified: Floats,
    ends: Floats,
    values: Floats,
    noise: float,
) -> tuple[Floats, Floats]:
    """Move ends to where the best is along directions that are not identified, if that is as good."""
    in_line = ends - ends @ unidentified @ unidentified.T
    also = objective(best + in_line * units)
    as_good = also < values + _TOLERANCE * noise
    return np.where(as_good[:, None], in_line, ends), np.minimum(also, values)


def _rival(theta: Floats, value: float, lowest: float, noise: float) -> Rival:
    comparable = value - lowest < _COMPARABLE * noise
    better = value < lowest - _BETTER * noise
    return Rival(theta, value, comparable, better)


def _separate(
    objective: Callable[[Floats], Floats],
    a: Floats,
    value_a: float,
    b: Floats,
    value_b: float,
    noise: float,
) -> bool:
    """Return whether the objective between two optima is above both by more than the noise."""
    share = np.linspace(0, 1, _BETWEEN + 2)[1:-1, None]
    between = objective(a + share * (b - a))
    barrier = np.max(between) - max(value_a, value_b)
    return bool(barrier > _BARRIER * noise)
