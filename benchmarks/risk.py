"""Small probabilities and p-boxes beside the truth.

Errors: exceedance probabilities of 1e-3, 1e-4 and 1e-5, over many seeds, from stored responses and from
1000 importance points: how far they are off, and in units of the error that is stated. Of a normal
response of one input, of the product of three lognormal inputs, and of the sum of ten normal inputs.
The posterior is given, so that the truth is known.

Coverage: data sets of 50 specimens, each calibrated by `minimize` and `sample_smc` from 512 runs;
in how many the 90% bands of `p_box` hold the true distribution function, of the response and of
another one, and the interval of `exceedance` its probability of 1e-3. Beside that the same bands of
the exact posterior under the right Haar prior, on the same data sets and on 2000.

    uv run python -m benchmarks.risk [--parts errors coverage exact] [--data-sets 600]
"""

from __future__ import annotations

import argparse
import logging
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from scipy.special import ndtr, ndtri

import prbayes as prb
from benchmarks import record
from prbayes._stats import envelope

OUT = record.RESULTS / "risk.json"
DRAWS = 200
PROBABILITIES = (1e-3, 1e-4, 1e-5)
COUNTS = {"one normal input": 1, "product of three": 3, "sum of ten": 10}
TRUE_MU, TRUE_SIGMA = 1.0, 0.5


def line(x: Any) -> Any:
    return x


def product3(a: Any, b: Any, c: Any) -> Any:
    return a * b * c


def sum10(x: Any) -> Any:
    return x.sum(axis=-1)


def draws_of(mu: Any, sigma: Any) -> xr.DataTree:
    """Return populations as a posterior."""
    columns = {"mu": ("chain", "draw"), "sigma": ("chain", "draw")}
    group = xr.Dataset(
        {
            name: (dims, values[None])
            for (name, dims), values in zip(columns.items(), (mu, sigma), strict=True)
        },
        coords={"chain": [0], "draw": range(mu.size)},
    )
    return xr.DataTree.from_dict({"posterior": group})


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
        prb.Simulator(
            *("y", response, *inputs),
            metric=prb.AreaMetric(),
            observed=np.exp(observed) if name == "product of three" else observed,
            propagation=prb.Reweighted(64 if name == "sum of ten" else 1024, random_seed=seed),
            progressbar=False,
        )
    return model, response, inputs


def errors(repetitions: int) -> dict[str, Any]:
    """Return the errors of small probabilities."""
    rng = np.random.default_rng(0)
    mu = rng.normal(0, 0.05, DRAWS)
    sigma = 0.5 * np.exp(rng.normal(0, 0.05, DRAWS))
    posterior = draws_of(mu, sigma)
    found: dict[str, Any] = {}
    for name, count in COUNTS.items():
        limits = {p: limit_of(p, count * mu, np.sqrt(count) * sigma) for p in PROBABILITIES}
        cells: dict[str, list[Any]] = {}
        for seed in range(repetitions):
            model, response, inputs = problem(name, seed)
            # Ten inputs are many for stored responses.
            ways = (1000,) if name == "sum of ten" else (0, 1000)
            for p, points in product(PROBABILITIES, ways):
                limit = np.exp(limits[p]) if name == "product of three" else limits[p]
                table = prb.exceedance(
                    *(posterior, response, limit, *inputs),
                    model=model,
                    points=points,
                    n_draws=DRAWS,
                    random_seed=seed,
                )
                row = [p, float(table.probability), float(table.error)]
                cells.setdefault(f"{name}/{p:g}/{points} points", []).append(row)
        for key, rows in cells.items():
            truth, values, stated = np.array(rows).T
            off = values / truth - 1
            found[key] = {
                "mean": 1 + off.mean(),
                "rms": np.sqrt(np.mean(off**2)),
                "stated": np.median(stated / truth),
                "within 2": np.mean(np.abs(values - truth) < 2 * stated),
                "repetitions": len(rows),
            }
            print(key, {name: round(float(x), 3) for name, x in found[key].items()}, flush=True)
    return found


def limit_of(p: float, mean: Any, sd: Any) -> float:
    """Return what a mixture of normal populations exceeds with a probability, by bisection."""
    low, high = 0.0, 100.0
    for _ in range(80):
        middle = (low + high) / 2
        if ndtr((mean - middle) / sd).mean() > p:
            low = middle
        else:
            high = middle
    return low


