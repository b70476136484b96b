"""Minimisation of the standardised objective, and the decision whether it has converged.

Parameters are in units of the prior's spread, the objective in units of its typical size. A
tolerance then means the same for every model, metric and method.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

import numpy as np
from pytensor.gradient import NullTypeGradError

from prbayes._progress import progress
from prbayes._validate import ArrayPair, Floats
from prbayes.inference.refits import SamplingDistribution, is_stored
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Minimum
from prbayes.metrics.density import overlap
from prbayes.model.evaluator import Evaluator, compiled_objective
from prbayes.model.parameters import THETAS, in_support
from prbayes.numerics.derivatives import cross, differences
from prbayes.optimize.objective import Minimisation, Objective, Ridge, SpentError, StalledError
from prbayes.response.budget import BudgetError

# Relative gain that is negligible: far below the noise of any data, which is 1 / N
_NEGLIGIBLE_GAIN = 1e-4
# Step of differences in prior standard deviations. The errors of rounding, 1e-16 / step, and of
# curvature, step^2, are both below the tolerance.
_STEP = 1e-4
# Number of evaluations, for each parameter, of the simplex after a failed line search
_SIMPLEX_EVALUATIONS = 60
# Overlap of two densities below which the area metric is minimised first, and overlap at which that
# ends. Half and twice these values give the same optima from far starts (benchmarks/landscapes.py).
OVERLAP = 0.02
OVERLAP_ENOUGH = 0.5


class Result(Enum):
    """How a minimisation ended, with its message."""

    CONVERGED = "The minimiser converged."
    SETTLED_BY_GRADIENTS = "The minimiser converged: by gradients, no better value is nearby."
    SETTLED_BY_SIMPLEX = "The minimiser converged: a search around its end found no better value."
    STALLED = "The minimiser stopped before convergence: try another start or method."
    FAILED = "The minimiser failed."
    MAX_EVALUATIONS = "The largest number of evaluations was reached before convergence."
    STOPPED = "A budget was spent."
    AT_EDGE = "The minimum is at the edge of a support."
    NO_INFORMATION = (
        "No hyperparameter changes the discrepancy here, far from the data: try another start."
    )
    NO_OVERLAP = "The population here hardly overlaps with the data: try another start."

    @property
    def converged(self) -> bool:
        """Whether the minimum is found."""
        return self in {Result.CONVERGED, Result.SETTLED_BY_GRADIENTS, Result.SETTLED_BY_SIMPLEX}


@dataclass(frozen=True)
class Trace:
    """The points that minimisers evaluated."""

    thetas: tuple[Floats, ...] = ()  # (d,)
    values: tuple[float, ...] = ()  # values of the objective at the points
    counts: tuple[int, ...] = ()  # numbers of evaluations up to each point
    count: int = 0  # number of evaluations in all

    def extended(self, objective: Objective) -> Trace:
        """Return the trace with the points of one more minimisation."""
        return Trace(
            thetas=self.thetas + tuple(objective.thetas),
            values=self.values + tuple(objective.values),
            counts=(*self.counts, *[self.count + c for c in objective.counts]),
            count=self.count + objective.count,
        )


@dataclass(frozen=True, eq=False)
class Fit:
    """A minimum on the designs as they are, and the sampling distribution around it."""

    theta: Floats  # (d,)
    result: Result
    details: str  # sentences with the numbers behind the result
    trace: Trace  # points of this minimisation and earlier ones
    center: Floats  # (d,): start of the minimisation
    scales: Floats  # (k,): divisors of the discrepancies
    lowest: float  # value of the objective at theta
    size: float  # typical size of the objective
    ridge: Ridge | None = None  # penalty on directions that designs do not identify
    # sampling distribution; None where it is not known
    sampling: SamplingDistribution | None = None
    # error of the optimum by the design, in standard errors; NaN where it is not known
    design_error: float = np.nan
    pilot: Floats | None = None  # (m, d): thetas around which designs grow

    @property
    def covariance(self) -> Floats:
        """The sampling covariance, (d, d); NaN where it is not known."""
        if self.sampling is None:
            return np.full((self.theta.size, self.theta.size), np.nan)
        return self.sampling.local.in_theta


@dataclass(frozen=True, eq=False)
class Search:
    """An objective and a minimiser; raise TypeError if the minimiser needs missing gradients."""

    evaluator: Evaluator
    prior_sd: Floats  # (d,): unit of the parameters
    settings: Minimisation
    ridge: Ridge | None = None  # penalty that is added to the objective
    uses_gradient: bool = field(init=False)  # whether the method receives gradients
    # whether gradients jump, so that line searches end in ever smaller steps
    has_kinks: bool = field(init=False)
    is_random: bool = field(init=False)  # whether evaluations draw specimens

    def __post_init__(self) -> None:
        nodes = self.evaluator.nodes
        random = [node.name for node in nodes if node.bound.random]
        method = self.settings.method
        if random and method.gradient and isinstance(method.method, str):
            raise TypeError(
                f"{random[0]}: prb.Fresh draws new responses at every evaluation, so the method "
                f"{method.method} has no gradient to follow; call "
                "prb.sample_smc(adjustment=None), use prb.minimize(method='Nelder-Mead'), or "
                "propagation=prb.Reweighted() or prb.Resimulated()"
            )
        has_kinks = Minimum.ABSOLUTE in [node.metric.minimum for node in nodes]
        object.__setattr__(self, "uses_gradient", method.gradient and not random)
        object.__setattr__(self, "has_kinks", has_kinks)
        object.__setattr__(self, "is_random", bool(random))

    def size(self, theta: Floats, scales: Floats) -> float:
        """Return a typical size of the objective; for a user's metric its value at theta."""
        nodes = self.evaluator.nodes
        if Minimum.UNKNOWN not in [node.metric.minimum for node in nodes]:
            sizes = [n.target.scale / scale for n, scale in zip(nodes, scales, strict=True)]
            return float(sum(sizes))
        (total,) = self.evaluator.total(theta[None], scales)
        value = float(np.abs(total))
        return value if 0 < value < np.inf else 1.0

    def objective(
        self, center: Floats, scales: Floats, size: float, spent: int, *, gradient: bool
    ) -> Objective:
        """Return the standardised objective around a center; its gradient is exact if possible."""
        exact = None
        if gradient:
            # The response, or an inverse distribution function, may have no gradient.
            with suppress(NotImplementedError, NullTypeGradError):
                exact = compiled_objective(self.evaluator, prior=self.settings.prior, gradient=True)

        def values(thetas: Floats) -> Floats:
            if not self.settings.prior:
                return self.evaluator.total(thetas, scales)  # which needs no compilation
            single = compiled_objective(self.evaluator, prior=True, gradient=False)
            return np.array([float(single(theta, scales)[0]) for theta in thetas])

        def function(theta: Floats) -> tuple[float, Floats | None, int]:
            if not gradient:
                return values(theta[None])[0], None, 1
            if exact is not None:
                value, slope = exact(theta, scales)
                # Differences replace PyMC's gradient of a truncated normal, which is NaN at points
                # that are cut off.
                if np.isfinite(slope).all() or not np.isfinite(value):
                    return value, slope, 1
            return differences(values, _STEP * self.prior_sd)(theta)

        return Objective(
            function,
            center,
            self.prior_sd,
            size,
            gradient=gradient,
            max_evaluations=self.settings.max_evaluations - spent,
            ridge=self.ridge,
        )


