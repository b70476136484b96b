"""A normal population on stored responses, with exact posteriors of what 50 specimens tell."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

import prbayes as prb
from prbayes._validate import Floats

N = 50
OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, N)


def same(x: Any) -> Any:
    return x


def doubled(x: Any) -> Any:
    return 2 * x


@cache
def normal() -> tuple[pm.Model, Any]:
    """Return the model, and the input of its specimens."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1), name="x")
        metric = prb.ProbabilityResidual()
        prb.Simulator("y", same, x, metric=metric, observed=OBSERVED)
    return model, x


@cache
def optimum() -> prb.Optimum:
    return prb.minimize(normal()[0], starts=0, progressbar=False)


def jeffreys(data: Floats, draws: int, seed: int = 0) -> xr.DataTree:
    """Return the exact posterior of mean and standard deviation under Jeffreys' prior."""
    rng = np.random.default_rng(seed)
    n = data.size
    sigma = data.std(ddof=1) * np.sqrt((n - 1) / rng.chisquare(n - 1, (1, draws)))
    mu = data.mean() + sigma / np.sqrt(n) * rng.normal(size=(1, draws))
    group = xr.Dataset({"mu": (("chain", "draw"), mu), "sigma": (("chain", "draw"), sigma)})
    return xr.DataTree.from_dict({"posterior": group.assign_coords(chain=[0], draw=range(draws))})


@cache
def posterior() -> xr.DataTree:
    return jeffreys(OBSERVED, 4000)
