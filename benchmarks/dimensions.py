"""How many responses a design takes when the population of 1 to 8 inputs is unknown, and how exact it then is.

The response is the root of the mean square of d inputs, all normal with the same unknown mean and
standard deviation; N = 50. Reweighted(n) grows until another design's optimum would be within a
tenth of a standard error, or says that it does not get there: from 1024 runs that stand alone, and
from 32 for each input, at least 64, between which responses are emulated. Resimulated(65 536) is the
reference for the minimiser.

Run: uv run python -m benchmarks.dimensions [--seeds 2]
"""

from __future__ import annotations

import argparse
import logging
import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks import record

HOW = ("alone", "emulated")
METRICS = {"PR": prb.ProbabilityResidual(), "KLD": prb.KullbackLeibler(), "area": prb.AreaMetric()}


def response(*x: Any) -> Any:
    """Return the root of the mean square."""
    return sum(v**2 for v in x) ** 0.5 / len(x) ** 0.5


def build(d: int, n: int, metric: prb.Metric, observed: Any, propagation: Any) -> pm.Model:
    """Return a model with d inputs, two hyperparameters."""
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 3.0, 1.0), pm.HalfNormal("sigma", 1.0)
        inputs = [pm.Normal.dist(mu, sigma) for _ in range(d)]
        prb.Simulator(
            "y", response, *inputs, metric=metric, observed=observed, propagation=propagation(n)
        )
    return model


def case(d: int, how: str, metric: str, seed: int) -> dict[str, Any]:
    """Calibrate once under Reweighted and once under Resimulated."""
    alone = how == "alone"

    def design(n: int) -> prb.Reweighted:
        return prb.Reweighted(n, emulator=None if alone else "auto")

    rng = np.random.default_rng([seed, d])
    observed = response(*rng.normal(3.0, 0.5, (d, 50)))
    clock = time.perf_counter()
    try:
        optimum = prb.minimize(
            build(d, 1024 if alone else max(64, 32 * d), METRICS[metric], observed, design),
            progressbar=False,
        )
    except prb.propagation.DesignError as error:
        return {"refused": str(error)[:200], "seconds": time.perf_counter() - clock}
    seconds = time.perf_counter() - clock
    reference = prb.minimize(
        build(d, 65_536, METRICS[metric], observed, prb.Resimulated),
        start=optimum.point,
        progressbar=False,
    )
    off = max(
        abs(optimum.point[k] - reference.point[k]) / reference.stderr[k] for k in reference.point
    )
    return {
        "responses": optimum.n_responses,
        "design_error": float(optimum.design_error),
        "off": float(off),
        "seconds": seconds,
    }


def main() -> None:
    """Print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--out", type=Path, default=record.RESULTS / "dimensions.json")
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    table: dict[str, Any] = {}
    print(
        f"{'inputs':>6s} {'metric':>6s} {'runs':>8s}  number, distance from the reference in standard errors, by data set"
    )
    for d in (1, 2, 3, 4, 6, 8):
        for metric, how in product(METRICS, HOW):
            if (d, how) == (1, "emulated"):
                continue
            rows = [case(d, how, metric, seed) for seed in range(arguments.seeds)]
            table[f"{d}/{metric}/{how}"] = rows
            cells = [
                f"{r['responses']} ({r['off']:.2f})" if "off" in r else "refused" for r in rows
            ]
            print(f"{d:6d} {metric:>6s} {how:>8s}  " + "   ".join(cells), flush=True)
            record.save(arguments.out, table)


if __name__ == "__main__":
    main()
