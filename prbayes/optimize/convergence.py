"""Runs minimisers on the standardised objective, and decides whether they have converged.

Standardised: parameters in units of the prior's spread, the objective in units of its typical size.
A tolerance then means the same for every model, metric and method.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pytensor.gradient import NullTypeGradError

from prbayes._progress import progress
from prbayes._validate import Floats
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Minimum
from prbayes.metrics.density import overlap as density_overlap
from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import THETAS
from prbayes.numerics.derivatives import cross, differences
from prbayes.optimize.methods import Method
from prbayes.optimize.objective import Hold, Objective, SpentError, StalledError
from prbayes.response.budget import BudgetError

# Relative gain of a simplex below which a stalled line search counts as converged: far below the
# noise of any data, which is 1 / N. By judgement.
_SETTLED = 1e-4
# Evaluations in a line search without progress; those of scipy that arrive take fewer. By
# judgement.
_STALLED = 15
# The same where gradients jump, so that line searches end in ever smaller steps, and where only
# a gain that counts is progress. What they leave is found by gradients a step apart.
_STALLED_AT_KINKS = 4
_SPENT = "max_evaluations = {} was reached before convergence."
# Most evaluations of a simplex that settles it, for each parameter. By judgement.
_SIMPLEX = 60
# Spreads of the prior that gradients are apart, at first: wider than kinks of a thousand points.
_ASTRIDE = 0.0025
# Rounds of such gradients, and how far their step may go beyond what they saw. By judgement.
_ROUNDS = 5
_BEYOND_SEEN = 10.0
# Spreads of the prior at which the objective has to be higher, each way that gradients lead down:
# kinks make small minima on a slope. By judgement.
_FARTHER = 0.25
# Step of differences in spreads of the prior: errors of rounding, 1e-16 / step, and of curvature,
# step^2, are then both below the tolerance.
_STEP = 1e-4
# Overlap of two densities below which the area metric leads, and from which on the metric itself
# is followed; from far starts both lead to the same optima (benchmarks/landscapes.py).
OVERLAP = 0.02
OVERLAP_ENOUGH = 0.5
# Weight effective sample size below which a design does not reach a population at all.
_THIN = 2.0
# Methods whose line searches are stopped where they gain nothing.
_LINE_SEARCHES = {"bfgs", "cg", "l-bfgs-b"}

Function = Callable[[Floats], tuple[float, Floats | None, int]]


@dataclass(frozen=True)
class Trace:
    """The points that minimisers have asked for."""

    thetas: tuple[Floats, ...] = ()  # (d,)
    values: tuple[float, ...] = ()  # the objective there
    counts: tuple[int, ...] = ()  # evaluations until then
    count: int = 0  # evaluations in all

    def then(self, objective: Objective) -> Trace:
        """Return the trace with the points of one more minimisation."""
        counts = tuple(self.count + c for c in objective.counts)
        return Trace(
            thetas=self.thetas + tuple(objective.thetas),
            values=self.values + tuple(objective.values),
            counts=self.counts + counts,
            count=self.count + objective.count,
        )


# Of a minimisation that has not begun.
_NOTHING = Trace()


@dataclass(frozen=True)
class Search:
    """What is minimised, and how."""

    evaluator: Evaluator
    prior_sd: Floats  # (d,): typical size of each parameter: the prior's spread
    method: Method
    prior: bool  # whether minus the log prior is added
    tolerance: float  # of the standardised problem
    most: int  # largest number of evaluations in all
    hold: Hold | None = None  # what is added to the objective

    @property
    def gradient(self) -> bool:
        """Whether the method is given gradients."""
        random = any(n.bound.random for n in self.evaluator.nodes)
        return self.method.gradient and not random

    def size(self, theta: Floats, scales: Floats) -> float:
        """Return a typical size of the objective; of a user's metric it is the value at theta."""
        nodes = self.evaluator.nodes
        if not any(n.metric.minimum is Minimum.UNKNOWN for n in nodes):
            sizes = [n.target.scale / scale for n, scale in zip(nodes, scales, strict=True)]
            return float(sum(sizes))
        (total,) = self.evaluator.total(theta[None], scales)
        first = float(np.abs(total))
        return first if 0 < first < np.inf else 1.0

    def best_of(self, thetas: Floats, scales: Floats) -> Floats:
        """Return the theta with the smallest objective, evaluated in one batch."""
        value = self.evaluator.total(thetas, scales)
        return np.asarray(thetas[np.argmin(value)])

    def objective(
        self, center: Floats, scales: Floats, size: float, *, gradient: bool, spent: int
    ) -> Objective:
        """Return the standardised objective around a center."""
        function = self._with_gradient(scales) if gradient else self._without_gradient(scales)
        if self.hold is not None:
            function = self._held(function, self.hold)
        most = self.most - spent
        return Objective(function, center, self.prior_sd, size, gradient=gradient, most=most)

    def _held(self, function: Function, hold: Hold) -> Function:
        """Return theta -> value, gradient, evaluations, with what holds the search."""

        def held(theta: Floats) -> tuple[float, Floats | None, int]:
            value, gradient, cost = function(theta)
            if gradient is not None:
                gradient = gradient + hold.slope(theta, self.prior_sd)
            return value + float(hold(theta, self.prior_sd)), gradient, cost

        return held

    def _with_gradient(self, scales: Floats) -> Function:
        """Return theta -> value, gradient, evaluations.

        Exact where it can be, or by differences.
        """
        by_differences = differences(self._values(scales), _STEP * self.prior_sd)
        try:
            exact = self.evaluator.objective(prior=self.prior, gradient=True)
        except (NotImplementedError, NullTypeGradError):
            # Of the response, or of an inverse distribution function, there is none.
            return by_differences

        def function(theta: Floats) -> tuple[float, Floats | None, int]:
            value, gradient = exact(theta, scales)
            if np.isfinite(value) and not np.isfinite(gradient).all():
                # That of a normal cut off on one side is no number at points that are cut off.
                return by_differences(theta)
            return value, gradient, 1

        return function

    def _without_gradient(self, scales: Floats) -> Function:
        values = self._values(scales)
        return lambda theta: (values(theta[None])[0], None, 1)

    def _values(self, scales: Floats) -> Callable[[Floats], Floats]:
        """Return thetas (P, d) -> values (P,)."""
        if not self.prior:
            # Needs no compilation.
            return lambda thetas: self.evaluator.total(thetas, scales)
        single = self.evaluator.objective(prior=self.prior, gradient=False)
        return lambda thetas: np.array([float(single(t, scales)[0]) for t in thetas])


