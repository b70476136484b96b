"""Draws of a density by steps of many at once, each from a start of its own."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from prbayes._checks import Floats
from prbayes.posterior.smc_kernel import Normal, correlation

# Steps of the draws, and their mean absolute correlation with where they began, at which they end.
WALK = 200
AT_LEAST = 20
_FORGOTTEN = 0.05
# The same, from which on it is told. By judgement.
REMEMBERED = 0.2


def walked(
    log_density: Callable[[Floats], Floats],
    start: Floats,
    rng: np.random.Generator,
    steps: int = WALK,
    at_least: int = AT_LEAST,
) -> tuple[Floats, float]:
    """Return draws of a density, each of which walked from a start of its own, (n, d).

    And the mean absolute correlation that they still have with where they began.

    Independent proposals from a normal fitted to all, in turn with random walks, by the rule of
    Metropolis and Hastings.
    """
    here = start.copy()
    density = log_density(here)
    scale = 2.38 / np.sqrt(here.shape[1])
    memory = 1.0
    for step in range(steps):
        fitted = Normal.of(here)
        noise = rng.standard_normal(here.shape)
        if step % 2:
            there, log_ratio = fitted.independent(here, noise)
        else:
            there = here + scale * noise @ fitted.root.T
            log_ratio = np.zeros(len(here))
        other = log_density(there)
        with np.errstate(invalid="ignore"):
            gain = other - density + log_ratio
        accepted = np.log(rng.random(len(here))) < np.nan_to_num(gain, nan=-np.inf)
        here[accepted] = there[accepted]
        density[accepted] = other[accepted]
        if step % 2 == 0:
            scale *= np.exp(accepted.mean() - 0.3)
            continue
        memory = correlation(start, here)
        if memory < _FORGOTTEN and step > at_least:
            break
    return here, memory
