"""Other optima of the discrepancy, such as mirror solutions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from prbayes._checks import Floats
from prbayes.estimate.batch_bfgs import descend
from prbayes.estimate.objective import Hold
from prbayes.estimate.refinement import visited
from prbayes.estimate.sampling import Local
from prbayes.model.evaluator import Evaluator
from prbayes.model.support import shortcomings

# Difference, in multiples of the noise, up to which data could come from either optimum; three of
# them are about the noise floor, since the noise is a third of it.
_COMPARABLE = 3.0
# Difference, in multiples of the noise, from which one is better than what was thought the best.
_BETTER = 0.1
# Points of the prior looked at for each start; the better half of them, thinned, are the starts.
# benchmarks/constants.py: half and twice as many find the same optima.
_LOOKED_AT = 8
# Steps of the way between two optima at which a barrier is looked for: one narrower is missed.
_SECTIONS = 10
# Times that the way between two optima is halved, to find one that is not straight.
_WAY_HALVED = 5
# Times that points are drawn where a descent on too few of them has ended.
_VISITS = 4
# Multiples of the noise that are nothing: what descents stop at, and what may be given up.
_NEGLIGIBLE = 0.01


@dataclass(frozen=True, eq=False)
class Rival:
    """An optimum of the discrepancy other than the best."""

    theta: Floats  # (d,)
    value: float  # the objective there
    comparable: bool  # whether it is as good as the best one up to sampling noise
    better: bool  # whether it is better than what was thought the best


@dataclass(frozen=True, eq=False)
class _Objective:
    """The objective in theta, and in units of the prior's spread around the best one."""

    evaluator: Evaluator
    scales: Floats
    best: Floats
    prior_sd: Floats
    hold: Hold | None  # what is added to it

    def __call__(self, thetas: Floats) -> Floats:
        """Return values of thetas, (..., d) -> (...)."""
        stacked = thetas.reshape(-1, thetas.shape[-1])
        values = self.evaluator.total(stacked, self.scales)
        if self.hold is not None:
            values = values + self.hold(stacked, self.prior_sd)
        return values.reshape(thetas.shape[:-1])

    def theta(self, x: Floats) -> Floats:
        """Return thetas, (..., d), of shifts in units of the prior's spread."""
        return np.asarray(self.best + x * self.prior_sd)

    def along(self, x: Floats, rows: Any) -> Floats:
        """Return values of shifts; the same function for all rows."""
        return self(self.theta(x))

    def polished(self, thetas: Floats, local: Local, noise: float) -> tuple[Floats, Floats]:
        """Return minima near thetas, (n, d), and their values: they are bent about as at best."""
        known = local.identified @ local.covariance @ local.identified.T
        inverse = (known + local.unidentified @ local.unidentified.T) / noise
        shifts = (thetas - self.best) / self.prior_sd
        tolerance = _NEGLIGIBLE * noise
        ends, values, *_ = descend(self.along, shifts, inverse, step=1e-3, tolerance=tolerance)
        return self.theta(ends), values


