"""A model of one normal input, and draws of a posterior by name."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

import prbayes as prb


def one_input(
    observed: Any,
    metric: Any = None,
    propagation: Any = None,
    response: Any = np.positive,
    *,
    mu: tuple[float, float] = (0.0, 2.0),
    sigma: float = 1.0,
    sd: float | None = None,
    **keywords: Any,
) -> pm.Model:
    """Return a model of normal inputs with mu ~ Normal(*mu), sigma ~ HalfNormal(sigma) or a known sd."""
    settings = {"observed": observed, "metric": metric, "propagation": propagation} | keywords
    with pm.Model() as model:
        mean = pm.Normal("mu", *mu)
        x = pm.Normal.dist(mean, pm.HalfNormal("sigma", sigma) if sd is None else sd)
        prb.Simulator("y", response, x, **settings)
    return model


def posterior_of(**values: Any) -> xr.DataTree:
    """Return a posterior of draws by name, shape (chain, draw, ...)."""
    arrays = {}
    for name, draws in values.items():
        elements = [f"{name}_dim_{i}" for i in range(np.ndim(draws) - 2)]
        arrays[name] = (["chain", "draw", *elements], np.asarray(draws))
    return xr.DataTree.from_dict({"posterior": xr.Dataset(arrays)})
