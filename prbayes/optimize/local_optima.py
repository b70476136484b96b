"""Local optima of the discrepancy other than the best, such as mirror solutions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from prbayes._validate import Floats
from prbayes.inference.asymptotics import Local
from prbayes.model.evaluator import Evaluator, shortcomings
from prbayes.numerics.batched_minimisers import descend
from prbayes.optimize.design_refinement import (
    FEW_SETS,
    noise_floors,
    refine_at,
    temporary_samples,
)
from prbayes.optimize.objective import Ridge
from prbayes.optimize.optimum import point_at

# Share of the noise floor that is about the difference of the discrepancy between the fit of the
# data and the truth; half or twice changes no optimum.
_NOISE_SHARE = 0.3
# Difference, in multiples of the noise, up to which data could come from either optimum: three make
# about the noise floor.
_COMPARABLE = 3.0
# Multiples of the noise that are nothing: descents stop there.
_NEGLIGIBLE = 0.01
# Points of the prior for each start; half and twice as many find the same optima.
_POINTS_PER_START = 8


@dataclass(frozen=True, eq=False)
class Rival:
    """A local optimum other than the best."""

    theta: Floats  # (d,)
    value: float  # of the objective
    comparable: bool  # whether it is as good as the best up to sampling noise
    better: bool  # whether it is better than the reference

    def record(self, evaluator: Evaluator) -> dict[str, Any]:
        """Return the rival as `Optimum` has it."""
        return {
            "point": point_at(evaluator, self.theta),
            "discrepancy": self.value,
            "theta": self.theta,
            "comparable": self.comparable,
        }


@dataclass(frozen=True, eq=False)
class Reference:
    """The best optimum so far, and the objective with its ridge."""

    evaluator: Evaluator
    theta: Floats  # (d,)
    scales: Floats  # (k,)
    local: Local  # rivals are reported at theta along the directions that are not identified
    noise: float  # difference of the objective that sampling explains
    ridge: Ridge | None = None

    def __call__(self, thetas: Floats) -> Floats:
        """Return the objective at thetas, (..., d) -> (...)."""
        stacked = thetas.reshape(-1, thetas.shape[-1])
        values = self.evaluator.total(stacked, self.scales)
        if self.ridge is not None:
            values = values + self.ridge(stacked, self.local.prior_sd)
        return values.reshape(thetas.shape[:-1])

    def shifts(self, thetas: Floats) -> Floats:
        """Return thetas relative to the reference in units of the prior's spread."""
        return np.asarray((thetas - self.theta) / self.local.prior_sd)

    def thetas(self, shifts: Floats) -> Floats:
        """Return the thetas of shifts, (..., d)."""
        return np.asarray(self.theta + shifts * self.local.prior_sd)

    def descend(self, shifts: Floats, curvature: Floats) -> tuple[Floats, Floats]:
        """Return the minima below shifts, (n, d), all at once, and their values."""
        ends, values, *_ = descend(
            lambda shifts, rows: self(self.thetas(shifts)),
            shifts,
            curvature,
            step=1e-3,
            tolerance=_NEGLIGIBLE * self.noise,
            is_central=True,
        )
        return ends, values

    def polish(self, thetas: Floats) -> tuple[Floats, Floats]:
        """Return the minima near thetas, (n, d), and their values, from the reference's Hessian."""
        local = self.local
        covariance = local.identified @ local.covariance @ local.identified.T
        inverse = (covariance + local.unidentified @ local.unidentified.T) / self.noise
        variances, axes = np.linalg.eigh(inverse)
        # A standard error may be zero, as where all responses are on one side of the data.
        if not variances.max() > 0:
            return thetas, self(thetas)
        variances = np.maximum(variances, 1e-12 * variances.max())
        ends, values = self.descend(self.shifts(thetas), (axes / variances) @ axes.T)
        return self.thetas(ends), values


