"""Values as labelled datasets, with the dimensions and coordinates of the model."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import cache
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from prbayes.model.evaluator import Evaluator
from prbayes.model.measurement import Measurement
from prbayes.model.random_variable import Node
from prbayes.response.outputs import Outputs


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    found = {}
    for name in ("prbayes", "pymc", "pytensor", "arviz", "numpy", "scipy"):
        found[f"{name}_version"] = _version(name)
    return {**found, "python_version": platform.python_version()}


@cache
def _version(package: str) -> str:
    return importlib.metadata.version(package)


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
    dims = evaluator.model.named_vars_to_dims
    known = evaluator.model.coords
    coords: dict[str, Any] = {}
    for name, size in leading.items():
        coords[name] = np.arange(size)
    variables = {}
    for name, value in values.items():
        array = np.asarray(value)
        unnamed = [None] * (array.ndim - len(leading))
        given = dims.get(name) or unnamed
        own = []
        for i, dim in enumerate(given):
            own.append(dim or f"{name}_dim_{i}")
            if known.get(dim) is not None:
                coords[dim] = np.asarray(known[dim])
        variables[name] = ([*leading, *own], array)
    return xr.Dataset(variables, coords=coords)


def failures_dataset(evaluator: Evaluator) -> xr.Dataset:
    """Return the points whose response failed so far: simulator, inputs and reason of each.

    And what took its place, ``instead``: NaN for none.

    Dims (failure) and (failure, column): the arguments of the response one after the other, NaN
    where another simulator has more of them.
    """
    each = []
    instead = []
    responses = [(node.name, node.bound.responses) for node in evaluator.nodes]
    responses += [(simulator.name, simulator.responses) for simulator in evaluator.measurements]
    for name, response in responses:
        each += [(name, failure) for failure in response.failed]
        instead += [response.replacement] * len(response.failed)
    columns = max((failure.inputs.size for _, failure in each), default=0)
    inputs = np.full((len(each), columns), np.nan)
    for row, (_, failure) in zip(inputs, each, strict=True):
        row[: failure.inputs.size] = failure.inputs
    names = np.array([name for name, _ in each], dtype=object)
    reasons = np.array([failure.reason for _, failure in each], dtype=object)
    return xr.Dataset(
        {
            "simulator": ("failure", names.astype(str)),
            "inputs": (["failure", "column"], inputs),
            "reason": ("failure", reasons.astype(str)),
            "instead": ("failure", np.array(instead, dtype=float)),
        }
    )


def observed_dataset(evaluator: Evaluator) -> xr.Dataset:
    """Return the observed responses of all simulators, labelled; several outputs by their names."""
    observed = {node.name: node.target.observed for node in evaluator.nodes}
    observed |= {m.name: m.observed for m in evaluator.measurements}
    return labelled_responses(evaluator, observed)


def labelled_responses(
    evaluator: Evaluator, values: dict[str, Any], leading: Sequence[int] = ()
) -> xr.Dataset:
    """Return responses of simulators by their names, shapes (*leading, N) or (*leading, N, m).

    Leading dimensions are chains and draws.
    """
    sizes = dict(zip(("chain", "draw"), leading, strict=False))
    data = labelled(evaluator, values, sizes)
    simulators: list[Node | Measurement] = [*evaluator.nodes, *evaluator.measurements]
    for simulator in simulators:
        if simulator.name not in values:
            continue
        if simulator.outputs.event:
            data = _with_outputs(data, simulator.name, simulator.outputs)
        else:
            _tell_units(data, simulator.name, simulator.outputs)
    return data


def _tell_units(data: xr.Dataset, name: str, outputs: Outputs) -> None:
    """Note the units of one simulator's outputs, where they are known."""
    if outputs.units:
        different = list(dict.fromkeys(outputs.units))
        units = different[0] if len(different) == 1 else list(outputs.units)
        data[name].attrs["units"] = units


def _with_outputs(data: xr.Dataset, name: str, outputs: Outputs) -> xr.Dataset:
    """Return observed responses with one simulator's outputs named, unless the model does that."""
    last = str(data[name].dims[-1])
    if last == f"{name}_dim_1":
        labels = _coordinate(outputs)
        dim = outputs.dim
        if not _is_free(data, dim, labels):
            dim = f"{name}_{dim}"  # another simulator has other outputs
        renamed = data[name].rename({last: dim})
        data = data.drop_vars(name).assign({name: renamed}).assign_coords({dim: labels})
    _tell_units(data, name, outputs)
    return data


def _coordinate(outputs: Outputs) -> NDArray[Any]:
    """Return the labels of outputs as an array that a file can hold: numbers, or else texts."""
    labels = np.asarray(outputs.labels)
    return labels if labels.dtype.kind in "iuf" else np.array(outputs.names)


def _is_free(data: xr.Dataset, dim: str, labels: NDArray[Any]) -> bool:
    """Whether a dimension can have these labels."""
    if dim in data.coords:
        return np.array_equal(data.coords[dim].values, labels)
    return dim not in data.dims and dim not in data.data_vars
