"""Measured specimens: readings of one simulator, readings of all, and the record of a likelihood.

A specimen has one row: the outputs of all simulators side by side, NaN where one was not measured.
"""

from __future__ import annotations

import weakref
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pytensor.tensor.variable import TensorVariable

from prbayes._stats import positive_scale
from prbayes._validate import ArraysByName, Floats, Indices, NamedValues, Shape, flat_rows
from prbayes.emulators.runs import Runs
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.readings import Readings, Repeats, averaged, side_by_side
from prbayes.model.parameters import Hyperparameters, parent_values
from prbayes.model.simulator_with_data import new_observed, number_specimens
from prbayes.propagation.base import Propagation
from prbayes.propagation.population_density import PopulationDensity
from prbayes.response.by_specimen import of_specimens
from prbayes.response.distributions import PriorSampler
from prbayes.response.inputs import Inputs
from prbayes.response.outputs import Outputs
from prbayes.response.response import Responses
from prbayes.specimens.coordinates import Coordinates
from prbayes.specimens.emulation import Emulation
from prbayes.specimens.points import SpecimenOptions
from prbayes.specimens.selection import Selection

# Roles of unknown parameters of the readings' distribution: factors of the standard deviation, or
# parameter of a count, and of the share of the output; and a number that is added to the output.
ROLES = ("error", "relative", "bias")


@dataclass(frozen=True, eq=False)
class Measurement:
    """The arguments of one simulator with a log-likelihood by specimen."""

    name: str
    metric: LogLikelihood
    observed: Floats  # (N,) or (N, m): measured responses
    weights: Floats | None  # (N,): factors of the specimens' log-likelihoods, of sum N
    specimens: NDArray[Any] | None  # (N,): labels of the specimens
    inputs: Inputs
    responses: Responses
    propagation: Propagation
    outputs: Outputs
    groups: Indices | None = None  # (N,): index of each specimen's group
    # Conditions on which the population of a specimen depends, as values (N,) by name.
    covariates: ArraysByName = field(default_factory=dict)
    conditions: Floats | None = None  # (N, C): values of conditions that are inputs
    # Whether outputs are readings at values of a vector condition, or of functions by specimen.
    at_conditions: bool = False
    # Model variables of the measurement: `ROLES` of the readings, and ``gross_errors``.
    extras: Mapping[str, TensorVariable] = field(default_factory=dict)
    # (N,): observed row of each specimen if the weights are frequencies
    observed_rows: Indices | None = None

    @property
    def event(self) -> Shape:
        """Shape of the outputs of a row, () or (m,)."""
        return self.observed.shape[1:]

    @property
    def rows(self) -> Floats:
        """Observed values, (N, m)."""
        return flat_rows(self.observed)

    @property
    def gross_errors(self) -> Any:
        """Share of specimens with a gross error: a number, a variable of the model, or False."""
        return self.extras.get("gross_errors", self.metric.gross_errors)

    @property
    def unknown(self) -> dict[str, TensorVariable]:
        """Unknown parameters of the readings' distribution, by role."""
        return {role: self.extras[role] for role in ROLES if role in self.extras}

    @cached_property
    def readings(self) -> Readings:
        """Observed values and their errors; unknown parameters have their prior's 84 % quantile."""
        return readings_at(self, 0.84, 512)


def observing(measurement: Measurement, data: Any) -> Measurement:
    """Return the measurement with other observed values; the same object for equal ones."""
    values = np.asarray(data, dtype=np.float64)
    if np.array_equal(values, measurement.observed, equal_nan=True):
        return measurement
    m = measurement
    of_rows = (m.groups, m.weights, m.specimens, m.conditions)
    is_aligned = bool(m.covariates) or any(x is not None for x in of_rows)
    is_aligned = is_aligned or of_specimens(m.responses.function) is not None
    aligned = "groups, conditions, records, functions, weights= or specimens="
    observed = new_observed(m, values, aligned, is_aligned=is_aligned)
    return replace(m, observed=observed, observed_rows=None)


