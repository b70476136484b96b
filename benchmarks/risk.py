"""Small probabilities and p-boxes beside the truth.

*Errors* of exceedance probabilities of 1e-3, 1e-4 and 1e-5 over many seeds, from stored responses and
from 1000 importance points: relative to the truth, and in units of the stated error. The responses are
a normal input, the product of three lognormal inputs, and the sum of ten normal inputs. The posterior
is given, so that the truth is known.

*Coverage*: data sets of 50 specimens, each calibrated by `minimize` and `sample_smc` from 512 runs;
how often the 90% bands of `p_box` contain the true distribution function, of the response and of
another one, and the interval of `exceedance` its probability of 1e-3. Beside that the same bands of
the exact posterior under the right Haar prior, on the same data sets.

    uv run python -m benchmarks.risk --cells coverage
    uv run python -m benchmarks.risk --cells "errors*" --data-sets 50
"""

from __future__ import annotations

from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri

import prbayes as prb
from benchmarks.study import Study
from prbayes._stats import envelope

DRAWS = 200
PROBABILITIES = (1e-3, 1e-4, 1e-5)
COUNTS = {"one normal input": 1, "product of three": 3, "sum of ten": 10}
TRUE_MU, TRUE_SIGMA, N = 1.0, 0.5, 50
EVEN = np.linspace(0.05, 0.95, 19)  # of the true distribution function, for pointwise bands


def line(x: Any) -> Any:
    return x


def product3(a: Any, b: Any, c: Any) -> Any:
    return a * b * c


def sum10(x: Any) -> Any:
    return x.sum(axis=-1)


def later(x: Any) -> Any:
    return np.exp(x)


@cache
def populations() -> tuple[Any, Any]:
    """Return means and standard deviations of populations, which are the posterior."""
    rng = np.random.default_rng(0)
    mu = rng.normal(0, 0.05, DRAWS)
    return mu, 0.5 * np.exp(rng.normal(0, 0.05, DRAWS))


def problem(name: str, seed: int) -> tuple[Any, ...]:
    """Return model, response and inputs."""
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 0, 0.2), pm.LogNormal("sigma", np.log(0.5), 0.2)
        response: Any
        if name == "one normal input":
            response, inputs = line, [pm.Normal.dist(mu, sigma)]
        elif name == "product of three":
            response = product3
            inputs = [pm.LogNormal.dist(mu, sigma) for _ in range(3)]
        else:
            response, inputs = sum10, [pm.Normal.dist(mu * np.ones(10), sigma)]
        observed = np.random.default_rng(0).normal(size=50)
        if name == "product of three":
            observed = np.exp(observed)
        stored = prb.Reweighted(64 if name == "sum of ten" else 1024, random_seed=seed)
        metric = prb.AreaMetric()
        prb.Simulator("y", response, *inputs, metric=metric, observed=observed, propagation=stored)
    return model, response, inputs


@cache
def limit_of(name: str, p: float) -> float:
    """Return what a mixture of normal populations exceeds with a probability."""
    mu, sigma = populations()
    mean, sd = COUNTS[name] * mu, np.sqrt(COUNTS[name]) * sigma
    limit = brentq(lambda x: ndtr((mean - x) / sd).mean() - p, 0.0, 100.0, xtol=1e-14)
    return float(np.exp(limit)) if name == "product of three" else float(limit)


def errors(name: str, seed: int) -> dict[str, list[float]]:
    """Return true and estimated probabilities and stated errors, by probability and points."""
    columns = {
        key: (("chain", "draw"), v[None])
        for key, v in zip(("mu", "sigma"), populations(), strict=True)
    }
    draws = xr.Dataset(columns, coords={"chain": [0], "draw": range(DRAWS)})
    posterior = xr.DataTree.from_dict({"posterior": draws})
    model, response, inputs = problem(name, seed)
    # Ten inputs are many for stored responses.
    ways = (1000,) if name == "sum of ten" else (0, 1000)
    row = {}
    for p, points in product(PROBABILITIES, ways):
        table = prb.exceedance(
            posterior, response, limit_of(name, p), *inputs,
            model=model, n_points=points, n_draws=DRAWS, random_seed=seed,
        )  # fmt: skip
        row[f"{p:g}/{points} points"] = [p, float(table.probability), float(table.error)]
    return row


