"""Other optima of the discrepancy, such as mirror solutions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from prbayes._checks import Floats
from prbayes.estimate.batch_bfgs import descend
from prbayes.estimate.sampling import Local
from prbayes.model.evaluator import Evaluator

_RIDGE = 9  # points looked at between two optima
_BARRIER = 1.0  # height, in units of the noise, that separates two optima
_COMPARABLE = 3.0  # difference, in units of the noise, up to which data could come from either optimum


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
        What the data see at ``best``; where they are blind, rivals are reported at the same place as ``best``.
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
        return evaluator.total(thetas.reshape(-1, thetas.shape[-1]), scales).reshape(thetas.shape[:-1])

    scale = local.prior_sd
    draws = evaluator.prior_points(8 * starts, seed)
    first = objective(draws)
    chosen = draws[np.argsort(first, kind="stable")[::4][:starts]]  # the better half, without crowding
    size = max(float(np.ptp(np.quantile(first[np.isfinite(first)], [0.0, 0.5]))), noise)
    if not size > 0:
        return []
    ends, values, _ = descend(
        lambda x, rows: objective(best + x * scale),
        (chosen - best) / scale,
        np.eye(best.size) / size,
        step=1e-3,
        tolerance=0.01 * noise,
    )
    kept = [(best, float(objective(best[None])[0]))]
    in_line = ends - ends @ local.unidentified @ local.unidentified.T
    also = objective(best + in_line * scale)
    ends, values = np.where((also < values + 0.01 * noise)[:, None], in_line, ends), np.minimum(also, values)
    for i in np.argsort(values):
        end, value = best + ends[i] * scale, float(values[i])
        if np.isfinite(value) and all(_separate(objective, end, value, *k, noise) for k in kept):
            kept.append((end, value))
    lowest = kept[0][1]
    return [Rival(t, v, v - lowest < _COMPARABLE * noise, v < lowest - 0.1 * noise) for t, v in kept[1:]]


def _separate(
    objective: Callable[[Floats], Floats], a: Floats, value_a: float, b: Floats, value_b: float, noise: float
) -> bool:
    share = np.linspace(0, 1, _RIDGE + 2)[1:-1, None]
    between = objective(a + share * (b - a))
    return bool(np.max(between) - max(value_a, value_b) > _BARRIER * noise)
