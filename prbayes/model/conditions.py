"""Conditions of specimens: their values, and observed values of readings under several of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
import xarray as xr
from pytensor.graph.basic import Variable
from pytensor.graph.traversal import ancestors

from prbayes._validate import Floats, called, real_array
from prbayes.metrics.base import Metric
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.response.condition import ReadingsCondition, is_condition
from prbayes.response.inputs import Inputs
from prbayes.response.outputs import refuse_other_order


def stacked_values(values: Mapping[str, Floats]) -> Floats | None:
    """Return the values of conditions, (N,) by name, as an array (N, C); None without one."""
    return np.stack(list(values.values()), axis=1) if values else None


def at_conditions(
    inputs: Inputs, specimens: Sequence[Floats], conditions: Floats | None
) -> list[Floats]:
    """Return inputs (..., n, *event) with the conditions, (N, C), of specimens in turn."""
    result = list(specimens)
    if conditions is not None:
        for place, column in zip(inputs.conditions, conditions.T, strict=True):
            n = result[place].shape[-1]
            result[place] = np.broadcast_to(np.resize(column, n), result[place].shape)
    return result


def observed_at_conditions(
    name: str, observed: Any, metric: Metric | None, inputs: Sequence[Any]
) -> tuple[Any, Metric | None]:
    """Return observed values and metric with a column for each value of a vector condition.

    Refuses conditions of specimens with a metric of distributions.
    """
    vectors = [x for x in inputs if isinstance(x, ReadingsCondition)]
    conditions = [*vectors, *(x for x in inputs if isinstance(x, Variable) and is_condition(x))]
    if conditions and isinstance(metric, Metric) and not metric.by_specimen:
        raise TypeError(
            f"{name}: metric: got {called(metric)} with the condition {conditions[0].name} of each "
            "specimen, expected prb.LogLikelihood(): a metric of distributions compares specimens "
            "under the same conditions; leave metric= out, or write a simulator for each condition"
        )
    _refuse_other_order(name, observed, metric, inputs)
    if not vectors:
        return observed, metric
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
    changed: dict[str, Any] = {}
    for role in ("error", "rounded", "censored"):
        value = getattr(metric, role, None)
        if value is None or isinstance(value, Variable):
            continue
        parts = [
            _at_columns(x, condition, float(np.median(x))) if np.shape(x) == shape else x
            for x in (value if role == "censored" else [value])
        ]
        changed[role] = tuple(parts) if role == "censored" else parts[0]
    return scattered, replace(cast(LogLikelihood, metric), **changed) if changed else metric


def _refuse_other_order(
    name: str, observed: Any, metric: Metric | None, inputs: Sequence[Any]
) -> None:
    """Raise if conditions, errors or limits with labels are in another order than observed."""
    for values in getattr(metric, "_labelled", ()):
        refuse_other_order(values, observed, f"{name}: LogLikelihood")
    for variable in ancestors([x for x in inputs if isinstance(x, Variable)]):
        values = getattr(variable.tag, "labelled", None)
        if values is not None:
            refuse_other_order(values, observed, f"{name}: {variable.name}")


def _at_columns(array: Any, condition: ReadingsCondition, missing: float = np.nan) -> Floats:
    """Return values of readings, (N, T), at the columns of their values, (N, G)."""
    columns = condition.columns
    result = np.full((len(columns), len(condition.data)), missing)
    rows, places = np.nonzero(columns >= 0)
    result[rows, columns[rows, places]] = np.asarray(array)[rows, places]
    return result