@dataclass(frozen=True)
class Run:
    """Where a minimisation ended."""

    best: Floats  # (d,)
    success: bool
    message: str  # what the method said
    trace: Trace  # with the points of those before it
    center: Floats  # (d,): where it began
    scales: Floats  # (k,)
    lowest: float  # the objective at ``best``
    size: float  # its typical size


def start(
    search: Search, given: dict[str, Any] | None, scales: Floats, seed: int
) -> tuple[Floats, int]:
    """Return where to begin, and how many points were screened for it."""
    evaluator = search.evaluator
    if given is not None:
        return evaluator.hyperparameters.unconstrained(given), 0
    if evaluator.responses_per_theta:
        return evaluator.hyperparameters.initial, 0
    points = evaluator.hyperparameters.prior_points(THETAS, seed)
    candidates = np.concatenate([evaluator.hyperparameters.initial[None], points])
    return search.best_of(candidates, scales), len(candidates)


def minimise(
    search: Search, theta: Floats, scales: Floats, trace: Trace, *, patient: bool = False
) -> Run:
    """Minimise from theta, within what is left of the budget.

    Where gradients jump a line search is stopped soon, unless it is to be ``patient``.
    """
    size = search.size(theta, scales)
    objective = search.objective(theta, scales, size, gradient=search.gradient, spent=trace.count)
    if search.method.name.lower() in _LINE_SEARCHES:
        objective.patience = _STALLED
        if _hasty(search) and not patient:
            objective.patience = _STALLED_AT_KINKS
            objective.least_gain = _SETTLED
    success, message = _scipy(
        search,
        objective,
        np.zeros_like(theta),
        jac=search.gradient or None,
        method=search.method.method,
        options=search.method.settings(search.tolerance, theta.size),
    )
    return Run(
        best=objective.best,
        success=success,
        message=message,
        trace=trace.then(objective),
        center=theta,
        scales=scales,
        lowest=objective.lowest,
        size=objective.size,
    )


