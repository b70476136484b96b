"""A normal population of known size, its best fit, and optima as pairs of numbers."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from prbayes._validate import Floats

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 50)


def normal_model(
    propagation: Any, response: Callable[..., Any] = lambda x: x, unit: float = 1.0
) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2 * unit), pm.HalfNormal("sigma", unit))
        metric = prb.ProbabilityResidual()
        prb.Simulator(
            "y", response, x, metric=metric, observed=unit * OBSERVED, propagation=propagation
        )
    return model


@cache
def model() -> pm.Model:
    return normal_model(prb.Resimulated(256))


@cache
def best() -> prb.Optimum:
    return prb.minimize(model(), start={"mu": 0.5, "sigma": 0.8})


def pair(optimum: prb.Optimum) -> Floats:
    return np.array([optimum.point["mu"], optimum.point["sigma"]])
