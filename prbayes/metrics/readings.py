"""Measured outputs with what is known of the measurement: error, rounding, censoring, gaps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from prbayes._checks import Floats

_LOG_ROOT_2PI = 0.5 * np.log(2 * np.pi)


@dataclass(frozen=True, eq=False)
class Readings:
    """Readings of m outputs of N specimens.

    Attributes
    ----------
    values : ndarray, shape (N, m)
        NaN where an output was not measured, or is censored.
    error : ndarray, shape (N, m)
        Standard deviation of the reading's normal error; zero if it is exact.
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
        sd = np.sqrt(emulator_error**2 + self.error**2 + self.step**2 / 12)
        return np.where(self.is_measured, sd, np.inf)

    def log_density(self, outputs: Floats, emulator_error: Floats) -> Floats:
        """Return the log-density of each specimen's readings given outputs, (N, ..., m) -> (N, ...).

        A censored reading has the probability of its interval, a rounded one the mean density over
        its step.
        """
        extra = (slice(None), *(None,) * (outputs.ndim - 2))
        sd = np.sqrt(emulator_error**2 + self.error**2)[extra]
        away = (self.values[extra] - outputs) / sd
        total = np.where(self.is_measured[extra], -0.5 * away**2 - np.log(sd) - _LOG_ROOT_2PI, 0.0)
        if (self.step > 0).any():
            half = self.step[extra] / 2
            low = (self.values[extra] - half - outputs) / sd
            high = (self.values[extra] + half - outputs) / sd
            with np.errstate(divide="ignore", invalid="ignore"):
                mean = log_interval_probability(low, high) - np.log(2 * half)
            total = np.where((half > 0) & self.is_measured[extra], mean, total)
        if self.is_censored.any():
            low = (self.lower[extra] - outputs) / sd
            high = (self.upper[extra] - outputs) / sd
            inside = log_interval_probability(low, high)
            total = np.where(self.is_censored[extra], inside, total)
        result = total.sum(axis=-1)
        return np.where(np.isnan(result), -np.inf, result)


def log_interval_probability(low: Floats, high: Floats) -> Floats:
    """Return log(Phi(high) - Phi(low)) of a standard normal variable, in the tails too."""
    # In the upper tail both are taken by symmetry, so that no digits are lost.
    upper = low > 0
    a, b = np.where(upper, -high, low), np.where(upper, -low, high)
    log_b, log_a = log_ndtr(b), log_ndtr(a)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(log_b + np.log1p(-np.exp(log_a - log_b)))
