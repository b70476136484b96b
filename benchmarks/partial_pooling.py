"""Partial pooling of groups beside the exact posterior of a normal hierarchy.

Six suppliers, twenty specimens of each; responses are normal, with a standard deviation of .5 within
a supplier and .3 between them. For each data set `minimize` and `sample_smc` on one model of all
groups, and the exact posterior, whose means are integrated in closed form and both spreads on a
grid. How far means of draws are from exact ones, in exact standard deviations, and ratios of
standard deviations; how often 89% intervals hold the truth. The command goes on after the data sets
whose rows its file has.

    uv run python -m benchmarks.partial_pooling [--data-sets 40]
"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any

import numpy as np

import prbayes as prb
from benchmarks import record, suppliers

OUT = record.RESULTS / "partial_pooling.json"
NAMES = ("m", "tau", "sigma", "mu")


def one(seed: int) -> dict[str, list[Any]]:
    """Return a row for each element of the hyperparameters, of one data set."""
    observed = suppliers.measured(seed)
    model = suppliers.hierarchy(observed)
    optimum = prb.minimize(model, progressbar=False)
    posterior = prb.sample_smc(
        500, chains=2, model=model, optimum=optimum, random_seed=seed, progressbar=False
    ).posterior
    exact = suppliers.exact(observed)
    truth: dict[str, Any] = {"m": 0.0, "tau": 0.3, "sigma": suppliers.SIGMA}
    # The means come first of all that the seed gives.
    truth["mu"] = np.random.default_rng(seed).normal(0, truth["tau"], len(suppliers.NAMES))
    rows: dict[str, list[Any]] = {}
    for name in NAMES:
        draws = posterior[name].values.reshape(1000, -1)
        mean, sd = np.reshape(exact[name], (-1, 2)).T
        low, high = np.quantile(draws, [0.055, 0.945], axis=0)
        held = (low <= truth[name]) & (truth[name] <= high)
        of_mean = (draws.mean(axis=0) - mean) / sd
        columns = [of_mean, draws.std(axis=0) / sd, held, draws.mean(axis=0), mean]
        rows[name] = np.stack(columns, axis=1).tolist()
    return rows


def main() -> None:
    """Compute, print and save."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data-sets", type=int, default=40)
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    found = record.load(arguments.out, {})
    rows: dict[str, list[Any]] = found.get("rows", {name: [] for name in NAMES})
    for seed in range(len(rows["m"]), arguments.data_sets):
        for name, each in one(seed).items():
            rows[name] += each
        summary = _summary(rows, seed + 1)
        record.save(arguments.out, {**summary, "rows": rows})
        print(seed + 1, summary, flush=True)


def _summary(rows: dict[str, list[Any]], data_sets: int) -> dict[str, Any]:
    found: dict[str, Any] = {"data sets": data_sets}
    for name, each in rows.items():
        shift, ratio, held, mean, exact = np.mean(each, axis=0)
        found[name] = {
            "shift": shift,
            "scatter of shifts": np.std(each, axis=0)[0],
            "ratio of sd": ratio,
            "held": held,
            "mean": mean,
            "exact mean": exact,
        }
    return found


if __name__ == "__main__":
    main()
