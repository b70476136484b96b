"""Runs minimisers on the standardised objective, and decides whether they have converged.

Standardised: parameters in units of the prior's spread, the objective in units of its typical size. A tolerance then
means the same for every model, metric and method.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from pytensor.gradient import NullTypeGradError

from prbayes._checks import Floats
from prbayes._progress import progress
from prbayes.estimate.differences import differences
from prbayes.estimate.methods import Method
from prbayes.estimate.objective import Objective, SpentError, StalledError
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Minimum
from prbayes.model.evaluator import Evaluator

_OVER = 0.5  # prior standard deviations: the simplex where the discrepancy jumps
_SETTLED = 1e-4  # relative gain of a simplex below which a stalled line search counts as converged
_SCREENED = 256  # prior draws tried as starts where a theta costs no response
_PATIENCE = 15  # evaluations in a line search without progress
_STEP = 1e-4  # of differences, in units of the prior's spread
_OVERLAP = 0.02  # of two densities, below which the area metric leads
_THIN = 2.0  # weight effective sample size below which a design does not reach a population at all
_ENOUGH = 0.5  # overlap from which on the metric itself is followed
_COARSE = 1e-2  # tolerance of the area metric as a guide


class Search:
    """Runs a minimiser on the objective, as often as scales or designs change, within one budget of evaluations."""

    def __init__(
        self, evaluator: Evaluator, scale: Floats, method: Method, prior: bool, tolerance: float, most: int
    ) -> None:
        self.evaluator, self.scale, self.method = evaluator, scale, method
        self.prior, self.tolerance, self.most = prior, tolerance, most
        self.fresh = any(n.bound.random for n in evaluator.nodes)
        self.gradient = method.gradient and not self.fresh
        self.thetas: list[Floats] = []
        self.values: list[float] = []
        self.counts: list[int] = []
        self.count = 0
        self.best = np.empty(0)
        self.remark = ""

    def start(self, start: dict[str, Any] | None, scales: Floats, seed: int) -> tuple[Floats, int]:
        """Return where to begin and how many draws were screened for it."""
        if start is not None:
            return self.evaluator.unconstrained(start), 0
        if self.evaluator.responses_per_theta:
            return self.evaluator.initial, 0
        draws = np.concatenate([self.evaluator.initial[None], self.evaluator.prior_points(_SCREENED, seed)])
        return self.best_of(draws, scales), len(draws)

    def best_of(self, thetas: Floats, scales: Floats) -> Floats:
        """Return the theta with the smallest objective, evaluated in one batch."""
        value = self.evaluator.total(thetas, scales)
        return np.asarray(thetas[np.argmin(value)])

    def size(self, theta: Floats, scales: Floats) -> float:
        """Return a typical size of the objective; of a user's metric it is the value at theta."""
        if not any(n.metric.minimum is Minimum.UNKNOWN for n in self.evaluator.nodes):
            return float(sum(n.target.scale / s for n, s in zip(self.evaluator.nodes, scales, strict=True)))
        first = float(np.abs(self.evaluator.total(theta[None], scales)[0]))
        return first if 0 < first < np.inf else 1.0

    def _function(self, scales: Floats, *, gradient: bool) -> Callable[[Floats], Any]:
        """Return theta -> value, gradient, number of evaluations: exact where it can be had, or by differences."""
        if gradient:
            try:
                exact = self.evaluator.objective(prior=self.prior, gradient=True)
                return lambda theta: (*exact(theta, scales), 1)
            except (NotImplementedError, NullTypeGradError):  # of the response, or of an inverse distribution function
                step = _STEP * self.scale
        if not self.prior:
            total = self.evaluator.total  # needs no compilation
            if gradient:
                return differences(lambda thetas: total(thetas, scales), step)
            return lambda theta: (total(theta[None], scales)[0], None, 1)
        plain = self.evaluator.objective(prior=self.prior, gradient=False)
        if gradient:
            return differences(lambda thetas: np.array([float(plain(t, scales)[0]) for t in thetas]), step)
        return lambda theta: (plain(theta, scales)[0], None, 1)

    def __call__(self, theta: Floats, scales: Floats) -> Any:
        """Minimise from theta; sets ``best``."""
        self.best = theta
        function, size = self._function(scales, gradient=self.gradient), self.size(theta, scales)
        objective = Objective(function, theta, self.scale, size, gradient=self.gradient, most=self.most - self.count)
        if self.method.name.lower() in {"bfgs", "cg", "l-bfgs-b"}:
            objective.patience = _PATIENCE
        options = self.method.settings(self.tolerance, theta.size)
        result = self._run(
            objective, np.zeros_like(theta), jac=self.gradient or None, method=self.method.method, options=options
        )
        self._record(objective)
        self.best = objective.best
        self._last = objective, scales
        return result

    def approach(self, theta: Floats, scales: Floats, seed: int) -> Floats:
        """Go to where simulated responses overlap with the data, by the area metric, whose gradient does not vanish.

        Without overlap a density metric hardly changes, or changes so that populations get wider without end. Where a
        theta costs no response, the prior's draws are looked at first. Returns theta itself where there is overlap.
        """
        thin = any(s["weight_ess"][0] < _THIN for s in self.evaluator.support(theta[None]).values())
        if self.fresh or (not thin and self.overlap(*self._populations(theta[None]))[0] > _OVERLAP):
            return theta
        areas = [AreaMetric().against(n.target.observed, n.target.weights) for n in self.evaluator.nodes]
        seen: dict[bytes, tuple[float, float]] = {}

        def area(thetas: Floats) -> Floats:
            populations = self._populations(thetas)
            values = [a.of(v, w) / a.scale for a, v, w in zip(areas, *populations, strict=True)]
            total = np.where(self.evaluator.in_support(thetas), np.sum(values, axis=0), np.inf)
            parts = zip(self.evaluator.nodes, scales, *populations, strict=True)
            own = sum(n.target.of(v, w) / s for n, s, v, w in parts)
            for row, both in zip(thetas, zip(self.overlap(*populations), own, strict=True), strict=True):
                seen[row.tobytes()] = both
            return np.asarray(np.nan_to_num(total, nan=np.inf, posinf=np.inf))

        if not self.evaluator.responses_per_theta:
            candidates = np.vstack([theta, self.evaluator.prior_points(_SCREENED, seed)])
            theta = candidates[np.argmin(area(candidates))]
        guide, left = differences(area, _STEP * self.scale), self.most - self.count
        objective = Objective(guide, theta, self.scale, len(areas), gradient=True, most=left)

        def near(t: Floats) -> None:
            if seen[(theta + t * self.scale).tobytes()][0] > _ENOUGH:
                raise StopIteration

        self._run(objective, np.zeros_like(theta), jac=True, method="BFGS", options={"gtol": _COARSE}, callback=near)
        reached = objective.best
        found = [seen[t.tobytes()] for t in objective.thetas]
        objective.values = [own for _, own in found]
        self._record(objective)
        self.remark = (
            f" At the start hardly any simulated response was near the data: the area metric led from there, in "
            f"{objective.count} evaluations."
        )
        return reached

    def _populations(self, thetas: Floats) -> tuple[list[Floats], list[Floats]]:
        """Return responses and weights, (P, n) each, by simulator."""
        found = [self.evaluator.populations(thetas, k) for k in range(len(self.evaluator.nodes))]
        return [v for v, _ in found], [w for _, w in found]

    def overlap(self, values: list[Floats], weights: list[Floats]) -> Floats:
        """Return the smallest overlap over the simulators with densities, shape (P,); one where there is none."""
        overlaps = [n.target.overlap(v, w) for n, v, w in zip(self.evaluator.nodes, values, weights, strict=True)]
        return np.min([np.ones(len(values[0])), *overlaps], axis=0)

    def _run(self, objective: Objective, start: Floats, **settings: Any) -> Any:
        from scipy import optimize  # takes longer to import than the whole package

        try:
            with progress("evaluations") as objective.report:
                return optimize.minimize(objective, start, **settings)
        except SpentError:
            message = f"max_evaluations = {self.most} was reached before convergence."
        except StalledError:
            message = f"The line search gained nothing in {objective.patience} evaluations."
        return optimize.OptimizeResult(success=False, message=message, fun=objective.lowest / objective.size)

    def _record(self, objective: Objective) -> None:
        self.thetas += objective.thetas
        self.values += objective.values
        self.counts += [self.count + c for c in objective.counts]
        self.count += objective.count

    def settle(self, result: Any) -> Any:
        """Decide on a line search that gave up: at a kink or at rounding that is the minimum, if a simplex agrees.

        Where the discrepancy jumps, since points lose their response there, the simplex is wide enough to step over it.
        """
        (last, scales), left = self._last, self.most - self.count
        if result.success or not self.gradient or left <= 0:
            return result
        plain = self._function(scales, gradient=False)
        again = Objective(plain, last.center, self.scale, last.size, gradient=False, most=left)
        start, before = (self.best - last.center) / self.scale, last.lowest
        simplex = np.vstack([start, start + (_OVER if self._jumps() else 0.01) * np.eye(start.size)])
        options = {"initial_simplex": simplex, "xatol": 1e-4, "fatol": 1e-7, "maxfev": 60 * start.size}
        polished = self._run(again, start, method="Nelder-Mead", options=options)
        self._record(again)
        if again.lowest <= before:
            self.best = again.best
        gain = (before - again.lowest) / max(abs(before), 1e-300)
        polished.success = bool(polished.success or gain < _SETTLED)
        polished.message = f"{result.message} A simplex from there gained {max(gain, 0):.1e}: {polished.message}"
        return polished

    def _jumps(self) -> bool:
        """Whether a smooth discrepancy loses or wins simulated responses close to the best theta."""
        if not all(n.metric.minimum is Minimum.QUADRATIC for n in self.evaluator.nodes):
            return False
        near = self.best + np.vstack([0 * self.scale, *(s * e for e in np.diag(_STEP * self.scale) for s in (1, -1))])
        lost = [~np.isfinite(v) for v in self._populations(near)[0]]
        return any((rows != rows[0]).any() for rows in lost)
