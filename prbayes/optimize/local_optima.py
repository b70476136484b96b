"""Local optima of the discrepancy other than the best, such as mirror solutions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from prbayes._finding import Finding
from prbayes._validate import ArrayPair, Arrays, Floats
from prbayes.inference.asymptotics import Local
from prbayes.model.evaluator import Evaluator, shortcomings
from prbayes.numerics.batched_minimisers import descend
from prbayes.optimize.convergence import Fit, Search
from prbayes.optimize.design_refinement import FEW_SETS, noise_floors, refine_at
from prbayes.optimize.objective import Ridge
from prbayes.optimize.optimum import point_text

# Difference of the discrepancy between the fit of the data and the truth, as a share of the noise
# floor
_NOISE_SHARE = 0.3
# Difference, in multiples of the noise, up to which data could come from either optimum. Three
# multiples are about the noise floor.
_COMPARABLE = 3.0
# Gain, in multiples of the noise, at which descents stop
_NEGLIGIBLE = 0.01
# Number of points of the prior that are compared for each start
_POINTS_PER_START = 8


@dataclass(frozen=True, eq=False)
class LocalOptimum:
    """A local optimum other than the best."""

    theta: Floats  # (d,)
    value: float  # value of the objective
    comparable: bool  # whether it is as good as the best up to sampling noise
    better: bool  # whether it is better than the reference

    def finding(self, evaluator: Evaluator) -> Finding:
        """Report that the data could as well come from this optimum."""
        return Finding(
            "second-mode",
            f"Another optimum fits about as well, {point_text(evaluator, self.theta)}: its "
            "discrepancy differs by no more than sampling noise; state a prior that excludes one, "
            "or report both.",
            "optimum_or_abc.md#two-answers",
        )


@dataclass(frozen=True, eq=False)
class Reference:
    """The best optimum so far, and the objective with its ridge."""

    evaluator: Evaluator
    theta: Floats  # (d,)
    scales: Floats  # (k,): divisors of the discrepancies
    # sampling distribution at theta; other optima have theta's values along its unidentified
    # directions
    local: Local
    noise: float  # difference of the objective that sampling explains
    ridge: Ridge | None = None

    def __call__(self, thetas: Floats) -> Floats:
        """Return the objective at thetas, (..., d) -> (...)."""
        stacked = thetas.reshape(-1, thetas.shape[-1])
        values = self.evaluator.total(stacked, self.scales)
        if self.ridge is not None:
            values = values + self.ridge(stacked, self.local.prior_sd)
        return values.reshape(thetas.shape[:-1])

    def descend(self, shifts: Floats, curvature: Floats) -> ArrayPair:
        """Return the minima that descents from shifts, (n, d), reach, and their values.

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

    def polish(self, thetas: Floats) -> ArrayPair:
        """Return the minima near thetas, (n, d), and values, by the Hessian of the reference."""
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

    def has_barrier(self, a: Floats, value_a: float, b: Floats, value_b: float) -> bool:
        """Return whether the objective between two optima exceeds both by more than the noise."""
        # nine points between, which miss barriers narrower than a tenth of the way
        shares = np.linspace(0, 1, 11)[1:-1, None]
        between = self(a + shares * (b - a))
        return bool(np.max(between) - max(value_a, value_b) > self.noise)

    def separated(self, ends: Floats, values: Floats, lowest: float) -> list[LocalOptimum]:
        """Return the optima that a barrier separates from the reference and from better ones."""
        optima = [(self.theta, lowest)]
        for i in np.argsort(values):
            end, value = ends[i], float(values[i])
            if np.isfinite(value) and all(
                self.has_barrier(end, value, theta, better) for theta, better in optima
            ):
                optima.append((end, value))
        return [
            LocalOptimum(
                theta,
                value,
                comparable=value - lowest < _COMPARABLE * self.noise,
                better=value < lowest - 0.1 * self.noise,
            )
            for theta, value in optima[1:]
        ]


def find_local_optima(search: Search, fit: Fit, starts: int) -> list[LocalOptimum]:
    """Return other optima than a fit, sorted by value; refine designs where they fall short."""
    if fit.sampling is None:
        return []
    evaluator, settings = search.evaluator, search.settings
    floors = noise_floors(evaluator, fit.theta, FEW_SETS)
    noise = _NOISE_SHARE * float((floors / fit.scales).sum())
    reference = Reference(evaluator, fit.theta, fit.scales, fit.sampling.local, noise, fit.ridge)
    undersampled: list[Floats] = []
    for remaining in (2, 1, 0):  # most designs need one search
        candidates = optima_from_prior(reference, starts, settings.random_seed, undersampled)
        optima = [o for o in candidates if not shortcomings(evaluator, o.theta[None])]
        undersampled = [
            optimum.theta
            for optimum in candidates
            if (optimum.better or optimum.comparable) and optimum not in optima
        ]
        if not (undersampled and settings.refine and remaining):
            break
        refine_at(evaluator, undersampled[0][None], beside=fit.theta[None])
    if len(floors) < 2 or not optima:
        return optima
    # An optimum is not comparable if a single simulator excludes it: the noise of the sum grows
    # with the number of simulators, and would hide it.
    thetas = np.array([fit.theta, *(optimum.theta for optimum in optima)])
    discrepancies = evaluator(thetas).discrepancies
    increase = discrepancies[1:] - discrepancies[0]
    is_excluded = (increase > _COMPARABLE * (_NOISE_SHARE * floors)).any(axis=1)
    return [
        replace(optimum, comparable=optimum.comparable and not excluded)
        for optimum, excluded in zip(optima, is_excluded, strict=True)
    ]


def optima_from_prior(
    reference: Reference, starts: int, seed: int, candidates: Arrays = ()
) -> list[LocalOptimum]:
    """Descend from points of the prior and candidates; return the optima that barriers separate.

    They are sorted by value.
    """
    points = reference.evaluator.hyperparameters.prior_points(_POINTS_PER_START * starts, seed)
    values = reference(points)
    # Start from the better half of the points, thinned.
    ranked = np.argsort(values, kind="stable")
    thinned = ranked[: len(ranked) // 2 : max(_POINTS_PER_START // 2, 1)]
    # Typical size of the objective among the prior's points.
    half = float(np.ptp(np.quantile(values[np.isfinite(values)], [0.0, 0.5])))
    size = max(half, reference.noise)
    if not size > 0:
        return []
    theta, prior_sd = reference.theta, reference.local.prior_sd
    first = (np.vstack([points[thinned[:starts]], *candidates]) - theta) / prior_sd
    ends, values = reference.descend(first, size * np.eye(theta.size))
    lowest = float(reference(theta[None])[0])
    # Move to the reference along unidentified directions where the value remains as good.
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
    # Repeat the descents, because one in a bent valley may end before its Hessian is accurate.
    for _ in range(8):
        previous = values
        thetas, values = reference.polish(thetas)
        if not (previous - values > _NEGLIGIBLE * reference.noise).any():
            break
    return reference.separated(thetas, values, lowest)