def later(x: Any) -> Any:
    return np.exp(x)


def coverage(data_sets: int) -> dict[str, Any]:
    """Return how often bands and intervals hold the truth."""
    held: dict[str, list[float]] = {}
    limit = TRUE_MU + TRUE_SIGMA * ndtri(1 - 1e-3)
    for seed in range(data_sets):
        data = np.random.default_rng(seed).normal(TRUE_MU, TRUE_SIGMA, 50)
        with pm.Model() as model:
            x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 2))
            prb.Simulator(
                *("y", line, x),
                metric=prb.ProbabilityResidual(),
                observed=data,
                propagation=prb.Reweighted(512),
                progressbar=False,
            )
        optimum = prb.minimize(model, progressbar=False)
        posterior = prb.sample_smc(
            500, chains=2, model=model, optimum=optimum, random_seed=seed, progressbar=False
        )
        for name, response, back in (("response", line, line), ("another", later, np.log)):
            box = prb.decision.p_box(posterior, response, x, model=model, prob=0.9)
            truth = ndtr((back(box.y.values) - TRUE_MU) / TRUE_SIGMA)
            inside = (box.lower <= truth) & (truth <= box.upper)
            held.setdefault(f"{name}/simultaneous", []).append(
                bool(inside.sel(band="simultaneous").all())
            )
            held.setdefault(f"{name}/pointwise, entirely", []).append(
                bool(inside.sel(band="pointwise").all())
            )
            # At each place by itself, on average over even steps of the true distribution.
            even = np.interp(np.linspace(0.05, 0.95, 19), truth, np.arange(truth.size)).astype(int)
            held.setdefault(f"{name}/pointwise", []).append(
                float(inside.sel(band="pointwise").values[even].mean())
            )
        table = prb.exceedance(posterior, line, limit, x, model=model, prob=0.9)
        held.setdefault("probability of 1e-3", []).append(bool(table.lower <= 1e-3 <= table.upper))
        if seed % 50 == 49:
            print(seed + 1, {key: np.mean(rows).round(3) for key, rows in held.items()}, flush=True)
    shares = {key: float(np.mean(rows)) for key, rows in held.items()}
    return {"data sets": data_sets, "level": 0.9, "held": shares}


def exact(sizes: tuple[int, ...]) -> dict[str, Any]:
    """Return how often the same bands hold the truth with the exact posterior of the same data."""
    held: dict[str, list[float]] = {"simultaneous": [], "pointwise": []}
    z = ndtri(np.linspace(3e-4, 1 - 3e-4, 150))
    n = 50
    for seed in range(max(sizes)):
        data = np.random.default_rng(seed).normal(TRUE_MU, TRUE_SIGMA, n)
        rng = np.random.default_rng([seed, 1])
        sigma = data.std(ddof=1) * np.sqrt((n - 1) / rng.chisquare(n - 1, (999, 1)))
        mu = data.mean() + sigma / np.sqrt(n) * rng.normal(size=(999, 1))
        y = data.mean() + data.std(ddof=1) * z
        truth = ndtr((y - TRUE_MU) / TRUE_SIGMA)
        functions = ndtr((y - mu) / sigma)
        low, high = envelope(functions, 0.1)
        held["simultaneous"].append(bool(((low <= truth) & (truth <= high)).all()))
        low, high = np.quantile(functions, [0.05, 0.95], axis=0)
        inside = ((low <= truth) & (truth <= high)).astype(float)
        held["pointwise"].append(
            float(np.interp(np.linspace(0.05, 0.95, 19), truth, inside).mean())
        )
    return {
        f"{size}": {key: float(np.mean(rows[:size])) for key, rows in held.items()}
        for size in sizes
    }


def main() -> None:
    """Compute, print and save."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", nargs="*", default=["errors", "coverage", "exact"])
    parser.add_argument("--data-sets", type=int, default=600)
    parser.add_argument("--repetitions", type=int, default=50)
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    whole = record.load(arguments.out, {})
    if "errors" in arguments.parts:
        whole["errors"] = errors(arguments.repetitions)
    if "coverage" in arguments.parts:
        whole["coverage"] = coverage(arguments.data_sets)
        print(whole["coverage"])
    if "exact" in arguments.parts:
        whole["exact"] = exact((arguments.data_sets, 2000))
        print(whole["exact"])
    record.save(arguments.out, whole)


if __name__ == "__main__":
    main()
