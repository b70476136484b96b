"""Made-up problems of readings with errors, limits, rounding, gaps and repeats."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
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


# -- censored readings -------------------------------------------------------------------------------


@problem
def weibull_lives_of_which_most_are_censored() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(31)
    life = 1e6 * rng.weibull(2.0, 25) ** 3
    y = np.minimum(life, 2.5e5)
    with pm.Model():
        shape, scale = pm.LogNormal("shape", 0.5, 0.7), pm.LogNormal("scale", 0.0, 1.0)
        draws = draws_of(
            lambda x: 1e6 * x**3,
            pm.Weibull.dist(shape, scale),
            observed=y,
            metric=prb.LogLikelihood(censored=(None, 2.5e5)),
        )
    x = (y / 1e6) ** (1 / 3)
    is_censored = y == 2.5e5

    def log_posterior(shape: Any, scale: Any) -> Any:
        weibull = stats.weibull_min(shape[:, None], scale=scale[:, None])
        logs = np.where(is_censored, weibull.logsf(x), weibull.logpdf(x)).sum(axis=1)
        prior = stats.norm(0.5, 0.7).logpdf(np.log(shape)) + stats.norm.logpdf(np.log(scale))
        return logs + prior - np.log(shape * scale)

    grid = on_grid(
        log_posterior, shape=np.linspace(0.2, 8.0, 201), scale=np.geomspace(0.4, 20.0, 401)
    )
    values, weights = grid
    weights = weights * values["scale"]
    yield from moments(draws, values, weights / weights.sum())


@problem
def a_fold_censored_at_both_sides() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(32)
    y = np.clip((rng.normal(0.4, 0.7, 20) ** 2) + rng.normal(0, 0.1, 20), 0.1, 0.8)
    with pm.Model():
        mu, sigma = pm.HalfNormal("mu", 2.0), pm.HalfNormal("sigma", 2.0)
        draws = draws_of(
            lambda x: x**2,
            pm.Normal.dist(mu, sigma),
            observed=y,
            metric=prb.LogLikelihood(error=0.1, censored=(0.1, 0.8)),
        )
    x = np.linspace(-12.0, 12.0, 4801)
    reading = stats.norm(x[:, None] ** 2, 0.1)
    logs = np.where(y <= 0.1, reading.logcdf(y), np.where(y >= 0.8, reading.logsf(y), 0.0))
    logs = np.where((y > 0.1) & (y < 0.8), reading.logpdf(y), logs)

    def log_posterior(mu: Any, sigma: Any) -> Any:
        masses = stats.norm(mu[:, None], sigma[:, None]).pdf(x) * (x[1] - x[0])
        prior = stats.halfnorm(scale=2).logpdf(mu) + stats.halfnorm(scale=2).logpdf(sigma)
        return marginal(masses, logs) + prior

    grid = on_grid(log_posterior, mu=np.linspace(0.0, 2.5, 61), sigma=np.linspace(0.1, 3.0, 81))
    yield from moments(draws, *grid)


@problem
def one_output_with_limits_by_specimen() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(33)
    x, limit = rng.gamma(9.0, 0.2, 18), rng.choice([1.2, 1.8, 2.4], 18)
    y = np.stack([np.log(x), x], axis=-1) + rng.normal(0, [0.2, 0.3], (18, 2))
    limits = np.stack([np.full(18, 10.0), limit], axis=-1)
    y = np.minimum(y, limits)
    with pm.Model():
        mean, sd = pm.LogNormal("mean", 0.0, 1.0), pm.HalfNormal("sd", 2.0)
        draws = draws_of(
            lambda x: np.stack([np.log(x), x], axis=-1),
            pm.Gamma.dist(mu=mean, sigma=sd),
            observed=y,
            metric=prb.LogLikelihood(error=[0.2, 0.3], censored=(None, limits)),
        )
    x = np.linspace(0.001, 12.0, 4000)
    first = stats.norm(np.log(x)[:, None], 0.2).logpdf(y[:, 0])
    second = stats.norm(x[:, None], 0.3)
    is_censored = y[:, 1] >= limit
    logs = first + np.where(is_censored, second.logsf(limit), second.logpdf(y[:, 1]))

    def log_posterior(mean: Any, sd: Any) -> Any:
        population = stats.gamma((mean / sd)[:, None] ** 2, scale=(sd**2 / mean)[:, None])
        prior = stats.lognorm(1.0).logpdf(mean) + stats.halfnorm(scale=2).logpdf(sd)
        return marginal(population.pdf(x) * (x[1] - x[0]), logs) + prior

    grid = on_grid(log_posterior, mean=np.linspace(1.2, 3.0, 61), sd=np.linspace(0.1, 2.0, 61))
    yield from moments(draws, *grid)


@problem
def all_but_two_below_a_limit() -> Iterator[tuple[str, float]]:
    y = np.concatenate([np.full(10, 0.05), [0.061, 0.112]])
    with pm.Model():
        mu, sigma = pm.Normal("mu", -3.0, 1.0), pm.HalfNormal("sigma", 1.0)
        draws = draws_of(
            np.exp,
            pm.Normal.dist(mu, sigma),
            observed=y,
            metric=prb.LogLikelihood(error=0.01, censored=(0.05, None)),
        )
    x = np.linspace(-12.0, 6.0, 6001)
    reading = stats.norm(np.exp(x)[:, None], 0.01)
    logs = np.where(y <= 0.05, reading.logcdf(y), reading.logpdf(y))

    def log_posterior(mu: Any, sigma: Any) -> Any:
        masses = stats.norm(mu[:, None], sigma[:, None]).pdf(x) * (x[1] - x[0])
        prior = stats.norm(-3, 1).logpdf(mu) + stats.halfnorm(scale=1).logpdf(sigma)
        return marginal(masses, logs) + prior

    grid = on_grid(log_posterior, mu=np.linspace(-7.0, -1.0, 61), sigma=np.linspace(0.02, 4.0, 81))
    yield from moments(draws, *grid)


# -- rounded readings and histograms -----------------------------------------------------------------


@problem
def a_histogram_of_a_gamma_population() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(34)
    edges = np.arange(0.0, 21.0, 2.0)
    counts, _ = np.histogram(rng.gamma(2.0, 1.0, 120) ** 1.5, edges)
    middles = (edges[1:] + edges[:-1]) / 2
    with pm.Model():
        alpha, beta = pm.LogNormal("alpha", 0.0, 1.0), pm.LogNormal("beta", 0.0, 1.0)
        draws = draws_of(
            lambda x: x**1.5,
            pm.Gamma.dist(alpha, beta),
            observed=middles,
            weights=counts,
            metric=prb.LogLikelihood(rounded=2.0),
        )

    def log_posterior(alpha: Any, beta: Any) -> Any:
        population = stats.gamma(alpha[:, None], scale=1 / beta[:, None])
        logs = np.log(np.diff(population.cdf(edges ** (2 / 3)), axis=1)) @ counts
        return logs + stats.lognorm(1.0).logpdf(alpha) + stats.lognorm(1.0).logpdf(beta)

    grid = on_grid(log_posterior, alpha=np.linspace(0.6, 5.0, 161), beta=np.linspace(0.2, 2.6, 161))
    yield from moments(draws, *grid)


@problem
def steps_wider_than_the_population() -> Iterator[tuple[str, float]]:
    y = 1e-9 * np.array([3.0, 3.0, 3.0, 4.0, 3.0, 3.0, 4.0, 3.0, 3.0, 3.0, 4.0, 3.0])
    with pm.Model():
        mu, sigma = pm.Normal("mu", 1.0, 2.0), pm.HalfNormal("sigma", 0.5)
        draws = draws_of(
            lambda x: 1e-9 * np.exp(x),
            pm.Normal.dist(mu, sigma),
            observed=y,
            metric=prb.LogLikelihood(rounded=1e-9),
        )
    low, high = np.log(1e9 * y - 0.5), np.log(1e9 * y + 0.5)

    def log_posterior(mu: Any, sigma: Any) -> Any:
        population = stats.norm(mu[:, None], sigma[:, None])
        masses = population.cdf(high) - population.cdf(low)
        logs = np.log(np.maximum(masses, 1e-300)).sum(axis=1)
        return logs + stats.norm(1, 2).logpdf(mu) + stats.halfnorm(scale=0.5).logpdf(sigma)

    grid = on_grid(
        log_posterior, mu=np.linspace(0.8, 1.6, 161), sigma=np.linspace(0.0005, 0.8, 400)
    )
    yield from moments(draws, *grid)


@problem
def rounded_readings_with_an_unknown_error() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(35)
    x = rng.normal(1.5, 0.4, 15)
    f = 1e3 * np.stack([np.sin(x), x**2], axis=-1)
    y = 100.0 * np.round((f + rng.normal(0, 80.0, (15, 2))) / 100.0)
    with pm.Model():
        mu, sigma = pm.Normal("mu", 1.0, 0.7), pm.HalfNormal("sigma", 0.5)
        e = pm.HalfNormal("e", 150.0)
        draws = draws_of(
            lambda x: 1e3 * np.stack([np.sin(x), x**2], axis=-1),
            pm.Normal.dist(mu, sigma),
            observed=y,
            metric=prb.LogLikelihood(error=e, rounded=100.0),
        )
    x = np.linspace(-3.0, 5.0, 1601)
    f = 1e3 * np.stack([np.sin(x), x**2], axis=-1)[:, None]

    def log_posterior(mu: Any, sigma: Any, e: Any) -> Any:
        logs = np.empty(len(e))
        for value in np.unique(e):
            at, reading = e == value, stats.norm(f, value)
            of_readings = np.log(reading.cdf(y + 50) - reading.cdf(y - 50) + 1e-300).sum(axis=-1)
            masses = stats.norm(mu[at, None], sigma[at, None]).pdf(x)
            logs[at] = marginal(masses, of_readings)
        prior = stats.norm(1, 0.7).logpdf(mu) + stats.halfnorm(scale=0.5).logpdf(sigma)
        return logs + prior + stats.halfnorm(scale=150).logpdf(e)

    grid = on_grid(
        log_posterior,
        mu=np.linspace(0.9, 2.1, 41),
        sigma=np.linspace(0.1, 1.1, 41),
        e=np.linspace(10.0, 250.0, 41),
    )
    yield from moments(draws, *grid)


# -- gross errors ------------------------------------------------------------------------------------


@problem
def a_known_share_of_gross_errors() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(36)
    y = np.exp(rng.normal(0.0, 0.2, 15)) + rng.normal(0, 0.05, 15)
    y[3] = 9.0
    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 2.0), pm.HalfNormal("sigma", 1.0)
        draws = draws_of(
            lambda x: x,
            pm.LogNormal.dist(mu, sigma),
            observed=y,
            metric=prb.LogLikelihood(error=0.05, gross_errors=0.1),
        )
    x = np.linspace(-5.0, 5.0, 4001)
    like = stats.norm(np.exp(x)[:, None], 0.05).pdf(y)

    def log_posterior(mu: Any, sigma: Any) -> Any:
        masses = stats.norm(mu[:, None], sigma[:, None]).pdf(x) * (x[1] - x[0])
        logs = np.log(0.9 * masses @ like + 0.1 / (2 * np.ptp(y))).sum(axis=1)
        return logs + stats.norm(0, 2).logpdf(mu) + stats.halfnorm(scale=1).logpdf(sigma)

    grid = on_grid(log_posterior, mu=np.linspace(-0.6, 0.6, 81), sigma=np.linspace(0.02, 1.2, 119))
    yield from moments(draws, *grid)


@problem
def an_unknown_share_of_gross_errors_of_two_outputs() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(37)
    x = rng.normal([2.0, 1.0], [0.3, 0.2], (20, 2))
    y = np.stack([x.prod(axis=1), x[:, 0] / x[:, 1]], axis=-1)
    y[[2, 11], 0] = [0.2, 6.0]
    with pm.Model():
        mu, sd = pm.Normal("mu", 1.5, 1.0, shape=2), pm.HalfNormal("sd", 0.5, shape=2)
        draws = draws_of(
            lambda a, b: np.stack([a * b, a / b], axis=-1),
            pm.LogNormal.dist(mu[0] - 1.0, sd[0]),
            pm.LogNormal.dist(mu[1] - 1.5, sd[1]),
            observed=y,
            metric=prb.LogLikelihood(gross_errors=True),
        )
    u = np.log(y)
    inputs, jacobian = (
        np.stack([u.sum(axis=1), u[:, 0] - u[:, 1]], axis=-1) / 2,
        0.5 / y.prod(axis=1),
    )
    ranges = np.prod(2 * np.ptp(y, axis=0))
    rng = np.random.default_rng(1)
    centre, spread = np.array([1.7, 1.5, 0.16, 0.2, 0.1]), np.array([0.05, 0.06, 0.05, 0.05, 0.07])
    t = stats.t(4)
    theta = centre + 1.5 * spread * t.rvs((400_000, 5), random_state=rng)
    log_q = t.logpdf((theta - centre) / (1.5 * spread)).sum(axis=1)
    theta = theta[is_valid := (theta[:, 2:] > 0).all(axis=1) & (theta[:, 4] < 1)]
    log_q, (m0, m1, s0, s1, w) = log_q[is_valid], theta.T
    logs = stats.norm([1.5, 1.5], 1.0).logpdf(theta[:, :2]).sum(axis=1)
    logs += stats.halfnorm(scale=0.5).logpdf(theta[:, 2:4]).sum(axis=1) + stats.beta(1, 9).logpdf(w)
    for x, factor in zip(inputs, jacobian, strict=True):
        p = stats.norm(m0 - 1.0, s0).pdf(x[0]) * stats.norm(m1 - 1.5, s1).pdf(x[1]) * factor
        logs += np.log((1 - w) * p + w / ranges)
    weights = np.exp(logs - log_q - (logs - log_q).max())
    names = {"m0": m0, "m1": m1, "s0": s0, "s1": s1, "w": w}
    of_draws = dict(zip(("m0", "m1"), np.moveaxis(draws["mu"].values, -1, 0), strict=True))
    of_draws |= dict(zip(("s0", "s1"), np.moveaxis(draws["sd"].values, -1, 0), strict=True))
    of_draws["w"] = draws["y_gross_errors"].values
    yield from moments(of_draws, names, weights / weights.sum())


@problem
def gross_errors_beside_a_fold() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(38)
    y = 1e6 * (rng.normal(0.5, 0.5, 24) ** 2 + rng.normal(0, 0.05, 24))
    y[[0, 7, 19]] = [-4e6, 6e6, 9e6]
    with pm.Model():
        mu, sigma = pm.HalfNormal("mu", 2.0), pm.HalfNormal("sigma", 2.0)
        w = pm.Beta("w", 1, 4)
        draws = draws_of(
            lambda x: 1e6 * x**2,
            pm.Normal.dist(mu, sigma),
            observed=y,
            metric=prb.LogLikelihood(error=5e4, gross_errors=w),
        )
    x = np.linspace(-9.0, 9.0, 6001)
    like = stats.norm(1e6 * x[:, None] ** 2, 5e4).pdf(y)

    def log_posterior(mu: Any, sigma: Any, w: Any) -> Any:
        at = np.stack([mu, sigma], axis=-1)
        at, index = np.unique(at, axis=0, return_inverse=True)
        density = (stats.norm(at[:, :1], at[:, 1:]).pdf(x) * (x[1] - x[0])) @ like
        share = w[:, None]
        logs = np.log((1 - share) * density[index] + share / (2 * np.ptp(y))).sum(axis=1)
        prior = stats.halfnorm(scale=2).logpdf(mu) + stats.halfnorm(scale=2).logpdf(sigma)
        return logs + prior + stats.beta(1, 4).logpdf(w)

    grid = on_grid(
        log_posterior,
        mu=np.linspace(0.0, 1.8, 41),
        sigma=np.linspace(0.15, 2.0, 61),
        w=np.linspace(0.005, 0.6, 61),
    )
    yield from moments(draws, *grid)


# -- counts ------------------------------------------------------------------------------------------


@problem
def counts_of_which_most_are_zero() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(41)
    hours = 1e6 * rng.uniform(0.2, 5.0, 30)
    y = rng.poisson(hours * 1e-7 * np.exp(rng.normal(0.0, 1.5, 30)))
    with pm.Model():
        mu, sigma = pm.Normal("mu", -16.0, 3.0), pm.HalfNormal("sigma", 3.0)
        draws = draws_of(
            lambda rate: rate,
            pm.LogNormal.dist(mu, sigma),
            observed=y,
            metric=prb.LogLikelihood(error=prb.readings.Poisson(hours)),
        )
    x = np.linspace(-60.0, 10.0, 3501)
    with np.errstate(over="ignore"):
        logs = stats.poisson(hours * np.exp(x)[:, None]).logpmf(y)

    def log_posterior(mu: Any, sigma: Any) -> Any:
        masses = stats.norm(mu[:, None], sigma[:, None]).pdf(x) * (x[1] - x[0])
        prior = stats.norm(-16, 3).logpdf(mu) + stats.halfnorm(scale=3).logpdf(sigma)
        return marginal(masses, logs) + prior

    grid = on_grid(log_posterior, mu=np.linspace(-26, -12.5, 91), sigma=np.linspace(0.03, 8, 81))
    yield from moments(draws, *grid)


@problem
def clustered_counts_at_two_conditions() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(42)
    f = rng.gamma(3.0, 1.0, 12)[:, None] * np.array([2.0, 10.0])
    y = rng.poisson(f * rng.gamma(2.0, 0.5, f.shape))
    with pm.Model():
        shape, rate = pm.LogNormal("shape", 0.5, 1.0), pm.LogNormal("rate", 0.0, 1.0)
        alpha = pm.LogNormal("alpha", 0.5, 0.7)
        draws = draws_of(
            lambda x: np.stack([2 * x, 10 * x], axis=-1),
            pm.Gamma.dist(shape, rate),
            observed=y,
            metric=prb.LogLikelihood(error=prb.readings.NegativeBinomial(alpha)),
        )
    x = np.exp(np.linspace(-6.0, 4.0, 501))
    f = x[:, None, None] * np.array([2.0, 10.0])

    def log_posterior(shape: Any, rate: Any, alpha: Any) -> Any:
        logs = np.empty(len(alpha))
        for value in np.unique(alpha):
            at = alpha == value
            density = stats.gamma(shape[at, None], scale=1 / rate[at, None]).pdf(x)
            counts = stats.nbinom(value, value / (value + f)).logpmf(y).sum(axis=-1)
            logs[at] = marginal(density * x * 0.02, counts)
        prior = stats.norm(0.5, 1).logpdf(np.log(shape)) + stats.norm.logpdf(np.log(rate))
        return logs + prior + stats.norm(0.5, 0.7).logpdf(np.log(alpha))

    axes = {"shape": (-0.8, 3.8), "rate": (-2.0, 3.0), "alpha": (-0.8, 3.0)}
    values, weights = on_grid(
        lambda **logs: log_posterior(**{name: np.exp(u) for name, u in logs.items()}),
        **{name: np.linspace(*ends, 45) for name, ends in axes.items()},
    )
    values = {name: np.exp(u) for name, u in values.items()}
    yield from moments({name: np.asarray(draws[name]) for name in axes}, values, weights)


@problem
def single_trials_at_a_threshold_of_two_inputs() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(43)
    p = 1 / (1 + np.exp(-rng.normal(0.7, np.hypot(1.0, 0.5), 40)))
    y, n = rng.binomial(np.repeat([1, 3], 20), p), np.repeat([1, 3], 20)
    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 2.0), pm.HalfNormal("sigma", 2.0)
        draws = draws_of(
            lambda load, offset: 1 / (1 + np.exp(-load - offset)),
            pm.Normal.dist(mu, sigma),
            pm.Normal.dist(0.0, 0.5),
            observed=y,
            metric=prb.LogLikelihood(error=prb.readings.Binomial(n)),
        )
    x = np.linspace(-25.0, 25.0, 2001)
    logs = stats.binom(n, 1 / (1 + np.exp(-x[:, None]))).logpmf(y)

    def log_posterior(mu: Any, sigma: Any) -> Any:
        sd = np.hypot(sigma, 0.5)[:, None]
        masses = stats.norm(mu[:, None], sd).pdf(x) * (x[1] - x[0])
        prior = stats.norm(0, 2).logpdf(mu) + stats.halfnorm(scale=2).logpdf(sigma)
        return marginal(masses, logs) + prior

    grid = on_grid(log_posterior, mu=np.linspace(-2.0, 4.5, 81), sigma=np.linspace(0, 6.5, 100))
    yield from moments(draws, *grid)


# -- selection ---------------------------------------------------------------------------------------


@problem
def weibull_strengths_that_passed_a_proof_test() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(44)
    y = 3e8 * np.sqrt(rng.weibull(4.0, 40))
    y = y[y > 2.7e8]
    with pm.Model():
        shape, scale = pm.LogNormal("shape", 1.2, 0.5), pm.LogNormal("scale", 0.0, 0.3)
        draws = draws_of(
            lambda x: 3e8 * np.sqrt(x),
            pm.Weibull.dist(shape, scale),
            observed=y,
            metric=prb.LogLikelihood(selected=(2.7e8, None)),
        )
    x, least = (y / 3e8) ** 2, 0.81

    def log_posterior(shape: Any, scale: Any) -> Any:
        population = stats.weibull_min(shape[:, None], scale=scale[:, None])
        logs = (population.logpdf(x) - population.logsf(least)).sum(axis=1)
        prior = stats.norm(1.2, 0.5).logpdf(np.log(shape)) + stats.norm(0, 0.3).logpdf(
            np.log(scale)
        )
        return logs + prior - np.log(shape * scale)

    grid = on_grid(log_posterior, shape=np.linspace(0.5, 12, 201), scale=np.linspace(0.3, 2.0, 201))
    yield from moments(draws, *grid)


@problem
def a_window_before_a_fold() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(45)
    y = np.cos(rng.normal(0.6, 0.5, 60)) + rng.normal(0, 0.1, 60)
    y = y[(y > 0.5) & (y < 0.95)]
    with pm.Model():
        mu, sigma = pm.HalfNormal("mu", 1.0), pm.HalfNormal("sigma", 1.0)
        draws = draws_of(
            np.cos,
            pm.Normal.dist(mu, sigma),
            observed=y,
            metric=prb.LogLikelihood(error=0.1, selected=(0.5, 0.95)),
        )
    x = np.linspace(-40.0, 40.0, 8001)
    reading = stats.norm(np.cos(x)[:, None], 0.1)
    logs, seen = reading.logpdf(y), (reading.sf(0.5) - reading.sf(0.95))[:, 0]

    def log_posterior(mu: Any, sigma: Any) -> Any:
        masses = stats.norm(mu[:, None], sigma[:, None]).pdf(x) * (x[1] - x[0])
        prior = stats.halfnorm(scale=1).logpdf(mu) + stats.halfnorm(scale=1).logpdf(sigma)
        return marginal(masses, logs) - len(y) * np.log(masses @ seen) + prior

    grid = on_grid(log_posterior, mu=np.linspace(0.0, 4.0, 81), sigma=np.linspace(0.1, 6.0, 119))
    yield from moments(draws, *grid)


@problem
def two_outputs_of_which_one_selects() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(46)
    x = rng.lognormal(0.3, 0.4, 45)
    y = np.stack([x, 1 / x], axis=-1) + rng.normal(0, [0.1, 0.05], (45, 2))
    y = y[(y[:, 0] < 1.6) & (y[:, 1] > 0.3)]
    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 1.0), pm.HalfNormal("sigma", 0.7)
        draws = draws_of(
            lambda x: np.stack([x, 1 / x], axis=-1),
            pm.LogNormal.dist(mu, sigma),
            observed=y,
            metric=prb.LogLikelihood(error=[0.1, 0.05], selected=([-np.inf, 0.3], [1.6, np.inf])),
        )
    x = np.linspace(-8.0, 12.0, 5001)
    of_each = [stats.norm(np.exp(sign * x)[:, None], e) for sign, e in ((1, 0.1), (-1, 0.05))]
    logs = of_each[0].logpdf(y[:, 0]) + of_each[1].logpdf(y[:, 1])
    seen = (of_each[0].cdf(1.6) * of_each[1].sf(0.3))[:, 0]

    def log_posterior(mu: Any, sigma: Any) -> Any:
        masses = stats.norm(mu[:, None], sigma[:, None]).pdf(x) * (x[1] - x[0])
        prior = stats.norm(0, 1).logpdf(mu) + stats.halfnorm(scale=0.7).logpdf(sigma)
        return marginal(masses, logs) - len(y) * np.log(masses @ seen) + prior

    grid = on_grid(log_posterior, mu=np.linspace(-0.5, 2.5, 81), sigma=np.linspace(0.08, 1.6, 81))
    yield from moments(draws, *grid)


# -- replicates and repeated readings ----------------------------------------------------------------


@problem
def repeats_of_unequal_number_with_an_unknown_error() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(47)
    labels = np.repeat([f"rod {i}" for i in range(12)], rng.integers(1, 6, 12))
    order = rng.permutation(len(labels))
    names, index = np.unique(labels[order], return_inverse=True)
    x = rng.normal(1.0, 0.4, 12)
    y = 1e-9 * (np.exp(x)[index] + rng.normal(0, 0.5, len(index)))
    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 2.0), pm.HalfNormal("sigma", 1.0)
        e = pm.HalfNormal("e", 2e-9)
        draws = draws_of(
            lambda x: 1e-9 * np.exp(x),
            pm.Normal.dist(mu, sigma),
            observed=y,
            specimens=labels[order],
            metric=prb.LogLikelihood(error=e),
        )
    x = np.linspace(-7.0, 6.0, 1301)
    member = (index[:, None] == np.arange(len(names))).astype(float)

    def log_posterior(mu: Any, sigma: Any, e: Any) -> Any:
        logs = np.empty(len(e))
        for value in np.unique(e):
            at = e == value
            masses = stats.norm(mu[at, None], sigma[at, None]).pdf(x)
            readings = stats.norm(1e-9 * np.exp(x)[:, None], value).logpdf(y) @ member
            logs[at] = marginal(masses, readings)
        prior = stats.norm(0, 2).logpdf(mu) + stats.halfnorm(scale=1).logpdf(sigma)
        return logs + prior + stats.halfnorm(scale=2e-9).logpdf(e)

    grid = on_grid(
        log_posterior,
        mu=np.linspace(0.2, 1.8, 45),
        sigma=np.linspace(0.05, 1.4, 45),
        e=1e-9 * np.linspace(0.25, 1.2, 45),
    )
    yield from moments(draws, *grid)


@problem
def two_rigs_with_common_specimens() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(48)
    x = rng.weibull(2.0, 16) * 2.0
    first, second = np.arange(12), np.array([14, 3, 9, 15, 0, 13, 12, 7])
    y, z = x[first] ** 2, np.log(x[second]) + rng.normal(0, 0.2, 8)
    y = y * (1 + 0.1 * rng.normal(size=12))
    with pm.Model():
        shape, scale = pm.LogNormal("shape", 0.5, 0.5), pm.LogNormal("scale", 0.5, 1.0)
        of_rod = pm.Weibull.dist(shape, scale)
        relative = prb.LogLikelihood(error=0.1, relative=True)
        prb.Simulator("rig", lambda x: x**2, of_rod, observed=y, specimens=first, metric=relative)
        draws = draws_of(
            np.log, of_rod, observed=z, specimens=second, metric=prb.LogLikelihood(error=0.2)
        )
    u = np.linspace(-6.0, 3.0, 3001)
    x = np.exp(u)
    logs = np.zeros((len(x), 16))
    logs[:, first] += stats.norm(x[:, None] ** 2, 0.1 * x[:, None] ** 2).logpdf(y)
    logs[:, second] += stats.norm(u[:, None], 0.2).logpdf(z)

    def log_posterior(shape: Any, scale: Any) -> Any:
        density = stats.weibull_min(shape[:, None], scale=scale[:, None]).pdf(x)
        prior = stats.norm(0.5, 0.5).logpdf(np.log(shape)) + stats.norm(0.5, 1).logpdf(
            np.log(scale)
        )
        return marginal(density * x * (u[1] - u[0]), logs) + prior - np.log(shape * scale)

    grid = on_grid(log_posterior, shape=np.linspace(0.6, 5.0, 81), scale=np.linspace(0.9, 3.6, 81))
    yield from moments(draws, *grid)


@problem
def repeats_with_an_error_each_beside_gross_errors() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(49)
    labels, error = np.repeat(np.arange(10), 3), np.tile([0.1, 0.2, 0.4], 10)
    y = np.repeat(rng.uniform(1.0, 2.5, 10) ** 2, 3) + error * rng.normal(size=30)
    y[12:15] += 20.0
    with pm.Model():
        low, width = pm.Normal("low", 0.5, 1.0), pm.HalfNormal("width", 3.0)
        draws = draws_of(
            lambda x: x**2,
            pm.Uniform.dist(low, low + width),
            observed=y,
            specimens=labels,
            metric=prb.LogLikelihood(error=error, gross_errors=0.2),
        )
    x = np.linspace(-4.0, 8.0, 12001)
    logs = stats.norm(x[:, None] ** 2, error).logpdf(y)
    like = np.exp(logs.reshape(len(x), 10, 3).sum(axis=2))
    total = np.concatenate([np.zeros((1, 10)), np.cumsum(like, axis=0)]) * (x[1] - x[0])

    def log_posterior(low: Any, width: Any) -> Any:
        first, last = (np.round((x + 4.0) * 1000).astype(int) for x in (low, low + width))
        p = 0.8 * (total[last] - total[first]) / width[:, None] + 0.2 / (2 * np.ptp(y)) ** 3
        prior = stats.norm(0.5, 1).logpdf(low) + stats.halfnorm(scale=3).logpdf(width)
        return np.log(p).sum(axis=1) + prior

    grid = on_grid(log_posterior, low=np.linspace(-3.5, 2.0, 551), width=np.linspace(0.3, 5.5, 521))
    yield from moments(draws, *grid)


# -- missing outputs ---------------------------------------------------------------------------------


@problem
def a_third_of_three_outputs_is_missing() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(51)
    x, units = rng.lognormal(0.0, 0.4, 14), np.array([1e-9, 1.0, 1e6])
    f = np.stack([x, np.sqrt(x), 1 / x], axis=-1)
    y = units * (f + rng.normal(0, [0.2, 0.1, 0.3], (14, 3)))
    y[rng.random((14, 3)) < 0.35] = np.nan
    y = y[np.isfinite(y).any(axis=1)]
    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 3.0), pm.HalfNormal("sigma", 2.0)
        draws = draws_of(
            lambda x: {"charge": 1e-9 * x, "root": np.sqrt(x), "load": 1e6 / x},
            pm.LogNormal.dist(mu, sigma),
            observed=dict(zip(("root", "load", "charge"), y.T[[1, 2, 0]], strict=True)),
            metric=prb.LogLikelihood(error=[0.1, 0.3e6, 0.2e-9]),
        )
    x = np.linspace(-8.0, 8.0, 4001)
    f = np.stack([np.exp(x), np.exp(x / 2), np.exp(-x)], axis=-1)[:, None]
    logs = np.nan_to_num(stats.norm(f, [0.2, 0.1, 0.3]).logpdf(y / units)).sum(axis=-1)

    def log_posterior(mu: Any, sigma: Any) -> Any:
        masses = stats.norm(mu[:, None], sigma[:, None]).pdf(x) * (x[1] - x[0])
        prior = stats.norm(0, 3).logpdf(mu) + stats.halfnorm(scale=2).logpdf(sigma)
        return marginal(masses, logs) + prior

    grid = on_grid(log_posterior, mu=np.linspace(-0.9, 0.9, 91), sigma=np.linspace(0.03, 1.6, 91))
    yield from moments(draws, *grid)


@problem
def exact_outputs_of_two_inputs_half_of_them_missing() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(52)
    a, b = rng.normal(1.0, 0.3, 16), rng.normal(0.5, 0.4, 16)
    y = np.stack([np.exp(a + b), (a - b) ** 3 + a - b], axis=-1)
    y[:5, 0], y[5:10, 1] = np.nan, np.nan
    with pm.Model():
        mu = pm.Normal("mu", 0.5, 1.0, shape=2)
        sigma = pm.HalfNormal("sigma", 0.5, shape=2)
        draws = draws_of(
            lambda a, b: np.stack([np.exp(a + b), (a - b) ** 3 + a - b], axis=-1),
            pm.Normal.dist(mu[0], sigma[0]),
            pm.Normal.dist(mu[1], sigma[1]),
            observed=y,
        )
    u = np.stack([a + b, a - b], axis=-1)  # normal coordinates of the two outputs
    rng, t = np.random.default_rng(1), stats.t(5)
    centre, scale = np.array([1.0, 0.5, -1.1, -1.1]), np.array([0.13, 0.13, 0.55, 0.55])
    theta = centre + scale * t.rvs((400_000, 4), random_state=rng)
    log_q, (m0, m1, l0, l1) = t.logpdf((theta - centre) / scale).sum(axis=1), theta.T
    s0, s1 = np.exp(l0), np.exp(l1)
    total, apart = s0**2 + s1**2, s0**2 - s1**2
    logs = stats.norm(0.5, 1).logpdf(theta[:, :2]).sum(axis=1) + l0 + l1
    logs += stats.halfnorm(scale=0.5).logpdf(s0) + stats.halfnorm(scale=0.5).logpdf(s1)
    for i in range(16):
        z = u[i] - np.stack([m0 + m1, m0 - m1], axis=-1)
        if i < 10:
            logs += stats.norm(0, np.sqrt(total)).logpdf(z[:, 1 if i < 5 else 0])
        else:
            determinant = total**2 - apart**2
            square = total * (z**2).sum(axis=1) - 2 * apart * z.prod(axis=1)
            logs += -0.5 * square / determinant - 0.5 * np.log(determinant)
    logs = np.nan_to_num(logs - log_q, nan=-np.inf)
    weights = np.exp(logs - logs.max())
    names = [(name, k) for name in ("mu", "sigma") for k in (0, 1)]
    of_draws = {f"{name}[{k}]": draws[name].values[..., k] for name, k in names}
    values = dict(zip(of_draws, (m0, m1, s0, s1), strict=True))
    yield from moments(of_draws, values, weights / weights.sum())


@problem
def a_curve_of_which_specimens_failed_early() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(53)
    times, x = np.array([0.5, 1.0, 2.0, 3.0]), rng.gamma(6.0, 0.1, 12)
    f = np.exp(-x[:, None] * times)
    y = f + rng.normal(0, 0.05, f.shape)
    y[f < 0.25] = np.nan
    table = pd.DataFrame(y, columns=times)
    with pm.Model():
        mean, sd = pm.HalfNormal("mean", 2.0), pm.HalfNormal("sd", 2.0)
        e = pm.HalfNormal("e", 0.2)
        draws = draws_of(
            lambda x: np.exp(-x[..., None] * times),
            pm.Gamma.dist(mu=mean, sigma=sd),
            observed=table.dropna(how="all"),
            metric=prb.LogLikelihood(error=e),
        )
    x = np.linspace(0.0005, 4.0, 4000)
    f, y = np.exp(-x[:, None] * times)[:, None], y[np.isfinite(y).any(axis=1)]

    def log_posterior(mean: Any, sd: Any, e: Any) -> Any:
        logs = np.empty(len(e))
        for value in np.unique(e):
            at = e == value
            shape, scale = (mean[at] / sd[at])[:, None] ** 2, (sd[at] ** 2 / mean[at])[:, None]
            of_readings = np.nan_to_num(stats.norm(f, value).logpdf(y)).sum(axis=-1)
            logs[at] = marginal(stats.gamma(shape, scale=scale).pdf(x), of_readings)
        prior = stats.halfnorm(scale=2).logpdf(mean) + stats.halfnorm(scale=2).logpdf(sd)
        return logs + prior + stats.halfnorm(scale=0.2).logpdf(e)

    grid = on_grid(
        log_posterior,
        mean=np.linspace(0.2, 1.4, 41),
        sd=np.linspace(0.05, 1.0, 41),
        e=np.linspace(0.02, 0.13, 31),
    )
    yield from moments(draws, *grid)


# -- known nuisance inputs ---------------------------------------------------------------------------


@problem
def a_known_tolerance_to_the_third_power() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(54)
    modulus, h = rng.lognormal(np.log(2e11), 0.03, 20), rng.lognormal(np.log(2e-3), 0.04, 20)
    y = 1e3 / (modulus * h**3)
    with pm.Model():
        mu, sigma = pm.Normal("mu", 26.0, 1.0), pm.HalfNormal("sigma", 0.3)
        draws = draws_of(
            lambda modulus, h: 1e3 / (modulus * h**3),
            pm.LogNormal.dist(mu, sigma),
            pm.LogNormal.dist(np.log(2e-3), 0.04),
            observed=y,
        )
    z = np.log(1e3 / y) - 3 * np.log(2e-3)

    def log_posterior(mu: Any, sigma: Any) -> Any:
        logs = stats.norm(mu[:, None], np.hypot(sigma, 0.12)[:, None]).logpdf(z).sum(axis=1)
        return logs + stats.norm(26, 1).logpdf(mu) + stats.halfnorm(scale=0.3).logpdf(sigma)

    grid = on_grid(log_posterior, mu=np.linspace(25.7, 26.3, 241), sigma=np.linspace(0, 0.4, 400))
    yield from moments(draws, *grid)


@problem
def a_phase_of_which_nothing_is_known() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(55)
    x, phase = rng.normal(2.0, 0.2, 24), rng.uniform(0.0, 1.0, 24)
    y = x + 0.5 * np.sin(2 * np.pi * phase)
    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 5.0), pm.HalfNormal("sigma", 1.0)
        draws = draws_of(
            lambda x, phase: x + 0.5 * np.sin(2 * np.pi * phase),
            pm.Normal.dist(mu, sigma),
            pm.Uniform.dist(0.0, 1.0),
            observed=y,
        )
    shift = 0.5 * np.sin(2 * np.pi * (np.arange(2000) + 0.5) / 2000)
    edges = np.linspace(-0.5 - 1e-9, 0.5 + 1e-9, 801)
    share, middle = np.histogram(shift, edges)[0] / 2000, (edges[1:] + edges[:-1]) / 2

    def log_posterior(mu: Any, sigma: Any) -> Any:
        logs = np.empty(len(mu))
        for m in np.unique(mu):
            at = mu == m
            square = (y[:, None] - middle - m) ** 2
            for s, place in zip(sigma[at], np.flatnonzero(at), strict=True):
                logs[place] = np.log(np.exp(-square / (2 * s * s)) @ share / s).sum()
        return logs + stats.norm(0, 5).logpdf(mu) + stats.halfnorm(scale=1).logpdf(sigma)

    grid = on_grid(log_posterior, mu=np.linspace(1.7, 2.5, 41), sigma=np.linspace(0.03, 0.8, 60))
    yield from moments(draws, *grid)


@problem
def a_known_gain_of_readings_with_an_unknown_error() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(56)
    x, gain = rng.weibull(3.0, 15), rng.uniform(0.8, 1.2, 15)
    f = np.stack([x * gain, gain], axis=-1)
    y = 1e6 * (f + rng.normal(0, 0.05, f.shape))
    with pm.Model():
        shape, scale = pm.LogNormal("shape", 1.0, 0.7), pm.LogNormal("scale", 0.0, 1.0)
        e = pm.HalfNormal("e", 2e5)
        draws = draws_of(
            lambda x, gain: 1e6 * np.stack([x * gain, gain], axis=-1),
            pm.Weibull.dist(shape, scale),
            pm.Uniform.dist(0.8, 1.2),
            observed=y,
            metric=prb.LogLikelihood(error=e),
        )
    x, gain = np.linspace(0.01, 4.0, 500), 0.8 + 0.4 * (np.arange(160) + 0.5) / 160
    y = y / 1e6

    def log_posterior(shape: Any, scale: Any, e: Any) -> Any:
        logs = np.empty(len(e))
        for value in np.unique(e):
            at = e == value
            first = stats.norm(x[:, None, None] * gain[:, None], value).pdf(y[:, 0])
            like = (first * stats.norm(gain[:, None], value).pdf(y[:, 1])).mean(axis=1)
            masses = stats.weibull_min(shape[at, None], scale=scale[at, None]).pdf(x)
            logs[at] = np.log(masses @ like + 1e-300).sum(axis=1)
        prior = stats.norm(1, 0.7).logpdf(np.log(shape)) + stats.norm.logpdf(np.log(scale))
        return logs + prior - np.log(shape * scale) + stats.halfnorm(scale=0.2).logpdf(e)

    grid = on_grid(
        log_posterior,
        shape=np.linspace(1.2, 6.5, 45),
        scale=np.linspace(0.6, 1.4, 45),
        e=np.linspace(0.002, 0.25, 63),
    )
    draws = {"shape": draws["shape"], "scale": draws["scale"], "e": draws["e"] / 1e6}
    yield from moments(draws, *grid)


# -- fewer readings than inputs ----------------------------------------------------------------------


@problem
def the_radius_of_two_centred_inputs() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(57)
    y = np.hypot(*rng.normal(0.0, 2.0, (2, 15)))
    with pm.Model():
        sigma = pm.HalfNormal("sigma", 10.0)
        draws = draws_of(
            np.hypot, pm.Normal.dist(0.0, sigma), pm.Normal.dist(0.0, sigma), observed=y
        )
        optimum = prb.minimize()
    best = np.sqrt((y**2).mean() / 2)
    stderr = best / (2 * np.sqrt(15))
    yield difference("optimum", optimum.point["sigma"], best, 0.1 * stderr)
    yield difference("its standard error", optimum.stderr["sigma"], stderr, 0.1 * stderr)

    def log_posterior(sigma: Any) -> Any:
        return stats.rayleigh(scale=sigma[:, None]).logpdf(y).sum(axis=1) + stats.halfnorm(
            scale=10
        ).logpdf(sigma)

    yield from moments(draws, *on_grid(log_posterior, sigma=np.linspace(0.8, 5.0, 2001)))


@problem
def a_product_of_lognormal_inputs() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(58)
    y = 1e-9 * np.exp(rng.normal(1.0, 0.5, 12))
    with pm.Model():
        mu = pm.Normal("mu", 0.0, [2.0, 0.3], shape=2)
        sigma = pm.HalfNormal("sigma", [1.0, 0.5], shape=2)
        draws = draws_of(
            lambda a, b: 1e-9 * a * b,
            pm.LogNormal.dist(mu[0], sigma[0]),
            pm.LogNormal.dist(mu[1], sigma[1]),
            observed=y,
        )
    z = np.log(1e9 * y)

    def log_posterior(s0: Any, s1: Any) -> Any:
        variance, between = s0**2 + s1**2, 2.0**2 + 0.3**2
        total = variance + 12 * between
        square = ((z - z.mean()) ** 2).sum() / variance + 12 * z.mean() ** 2 / total
        logs = -0.5 * square - 5.5 * np.log(variance) - 0.5 * np.log(total)
        return logs + stats.halfnorm(scale=1).logpdf(s0) + stats.halfnorm(scale=0.5).logpdf(s1)

    values, weights = on_grid(
        log_posterior, s0=np.linspace(0.001, 2.5, 400), s1=np.linspace(0.001, 1.5, 400)
    )
    of_draws = {f"s{k}": draws["sigma"].values[..., k] for k in (0, 1)}
    yield from moments(of_draws, values, weights)


@problem
def the_largest_load_of_three_smooth_ones() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(59)
    loads = rng.gamma(4.0, 1.0, (40, 3))
    y = (loads**3).sum(axis=1) + rng.normal(0, 20.0, 40)
    with pm.Model():
        shape, scale = pm.LogNormal("shape", 1.0, 0.5), pm.LogNormal("scale", 0.0, 0.5)
        inputs = [pm.Gamma.dist(shape, 1 / scale) for _ in range(3)]
        draws = draws_of(
            lambda a, b, c: a**3 + b**3 + c**3,
            *inputs,
            observed=y,
            metric=prb.LogLikelihood(error=20.0),
        )
    # The density of a sum of cubes by two convolutions on a grid
    step, size = 1.0, 2**14
    edges = step * np.arange(size + 1)

    def log_posterior(shape: Any, scale: Any) -> Any:
        noise = np.exp(-0.5 * (2 * np.pi * np.fft.rfftfreq(size, step) * 20.0) ** 2)
        result = np.empty(len(shape))
        for k, (a, s) in enumerate(zip(shape, scale, strict=True)):
            masses = np.diff(stats.gamma(a, scale=s).cdf(np.cbrt(edges)))
            density = np.fft.irfft(np.fft.rfft(masses) ** 3 * noise, size)
            at = np.interp(y - 1.5 * step, edges[:-1], density)
            result[k] = np.log(np.maximum(at, 1e-300)).sum()
        prior = stats.norm(1, 0.5).logpdf(np.log(shape)) + stats.norm(0, 0.5).logpdf(np.log(scale))
        return result + prior - np.log(shape * scale)

    grid = on_grid(log_posterior, shape=np.linspace(1.0, 9.0, 41), scale=np.linspace(0.3, 2.6, 47))
    yield from moments(draws, *grid)
