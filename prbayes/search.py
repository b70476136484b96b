"""Runs scipy's optimisers on the standardised objective, and decides whether they have converged."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from prbayes._arrays import Floats
from prbayes.population import Evaluator

_log = logging.getLogger("prbayes")

_SETTLED = 1e-4  # relative gain of a simplex below which a stalled line search counts as converged
_SCREENED = 256  # prior draws tried as starts where a theta costs no response


class SpentError(Exception):
    """The budget of evaluations is spent."""


class _Counted:
    """The objective on standardised parameters; records every evaluation, at most ``most`` of them."""

    def __init__(self, function: Any, center: Floats, scale: Floats, *, gradient: bool, most: int) -> None:
        self.function, self.center, self.scale, self.gradient = function, center, scale, gradient
        self.most = most
        self.thetas: list[Floats] = []
        self.values: list[float] = []
        self.gradients: list[Floats] = []

    def __call__(self, t: Floats) -> Any:
        if len(self.values) >= self.most:
            raise SpentError
        theta = self.center + t * self.scale
        value, *gradient = self.function(theta)
        value = float(value)
        self.thetas.append(theta)
        self.values.append(value)
        if not self.gradient:
            return value if np.isfinite(value) else 1e300
        g = np.asarray(gradient[0]) * self.scale
        self.gradients.append(g)
        if not np.isfinite(value) or not np.isfinite(g).all():
            return 1e10 + float(t @ t), 2 * t  # back towards the start, without breaking a line search
        return value, g


class Search:
    """Runs scipy on the objective, as often as scales or designs change."""

    def __init__(
        self, evaluator: Evaluator, scale: Floats, method: str, gradient: bool, prior: bool, tolerance: float, most: int
    ) -> None:
        self.evaluator, self.scale, self.method = evaluator, scale, method
        self.gradient, self.prior, self.tolerance, self.most = gradient, prior, tolerance, most
        self.thetas: list[Floats] = []
        self.values: list[float] = []
        self.best = np.empty(0)

    def start(self, start: dict[str, Any] | None, scales: Floats, seed: int) -> tuple[Floats, int]:
        """Return where to begin and how many draws were screened for it."""
        if start is not None:
            return self.evaluator.unconstrained(start), 0
        if self.evaluator.responses_per_theta:
            return self.evaluator.initial, 0
        draws = np.concatenate([self.evaluator.initial[None], self.evaluator.prior_thetas(_SCREENED, seed)])
        return self.best_of(draws, scales), len(draws)

    def best_of(self, thetas: Floats, scales: Floats) -> Floats:
        """Return the theta with the smallest objective, evaluated in one batch."""
        found = self.evaluator(thetas)
        value = (found.discrepancies / scales).sum(axis=-1) - found.log_other
        return np.asarray(thetas[np.argmin(np.where(np.isfinite(value), value, np.inf))])

    def __call__(self, theta: Floats, scales: Floats) -> Any:
        """Minimise from theta; sets ``best``."""
        exact = self.gradient
        try:
            compiled = self.evaluator.objective(prior=self.prior, gradient=exact)
        except NotImplementedError as error:
            _log.info("no exact gradient (%s): finite differences on common random numbers", error)
            exact = False
            compiled = self.evaluator.objective(prior=self.prior, gradient=False)
        counted = _Counted(lambda theta: compiled(theta, scales), theta, self.scale, gradient=exact, most=self.most)
        zero = np.zeros_like(theta)
        first = counted(zero)
        size = max(abs(first[0] if exact else first), 1e-12)
        options: dict[str, Any] = {}
        name = self.method.lower()
        if name in {"bfgs", "cg"}:
            options = {"gtol": self.tolerance * size, "maxiter": self.most}
            if not exact:
                options["finite_diff_rel_step"] = None
                options["eps"] = 1e-5
        elif name == "l-bfgs-b":
            options = {"gtol": self.tolerance * size, "ftol": self.tolerance**2, "maxfun": self.most}
        elif name == "nelder-mead":
            options = {"xatol": 1e-6, "fatol": self.tolerance * size, "maxfev": self.most}
            options["initial_simplex"] = np.vstack([zero, 0.2 * np.eye(zero.size)])
        result = self._run(counted, zero, jac=exact if self.gradient else None, method=self.method, options=options)
        self._record(counted)
        self._last = counted, size, exact
        return result

    def _run(self, counted: _Counted, start: Floats, **settings: Any) -> Any:
        from scipy import optimize  # takes longer to import than the whole package

        try:
            return optimize.minimize(counted, start, **settings)
        except SpentError:
            message = f"max_evaluations = {self.most} was reached before convergence."
            return optimize.OptimizeResult(success=False, message=message, fun=np.nanmin(counted.values))

    def _record(self, counted: _Counted) -> None:
        self.thetas += counted.thetas
        self.values += counted.values
        values = np.array(counted.values)
        self.best = counted.thetas[int(np.argmin(np.where(np.isfinite(values), values, np.inf)))]

    def settle(self, result: Any) -> Any:
        """Decide on a line search that gave up: at a kink or at rounding that is the minimum, if a simplex agrees."""
        counted, size, exact = self._last
        if result.success or not self.gradient or len(counted.values) >= self.most:
            return result
        start = (self.best - counted.center) / self.scale
        before = min(v for v in counted.values if np.isfinite(v))
        again = _Counted(
            counted.function if not exact else (lambda theta: counted.function(theta)[:1]),
            counted.center,
            self.scale,
            gradient=False,
            most=self.most - len(counted.values),
        )
        simplex = np.vstack([start, start + 0.01 * np.eye(start.size)])
        polished = self._run(
            again,
            start,
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "xatol": 1e-5, "fatol": 1e-9 * size, "maxfev": 60 * start.size},
        )
        self.thetas += again.thetas
        self.values += again.values
        if polished.fun <= before:
            self.best = again.thetas[int(np.nanargmin(again.values))]
        gain = (before - polished.fun) / max(abs(before), 1e-300)
        polished.success = bool(polished.success or gain < _SETTLED)
        polished.message = f"{result.message} A simplex from there gained {max(gain, 0):.1e}: {polished.message}"
        return polished
