"""Readings of one simulator, and the readings of all simulators stacked by specimen.

A specimen has one row: the outputs of all simulators side by side, NaN where one was not measured.
Repeated readings of an output are one reading, their weighted mean.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pytensor.tensor.variable import TensorVariable

from prbayes._validate import Floats
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.readings import Readings, Repeats, averaged, side_by_side
from prbayes.propagation.base import Propagation
from prbayes.response.distributions import prior_draws
from prbayes.response.inputs import Inputs
from prbayes.response.outputs import Outputs
from prbayes.response.response import Responses


@dataclass(frozen=True, eq=False)
class Measurement:
    """What one simulator with a log-likelihood by specimen was given.

    Attributes
    ----------
    name : str
    metric : LogLikelihood
    observed : ndarray, shape (N,) or (N, m)
    weights : ndarray, shape (N,), or None
        Factors of the specimens' log-likelihoods, which sum to N.
    specimens : ndarray, shape (N,), or None
        Labels.
    inputs : Inputs
    responses : Responses
    propagation : Propagation
    outputs : Outputs
    groups : ndarray of int, shape (N,), or None
        Index of each specimen's group.
    extras : dict
        Model variables of the measurement: ``error`` and ``gross_errors``.
    """

    name: str
    metric: LogLikelihood
    observed: Floats
    weights: Floats | None
    specimens: NDArray[Any] | None
    inputs: Inputs
    responses: Responses
    propagation: Propagation
    outputs: Outputs
    groups: NDArray[np.intp] | None = None
    extras: Mapping[str, TensorVariable] = field(default_factory=dict)

    @property
    def event(self) -> tuple[int, ...]:
        """Shape of the outputs of a row, () or (m,)."""
        return self.observed.shape[1:]

    @property
    def rows(self) -> Floats:
        """Observed values, (N, m)."""
        return self.observed.reshape(len(self.observed), -1)

    @property
    def gross_errors(self) -> Any:
        """Share of specimens with a gross error: a number, a variable of the model, or False."""
        return self.extras.get("gross_errors", self.metric.gross_errors)

    @cached_property
    def readings(self) -> Readings:
        """Observed values with what is known of the measurement."""
        return self.metric.readings(self.rows, reference_error(self.extras), self.event)

    @property
    def scale(self) -> Floats:
        """Standard deviation of the error of a reading, (N, m), in units of an unknown error."""
        return np.ones_like(self.rows) if "error" in self.extras else self.readings.error

    @cached_property
    def range(self) -> Floats:
        """Smallest and largest observed value of each output, (2, m)."""
        return np.stack([np.nanmin(self.rows, axis=0), np.nanmax(self.rows, axis=0)])

    def observing(self, values: Floats) -> Measurement:
        """Return the measurement with other observed values."""
        values = np.asarray(values, dtype=np.float64)
        if values.ndim != self.observed.ndim or values.shape[1:] != self.event:
            raise ValueError(
                f"{self.name}: observed: got shape {values.shape}, expected "
                f"{('N', *self.event)}, as when the simulator was made"
            )
        if len(values) != len(self.observed) and not (
            self.groups is None and self.weights is None and self.specimens is None
        ):
            raise ValueError(
                f"{self.name}: observed: got {len(values)} specimens, expected "
                f"{len(self.observed)}, as many as there are groups, weights= or specimens=; build "
                "the model again with those of the new ones"
            )
        return replace(self, observed=values)


def reference_error(extras: Mapping[str, TensorVariable]) -> Floats | None:
    """Return a plausible value of an unknown reading error: its prior's 84 % quantile."""
    if "error" not in extras:
        return None
    (draws,) = prior_draws([extras["error"]], 512, seed=0)
    return np.asarray(np.quantile(draws, 0.84, axis=0))


