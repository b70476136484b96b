"""Groups of specimens beside the exact posterior: partial pooling, and small groups without pooling.

*Partial pooling*: six suppliers, twenty specimens of each; responses are normal, with a standard
deviation of .5 within a supplier and .3 between them. *Small groups*, by metric: three suppliers of
ten specimens, or of five; responses are 2 x + 1 of normal inputs, with a mean of each supplier, one
standard deviation, and wide priors, so that no group learns its mean from another. For each data set
`minimize` and `sample_smc` on one model of all groups, and the exact posterior, whose means are
integrated in closed form and spreads on a grid. Distances of means are in exact standard deviations.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.groups [--cells "partial pooling"]
"""

from __future__ import annotations

import time
from itertools import product
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

import prbayes as prb
from benchmarks.metrics import METRICS
from benchmarks.study import Study
from prbayes._validate import Floats

NAMES = ["Adler", "Busch", "Celik", "Dorn", "Eder", "Falk"]
EACH = 20
SIGMA = 0.5
POOLING = "partial pooling"
# Standard deviations of the priors of mean, spread between suppliers, and spread within one.
PRIORS = (1.0, 0.5, 1.0)
# Small groups: true means and spread, and standard deviations of their priors.
MEANS, SPREAD, WIDE = np.array([1.0, 1.3, 0.8]), 0.4, (2.0, 1.0)
_TAILS = (0.055, 0.945)


def labelled(values: Any, suppliers: Any) -> xr.DataArray:
    """Return responses with the supplier of each specimen."""
    return xr.DataArray(values, {"supplier": ("specimen", suppliers)}, "specimen")


def measured(seed: int, between: float = 0.3) -> xr.DataArray:
    """Return responses of twenty specimens of each supplier."""
    rng = np.random.default_rng(seed)
    means = rng.normal(0, between, len(NAMES))
    values = rng.normal(np.repeat(means, EACH), SIGMA)
    return labelled(values, np.repeat(NAMES, EACH))


def same(x: Any) -> Any:
    return x


def line(x: Any) -> Any:
    return 2 * x + 1


def hierarchy(observed: xr.DataArray, metric: Any = None, **given: Any) -> pm.Model:
    """Return the model of all suppliers together."""
    with pm.Model(coords={"supplier": NAMES}) as model:
        m = pm.Normal("m", 0, PRIORS[0])
        tau = pm.HalfNormal("tau", PRIORS[1])
        mu = pm.Normal("mu", m, tau, dims="supplier")
        sigma = pm.HalfNormal("sigma", PRIORS[2])
        x = pm.Normal.dist(mu[prb.response.group("supplier")], sigma, name="x")
        metric = metric or METRICS["PR"]
        prb.Simulator("y", same, x, metric=metric, observed=observed, progressbar=False, **given)
    return model


def separate(observed: xr.DataArray, metric: prb.Metric) -> pm.Model:
    """Return the model of three suppliers whose means are not pooled."""
    with pm.Model(coords={"supplier": NAMES[: len(MEANS)]}) as model:
        mu = pm.Normal("mu", 0, WIDE[0], dims="supplier")
        sigma = pm.HalfNormal("sigma", WIDE[1])
        x = pm.Normal.dist(mu[prb.response.group("supplier")], sigma, name="x")
        prb.Simulator("y", line, x, metric=metric, observed=observed)
    return model


def exact(observed: xr.DataArray) -> dict[str, Any]:
    """Return mean and standard deviation of each hyperparameter, of the normal hierarchy.

    Means of suppliers and of all are integrated in closed form, both spreads on a grid.
    """
    y = observed.values.reshape(len(NAMES), -1)
    n = np.full(len(NAMES), y.shape[1])
    bar = y.mean(axis=1)
    squares = ((y - bar[:, None]) ** 2).sum()
    freedom = y.size - len(NAMES)
    own = np.sqrt(squares / freedom)
    tau = (np.arange(300) + 0.5) / 300 * 4 * PRIORS[1]
    sigma = own * np.exp(np.linspace(-0.6, 0.6, 150))
    t, s = np.meshgrid(tau, sigma, indexing="ij")
    variance = t[..., None] ** 2 + s[..., None] ** 2 / n
    precision = 1 / PRIORS[0] ** 2 + (1 / variance).sum(-1)
    mean = (bar / variance).sum(-1) / precision
    log = -0.5 * (np.log(variance) + bar**2 / variance).sum(-1)
    log += 0.5 * (mean**2 * precision - np.log(precision))
    log -= freedom * np.log(s) + squares / (2 * s**2)
    log += np.log(s) - 0.5 * ((t / PRIORS[1]) ** 2 + (s / PRIORS[2]) ** 2)
    weight = np.exp(log - log.max())
    weight /= weight.sum()

    def moments(center: Floats, spread: Any) -> tuple[float, float]:
        first = float((weight * center).sum())
        return first, float(np.sqrt((weight * (spread + center**2)).sum() - first**2))

    kept = t[..., None] ** 2 / variance
    means = []
    for g, k in enumerate(np.moveaxis(kept, -1, 0)):
        center = mean + k * (bar[g] - mean)
        means.append(moments(center, k * s**2 / n[g] + (1 - k) ** 2 / precision))
    found = {"m": moments(mean, 1 / precision), "tau": moments(t, 0.0)}
    return {**found, "sigma": moments(s, 0.0), "mu": np.array(means)}