def coverage(seed: int) -> dict[str, float]:
    """Return whether bands and intervals contain the truth; of pointwise bands the share."""
    data = np.random.default_rng(seed).normal(TRUE_MU, TRUE_SIGMA, N)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 2))
        metric, stored = prb.ProbabilityResidual(), prb.Reweighted(512)
        prb.Simulator("y", line, x, metric=metric, observed=data, propagation=stored)
    optimum = prb.minimize(model)
    posterior = prb.sample_smc(500, chains=2, model=model, optimum=optimum, random_seed=seed)
    row: dict[str, float] = {}
    for name, response, back in (("response", line, line), ("another", later, np.log)):
        box = prb.decision.p_box(posterior, response, x, model=model, prob=0.9)
        truth = ndtr((back(box.y.values) - TRUE_MU) / TRUE_SIGMA)
        inside = (box.lower <= truth) & (truth <= box.upper)
        pointwise = inside.sel(band="pointwise")
        row[f"{name}/simultaneous"] = bool(inside.sel(band="simultaneous").all())
        row[f"{name}/pointwise, entirely"] = bool(pointwise.all())
        # At each place by itself, on average over even steps of the true distribution.
        even = np.interp(EVEN, truth, np.arange(truth.size)).astype(int)
        row[f"{name}/pointwise"] = float(pointwise.values[even].mean())
    limit = TRUE_MU + TRUE_SIGMA * ndtri(1 - 1e-3)
    table = prb.exceedance(posterior, line, limit, x, model=model, prob=0.9)
    row["probability of 1e-3"] = bool(table.lower <= 1e-3 <= table.upper)
    return row | exact(data, seed)


def exact(data: Any, seed: int) -> dict[str, float]:
    """Return the same of bands of the exact posterior."""
    rng = np.random.default_rng([seed, 1])
    sigma = data.std(ddof=1) * np.sqrt((N - 1) / rng.chisquare(N - 1, (999, 1)))
    mu = data.mean() + sigma / np.sqrt(N) * rng.normal(size=(999, 1))
    y = data.mean() + data.std(ddof=1) * ndtri(np.linspace(3e-4, 1 - 3e-4, 150))
    truth = ndtr((y - TRUE_MU) / TRUE_SIGMA)
    functions = ndtr((y - mu) / sigma)
    low, high = envelope(functions, 0.1)
    simultaneous = bool(((low <= truth) & (truth <= high)).all())
    low, high = np.quantile(functions, [0.05, 0.95], axis=0)
    inside = ((low <= truth) & (truth <= high)).astype(float)
    pointwise = float(np.interp(EVEN, truth, inside).mean())
    return {"exact/simultaneous": simultaneous, "exact/pointwise": pointwise}


def row(cell: str, seed: int) -> dict[str, Any]:
    """Return the row of a seed."""
    return coverage(seed) if cell == "coverage" else errors(cell.removeprefix("errors/"), seed)


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return shares of intervals with the truth, or errors of probabilities."""
    figures: dict[str, Any] = {"data sets": len(rows)}
    for key in rows[0]:
        columns = np.array([row[key] for row in rows], dtype=float).T
        if columns.ndim == 1:
            figures[key] = float(columns.mean())
            continue
        truth, values, stated = columns
        figures[key] = {
            "rms": np.sqrt(np.mean((values / truth - 1) ** 2)),
            "stated": np.median(stated / truth),
            "within 2": np.mean(np.abs(values - truth) < 2 * stated),
        }
    return figures


CELLS = [*(f"errors/{name}" for name in COUNTS), "coverage"]
STUDY = Study("risk", __doc__, CELLS, row, 600, summary, has_rows=False)

if __name__ == "__main__":
    STUDY.main()
