"""The spread of an input where readings have an error: ignored, known, and estimated from repeats.

Responses are lognormal, of one input with mean 0 and standard deviation .3; readings of 50 specimens
have a normal error with standard deviation .25. 200 data sets, each calibrated by `minimize` and
`sample_smc` in three ways: without the error, with it as another input of known spread, and with a
prior of that spread from 20 differences of repeats. How often 89% intervals hold the truth. The
command goes on after the data sets that its file has.

    uv run python -m benchmarks.measurement_error [--data-sets 200]
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
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    found = record.load(arguments.out, {})
    done = min((cell["data sets"] for cell in found.values()), default=0)
    for seed in range(done, arguments.data_sets):
        for key, row in _of_one(seed).items():
            found[key] = _with(found.get(key), row)
        record.save(arguments.out, found)
        if seed % 20 == 19:
            print(seed + 1, found, flush=True)


def _of_one(seed: int) -> dict[str, dict[str, float]]:
    """Return what each way finds of one data set."""
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
            rows[f"{way}/{name}"] = {"mean": values.mean(), "sd": values.std(), "held": held}
    return rows


def _with(before: dict[str, float] | None, row: dict[str, float]) -> dict[str, float]:
    """Return means over one data set more."""
    if before is None:
        return {**row, "data sets": 1}
    n = before["data sets"]
    joined = {key: (n * before[key] + value) / (n + 1) for key, value in row.items()}
    return {**joined, "data sets": n + 1}


if __name__ == "__main__":
    main()
