"""Invertible responses under vague priors: runs, bias and widths, against the posterior of the inputs.

With exact readings of an invertible response the inputs of the specimens are known, and the posterior
of each normal population is that of its own sample, by a grid. Means and spreads of the populations,
sizes and priors are random; populations are up to a thousand times narrower than their prior.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.invertible [--data-sets 20] [--cells "sigmoid"]
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


def elimination(a: Any, b: Any) -> list[Any]:
    """Return concentrations at two times of a rate and an amount."""
    rate, amount = np.exp(0.3 * a), np.exp(0.3 * b)
    return [np.exp(-rate) * amount, np.exp(-3 * rate) * amount]


def growth(a: Any, b: Any, c: Any) -> list[Any]:
    """Return sizes at three times of a logistic curve."""
    return [(2 + np.tanh(0.4 * a)) / (1 + np.exp((b - t) * np.exp(0.2 * c))) for t in (-1, 0.5, 2)]


def trace(a: Any, b: Any) -> list[Any]:
    """Return a curve of two waves at two times."""
    times = 1.0, 4.0
    return [a * np.sin(0.3 * t) + b * np.cos(0.3 * t) + 0.05 * t * np.tanh(a) for t in times]


def polar(a: Any, b: Any) -> list[Any]:
    """Return the place at a logarithmic radius and an angle."""
    return [np.exp(0.5 * a) * np.cos(0.3 * b), np.exp(0.5 * a) * np.sin(0.3 * b)]


# Number of inputs, and outputs of them.
RESPONSES: dict[str, tuple[int, Callable[..., list[Any]]]] = {
    "linear": (1, lambda x: [3.0 * x + 1.0]),
    "softplus": (1, lambda x: [np.logaddexp(0, x)]),
    "decay": (1, lambda x: [5.0 * np.exp(-x)]),
    "cubic": (1, lambda x: [x + 0.3 * x**3]),
    "saturation": (1, lambda x: [x / np.sqrt(1.0 + x**2)]),
    "sigmoid": (1, lambda x: [1.0 / (1.0 + np.exp(-2.0 * x)) + 0.05 * x]),
    "waves": (1, lambda x: [x + 0.4 * np.sin(2.0 * x)]),
    "shear": (2, lambda a, b: [a, b + a**2]),
    "polar": (2, polar),
    "mixed": (2, lambda a, b: [np.logaddexp(0, a) + 0.2 * b, b + 0.3 * np.tanh(a)]),
    "steep": (2, lambda a, b: [np.logaddexp(0, 3 * a) + 0.2 * b, b + 0.3 * np.tanh(2 * a)]),
    "product": (2, lambda a, b: [np.exp(a + b), np.exp(a - b)]),
    "elimination": (2, elimination),
    "trace": (2, trace),
    "triangle": (3, lambda a, b, c: [a + 0.2 * b**2, b + 0.3 * np.sin(c), c + np.exp(a / 2) / 10]),
    "growth": (3, growth),
}


def exact(x: Any, prior: tuple[float, float], scale: float) -> list[Any]:
    """Return means, standard deviations and widths of intervals of mu and sigma, of a sample."""
    n, steps = len(x), np.linspace(-5, 5, 401)
    mu = x.mean() + x.std() * np.sinh(steps) / np.sqrt(n)
    log_sd = np.log(x.std()) + np.linspace(-6, 10, 401) / np.sqrt(n)
    mesh, logs = np.meshgrid(mu, log_sd, indexing="ij")
    spread = np.exp(logs)
    squares = n * (x.var() + (x.mean() - mesh) ** 2)
    density = -(n - 1) * logs - squares / (2 * spread**2)
    density += stats.norm(*prior).logpdf(mesh) + stats.halfnorm(scale=scale).logpdf(spread)
    weights = np.exp(density - density.max()) * np.cosh(steps)[:, None]
    weights /= weights.sum()
    figures = []
    for grid in (mesh, spread):
        mean = float((weights * grid).sum())
        sd = float(np.sqrt((weights * (grid - mean) ** 2).sum()))
        # Standard deviations of draws from the heavy tails of few specimens are noisy.
        order = np.argsort(grid, axis=None)
        cumulative = np.cumsum(weights.ravel()[order])
        low, high = grid.ravel()[order][np.searchsorted(cumulative, ENDS)]
        figures.append((mean, sd, high - low))
    return figures


def row(cell: str, number: int) -> dict[str, Any]:
    """Return runs, bias and widths of a data set."""
    d, response = RESPONSES[cell]
    rng = np.random.default_rng([number, list(RESPONSES).index(cell)])
    n, mean, sd = int(rng.integers(5, 41)), rng.uniform(-2.0, 2.0, d), 10 ** rng.uniform(-2.5, 0, d)
    x = rng.normal(mean, sd, (n, d))
    priors = [(m + rng.normal(0.0, 1.0), rng.uniform(1.0, 4.0)) for m in mean]
    scales, runs = rng.uniform(0.5, 2.0, d), [0]

    def counted(*x: Any) -> Any:
        runs[0] += np.size(x[0])
        return np.stack(np.broadcast_arrays(*response(*x)), axis=-1)

    observed = np.stack(response(*x.T), axis=-1)
    begun = time.process_time()
    with pm.Model():
        inputs = [
            pm.Normal.dist(pm.Normal(f"mu_{k}", *priors[k]), pm.HalfNormal(f"sigma_{k}", scales[k]))
            for k in range(d)
        ]
        prb.Simulator("y", counted, *inputs, observed=observed)
        draws = prb.sample(draws=2000, random_seed=number).posterior
    figures: dict[str, Any] = {"runs": runs[0], "cpu": round(time.process_time() - begun, 2)}
    biases, widths = [], []
    for k in range(d):
        references = exact(x[:, k], priors[k], scales[k])
        for name, (center, unit, width) in zip(("mu", "sigma"), references, strict=True):
            of_name = draws[f"{name}_{k}"].to_numpy()
            biases.append(abs(float(of_name.mean()) - center) / unit)
            widths.append(float(np.ptp(np.quantile(of_name, ENDS))) / width)
    codes = [finding["code"] for finding in json.loads(draws.attrs["findings"])]
    figures |= {"bias": max(biases), "narrowest": min(widths), "widest": max(widths)}
    return figures | {"n": n, "findings": codes}


def summary(rows: Rows) -> dict[str, Any]:
    """Return the worst figures of the rows of a cell, and how many are right."""
    answered = [row for row in rows if "error" not in row]
    right = [r for r in answered if r["bias"] < 0.1 and 0.9 < r["narrowest"] < r["widest"] < 1.1]
    return {
        "data sets": len(rows),
        "refused": len(rows) - len(answered),
        "right": len(right),
        "median runs": float(np.median([r["runs"] for r in answered])) if answered else np.nan,
        "runs": max((r["runs"] for r in answered), default=0),
        "cpu": float(np.median([r["cpu"] for r in answered])) if answered else np.nan,
    }


if __name__ == "__main__":
    failures = (prb.propagation.DesignError, ValueError, RuntimeError)
    Study("invertible", __doc__, RESPONSES, row, 10, summary, failures=failures).main()
