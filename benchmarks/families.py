"""Normal or lognormal: how often cross-validated scores identify the right family, and whether their error is right.

The input's truth is normal or lognormal, with mean 1 and a coefficient of variation; N responses
are calibrated as both families with a metric, and `prb.rank` says which predicts better. Counted are
the data sets in which it names the right family, no significant difference, and the wrong one. z is
the difference between right and wrong family, less its mean over all data sets, in units of the
stated standard error: its standard deviation is one if that error is right.

One design serves all data sets of a case, and the minimisations of the folds start at the optimum of
many data, so that a data set takes a tenth of a second.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.families [--data-sets 50]
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks.metrics import METRICS
from benchmarks.study import Study

FAMILIES = ("normal", "lognormal")
SIZES = (20, 50, 200)
LINEAR, NONLINEAR = "1 + 2 x", "exp(x)"
RESPONSES: dict[str, Callable[[Any], Any]] = {LINEAR: lambda x: 1 + 2 * x, NONLINEAR: np.exp}
# The divergence everywhere; the other metrics, and the other response, in the middle.
CASES = [(LINEAR, "KLD", truth, cv) for cv, truth in product((0.1, 0.3, 0.6), FAMILIES)]
CASES += [(LINEAR, m, truth, 0.3) for m, truth in product(("PR", "log-likelihood"), FAMILIES)]
CASES += [(NONLINEAR, "KLD", truth, 0.3) for truth in FAMILIES]
MANY = 2000  # data from whose optimum minimisations start


def name_of(response: str, metric: str, truth: str, cv: float, n: int) -> str:
    """Return the name of a cell."""
    return f"{response}/{metric}/{truth}/{cv}/{n}"


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
            "y", RESPONSES[response], x, metric=METRICS[metric], observed=data,
            propagation=prb.Reweighted(512),
        )  # fmt: skip
        return prb.minimize()


@cache
def optima(response: str, metric: str, truth: str, variation: float) -> dict[str, prb.Optimum]:
    """Return the optimum of each family from many data."""
    data = RESPONSES[response](drawn(truth, variation, MANY, np.random.default_rng(1)))
    return {family: calibrated(family, response, metric, data) for family in FAMILIES}


def row(cell: str, number: int) -> tuple[float, float, bool]:
    """Return by how much the right family is ahead, the standard error, and its significance."""
    response, metric, truth, variation, n = cell.split("/")
    rng = np.random.default_rng([11, int(n), number])
    data = RESPONSES[response](drawn(truth, float(variation), int(n), rng))
    calibrated_again = {
        family: replace(
            optimum,
            evaluator=optimum.evaluator.observing({"y": data}),
            search=replace(optimum.search, identity=None),
        )
        for family, optimum in optima(response, metric, truth, float(variation)).items()
    }
    table = prb.rank(calibrated_again, progressbar=False)
    sign = 1.0 if table.candidate.values[0] == truth else -1.0
    other = table.isel(candidate=1)
    return sign * float(other["difference"]), float(other["stderr"]), bool(other["significant"])


def summary(rows: list[Any]) -> dict[str, Any]:
    """Return shares of identified families, and the standard deviation of z."""
    difference, error, significant = (np.array(column) for column in zip(*rows, strict=True))
    z = (difference - difference.mean()) / error
    return {
        "right": float((significant & (difference > 0)).mean()),
        "wrong": float((significant & (difference < 0)).mean()),
        "difference": float(difference.mean()),
        "stderr": float(error.mean()),
        "z_sd": float(z.std(ddof=1)) if len(rows) > 1 else 0.0,
        "data sets": len(rows),
    }


CELLS = [name_of(*case, n) for case, n in product(CASES, SIZES)]
STUDY = Study("families", __doc__, CELLS, row, 50, summary, has_rows=False)

if __name__ == "__main__":
    STUDY.main()
