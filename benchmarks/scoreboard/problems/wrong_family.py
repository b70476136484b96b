"""The calibrated population is normal, and the true one is skewed.

No hyperparameter is right. What is told are quantiles of the response, whose truth is known; the
unit is the standard deviation of the same quantile under the exact posterior of the normal family.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from scipy import stats

from benchmarks.scoreboard import exact
from benchmarks.scoreboard.problem import Draws, Input, Problem, Reference
from benchmarks.scoreboard.problems.linear import PRIORS

LEVELS = {"5%": 0.05, "50%": 0.5, "95%": 0.95}
# Gamma of shape 4, moved to mean 10 and scaled to standard deviation 1: its skewness is 1.
TRUE = stats.gamma(4.0, loc=8.0, scale=0.5)


def data(size: int, replicate: int) -> Any:
    """Draw specimens."""
    return TRUE.rvs(size, random_state=np.random.default_rng([4, size, replicate]))


def told(draws: Draws) -> Draws:
    """Return quantiles of the response."""
    mu, sigma = np.asarray(draws["mu"]), np.asarray(draws["sigma"])
    return {name: mu + sigma * stats.norm.ppf(level) for name, level in LEVELS.items()}


@cache
def reference(size: int, replicate: int) -> Reference:
    """Return the true quantiles, in units of the normal family's exact posterior."""
    likelihood = exact.normal_log_likelihood(data(size, replicate))
    unit = exact.posterior(PRIORS, likelihood, told).sd
    assert PROBLEM.truth is not None
    return Reference("truth", PROBLEM.truth, unit)


PROBLEM = Problem(
    name="wrong family",
    what="y = x, x gamma and calibrated as normal: quantiles of the response against the true ones.",
    licence="drawn here",
    priors=PRIORS,
    inputs=(Input("normal", "mu", "sigma"),),
    formula=lambda xp, x: x,
    sizes=(50, 200),
    data=data,
    reference=reference,
    truth={name: float(TRUE.ppf(level)) for name, level in LEVELS.items()},
    told=told,
)
