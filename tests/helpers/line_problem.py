"""A response that is a line, of a normal input."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
from scipy import stats

import prbayes as prb
from prbayes.metrics.base import Metric
from prbayes.model.random_variable import Node, nodes
from prbayes.propagation.base import Propagation

N, MU, SIGMA, EPSILON, POINTS = 30, 2.0, 0.8, 0.02, 128
OBSERVED = np.random.default_rng(3).permutation(
    0.75 * stats.norm(MU, SIGMA).ppf((np.arange(N) + 0.5) / N)
)
QUIET = {"progressbar": False}


def line(x: Any) -> Any:
    return 0.75 * x


def build(
    propagation: Propagation,
    response: Any = line,
    *,
    prior: tuple[float, float] = (2, 1),
    metric: Metric | None = None,
    **changes: Any,
) -> tuple[pm.Model, Node]:
    keywords = {
        "metric": metric or prb.AreaMetric(),
        "observed": OBSERVED,
        "epsilon": EPSILON,
    } | changes
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", *prior), pm.HalfNormal("sigma", 1)
        prb.Simulator("y", response, pm.Normal.dist(mu, sigma), propagation=propagation, **keywords)
    return model, next(iter(nodes(model).values()))
