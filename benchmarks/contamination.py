"""What gross outliers do to each metric: shift of the posterior, in standard deviations of the clean posterior.

Data are normal, N(10, 1), with N = 50; then 5% of them, 2 or 3 values at random, are replaced by
gross outliers 8 standard deviations above the mean. The same data sets, clean and contaminated, are
calibrated with each metric, and the shift of the posterior mean and the ratio of the posterior's sd
to the clean one are averaged.

    uv run python -m benchmarks.contamination [--replicates 40]
"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks import record
from benchmarks.metrics import BY_NAME
from prbayes.model.evaluator import Evaluator
from prbayes.posterior.sample import draw_posterior
from prbayes.posterior.smc import SamplingSettings

SIZE = 50
SHARE = 0.05
DISTANCE = 8.0
METRICS = ("ProbabilityResidual", "KullbackLeibler", "AreaMetric", "LogLikelihood")


def evaluator_of(metric: str) -> Evaluator:
    """Return an evaluator of the model, to be given data."""
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 10, 3), pm.HalfNormal("sigma", 3)
        prb.Simulator(
            "y",
            lambda x: x,
            pm.Normal.dist(mu, sigma),
            metric=BY_NAME[metric],
            observed=np.random.default_rng(0).normal(10, 1, SIZE),
        )
    return Evaluator.of(model)


def posterior(evaluator: Evaluator, data: Any) -> Any:
    """Return means and standard deviations of mu and sigma."""
    tree = draw_posterior(
        evaluator.observing({"y": data}), SamplingSettings(chains=4, random_seed=1)
    )
    draws = tree["posterior"].dataset
    return np.array([[float(draws[n].mean()), float(draws[n].std())] for n in ("mu", "sigma")])


def main() -> None:
    """Calibrate clean and contaminated data; print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--replicates", type=int, default=40)
    parser.add_argument("--out", type=Path, default=record.RESULTS / "contamination.json")
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    table: dict[str, Any] = {
        "replicates": arguments.replicates,
        "N": SIZE,
        "share": SHARE,
        "distance": DISTANCE,
    }
    for metric in METRICS:
        evaluator = evaluator_of(metric)
        shifts, ratios = [], []
        for i in range(arguments.replicates):
            rng = np.random.default_rng([5, i])
            data = rng.normal(10, 1, SIZE)
            dirty = data.copy()
            n_bad = int(SHARE * SIZE) + (rng.random() < SHARE * SIZE % 1)
            dirty[SIZE - n_bad :] = 10 + DISTANCE
            clean, after = posterior(evaluator, data), posterior(evaluator, dirty)
            shifts.append((after[:, 0] - clean[:, 0]) / clean[:, 1])
            ratios.append(after[:, 1] / clean[:, 1])
        error = np.std(shifts, axis=0, ddof=1) / np.sqrt(len(shifts))
        table[metric] = {
            "shift": np.mean(shifts, axis=0).tolist(),
            "standard_error": error.tolist(),
            "sd_ratio": np.median(ratios, axis=0).tolist(),
        }
        print(metric, table[metric], flush=True)
    record.save(arguments.out, table)


if __name__ == "__main__":
    main()
