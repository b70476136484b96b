"""A two-storey shear frame: two frequencies and the roof's share of the first mode, wide priors."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from benchmarks.scoreboard import exact
from benchmarks.scoreboard.problem import Input, Problem, Reference, uniform

STIFFNESS, SCATTER = np.array([1000.0, 800.0]), np.array([80.0, 60.0])
PRIORS = {
    "mu1": uniform(400.0, 1600.0),
    "sd1": uniform(0.0, 600.0),
    "mu2": uniform(300.0, 1300.0),
    "sd2": uniform(0.0, 450.0),
}


def formula(xp: Any, lower: Any, upper: Any) -> list[Any]:
    """Return outputs from the stiffnesses of the storeys, masses are one; NaN of negative ones."""
    there = (lower > 0) & (upper > 0)
    lower, upper = xp.where(there, lower, np.nan), xp.where(there, upper, np.nan)
    middle, root = (lower + 2 * upper) / 2, xp.sqrt(lower**2 + 4 * upper**2) / 2
    low = middle - root
    roof = (lower + upper - low) / upper
    frequencies = [xp.sqrt(low) / 2 / np.pi, xp.sqrt(middle + root) / 2 / np.pi]
    return [*frequencies, roof / (1 + roof)]


def stiffnesses(size: int, replicate: int) -> Any:
    """Draw the specimens' stiffnesses, (N, 2)."""
    z = np.random.default_rng([5, size, replicate]).standard_normal((size, 2))
    return STIFFNESS + SCATTER * z


def data(size: int, replicate: int) -> Any:
    """Return the outputs of the specimens, (N, 3)."""
    return np.stack(formula(np, *stiffnesses(size, replicate).T), axis=-1)


@cache
def reference(size: int, replicate: int) -> Reference:
    """Return the exact posterior: the outputs tell both stiffnesses of a specimen."""
    x, names = stiffnesses(size, replicate), list(PRIORS)
    center: dict[str, float] = {}
    sd: dict[str, float] = {}
    for k in range(2):
        priors = {name: PRIORS[name] for name in names[2 * k : 2 * k + 2]}
        storey = exact.posterior(priors, exact.normal_log_likelihood(x[:, k]))
        center |= storey.center
        sd |= storey.sd
    return Reference("exact posterior", center, sd)


PROBLEM = Problem(
    name="frame",
    what="Two frequencies and a mode of a two-storey frame, two normal stiffnesses, wide priors.",
    licence="drawn here",
    priors=PRIORS,
    inputs=(Input("normal", "mu1", "sd1"), Input("normal", "mu2", "sd2")),
    formula=formula,
    sizes=(20, 50),
    data=data,
    reference=reference,
    truth={"mu1": 1000.0, "sd1": 80.0, "mu2": 800.0, "sd2": 60.0},
)
