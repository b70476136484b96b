"""Local optima of the discrepancy other than the best, such as mirror solutions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from prbayes._finding import Finding
from prbayes._validate import Floats
from prbayes.inference.asymptotics import Local
from prbayes.model.description import labelled
from prbayes.model.evaluator import Evaluator, shortcomings
from prbayes.model.parameters import readable_variables, split_elements, table_elements
from prbayes.numerics.batched_minimisers import descend
from prbayes.optimize.convergence import Fit
from prbayes.optimize.design_refinement import (
    FEW_SETS,
    noise_floors,
    refine_at,
    temporary_samples,
)
from prbayes.optimize.objective import Ridge
from prbayes.optimize.optimum import point_at

# Share of the noise floor that is about the difference of the discrepancy between the fit of the
# data and the truth.
_NOISE_SHARE = 0.3
# Difference, in multiples of the noise, up to which data could come from either optimum: three make
# about the noise floor.
_COMPARABLE = 3.0
# Multiples of the noise that are nothing: descents stop there.
_NEGLIGIBLE = 0.01
# Points of the prior that are compared for each start.
_POINTS_PER_START = 8


@dataclass(frozen=True, eq=False)
class LocalOptimum:
    """A local optimum other than the best."""

    theta: Floats  # (d,)
    value: float  # of the objective
    comparable: bool  # whether it is as good as the best up to sampling noise
    better: bool  # whether it is better than the reference

    def as_dict(self, evaluator: Evaluator) -> dict[str, Any]:
        """Return the optimum as a record of `Optimum`."""
        return {
            "point": point_at(evaluator, self.theta),
            "discrepancy": self.value,
            "theta": self.theta,
            "comparable": self.comparable,
        }

    def finding(self, evaluator: Evaluator) -> Finding:
        """Report that the data could as well come from here."""
        hyperparameters = evaluator.hyperparameters
        # Beside a second point, so that constants can be recognised.
        points = hyperparameters.constrained(np.stack([self.theta, hyperparameters.initial]))
        names = readable_variables([str(rv.name) for rv in evaluator.model.free_RVs], points)
        values = labelled(evaluator, {name: points[name] for name in names}, {"point": 2}).data_vars
        elements = split_elements(values)
        place = ", ".join(f"{name} = {elements[name][0]:.4g}" for name in table_elements(values))
        return Finding(
            "second-mode",
            f"The data could as well come from {place}: another optimum, or mirror "
            "solution, whose discrepancy differs by no more than sampling noise; state a prior "
            "that excludes one, or report both.",
            "optimum_or_abc.md#two-answers",
        )


@dataclass(frozen=True, eq=False)
class Reference:
    """The best optimum so far, and the objective with its ridge."""

    evaluator: Evaluator
    theta: Floats  # (d,)
    scales: Floats  # (k,)
    local: Local  # optima are reported at theta along the directions that are not identified
    noise: float  # difference of the objective that sampling explains
    ridge: Ridge | None = None

    def __call__(self, thetas: Floats) -> Floats:
        """Return the objective at thetas, (..., d) -> (...)."""
        stacked = thetas.reshape(-1, thetas.shape[-1])
        values = self.evaluator.total(stacked, self.scales)
        if self.ridge is not None:
            values = values + self.ridge(stacked, self.local.prior_sd)
        return values.reshape(thetas.shape[:-1])

    def descend(self, shifts: Floats, curvature: Floats) -> tuple[Floats, Floats]:
        """Return the minima below shifts from theta, (n, d), all at once, and their values.

        Shifts and curvature, (d, d), are in units of the prior's spread.
        """
        ends, values, *_ = descend(
            lambda shifts, rows: self(self.theta + shifts * self.local.prior_sd),
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
        shifts = (thetas - self.theta) / local.prior_sd
        ends, values = self.descend(shifts, (axes / variances) @ axes.T)
        return np.asarray(self.theta + ends * local.prior_sd), values

    def separated(self, ends: Floats, values: Floats, lowest: float) -> list[LocalOptimum]:
        """Return the optima that a barrier separates from the reference and from better ones."""
        optima = [(self.theta, lowest)]
        for i in np.argsort(values):
            value = float(values[i])
            if not np.isfinite(value):
                continue
            for theta, better in optima:
                if not has_barrier(self, ends[i], value, theta, better):
                    break
            else:
                optima.append((ends[i], value))
        return [
            LocalOptimum(
                theta,
                value,
                comparable=value - lowest < _COMPARABLE * self.noise,
                better=value < lowest - 0.1 * self.noise,
            )
            for theta, value in optima[1:]
        ]


def find_local_optima(
    evaluator: Evaluator, fit: Fit, starts: int, seed: int, *, refine: bool
) -> list[LocalOptimum]:
    """Return other optima than a fit, sorted by value; refine designs where they fall short."""
    if fit.sampling is None:
        return []
    floors = noise_floors(evaluator, fit.theta, FEW_SETS)
    noise = _NOISE_SHARE * float((floors / fit.scales).sum())
    reference = Reference(evaluator, fit.theta, fit.scales, fit.sampling.local, noise, fit.ridge)
    if refine and any(bound.design.is_emulated for bound in evaluator.reweighted.values()):
        optima = verified_optima(reference, optima_from_prior(reference, starts, seed))
    else:
        for remaining in (2, 1, 0):  # most need one search
            candidates = optima_from_prior(reference, starts, seed)
            optima = [optimum for optimum in candidates if _is_supported(evaluator, optimum)]
            undersampled = [
                optimum
                for optimum in candidates
                if (optimum.better or optimum.comparable) and optimum not in optima
            ]
            if not undersampled or not refine or not remaining:
                break
            refine_at(evaluator, undersampled[0].theta[None])
    if len(floors) < 2 or not optima:
        return optima
    # Not comparable where one simulator alone excludes an optimum: the noise of several simulators
    # together grows with their number, and would hide it.
    thetas = np.array([fit.theta, *(optimum.theta for optimum in optima)])
    discrepancies = evaluator(thetas).discrepancies
    increase = discrepancies[1:] - discrepancies[0]
    is_excluded = (increase > _COMPARABLE * (_NOISE_SHARE * floors)).any(axis=1)
    return [
        replace(optimum, comparable=optimum.comparable and not excluded)
        for optimum, excluded in zip(optima, is_excluded, strict=True)
    ]


def optima_from_prior(reference: Reference, starts: int, seed: int) -> list[LocalOptimum]:
    """Descend from points of the prior; return the optima that barriers separate, by value."""
    points = reference.evaluator.hyperparameters.prior_points(_POINTS_PER_START * starts, seed)
    values = reference(points)
    # The better half of the points, thinned.
    ranked = np.argsort(values, kind="stable")
    thinned = ranked[: len(ranked) // 2 : max(_POINTS_PER_START // 2, 1)]
    # Typical size of the objective among the prior's points.
    half = float(np.ptp(np.quantile(values[np.isfinite(values)], [0.0, 0.5])))
    size = max(half, reference.noise)
    if not size > 0:
        return []
    theta, prior_sd = reference.theta, reference.local.prior_sd
    first = (points[thinned[:starts]] - theta) / prior_sd
    ends, values = reference.descend(first, size * np.eye(theta.size))
    lowest = float(reference(theta[None])[0])
    # To the reference along unidentified directions, if that is as good.
    unidentified = reference.local.unidentified
    aligned = ends - ends @ unidentified @ unidentified.T
    aligned_values = reference(theta + aligned * prior_sd)
    is_as_good = aligned_values < values + _NEGLIGIBLE * reference.noise
    ends = np.where(is_as_good[:, None], aligned, ends)
    values = np.minimum(aligned_values, values)
    optima = reference.separated(theta + ends * prior_sd, values, lowest)
    if not optima:
        return []
    thetas = np.stack([optimum.theta for optimum in optima])
    values = np.array([optimum.value for optimum in optima])
    # A descent in a bent valley may end before it has learned how flat the valley is.
    for _ in range(8):
        previous = values
        thetas, values = reference.polish(thetas)
        if not (previous - values > _NEGLIGIBLE * reference.noise).any():
            break
    return reference.separated(thetas, values, lowest)


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


def _is_supported(evaluator: Evaluator, optimum: LocalOptimum) -> bool:
    return not shortcomings(evaluator, optimum.theta[None])


def verified_optima(reference: Reference, optima: list[LocalOptimum]) -> list[LocalOptimum]:
    """Return optima that persist when emulated samples are extended to them."""
    evaluator = reference.evaluator
    supported = [optimum for optimum in optima if _is_supported(evaluator, optimum)]
    unsupported = [optimum.theta for optimum in optima if optimum not in supported]
    ends = [mirror_optimum(reference, theta) for theta in unsupported[:4]]
    mirrors = [end for end in ends if end is not None]
    if not mirrors:
        return supported
    refine_at(evaluator, np.stack(mirrors), beside=reference.theta[None])
    thetas = np.stack([optimum.theta for optimum in supported] + mirrors)
    lowest = float(reference(reference.theta[None])[0])
    polished = reference.separated(*reference.polish(thetas), lowest)
    return [optimum for optimum in polished if _is_supported(evaluator, optimum)]


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
