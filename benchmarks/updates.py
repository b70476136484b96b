"""Posteriors that grow by updates, against the exact posterior of all specimens.

Twenty rotors are measured first, and forty more in batches. An amplification belongs to two natural
frequencies, so that the exact posterior sums over both roots, on a grid. Distances are in exact
standard deviations, times in CPU seconds for each added specimen.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.updates
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.stats import halfnorm, norm

from benchmarks.study import Study

PEAK = 10 / np.sqrt(1 - 2 * 0.1**2)  # Hz, at the largest amplification
CELLS = {"ten at once": 10, "forty at once": 40, "one by one": 1}


def amplification(frequency: Any, damping: float = 0.1) -> Any:
    """Return the amplitude at 10 Hz over the static deflection."""
    r = 10.0 / frequency
    return 1 / np.sqrt((1 - r**2) ** 2 + (2 * damping * r) ** 2)


def exact(measured: Any) -> dict[str, tuple[float, float]]:
    """Return mean and standard deviation of mu and sigma."""
    ends = ((1.0, PEAK), (PEAK, 50.0))
    roots = np.array(
        [[brentq(lambda f, y=y: amplification(f) - y, *e) for e in ends] for y in measured]
    )
    slope = np.abs(amplification(roots + 1e-5) - amplification(roots - 1e-5)) / 2e-5
    mu, sigma = map(np.ravel, np.meshgrid(np.linspace(10, 12.4, 300), np.geomspace(0.15, 2, 300)))
    density = sum(norm.pdf(roots[:, [k]], mu, sigma) / slope[:, [k]] for k in range(2))
    logs = np.log(density).sum(axis=0) + np.log(sigma)
    logs += norm.logpdf(mu, 11, 0.3) + halfnorm.logpdf(sigma, 0, 0.5)
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    moments = {}
    for name, values in (("mu", mu), ("sigma", sigma)):
        mean = float(weights @ values)
        moments[name] = mean, float(np.sqrt(weights @ (values - mean) ** 2))
    return moments


def row(cell: str, number: int) -> dict[str, float]:
    """Update a posterior of 20 specimens by 40; return distances, widths, time and runs."""
    import pymc as pm

    import prbayes as prb

    rng = np.random.default_rng(number)
    measured = amplification(rng.normal(11.2, 0.4, 60))
    with pm.Model() as model:
        mu = pm.Normal("mu", 11, 0.3)
        sigma = pm.HalfNormal("sigma", 0.5)
        prb.Simulator("y", amplification, pm.Normal.dist(mu, sigma), observed=measured[:20])
    result = prb.sample(model=model, random_seed=number, progressbar=False)
    start, runs = time.process_time(), 0
    for first in range(20, 60, CELLS[cell]):
        new = measured[first : first + CELLS[cell]]
        result = prb.update(result, observed=new, model=model, random_seed=first)
        runs += result["posterior"].attrs["n_responses"]
    found = {"cpu": (time.process_time() - start) / 40, "runs": float(runs)}
    for name, (mean, sd) in exact(measured).items():
        draws = result["posterior"][name]
        found[f"{name}, bias"] = float(draws.mean() - mean) / sd
        found[f"{name}, width"] = float(draws.std()) / sd
    return found


def summary(rows: list[dict[str, float]]) -> dict[str, Any]:
    """Return the largest distance, the widths' range, and medians of costs."""
    widths = [value for one in rows for key, value in one.items() if key.endswith("width")]
    return {
        "data sets": len(rows),
        "largest bias": max(abs(v) for one in rows for k, v in one.items() if k.endswith("bias")),
        "widths": [min(widths), max(widths)],
        "cpu": float(np.median([one["cpu"] for one in rows])),
        "runs": float(np.median([one["runs"] for one in rows])),
    }


STUDY = Study("updates", __doc__ or "", CELLS, row, 3, summary)

if __name__ == "__main__":
    STUDY.main()
