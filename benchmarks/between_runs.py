"""Is a population that is emulated between runs ever worse than the runs' own weights?

Twelve responses, smooth and not (`benchmarks.responses`), each with a mean and a standard deviation
for every input; priors of means are one population standard deviation wide, of standard deviations
a factor of 1.35. The same runs are weighted alone (``emulator=None``) and with an emulator
(``emulator="auto"``) to the populations of 16 thetas around the truth, scattered as posteriors of 50
specimens are. The error is the root mean square of their distribution functions at 31 quantiles, over
outputs, thetas and designs, in units of the sampling noise of 50 data; the reference is 65 536
responses of each population. One input has no emulator: the runs are a quadrature rule.

    uv run python -m benchmarks.between_runs [--data-sets 8]
"""

from __future__ import annotations

from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pymc as pm
from scipy.stats import norm, qmc

import prbayes as prb
from benchmarks.responses import RESPONSES, Response
from benchmarks.study import Study
from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import unconstrained

LEVELS = (np.arange(31) + 0.5) / 31
THETAS = 16
DATA = 50  # whose sampling noise is the unit, and whose posterior the thetas are scattered as


def design_of(response: Response, n: int, seed: int, emulator: Any) -> Evaluator:
    """Return an evaluator of a model of normal inputs, with its design."""
    x = response.mean + response.sd * np.random.default_rng(1).standard_normal((DATA, response.d))
    observed = response(x)
    observed = observed[~np.isnan(observed).any(axis=1)]
    with pm.Model() as model:
        inputs = []
        for i, (mean, sd) in enumerate(zip(response.mean, response.sd, strict=True)):
            mu = pm.Normal(f"mu{i}", mean, sd)
            sigma = pm.LogNormal(f"sigma{i}", np.log(sd), 0.3)
            inputs.append(pm.Normal.dist(mu, sigma))
        prb.Simulator(
            "y", response.of_columns, *inputs, metric=prb.Joint(prb.ProbabilityResidual()),
            observed=observed, propagation=prb.Reweighted(n, emulator=emulator, random_seed=seed),
        )  # fmt: skip
    return Evaluator.of(model)


def populations(response: Response) -> list[tuple[Any, Any]]:
    """Return means and standard deviations of inputs, scattered as a posterior is."""
    rng = np.random.default_rng(2)
    z = rng.standard_normal((THETAS, 2, response.d))
    means = response.mean + response.sd * z[:, 0] / np.sqrt(DATA)
    sds = response.sd * np.exp(z[:, 1] / np.sqrt(2 * DATA))
    return list(zip(means, sds, strict=True))


@cache
def truths(name: str) -> list[Any]:
    """Return quantiles of each population's outputs, (levels, m), those that are NaN left out."""
    response = RESPONSES[name]
    uniforms = qmc.Sobol(response.d, rng=np.random.default_rng(3)).random(65_536)
    z = norm.ppf(np.clip(uniforms, 1e-9, 1 - 1e-9))
    quantiles = []
    for mean, sd in populations(response):
        y = response(mean + sd * z)
        y = np.sort(y[~np.isnan(y).any(axis=1)], axis=0)
        quantiles.append(y[(LEVELS * len(y)).astype(int)])
    return quantiles


def off(evaluator: Evaluator, name: str) -> float:
    """Return the mean square error of distribution functions, in sampling noise."""
    response = RESPONSES[name]
    noise = np.sqrt(LEVELS * (1 - LEVELS) / DATA)
    thetas = []
    for mean, sd in populations(response):
        values: dict[str, Any] = {}
        for i in range(response.d):
            values |= {f"mu{i}": mean[i], f"sigma{i}": sd[i]}
        thetas.append(unconstrained(evaluator.hyperparameters, values))
    simulated, weights = evaluator.populations(np.array(thetas), 0)
    squares = []
    for y, w, quantiles in zip(simulated, weights, truths(name), strict=True):
        has = ~np.isnan(y).any(axis=1)
        share = w[has] / w[has].sum()
        for output in range(response.outputs):
            at = quantiles[:, output]
            counted = np.isfinite(at) & (np.diff(at, prepend=-np.inf) > 0)  # no atoms
            below = (y[has, output][:, None] <= at[counted]).T @ share
            squares.append((((below - LEVELS[counted]) / noise[counted]) ** 2).mean())
    return float(np.mean(squares))


def row(cell: str, seed: int) -> dict[str, float]:
    """Return the mean square errors of both."""
    name, n = cell.split("/")
    ways = {"alone": None, "emulated": "auto"}
    return {
        way: off(design_of(RESPONSES[name], int(n), seed, emulator), name)
        for way, emulator in ways.items()
    }


def summary(rows: list[dict[str, float]]) -> dict[str, float]:
    """Return the errors and their ratio."""
    rms = {key: float(np.sqrt(np.mean([row[key] for row in rows]))) for key in rows[0]}
    return rms | {"ratio": rms["emulated"] / rms["alone"]}


CELLS = [f"{name}/{n}" for name, n in product(RESPONSES, (64, 256))]
STUDY = Study("between_runs", __doc__, CELLS, row, 8, summary, has_rows=False)

if __name__ == "__main__":
    STUDY.main()
