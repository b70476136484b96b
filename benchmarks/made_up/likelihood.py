"""Made-up problems of exact readings: the posterior is that of the inputs themselves."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pymc as pm
from scipy import stats

import prbayes as prb
from benchmarks.made_up import moments, on_grid, problem


def compared(
    response: Callable[[Any], Any], x: Any, mu: tuple[float, float], sigma: float, center: float
) -> Iterator[tuple[str, float]]:
    """Compare the posterior of a normal population with that of its inputs x, (N,).

    The priors are Normal(*mu) and HalfNormal(sigma); the grid reaches ten standard errors.
    """
    with pm.Model():
        population = pm.Normal.dist(pm.Normal("mu", *mu), pm.HalfNormal("sigma", sigma))
        prb.Simulator("y", response, population, observed=response(x))
        draws = prb.sample(draws=4000, random_seed=1).posterior

    def log_posterior(mean: Any, log_sd: Any) -> Any:
        sd = np.exp(log_sd)
        logs = stats.norm(mean[:, None], sd[:, None]).logpdf(x).sum(axis=1)
        return logs + stats.norm(*mu).logpdf(mean) + stats.halfnorm(scale=sigma).logpdf(sd) + log_sd

    spread, root = x.std(), np.sqrt(len(x))
    axes = {
        "mean": x.mean() + spread * np.linspace(-10, 10, 401) / root,
        "log_sd": np.log(spread) + np.linspace(-6, 10, 401) / root,
    }
    values, weights = on_grid(log_posterior, **axes)
    wanted = {"mu": values["mean"] - center, "sigma": np.exp(values["log_sd"])}
    got = {"mu": draws["mu"] - center, "sigma": draws["sigma"]}
    yield from moments(got, wanted, weights)


@problem
def cubic_of_a_normal() -> Iterator[tuple[str, float]]:
    x = np.random.default_rng(11).normal(0.4, 0.3, 15)
    yield from compared(lambda x: x + 2.0 * x**3, x, (0.0, 2.0), 1.0, 0.0)


@problem
def saturation_under_vague_priors() -> Iterator[tuple[str, float]]:
    x = np.random.default_rng(12).normal(2.5, 0.6, 12)
    yield from compared(np.tanh, x, (0.0, 10.0), 5.0, 0.0)


@problem
def five_specimens_on_a_step() -> Iterator[tuple[str, float]]:
    x = np.random.default_rng(13).normal(-0.2, 0.5, 5)
    yield from compared(lambda x: 1 / (1 + np.exp(-6.0 * x)) + 0.02 * x, x, (0.0, 3.0), 2.0, 0.0)


@problem
def strains_of_a_modulus_in_pascal() -> Iterator[tuple[str, float]]:
    x = np.random.default_rng(14).normal(2.1e11, 6e9, 30)
    yield from compared(lambda x: 250e6 / x, x, (2e11, 5e10), 2e10, 2e11)


@problem
def a_narrow_population_far_from_the_prior() -> Iterator[tuple[str, float]]:
    x = np.random.default_rng(15).normal(7.0, 0.01, 20)
    yield from compared(lambda x: np.log1p(np.exp(x)), x, (0.0, 4.0), 2.0, 0.0)


@problem
def growth_over_ten_orders_of_magnitude() -> Iterator[tuple[str, float]]:
    """The emulator's error covers the small readings: that is reported."""
    x = np.random.default_rng(16).normal(1.0, 0.8, 40)
    with pm.Model():
        population = pm.Normal.dist(pm.Normal("mu", 0.0, 2.0), pm.HalfNormal("sigma", 2.0))
        prb.Simulator("y", lambda x: np.exp(5.0 * x), population, observed=np.exp(5.0 * x))
        codes = [finding.code for finding in prb.minimize().findings]
    yield "emulator-error", 0.0 if "emulator-error" in codes else np.inf


@problem
def growth_in_logarithms() -> Iterator[tuple[str, float]]:
    x = np.random.default_rng(16).normal(1.0, 0.8, 40)
    yield from compared(lambda x: np.log(np.exp(5.0 * x) + np.exp(x)), x, (0.0, 2.0), 2.0, 0.0)
