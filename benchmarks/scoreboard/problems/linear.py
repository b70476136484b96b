"""The response is the input itself."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from benchmarks.scoreboard import exact
from benchmarks.scoreboard.problem import Input, Problem, Reference, half_normal, normal

TRUTH = {"mu": 10.0, "sigma": 1.0}
PRIORS = {"mu": normal(10.0, 3.0), "sigma": half_normal(3.0)}


def data(size: int, replicate: int) -> Any:
    """Draw specimens."""
    return np.random.default_rng([1, size, replicate]).normal(10.0, 1.0, size)


@cache
def reference(size: int, replicate: int) -> Reference:
    """Return the exact posterior."""
    likelihood = exact.normal_log_likelihood(data(size, replicate))
    return exact.posterior(PRIORS, likelihood)


PROBLEM = Problem(
    name="linear",
    what="y = x, x normal: the posterior is known in closed form.",
    licence="drawn here",
    priors=PRIORS,
    inputs=(Input("normal", "mu", "sigma"),),
    formula=lambda xp, x: x,
    sizes=(20, 50, 200),
    data=data,
    reference=reference,
    truth=TRUTH,
)
