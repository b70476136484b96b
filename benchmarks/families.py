"""Normal or lognormal: how often the right family is told from cross-validated scores, and whether their error is right.

The input's truth is normal or lognormal, with mean 1 and a coefficient of variation; N responses
are calibrated as both families with a metric, and `prb.rank` says which
predicts better. Counted are the data sets in which it names the right family, says that it cannot
tell, and names the wrong one. z is the difference between right and wrong family, less its mean
over all data sets, in units of the standard error that is stated: its standard deviation is one
where that is honest.

One design serves all data sets of a case, and the minimisations of the folds start at the long-run
optimum, so that a data set takes a tenth of a second. Cases that the file has are not computed again.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.families [--replicates 50] [--processes 2]
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks import record
from benchmarks.metrics import BY_NAME

FAMILIES = ("normal", "lognormal")
VARIATIONS = (0.1, 0.3, 0.6)
SIZES = (20, 50, 200)
METRICS = ("KullbackLeibler", "ProbabilityResidual", "LogLikelihood")
LINEAR, NONLINEAR = "1 + 2 x", "exp(x)"
RESPONSES: dict[str, Callable[[Any], Any]] = {LINEAR: lambda x: 1 + 2 * x, NONLINEAR: np.exp}
# Divergence everywhere; the other metrics, and the other response, in the middle.
CASES = [(LINEAR, METRICS[0], truth, cv) for cv, truth in product(VARIATIONS, FAMILIES)]
CASES += [(LINEAR, metric, truth, 0.3) for metric, truth in product(METRICS[1:], FAMILIES)]
CASES += [(NONLINEAR, METRICS[0], truth, 0.3) for truth in FAMILIES]
LONG_RUN = 2000  # data that stand for all, from whose optimum minimisations start


def drawn(truth: str, variation: float, n: int, rng: np.random.Generator) -> Any:
    """Return inputs of specimens."""
    if truth == "normal":
        return rng.normal(1.0, variation, n)
    variance = np.log1p(variation**2)
    return rng.lognormal(-variance / 2, np.sqrt(variance), n)


def calibrated(family: str, response: str, metric: str, data: Any) -> prb.Optimum:
    """Return the optimum of a family."""
    with pm.Model():
        mean = pm.TruncatedNormal("mean", 1.0, 0.5, lower=0.1)
        sd = pm.HalfNormal("sd", 0.7)
        x = pm.Normal.dist(mean, sd)
        if family == "lognormal":
            variance = pm.math.log1p((sd / mean) ** 2)
            x = pm.LogNormal.dist(pm.math.log(mean) - variance / 2, pm.math.sqrt(variance))
        prb.Simulator(
            "y", RESPONSES[response], x, metric=BY_NAME[metric], observed=data,
            propagation=prb.Reweighted(512), progressbar=False,
        )  # fmt: skip
        return prb.minimize(progressbar=False)


def case(chosen: tuple[str, str, str, float], replicates: int) -> list[dict[str, Any]]:
    """Return the rows of one case, one for each number of data."""
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    response, metric, truth, variation = chosen
    compute = RESPONSES[response]
    long_run = compute(drawn(truth, variation, LONG_RUN, np.random.default_rng(1)))
    optima = {family: calibrated(family, response, metric, long_run) for family in FAMILIES}
    rows = []
    for n in SIZES:
        found = []
        for i in range(replicates):
            data = compute(drawn(truth, variation, n, np.random.default_rng([11, n, i])))
            found.append(compared(optima, data, truth))
        rows.append(summary(found) | dict(zip(KEYS, (*chosen, n), strict=True)))
    return rows


KEYS = ("response", "metric", "truth", "cv", "n")


def compared(optima: dict[str, prb.Optimum], data: Any, truth: str) -> tuple[float, float, bool]:
    """Return by how much the right family is ahead, the standard error, and whether it is told."""
    anew = {
        family: replace(
            one,
            evaluator=one.evaluator.observing({"y": data}),
            search=replace(one.search, identity=None),
        )
        for family, one in optima.items()
    }
    table = prb.rank(anew, progressbar=False)
    sign = 1.0 if table.candidate.values[0] == truth else -1.0
    other = table.isel(candidate=1)
    return sign * float(other["difference"]), float(other["stderr"]), bool(other["significant"])


def summary(found: list[tuple[float, float, bool]]) -> dict[str, Any]:
    """Return what all data sets of a cell say together."""
    difference, error, told = (np.array(column) for column in zip(*found, strict=True))
    z = (difference - difference.mean()) / error
    return {
        "right": float((told & (difference > 0)).mean()),
        "wrong": float((told & (difference < 0)).mean()),
        "difference": float(difference.mean()),
        "stderr": float(error.mean()),
        "z_sd": float(z.std(ddof=1)),
        "replicates": len(found),
    }


def main() -> None:
    """Calibrate and compare; print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--replicates", type=int, default=50)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=record.RESULTS / "families.json")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = record.load(arguments.out, {"rows": []})["rows"]
    done = {tuple(row[key] for key in KEYS[:4]) for row in rows}
    left = [chosen for chosen in CASES if chosen not in done]
    print(f"{'response':9s} {'metric':20s} {'truth':10s} {'cv':>4s} {'N':>4s} {'right':>6s} {'wrong':>6s} "
          f"{'ahead':>7s} {'se':>6s} {'sd of z':>8s}")  # fmt: skip
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        for some in pool.map(case, left, [arguments.replicates] * len(left)):
            for row in some:
                print(f"{row['response']:9s} {row['metric']:20s} {row['truth']:10s} {row['cv']:4.1f} {row['n']:4d} "
                      f"{row['right']:6.2f} {row['wrong']:6.2f} {row['difference']:7.2f} {row['stderr']:6.2f} "
                      f"{row['z_sd']:8.2f}", flush=True)  # fmt: skip
            rows += some
            record.save(arguments.out, {"rows": rows})  # a later run goes on from here


if __name__ == "__main__":
    main()
