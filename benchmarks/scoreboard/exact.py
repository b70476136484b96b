"""Exact posteriors of two hyperparameters, on a grid that is narrowed to where the posterior is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.scoreboard.problem import Draws, Prior, Reference

_POINTS = 241  # of each side of the grid
_PASSES = 4
_NEGLIGIBLE = 1e-9  # of the highest marginal weight
_TAIL = 1e-6  # of a prior, that is left out at either end


def posterior(
    priors: dict[str, Prior],
    log_likelihood: Callable[[Any, Any], Any],
    told: Callable[[Draws], Draws] = dict,
    points: int = _POINTS,
) -> Reference:
    """Return means and standard deviations of two hyperparameters, or of what is told of them.

    ``log_likelihood`` takes the two, in the order of the priors, each (P,), and returns (P,).
    """
    names, frozen = list(priors), [p.distribution() for p in priors.values()]
    low, high = np.transpose([p.ppf([_TAIL, 1 - _TAIL]) for p in frozen])
    for _ in range(_PASSES):
        axes = [np.linspace(a, b, points) for a, b in zip(low, high, strict=True)]
        first, second = (x.ravel() for x in np.meshgrid(*axes, indexing="ij"))
        values = {names[0]: first, names[1]: second}
        with np.errstate(divide="ignore", invalid="ignore"):
            prior = frozen[0].logpdf(first) + frozen[1].logpdf(second)
            logs = log_likelihood(first, second) + prior
        logs = np.where(np.isnan(logs), -np.inf, logs)
        weights = np.exp(logs - logs.max())
        square = weights.reshape(points, points)
        for k, axis in enumerate(axes):
            marginal = square.sum(axis=1 - k)
            kept = np.flatnonzero(marginal > _NEGLIGIBLE * marginal.max())
            low[k] = axis[max(kept[0] - 1, 0)]
            high[k] = axis[min(kept[-1] + 1, points - 1)]
    return moments("exact posterior", told(values), weights)


def moments(kind: str, values: Draws, weights: Any) -> Reference:
    """Return a reference from weighted values."""
    weights = weights / weights.sum()
    center = {name: float(weights @ value) for name, value in values.items()}
    sd = {
        name: float(np.sqrt(weights @ (value - center[name]) ** 2))
        for name, value in values.items()
    }
    return Reference(kind, center, sd)


def normal_log_likelihood(x: Any) -> Callable[[Any, Any], Any]:
    """Return the log-likelihood of a normal population, given its specimens."""
    n, mean, scatter = len(x), x.mean(), ((x - x.mean()) ** 2).sum()

    def function(mu: Any, sigma: Any) -> Any:
        return -n * np.log(sigma) - (scatter + n * (mean - mu) ** 2) / (2 * sigma**2)

    return function
