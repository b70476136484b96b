"""Other optima of the discrepancy, such as mirror solutions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from prbayes._validate import Floats
from prbayes.inference.asymptotics import Local
from prbayes.model.coverage import shortcomings
from prbayes.model.evaluator import Evaluator
from prbayes.numerics.batched_bfgs import Minima, descend
from prbayes.optimize.design_refinement import visited
from prbayes.optimize.objective import Hold

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
# Times that descents go on from where they ended, at most; once or twice does, by judgement.
_GOING_ON = 8
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
class Best:
    """What is known of the best optimum, and the objective in units of the prior's spread around.

    Rivals are those of the same objective, with what held the search for it.
    """

    evaluator: Evaluator
    theta: Floats  # (d,)
    scales: Floats  # (k,)
    # What the data identify there; along the other directions, rivals are reported at its place.
    local: Local
    noise: float  # a difference of the objective that sampling explains
    hold: Hold | None = None  # what is added to the objective

    def __call__(self, thetas: Floats) -> Floats:
        """Return values of thetas, (..., d) -> (...)."""
        stacked = thetas.reshape(-1, thetas.shape[-1])
        values = self._held(stacked, self.evaluator.total(stacked, self.scales))
        return values.reshape(thetas.shape[:-1])

    def _held(self, thetas: Floats, values: Floats) -> Floats:
        if self.hold is None:
            return values
        return values + self.hold(thetas, self.local.prior_sd)

    def shifts(self, thetas: Floats) -> Floats:
        """Return how far thetas, (..., d), are from the best one."""
        return np.asarray((thetas - self.theta) / self.local.prior_sd)

    def thetas(self, shifts: Floats) -> Floats:
        """Return the thetas of shifts, (..., d)."""
        return np.asarray(self.theta + shifts * self.local.prior_sd)

    def along(self, shifts: Floats, rows: Any) -> Floats:
        """Return values of shifts; the same function for all rows."""
        return self(self.thetas(shifts))

    def descended(self, shifts: Floats, curvature: Floats) -> Minima:
        """Return the minima that shifts, (n, d), lead to."""
        return descend(
            self.along,
            shifts,
            curvature,
            step=1e-3,
            tolerance=_NEGLIGIBLE * self.noise,
            is_central=True,
        )

    def polished(self, thetas: Floats) -> tuple[Floats, Floats]:
        """Return minima near thetas, (n, d), and their values: they are bent about as at best."""
        local = self.local
        known = local.identified @ local.covariance @ local.identified.T
        inverse = (known + local.unidentified @ local.unidentified.T) / self.noise
        variances, axes = np.linalg.eigh(inverse)
        # A standard error may be zero, as where all responses are on one side of the data.
        if not variances.max() > 0:
            return thetas, self(thetas)
        variances = np.maximum(variances, 1e-12 * variances.max())
        ends, values, *_ = self.descended(self.shifts(thetas), (axes / variances) @ axes.T)
        return self.thetas(ends), values


def _starts(best: Best, n: int, seed: int) -> tuple[Floats, float]:
    """Return shifts to begin at, (n, d), and the typical size of the objective among the priors'.

    They are the better half of points of the prior, without crowding.
    """
    points = best.evaluator.hyperparameters.prior_points(_LOOKED_AT * n, seed)
    values = best(points)
    ranked = np.argsort(values, kind="stable")
    thinned = ranked[: len(ranked) // 2 : max(_LOOKED_AT // 2, 1)]
    chosen = points[thinned[:n]]
    finite = values[np.isfinite(values)]
    quantiles = np.quantile(finite, [0.0, 0.5])
    half = float(np.ptp(quantiles))
    return best.shifts(chosen), max(half, best.noise)


def rivals(best: Best, *, starts: int, seed: int) -> list[Rival]:
    """Descend from points of the prior, and return the optima that barriers separate.

    Returns
    -------
    list of Rival
        Sorted by value; without the best.
    """
    starts_at, size = _starts(best, starts, seed)
    if not size > 0:
        return []

    # Descend, all at once.
    ends, values, *_ = best.descended(starts_at, size * np.eye(best.theta.size))
    lowest = float(best(best.theta[None])[0])
    ends, values = _in_line(best, ends, values)

    found = _kept(best, best.thetas(ends), values, lowest)
    if not found:
        return []
    thetas = np.stack([rival.theta for rival in found])
    values = np.array([rival.value for rival in found])
    # In a bent valley a descent ends where it has not learned how flat that is.
    for _ in range(_GOING_ON):
        before = values
        thetas, values = best.polished(thetas)
        if not (before - values > _NEGLIGIBLE * best.noise).any():
            break
    return _kept(best, thetas, values, lowest)


def standing(best: Best, thetas: Floats) -> list[Rival]:
    """Return optima near thetas, (n, d), on designs as they are now, as `rivals` does."""
    lowest = float(best(best.theta[None])[0])
    ends, values = best.polished(thetas)
    return _kept(best, ends, values, lowest)


def _kept(best: Best, ends: Floats, values: Floats, lowest: float) -> list[Rival]:
    """Return those that a barrier separates from the best one and from all that are kept."""
    kept = [(best.theta, lowest)]
    for i in np.argsort(values):
        value = float(values[i])
        if not np.isfinite(value):
            continue
        separate = (_separate(best, ends[i], value, *other) for other in kept)
        if all(separate):
            kept.append((ends[i], value))
    return [_rival(theta, value, lowest, best.noise) for theta, value in kept[1:]]


def visit(best: Best, theta: Floats) -> Floats | None:
    """Return where an optimum that clouds do not support is once they reach it; None if nowhere.

    Few points of a cloud far away have minima of their own, and values of their own at those of
    all. What they hide is a mirror image, which is as good as the best one: worse by less than the
    noise.
    """
    evaluator = best.evaluator
    for _ in range(_VISITS):
        with visited(evaluator, np.stack([best.theta, theta])):
            if shortcomings(evaluator, theta[None]):
                return None
            lowest = float(best(best.theta[None])[0])
            (theta,), (value,) = best.polished(theta[None])
            if not value - lowest < best.noise:
                return None
            found = not shortcomings(evaluator, theta[None])
        if found:
            break
    else:
        return None
    return None if _joined(best, best.theta, theta, _WAY_HALVED) else theta


def _joined(best: Best, a: Floats, b: Floats, times: int) -> bool:
    """Return whether a way leads from one point to another that is nowhere above both.

    Straight, or along a valley: from where the middle of the way goes down to. Clouds reach it.
    """
    way = np.linspace(a, b, 3)
    with visited(best.evaluator, way):
        value_a, value_b = map(float, best(way[[0, -1]]))
        if not _separate(best, a, value_a, b, value_b):
            return True
        (middle,), (value,) = best.polished(way[1:2])
    if not times or not value < max(value_a, value_b) + best.noise:
        return False
    return _joined(best, a, middle, times - 1) and _joined(best, middle, b, times - 1)


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


def _in_line(best: Best, ends: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Move ends to where the best is along what is not identified, if that is as good."""
    unidentified = best.local.unidentified
    hidden = ends @ unidentified @ unidentified.T
    in_line = ends - hidden
    also = best.along(in_line, None)
    as_good = also < values + _NEGLIGIBLE * best.noise
    aligned = np.where(as_good[:, None], in_line, ends)
    return aligned, np.minimum(also, values)


def _rival(theta: Floats, value: float, lowest: float, noise: float) -> Rival:
    comparable = value - lowest < _COMPARABLE * noise
    better = value < lowest - _BETTER * noise
    return Rival(theta, value, comparable, better)


def _separate(best: Best, a: Floats, value_a: float, b: Floats, value_b: float) -> bool:
    """Return whether the objective between two optima is above both by more than the noise."""
    share = np.linspace(0, 1, _SECTIONS + 1)
    inside = share[1:-1, None]
    between = best(a + inside * (b - a))
    barrier = np.max(between) - max(value_a, value_b)
    return bool(barrier > best.noise)
