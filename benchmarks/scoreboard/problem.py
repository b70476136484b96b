"""A problem of the scoreboard: measured responses, priors, a response and a reference.

Nothing here or in `problems` needs more than NumPy and SciPy, so that a rival imports a problem in
an environment of its own, without prbayes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats
from scipy.special import ndtr

Draws = dict[Any, Any]  # hyperparameters by name, each (S,)


@dataclass(frozen=True)
class Prior:
    """A distribution of scipy.stats, by its name and its arguments in SciPy's order."""

    family: str
    arguments: tuple[float, ...]

    def distribution(self) -> Any:
        """Return the frozen distribution."""
        return getattr(stats, self.family)(*self.arguments)


def normal(mean: float, sd: float) -> Prior:
    """Return a normal prior."""
    return Prior("norm", (mean, sd))


def half_normal(scale: float) -> Prior:
    """Return the prior of the absolute value of a normal variable with mean zero."""
    return Prior("halfnorm", (0.0, scale))


def uniform(low: float, high: float) -> Prior:
    """Return a uniform prior."""
    return Prior("uniform", (low, high - low))


def truncated(mean: float, sd: float, low: float) -> Prior:
    """Return a normal prior of which what is below ``low`` is cut off."""
    return Prior("truncnorm", ((low - mean) / sd, np.inf, mean, sd))


# From independent standard normal variables; the two parameters of each family.
FAMILIES: dict[str, Callable[[Any, Any, Any], Any]] = {
    "normal": lambda z, mean, sd: mean + sd * z,
    "lognormal": lambda z, mean, sd: np.exp(mean + sd * z),
    "uniform": lambda z, low, high: low + (high - low) * ndtr(z),
}


@dataclass(frozen=True)
class Input:
    """An aleatory input: its family, and its two parameters as hyperparameters or numbers."""

    family: str
    first: str | float
    second: str | float


@dataclass(frozen=True)
class Reference:
    """What a rival's draws are compared with, by name of what is told."""

    kind: str  # "exact posterior", "specimen fits", "truth", "published"
    center: dict[str, float]
    sd: dict[str, float]


def _none(size: int, replicate: int) -> Any:
    raise NotImplementedError


@dataclass(frozen=True)
class Problem:
    """Measured responses of specimens, and the population that is looked for."""

    name: str
    what: str  # one sentence
    licence: str  # of the data, and their source
    priors: dict[str, Prior]
    inputs: tuple[Input, ...]
    # NumPy, or another module with its functions, and the inputs -> outputs, one of them or a list.
    formula: Callable[..., Any]
    sizes: tuple[int, ...]  # numbers of specimens
    # Size, replicate -> (N,), or (N, m) of several outputs.
    data: Callable[[int, int], Any] = _none
    reference: Callable[[int, int], Reference] = _none  # of the same arguments
    replicates: int = 100  # data sets that can be drawn; 1 of real data
    truth: dict[str, float] | None = None  # of what is told
    told: Callable[[Draws], Draws] = dict  # what is told of hyperparameters
    degrees: int | None = None  # of freedom of outputs that are readings of a curve, with errors
    error: float | None = None  # sd of a reading, where it is known
    correlation: str = ""  # the hyperparameter that correlates the first two inputs, if one does
    separate: bool = False  # whether each output was measured on specimens of its own

    def population(self, values: Draws, z: Any) -> list[Any]:
        """Return inputs of specimens, each (S, n), from standard normal variables (..., n, inputs)."""
        z = np.asarray(z, dtype=float)
        columns = [z[..., j] for j in range(z.shape[-1])]
        if self.correlation:
            rho = _column(values[self.correlation])
            columns[1] = rho * columns[0] + np.sqrt(1 - rho**2) * columns[1]
        found = []
        for column, one in zip(columns, self.inputs, strict=True):
            two = [_column(values.get(p, p)) for p in (one.first, one.second)]
            found.append(FAMILIES[one.family](column, *two))
        return found

    def log_prior(self, values: Draws) -> Any:
        """Return the logarithm of the prior's density, in the shape of the values."""
        return sum(p.distribution().logpdf(values[name]) for name, p in self.priors.items())

    def prior_draws(self, rng: np.random.Generator, count: int) -> Draws:
        """Draw hyperparameters from the prior."""
        return {
            name: p.distribution().rvs(count, random_state=rng) for name, p in self.priors.items()
        }


def _column(value: Any) -> Any:
    return np.asarray(value, dtype=float)[..., None]


def capped(simulated: Any, observed: Any) -> Any:
    """Return responses, those of specimens that have failed far above all measured ones."""
    return np.minimum(np.where(np.isnan(simulated), np.inf, simulated), 10 * observed.max(axis=0))


def components(problem: Problem, observed: Any) -> Callable[[Any], Any]:
    """Return the map of outputs (..., m) to principal components of the data, (..., k).

    There are as many as inputs, each with a standard deviation of one in the data.
    """
    center, unit = observed.mean(axis=0), observed.std(axis=0)
    _, size, directions = np.linalg.svd((observed - center) / unit, full_matrices=False)
    count = len(problem.inputs)
    kept = directions[:count].T / size[:count] * np.sqrt(len(observed))
    return lambda y: (y - center) / unit @ kept


def statistics(y: Any) -> Any:
    """Return what tells data sets (..., N, m): sorted values of each output, and correlations.

    A correlation is multiplied by the root of N, to count as much as a mean of N values does.
    """
    ordered = np.swapaxes(np.sort(y, axis=-2), -2, -1).reshape(*y.shape[:-2], -1)
    first, second = np.triu_indices(y.shape[-1], 1)
    centred = y - y.mean(axis=-2, keepdims=True)
    centred = centred / np.sqrt((centred**2).sum(axis=-2, keepdims=True))
    correlations = (centred[..., first] * centred[..., second]).sum(axis=-2)
    return np.concatenate([ordered, np.sqrt(y.shape[-2]) * correlations], axis=-1)


class Response:
    """The response of a problem, which counts its runs: one is one specimen, with all its outputs."""

    def __init__(self, problem: Problem) -> None:
        self.problem, self.runs = problem, 0

    def __call__(self, *inputs: Any) -> Any:
        """Return responses of inputs (...): (...), or (..., m) of several outputs."""
        columns = np.broadcast_arrays(*[np.asarray(x, dtype=float) for x in inputs])
        self.runs += columns[0].size
        outputs = self.problem.formula(np, *columns)
        several = type(outputs) is list
        return np.stack(np.broadcast_arrays(*outputs), axis=-1) if several else outputs