def _starts(objective: _Objective, n: int, noise: float, seed: int) -> tuple[Floats, float]:
    """Return shifts to begin at, (n, d), and the typical size of the objective among the priors'.

    They are the better half of points of the prior, without crowding.
    """
    points = objective.evaluator.prior_points(_LOOKED_AT * n, seed)
    values = objective(points)
    ranked = np.argsort(values, kind="stable")
    thinned = ranked[: len(ranked) // 2 : max(_LOOKED_AT // 2, 1)]
    chosen = points[thinned[:n]]
    finite = values[np.isfinite(values)]
    quantiles = np.quantile(finite, [0.0, 0.5])
    half = float(np.ptp(quantiles))
    size = max(half, noise)
    shifts = (chosen - objective.best) / objective.prior_sd
    return shifts, size


def rivals(
    evaluator: Evaluator,
    best: Floats,
    scales: Floats,
    local: Local,
    noise: float,
    *,
    starts: int,
    seed: int,
    hold: Hold | None = None,
) -> list[Rival]:
    """Descend from points of the prior, and return the optima that barriers separate.

    Parameters
    ----------
    evaluator : Evaluator
    best : ndarray, shape (d,)
    scales : ndarray, shape (k,)
    local : Local
        What the data identify at ``best``; along the other directions, rivals are reported at the
        same place as ``best``.
    noise : float
        A difference of the objective that sampling explains.
    starts : int
    seed : int
    hold : Hold, optional
        What held the search for ``best``: rivals are those of the same objective.

    Returns
    -------
    list of Rival
        Sorted by value; without ``best``.
    """
    objective = _Objective(evaluator, scales, best, local.prior_sd, hold)
    starts_at, size = _starts(objective, starts, noise, seed)
    if not size > 0:
        return []

    # Descend, all at once.
    ends, values, *_ = descend(
        objective.along,
        starts_at,
        np.eye(best.size) / size,
        step=1e-3,
        tolerance=_NEGLIGIBLE * noise,
    )
    lowest = float(objective(best[None])[0])
    ends, values = _in_line(objective, local.unidentified, ends, values, noise)

    return _kept(objective, objective.theta(ends), values, lowest, noise)


def standing(
    evaluator: Evaluator,
    best: Floats,
    scales: Floats,
    local: Local,
    noise: float,
    thetas: Floats,
    *,
    hold: Hold | None = None,
) -> list[Rival]:
    """Return optima near thetas, (n, d), on designs as they are now.

    Other parameters, and what is returned, are those of `rivals`.
    """
    objective = _Objective(evaluator, scales, best, local.prior_sd, hold)
    lowest = float(objective(best[None])[0])
    ends, values = objective.polished(thetas, local, noise)
    return _kept(objective, ends, values, lowest, noise)


def _kept(
    objective: _Objective, ends: Floats, values: Floats, lowest: float, noise: float
) -> list[Rival]:
    """Return those that a barrier separates from the best one and from all that are kept."""
    kept = [(objective.best, lowest)]
    for i in np.argsort(values):
        value = float(values[i])
        if not np.isfinite(value):
            continue
        separate = (_separate(objective, ends[i], value, *other, noise) for other in kept)
        if all(separate):
            kept.append((ends[i], value))
    return [_rival(theta, value, lowest, noise) for theta, value in kept[1:]]


def visit(
    evaluator: Evaluator,
    best: Floats,
    scales: Floats,
    local: Local,
    noise: float,
    theta: Floats,
    *,
    hold: Hold | None = None,
) -> Floats | None:
    """Return where an optimum that clouds do not support is once they reach it; None if nowhere.

    Few points of a cloud far away have minima of their own, and values of their own at those of
    all. What they hide is a mirror image, which is as good as the best one: worse by less than the
    noise. Other parameters are those of `rivals`.
    """
    objective = _Objective(evaluator, scales, best, local.prior_sd, hold)
    for _ in range(_VISITS):
        with visited(evaluator, np.stack([best, theta])):
            if shortcomings(evaluator, theta[None]):
                return None
            lowest = float(objective(best[None])[0])
            (theta,), (value,) = objective.polished(theta[None], local, noise)
            if not value - lowest < noise:
                return None
            found = not shortcomings(evaluator, theta[None])
        if found:
            break
    else:
        return None
    return None if _joined(objective, best, theta, local, noise, _WAY_HALVED) else theta


def _joined(
    objective: _Objective, a: Floats, b: Floats, local: Local, noise: float, times: int
) -> bool:
    """Return whether a way leads from one point to another that is nowhere above both.

    Straight, or along a valley: from where the middle of the way goes down to. Clouds reach it.
    """
    way = np.linspace(a, b, 3)
    with visited(objective.evaluator, way):
        value_a, value_b = map(float, objective(way[[0, -1]]))
        if not _separate(objective, a, value_a, b, value_b, noise):
            return True
        (middle,), (value,) = objective.polished(way[1:2], local, noise)
    if not times or not value < max(value_a, value_b) + noise:
        return False
    first = _joined(objective, a, middle, local, noise, times - 1)
    return first and _joined(objective, middle, b, local, noise, times - 1)


def excluded(evaluator: Evaluator, best: Floats, found: list[Rival], noises: Floats) -> list[Rival]:
    """Return optima, not comparable where one simulator alone tells them from the best.

    The noise of several simulators together grows with their number, and would hide it.

    Parameters
    ----------
    evaluator : Evaluator
    best : ndarray, shape (d,)
    found : list of Rival
    noises : ndarray, shape (k,)
        By simulator: a difference of its discrepancy that sampling explains.
    """
    if len(noises) < 2 or not found:
        return found
    thetas = np.array([best, *(rival.theta for rival in found)])
    discrepancies = evaluator(thetas).discrepancies
    worse = discrepancies[1:] - discrepancies[0]
    told = (worse > _COMPARABLE * noises).any(axis=1)
    return [
        replace(rival, comparable=rival.comparable and not alone)
        for rival, alone in zip(found, told, strict=True)
    ]


def _in_line(
    objective: _Objective,
    unidentified: Floats,
    ends: Floats,
    values: Floats,
    noise: float,
) -> tuple[Floats, Floats]:
    """Move ends to where the best is along what is not identified, if that is as good."""
    hidden = ends @ unidentified @ unidentified.T
    in_line = ends - hidden
    also = objective.along(in_line, None)
    as_good = also < values + _NEGLIGIBLE * noise
    aligned = np.where(as_good[:, None], in_line, ends)
    return aligned, np.minimum(also, values)


def _rival(theta: Floats, value: float, lowest: float, noise: float) -> Rival:
    comparable = value - lowest < _COMPARABLE * noise
    better = value < lowest - _BETTER * noise
    return Rival(theta, value, comparable, better)


def _separate(
    objective: _Objective,
    a: Floats,
    value_a: float,
    b: Floats,
    value_b: float,
    noise: float,
) -> bool:
    """Return whether the objective between two optima is above both by more than the noise."""
    share = np.linspace(0, 1, _SECTIONS + 1)
    inside = share[1:-1, None]
    between = objective(a + inside * (b - a))
    barrier = np.max(between) - max(value_a, value_b)
    return bool(barrier > noise)
