"""Made-up problems of readings with errors, limits, rounding, gaps and repeats."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pymc as pm
from scipy import stats

import prbayes as prb
from benchmarks.made_up import difference, moments, on_grid, problem


def draws_of(response: Any, *inputs: Any, **arguments: Any) -> Any:
    """Return the posterior of the model on the context, with one simulator more."""
    prb.Simulator("y", response, *inputs, **arguments)
    return prb.sample(draws=2000, random_seed=1).posterior


def marginal(masses: Any, logs: Any) -> Any:
    """Return log-likelihoods of populations, (S,).

    ``masses``, (S, X), are those of a grid of inputs, and ``logs``, (X, N), log-densities of the
    readings of each specimen.
    """
    top = logs.max(axis=0)
    return np.log(masses @ np.exp(logs - top) + 1e-300).sum(axis=1) + top.sum()


def halves(x: Any) -> Any:
    """Return masses of the cells of an equidistant grid, times a density."""
    return x[1] - x[0]


# -- a known error -----------------------------------------------------------------------------------


@problem
def charges_with_an_error_each() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(21)
    error = 1e-9 * rng.uniform(0.05, 0.6, 12)
    y = 1e-9 * np.exp(rng.normal(0.5, 0.3, 12)) ** 2 + error * rng.normal(size=12)
    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 3.0), pm.HalfNormal("sigma", 1.0)
        draws = draws_of(
            lambda c: 1e-9 * c**2,
            pm.LogNormal.dist(mu, sigma),
            observed=y,
            metric=prb.LogLikelihood(error=error),
        )
    x = np.linspace(-6.0, 4.0, 4001)
    logs = stats.norm(1e-9 * np.exp(2 * x)[:, None], error).logpdf(y)

    def log_posterior(mu: Any, sigma: Any) -> Any:
        masses = stats.norm(mu[:, None], sigma[:, None]).pdf(x) * (x[1] - x[0])
        prior = stats.norm(0, 3).logpdf(mu) + stats.halfnorm(scale=1).logpdf(sigma)
        return marginal(masses, logs) + prior

    grid = on_grid(log_posterior, mu=np.linspace(-0.3, 1.2, 61), sigma=np.linspace(0.02, 1.2, 81))
    yield from moments(draws, *grid)


@problem
def an_error_above_the_scatter_at_a_fold() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(22)
    y = (rng.normal(1.3, 0.4, 8) - 1.0) ** 2 + rng.normal(0, 0.5, 8)
    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 3.0), pm.HalfNormal("sigma", 2.0)
        draws = draws_of(
            lambda x: (x - 1.0) ** 2,
            pm.Normal.dist(mu, sigma),
            observed=y,
            metric=prb.LogLikelihood(error=0.5),
        )
    z = np.linspace(-6, 6, 241)

    def log_posterior(mu: Any, sigma: Any) -> Any:
        f = (mu[:, None] + sigma[:, None] * z - 1.0) ** 2
        like = stats.norm(0, 0.5).pdf(y - f[..., None]) * stats.norm.pdf(z)[:, None]
        prior = stats.norm(0, 3).logpdf(mu) + stats.halfnorm(scale=2).logpdf(sigma)
        return np.log(like.sum(axis=1)).sum(axis=1) + prior

    grid = on_grid(log_posterior, mu=np.linspace(-3, 5, 97), sigma=np.linspace(0.005, 4, 81))
    yield from moments(draws, *grid)


@problem
def weibull_loads_with_a_tiny_error() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(23)
    x = 3.0 * rng.weibull(1.2, 25)
    y = 1e6 * x**1.5 + rng.normal(0, 300.0, 25)
    with pm.Model():
        shape, scale = pm.LogNormal("shape", 0.0, 1.0), pm.LogNormal("scale", 0.0, 2.0)
        draws = draws_of(
            lambda x: 1e6 * x**1.5,
            pm.Weibull.dist(shape, scale),
            observed=y,
            metric=prb.LogLikelihood(error=300.0),
        )
    # Quadrature of each specimen over its own narrow interval
    z = np.linspace(-6, 6, 61)
    f = np.maximum(y[:, None] + 300.0 * z, 1.0)
    at, slope = (f / 1e6) ** (2 / 3), 1.5e6 * (f / 1e6) ** (1 / 3)

    def log_posterior(shape: Any, scale: Any) -> Any:
        total = 0.0
        for points, weights in zip(at, stats.norm.pdf(z) / slope, strict=True):
            density = stats.weibull_min(shape[:, None], scale=scale[:, None]).pdf(points)
            total = total + np.log(density @ weights)
        prior = stats.lognorm(1.0).logpdf(shape) + stats.lognorm(2.0).logpdf(scale)
        return total + prior

    grid = on_grid(log_posterior, shape=np.linspace(0.5, 2.4, 71), scale=np.linspace(1, 7, 71))
    yield from moments(draws, *grid)


# -- an unknown error --------------------------------------------------------------------------------


@problem
def one_unknown_error_of_two_outputs() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(24)
    x = rng.gamma(4.0, 0.25, 10)
    y = np.stack([x, np.exp(x)], axis=-1) + rng.normal(0, 0.15, (10, 2))
    with pm.Model():
        mean, sd = pm.LogNormal("mean", 0.0, 1.0), pm.HalfNormal("sd", 1.0)
        e = pm.HalfNormal("e", 0.5)
        draws = draws_of(
            lambda x: np.stack([x, np.exp(x)], axis=-1),
            pm.Gamma.dist(mu=mean, sigma=sd),
            observed=y,
            metric=prb.LogLikelihood(error=e),
        )
    x = np.linspace(0.002, 5.0, 1250)
    f = np.stack([x, np.exp(x)], axis=-1)[:, None]

    def log_posterior(mean: Any, sd: Any, e: Any) -> Any:
        logs, shape = np.empty(len(e)), (mean / sd) ** 2
        for value in np.unique(e):
            at = e == value
            masses = stats.gamma(shape[at, None], scale=(sd**2 / mean)[at, None]).pdf(x)
            logs[at] = marginal(masses, stats.norm(f, value).logpdf(y).sum(axis=-1))
        prior = stats.lognorm(1.0).logpdf(mean) + stats.halfnorm(scale=1).logpdf(sd)
        return logs + prior + stats.halfnorm(scale=0.5).logpdf(e)

    grid = on_grid(
        log_posterior,
        mean=np.linspace(0.4, 2.0, 41),
        sd=np.linspace(0.08, 1.6, 41),
        e=np.linspace(0.03, 0.7, 32),
    )
    yield from moments(draws, *grid)


@problem
def a_vague_error_of_single_readings() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(25)
    x = rng.normal(1.0, 0.5, 30)
    y = 1e6 * (x + 0.3 * x**3) + rng.normal(0, 4e5, 30)
    with pm.Model():
        mu, e = pm.Normal("mu", 0.0, 5.0), pm.HalfNormal("e", 5e6)
        draws = draws_of(
            lambda x: 1e6 * (x + 0.3 * x**3),
            pm.Normal.dist(mu, 0.5),
            observed=y,
            metric=prb.LogLikelihood(error=e),
        )
    x = np.linspace(-3.0, 5.0, 1601)
    f = 1e6 * (x + 0.3 * x**3)[:, None]

    def log_posterior(mu: Any, e: Any) -> Any:
        logs = np.empty(len(e))
        for value in np.unique(e):
            at = e == value
            masses = stats.norm(mu[at, None], 0.5).pdf(x)
            logs[at] = marginal(masses, stats.norm(f, value).logpdf(y))
        return logs + stats.norm(0, 5).logpdf(mu) + stats.halfnorm(scale=5e6).logpdf(e)

    grid = on_grid(log_posterior, mu=np.linspace(0.2, 1.8, 81), e=np.linspace(1e4, 1.5e6, 120))
    yield from moments(draws, *grid)


@problem
def unknown_errors_of_outputs_in_odd_units() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(26)
    units, slopes = np.array([1e-6, 1e3]), np.array([[1.0, 0.5], [-0.5, 1.0]])
    x = rng.normal([1.0, 2.0], [0.5, 0.8], (14, 2))
    y = units * (x @ slopes.T + rng.normal(0, [0.1, 0.3], (14, 2)))
    with pm.Model():
        mu = pm.Normal("mu", 0.0, 3.0, shape=2)
        e = pm.HalfNormal("e", units, shape=2)
        draws = draws_of(
            lambda a, b: np.stack([1e-6 * (a + 0.5 * b), 1e3 * (b - 0.5 * a)], axis=-1),
            pm.Normal.dist(mu[0], 0.5),
            pm.Normal.dist(mu[1], 0.8),
            observed=y,
            metric=prb.LogLikelihood(error=e),
        )
    # The readings are normal; means given errors are, too.
    z, between = y / units, slopes @ np.diag([0.25, 0.64]) @ slopes.T

    def log_posterior(e0: Any, e1: Any) -> Any:
        result = []
        for errors in np.stack([e0, e1], axis=-1):
            covariance = np.kron(np.eye(14), between + np.diag(errors**2))
            covariance += np.kron(np.ones((14, 14)), 9.0 * slopes @ slopes.T)
            log_p = stats.multivariate_normal(np.zeros(28), covariance).logpdf(z.ravel())
            result.append(log_p + stats.halfnorm.logpdf(errors).sum())
        return np.array(result)

    grid = np.linspace(0.005, 1.7, 48)
    names = {"e0": draws["e"].values[..., 0] / 1e-6, "e1": draws["e"].values[..., 1] / 1e3}
    yield from moments(names, *on_grid(log_posterior, e0=grid, e1=grid))


# -- relative and combined errors --------------------------------------------------------------------


@problem
def a_relative_error_across_zero() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(27)
    x = rng.normal(0.6, 0.8, 16)
    y = x * (1 + 0.2 * rng.normal(size=16))
    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 2.0), pm.HalfNormal("sigma", 2.0)
        draws = draws_of(
            lambda x: x,
            pm.Normal.dist(mu, sigma),
            observed=y,
            metric=prb.LogLikelihood(error=0.2, relative=True),
        )
    # The ratio of the output and the reading is the variable of quadrature.
    u = np.concatenate([-np.geomspace(60.0, 0.02, 3000), np.geomspace(0.02, 60.0, 3000)])
    widths = np.gradient(u)

    def log_posterior(mu: Any, sigma: Any) -> Any:
        total = stats.norm(0, 2).logpdf(mu) + stats.halfnorm(scale=2).logpdf(sigma)
        for reading in y:
            f = u * reading
            weights = widths * stats.norm(f, 0.2 * abs(f)).pdf(reading) * abs(reading)
            total = total + np.log(stats.norm(mu[:, None], sigma[:, None]).pdf(f) @ weights)
        return total

    grid = on_grid(log_posterior, mu=np.linspace(-0.8, 1.9, 45), sigma=np.linspace(0.3, 2.2, 41))
    yield from moments(draws, *grid)


@problem
def a_combined_error_over_decades() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(28)
    f = np.exp(rng.normal(0.0, 1.5, 20))
    y = f + np.hypot(0.3, 0.15 * f) * rng.normal(size=20)
    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 3.0), pm.HalfNormal("sigma", 3.0)
        draws = draws_of(
            lambda x: x,
            pm.LogNormal.dist(mu, sigma),
            observed=y,
            metric=prb.LogLikelihood(error=prb.readings.Combined(0.3, 0.15)),
        )
    x = np.linspace(-14.0, 6.0, 3001)
    f = np.exp(x)[:, None]
    logs = stats.norm(f, np.hypot(0.3, 0.15 * f)).logpdf(y)

    def log_posterior(mu: Any, sigma: Any) -> Any:
        masses = stats.norm(mu[:, None], sigma[:, None]).pdf(x) * (x[1] - x[0])
        prior = stats.norm(0, 3).logpdf(mu) + stats.halfnorm(scale=3).logpdf(sigma)
        return marginal(masses, logs) + prior

    grid = on_grid(log_posterior, mu=np.linspace(-2.5, 2.0, 81), sigma=np.linspace(0.4, 4.0, 81))
    yield from moments(draws, *grid)


@problem
def a_combined_error_with_an_unknown_part() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(29)
    x = rng.uniform(1.0, 3.0, 24)
    f = np.stack([x**2, 10 * x], axis=-1)
    y = f + np.hypot([0.2, 0.5], 0.1 * f) * rng.normal(size=(24, 2))
    with pm.Model():
        mid, half = pm.Normal("mid", 2.0, 1.0), pm.LogNormal("half", 0.0, 0.5)
        b = pm.HalfNormal("b", 0.3)
        draws = draws_of(
            lambda x: np.stack([x**2, 10 * x], axis=-1),
            pm.Uniform.dist(mid - half, mid + half),
            observed=y,
            metric=prb.LogLikelihood(error=prb.readings.Combined([0.2, 0.5], b)),
        )
    x = np.linspace(-1.0, 5.0, 2401)
    f = np.stack([x**2, 10 * x], axis=-1)[:, None]

    def log_posterior(mid: Any, half: Any, b: Any) -> Any:
        logs = np.empty(len(b))
        for value in np.unique(b):
            at = b == value
            like = stats.norm(f, np.hypot([0.2, 0.5], value * f)).pdf(y).prod(axis=-1)
            cumulated = np.concatenate([np.zeros((1, 24)), np.cumsum(like[1:] + like[:-1], axis=0)])
            ends = [
                np.stack([np.interp(end, x, column) for column in cumulated.T], axis=-1)
                for end in (mid[at] - half[at], mid[at] + half[at])
            ]
            mass = np.maximum(ends[1] - ends[0], 1e-300) / half[at, None]
            logs[at] = np.log(mass).sum(axis=-1)
        prior = stats.norm(2, 1).logpdf(mid) + stats.lognorm(0.5).logpdf(half)
        return logs + prior + stats.halfnorm(scale=0.3).logpdf(b)

    grid = on_grid(
        log_posterior,
        mid=np.linspace(1.6, 2.4, 61),
        half=np.linspace(0.5, 1.7, 81),
        b=np.linspace(0.02, 0.25, 32),
    )
    yield from moments(draws, *grid)