def readings_at(measurement: Measurement, prob: float, draws: int) -> Readings:
    """Return readings with a scatter that has this quantile in the prior of its parameters.

    An unknown bias has its prior's median, from which it scatters.
    """
    variables = measurement.unknown
    prior = PriorSampler(list(variables.values()))(draws, seed=0) if variables else []
    samples = dict(zip(variables, prior, strict=True))
    for role, sample in samples.items():
        _refuse_by_reading(role, sample.shape[1:], measurement.event)
    bias = samples.pop("bias", np.zeros(1))
    middle = np.median(bias, axis=0)
    scatter = np.quantile(np.abs(bias - middle), prob, axis=0)
    count = measurement.metric.count
    prob = prob if count is None or count.widens else 1 - prob
    unknown = {role: np.quantile(x, prob, axis=0) for role, x in samples.items()}
    unknown |= {"bias": middle} if "bias" in variables else {}
    readings = measurement.metric.readings(measurement.rows, unknown, measurement.event)
    return replace(readings, error=np.hypot(readings.error, scatter))


def _refuse_by_reading(role: str, shape: Shape, event: Shape) -> None:
    """Raise if an unknown parameter of the readings has a shape other than (), (1,) and (m,)."""
    if shape in ((), (1,), event):
        return
    of_outputs = f", or of shape {event}, one for each output" if event else ""
    raise ValueError(
        f"LogLikelihood: {'bias' if role == 'bias' else 'error'}: got a variable of shape {shape}, "
        f"expected a scalar one{of_outputs}; pass numbers for single readings"
    )


def unit_readings(measurement: Measurement) -> Readings:
    """Return readings with errors in units of the unknown ones, and without an unknown bias."""
    return measurement.metric.readings(measurement.rows, None, measurement.event)


def selection_of(measurements: Sequence[Measurement]) -> Selection | None:
    """Return the limits within which specimens were measured; None without limits."""
    if all(m.metric.selected is None for m in measurements):
        return None
    parts = []
    for m in measurements:
        ends = m.metric.selected or (None, None)
        defaults = zip(ends, (-np.inf, np.inf), strict=True)
        low, high = (default if end is None else end for end, default in defaults)
        readings, shape = unit_readings(m), m.rows.shape
        try:
            limits = [np.broadcast_to(np.asarray(x, float), shape[1:]) for x in (low, high)]
            # None for one of the outputs has become NaN.
            limits = [
                np.where(np.isnan(x), default, x)
                for x, default in zip(limits, (-np.inf, np.inf), strict=True)
            ]
        except ValueError:
            raise ValueError(
                f"{m.name}: metric: selected: got limits of shape {np.shape(low)} and "
                f"{np.shape(high)}, expected numbers, or shape {shape[1:]}, one for each output"
            ) from None
        with np.errstate(invalid="ignore"):
            is_outside = (m.rows < limits[0]) | (m.rows > limits[1])
        if is_outside.any():
            row, column = np.argwhere(is_outside)[0].tolist()
            raise ValueError(
                f"{m.name}: metric: selected: got the reading {m.rows[row, column]:g} of specimen "
                f"{row}, expected readings within the limits: others are never seen; widen the "
                "limits, or leave selected= out"
            )
        if any(np.ptp(x, axis=0).any() for x in (readings.error, readings.relative, readings.bias)):
            raise ValueError(
                f"{m.name}: metric: error: got errors that differ between specimens beside "
                "selected=, expected the same for all: those that were never seen need one too"
            )
        parts.append([*limits, readings.error[0], readings.relative[0], readings.bias[0]])
    return Selection(*(np.concatenate(x) for x in zip(*parts, strict=True)))


def observed_range(measurement: Measurement) -> Floats:
    """Return the smallest and largest observed value of each output, (2, m)."""
    return np.stack([np.nanmin(measurement.rows, axis=0), np.nanmax(measurement.rows, axis=0)])


