"""Values as labelled datasets, with the dimensions and coordinates of the model."""

from __future__ import annotations

import importlib.metadata
from typing import Any

import numpy as np
import xarray as xr

from prbayes.model.evaluator import Evaluator


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    return {
        f"{name}_version": importlib.metadata.version(name) for name in ("prbayes", "pymc", "numpy")
    }


def labelled(evaluator: Evaluator, values: dict[str, Any], leading: dict[str, int]) -> xr.Dataset:
    """Label values, shapes (*leading, *shape), with the model's own dimensions and coordinates."""
    dims = evaluator.model.named_vars_to_dims
    coords: dict[str, Any] = {name: np.arange(size) for name, size in leading.items()}
    variables = {}
    for name, value in values.items():
        rest = np.ndim(value) - len(leading)
        own = [d or f"{name}_dim_{i}" for i, d in enumerate(dims.get(name) or [None] * rest)]
        for d in own:
            if evaluator.model.coords.get(d) is not None:
                coords[d] = np.asarray(evaluator.model.coords[d])
        variables[name] = ([*leading, *own], np.asarray(value))
    return xr.Dataset(variables, coords=coords)


def observed_dataset(evaluator: Evaluator) -> xr.Dataset:
    """Return the observed responses of all simulators, labelled."""
    return labelled(evaluator, {n.name: n.target.observed for n in evaluator.nodes}, {})
