"""The response folds the population: two inputs give one response."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from benchmarks.scoreboard import exact
from benchmarks.scoreboard.problem import Input, Problem, Reference, half_normal, truncated

TRUTH = {"mu": 2.0, "sigma": 0.5}
# The mirrored solution, about x = 1, is excluded.
PRIORS = {"mu": truncated(2.0, 1.0, low=1.0), "sigma": half_normal(1.0)}


def data(size: int, replicate: int) -> Any:
    """Draw responses of specimens."""
    x = np.random.default_rng([2, size, replicate]).normal(2.0, 0.5, size)
    return (x - 1) ** 2


def log_likelihood(y: Any, mu: Any, sigma: Any) -> Any:
    """Return the log-likelihood up to a constant, (P,), of responses (N,)."""
    root, total = np.sqrt(y), np.zeros(np.shape(mu))
    for r in root:
        near, far = ((1 + r - mu) / sigma) ** 2, ((1 - r - mu) / sigma) ** 2
        total += np.logaddexp(-near / 2, -far / 2)
    return total - len(y) * np.log(sigma)


@cache
def reference(size: int, replicate: int) -> Reference:
    """Return the exact posterior."""
    y = data(size, replicate)
    return exact.posterior(PRIORS, lambda mu, sigma: log_likelihood(y, mu, sigma))


PROBLEM = Problem(
    name="folded",
    what="y = x^2 - 2 x + 1, x normal: the response folds the population about x = 1.",
    licence="drawn here",
    priors=PRIORS,
    inputs=(Input("normal", "mu", "sigma"),),
    formula=lambda xp, x: x**2 - 2 * x + 1,
    sizes=(20, 50, 200),
    data=data,
    reference=reference,
    truth=TRUTH,
)
