"""Specimens of several suppliers, normal in each, and the exact posterior of their hierarchy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

import prbayes as prb
from prbayes._validate import Floats

NAMES = ["Adler", "Busch", "Celik", "Dorn", "Eder", "Falk"]
EACH = 20
SIGMA = 0.5
# Standard deviations of the priors of mean, spread between suppliers, and spread within one.
PRIORS = (1.0, 0.5, 1.0)


def measured(seed: int, between: float = 0.3) -> xr.DataArray:
    """Return responses of twenty specimens of each supplier."""
    rng = np.random.default_rng(seed)
    means = rng.normal(0, between, len(NAMES))
    values = rng.normal(np.repeat(means, EACH), SIGMA)
    return labelled(values, np.repeat(NAMES, EACH))


def labelled(values: Any, suppliers: Any) -> xr.DataArray:
    """Return responses with the supplier of each specimen."""
    return xr.DataArray(values, {"supplier": ("specimen", suppliers)}, "specimen")


def same(x: Any) -> Any:
    return x


def hierarchy(observed: xr.DataArray, metric: Any = None, **given: Any) -> pm.Model:
    """Return the model of all suppliers together."""
    with pm.Model(coords={"supplier": NAMES}) as model:
        m = pm.Normal("m", 0, PRIORS[0])
        tau = pm.HalfNormal("tau", PRIORS[1])
        mu = pm.Normal("mu", m, tau, dims="supplier")
        sigma = pm.HalfNormal("sigma", PRIORS[2])
        x = pm.Normal.dist(mu[prb.response.group("supplier")], sigma, name="x")
        metric = metric or prb.ProbabilityResidual()
        prb.Simulator("y", same, x, metric=metric, observed=observed, progressbar=False, **given)
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