@dataclass(frozen=True, eq=False)
class StackedReadings:
    """Readings of S specimens in the M outputs of all simulators."""

    # Readings of each specimen; a weighted mean replaces repeated readings of an output.
    readings: Readings
    # (S, M): standard deviation of the reading error, relative to the unknown error if there is
    # one.
    scale: Floats
    relative: Floats  # (S, M): likewise, of the relative error
    parameter: Floats  # (S, M): likewise, of the parameter of counts
    bias: Floats  # (S, M): the bias that `readings` lack, where it is unknown
    repeats: Repeats | None  # scatter of repeated readings; None if there are none
    # For each simulator, (N,): index of the specimen of each row.
    numbers: tuple[Indices, ...]
    groups: Indices | None  # (S,): index of each specimen's group
    covariates: Floats  # (C, S): values of the conditions that populations depend on
    # (S,): log-density of a gross error, which is uniform over twice the range of each output.
    log_gross: Floats
    conditions: Floats | None  # (S, C): values of the conditions that are inputs
    coordinates: Floats | None  # (S, C): coordinates of these conditions

    @classmethod
    def of(cls, measurements: Sequence[Measurement]) -> StackedReadings:
        """Stack the readings of simulators; raise if those of a specimen cannot be combined."""
        first = measurements[0]
        numbers, size = number_specimens(measurements)
        parts = [_averaged(m, index, size) for m, index in zip(measurements, numbers, strict=True)]
        conditions = coordinates = None
        variables = [first.inputs.aleatory[place] for place in first.inputs.conditions]
        if variables:
            conditions = np.empty((size, len(variables)))
            coordinates = np.empty(conditions.shape)
            for k, variable in enumerate(variables):
                of_rows = [np.asarray(m.conditions)[:, k] for m in measurements]
                kind = f"values of {variable.name}"
                conditions[:, k] = _value_by_specimen(kind, measurements, of_rows, numbers, size)
                coordinates[:, k] = variable.owner.op.coordinates(conditions[:, k])
        readings, scales, repeats = zip(*parts, strict=True)
        stacked = side_by_side(readings)
        unknown = [
            np.tile([role in m.extras for role in ROLES], (m.rows.shape[1], 1)).T
            for m in measurements
        ]
        is_error, is_relative, is_bias = np.concatenate(unknown, axis=1)
        groups = None
        if first.groups is not None:
            of_rows = [np.asarray(m.groups) for m in measurements]
            groups = _value_by_specimen("groups", measurements, of_rows, numbers, size).astype(
                np.intp
            )
        covariates = np.empty((len(first.covariates), size))
        for covariate, name in zip(covariates, first.covariates, strict=True):
            of_rows = [m.covariates[name] for m in measurements]
            covariate[:] = _value_by_specimen(
                f"values of {name}", measurements, of_rows, numbers, size
            )
        log_gross = np.zeros(size)
        for measurement, index in zip(measurements, numbers, strict=True):
            width = 2 * np.ptp(observed_range(measurement), axis=0)
            logs = np.log(positive_scale(width))
            logs = np.where(np.isnan(measurement.rows), 0.0, logs).sum(axis=1)
            np.subtract.at(log_gross, index, logs)
        return cls(
            stacked,
            np.concatenate(scales, axis=1),
            np.where(is_relative, 1.0, stacked.relative),
            np.where(is_error, 1.0, stacked.parameter),
            np.where(is_bias, stacked.bias, 0.0),
            side_by_side(repeats) if any(part.count.any() for part in repeats) else None,
            tuple(numbers),
            groups,
            covariates,
            log_gross,
            conditions,
            coordinates,
        )


def _averaged(
    measurement: Measurement, numbers: Indices, size: int
) -> tuple[Readings, Floats, Repeats]:
    """Return the averaged readings of one simulator by specimen, their scale and their repeats."""
    readings = measurement.readings
    present = readings.is_measured | readings.is_censored
    count = np.zeros((size, present.shape[1]), dtype=np.intp)
    np.add.at(count, numbers, present)
    is_repeated = present & (count > 1)[numbers]
    is_normal = (readings.step == 0) & ~readings.is_censored & (readings.family < 0)
    is_normal &= readings.relative == 0
    of_kind = (
        "with rounded or censored readings, counts or a relative error, expected repeated readings "
        "with a normal error; pass one count for each specimen, with its whole exposure, or leave "
        "rounded=, censored= and relative= out, and pass an error= that covers them"
    )
    of_error = (
        "without error=, expected it once: exact readings of one specimen would be equal; pass "
        "metric=prb.LogLikelihood(error=...) with their standard deviation"
    )
    scale = unit_readings(measurement).error
    for is_bad, problem in ((~is_normal, of_kind), (scale == 0, of_error)):
        where = is_repeated & is_bad
        if where.any():
            row = int(np.argmax(where.any(axis=1)))
            labels = measurement.specimens
            label = int(numbers[row]) if labels is None else labels.tolist()[row]
            raise ValueError(
                f"{measurement.name}: specimens: got the label {label!r} several times {problem}"
            )
    return averaged(readings, scale, numbers, count)


