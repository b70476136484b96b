"""Coverage of population tables: intervals of mean, spread and quantiles, and tolerance bounds.

Specimens are normal, and the response is the input. *Reference posterior*: its draws, in closed form,
by which A- and B-basis values are the classical tolerance bounds. *sample* and *optimum*: those of
`prb.sample` and `prb.minimize` with wide priors. An interval counts if it contains the true quantity
of the population, and a tolerance bound if the true quantile is above it.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.population [--cells "sample*"]
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from scipy import stats

import prbayes as prb
from benchmarks.study import Rows, Study
from prbayes._validate import Floats

MU, SIGMA = 10.0, 1.0
TRUE = {
    "mean": MU,
    "sd": SIGMA,
    "cv": SIGMA / MU,
    "5% quantile": MU + SIGMA * stats.norm.ppf(0.05),
    "B-basis": MU + SIGMA * stats.norm.ppf(0.10),
    "A-basis": MU + SIGMA * stats.norm.ppf(0.01),
}
CELLS = [
    *("reference posterior, N = 10", "reference posterior, N = 20"),
    *("sample, N = 20", "optimum, N = 20"),
]
DRAWS = 4000


def reference(observed: Floats, rng: np.random.Generator) -> xr.DataTree:
    """Return draws of the posterior with the prior 1 / sigma."""
    n = observed.size
    sigma = observed.std(ddof=1) * np.sqrt((n - 1) / rng.chisquare(n - 1, DRAWS))
    draws = {"mu": rng.normal(observed.mean(), sigma / np.sqrt(n)), "sigma": sigma}
    data = {name: (("chain", "draw"), values[None]) for name, values in draws.items()}
    return xr.DataTree.from_dict({"posterior": xr.Dataset(data)})


def row(cell: str, number: int) -> dict[str, bool]:
    """Return which quantities are covered for a data set."""
    kind, _, size = cell.partition(", N = ")
    rng = np.random.default_rng([number, int(size)])
    observed = rng.normal(MU, SIGMA, int(size))
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", MU, 10.0), pm.HalfNormal("sigma", 5.0))
        prb.Simulator("y", np.positive, x, observed=observed)
    result: Any = reference(observed, rng) if kind == "reference posterior" else prb.minimize(model)
    if kind == "sample":
        result = prb.sample(model=model, optimum=result, random_seed=number)
    table = prb.population(result, model=model, n_draws=DRAWS).isel(name=0)
    covered = {}
    for name, value in TRUE.items():
        low, high = float(table.lower.sel(quantity=name)), float(table.upper.sel(quantity=name))
        if name.endswith("basis"):
            low, high = float(table.estimate.sel(quantity=name)), np.inf
        covered[name] = bool(low <= value <= high)
    return covered


def summary(rows: Rows) -> dict[str, float]:
    """Return the coverage of each quantity, and the number of data sets."""
    shares = {name: float(np.mean([row[name] for row in rows])) for name in TRUE}
    return {"data sets": len(rows)} | {name: round(share, 3) for name, share in shares.items()}


STUDY = Study("population", __doc__ or "", CELLS, row, data_sets=200, summary=summary)

if __name__ == "__main__":
    STUDY.main()
