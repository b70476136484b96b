"""How sure are the tails? Coverage of quantiles of a population under a wrong family and a wider one.

Inputs of N specimens come from a population with mean 0 and standard deviation 1. They are
calibrated as normal and as sinh-arcsinh (`prb.families.SinhArcsinh`), with exact readings of
y = x, or through a fold, y = (x - 1.5)^2. Counted are the 89 % intervals of the quantiles of the
population that contain the true ones. Forty data sets, with the seeds 40 k, 40 k + 1, ..., are the
products of one fleet, so that a posterior takes a tenth of a second.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.tails [--cells "gamma/*"]
"""

from __future__ import annotations

import time
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
from scipy import stats
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri

import prbayes as prb
from benchmarks.study import Study

PROBABILITIES = np.array([0.01, 0.05, 0.5, 0.95, 0.99])
PRODUCTS = 40
# Populations of SciPy, which are moved and scaled; and a mixture of two normals.
TRUTHS: dict[str, Any] = {
    "normal": stats.norm(),
    "gamma": stats.gamma(4),  # skewness 1
    "lognormal": stats.lognorm(0.3142),  # skewness 1
    "Student t": stats.t(5),
    "two modes": None,
}
DISTANCE, SPREAD = 1.2, 0.6  # the modes' distance from the middle, and their standard deviation
RESPONSES: dict[str, Any] = {"y = x": lambda x: x, "fold": lambda x: (x - 1.5) ** 2}
CELLS = [f"{truth}/{n}/y = x" for truth in TRUTHS for n in (20, 50)]
CELLS += ["gamma/50/fold"]


def drawn(truth: str, n: int, seed: int) -> Any:
    """Return inputs of n specimens, with mean 0 and standard deviation 1 in the population."""
    rng = np.random.default_rng(seed)
    if truth == "two modes":
        x = rng.normal(size=n) * SPREAD + rng.choice([-DISTANCE, DISTANCE], n)
        return x / np.hypot(DISTANCE, SPREAD)
    family = TRUTHS[truth]
    return (family.rvs(n, random_state=rng) - family.mean()) / family.std()


@cache
def quantiles(truth: str) -> Any:
    """Return the true quantiles."""
    if truth != "two modes":
        family = TRUTHS[truth]
        return (family.ppf(PROBABILITIES) - family.mean()) / family.std()

    def excess(x: float, p: float) -> float:
        return float(np.mean(ndtr((x + np.array([-DISTANCE, DISTANCE])) / SPREAD)) - p)

    roots = [brentq(excess, -9, 9, (p,)) for p in PROBABILITIES]
    return np.array(roots) / np.hypot(DISTANCE, SPREAD)


def model_of(family: str, response: Any, observed: Any) -> pm.Model:
    """Return the model of one data set."""
    with pm.Model() as model:
        mu, s = pm.Normal("mu", 0, 1), pm.LogNormal("s", 0, 1)
        if family == "normal":
            x = pm.Normal.dist(mu, s)
        else:
            x = prb.families.SinhArcsinh.dist(mu, s, name="x")
        prb.Simulator("y", response, x, observed=observed)
    return model


def row(cell: str, number: int) -> dict[str, Any]:
    """Return hits, widths and errors of the intervals of each quantile, summed over data sets."""
    truth, n, response = cell.split("/")
    function = RESPONSES[response]
    seeds = range(PRODUCTS * number, PRODUCTS * (number + 1))
    data = {str(seed): function(drawn(truth, int(n), seed)) for seed in seeds}
    result: dict[str, Any] = {}
    for family in ("normal", "sinh-arcsinh"):
        start = time.process_time()
        model = model_of(family, function, data[str(seeds[0])])
        tree = prb.calibrate_each(data, model=model, progressbar=False)
        draws = tree["posterior"].to_dataset()
        mu, s = (draws[name].values[0, ..., None] for name in ("mu", "s"))
        scores = ndtri(PROBABILITIES)
        if family == "sinh-arcsinh":
            skew, tail = (draws[name].values[0, ..., None] for name in ("x_skew", "x_tail"))
            scores = tail * np.sinh((np.arcsinh(scores) + skew) / tail)
        low, middle, high = np.quantile(mu + s * scores, [0.055, 0.5, 0.945], axis=0)
        exact = quantiles(truth)
        result[family] = {
            "hits": ((low <= exact) & (exact <= high)).sum(axis=0).tolist(),
            "width": (high - low).sum(axis=0).round(4).tolist(),
            "error": (middle - exact).sum(axis=0).round(4).tolist(),
            "failed": int(np.isnan(low[:, 0]).sum()),
            "cpu_seconds": round(time.process_time() - start, 1),
        }
    return result


def summary(rows: list[Any]) -> dict[str, Any]:
    """Return coverage, mean widths and mean errors by family, and the ratio of the widths."""
    count = PRODUCTS * len(rows)
    figures: dict[str, Any] = {"data sets": count}
    for family in ("normal", "sinh-arcsinh"):
        of_family = [r[family] for r in rows]
        figures[family] = {
            key: (np.sum([r[key] for r in of_family], axis=0) / count).round(4).tolist()
            for key in ("hits", "width", "error", "failed")
        }
        figures[family]["cpu_seconds"] = sum(r["cpu_seconds"] for r in of_family)
    widths = [np.array(figures[family]["width"]) for family in ("sinh-arcsinh", "normal")]
    figures["ratio"] = (widths[0] / widths[1]).round(3).tolist()
    return figures


STUDY = Study("tails", __doc__ or "", CELLS, row, 10, summary, block=5)

if __name__ == "__main__":
    STUDY.main()