def _hasty(search: Search) -> bool:
    """Return whether line searches are stopped soon, since gradients jump."""
    return any(n.metric.minimum is Minimum.ABSOLUTE for n in search.evaluator.nodes)


def settle(search: Search, run: Run) -> Run:
    """Decide on a line search that gave up, at a kink or rounding.

    It has converged if gradients around its end promise next to nothing, or else if a simplex
    agrees, after a more patient line search where the first was stopped soon. Where the discrepancy
    jumps, since points lose their response there, the simplex is wide enough to step over it.
    """
    if run.success or not search.gradient or run.trace.count >= search.most:
        return run
    jumping = jumps(search, run.best)
    if not jumping:
        run = _by_gradients(search, run)
        if run.success or run.trace.count >= search.most:
            return run
        if _hasty(search):
            run = minimise(search, run.best, run.scales, run.trace, patient=True)
            if run.success or run.trace.count >= search.most:
                return run
    spent = run.trace.count
    again = search.objective(run.center, run.scales, run.size, gradient=False, spent=spent)
    begin = (run.best - run.center) / search.prior_sd
    # In spreads of the prior: wide enough to step over the jump of a point that loses its response,
    # or small, to see whether a stalled line search is at its minimum.
    edge = 0.5 if jumping else 0.01
    simplex = np.vstack([begin, begin + edge * np.eye(begin.size)])
    options = {
        "initial_simplex": simplex,
        "maxfev": _SIMPLEX * begin.size,
        # Coarse, since it only has to gain less than _SETTLED.
        "xatol": 1e-4,
        "fatol": 1e-7,
    }
    success, message = _scipy(search, again, begin, method="Nelder-Mead", options=options)
    gain = (run.lowest - again.lowest) / max(abs(run.lowest), 1e-300)
    return replace(
        run,
        best=again.best if again.lowest <= run.lowest else run.best,
        success=success or gain < _SETTLED,
        message=f"{run.message} A simplex from there gained {max(gain, 0):.1e}: {message}",
        trace=run.trace.then(again),
    )


def _by_gradients(search: Search, run: Run) -> Run:
    """Go on by Newton's steps of gradients that lie apart, so that kinks count as curvature.

    The run has converged where such a step neither promises nor gains anything that counts.
    """
    spent = run.trace.count
    objective = search.objective(run.center, run.scales, run.size, gradient=True, spent=spent)
    # Differences for gradients may take as many evaluations as a simplex.
    objective.most = min(objective.most, _SIMPLEX * run.best.size)
    best, lowest, apart = run.best, run.lowest, _ASTRIDE
    settled, said = False, ""
    try:
        for _ in range(_ROUNDS):
            at = (best - run.center) / search.prior_sd
            step, promised, downhill = _newton(objective, at, apart)
            objective(at + step)
            promise = promised * run.size / max(abs(lowest), 1e-300)
            calm = max(promise, _gain(lowest, objective)) < _SETTLED
            for way in downhill if calm else ():
                objective(at + step + _FARTHER * way)
            gain = _gain(lowest, objective)
            settled = calm and gain < _SETTLED
            if objective.lowest < lowest:
                best, lowest = objective.best, objective.lowest
            if settled:
                break
            if gain < _SETTLED:
                apart /= 4
        said = " Gradients around it tell of no minimum there."
        if np.isfinite(promise):
            said = f" Gradients around it promise a gain of {promise:.1e}."
    except SpentError:
        if spent + objective.count >= search.most:
            said = f" {_SPENT.format(search.most)}"
    except BudgetError:
        said = " Stopped."
    lower = objective.lowest < lowest
    return replace(
        run,
        best=objective.best if lower else best,
        lowest=min(objective.lowest, lowest),
        success=settled,
        message=run.message + said,
        trace=run.trace.then(objective),
    )


def _gain(before: float, objective: Objective) -> float:
    """Return what the lowest value is below another, as a share of it."""
    return (before - objective.lowest) / max(abs(before), 1e-300)