def _value_by_specimen(
    kind: str,
    measurements: Sequence[Measurement],
    values: Sequence[NDArray[Any]],
    numbers: Sequence[Indices],
    size: int,
) -> Floats:
    """Return a value for each specimen, (S,), from values for the rows of each simulator, (N,)."""
    result = np.full(size, np.nan)
    for measurement, of_rows, index in zip(measurements, values, numbers, strict=True):
        conflicts = ~np.isnan(result[index]) & (result[index] != of_rows)
        result[index] = of_rows
        conflicts |= result[index] != of_rows
        if conflicts.any():
            label = np.asarray(measurement.specimens).tolist()[int(np.argmax(conflicts))]
            raise ValueError(
                f"{measurement.name}: specimens: got the label {label!r} with two {kind}, expected "
                "one for each specimen; write labels that are different"
            )
    return result


@dataclass(frozen=True, eq=False)
class SpecimenLikelihood:
    """Data and settings of a log-likelihood of specimens, measured by one simulator or several."""

    measurements: tuple[Measurement, ...]  # measurements with the same inputs
    model: Any = None  # weak reference to a pymc.Model
    shared_emulation: Emulation | None = None  # emulator that was fitted for other data
    options: SpecimenOptions = field(default_factory=SpecimenOptions)
    # Cache of values that are computed at their first use, such as the points of the specimens.
    cache: dict[str, Any] = field(default_factory=dict, init=False, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        """Replace the weak reference by the model, because weak references have no pickle."""
        derived = ("hyperparameters", "reading density", "updated", "products", "populations")
        cache = {key: value for key, value in self.cache.items() if key not in derived}
        model = None if self.model is None else self.model()
        return {**vars(self), "model": model, "cache": cache}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the weak reference."""
        model = state["model"]
        vars(self).update({**state, "model": None if model is None else weakref.ref(model)})

    @property
    def name(self) -> str:
        """Names of the simulators."""
        return " and ".join(m.name for m in self.measurements)

    @property
    def inputs(self) -> Inputs:
        """The inputs of the responses."""
        return self.measurements[0].inputs

    @cached_property
    def stacked(self) -> StackedReadings:
        """The readings of all simulators, by specimen."""
        return StackedReadings.of(self.measurements)

    @property
    def readings(self) -> Readings:
        """The readings of S specimens in M outputs."""
        return self.stacked.readings

    def variables(self, names: Collection[str] | None = None) -> tuple[TensorVariable, ...]:
        """Return the model variables of the log-density: roots of the inputs, then extras.

        Extras are those of the simulators with these names, by default of all.
        """
        measurements = [m for m in self.measurements if names is None or m.name in names]
        extras = [v for m in measurements for v in m.extras.values()]
        return tuple(dict.fromkeys([*self.inputs.parents, *extras]))

    @property
    def error_is_known(self) -> bool:
        """Whether no parameter of the readings' distribution is a variable of the model."""
        return not any(m.unknown for m in self.measurements)

    @property
    def calls_response(self) -> bool:
        """Whether the response itself takes the place of an emulator."""
        return self.has_table or self.measurements[0].propagation.calls_response

    @property
    def has_table(self) -> bool:
        """Whether the response is a table of runs."""
        return isinstance(self.measurements[0].responses.function, Runs)

    @cached_property
    def density(self) -> PopulationDensity:
        """The density of the inputs in a population."""
        return PopulationDensity(self.inputs)

    @cached_property
    def coordinates(self) -> Coordinates:
        """Coordinates of the inputs."""
        return Coordinates.of_prior(self.inputs, len(self.readings), sampler=self.density.sampler)

    @property
    def by_group(self) -> list[tuple[int | None, Indices]]:
        """The index of each group, None without groups, and its specimens."""
        return rows_by_group(self.stacked.groups, len(self.readings))

    def parents(self, values: ArraysByName, group: int | None, specimens: Indices) -> list[Floats]:
        """Return the parents of the inputs of specimens in a group, (P, *shape).

        Values are those of the model's variables by name, (P, *shape). The covariates of specimens,
        (n,) or (P, n), have shape (P, n).
        """
        covariates = list(self.stacked.covariates[:, specimens])
        return parent_values(values, self.inputs, group, covariates)

    @property
    def hyperparameters(self) -> Hyperparameters:
        """The hyperparameters of the model, those of its evaluator where one was made."""
        evaluated: Hyperparameters | None = self.cache.get("hyperparameters", lambda: None)()
        if evaluated is not None:
            return evaluated
        model = self.model()
        if model is None:
            raise RuntimeError(
                "got a simulator whose model was deleted, expected one with its "
                "model; build the model again"
            )
        return Hyperparameters.of(model)

    def of_rows(self, rows: Indices) -> SpecimenLikelihood:
        """Return the likelihood of some rows of a single simulator."""
        (measurement,) = self.measurements
        part = replace(measurement, observed=measurement.observed[rows], observed_rows=None)
        result = replace(self, measurements=(part,))
        # Compiled functions and coordinates depend on the populations only, and are reused.
        vars(result).update(density=self.density, coordinates=self.coordinates)
        return result

    def observing(self, data: NamedValues, model: Any = None) -> SpecimenLikelihood:
        """Return the likelihood of other observed values by simulator, with the same runs.

        ``model`` is a copy of the model. The likelihood is the same object if the values are the
        same, unless `pymc.do` or `pymc.observe` left other free variables in the copy, for whose
        posterior points are drawn.
        """
        changed = tuple(
            m if data.get(m.name) is None else observing(m, data[m.name]) for m in self.measurements
        )
        models = [m for m in (self.model(), model) if m is not None] if model is not None else []
        names = [{str(rv.name) for rv in m.free_RVs} for m in models]
        is_same_model = model is None or names[1:] == names[:1]
        is_same_data = all(a is b for a, b in zip(changed, self.measurements, strict=True))
        if is_same_model and is_same_data:
            return self
        prepared = self.cache.get("preparation")
        emulation = prepared.emulation if prepared else self.shared_emulation
        return replace(
            self,
            measurements=changed,
            model=self.model if is_same_model else weakref.ref(model),
            # The emulator of a fleet is accurate at the specimens of all of its products.
            shared_emulation=self.cache.get("emulation of a fleet", emulation),
        )


def has_random_response(likelihood: SpecimenLikelihood) -> bool:
    """Return whether the response is random, so that its distribution is emulated."""
    return likelihood.measurements[0].responses.repeats > 1


def is_exchangeable(likelihood: SpecimenLikelihood) -> bool:
    """Return whether all specimens have the same population, weight and outputs of a simulator."""
    first, *more = likelihood.measurements
    functions = of_specimens(first.responses.function)
    of_rows = (first.groups, first.weights, first.specimens, first.conditions, functions)
    return not more and not first.covariates and all(x is None for x in of_rows)


def own_columns(likelihood: SpecimenLikelihood) -> Indices | None:
    """Return outputs of each specimen's own functions, (S, c); None where all have the same."""
    functions = [of_specimens(m.responses.function) for m in likelihood.measurements]
    if not any(functions):
        return None
    readings = likelihood.readings
    is_read = readings.is_measured | readings.is_censored
    count = int(is_read.sum(axis=1).max())
    order = np.argsort(~is_read, axis=1, kind="stable")
    return order[:, :count]


def rows_by_context(likelihood: SpecimenLikelihood) -> list[tuple[int | None, Indices]]:
    """Return the group, and the specimens, of each combination of group and covariates."""
    contexts = []
    for group, rows in likelihood.by_group:
        covariates = likelihood.stacked.covariates[:, rows]
        _, number = np.unique(covariates, axis=1, return_inverse=True)
        contexts += [(group, rows[number == k]) for k in range(number.max() + 1)]
    return contexts


def rows_by_group(groups: Indices | None, n: int) -> list[tuple[int | None, Indices]]:
    """Return the index of each group, None without groups, and the rows in it, of n specimens."""
    if groups is None:
        return [(None, np.arange(n))]
    return [(group, np.flatnonzero(groups == group)) for group in np.unique(groups).tolist()]


def specimen_numbers(likelihood: SpecimenLikelihood, measurement: Measurement) -> Indices:
    """Return the specimen of each row of a simulator, (N,)."""
    return likelihood.stacked.numbers[likelihood.measurements.index(measurement)]


def specimen_labels(likelihood: SpecimenLikelihood) -> NDArray[Any] | None:
    """Return labels of the specimens, (S,); None if these are the rows of a single simulator."""
    measurements = likelihood.measurements
    if len(measurements) == 1 and len(likelihood.readings) == len(measurements[0].observed):
        return None
    labels = np.concatenate([np.asarray(m.specimens) for m in measurements])
    _, first = np.unique(np.concatenate(likelihood.stacked.numbers), return_index=True)
    return labels[first]


def output_columns(likelihood: SpecimenLikelihood, measurement: Measurement) -> slice:
    """Return which of all outputs are those of a simulator."""
    widths = [m.rows.shape[1] for m in likelihood.measurements]
    place = likelihood.measurements.index(measurement)
    first = sum(widths[:place])
    return slice(first, first + widths[place])
