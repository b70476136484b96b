"""Measured outputs with their errors, rounding, censoring and gaps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from prbayes._stats import positive_scale
from prbayes._validate import Bools, Floats, Indices
from prbayes.readings import COUNTS


@dataclass(frozen=True, eq=False)
class Readings:
    """Readings of m outputs of N specimens; all arrays have the shape (N, m)."""

    # Estimates of the outputs: readings without known bias, counts divided by their exposure; NaN
    # if an output was not measured, or is censored.
    values: Floats
    error: Floats  # standard deviation of the normal error; zero if the reading is exact
    relative: Floats  # further standard deviation, as a share of the output
    step: Floats  # width to which the reading was rounded; zero if it was not
    lower: Floats  # lower bound of a censored reading, perhaps infinite; NaN if not censored
    upper: Floats  # upper bound, likewise
    bias: Floats  # known mean of the error
    # Index of the distribution of a count in `prbayes.readings.COUNTS`; -1 for a normal error. The
    # error of a count is that of the normal approximation of its likelihood.
    family: Indices
    size: Floats  # exposure of a count
    parameter: Floats  # parameter of the distribution of a count

    @classmethod
    def exact(cls, values: Floats) -> Readings:
        """Return readings without error, (N, m)."""
        zero, unit = np.zeros_like(values), np.ones_like(values)
        missing = np.full_like(values, np.nan)
        family = np.full(values.shape, -1)
        return cls(values, zero, zero, zero, missing, missing, zero, family, unit, unit)

    def __len__(self) -> int:
        return len(self.values)

    def rows(self, index: Indices) -> Readings:
        """Return the readings of selected specimens."""
        return _mapped(self, lambda array: array[index])

    def at_columns(self, columns: Indices) -> Readings:
        """Return the readings of selected outputs of each specimen, (N, k)."""
        return _mapped(self, lambda array: np.take_along_axis(array, columns, axis=1))

    @property
    def is_measured(self) -> Bools:
        """Which readings are numbers, (N, m)."""
        return np.isfinite(self.values)

    @property
    def is_censored(self) -> Bools:
        """Which readings are intervals, (N, m)."""
        return ~np.isnan(self.lower)

    def error_sd(self, outputs: Any) -> Any:
        """Return the standard deviation of the errors of outputs that broadcast against (N, m)."""
        return np.hypot(self.error, self.relative * np.abs(outputs))

    def spread(self) -> Floats:
        """Return the standard deviation of each output over specimens, (m,); one if it is zero.

        Few readings do not determine a scale. Outputs with fewer than eight readings share the
        standard deviation of all their readings. An output that is censored throughout has a tenth
        of the limit, and at least the error.
        """
        count = np.maximum(self.is_measured.sum(axis=0), 1)
        values = np.where(self.is_measured, self.values, 0.0)
        mean = values.sum(axis=0) / count
        deviations = np.where(self.is_measured, values - mean, 0.0)
        sd = np.sqrt((deviations**2).sum(axis=0) / count)
        few = self.is_measured.sum(axis=0) < min(8, len(self))
        pooled = self.values[:, few][self.is_measured[:, few]]
        if few.sum() > 1 and pooled.size > 1:
            sd[few] = pooled.std()
        for j in np.flatnonzero(~self.is_measured.any(axis=0)):
            limits = np.nan_to_num(np.abs(located_values(self)[:, j]))
            sd[j] = max(0.1 * limits.max(), self.error[:, j].max())
        return positive_scale(sd)

    def comparison_sd(self, emulator_error: Floats) -> Floats:
        """Return the standard deviation of the comparison with an emulator, (N, m).

        Emulator error, reading error and rounding add; infinite where nothing was measured.
        """
        error = self.error_sd(np.nan_to_num(self.values))
        sd = np.sqrt(emulator_error**2 + error**2 + self.step**2 / 12)
        return np.where(self.is_measured, sd, np.inf)

    def log_density(self, outputs: Floats, emulator_error: Floats) -> Floats:
        """Return the log-density of each specimen's readings given outputs, (N, K, m) -> (N, K).

        The log-density is -inf if an output is NaN.
        """
        if self.relative.any():
            by_point = np.moveaxis(outputs, 1, 0)  # (K, N, m)
            variance = np.moveaxis(emulator_error**2 + self.error_sd(by_point) ** 2, 0, 1)
        else:
            variance = (emulator_error**2 + self.error**2)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            result = self.symbolic_log_density(outputs, variance, np)
        return np.where(np.isnan(result), -np.inf, result)

    def symbolic_log_density(
        self, outputs: Any, variance: Any, xp: Any, parameter: Any = None
    ) -> Any:
        """Return the log-density, (N, K), as an array or a graph of the comparison's variance.

        A censored reading has the probability of its interval, a rounded one the mean density over
        its step, a count that of its distribution with the ``parameter``, without an error of the
        emulator. Variance and parameter broadcast against the outputs, (N, K, m).
        """
        sd = xp.sqrt(variance)
        values = np.where(self.is_measured, self.values, 0.0)[:, None]
        z = (values - outputs) / sd
        normal = -0.5 * z**2 - 0.5 * xp.log(2 * np.pi * variance)
        terms = xp.where(self.is_measured[:, None], normal, 0.0)
        if (self.step > 0).any():
            step = positive_scale(self.step)[:, None]
            half = step / (2 * sd)
            inside = log_interval_probability(z - half, z + half, xp)
            is_rounded = ((self.step > 0) & self.is_measured)[:, None]
            terms = xp.where(is_rounded, inside - np.log(step), terms)
        if self.is_censored.any():
            # Infinite bounds become large numbers, because their derivatives would be NaN.
            far = 1e30
            lower = np.where(self.is_censored, np.maximum(self.lower, -far), 0.0)[:, None]
            upper = np.where(self.is_censored, np.minimum(self.upper, far), 1.0)[:, None]
            low = (lower - outputs) / sd
            high = (upper - outputs) / sd
            inside = log_interval_probability(low, high, xp)
            terms = xp.where(self.is_censored[:, None], inside, terms)
        for code in _codes(self):
            is_count = ((self.family == code) & self.is_measured)[:, None]
            size = self.size[:, None]
            counts = np.where(is_count, np.round(values * size), 0.0)
            parameter = self.parameter[:, None] if parameter is None else parameter
            logs = COUNTS[code].log_density(counts, size * outputs, size, parameter, xp)
            terms = xp.where(is_count, logs, terms)
        # In NumPy a matrix product is five times faster than a sum over a short axis.
        return terms @ np.ones(terms.shape[-1]) if xp is np else terms.sum(axis=-1)


def _codes(readings: Readings) -> tuple[int, ...]:
    """Return the codes of the distributions of counts among the readings."""
    return tuple(code for code in np.unique(readings.family).tolist() if code >= 0)


def _mapped(readings: Readings, function: Callable[[NDArray[Any]], NDArray[Any]]) -> Readings:
    """Return the readings with a function applied to each array."""
    return Readings(*[function(getattr(readings, f.name)) for f in fields(readings)])


def has_error(readings: Readings) -> Bools:
    """Return which readings have an error of their own, known or unknown, (N, m)."""
    return (readings.error > 0) | (readings.relative > 0)


def located_values(readings: Readings) -> Floats:
    """Return readings, (N, m); of an output that is censored throughout, the finite limits."""
    limits = np.where(np.isfinite(readings.lower), readings.lower, readings.upper)
    return np.where(readings.is_measured.any(axis=0), readings.values, limits)


def robust_spread(readings: Readings) -> Floats:
    """Return the standard deviation of each output by its quartiles, (m,).

    Unlike `Readings.spread` it does not depend on a few specimens near a pole of the response. If
    the quartiles are equal, it is `Readings.spread`.
    """
    widths = np.zeros(readings.values.shape[1])
    for j, column in enumerate(readings.values.T):
        measured = column[readings.is_measured[:, j]]
        if measured.size >= min(8, len(readings)):
            high, low = np.quantile(measured, [0.75, 0.25])
            widths[j] = high - low
    scatter = widths / 1.349
    return np.where(scatter > 0, scatter, readings.spread())


def relative_error(readings: Readings, error: Floats) -> Floats:
    """Return errors of an emulator, (m,), in units of `robust_spread`.

    Outputs with fewer than eight readings share the root mean square of their errors.
    """
    count = readings.is_measured.sum(axis=0)
    few = (count > 0) & (count < min(8, len(readings)))
    squares = (count[few] * error[few] ** 2).sum() / np.maximum(count[few].sum(), 1)
    return np.where(few, np.sqrt(squares), error) / robust_spread(readings)


def scaled_errors(readings: Readings, factor: float | Floats) -> Readings:
    """Return the readings with their errors multiplied by a factor, a number or (m,)."""
    power = np.ones(readings.family.shape)
    for code in _codes(readings):
        power[readings.family == code] = 1.0 if COUNTS[code].widens else -2.0
    return replace(
        readings,
        error=factor * readings.error,
        relative=factor * readings.relative,
        parameter=factor**power * readings.parameter,
    )


def with_values(readings: Readings, numbers: Floats) -> Readings:
    """Return the same readings with other numbers, (N, m), none of them censored.

    Missing readings stay missing. The normal approximation of counts follows the new ones.
    """
    missing = np.full_like(readings.values, np.nan)
    values = np.where(readings.is_measured, numbers / readings.size - readings.bias, np.nan)
    result = replace(readings, values=values, lower=missing, upper=missing)
    for code in _codes(readings):
        counts = np.where(readings.is_measured, numbers, 0.0)
        sd = COUNTS[code].sd(counts, readings.size, readings.parameter) / readings.size
        result = replace(result, error=np.where(readings.family == code, sd, result.error))
    return result


def add_errors(
    readings: Readings,
    rng: np.random.Generator,
    outputs: Floats,
    error: Any = 1.0,
    relative: Any = 1.0,
    bias: Any = 0.0,
) -> Floats:
    """Draw readings of outputs, (P, N, m), with their errors and rounding.

    ``error`` and ``relative`` are factors of the errors, the first one also of the parameter of
    counts, and ``bias`` is added to the known one; they broadcast to the outputs.
    """
    additive = error * readings.error
    proportional = relative * readings.relative * np.abs(outputs)
    sd = np.hypot(additive, proportional)
    noise = rng.standard_normal(outputs.shape)
    result = outputs + sd * noise + (readings.bias + bias)
    if (readings.step > 0).any():
        unit = positive_scale(readings.step)
        result = np.where(readings.step > 0, np.round(result / unit) * unit, result)
    for code in _codes(readings):
        is_count = np.broadcast_to(readings.family == code, outputs.shape)
        numbers = (readings.size * outputs, readings.size, error * readings.parameter)
        mean, size, parameter = (np.broadcast_to(x, outputs.shape)[is_count] for x in numbers)
        result[is_count] = COUNTS[code].draw(rng, mean, size, parameter)
    return np.asarray(result)


@dataclass(frozen=True, eq=False)
class Repeats:
    r"""The log-density of repeated readings less that of their weighted mean.

    Readings :math:`y_r` with standard deviations :math:`e c_r` have the mean :math:`\bar y` with
    :math:`e c`, :math:`c^{-2} = \sum c_r^{-2}`, and

    .. math:: \prod_r N(y_r;\, f,\, e^2 c_r^2) = N(\bar y;\, f,\, e^2 c^2)\,
        \frac{c}{(2 \pi e^2)^{(R-1)/2} \prod_r c_r}
        \exp\Bigl(-\frac{1}{2 e^2} \sum_r \frac{(y_r - \bar y)^2}{c_r^2}\Bigr).
    """

    count: Floats  # number of readings less one, (N, m)
    within: Floats  # weighted sum of squares around the mean, (N, m)
    constant: Floats  # logarithm of the factor without e, (N, m)

    def log_density(self, error: Any, xp: Any) -> Any:
        """Return the sum over outputs, (N,), as an array or a graph of the error e, (m,)."""
        terms = self.constant - self.count * xp.log(error) - self.within / (2 * error**2)
        return terms.sum(axis=-1)


def side_by_side(records: Sequence[Any]) -> Any:
    """Concatenate records of different outputs of the same specimens."""
    first = records[0]
    names = [f.name for f in fields(first)]
    arrays = {name: np.concatenate([getattr(r, name) for r in records], axis=1) for name in names}
    return replace(first, **arrays)


def averaged(
    readings: Readings, scale: Floats, numbers: Indices, count: Indices
) -> tuple[Readings, Floats, Repeats]:
    """Return readings of S specimens, in which repeated ones are averaged, and their scale, (S, m).

    ``scale``, (N, m), is the standard deviation of the error of each reading, in any unit e; it is
    positive for repeated readings. ``numbers``, (N,), is the specimen of each row, and ``count``,
    (S, m), the number of readings of each output. Also return what the log-density of the mean
    lacks.
    """
    present = np.nonzero(readings.is_measured | readings.is_censored)
    places = numbers[present[0]], present[1]

    def by_specimen(values: Floats, missing: Any) -> Floats:
        result = np.empty(count.shape)
        result[:] = missing
        result[numbers] = values  # any row of a specimen, for outputs that were not measured
        result[places] = values[present]
        return result

    error = by_specimen(readings.error, np.median(readings.error, axis=0))
    combined = Readings(
        values=by_specimen(readings.values, np.nan),
        error=error,
        step=by_specimen(readings.step, np.median(readings.step, axis=0)),
        lower=by_specimen(readings.lower, np.nan),
        upper=by_specimen(readings.upper, np.nan),
        relative=by_specimen(readings.relative, np.median(readings.relative, axis=0)),
        bias=by_specimen(readings.bias, np.median(readings.bias, axis=0)),
        family=np.broadcast_to(readings.family[:1], count.shape),
        size=by_specimen(readings.size, np.median(readings.size, axis=0)),
        parameter=by_specimen(readings.parameter, np.median(readings.parameter, axis=0)),
    )
    single_scale = by_specimen(scale, np.median(scale, axis=0))
    is_repeated = count > 1
    if not is_repeated.any():
        zero = np.zeros(count.shape)
        return combined, single_scale, Repeats(zero, zero, zero)

    def total(values: Floats) -> Floats:
        result = np.zeros(count.shape)
        np.add.at(result, places, np.where(is_repeated[places], values, 0.0))
        return np.where(is_repeated, result, 0.0)

    with np.errstate(divide="ignore", invalid="ignore"):
        c = scale[present]
        y = readings.values[present]
        precision = total(c**-2.0)
        mean = total(y / c**2) / precision
        within = total(((y - mean[places]) / c) ** 2)
        mean_scale = precision**-0.5
        mean_error = error / single_scale * mean_scale
        normal = (count - 1) / 2 * np.log(2 * np.pi)
        constant = np.log(mean_scale) - total(np.log(c)) - normal
    combined = replace(
        combined,
        values=np.where(is_repeated, mean, combined.values),
        error=np.where(is_repeated, mean_error, error),
    )
    n_extra = np.where(is_repeated, count - 1.0, 0.0)
    repeats = Repeats(n_extra, within, np.where(is_repeated, constant, 0.0))
    return combined, np.where(is_repeated, mean_scale, single_scale), repeats


def log_interval_probability(low: Any, high: Any, xp: Any = np) -> Any:
    """Return log(Phi(high) - Phi(low)) of a standard normal variable, in the tails too."""
    # In the upper tail both ends are mirrored, so that no digits are lost.
    is_upper = low > 0
    a = xp.where(is_upper, -high, low)
    b = xp.where(is_upper, -low, high)
    log_a = _log_distribution(a, xp)
    log_b = _log_distribution(b, xp)
    return log_b + xp.log1p(-xp.exp(log_a - log_b))


def _log_distribution(x: Any, xp: Any) -> Any:
    """Return log Phi(x)."""
    if xp is np:
        return log_ndtr(x)
    scaled = x / np.sqrt(2)
    # Both branches have to be finite everywhere, because gradients pass through both.
    lower = xp.log(xp.erfcx(-xp.minimum(scaled, 0.0)) / 2) - xp.minimum(scaled, 0.0) ** 2
    upper = xp.log1p(-xp.erfc(xp.maximum(scaled, 0.0)) / 2)
    return xp.where(x < 0, lower, upper)