def exact_draws(x: Floats, rng: np.random.Generator) -> Floats:
    """Return draws of the posterior without pooling, given inputs (suppliers, n): means, spread."""
    groups, n = x.shape
    sigma = np.linspace(0.05, 3.0, 6000)
    variance = sigma[:, None] ** 2 / n
    total = variance + WIDE[0] ** 2
    squares = ((x - x.mean(axis=1, keepdims=True)) ** 2).sum()
    log = -groups * (n - 1) * np.log(sigma) - squares / (2 * sigma**2)
    log -= 0.5 * (np.log(total) + x.mean(axis=1) ** 2 / total).sum(axis=1)
    log -= 0.5 * (sigma / WIDE[1]) ** 2
    weight = np.exp(log - log.max())
    drawn = rng.choice(sigma, 20_000, p=weight / weight.sum())
    precision = n / drawn[:, None] ** 2 + 1 / WIDE[0] ** 2
    center = n / drawn[:, None] ** 2 * x.mean(axis=1) / precision
    means = rng.normal(center, 1 / np.sqrt(precision))
    return np.column_stack([means, drawn])


def posterior_of(model: pm.Model, draws: int, seed: int) -> Any:
    """Return the posterior after an optimum."""
    optimum = prb.minimize(model)
    tree = prb.sample_smc(draws, chains=2, model=model, optimum=optimum, random_seed=seed)
    return tree.posterior


def compared(draws: Floats, mean: Any, sd: Any, truth: Any) -> dict[str, list[Any]]:
    """Return distances and widths of draws (n, k), and whether 89% intervals contain the truth."""
    return {
        "shift": ((draws.mean(axis=0) - mean) / sd).tolist(),
        "ratio": (draws.std(axis=0) / sd).tolist(),
        "held": contains(draws, truth),
    }


def contains(draws: Floats, truth: Any) -> list[bool]:
    """Return whether 89% intervals of draws (n, k) contain the truth."""
    low, high = np.quantile(draws, _TAILS, axis=0)
    return list(map(bool, (low <= truth) & (truth <= high)))


def pooled_row(seed: int) -> dict[str, Any]:
    """Return the row of a hierarchy, by hyperparameter."""
    observed = measured(seed)
    posterior, reference = posterior_of(hierarchy(observed), 500, seed), exact(observed)
    truth: dict[str, Any] = {"m": 0.0, "tau": 0.3, "sigma": SIGMA}
    # The means come first of all that the seed gives.
    truth["mu"] = np.random.default_rng(seed).normal(0, truth["tau"], len(NAMES))
    figures = {}
    for name, value in truth.items():
        draws = posterior[name].values.reshape(1000, -1)
        mean, sd = np.reshape(reference[name], (-1, 2)).T
        moments = {"mean": draws.mean(axis=0).tolist(), "exact mean": mean.tolist()}
        figures[name] = compared(draws, mean, sd, value) | moments
    return figures


def small_row(metric: str, size: int, seed: int) -> dict[str, Any]:
    """Return the row of small groups: of the means, and of the spread."""
    rng = np.random.default_rng([seed, size])
    x = rng.normal(MEANS[:, None], SPREAD, (len(MEANS), size))
    clock = time.process_time()
    observed = labelled(line(x).ravel(), np.repeat(NAMES[: len(MEANS)], size))
    posterior = posterior_of(separate(observed, METRICS[metric]), 1000, seed)
    figures: dict[str, Any] = {"seconds": time.process_time() - clock}
    reference = exact_draws(x, rng)
    parts = {"mu": (reference[:, :-1], MEANS), "sigma": (reference[:, -1:], [SPREAD])}
    for name, (exact_part, truth) in parts.items():
        draws = posterior[name].values.reshape(len(posterior.chain) * len(posterior.draw), -1)
        figures[name] = compared(draws, exact_part.mean(axis=0), exact_part.std(axis=0), truth)
        figures[name]["exact held"] = contains(exact_part, truth)
    return figures


def row(cell: str, seed: int) -> dict[str, Any]:
    """Return the row of a data set."""
    if cell == POOLING:
        return pooled_row(seed)
    metric, size = cell.split(", ")
    return small_row(metric, int(size), seed)


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return means of the figures of each hyperparameter; of distances the scatter, too."""
    figures: dict[str, Any] = {"data sets": len(rows)}
    for name, keys in rows[0].items():
        if name == "seconds":
            figures[name] = float(np.median([row[name] for row in rows]))
            continue
        of_name = {}
        for key in keys:
            values = np.array([row[name][key] for row in rows], dtype=float)
            of_name[key] = float(values.mean())
            if key == "shift":
                of_name["off"] = float(np.sqrt((values**2).mean()))
                of_name["scatter of shifts"] = float(values.std())
        figures[name] = of_name
    return figures


CELLS = [POOLING, *(f"{metric}, {size}" for size, metric in product((10, 5), METRICS))]
STUDY = Study("groups", __doc__, CELLS, row, 40, summary)

if __name__ == "__main__":
    STUDY.main()