def minimise(
    search: Search, theta: Floats, scales: Floats, trace: Trace, *, patient: bool = False
) -> Fit:
    """Minimise from theta with the remaining evaluations.

    If the metric has kinks, a line search is stopped soon, unless it is ``patient``.
    """
    size = search.size(theta, scales)
    gradient = search.uses_gradient
    objective = search.objective(theta, scales, size, trace.count, gradient=gradient)
    method = search.settings.method
    if str(method.method).lower() in {"bfgs", "cg", "l-bfgs-b"}:
        # Line searches that succeed make progress within fewer evaluations.
        objective.patience = 15
        if search.has_kinks and not patient:
            objective.patience = 4
            objective.least_gain = _NEGLIGIBLE_GAIN
    result, details = _run_scipy(
        search,
        objective,
        np.zeros_like(theta),
        jac=gradient or None,
        method=method.method,
        options=method.settings(search.settings.tolerance, theta.size),
    )
    return Fit(
        theta=objective.best,
        result=result,
        details=details,
        trace=trace.extended(objective),
        center=theta,
        scales=scales,
        lowest=objective.lowest,
        size=size,
        ridge=search.ridge,
    )


def _run_scipy(
    search: Search, objective: Objective, start: Floats, **settings: Any
) -> tuple[Result, str]:
    """Run a minimiser of scipy; return the result and its details."""
    # Import here, because SciPy's minimisers take longer to import than the whole package.
    from scipy.optimize import minimize as scipy_minimize

    try:
        with progress("evaluations") as objective.report:
            outcome = scipy_minimize(objective, start, **settings)
    except SpentError:
        return Result.MAX_EVALUATIONS, f"max_evaluations = {search.settings.max_evaluations}."
    except BudgetError:
        if not np.isfinite(objective.lowest):
            raise
        return Result.STOPPED, ""
    except StalledError:
        patience = objective.patience
        return Result.STALLED, f"No better value was found in {patience} evaluations."
    return Result.CONVERGED if outcome.success else Result.FAILED, str(outcome.message)