def _newton(objective: Objective, at: Floats, apart: float) -> tuple[Floats, float, Floats]:
    """Return Newton's step by gradients around a place, what it promises to gain, and ways down.

    Infinity where the minimum is farther away than it may go, or there is none, and where the
    objective is no number at one of them.
    """
    pairs = [(objective(at + step)[1], objective(at - step)[1]) for step in apart * np.eye(at.size)]
    if not np.isfinite(objective.values[-2 * at.size :]).all():
        return np.zeros(at.size), np.inf, np.zeros((0, at.size))
    slope = np.mean(pairs, axis=(0, 1))
    rows = np.array([after - before for after, before in pairs]) / (2 * apart)
    bends, axes = np.linalg.eigh((rows + rows.T) / 2)
    along = axes.T @ slope
    ways = np.where(along > 0, -1.0, 1.0)[:, None] * axes.T
    reach = _BEYOND_SEEN * apart
    with np.errstate(divide="ignore", invalid="ignore"):
        full = np.where(bends > 0, -along / bends, np.where(along > 0, -np.inf, np.inf))
    full[(bends == 0) & (along == 0)] = 0.0  # nothing changes at all
    shift = np.clip(full, -reach, reach)
    if not (np.abs(full) <= reach).all():  # as on a saddle
        return axes @ shift, np.inf, ways
    promised = -(along @ shift) - 0.5 * bends @ shift**2
    return axes @ shift, float(promised), ways


def jumps(search: Search, theta: Floats) -> bool:
    """Return whether a smooth discrepancy loses or wins simulated responses close to theta."""
    if not all(n.metric.minimum is Minimum.QUADRATIC for n in search.evaluator.nodes):
        return False
    near = cross(theta, _STEP * search.prior_sd)
    values, _ = _populations(search.evaluator, near)
    lost = [
        np.isnan(v) if n.target.event else ~np.isfinite(v)
        for n, v in zip(search.evaluator.nodes, values, strict=True)
    ]
    return any((rows != rows[0]).any() for rows in lost)


def _scipy(
    search: Search, objective: Objective, begin: Floats, **settings: Any
) -> tuple[bool, str]:
    """Run a minimiser of scipy; return whether it succeeded, and what it said."""
    from scipy import optimize  # takes longer to import than the whole package

    try:
        with progress("evaluations") as objective.report:
            result = optimize.minimize(objective, begin, **settings)
    except SpentError:
        return False, _SPENT.format(search.most)
    except BudgetError:
        if not np.isfinite(objective.lowest):
            raise
        return False, "Stopped."
    except StalledError:
        return False, f"The line search gained nothing in {objective.patience} evaluations."
    return bool(result.success), str(result.message)


# -- where nothing overlaps ------------------------------------------------------------------------


@dataclass(frozen=True)
class Approach:
    """Where the area metric led."""

    theta: Floats  # (d,)
    trace: Trace  # with the points of those before it
    remark: str = ""  # that it did; empty if there was no need


def approach(
    search: Search,
    theta: Floats,
    scales: Floats,
    seed: int,
    trace: Trace = _NOTHING,
    least: float = OVERLAP,
) -> Approach:
    """Go to where simulated responses overlap with the data, by the area metric.

    Without overlap a density metric hardly changes, or changes so that populations get wider
    without end; the gradient of the area metric does not vanish. Where a theta costs no response,
    points of the prior are looked at first. Returns theta itself where there is overlap, of more
    than ``least``.
    """
    evaluator = search.evaluator
    if not _astray(evaluator, theta, least):
        return Approach(theta, trace)
    guide = _Guide(evaluator, scales)
    if not evaluator.responses_per_theta:
        points = evaluator.hyperparameters.prior_points(THETAS, seed)
        candidates = np.vstack([theta, points])
        theta = candidates[np.argmin(guide(candidates))]
    function = differences(guide, _STEP * search.prior_sd)
    size = len(evaluator.nodes)
    most = search.most - trace.count
    objective = Objective(function, theta, search.prior_sd, size, gradient=True, most=most)

    def stop_where_near(t: Floats) -> None:
        if guide.overlap_at(theta + t * search.prior_sd) > OVERLAP_ENOUGH:
            raise StopIteration

    _scipy(
        search,
        objective,
        np.zeros_like(theta),
        jac=True,
        method="BFGS",
        options={"gtol": 1e-2},  # coarse: the area metric is left before it converges
        callback=stop_where_near,
    )
    reached = objective.best
    # The trace is of the model's own objective.
    objective.values = [guide.objective_at(t) for t in objective.thetas]
    remark = (
        " At the start hardly any simulated response was near the data: the area metric led from "
        f"there, in {objective.count} evaluations."
    )
    return Approach(reached, trace.then(objective), remark)


