"""Readings with a known error under vague priors: runs, bias and widths, against quadrature.

Means and spreads of the populations, sizes, priors and errors are random; errors are a twentieth to
twice the spread of the outputs. The likelihood of each specimen is a sum over its inputs, and the
posterior a grid over mean and spread, which is laid around all modes of a coarser one.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.inaccurate [--data-sets 10] [--cells "square"]
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
from scipy import stats

import prbayes as prb
from benchmarks.invertible import ENDS, summary
from benchmarks.study import Study

RESPONSES: dict[str, Callable[[Any], Any]] = {
    "linear": lambda x: 3.0 * x + 1.0,
    "softplus": lambda x: np.logaddexp(0, x),
    "decay": lambda x: 5.0 * np.exp(-x),
    "saturation": lambda x: x / np.sqrt(1.0 + x**2),
    "sigmoid": lambda x: 1.0 / (1.0 + np.exp(-2.0 * x)),
    "square": lambda x: x**2,
    "bump": lambda x: np.exp(-(x**2)),
    "waves": lambda x: x + 1.2 * np.sin(2.0 * x),
    "sine": np.sin,
}


def exact(
    x: Any, likelihood: Any, prior: tuple[float, float], scale: float
) -> list[tuple[float, float, float]]:
    """Return means, standard deviations and widths of intervals of mu and sigma.

    ``likelihood``, (N, K), has densities of the readings at inputs x, (K,), at equal distances.
    """
    step = x[1] - x[0]
    is_possible = likelihood.max(axis=0) > 1e-14
    x, likelihood = x[is_possible], likelihood[:, is_possible]
    ends = [(prior[0] - 4.5 * prior[1], prior[0] + 4.5 * prior[1])]
    ends.append((np.log(1e-3 * scale), np.log(4.5 * scale)))
    for size in (1501, 801):
        mu, log_sd = np.linspace(*ends[0], size), np.linspace(*ends[1], 61)
        density = np.empty((len(mu), len(log_sd)))
        for k, sd in enumerate(np.exp(log_sd)):
            # A population narrower than the steps has the same likelihood as a point.
            unit = max(sd, 1.5 * step)
            population = np.exp(-(((x[:, None] - mu) / unit) ** 2) / 2)
            with np.errstate(divide="ignore"):
                logs = np.log(likelihood @ (population / unit)).sum(axis=0)
            density[:, k] = logs + stats.halfnorm(scale=scale).logpdf(sd) + log_sd[k]
        density += stats.norm(*prior).logpdf(mu)[:, None]
        weights = np.exp(density - density.max())
        for axis, grid in enumerate((mu, log_sd)):
            of_axis = weights.sum(axis=1 - axis)
            rows = np.flatnonzero(of_axis > 1e-7 * of_axis.max())
            first, last = max(rows[0] - 2, 0), min(rows[-1] + 2, len(grid) - 1)
            ends[axis] = grid[first], grid[last]
    weights /= weights.sum()
    figures = []
    for of_grid, grid in ((weights.sum(axis=1), mu), (weights.sum(axis=0), np.exp(log_sd))):
        mean = float(of_grid @ grid)
        sd = float(np.sqrt(of_grid @ (grid - mean) ** 2))
        low, high = np.interp(ENDS, np.cumsum(of_grid) - of_grid / 2, grid)
        figures.append((mean, sd, float(high - low)))
    return figures


def row(cell: str, number: int) -> dict[str, Any]:
    """Return runs, bias and widths of a data set."""
    response, runs = RESPONSES[cell], [0]
    rng = np.random.default_rng([number, list(RESPONSES).index(cell), 1])
    n, mean, sd = int(rng.integers(5, 41)), rng.uniform(-1.5, 1.5), 10 ** rng.uniform(-1.5, 0.0)
    clean = response(rng.normal(mean, sd, n))
    error = clean.std() * 10 ** rng.uniform(-1.3, 0.3)
    observed = clean + rng.normal(0, error, n)
    prior, scale = (mean + rng.normal(0, 0.7), rng.uniform(0.7, 3.0)), rng.uniform(0.5, 1.5)

    def counted(x: Any) -> Any:
        runs[0] += np.size(x)
        return response(x)

    begun = time.process_time()
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", *prior), pm.HalfNormal("sigma", scale))
        metric = prb.LogLikelihood(error=error)
        prb.Simulator("y", counted, x, observed=observed, metric=metric)
        draws = prb.sample(draws=2000, random_seed=number).posterior
    figures: dict[str, Any] = {"runs": runs[0], "cpu": round(time.process_time() - begun, 2)}
    half = 4.5 * prior[1] + 4 * scale
    inputs = np.linspace(prior[0] - half, prior[0] + half, 12001)
    likelihood = np.exp(-(((observed[:, None] - response(inputs)) / error) ** 2) / 2)
    names, biases, widths = ("mu", "sigma"), [], []
    for name, figure in zip(names, exact(inputs, likelihood, prior, scale), strict=True):
        of_name = draws[name].to_numpy()
        biases.append(abs(float(of_name.mean()) - figure[0]) / figure[1])
        widths.append(float(np.ptp(np.quantile(of_name, ENDS))) / figure[2])
    codes = [finding["code"] for finding in json.loads(draws.attrs["findings"])]
    figures |= {"bias": max(biases), "narrowest": min(widths), "widest": max(widths)}
    return figures | {"n": n, "findings": codes}


if __name__ == "__main__":
    failures = (prb.propagation.DesignError, ValueError, RuntimeError)
    Study("inaccurate", __doc__, RESPONSES, row, 10, summary, failures=failures).main()