def find_rivals(
    evaluator: Evaluator,
    theta: Floats,
    scales: Floats,
    local: Local,
    ridge: Ridge | None,
    *,
    starts: int,
    seed: int,
    refine: bool,
) -> list[Rival]:
    """Return other optima, sorted by value; refine designs where one in question needs it."""
    floors = noise_floors(evaluator, theta, FEW_SETS)
    noise = _NOISE_SHARE * float((floors / scales).sum())
    reference = Reference(evaluator, theta, scales, local, noise, ridge)

    def search() -> list[Rival]:
        return rivals_from_prior(reference, starts=starts, seed=seed)

    if refine and any(bound.design.is_emulated for bound in evaluator.reweighted.values()):
        rivals = verified_rivals(reference, search())
    else:
        rivals = _supported_rivals(evaluator, search, refine=refine)
    return _excluded_by_one_simulator(evaluator, theta, rivals, _NOISE_SHARE * floors)


def rivals_from_prior(reference: Reference, *, starts: int, seed: int) -> list[Rival]:
    """Descend from points of the prior; return the optima that barriers separate, by value."""
    points = reference.evaluator.hyperparameters.prior_points(_POINTS_PER_START * starts, seed)
    values = reference(points)
    # The better half of the points, thinned.
    ranked = np.argsort(values, kind="stable")
    thinned = ranked[: len(ranked) // 2 : max(_POINTS_PER_START // 2, 1)]
    first = reference.shifts(points[thinned[:starts]])
    # Typical size of the objective among the prior's points.
    half = float(np.ptp(np.quantile(values[np.isfinite(values)], [0.0, 0.5])))
    size = max(half, reference.noise)
    if not size > 0:
        return []
    ends, values = reference.descend(first, size * np.eye(reference.theta.size))
    lowest = float(reference(reference.theta[None])[0])
    # To the reference along unidentified directions, if that is as good.
    unidentified = reference.local.unidentified
    aligned = ends - ends @ unidentified @ unidentified.T
    aligned_values = reference(reference.thetas(aligned))
    is_as_good = aligned_values < values + _NEGLIGIBLE * reference.noise
    ends = np.where(is_as_good[:, None], aligned, ends)
    values = np.minimum(aligned_values, values)
    rivals = _separated(reference, reference.thetas(ends), values, lowest)
    if not rivals:
        return []
    thetas = np.stack([rival.theta for rival in rivals])
    values = np.array([rival.value for rival in rivals])
    # A descent in a bent valley may end before it has learned how flat the valley is.
    for _ in range(8):
        previous = values
        thetas, values = reference.polish(thetas)
        if not (previous - values > _NEGLIGIBLE * reference.noise).any():
            break
    return _separated(reference, thetas, values, lowest)


def polished_rivals(reference: Reference, thetas: Floats) -> list[Rival]:
    """Return the optima near thetas, (n, d), on designs as they are now."""
    lowest = float(reference(reference.theta[None])[0])
    ends, values = reference.polish(thetas)
    return _separated(reference, ends, values, lowest)


def _separated(reference: Reference, ends: Floats, values: Floats, lowest: float) -> list[Rival]:
    """Return the optima that a barrier separates from the reference and from better ones."""
    optima = [(reference.theta, lowest)]
    for i in np.argsort(values):
        value = float(values[i])
        if np.isfinite(value) and all(
            has_barrier(reference, ends[i], value, *optimum) for optimum in optima
        ):
            optima.append((ends[i], value))
    noise = reference.noise
    return [
        Rival(
            theta,
            value,
            comparable=value - lowest < _COMPARABLE * noise,
            better=value < lowest - 0.1 * noise,
        )
        for theta, value in optima[1:]
    ]


def has_barrier(reference: Reference, a: Floats, value_a: float, b: Floats, value_b: float) -> bool:
    """Return whether the objective between two optima exceeds both by more than the noise."""
    shares = np.linspace(0, 1, 11)[1:-1, None]  # a narrower barrier is missed
    between = reference(a + shares * (b - a))
    return bool(np.max(between) - max(value_a, value_b) > reference.noise)


def are_connected(reference: Reference, a: Floats, b: Floats, halvings: int) -> bool:
    """Return whether a path along which the objective exceeds neither optimum connects both.

    The path is straight, or leads along a valley, through the minimum below its middle. Emulated
    samples are extended to it.
    """
    path = np.linspace(a, b, 3)
    with temporary_samples(reference.evaluator, path):
        value_a, value_b = map(float, reference(path[[0, -1]]))
        if not has_barrier(reference, a, value_a, b, value_b):
            return True
        (middle,), (value,) = reference.polish(path[1:2])
    if not halvings or not value < max(value_a, value_b) + reference.noise:
        return False
    return are_connected(reference, a, middle, halvings - 1) and are_connected(
        reference, middle, b, halvings - 1
    )


# -- designs ---------------------------------------------------------------------------------------


def _is_supported(evaluator: Evaluator, rival: Rival) -> bool:
    return not shortcomings(evaluator, rival.theta[None])


def _supported_rivals(
    evaluator: Evaluator, search: Callable[[], list[Rival]], *, refine: bool
) -> list[Rival]:
    """Return optima that designs support, with more runs where one in question has too few."""
    for remaining in (2, 1, 0):  # most need one search
        rivals = search()
        supported = [rival for rival in rivals if _is_supported(evaluator, rival)]
        undersampled = [
            rival
            for rival in rivals
            if (rival.better or rival.comparable) and rival not in supported
        ]
        if not undersampled or not refine or not remaining:
            break
        refine_at(evaluator, undersampled[0].theta[None])
    return supported


def verified_rivals(reference: Reference, rivals: list[Rival]) -> list[Rival]:
    """Return optima that persist when emulated samples are extended to them."""
    evaluator = reference.evaluator
    supported = [rival for rival in rivals if _is_supported(evaluator, rival)]
    unsupported = [rival.theta for rival in rivals if rival not in supported]
    ends = [mirror_optimum(reference, theta) for theta in unsupported[:4]]
    mirrors = [end for end in ends if end is not None]
    if not mirrors:
        return supported
    refine_at(evaluator, np.stack(mirrors), beside=reference.theta[None])
    thetas = np.stack([rival.theta for rival in supported] + mirrors)
    return [r for r in polished_rivals(reference, thetas) if _is_supported(evaluator, r)]


def mirror_optimum(reference: Reference, theta: Floats) -> Floats | None:
    """Return the mirror solution near a theta that emulated samples do not cover, if it is one.

    Far from the design the emulated sample is sparse and has spurious minima. A mirror solution is
    worse than the reference by less than the noise on samples that cover both.
    """
    evaluator = reference.evaluator
    for _ in range(4):
        with temporary_samples(evaluator, np.stack([reference.theta, theta])):
            if shortcomings(evaluator, theta[None]):
                return None
            lowest = float(reference(reference.theta[None])[0])
            (theta,), (value,) = reference.polish(theta[None])
            if not value - lowest < reference.noise:
                return None
            is_covered = not shortcomings(evaluator, theta[None])
        if is_covered:
            return None if are_connected(reference, reference.theta, theta, 5) else theta
    return None


def _excluded_by_one_simulator(
    evaluator: Evaluator, best: Floats, rivals: list[Rival], noises: Floats
) -> list[Rival]:
    """Return rivals, not comparable where one simulator alone tells them from the best.

    The noise of several simulators together grows with their number, and would hide it. ``noises``
    are differences of each discrepancy that sampling explains, (k,).
    """
    if len(noises) < 2 or not rivals:
        return rivals
    thetas = np.array([best, *(rival.theta for rival in rivals)])
    discrepancies = evaluator(thetas).discrepancies
    increase = discrepancies[1:] - discrepancies[0]
    is_excluded = (increase > _COMPARABLE * noises).any(axis=1)
    return [
        replace(rival, comparable=rival.comparable and not excluded)
        for rival, excluded in zip(rivals, is_excluded, strict=True)
    ]
