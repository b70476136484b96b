"""Populations at several places of a response, of which each has a part of the posterior."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
import pytest
from scipy import stats

import prbayes as prb
from prbayes._validate import Floats

# Response, number of specimens, mean and spread of their inputs, error, prior of mu and sigma
PROBLEMS: dict[str, tuple[Callable[[Any], Any], int, float, float, float, Any, float]] = {
    "a bump": (lambda x: np.exp(-(x**2)), 25, -1.1, 0.3, 0.09, (-0.9, 1.0), 0.9),
    "a narrow population": (lambda x: np.exp(-(x**2)), 9, 1.2, 0.05, 0.002, (0.9, 1.0), 0.8),
    "a sine": (np.sin, 18, 1.25, 0.05, 0.007, (2.7, 2.7), 0.9),
    "a narrow sine": (np.sin, 10, -0.6, 0.03, 0.02, (0.5, 1.5), 0.6),
    "waves": (lambda x: x + 1.2 * np.sin(2 * x), 12, 0.5, 0.04, 0.01, (0.9, 1.2), 0.7),
}


def masses(observed: Floats, name: str, count: int = 1601) -> tuple[Floats, Floats]:
    """Return values of mu, (M,), at equal distances, and their posterior masses."""
    response, _, _, _, error, prior, scale = PROBLEMS[name]
    half = 4.5 * prior[1] + 4 * scale
    x = np.linspace(prior[0] - half, prior[0] + half, 3001)
    likelihood = np.exp(-(((observed[:, None] - response(x)) / error) ** 2) / 2)
    mu = np.linspace(prior[0] - 4.5 * prior[1], prior[0] + 4.5 * prior[1], count)
    log_sd = np.linspace(np.log(0.01 * scale), np.log(4 * scale), 31)
    logs = np.empty((count, len(log_sd)))
    for k, sd in enumerate(np.exp(log_sd)):
        unit = max(sd, 1.5 * (x[1] - x[0]))
        population = np.exp(-(((x[:, None] - mu) / unit) ** 2) / 2) / unit
        with np.errstate(divide="ignore"):
            logs[:, k] = np.log(likelihood @ population).sum(axis=0) + log_sd[k]
        logs[:, k] += stats.halfnorm(scale=scale).logpdf(sd)
    logs += stats.norm(*prior).logpdf(mu)[:, None]
    weights = np.exp(logs - logs.max()).sum(axis=1)
    return mu, weights / weights.sum()


@pytest.mark.long
@pytest.mark.parametrize("name", PROBLEMS)
def test_each_population_has_its_share_of_the_draws(name: str) -> None:
    response, n, mean, sd, error, prior, scale = PROBLEMS[name]
    rng = np.random.default_rng(len(name))
    observed = response(rng.normal(mean, sd, n)) + rng.normal(0, error, n)
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", *prior), pm.HalfNormal("sigma", scale))
        metric = prb.LogLikelihood(error=error)
        prb.Simulator("y", response, x, observed=observed, metric=metric)
        draws = prb.sample(draws=1000, random_seed=0).posterior["mu"].to_numpy().ravel()
    # Modes are separated where a tenth of a unit of mu has less than a thousandth of the mass.
    mu, weights = masses(observed, name)
    is_mode = np.convolve(weights, np.ones(9), "same") > 1e-3
    ends = mu[1:][np.diff(is_mode.astype(int)) == 1][1:]
    shares = np.bincount(np.digitize(mu, ends), weights, len(ends) + 1)
    found = np.bincount(np.digitize(draws, ends), minlength=len(ends) + 1) / len(draws)
    assert (shares > 0.05).sum() > 1
    np.testing.assert_allclose(found, shares, atol=0.05)
