"""Values as labelled datasets, with the dimensions and coordinates of the model."""

from __future__ import annotations

import importlib.metadata
from typing import Any

import numpy as np
import xarray as xr

from prbayes.model.evaluator import Evaluator


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    found = {}
    for name in ("prbayes", "pymc", "numpy"):
        found[f"{name}_version"] = importlib.metadata.version(name)
    return found


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

    Dims (failure) and (failure, column): the arguments of the response one after the other, NaN
    where another simulator has more of them.
    """
    each = []
    for node in evaluator.nodes:
        each += [(node.name, failure) for failure in node.bound.responses.failed]
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
        }
    )


def observed_dataset(evaluator: Evaluator) -> xr.Dataset:
    """Return the observed responses of all simulators, labelled."""
    observed = {node.name: node.target.observed for node in evaluator.nodes}
    return labelled(evaluator, observed, {})
