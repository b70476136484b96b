"""One measured value in twenty is gross: eight standard deviations above the mean.

The reference is of the data without the gross values.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from benchmarks.scoreboard import exact
from benchmarks.scoreboard.problem import Input, Problem, Reference
from benchmarks.scoreboard.problems.linear import PRIORS, TRUTH

SHARE, DISTANCE = 0.05, 8.0


def clean(size: int, replicate: int) -> Any:
    """Draw specimens."""
    return np.random.default_rng([3, size, replicate]).normal(10.0, 1.0, size)


def data(size: int, replicate: int) -> Any:
    """Return the specimens, the last of which are replaced by gross values."""
    values = clean(size, replicate)
    values[size - round(SHARE * size) :] = 10.0 + DISTANCE
    return values


@cache
def reference(size: int, replicate: int) -> Reference:
    """Return the exact posterior of the specimens before the gross values came."""
    likelihood = exact.normal_log_likelihood(clean(size, replicate))
    return exact.posterior(PRIORS, likelihood)


PROBLEM = Problem(
    name="contaminated",
    what="y = x, x normal, and 5% of the values are gross: the reference is of the data without them.",
    licence="drawn here",
    priors=PRIORS,
    inputs=(Input("normal", "mu", "sigma"),),
    formula=lambda xp, x: x,
    sizes=(20, 100),
    data=data,
    reference=reference,
    truth=TRUTH,
)
