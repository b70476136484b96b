"""Objective of a minimisation in standardised units, and the options of SciPy's methods for it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from prbayes._validate import Floats, NamedValues
from prbayes.model.evaluator import Evaluator, epsilons, has_other_terms

# function of theta, (d,), that returns value, gradient (d,) or None, and number of evaluations
type Function = Callable[[Floats], tuple[float, Floats | None, int]]


class SpentError(Exception):
    """The largest number of evaluations is reached."""


class StalledError(Exception):
    """A line search has made no progress for some time."""


@dataclass(frozen=True, eq=False)
class Ridge:
    """Quadratic penalty that regularises directions which the data do not identify."""

    center: Floats  # (d,)
    directions: Floats  # (d, q): directions, orthonormal in units of the prior's spread
    weight: float  # factor of half the squared distance, in units of the objective

    def __call__(self, thetas: Floats, prior_sd: Floats) -> Floats:
        """Return the penalty at thetas, (..., d) -> (...)."""
        along = (thetas - self.center) / prior_sd @ self.directions
        return 0.5 * self.weight * (along**2).sum(axis=-1)

    def gradient(self, thetas: Floats, prior_sd: Floats) -> Floats:
        """Return the gradient of the penalty at thetas, (..., d)."""
        along = (thetas - self.center) / prior_sd @ self.directions
        return self.weight * (along @ self.directions.T) / prior_sd


@dataclass(eq=False)
class Objective:
    """A function of standardised parameters t, theta = center + t * prior_sd."""

    function: Function
    center: Floats  # (d,)
    prior_sd: Floats  # (d,)
    size: float  # typical size of the values
    gradient: bool  # whether the gradient is returned as well
    max_evaluations: int
    ridge: Ridge | None = None
    # number of points without progress after which a line search has stalled
    patience: float = np.inf
    least_gain: float = 0.0  # smallest relative gain that counts as progress
    report: Callable[[int, str], None] = field(default=lambda done, note: None)
    count: int = field(default=0, init=False)
    thetas: list[Floats] = field(default_factory=list, init=False)
    values: list[float] = field(default_factory=list, init=False)
    # numbers of evaluations up to each point
    counts: list[int] = field(default_factory=list, init=False)
    best: Floats = field(init=False)  # theta of the lowest value, or the center
    lowest: float = field(default=np.inf, init=False)  # smallest finite value
    _since_progress: int = field(default=0, init=False)
    _value_at_progress: float = field(default=np.inf, init=False)

    def __post_init__(self) -> None:
        self.best = self.center

    def __call__(self, t: Floats) -> Any:
        """Return the value, and the gradient where there is one.

        Raises SpentError at the largest number of evaluations, StalledError without progress.
        """
        if self.count >= self.max_evaluations:
            raise SpentError
        theta = self.center + np.asarray(t) * self.prior_sd
        value, gradient, cost = self.function(theta)
        if self.ridge is not None:
            value = value + float(self.ridge(theta, self.prior_sd))
            if gradient is not None:
                gradient = gradient + self.ridge.gradient(theta, self.prior_sd)
        value = float(value)
        self.count += cost
        self.thetas.append(theta)
        self.values.append(value)
        self.counts.append(self.count)
        if np.isfinite(value) and value < self.lowest:
            self.lowest, self.best = value, theta
        self.report(cost, f"discrepancy {self.lowest:.4g}")
        value = value / self.size
        # Relative gains below 1e-10 are rounding errors of a sum over thousands of points.
        least = max(1e-10, self.least_gain * abs(self._value_at_progress))
        is_first = not np.isfinite(self._value_at_progress)
        if is_first or value < self._value_at_progress - least:
            self._since_progress, self._value_at_progress = 0, value
        else:
            self._since_progress += 1
        if self._since_progress > self.patience:
            raise StalledError
        if not self.gradient:
            return value if np.isfinite(value) else 1e300
        slope = np.asarray(gradient) * self.prior_sd / self.size
        if not np.isfinite(value) or not np.isfinite(slope).all():
            # A bowl around the start leads a line search back, where infinite values would end it.
            return 1e10 + float(t @ t), 2 * t
        return value, slope


def initial_scales(evaluator: Evaluator, *, prior: bool) -> Floats:
    """Return the first divisors of the discrepancies, (k,): epsilons, or typical sizes.

    The divisor of a single simulator is one. Raises ValueError if log-densities are added to
    discrepancies without an epsilon of each.
    """
    terms = ""
    if prior:
        terms = "minus the log prior (prior=True)"
    elif has_other_terms(evaluator.model):
        # Terms that only exclude hyperparameters are constant elsewhere, and do not count.
        values = evaluator.log_other(evaluator.hyperparameters.prior_points(64, 0))
        finite = values[np.isfinite(values)]
        if finite.size and np.ptp(finite) > 0:
            terms = "other likelihood terms or potentials"
    epsilon = epsilons(evaluator)
    if not terms and epsilon.size == 1:
        return np.ones(1)
    unset = [node.name for node in evaluator.nodes if np.isnan(node.epsilon_value)]
    if terms and unset:
        raise ValueError(
            f"prb.minimize: got {terms} beside simulators without epsilon, {unset}, expected an "
            "epsilon of each, without which a discrepancy has no weight against a log-density; "
            "pass epsilon= to prb.Simulator, or calibrate one on the simulators alone, in a model "
            "without other terms and with prior=False: "
            "prb.set_epsilon(model, dict(prb.calibrate_epsilon(prb.minimize(alone))))"
        )
    sizes = np.array([node.target.scale for node in evaluator.nodes])
    return np.where(np.isnan(epsilon), sizes, epsilon)


# SciPy's minimisers that need no Hessian
_GRADIENT_FREE = ("Nelder-Mead", "Powell", "COBYLA", "COBYQA")
_WITH_GRADIENT = ("BFGS", "CG", "L-BFGS-B", "Newton-CG", "SLSQP", "TNC", "trust-constr")


@dataclass(frozen=True)
class Method:
    """A minimiser of `scipy.optimize.minimize`, by name or as a function, with its options.

    Raises ValueError or TypeError if there is no such method or option.
    """

    method: str | Callable[..., Any] = "BFGS"
    # options that replace those of `settings`
    options: NamedValues = field(default_factory=dict)
    gradient: bool = field(init=False)  # whether the method uses gradients

    def __post_init__(self) -> None:
        if isinstance(self.method, str):
            names = (*_WITH_GRADIENT, *_GRADIENT_FREE)
            if self.method.lower() not in {name.lower() for name in names}:
                raise ValueError(
                    f"method: got {self.method!r}, expected one of {', '.join(names)}, or a "
                    "function that scipy.optimize.minimize takes as its method"
                )
        elif not callable(self.method) or isinstance(self.method, type):
            raise TypeError(
                f"method: got {self.method!r:.60}, expected the name of a scipy method, or a "
                "function that scipy.optimize.minimize takes as its method"
            )
        if not isinstance(self.options, Mapping):
            raise TypeError(
                f"options: got {type(self.options).__name__}, expected a mapping of names to values"
            )
        if isinstance(self.method, str) and self.options:
            self._refuse_unknown_options(self.method)
        is_free = str(self.method).lower() in {name.lower() for name in _GRADIENT_FREE}
        object.__setattr__(self, "gradient", not is_free)

    def _refuse_unknown_options(self, method: str) -> None:
        """Raise for options that scipy's method does not have, of which it only warns."""
        if not all(isinstance(name, str) for name in self.options):
            raise TypeError(f"options: got {list(self.options)} as names, expected texts")
        # Import here, because SciPy's minimisers take longer to import than the whole package.
        from scipy.optimize import OptimizeWarning
        from scipy.optimize import minimize as scipy_minimize

        # SciPy checks the names of options when it runs: minimise a parabola from its minimum.
        # Invalid values raise an error later, on the problem itself.
        options = {name: value for name, value in self.options.items() if name != "disp"}
        with warnings.catch_warnings(record=True) as caught, suppress(Exception):
            warnings.simplefilter("always")
            scipy_minimize(
                lambda x: (x @ x, 2 * x), np.zeros(2), method=method, jac=True, options=options
            )
        for warning in caught:
            if issubclass(warning.category, OptimizeWarning):
                raise ValueError(
                    f"options: got {dict(self.options)}, expected options of scipy's {method}; "
                    f"scipy says: {warning.message}"
                )

    def settings(self, tolerance: float, size: int) -> dict[str, Any]:
        """Return scipy's options for a standardised problem of ``size`` parameters.

        The objective limits evaluations, so iterations are unlimited.
        """
        if not isinstance(self.method, str):
            return dict(self.options)
        most = 10**9  # a limit that is never reached
        # The first step of methods without gradient is larger than most standard errors, and within
        # the prior.
        step = 0.2
        defaults: dict[str, dict[str, Any]] = {
            "bfgs": {"gtol": tolerance},
            "cg": {"gtol": tolerance},
            "l-bfgs-b": {"gtol": tolerance, "ftol": tolerance**2, "maxfun": most},
            "newton-cg": {"xtol": tolerance},
            "slsqp": {"ftol": tolerance**2},
            "tnc": {"gtol": tolerance, "ftol": tolerance**2, "xtol": 0.0, "maxfun": most},
            "trust-constr": {"gtol": tolerance, "xtol": tolerance**2},
            "nelder-mead": {
                "xatol": tolerance,
                "fatol": tolerance / 100,
                "initial_simplex": np.vstack([np.zeros(size), step * np.eye(size)]),
                "maxfev": most,
            },
            "powell": {"xtol": tolerance, "ftol": tolerance**2, "maxfev": most},
            "cobyla": {"tol": tolerance, "rhobeg": step},
            "cobyqa": {
                "final_tr_radius": tolerance,
                "initial_tr_radius": step,
                "maxfev": most,
            },
        }
        name = self.method.lower()
        iterations = {} if name == "tnc" else {"maxiter": most}
        return {**defaults[name], **iterations, **self.options}


@dataclass(frozen=True)
class Minimisation:
    """Settings of `minimize`."""

    start: dict[str, Any] | None = None
    method: Method = field(default_factory=Method)
    prior: bool = False
    tolerance: float = 1e-6
    max_evaluations: int = 5000
    refine: bool = True
    starts: int | None = None
    random_seed: int = 0
