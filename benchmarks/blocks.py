"""Seconds for the discrepancies of 2000 populations, by how many are evaluated at a time.

Run: uv run python -m benchmarks.blocks
"""

import argparse
import statistics
import time
from pathlib import Path

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks import record
from prbayes.model.evaluator import Evaluator
from prbayes.propagation import reweighted

METRICS = {"KLD": prb.KullbackLeibler(), "area": prb.AreaMetric()}
POINTS = [256, 1024, 4096, 16384]
BLOCKS = [16, 64, 256, 1024, 2000]
POPULATIONS = 2000


def evaluator_of(metric, n):
    """Return the evaluator of a normal population."""
    observed = np.random.default_rng(1).normal(0, 1, 50)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator(
            "y", np.positive, x, metric=metric, observed=observed, propagation=prb.Reweighted(n)
        )
    return Evaluator.of(model)


def main():
    """Time all blocks in turn, several times; medians as ratios to those in use."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--out", type=Path, default=record.RESULTS / "blocks.json")
    arguments = parser.parse_args()
    in_use = reweighted._BLOCK, reweighted._MIN_POPULATIONS
    blocks = {"in use": in_use} | {str(number): (1, number) for number in BLOCKS}
    rows = []
    for name, metric in METRICS.items():
        for points in POINTS:
            evaluator = evaluator_of(metric, points)
            thetas = evaluator.hyperparameters.prior_thetas(POPULATIONS, 1)
            seconds: dict[str, list[float]] = {block: [] for block in blocks}
            for _ in range(arguments.repeats):
                for block, setting in blocks.items():
                    reweighted._BLOCK, reweighted._MIN_POPULATIONS = setting
                    start = time.perf_counter()
                    evaluator.discrepancies(thetas, 0)
                    seconds[block].append(time.perf_counter() - start)
            medians = {block: statistics.median(found) for block, found in seconds.items()}
            used = medians.pop("in use")
            ratios = {block: round(found / used, 2) for block, found in medians.items()}
            rows.append({"metric": name, "points": points, "seconds": used, "ratios": ratios})
            print(f"{name:6s} {points:6d} {used:8.4f} s", *(f"{k}: {v}" for k, v in ratios.items()))
    reweighted._BLOCK, reweighted._MIN_POPULATIONS = in_use
    record.save(arguments.out, rows)


if __name__ == "__main__":
    main()
