"""Objective of a minimisation: scales, penalty, standardised units, record of evaluations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator, has_other_terms

# Theta (d,) -> value, gradient (d,) or None, number of evaluations.
type Function = Callable[[Floats], tuple[float, Floats | None, int]]


class SpentError(Exception):
    """The largest number of evaluations is reached."""


class StalledError(Exception):
    """A line search has made no progress for some time."""


@dataclass(frozen=True, eq=False)
class Ridge:
    """Quadratic penalty that regularises directions which the data do not identify."""

    center: Floats  # (d,)
    directions: Floats  # (d, q): orthonormal in units of the prior's spread
    weight: float  # of half the squared distance, in units of the objective

    def __call__(self, thetas: Floats, prior_sd: Floats) -> Floats:
        """Return the penalty at thetas, (..., d) -> (...)."""
        along = (thetas - self.center) / prior_sd @ self.directions
        return np.asarray(0.5 * self.weight * (along**2).sum(axis=-1))

    def gradient(self, thetas: Floats, prior_sd: Floats) -> Floats:
        """Return the gradient of the penalty at thetas, (..., d)."""
        along = (thetas - self.center) / prior_sd @ self.directions
        return np.asarray(self.weight * (along @ self.directions.T) / prior_sd)


@dataclass(eq=False)
class Objective:
    """A function in standardised parameters t and values, theta = center + t * prior_sd."""

    function: Function
    center: Floats  # (d,)
    prior_sd: Floats  # (d,)
    size: float  # typical size of the values
    gradient: bool  # whether the gradient is returned as well
    max_evaluations: int
    ridge: Ridge | None = None
    patience: float = np.inf  # points without progress after which a line search has stalled
    least_gain: float = 0.0  # relative, that counts as progress
    report: Callable[[int, str], None] = field(default=lambda done, note: None)
    count: int = field(default=0, init=False)
    thetas: list[Floats] = field(default_factory=list, init=False)
    values: list[float] = field(default_factory=list, init=False)
    counts: list[int] = field(default_factory=list, init=False)  # evaluations up to each point
    lowest: float = field(default=np.inf, init=False)  # smallest finite value
    _since_progress: int = field(default=0, init=False)
    _value_at_progress: float = field(default=np.inf, init=False)

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
        self.count += cost
        self.thetas.append(theta)
        self.values.append(float(value))
        self.counts.append(self.count)
        if np.isfinite(value):
            self.lowest = min(self.lowest, float(value))
        value = float(value) / self.size
        self._check_progress(value, cost)
        if not self.gradient:
            return value if np.isfinite(value) else 1e300
        slope = np.asarray(gradient) * self.prior_sd / self.size
        if not np.isfinite(value) or not np.isfinite(slope).all():
            # Leads back to the start without breaking a line search.
            return 1e10 + float(t @ t), 2 * t
        return value, slope

    def _check_progress(self, value: float, cost: int) -> None:
        # A relative gain below 1e-10 is rounding of a sum over thousands of points.
        least = max(1e-10, self.least_gain * abs(self._value_at_progress))
        is_first = not np.isfinite(self._value_at_progress)
        if is_first or value < self._value_at_progress - least:
            self._since_progress, self._value_at_progress = 0, value
        else:
            self._since_progress += 1
        self.report(cost, f"discrepancy {self.lowest:.4g}")
        if self._since_progress > self.patience:
            raise StalledError

    @property
    def best(self) -> Floats:
        """The point with the smallest value, or the center."""
        if not self.values:
            return self.center
        values = np.nan_to_num(self.values, nan=np.inf, posinf=np.inf)
        return self.thetas[int(np.argmin(values))]


def initial_scales(evaluator: Evaluator, *, prior: bool) -> Floats:
    """Return the first divisors of the discrepancies, (k,): epsilons, or typical sizes.

    One for a simulator alone. Raises ValueError if log-densities are added to discrepancies
    without an epsilon of each.
    """
    terms = ""
    if prior:
        terms = "minus the log prior (prior=True)"
    elif _has_varying_terms(evaluator):
        terms = "other likelihood terms or potentials"
    elif len(evaluator.nodes) == 1:
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
    return np.where(np.isnan(evaluator.epsilon), sizes, evaluator.epsilon)


def _has_varying_terms(evaluator: Evaluator) -> bool:
    """Return whether other terms do more than exclude hyperparameters."""
    if not has_other_terms(evaluator):
        return False
    # A power of two, as Sobol points are then balanced.
    values = evaluator.log_other(evaluator.hyperparameters.prior_points(64, 0))
    finite = values[np.isfinite(values)]
    return finite.size > 0 and bool(np.ptp(finite) > 0)
