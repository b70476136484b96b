"""Where else the data could come from: mirror solutions, and directions that the data do not see."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from prbayes._checks import Floats
from prbayes.descent import descend
from prbayes.information import Local
from prbayes.population import Evaluator

_RIDGE = 9  # points looked at between two optima
_BARRIER = 1.0  # height, in units of the noise, that separates two optima
_COMPARABLE = 3.0  # difference, in units of the noise, up to which data could come from either optimum
_SHARE = 0.15  # of an element in a direction below which it is not mentioned


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

    scale = local.scale
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
    in_line = ends - ends @ local.blind @ local.blind.T
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


def blind_directions(blind: Floats, names: list[str]) -> list[str]:
    """Name the directions about which the data tell less than the prior, such as 'mu[0] - 0.8 mu[1]'."""
    found = []
    # Rotated so that elements stand alone where they can.
    basis = blind
    while basis.shape[1]:
        projector = basis @ basis.T
        i = int(np.argmax(np.diag(projector)))
        direction = projector[i] / np.sqrt(projector[i, i])
        found.append(_named(direction, names))
        rest = basis - np.outer(direction, direction @ basis)
        left, strength, _ = np.linalg.svd(rest, full_matrices=False)
        basis = left[:, strength > 1e-6]
    return found


def _named(direction: Floats, names: list[str]) -> str:
    largest = direction[np.argmax(np.abs(direction))]
    parts = []
    for share, name in sorted(zip(direction / largest, names, strict=True), key=lambda p: -abs(p[0])):
        if abs(share) > _SHARE:
            size = "" if abs(share) > 0.95 else f"{abs(share):.1f} "
            parts.append(f"{'-' if share < 0 else '+'} {size}{name}")
    return " ".join(parts).removeprefix("+ ")
