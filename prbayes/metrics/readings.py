"""Measured outputs with what is known of the measurement: error, rounding, censoring, gaps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from prbayes._checks import Floats


@dataclass(frozen=True, eq=False)
class Readings:
    """Readings of m outputs of N specimens.

    Attributes
    ----------
    values : ndarray, shape (N, m)
        NaN where an output was not measured, or is censored.
    error : ndarray, shape (N, m)
        Standard deviation of the reading's normal error; zero if it is exact.
    relative : bool
        Whether the error is a share of the output.
    step : ndarray, shape (N, m)
        Width to which the reading was rounded; zero if it was not.
    lower, upper : ndarray, shape (N, m)
        Bounds of a censored reading, perhaps infinite; NaN where the reading is not censored.
    """

    values: Floats
    error: Floats
    step: Floats
    lower: Floats
    upper: Floats
    relative: bool = False

    @classmethod
    def exact(cls, values: Floats) -> Readings:
        """Return readings without error, (N, m)."""
        zero, missing = np.zeros_like(values), np.full_like(values, np.nan)
        return cls(values, zero, zero, missing, missing)

    def __len__(self) -> int:
        return len(self.values)

    def rows(self, index: NDArray[np.intp]) -> Readings:
        """Return the readings of some specimens."""
        fields = ("values", "error", "step", "lower", "upper")
        return replace(self, **{name: getattr(self, name)[index] for name in fields})

    @property
    def is_measured(self) -> NDArray[np.bool_]:
        """Which readings are numbers, (N, m)."""
        return np.isfinite(self.values)

    @property
    def is_censored(self) -> NDArray[np.bool_]:
        """Which readings are known to an interval alone, (N, m)."""
        return ~np.isnan(self.lower)

    def error_sd(self, outputs: Any) -> Any:
        """Return the standard deviation of the errors of outputs that broadcast against (N, m)."""
        return self.error * np.abs(outputs) if self.relative else self.error

    def spread(self) -> Floats:
        """Return the standard deviation of each output over specimens, (m,); one if it is zero."""
        measured = self.is_measured
        count = np.maximum(measured.sum(axis=0), 1)
        values = np.where(measured, self.values, 0.0)
        mean = values.sum(axis=0) / count
        away = np.where(measured, values - mean, 0.0)
        sd = np.sqrt((away**2).sum(axis=0) / count)
        return np.where(sd > 0, sd, 1.0)

    def comparison_sd(self, emulator_error: Floats) -> Floats:
        """Return the standard deviation of the comparison with an emulator, (N, m).

        Emulator error, reading error and rounding add; infinite where nothing was measured.
        """
        error = self.error_sd(np.nan_to_num(self.values))
        sd = np.sqrt(emulator_error**2 + error**2 + self.step**2 / 12)
        return np.where(self.is_measured, sd, np.inf)

    def scaled(self, factor: float) -> Readings:
        """Return the readings with another scale of their error."""
        return replace(self, error=factor * self.error)

    def log_density(self, outputs: Floats, emulator_error: Floats) -> Floats:
        """Return the log-density of each specimen's readings given outputs, (N, K, m) -> (N, K).

        -inf where an output is NaN.
        """
        by_point = np.moveaxis(outputs, 1, 0)  # (K, N, m)
        variance = emulator_error**2 + self.error_sd(by_point) ** 2
        variance = np.moveaxis(np.broadcast_to(variance, by_point.shape), 0, 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            result = self.symbolic_log_density(outputs, variance, np)
        return np.where(np.isnan(result), -np.inf, result)

    def symbolic_log_density(self, outputs: Floats, variance: Any, xp: Any) -> Any:
        """Return the same as an array or a graph of the comparison's variance.

        A censored reading has the probability of its interval, a rounded one the mean density over
        its step.

        Parameters
        ----------
        outputs : ndarray, shape (N, K, m)
        variance : array or graph that broadcasts against it
        xp : module
            ``numpy`` or ``pytensor.tensor``.
        """
        sd = xp.sqrt(variance)
        values = np.where(self.is_measured, self.values, 0.0)[:, None]
        away = (values - outputs) / sd
        normal = -0.5 * away**2 - 0.5 * xp.log(2 * np.pi * variance)
        terms = xp.where(self.is_measured[:, None], normal, 0.0)
        if (self.step > 0).any():
            step = np.where(self.step > 0, self.step, 1.0)[:, None]
            inside = log_interval_probability(away - step / (2 * sd), away + step / (2 * sd), xp)
            is_rounded = ((self.step > 0) & self.is_measured)[:, None]
            terms = xp.where(is_rounded, inside - np.log(step), terms)
        if self.is_censored.any():
            # Finite bounds far out: the derivative at an infinite one would be NaN.
            far = 1e30
            lower = np.where(self.is_censored, np.maximum(self.lower, -far), 0.0)[:, None]
            upper = np.where(self.is_censored, np.minimum(self.upper, far), 1.0)[:, None]
            inside = log_interval_probability((lower - outputs) / sd, (upper - outputs) / sd, xp)
            terms = xp.where(self.is_censored[:, None], inside, terms)
        return terms.sum(axis=-1)


def log_interval_probability(low: Any, high: Any, xp: Any = np) -> Any:
    """Return log(Phi(high) - Phi(low)) of a standard normal variable, in the tails too."""
    # In the upper tail both ends are mirrored, so that no digits are lost.
    is_upper = low > 0
    a, b = xp.where(is_upper, -high, low), xp.where(is_upper, -low, high)
    log_a, log_b = _log_distribution(a, xp), _log_distribution(b, xp)
    return log_b + xp.log1p(-xp.exp(log_a - log_b))


def _log_distribution(x: Any, xp: Any) -> Any:
    """Return log Phi(x)."""
    if xp is np:
        return log_ndtr(x)
    scaled = x / np.sqrt(2)
    # Each branch is finite where the other one is chosen, so that gradients are.
    lower = xp.log(xp.erfcx(-xp.minimum(scaled, 0.0)) / 2) - xp.minimum(scaled, 0.0) ** 2
    upper = xp.log1p(-xp.erfc(xp.maximum(scaled, 0.0)) / 2)
    return xp.where(x < 0, lower, upper)
