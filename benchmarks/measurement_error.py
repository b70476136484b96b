"""The spread of an input where readings have an error: ignored, known, and estimated from repeats.

Responses are lognormal, of one input with mean 0 and standard deviation .3; readings of 50 specimens
have a normal error with standard deviation .25. 200 data sets, each calibrated by `minimize` and
`sample_smc` in three ways: without the error, with it as another input of known spread, and with a
prior of that spread from 20 differences of repeats. How often 89% intervals hold the truth. The
command goes on after the data sets that its file has.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.measurement_error [--data-sets 200] [--workers 2]
"""

from __future__ import annotations

import argparse
import logging
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks import record

OUT = record.RESULTS / "measurement_error.json"
TRUTH = {"mu": 0.0, "sigma": 0.3}
ERROR, N, REPEATS = 0.25, 50, 20
WAYS = ("ignored", "known", "estimated")


def true_value(x: Any) -> Any:
    return np.exp(x)


def reading(x: Any, error: Any) -> Any:
    return np.exp(x) + error


def posterior(way: str, readings: Any, differences: Any, seed: int) -> Any:
    """Return the posterior of one data set."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 0.5), pm.HalfNormal("sigma", 0.5))
        given = {"metric": prb.ProbabilityResidual(), "observed": readings}
        if way == "ignored":
            prb.Simulator("y", true_value, x, **given, progressbar=False)
        else:
            spread: Any = ERROR
            if way == "estimated":
                # The logarithm of a standard deviation from n differences is known to 1 / sqrt(2 n).
                found = np.sqrt(np.mean(differences**2) / 2)
                spread = pm.LogNormal("error", np.log(found), 1 / np.sqrt(2 * REPEATS))
            error = pm.Normal.dist(0.0, spread)
            propagation = prb.Reweighted(1024, emulator=None)
            prb.Simulator(
                *("y", reading, x, error), **given, propagation=propagation, progressbar=False
            )
    optimum = prb.minimize(model, progressbar=False)
    return prb.sample_smc(
        250, chains=2, model=model, optimum=optimum, random_seed=seed, progressbar=False
    ).posterior


def main() -> None:
    """Compute, print and save."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data-sets", type=int, default=200)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    rows = record.load(arguments.out, {}).get("rows", {})
    missing = [seed for seed in range(arguments.data_sets) if str(seed) not in rows]
    with ProcessPoolExecutor(arguments.workers, mp_context=get_context("spawn")) as pool:
        futures = {pool.submit(_of_one, seed): seed for seed in missing}
        for future in as_completed(futures):
            rows[str(futures[future])] = future.result()
            record.save(arguments.out, {**_summary(list(rows.values())), "rows": rows})
    print(_summary(list(rows.values())))


def _of_one(seed: int) -> dict[str, dict[str, float]]:
    """Return what each way finds of one data set."""
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    rng = np.random.default_rng(seed)
    readings = np.exp(rng.normal(TRUTH["mu"], TRUTH["sigma"], N)) + rng.normal(0, ERROR, N)
    differences = np.sqrt(2) * rng.normal(0, ERROR, REPEATS)
    rows = {}
    for way in WAYS:
        draws = posterior(way, readings, differences, seed)
        for name, truth in TRUTH.items():
            values = draws[name].values
            low, high = np.quantile(values, [0.055, 0.945])
            held = float(low <= truth <= high)
            moments = {"mean": float(values.mean()), "sd": float(values.std())}
            rows[f"{way}/{name}"] = {**moments, "held": held}
    return rows


def _summary(rows: list[dict[str, dict[str, float]]]) -> dict[str, Any]:
    """Return means over data sets, by way and hyperparameter."""
    found: dict[str, Any] = {}
    for key in rows[0]:
        cells = [row[key] for row in rows]
        means = {name: float(np.mean([cell[name] for cell in cells])) for name in cells[0]}
        found[key] = {**means, "data sets": len(rows)}
    return found


if __name__ == "__main__":
    main()