# -- stalled line searches -------------------------------------------------------------------------


def settle(search: Search, fit: Fit) -> Fit:
    """Decide whether a line search that gave up, because of kinks or rounding, has converged.

    It has converged if gradients around its end predict no gain, or else if a simplex gains
    nothing. At kinks a more patient line search comes before the simplex.
    """
    most = search.settings.max_evaluations
    if fit.result.converged or fit.trace.count >= most or not search.uses_gradient:
        return fit
    is_jumping = _loses_responses(search, fit.theta)
    if not is_jumping:
        fit = _follow_gradients(search, fit)
        if search.has_kinks and not fit.result.converged and fit.trace.count < most:
            longer = minimise(search, fit.theta, fit.scales, fit.trace, patient=True)
            fit = replace(
                longer, sampling=fit.sampling, design_error=fit.design_error, pilot=fit.pilot
            )
        if fit.result.converged or fit.trace.count >= most:
            return fit
    objective = search.objective(fit.center, fit.scales, fit.size, fit.trace.count, gradient=False)
    start = (fit.theta - fit.center) / search.prior_sd
    # Edges are in prior standard deviations; at a jump they are wide enough to step over it.
    edge = 0.5 if is_jumping else 0.01
    options = {
        "initial_simplex": np.vstack([start, start + edge * np.eye(start.size)]),
        "maxfev": _SIMPLEX_EVALUATIONS * start.size,
        "xatol": 1e-4,  # coarse, because the gain decides
        "fatol": 1e-7,
    }
    result, _ = _run_scipy(search, objective, start, method="Nelder-Mead", options=options)
    gain = _relative_gain(fit.lowest, objective)
    if result.converged or gain < _NEGLIGIBLE_GAIN:
        result = Result.SETTLED_BY_SIMPLEX
    is_as_good = np.isfinite(objective.lowest) and objective.lowest <= fit.lowest
    return replace(
        fit,
        theta=objective.best if is_as_good else fit.theta,
        result=result,
        details=f"{fit.details} A search around it gained {max(gain, 0):.1e} of the value.",
        trace=fit.trace.extended(objective),
    )


def _loses_responses(search: Search, theta: Floats) -> bool:
    """Return whether a smooth discrepancy loses or gains simulated responses close to theta."""
    nodes = search.evaluator.nodes
    if not all(n.metric.minimum is Minimum.QUADRATIC for n in nodes):
        return False
    nearby = cross(theta, _STEP * search.prior_sd)
    for k, node in enumerate(nodes):
        values, _ = search.evaluator.populations(nearby, k)
        is_lost = np.isnan(values) if node.target.event else ~np.isfinite(values)
        if (is_lost != is_lost[0]).any():
            return True
    return False