def _astray(evaluator: Evaluator, theta: Floats, least: float) -> bool:
    """Return whether hardly a response of the population at theta is near the data."""
    thin = any(s["weight_ess"][0] < _THIN for s in evaluator.support(theta[None]).values())
    if any(n.bound.random for n in evaluator.nodes):
        return False
    if thin:
        return True
    return not overlap(evaluator, *_populations(evaluator, theta[None]))[0] > least


class _Guide:
    """The area between populations and data, with what else is known of each theta."""

    def __init__(self, evaluator: Evaluator, scales: Floats) -> None:
        nodes = evaluator.nodes
        self.evaluator, self.scales = evaluator, scales
        self.areas = [
            n.metric.like(AreaMetric()).against(n.target.observed, n.target.weights) for n in nodes
        ]
        self._known: dict[bytes, tuple[float, float]] = {}

    def __call__(self, thetas: Floats) -> Floats:
        """Return the sum of the areas, in units of their typical sizes; thetas (P, d) -> (P,)."""
        values, weights = _populations(self.evaluator, thetas)
        areas = []
        for area, v, w in zip(self.areas, values, weights, strict=True):
            areas.append(area.of(v, w) / area.scale)
        inside = self.evaluator.hyperparameters.in_support(thetas)
        total = np.where(inside, np.sum(areas, axis=0), np.inf)
        # What is known of them besides: the overlap, and the model's own objective.
        overlaps = overlap(self.evaluator, values, weights)
        objective: Any = 0
        nodes = self.evaluator.nodes
        for node, scale, v, w in zip(nodes, self.scales, values, weights, strict=True):
            objective = objective + node.target.of(v, w) / scale
        for theta, one, other in zip(thetas, overlaps, objective, strict=True):
            self._known[theta.tobytes()] = one, other
        return np.asarray(np.nan_to_num(total, nan=np.inf, posinf=np.inf))

    def overlap_at(self, theta: Floats) -> float:
        """Return the overlap at a theta that was asked for."""
        return self._known[theta.tobytes()][0]

    def objective_at(self, theta: Floats) -> float:
        """Return the model's own objective at a theta that was asked for."""
        return self._known[theta.tobytes()][1]


def best_or_nearest(search: Search, thetas: Floats, scales: Floats) -> Floats:
    """Return the theta with the smallest objective, or area where no population meets the data.

    Without overlap density metrics are the same everywhere, up to rounding.
    """
    if not all(apart_from_data(search.evaluator, theta) for theta in thetas):
        return search.best_of(thetas, scales)
    return np.asarray(thetas[np.argmin(areas(search.evaluator, scales, thetas))])


def areas(evaluator: Evaluator, scales: Floats, thetas: Floats) -> Floats:
    """Return the areas between populations at thetas, (P, d), and the data, summed, (P,)."""
    return _Guide(evaluator, scales)(thetas)


def overlap(evaluator: Evaluator, values: list[Floats], weights: list[Floats]) -> Floats:
    """Return the smallest overlap over simulators with densities, (P,); one where there is none."""
    overlaps = [
        density_overlap(n.target, v, w)
        for n, v, w in zip(evaluator.nodes, values, weights, strict=True)
    ]
    return np.min([np.ones(len(values[0])), *overlaps], axis=0)


def apart_from_data(evaluator: Evaluator, theta: Floats, least: float = OVERLAP) -> bool:
    """Return whether stored responses, with the weights of theta, are nowhere near any data.

    Their densities then overlap by less than ``least``.

    False where that would compute responses, and where a metric compares no densities.
    """
    if not all(node.bound.stored for node in evaluator.nodes):
        return False
    values, weights = _populations(evaluator, theta[None])
    every = zip(evaluator.nodes, values, weights, strict=True)
    return all(density_overlap(node.target, v, w)[0] < least for node, v, w in every)


def _populations(evaluator: Evaluator, thetas: Floats) -> tuple[list[Floats], list[Floats]]:
    """Return responses and weights, (P, n) each, by simulator."""
    found = [evaluator.populations(thetas, k) for k in range(len(evaluator.nodes))]
    values, weights = zip(*found, strict=True)
    return list(values), list(weights)
