"""Priors and inputs of a problem as PyMC's variables, for the rivals that are written in PyMC."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm

from benchmarks.scoreboard.problem import Draws, Problem

_PRIORS: dict[str, Any] = {
    "norm": lambda name, mean, sd: pm.Normal(name, mean, sd),
    "halfnorm": lambda name, _, scale: pm.HalfNormal(name, scale),
    "beta": lambda name, a, b: pm.Beta(name, a, b),
    "uniform": lambda name, low, width: pm.Uniform(name, low, low + width),
    "lognorm": lambda name, s, _, scale: pm.LogNormal(name, np.log(scale), s),
    "truncnorm": lambda name, low, _, mean, sd: pm.TruncatedNormal(
        name, mean, sd, lower=mean + low * sd
    ),
}
_INPUTS = {"normal": pm.Normal, "lognormal": pm.LogNormal, "uniform": pm.Uniform}


def hyperparameters(problem: Problem) -> dict[str, Any]:
    """Make the hyperparameters, within a model."""
    return {name: _PRIORS[p.family](name, *p.arguments) for name, p in problem.priors.items()}


def _families(problem: Problem, values: Draws) -> list[tuple[Any, list[Any]]]:
    return [
        (_INPUTS[x.family], [values.get(p, p) for p in (x.first, x.second)]) for x in problem.inputs
    ]


def _joint(problem: Problem, values: Draws) -> dict[str, Any]:
    """Return mean and covariance of two correlated normal inputs."""
    (_, (m, s)), (_, (n, t)) = _families(problem, values)
    cross = values[problem.correlation] * s * t
    cov = pm.math.stack([pm.math.stack([s * s, cross]), pm.math.stack([cross, t * t])])
    return {"mu": pm.math.stack([m, n]), "cov": cov}


def inputs(problem: Problem, values: Draws) -> list[Any]:
    """Return the inputs of a specimen as distributions, which are not in the model.

    Correlated inputs are one vector.
    """
    if problem.correlation:
        return [pm.MvNormal.dist(**_joint(problem, values))]
    return [family.dist(*two) for family, two in _families(problem, values)]


def latent(problem: Problem, values: Draws, size: int) -> list[Any]:
    """Make the inputs of all specimens, as latent variables within a model."""
    if problem.correlation:
        both = pm.MvNormal("x", **_joint(problem, values), shape=(size, 2))
        return [both[:, 0], both[:, 1]]
    families = _families(problem, values)
    return [family(f"x{k}", *two, shape=size) for k, (family, two) in enumerate(families)]


def draws(posterior: Any, problem: Problem) -> dict[str, Any]:
    """Return the draws of all chains."""
    return {name: posterior[name].to_numpy().ravel() for name in problem.priors}