@dataclass(frozen=True, eq=False)
class StackedReadings:
    """Readings of S specimens in M outputs, those of all simulators.

    Attributes
    ----------
    readings : Readings
        Repeated readings of an output by their weighted mean, with its error.
    scale : ndarray, shape (S, M)
        Standard deviation of the error of these readings, in units of an unknown error.
    repeats : Repeats or None
        None if no output of a specimen was read repeatedly.
    numbers : tuple of ndarray of int, shapes (N,)
        Specimen of each row, by simulator.
    groups : ndarray of int, shape (S,), or None
    log_gross : ndarray, shape (S,)
        Log-density of a specimen with a gross error: uniform over twice the range of each output.
    """

    readings: Readings
    scale: Floats
    repeats: Repeats | None
    numbers: tuple[NDArray[np.intp], ...]
    groups: NDArray[np.intp] | None
    log_gross: Floats

    @classmethod
    def of(cls, measurements: Sequence[Measurement]) -> StackedReadings:
        """Stack the readings of simulators.

        Raises
        ------
        ValueError
            If readings of one specimen contradict each other, or cannot be combined.
        """
        numbers, size = _specimen_numbers(measurements)
        parts = [_averaged(m, index, size) for m, index in zip(measurements, numbers, strict=True)]
        readings, scales, repeats = zip(*parts, strict=True)
        log_gross = np.zeros(size)
        for measurement, index in zip(measurements, numbers, strict=True):
            width = 2 * np.ptp(measurement.range, axis=0)
            logs = np.log(np.where(width > 0, width, 1.0))
            logs = np.where(np.isnan(measurement.rows), 0.0, logs).sum(axis=1)
            np.subtract.at(log_gross, index, logs)
        return cls(
            side_by_side(readings),
            np.concatenate(scales, axis=1),
            side_by_side(repeats) if any(part.count.any() for part in repeats) else None,
            tuple(numbers),
            _groups(measurements, numbers, size),
            log_gross,
        )


def _specimen_numbers(
    measurements: Sequence[Measurement],
) -> tuple[list[NDArray[np.intp]], int]:
    """Return the specimen of each row, by simulator, and the number of specimens."""
    first: dict[object, int] = {}
    numbers = []
    for k, measurement in enumerate(measurements):
        labels: list[object] = [(k, i) for i in range(len(measurement.observed))]
        if measurement.specimens is not None:
            labels = measurement.specimens.tolist()
        numbers.append(np.array([first.setdefault(x, len(first)) for x in labels], dtype=np.intp))
    return numbers, len(first)


def _averaged(
    measurement: Measurement, numbers: NDArray[np.intp], size: int
) -> tuple[Readings, Floats, Repeats]:
    """Return the readings of one simulator by specimen, their scale and their repeats."""

    def text(row: int) -> str:
        labels = measurement.specimens
        return repr(int(numbers[row]) if labels is None else labels.tolist()[row])

    readings = measurement.readings
    present = readings.is_measured | readings.is_censored
    count = np.zeros((size, present.shape[1]), dtype=np.intp)
    np.add.at(count, numbers, present)
    repeated = present & (count > 1)[numbers]
    exact = repeated & (measurement.scale == 0)
    is_normal = (readings.step == 0) & ~readings.is_censored & ~readings.is_relative
    coarse = repeated & ~is_normal
    name = measurement.name
    if coarse.any():
        raise ValueError(
            f"{name}: specimens: got the label {text(int(np.argmax(coarse.any(axis=1))))} several "
            "times with rounded or censored readings or a relative error, expected repeated "
            "readings with a normal error; leave rounded=, censored= and relative= out, and pass "
            "an error= that covers them"
        )
    if exact.any():
        raise ValueError(
            f"{name}: specimens: got the label {text(int(np.argmax(exact.any(axis=1))))} several "
            "times without error=, expected it once: exact readings of one specimen would be "
            "equal; pass metric=prb.LogLikelihood(error=...) with their standard deviation"
        )
    return averaged(readings, measurement.scale, numbers, count)


def _groups(
    measurements: Sequence[Measurement], numbers: Sequence[NDArray[np.intp]], size: int
) -> NDArray[np.intp] | None:
    """Return the group of each specimen, None without groups."""
    result = np.full(size, -1, dtype=np.intp)
    for measurement, index in zip(measurements, numbers, strict=True):
        if measurement.groups is None:
            return None
        conflicts = (result[index] >= 0) & (result[index] != measurement.groups)
        result[index] = measurement.groups
        conflicts |= result[index] != measurement.groups
        if conflicts.any():
            label = np.asarray(measurement.specimens).tolist()[int(np.argmax(conflicts))]
            raise ValueError(
                f"{measurement.name}: specimens: got the label {label!r} in two groups, expected "
                "each specimen in one group; write labels that are different"
            )
    return result
