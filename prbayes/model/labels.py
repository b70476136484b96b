"""Labelled datasets of a model's variables and responses, and the versions that made them."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import cache
from typing import Any

import numpy as np
import xarray as xr

from prbayes.model.evaluator import Evaluator
from prbayes.model.measurement import Measurement
from prbayes.model.random_variable import Node
from prbayes.response.outputs import Outputs

_version = cache(importlib.metadata.version)


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    packages = ("prbayes", "pymc", "pytensor", "arviz", "numpy", "scipy")
    result = {f"{package}_version": _version(package) for package in packages}
    return {**result, "python_version": platform.python_version()}


def arviz_attributes() -> dict[str, str]:
    """Return the attributes that ArviZ gives a group."""
    version = _version("prbayes")
    return {
        "created_at": datetime.now(UTC).isoformat(),
        "creation_library": "prbayes",
        "creation_library_version": version,
        "creation_library_language": "Python",
        "inference_library": "prbayes",
        "inference_library_version": version,
    }


def labelled(evaluator: Evaluator, values: dict[str, Any], leading: dict[str, int]) -> xr.Dataset:
    """Label values, shapes (*leading, *shape), with the model's own dimensions and coordinates."""
    model = evaluator.model
    coords: dict[str, Any] = {name: np.arange(size) for name, size in leading.items()}
    variables = {}
    for name, value in values.items():
        array = np.asarray(value)
        unnamed = [None] * (array.ndim - len(leading))
        dims = model.named_vars_to_dims.get(name) or unnamed
        for dim in filter(None, dims):
            if model.coords.get(dim) is not None:
                coords[dim] = np.asarray(model.coords[dim])
        names = [dim or f"{name}_dim_{i}" for i, dim in enumerate(dims)]
        variables[name] = ([*leading, *names], array)
    return xr.Dataset(variables, coords=coords)


def _simulators(evaluator: Evaluator) -> list[Node | Measurement]:
    return [*evaluator.nodes, *evaluator.measurements]


def failures_dataset(evaluator: Evaluator) -> xr.Dataset:
    """Return the points whose response failed: simulator, inputs, reason, and replacement.

    Dims (failure) and (failure, column): the arguments of the response one after the other, NaN
    where another simulator has more of them. The replacement, ``instead``, is NaN for none.
    """
    failures = [
        (simulator.name, simulator.responses.replacement, failure)
        for simulator in _simulators(evaluator)
        for failure in simulator.responses.failed
    ]
    columns = max((failure.inputs.size for _, _, failure in failures), default=0)
    inputs = np.full((len(failures), columns), np.nan)
    for row, (_, _, failure) in zip(inputs, failures, strict=True):
        row[: failure.inputs.size] = failure.inputs
    names = np.array([name for name, _, _ in failures], dtype=object)
    reasons = np.array([failure.reason for _, _, failure in failures], dtype=object)
    return xr.Dataset(
        {
            "simulator": ("failure", names.astype(str)),
            "inputs": (["failure", "column"], inputs),
            "reason": ("failure", reasons.astype(str)),
            "instead": ("failure", np.array([value for _, value, _ in failures], dtype=float)),
        }
    )


def observed_dataset(evaluator: Evaluator) -> xr.Dataset:
    """Return the observed responses of all simulators, labelled; several outputs by their names."""
    observed = {simulator.name: simulator.observed for simulator in _simulators(evaluator)}
    return labelled_responses(evaluator, observed)


def labelled_responses(
    evaluator: Evaluator, values: dict[str, Any], leading: Sequence[int] = ()
) -> xr.Dataset:
    """Return responses of simulators by their names, shapes (*leading, N) or (*leading, N, m).

    Leading dimensions are chains and draws.
    """
    sizes = dict(zip(("chain", "draw"), leading, strict=False))
    data = labelled(evaluator, values, sizes)
    for simulator in _simulators(evaluator):
        name, outputs = simulator.name, simulator.outputs
        if name in values:
            if outputs.event:
                data = _with_output_names(data, name, outputs)
            if outputs.units:
                units = list(dict.fromkeys(outputs.units))
                data[name].attrs["units"] = units[0] if len(units) == 1 else list(outputs.units)
    return data


def _with_output_names(data: xr.Dataset, name: str, outputs: Outputs) -> xr.Dataset:
    """Return responses with one simulator's outputs named, unless the model names them."""
    last = str(data[name].dims[-1])
    if last != f"{name}_dim_1":
        return data
    labels = np.asarray(outputs.labels)
    if labels.dtype.kind not in "iuf":  # a file stores numbers and texts
        labels = np.array(outputs.names)
    dim = outputs.dim
    if dim in data.coords:
        is_free = np.array_equal(data.coords[dim].values, labels)
    else:
        is_free = dim not in data.dims and dim not in data.data_vars
    if not is_free:
        dim = f"{name}_{dim}"  # another simulator has other outputs
    renamed = data[name].rename({last: dim})
    return data.drop_vars(name).assign({name: renamed}).assign_coords({dim: labels})
