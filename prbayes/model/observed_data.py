"""Observed data of a simulator, read once and aligned specimen by specimen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import pandas as pd
import pymc as pm
import pytensor.tensor as pt
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from pytensor.graph.basic import Variable
from pytensor.graph.traversal import ancestors

from prbayes._finding import Finding, report
from prbayes._validate import (
    Floats,
    Indices,
    NamedArrays,
    Names,
    Shape,
    called,
    real_array,
    sample_labels,
    wrong_value,
)
from prbayes.metrics.base import Metric
from prbayes.metrics.likelihood import LogLikelihood, mapped_metric
from prbayes.model.random_variable import known_value
from prbayes.response.by_specimen import of_specimens, with_columns
from prbayes.response.compile import PLAIN
from prbayes.response.condition import ReadingsCondition, is_condition, known_covariates
from prbayes.response.inputs import Groups, group_indices, labels_and_values
from prbayes.response.outputs import (
    Outputs,
    in_order_of,
    label_texts,
    read_observed,
    refuse_other_order,
    specimen_index,
)


@dataclass(frozen=True, eq=False)
class ObservedData:
    """Observed responses of N specimens, with what is known of each specimen."""

    name: str  # name of the simulator, for messages
    original: Any  # observed values as the user has them: numbers or `pymc.Data`
    values: Floats  # (N,) or (N, m): measured responses
    outputs: Outputs
    groups: Indices | None  # (N,): index of the group; None without groups
    weights: Any  # (N,): relative weights; None for equal ones
    labels: NDArray[Any] | None  # (N,): labels of the specimens; None without labels
    # (N,): observed row of each specimen if the weights are frequencies, else None
    rows: Indices | None
    n_rows: int  # number of observed rows
    dims: Names | None  # names of the observed dimensions
    # (N,): labels in the index or the coordinate of the specimens; None if these only count them
    index: list[str] | None = None

    def __len__(self) -> int:
        return _length(self.values)

    def known_values(self, variables: Sequence[Any]) -> NamedArrays:
        """Return the values of conditions or covariates by name, (N,)."""
        return known_covariates(self.name, variables, self.n_rows, self.rows)

    def for_pymc(self, values: Floats) -> Any:
        """Return the data of an observed variable: `pymc.Data` as it is, else the values.

        Values with NaN are a constant, in which PyMC does not look for missing values to impute.
        """
        if isinstance(self.original, Variable):
            return self.original
        return pt.constant(values) if np.isnan(values).any() else values


def read_data(
    name: str,
    observed: Any,
    groups: Groups | None,
    weights: Any,
    specimens: ArrayLike | None,
    dims: object,
    model: pm.Model,
) -> ObservedData:
    """Return the observed data of a simulator; raise if arguments do not fit each other.

    Weights and labels with an index are sorted as the observed values are. Integer weights are
    frequencies: each observed row is repeated as many times.
    """
    weights = in_order_of(weights, observed, f"{name}: weights")
    places, measured = None, observed
    if groups is not None:
        places, measured = group_indices(name, observed, groups)
    if isinstance(measured, Variable):
        measured = _present_numbers(name, measured)
    values, outputs = read_observed(name, measured)
    n_rows, rows = _length(values), None
    if weights is not None and np.asarray(weights).dtype.kind in "iu":
        rows = _rows_of_frequencies(name, weights, np.shape(values)[:1], observed, specimens)
        values, weights = values[rows], None
        places = None if places is None else places[rows]
    elif weights is not None:
        _report_whole_weights(name, np.asarray(weights))
    labels = None
    if specimens is not None:
        label = f"{name}: specimens"
        labels = sample_labels(in_order_of(specimens, observed, label), _length(values), label)
    if dims is not None:
        dims = _checked_dims(name, dims, np.shape(values), model)
    index = None
    if rows is None:
        of_data = model.named_vars_to_dims.get(getattr(observed, "name", None), (None,))
        coordinate = model.coords.get((dims or of_data)[0])
        index = specimen_index(observed) if coordinate is None else pd.Index(list(coordinate))
        index = label_texts(index, "" if groups is None else groups.dim)
    return ObservedData(
        name, observed, values, outputs, places, weights, labels, rows, n_rows, dims, index
    )


def _length(values: Floats) -> int:
    """Return the number of specimens; a scalar is one specimen."""
    return len(values) if np.ndim(values) else 1


def _present_numbers(name: str, observed: Any) -> Any:
    """Return the current values of `pymc.Data`."""
    values = None if hasattr(observed.type, "dims") else known_value(observed)
    if values is None:
        raise TypeError(
            f"{name}: observed: got {observed} of type {observed.type}, expected numbers or pm.Data"
        )
    return values


def _rows_of_frequencies(
    name: str, weights: Any, shape: Shape, observed: Any, specimens: Any
) -> Indices:
    """Return the observed row of each specimen if the weights are frequencies."""
    frequencies = np.asarray(weights)
    if not shape or frequencies.shape != shape or (frequencies < 0).any() or frequencies.sum() < 2:
        raise ValueError(
            f"{name}: weights: got {frequencies.tolist()!s:.60}, expected {shape} frequencies, "
            "whole numbers from 0 whose sum is at least 2, one for each observed value"
        )
    if specimens is not None or isinstance(observed, Variable):
        conflicting = "pm.Data" if specimens is None else "specimens="
        raise TypeError(
            f"{name}: weights: got whole numbers, which are frequencies, beside {conflicting}, "
            "expected a row for each specimen; pass np.repeat(observed, weights), or relative "
            "weights as floats"
        )
    return np.repeat(np.arange(frequencies.size), frequencies)


def _report_whole_weights(name: str, weights: Any) -> None:
    """Report relative weights that look like frequencies."""
    is_whole = weights.dtype.kind == "f" and (weights == np.round(weights)).all()
    if not is_whole or weights.max(initial=0) < 2:
        return
    text = (
        f"{name}: weights: got whole numbers of type float, which are relative weights of "
        f"{len(weights)} specimens; pass integers if they are frequencies (counts of a histogram), "
        "or weights / weights.sum() if not."
    )
    report(Finding("whole-weights", text))


def _checked_dims(name: str, dims: object, shape: Shape, model: pm.Model) -> Names:
    """Return names of the observed dimensions; raise if their lengths in the model differ."""
    names = [dims] if isinstance(dims, str) else dims
    if not isinstance(names, list | tuple) or {type(dim) for dim in names} != {str}:
        raise wrong_value(dims, f"{name}: dims", "the name of one dimension")
    if len(names) != len(shape):
        raise ValueError(
            f"{name}: dims: got {names}, expected {len(shape)} names, one for each dimension of "
            f"observed, {shape}"
        )
    lengths = model.dim_lengths
    for dim, size in zip(names, shape, strict=True):
        if dim not in lengths:
            raise ValueError(
                f"{name}: dims: got {dim!r}, expected one of the model's dimensions, "
                f"{list(lengths)}; add it with pm.Model(coords={{{dim!r}: ...}})"
            )
        length = int(lengths[dim].eval(mode=PLAIN))
        if length != size:
            raise ValueError(
                f"{name}: dims: got {dim!r} of length {length}, expected {size}, as many as there "
                "are observed values"
            )
    return tuple(names)


def _labelled_rows(name: str, observed: Any, groups: Groups | None) -> Any:
    """Return a table of pandas as an array with the label and the group of each row."""
    if not hasattr(observed, "iloc"):
        return observed
    first, coords = f"{name}_specimen", {}
    index = observed.index
    if groups is not None:
        labels, observed = labels_and_values(f"{name}: observed", observed, groups.dim)
        coords[groups.dim] = (first, labels)
        if groups.dim in index.names:
            index = index.droplevel(groups.dim) if index.nlevels > 1 else None
    if index is not None:
        texts = label_texts(index) if index.nlevels > 1 else None
        coords[first] = (first, index.to_numpy() if texts is None else texts)
    dims = (first, f"{name}_column")[: observed.ndim]
    return xr.DataArray(observed.to_numpy(), dims=dims, coords=coords)


def observed_at_conditions(
    name: str,
    observed: Any,
    metric: Metric | None,
    inputs: Sequence[Any],
    groups: Groups | None = None,
) -> tuple[Any, Metric | None]:
    """Return observed values and metric with a column for each value of a vector condition.

    Refuses conditions of specimens with a metric of distributions.
    """
    vectors = [x for x in inputs if isinstance(x, ReadingsCondition)]
    conditions = [*vectors, *(x for x in inputs if isinstance(x, Variable) and is_condition(x))]
    if conditions:
        _refuse_distributions(
            name,
            metric,
            f"the condition {conditions[0].name} of each specimen",
            "under the same conditions; leave metric= out, or write a simulator for each condition",
        )
    _refuse_other_order(name, observed, metric, inputs)
    if not vectors:
        return observed, metric
    if groups is not None:  # the array at the conditions has no index of pandas
        observed = _labelled_rows(name, observed, groups)
    condition = vectors[0]
    shape = condition.columns.shape
    if any(x is not condition for x in vectors):
        raise ValueError(
            f"{name}: got the conditions {[str(x.name) for x in vectors]}, each with several "
            "values of a specimen, expected one of them; compute the others in the response"
        )
    if isinstance(observed, Variable | Mapping) or np.shape(observed) != shape:
        raise ValueError(
            f"{name}: observed: got {called(observed)} of shape {np.shape(observed)}, expected an "
            f"array of shape {shape}, that of the condition {condition.name}"
        )
    readings = real_array(observed, f"{name}: observed")
    outside = ~np.isnan(readings) & (condition.columns < 0)
    if outside.any():
        row, column = np.argwhere(outside)[0].tolist()
        raise ValueError(
            f"{name}: observed: got {readings[row, column]:g} in row {row}, column {column}, where "
            f"the condition {condition.name} is NaN, expected NaN in both, or a number in both"
        )
    dim = str(condition.name)
    first = observed.dims[0] if hasattr(observed, "dims") else f"{name}_specimen"
    coords = {k: v for k, v in getattr(observed, "coords", {}).items() if v.dims == (first,)}
    coords[dim] = condition.data
    scattered = xr.DataArray(_at_columns(readings, condition), dims=(first, dim), coords=coords)

    def at_columns(value: Any) -> Any:
        if isinstance(value, Variable) or np.shape(value) != shape:
            return value
        return _at_columns(value, condition, float(np.median(value)))

    if isinstance(metric, Metric):
        metric = mapped_metric(cast(LogLikelihood, metric), at_columns)
    return scattered, metric


def observed_by_specimen(
    name: str,
    observed: Any,
    metric: Metric | None,
    response: Any,
    inputs: Sequence[Any],
    groups: Groups | None = None,
) -> tuple[Any, Metric | None, Any]:
    """Return observed values, metric and response with an output for each reading of a function.

    They are returned as they are if the response is not one by specimen.
    """
    functions = of_specimens(response)
    if functions is None:
        return observed, metric, response
    places = np.array(functions.places)
    observed = _labelled_rows(name, observed, groups)
    shape = np.shape(observed)
    _refuse_distributions(
        name,
        metric,
        "functions of each specimen's own",
        "with the same function; leave metric= out",
    )
    _refuse_times_beside_functions(name, inputs)
    if isinstance(observed, Variable | Mapping) or len(shape) not in (1, 2):
        raise TypeError(
            f"{name}: observed: got {called(observed)} with functions of each specimen's own, "
            f"expected an array of shape ({places.size},) or ({places.size}, T), padded with NaN"
        )
    if shape[0] != places.size:
        raise ValueError(
            f"{name}: observed: got {shape[0]} rows, and functions or records of {places.size} "
            "specimens, expected one for each row"
        )
    numbers = real_array(observed, f"{name}: observed")
    readings = numbers.astype(float).reshape(places.size, -1)
    is_read = np.isfinite(readings)
    used = []
    for k in range(len(functions.functions)):
        is_used = is_read[places == k].any(axis=0)
        used.append(np.flatnonzero(is_used))
    if any(columns.size == 0 for columns in used):
        is_empty = ~is_read.any(axis=1)
        row = int(is_empty.argmax())
        raise ValueError(
            f"{name}: observed: got no reading in row {row}, expected one at least; leave the "
            "specimen out, here and among the functions or records"
        )
    sizes = [columns.size for columns in used]
    ends = np.cumsum([0, *sizes])
    first, labels = _labels_by_specimen(name, observed, places, used)

    def at_outputs(value: Any, missing: float | None = None) -> Any:
        """Return values of the shape of the readings at the outputs of functions, (N, M)."""
        if isinstance(value, Variable) or np.shape(value) != shape:
            return value
        values = np.asarray(value, dtype=float).reshape(readings.shape)
        filling = float(np.median(values)) if missing is None else missing
        result = np.full((len(values), ends[-1]), filling)
        for row, k in enumerate(places):
            result[row, ends[k] : ends[k + 1]] = values[row, used[k]]
        return result

    scattered_readings = at_outputs(readings.reshape(shape), np.nan)
    dims = (first, f"{name}_reading")
    scattered = xr.DataArray(scattered_readings, dims=dims, coords=labels)
    if isinstance(metric, Metric):
        metric = mapped_metric(cast(LogLikelihood, metric), at_outputs)
    count = shape[1] if len(shape) == 2 else None
    changed = with_columns(response, used, count)
    return scattered, metric, changed


def _refuse_times_beside_functions(name: str, inputs: Sequence[Any]) -> None:
    """Raise if an input is a condition with several values of each specimen."""
    vector = next((x for x in inputs if isinstance(x, ReadingsCondition)), None)
    if vector is not None:
        raise TypeError(
            f"{name}: inputs: got the condition {vector.name} with several values of a specimen "
            "beside functions of each specimen's own, expected one of both; put the values into "
            "the records"
        )


def _labels_by_specimen(
    name: str, observed: Any, places: Indices, used: Sequence[Indices]
) -> tuple[str, dict[str, Any]]:
    """Return the dimension of the specimens, and coordinates of specimens and readings."""
    index = specimen_index(observed)
    first = observed.dims[0] if hasattr(observed, "dims") else f"{name}_specimen"
    coords = {k: v for k, v in getattr(observed, "coords", {}).items() if v.dims == (first,)}
    if index is not None and first not in coords:
        coords[first] = index
    rows = range(len(places)) if index is None else index
    texts = list(map(str, rows))
    labels = []
    for k, columns in enumerate(used):
        text = texts[int(np.argmax(places == k))]
        labels += [text] if np.ndim(observed) == 1 else [f"{text}[{j}]" for j in columns]
    return first, {**coords, f"{name}_reading": labels}


def _refuse_distributions(name: str, metric: Any, differing: str, remedy: str) -> None:
    """Raise if a metric would compare the distributions of specimens that differ."""
    if isinstance(metric, Metric) and not metric.by_specimen:
        raise TypeError(
            f"{name}: metric: got {called(metric)} with {differing}, expected prb.LogLikelihood(): "
            f"a metric of distributions compares specimens {remedy}"
        )


def _refuse_other_order(
    name: str, observed: Any, metric: Metric | None, inputs: Sequence[Any]
) -> None:
    """Raise if labelled conditions, errors or limits are in another order than observed values."""
    for values in getattr(metric, "_labelled", ()):
        refuse_other_order(values, observed, f"{name}: LogLikelihood")
    for variable in ancestors([x for x in inputs if isinstance(x, Variable)]):
        values = getattr(variable.tag, "labelled", None)
        if values is not None:
            refuse_other_order(values, observed, f"{name}: {variable.name}")


def _at_columns(array: Any, condition: ReadingsCondition, missing: float = np.nan) -> Floats:
    """Return an array of readings, (N, T), at the columns of their values, (N, G)."""
    columns = condition.columns
    result = np.full((len(columns), len(condition.data)), missing)
    rows, places = np.nonzero(columns >= 0)
    result[rows, columns[rows, places]] = np.asarray(array)[rows, places]
    return result