def _follow_gradients(search: Search, fit: Fit) -> Fit:
    """Take Newton steps from gradients a distance apart, so that kinks count as curvature.

    The fit has converged if such a step neither predicts nor brings a gain, and if the objective is
    higher a quarter of the prior's spread downhill, because kinks make small minima on a slope.
    """
    spent = fit.trace.count
    objective = search.objective(fit.center, fit.scales, fit.size, spent, gradient=True)
    # Limit the evaluations, because gradients by differences may take as many as a simplex.
    limit = _SIMPLEX_EVALUATIONS * fit.theta.size
    objective.max_evaluations = min(objective.max_evaluations, limit)
    best, lowest, result, details = fit.theta, fit.lowest, fit.result, ""
    # Step of the differences in prior standard deviations. It is wider than the distance between
    # the kinks of an objective that is an average over a thousand points.
    apart = 0.0025
    try:
        for _ in range(5):
            start = (best - fit.center) / search.prior_sd
            step, promised, downhill = _newton_step(objective, start, apart)
            objective(start + step)
            promise = promised * fit.size / max(abs(lowest), 1e-300)
            if max(promise, _relative_gain(lowest, objective)) < _NEGLIGIBLE_GAIN:
                for direction in downhill:
                    objective(start + step + 0.25 * direction)
                if _relative_gain(lowest, objective) < _NEGLIGIBLE_GAIN:
                    result = Result.SETTLED_BY_GRADIENTS
            gain = _relative_gain(lowest, objective)
            if objective.lowest < lowest:
                best, lowest = objective.best, objective.lowest
            if result.converged:
                break
            if gain < _NEGLIGIBLE_GAIN:
                apart /= 4
        details = "Gradients show no minimum there."
        if np.isfinite(promise):
            details = f"By gradients, a better value would be lower by {promise:.1e} of it."
    except SpentError:
        most = search.settings.max_evaluations
        if spent + objective.count >= most:
            result, details = Result.MAX_EVALUATIONS, f"max_evaluations = {most}."
    except BudgetError:
        result = Result.STOPPED
    return replace(
        fit,
        theta=objective.best if objective.lowest < lowest else best,
        lowest=min(objective.lowest, lowest),
        result=result,
        details=f"{fit.details} {details}".strip(),
        trace=fit.trace.extended(objective),
    )


def _relative_gain(lowest: float, objective: Objective) -> float:
    return (lowest - objective.lowest) / max(abs(lowest), 1e-300)


