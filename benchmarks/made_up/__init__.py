"""Made-up problems in each public capability, against closed forms and quadrature.

A problem is a function that calibrates with prbayes, at its defaults unless they are the subject, and
compares numbers with a reference that does not use prbayes. Each comparison is divided by the largest
difference that is allowed, so that a problem holds up to 1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

PROBLEMS: dict[str, Callable[[], Iterator[tuple[str, float]]]] = {}
OF_MEAN, OF_SD = 0.1, 0.1  # allowed: in exact standard deviations, and as a share of the exact one


def problem(
    function: Callable[[], Iterator[tuple[str, float]]],
) -> Callable[[], Iterator[tuple[str, float]]]:
    """Register a problem under its module and name."""
    module = function.__module__.rpartition(".")[2]
    PROBLEMS[f"{module}: {function.__name__.replace('_', ' ')}"] = function
    return function


def difference(name: str, got: Any, expected: Any, allowed: Any) -> tuple[str, float]:
    """Return the largest difference of arrays as a share of what is allowed."""
    share = np.abs(np.asarray(got, float) - np.asarray(expected, float)) / np.asarray(allowed)
    return name, float(share.max()) if np.isfinite(share).all() else np.inf


def on_grid(log_posterior: Callable[..., Any], **axes: Any) -> tuple[dict[str, Any], Any]:
    """Return values of a grid by name, each (S,), and their posterior weights, (S,).

    ``log_posterior`` takes the values by name; axes are equidistant in what the density is of.
    """
    names = list(axes)
    mesh = np.meshgrid(*axes.values(), indexing="ij")
    values = {name: values.ravel() for name, values in zip(names, mesh, strict=True)}
    logs = np.asarray(log_posterior(**values), dtype=float)
    weights = np.exp(logs - logs.max())
    return values, weights / weights.sum()


def moments(draws: Any, values: dict[str, Any], weights: Any) -> Iterator[tuple[str, float]]:
    """Yield differences of means and standard deviations of draws from those of a weighted grid."""
    for name, of_grid in values.items():
        mean = float(weights @ of_grid)
        sd = float(np.sqrt(weights @ (of_grid - mean) ** 2))
        drawn = np.asarray(draws[name], dtype=float).ravel()
        yield difference(f"mean of {name}", drawn.mean(), mean, OF_MEAN * sd)
        yield difference(f"sd of {name}", drawn.std(), sd, OF_SD * sd)
