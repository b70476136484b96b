"""A normal model where the truth is not normal, where data are few, tied or rounded: what each metric does.

True inputs: Weibull (shape 1.5), gamma (shape 2), a mixture (80% N(0, 1), 20% N(4, 0.5)), and
normal; the response is the input itself, and the calibrated family is normal. The table has, as
medians over data sets, the error of the mean in true standard deviations, the ratio of the standard
deviations, the area between the calibrated and the true distribution function in true standard
deviations, and the error of the 95% quantile. Ties and rounding: normal data of N = 50, rounded to
multiples of 0.1 to 2 standard deviations, or with half of the values equal to the median.

    uv run python -m benchmarks.misspecified [--seeds 20]
"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
from scipy import stats

import prbayes as prb
from benchmarks import record
from benchmarks.systems import METRICS
from prbayes.model.evaluator import Evaluator
from prbayes.optimize.convergence import Search, Trace, approach, minimise, settle
from prbayes.optimize.objective import Method

SIZES = (20, 50, 1000, 100_000)
LEVELS = (np.arange(100_000) + 0.5) / 100_000
FAMILIES = {
    "normal": stats.norm(),
    "Weibull": stats.weibull_min(1.5),
    "gamma": stats.gamma(2),
    "mixture": None,
}


def draw(family: str, rng: np.random.Generator, n: int) -> Any:
    """Draw standardised values, with true mean zero and true standard deviation one."""
    if family == "mixture":
        x = np.where(rng.random(n) < 0.8, rng.normal(0, 1, n), rng.normal(4, 0.5, n))
        return (x - 0.8) / np.sqrt(0.8 * 1 + 0.2 * 0.25 + 0.16 * 16)
    frozen = FAMILIES[family]
    return (frozen.rvs(n, random_state=rng) - frozen.mean()) / frozen.std()


def quantiles(family: str) -> Any:
    """Return the true quantiles at LEVELS."""
    if family == "mixture":
        return np.sort(draw(family, np.random.default_rng(0), LEVELS.size))
    frozen = FAMILIES[family]
    return (frozen.ppf(LEVELS) - frozen.mean()) / frozen.std()


def evaluator() -> Evaluator:
    """Return an evaluator of the normal model, to be given data and metrics."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 2))
        data = np.random.default_rng(0).normal(size=50)
        prb.Simulator(
            "y",
            lambda x: x,
            x,
            metric=METRICS["PR"],
            observed=data,
            propagation=prb.Resimulated(4096),
        )
    return Evaluator.of(model)


def fit(base: Evaluator, data: Any, metric: str) -> tuple[float, float, bool]:
    """Return mu, sigma, and whether the optimiser converged; NaN where the metric refuses the data."""
    try:
        ev = base.observing({"y": data}, METRICS[metric])
    except ValueError:
        return np.nan, np.nan, False
    search = Search(
        ev, np.array([1.0, 1.0]), Method(), prior=False, tolerance=1e-6, max_evaluations=3000
    )
    start = ev.hyperparameters.unconstrained({"mu": float(np.median(data)) + 0.3, "sigma": 1.5})
    theta, trace = approach(search, start, np.ones(1), 0, Trace())
    run = settle(search, minimise(search, theta, np.ones(1), trace))
    return float(run.theta[0]), float(np.exp(run.theta[1])), run.result.converged


def families(base: Evaluator, seeds: int) -> dict[str, Any]:
    """Fit normal populations to data of other families."""
    out: dict[str, Any] = {}
    z = stats.norm.ppf(LEVELS)
    print(
        f"{'truth':8s} {'N':>7s} {'metric':15s} {'mean':>7s} {'sd ratio':>9s} {'area':>7s} {'95%':>7s} {'failed':>7s}"
    )
    for family in FAMILIES:
        truth = quantiles(family)
        for n in SIZES:
            for metric in METRICS:
                found = [
                    fit(base, draw(family, np.random.default_rng([s, n]), n), metric)
                    for s in range(seeds)
                ]
                mu, sigma = np.array([f[:2] for f in found]).T
                gaps = mu[:, None] + sigma[:, None] * z - truth
                row = [
                    float(np.median(mu)),
                    float(np.median(sigma)),
                    float(np.median(np.abs(gaps).mean(axis=1))),
                    float(np.median(gaps[:, int(0.95 * LEVELS.size)])),
                    sum(not f[2] for f in found),
                ]
                out[f"{family}/{n}/{metric}"] = row
                print(f"{family:8s} {n:7d} {metric:15s} {row[0]:7.3f} {row[1]:9.3f} {row[2]:7.3f} {row[3]:7.3f} "
                      f"{row[4]:7d}", flush=True)  # fmt: skip
    return out


def spoiled(data: Any, how: str) -> Any:
    """Round data to a multiple of standard deviations, or tie half of them."""
    if how == "half tied":
        return np.where(np.arange(data.size) % 2 == 0, np.median(data), data)
    step = float(how.split()[1])
    return step * np.round(data / step)


def ties(base: Evaluator, seeds: int) -> dict[str, Any]:
    """Fit to rounded and tied data; differences from the fit to the data as they were."""
    out: dict[str, Any] = {}
    print(
        f"\n{'N = 50':10s} {'metric':15s} {'shift of mu, |median|':>22s} {'sigma / sigma before':>21s} {'failed':>7s}"
    )
    before = {}
    for metric in METRICS:
        before[metric] = np.array([fit(base, np.random.default_rng([s, 50]).normal(size=50), metric)[:2]
                                   for s in range(seeds)])  # fmt: skip
    for how in ("round 0.1", "round 0.5", "round 1", "round 2", "half tied"):
        for metric in METRICS:
            found = [fit(base, spoiled(np.random.default_rng([s, 50]).normal(size=50), how), metric)
                     for s in range(seeds)]  # fmt: skip
            after = np.array([f[:2] for f in found])
            row = [
                float(np.nanmedian(np.abs(after - before[metric])[:, 0])),
                float(np.nanmedian((after / before[metric])[:, 1])),
                sum(not f[2] for f in found),
            ]
            out[f"{how}/{metric}"] = row
            print(f"{how:10s} {metric:15s} {row[0]:22.3f} {row[1]:21.3f} {row[2]:7d}", flush=True)
    return out


def main() -> None:
    """Fit, print tables, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--out", type=Path, default=record.RESULTS / "misspecified.json")
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    base = evaluator()
    out = {"families": families(base, arguments.seeds), "ties": ties(base, arguments.seeds)}
    record.save(arguments.out, out)


if __name__ == "__main__":
    main()