def _newton_step(objective: Objective, t: Floats, apart: float) -> tuple[Floats, float, Floats]:
    """Return a Newton step from gradients around a point, its gain, and downhill directions.

    The gain is infinite if the minimum is farther away than ten times the distance of the
    gradients, if there is none, or if the objective is not finite at one of them.
    """
    steps = apart * np.eye(t.size)
    pairs = [(objective(t + step)[1], objective(t - step)[1]) for step in steps]
    latest = objective.values[-2 * t.size :]
    if not np.isfinite(latest).all():
        return np.zeros(t.size), np.inf, np.zeros((0, t.size))
    gradient = np.mean(pairs, axis=(0, 1))
    differences = np.array([up - down for up, down in pairs])
    hessian = differences / (2 * apart)
    symmetric = (hessian + hessian.T) / 2
    curvatures, axes = np.linalg.eigh(symmetric)
    slope = axes.T @ gradient
    sign = np.where(slope > 0, -1.0, 1.0)
    downhill = sign[:, None] * axes.T
    reach = 10.0 * apart
    endless = np.where(slope > 0, -np.inf, np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        full = np.where(curvatures > 0, -slope / curvatures, endless)
    is_flat = (curvatures == 0) & (slope == 0)
    full[is_flat] = 0.0
    shift = np.clip(full, -reach, reach)
    # the minimum is far away, or there is none, as on a saddle
    if not (np.abs(full) <= reach).all():
        return axes @ shift, np.inf, downhill
    gain = -(slope @ shift) - 0.5 * curvatures @ shift**2
    return axes @ shift, float(gain), downhill


# -- starts without overlap ------------------------------------------------------------------------


def approach(
    search: Search,
    theta: Floats,
    scales: Floats,
    trace: Trace,
    least: float = OVERLAP,
) -> tuple[Floats, Trace]:
    """Move to where simulated responses overlap with the data by more than ``least``.

    Without overlap a density metric hardly changes, or prefers ever wider populations; the gradient
    of the area metric does not vanish. Points of the prior are tried first if a theta costs no
    response. Returns theta itself where there is overlap.
    """
    evaluator = search.evaluator
    if search.is_random:
        return theta, trace
    # With a weight effective sample size below two the design does not reach the population at all.
    ess = [s["weight_ess"][0] for s in evaluator.support(theta[None]).values()]
    if not [n for n in ess if n < 2.0]:
        _, overlaps = overlapping_populations(evaluator, theta[None])
        if overlaps.min() > least:
            return theta, trace
    guide = AreaGuide(evaluator, scales)
    if not evaluator.responses_per_theta:
        points = evaluator.hyperparameters.prior_points(THETAS, search.settings.random_seed)
        candidates = np.vstack([theta, points])
        theta = candidates[np.argmin(guide(candidates))]
    objective = Objective(
        differences(guide, _STEP * search.prior_sd),
        theta,
        search.prior_sd,
        len(evaluator.nodes),
        gradient=True,
        max_evaluations=search.settings.max_evaluations - trace.count,
    )

    def stop_with_overlap(t: Floats) -> None:
        overlap_there, _ = guide.records[(theta + t * search.prior_sd).tobytes()]
        if overlap_there > OVERLAP_ENOUGH:
            raise StopIteration

    _run_scipy(
        search,
        objective,
        np.zeros_like(theta),
        jac=True,
        method="BFGS",
        options={"gtol": 1e-2},  # coarse, because the area metric is left before it converges
        callback=stop_with_overlap,
    )
    # Record the values of the model's own objective in the trace, not the areas.
    objective.values = [guide.records[t.tobytes()][1] for t in objective.thetas]
    return objective.best, trace.extended(objective)


class AreaGuide:
    """The summed area between populations and data, in units of typical areas."""

    def __init__(self, evaluator: Evaluator, scales: Floats) -> None:
        self.evaluator = evaluator
        self.scales = scales
        self.areas = [
            n.metric.like(AreaMetric()).against(n.target.observed, n.target.weights)
            for n in evaluator.nodes
        ]
        # smallest overlap of a simulator, and the model's own objective, by theta
        self.records: dict[bytes, tuple[float, float]] = {}

    def __call__(self, thetas: Floats) -> Floats:
        """Return the sum of the areas; thetas (P, d) -> (P,)."""
        populations, overlaps = overlapping_populations(self.evaluator, thetas)
        areas = [
            area.of(*population) / area.scale
            for area, population in zip(self.areas, populations, strict=True)
        ]
        is_possible = in_support(self.evaluator.hyperparameters, thetas)
        total = np.where(is_possible, np.sum(areas, axis=0), np.inf)
        objective = np.zeros(len(thetas))
        for node, scale, population in zip(
            self.evaluator.nodes, self.scales, populations, strict=True
        ):
            objective = objective + node.target.of(*population) / scale
        for theta, *numbers in zip(thetas, overlaps.min(axis=0), objective, strict=True):
            self.records[theta.tobytes()] = (numbers[0], numbers[1])
        return np.nan_to_num(total, nan=np.inf, posinf=np.inf)


def best_or_nearest(search: Search, thetas: Floats, scales: Floats) -> Floats:
    """Return the theta with the smallest objective, or with the smallest area without any overlap.

    Without overlap density metrics are the same everywhere, up to rounding.
    """
    evaluator = search.evaluator
    if all(stored_overlap(evaluator, theta) < OVERLAP for theta in thetas):
        values = AreaGuide(evaluator, scales)(thetas)
    else:
        values = evaluator.total(thetas, scales)
    return np.asarray(thetas[np.argmin(values)])


def overlapping_populations(evaluator: Evaluator, thetas: Floats) -> tuple[list[ArrayPair], Floats]:
    """Return responses and weights by simulator, and their overlaps with the data, (K, P)."""
    populations = [evaluator.populations(thetas, k) for k in range(len(evaluator.nodes))]
    pairs = zip(evaluator.nodes, populations, strict=True)
    return populations, np.array([overlap(node.target, *population) for node, population in pairs])


def stored_overlap(evaluator: Evaluator, theta: Floats) -> float:
    """Return the largest overlap of stored responses, with the weights of theta, with the data.

    Infinite if it would compute responses, or a metric compares no densities.
    """
    if not is_stored(evaluator):
        return np.inf
    _, overlaps = overlapping_populations(evaluator, theta[None])
    return float(overlaps.max())
