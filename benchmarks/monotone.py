"""Monotone responses under vague priors: runs, bias and widths, against the posterior of the inputs.

With exact readings of a monotone response the inputs of the specimens are known, and the posterior of
a normal population is that of its own sample, by a grid. Means and spreads of the populations, sizes
and priors are random; populations are up to a thousand times narrower than their prior.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.monotone [--data-sets 20] [--cells "sigmoid"]
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
from benchmarks.study import Rows, Study

ENDS = [0.055, 0.945]  # of the intervals whose widths are compared
RESPONSES: dict[str, Callable[[Any], Any]] = {
    "linear": lambda x: 3.0 * x + 1.0,
    "softplus": lambda x: np.log1p(np.exp(x)),
    "decay": lambda x: 5.0 * np.exp(-x),
    "cubic": lambda x: x + 0.3 * x**3,
    "saturation": lambda x: x / np.sqrt(1.0 + x**2),
    "sigmoid": lambda x: 1.0 / (1.0 + np.exp(-2.0 * x)) + 0.05 * x,
    "waves": lambda x: x + 0.4 * np.sin(2.0 * x),
}


def row(cell: str, number: int) -> dict[str, Any]:
    """Return runs, bias and widths of a data set."""
    rng = np.random.default_rng([number, list(RESPONSES).index(cell)])
    n, mean, sd = int(rng.integers(5, 41)), rng.uniform(-2.0, 2.0), 10 ** rng.uniform(-2.5, 0.0)
    x = rng.normal(mean, sd, n)
    prior = mean + rng.normal(0.0, 1.0), rng.uniform(1.0, 4.0)
    scale = rng.uniform(0.5, 2.0)
    response, runs = RESPONSES[cell], [0]

    def counted(x: Any) -> Any:
        runs[0] += np.size(x)
        return response(x)

    begun = time.process_time()
    with pm.Model():
        population = pm.Normal.dist(pm.Normal("mu", *prior), pm.HalfNormal("sigma", scale))
        prb.Simulator("y", counted, population, observed=response(x))
        draws = prb.sample(draws=2000, random_seed=number).posterior
    cpu = time.process_time() - begun
    steps = np.linspace(-5, 5, 401)
    mu = x.mean() + x.std() * np.sinh(steps) / np.sqrt(n)
    log_sd = np.log(x.std()) + np.linspace(-6, 10, 401) / np.sqrt(n)
    mesh, logs = np.meshgrid(mu, log_sd, indexing="ij")
    spread = np.exp(logs)
    squares = n * (x.var() + (x.mean() - mesh) ** 2)
    density = -(n - 1) * logs - squares / (2 * spread**2)
    density += stats.norm(*prior).logpdf(mesh) + stats.halfnorm(scale=scale).logpdf(spread)
    weights = np.exp(density - density.max()) * np.cosh(steps)[:, None]
    weights /= weights.sum()
    figures: dict[str, Any] = {"runs": runs[0], "cpu": round(cpu, 2), "bias": 0.0, "n": n, "sd": sd}
    widths = []
    for name, grid in (("mu", mesh), ("sigma", spread)):
        exact = float((weights * grid).sum())
        sd = float(np.sqrt((weights * (grid - exact) ** 2).sum()))
        figures["bias"] = max(figures["bias"], abs(float(draws[name].mean()) - exact) / sd)
        # Standard deviations of draws from the heavy tails of few specimens are noisy.
        order = np.argsort(grid, axis=None)
        cumulative = np.cumsum(weights.ravel()[order])
        low, high = grid.ravel()[order][np.searchsorted(cumulative, ENDS)]
        widths.append(float(np.ptp(np.quantile(draws[name], ENDS))) / (high - low))
    codes = [finding["code"] for finding in json.loads(draws.attrs["findings"])]
    return figures | {"narrowest": min(widths), "widest": max(widths), "findings": codes}


def summary(rows: Rows) -> dict[str, Any]:
    """Return the worst figures of the rows of a cell, and how many are right."""
    answered = [row for row in rows if "error" not in row]
    right = [r for r in answered if r["bias"] < 0.1 and 0.9 < r["narrowest"] < r["widest"] < 1.1]
    return {
        "data sets": len(rows),
        "refused": len(rows) - len(answered),
        "right": len(right),
        "runs": max((r["runs"] for r in answered), default=0),
        "cpu": float(np.median([r["cpu"] for r in answered])) if answered else np.nan,
    }


if __name__ == "__main__":
    failures = (prb.propagation.DesignError, ValueError, RuntimeError)
    Study("monotone", __doc__, RESPONSES, row, 20, summary, failures=failures).main()
