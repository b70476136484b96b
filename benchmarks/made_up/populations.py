"""Made-up problems of populations of many kinds, under the log-likelihood by specimen."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import arviz as az
import numpy as np
import pandas as pd
import pymc as pm
from scipy import optimize, special, stats
from scipy.stats import qmc

import prbayes as prb
from benchmarks.made_up import difference, moments, on_grid, problem


def by_importance(log_posterior: Callable[[Any], Any], start: Any, n: int = 15) -> tuple[Any, Any]:
    """Return points, (2^n, d), with normalised importance weights of a density of one mode.

    The proposal is a t distribution with 5 degrees of freedom about the mode, at Sobol points.
    ``log_posterior`` takes (S, d).
    """

    def loss(theta: Any) -> float:
        value = -float(log_posterior(theta[None])[0])
        return value if np.isfinite(value) else 1e10

    options = {"xatol": 1e-6, "fatol": 1e-8, "maxiter": 20000, "maxfev": 20000}
    mode = np.asarray(start, dtype=float)
    for _ in range(3):
        mode = optimize.minimize(loss, mode, method="Nelder-Mead", options=options).x
    d = len(mode)
    cube = np.clip(qmc.Sobol(d + 1, seed=1).random_base2(n), 1e-9, 1 - 1e-9)
    t = special.ndtri(cube[:, :d]) / np.sqrt(stats.chi2(5).ppf(cube[:, d:]) / 5)
    # The scale starts from differences at the mode, and is adapted twice.
    step = 1e-3 * np.maximum(1.0, np.abs(mode))
    scale = [(2 * loss(mode) - loss(mode + e) - loss(mode - e)) for e in np.diag(step)]
    root = np.diag(step / np.sqrt(np.maximum(-np.asarray(scale), 1e-12)))
    centre = mode
    for _ in range(4):
        points = centre + t @ root.T
        logs = log_posterior(points) + (5 + d) / 2 * np.log1p((t**2).sum(axis=1) / 5)
        logs = np.where(np.isfinite(logs), logs, -np.inf)
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        centre_next = weights @ points
        covariance = np.cov(points.T, aweights=weights).reshape(d, d)
        if 1 / (weights**2).sum() > 0.3 * len(weights):
            break
        centre, root = centre_next, np.linalg.cholesky(covariance + 1e-12 * np.eye(d))
    assert 1 / (weights**2).sum() > 0.1 * len(weights), "the reference has too few points"
    return points, weights


def normal_nodes(n: int, reach: float = 8.0) -> tuple[Any, Any]:
    """Return equidistant standard normal scores and their probabilities."""
    z = np.linspace(-reach, reach, n)
    weights = stats.norm.pdf(z)
    return z, weights / weights.sum()


# -- correlated inputs -----------------------------------------------------------------------------


@problem
def correlated_inputs_in_odd_units() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(21)
    x = rng.multivariate_normal([1.0, -0.5], [[0.09, 0.042], [0.042, 0.04]], 12)

    def response(x: Any) -> Any:
        first, second = np.exp(x[..., 0]), np.exp(x[..., 1] - x[..., 0] / 2)
        return np.stack([1e6 * first, 1e-9 * second], axis=-1)

    with pm.Model():
        mean = pm.Normal("mean", [0.0, 0.0], [2.0, 2.0])
        sds = pm.HalfNormal.dist([1.0, 1.0])
        chol, _, _ = pm.LKJCholeskyCov("chol", n=2, eta=2, sd_dist=sds)
        prb.Simulator("y", response, pm.MvNormal.dist(mean, chol=chol), observed=response(x))
        draws = prb.sample(random_seed=1).posterior

    def log_posterior(theta: Any) -> Any:
        m, s, rho = theta[:, :2], np.exp(theta[:, 2:4]), np.tanh(theta[:, 4])
        z = (x[:, None] - m) / s
        square = (z[..., 0] ** 2 - 2 * rho * z[..., 0] * z[..., 1] + z[..., 1] ** 2) / (1 - rho**2)
        logs = -0.5 * square.sum(axis=0) - 12 * (theta[:, 2] + theta[:, 3])
        logs -= 6 * np.log1p(-(rho**2))
        logs += stats.norm(0, 2).logpdf(m).sum(axis=1)
        logs += (stats.halfnorm.logpdf(s) + theta[:, 2:4]).sum(axis=1)
        return logs + 2 * np.log1p(-(rho**2))  # LKJ with eta = 2, and the change to atanh

    points, weights = by_importance(log_posterior, [1.0, -0.5, -1.2, -1.6, 0.7])
    sd = draws["chol_stds"].values
    got = {
        "mean 0": draws["mean"].values[..., 0],
        "mean 1": draws["mean"].values[..., 1],
        "log sd 0": np.log(sd[..., 0]),
        "log sd 1": np.log(sd[..., 1]),
        "atanh": np.arctanh(draws["chol_corr"].values[..., 0, 1]),
    }
    yield from moments(got, dict(zip(got, points.T, strict=True)), weights)


@problem
def one_output_of_two_inputs_of_known_correlation() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(22)
    covariance = np.array([[0.25, -0.135], [-0.135, 0.09]])
    x = rng.multivariate_normal([2.0, 1.0], covariance, 20)

    def response(x: Any) -> Any:
        return x[..., 0] + x[..., 1] ** 2

    y = response(x)
    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 5.0), pm.HalfNormal("sigma", 2.0)
        c = -0.9 * 0.3 * sigma
        rows = [pm.math.stack([sigma**2, c]), pm.math.stack([c, 0.09])]
        population = pm.MvNormal.dist(pm.math.stack([mu, 1.0]), pm.math.stack(rows))
        prb.Simulator("y", response, population, observed=y)
        draws = prb.sample(random_seed=1).posterior

    z, p = normal_nodes(301)
    left = y[:, None] - (1.0 + 0.3 * z) ** 2  # of the first input

    def log_posterior(mu: Any, sigma: Any) -> Any:
        logs = stats.norm(0, 5).logpdf(mu) + stats.halfnorm(scale=2).logpdf(sigma)
        for k in range(len(mu)):
            density = stats.norm.pdf(left, mu[k] - 0.9 * sigma[k] * z, np.sqrt(0.19) * sigma[k])
            logs[k] += np.log(density @ p).sum()
        return logs

    axes = {"mu": np.linspace(0.9, 3.1, 45), "sigma": np.linspace(0.1, 2.0, 60)}
    values, weights = on_grid(log_posterior, **axes)
    yield from moments(draws, values, weights)


@problem
def three_correlated_inputs_with_missing_readings() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(23)
    scale = np.array([0.3, 0.5, 2e5])
    correlation = np.array([[1.0, 0.6, -0.3], [0.6, 1.0, 0.2], [-0.3, 0.2, 1.0]])
    covariance = scale[:, None] * correlation * scale
    x = rng.multivariate_normal([1.0, 2.0, 1e6], covariance, 10)
    x[[0, 3, 5], [1, 2, 0]] = np.nan
    x[7, :2] = np.nan

    def response(x: Any) -> Any:
        a, b, c = np.moveaxis(np.asarray(x), -1, 0)
        return np.stack([1e-9 * np.exp(a), b + b**3 / 10, np.cbrt(c)], axis=-1)

    with pm.Model():
        mean = pm.Normal("mean", [0.0, 0.0, 0.0], [10.0, 10.0, 3e6])
        prb.Simulator("y", response, pm.MvNormal.dist(mean, covariance), observed=response(x))
        draws = prb.sample(random_seed=1).posterior["mean"].values.reshape(-1, 3)

    precision, shift = np.diag(1 / np.array([10.0, 10.0, 3e6]) ** 2), np.zeros(3)
    for row in x:
        seen = np.flatnonzero(np.isfinite(row))
        inverse = np.linalg.inv(covariance[np.ix_(seen, seen)])
        precision[np.ix_(seen, seen)] += inverse
        shift[seen] += inverse @ row[seen]
    exact = np.linalg.inv(precision)
    sd = np.sqrt(np.diag(exact))
    yield difference("means", draws.mean(axis=0), exact @ shift, 0.1 * sd)
    yield difference("sds", draws.std(axis=0), sd, 0.1 * sd)
    correlations = np.corrcoef(draws.T) - exact / np.outer(sd, sd)
    yield difference("correlations", correlations, 0.0, 0.1)


# -- sinh-arcsinh families -------------------------------------------------------------------------


def sinh_arcsinh(x: Any, mu: Any, s: Any, skew: Any, *, tail: Any) -> Any:
    """Return the log-density, by the derivative of the score."""
    u = (x - mu) / (s * tail)
    score = np.sinh(tail * np.arcsinh(u) - skew)
    slope = np.sqrt(1 + score**2) / np.sqrt(1 + u**2) / s
    return stats.norm.logpdf(score) + np.log(slope)


@problem
def four_parameters_of_a_sinh_arcsinh_input() -> Iterator[tuple[str, float]]:
    x = 3.0 - np.random.default_rng(24).gamma(2.0, 0.5, 40)

    def response(x: Any) -> Any:
        return np.expm1(0.8 * x)

    with pm.Model():
        mu, s = pm.Normal("mu", 0.0, 10.0), pm.HalfNormal("s", 3.0)
        population = prb.families.SinhArcsinh.dist(mu, s, name="x")
        prb.Simulator("y", response, population, observed=response(x))
        draws = prb.sample(random_seed=1).posterior

    def log_posterior(theta: Any) -> Any:
        mu, s, skew, tail = theta[:, 0], np.exp(theta[:, 1]), theta[:, 2], np.exp(theta[:, 3])
        logs = sinh_arcsinh(x[:, None], mu, s, skew, tail=tail).sum(axis=0)
        logs += stats.norm(0, 10).logpdf(mu) + stats.halfnorm(scale=3).logpdf(s) + theta[:, 1]
        logs += stats.norm(0, 0.35).logpdf(skew) + stats.norm(0, 0.25).logpdf(theta[:, 3])
        return logs

    points, weights = by_importance(log_posterior, [2.0, -0.5, 0.0, 0.0])
    got = {
        "mu": draws["mu"].values,
        "log s": np.log(draws["s"].values),
        "skew": draws["x_skew"].values,
        "log tail": np.log(draws["x_tail"].values),
    }
    yield from moments(got, dict(zip(got, points.T, strict=True)), weights)


@problem
def tiny_log_sinh_arcsinh_input_of_known_shape() -> Iterator[tuple[str, float]]:
    z = np.random.default_rng(25).normal(size=15)
    x = np.exp(-20.0 + 0.4 * 0.7 * np.sinh((np.arcsinh(z) + 0.5) / 0.7))

    def response(x: Any) -> Any:
        return 1e-3 / x

    with pm.Model():
        mu, s = pm.Normal("mu", -20.0, 3.0), pm.HalfNormal("s", 2.0)
        population = prb.families.LogSinhArcsinh.dist(mu, s, name="x", skew=0.5, tail=0.7)
        prb.Simulator("y", response, population, observed=response(x))
        draws = prb.sample(random_seed=1).posterior

    def log_posterior(mu: Any, s: Any) -> Any:
        logs = sinh_arcsinh(np.log(x)[:, None], mu, s, 0.5, tail=0.7).sum(axis=0)
        return logs + stats.norm(-20, 3).logpdf(mu) + stats.halfnorm(scale=2).logpdf(s)

    axes = {"mu": np.linspace(-20.8, -19.2, 401), "s": np.linspace(0.1, 1.2, 401)}
    values, weights = on_grid(log_posterior, **axes)
    yield from moments(draws, values, weights)


@problem
def skewness_from_ten_readings_with_an_error() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(26)
    x = 0.6 * rng.standard_t(4, 10) + 0.5

    def response(x: Any) -> Any:
        return x + x**3

    y = response(x) + 0.5 * rng.normal(size=10)
    with pm.Model():
        mu, s = pm.Normal("mu", 0.0, 2.0), pm.HalfNormal("s", 1.0)
        skew = pm.Normal("skew", 0.0, 0.5)
        population = prb.families.SinhArcsinh.dist(mu, s, name="x", skew=skew, tail=0.8)
        metric = prb.LogLikelihood(error=0.5)
        prb.Simulator("y", response, population, metric=metric, observed=y)
        draws = prb.sample(random_seed=1).posterior

    # One specimen is at x = -11.7, where its reading determines x to .001.
    about = x.min() + np.linspace(-0.01, 0.01, 201)
    nodes = np.sort(np.r_[np.linspace(-14, 6, 1401), about])
    of_reading = stats.norm.pdf(y[:, None], response(nodes), 0.5) * np.gradient(nodes)

    def log_posterior(mu: Any, s: Any, skew: Any) -> Any:
        logs = stats.norm(0, 2).logpdf(mu) + stats.halfnorm(scale=1).logpdf(s)
        logs += stats.norm(0, 0.5).logpdf(skew)
        for block in np.array_split(np.arange(len(mu)), 60):
            parts = (v[block, None] for v in (mu, s, skew))
            density = np.exp(sinh_arcsinh(nodes, *parts, tail=0.8))
            logs[block] += np.log(density @ of_reading.T + 1e-300).sum(axis=1)
        return logs

    axes = {
        "mu": np.linspace(-0.5, 3.0, 31),
        "s": np.linspace(0.05, 3.2, 41),
        "skew": np.linspace(-2.2, 0.8, 25),
    }
    values, weights = on_grid(log_posterior, **axes)
    yield from moments(draws, values, weights)


# -- mixtures --------------------------------------------------------------------------------------


@problem
def share_of_the_second_kind_of_specimens() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(31)
    x = np.where(rng.random(25) < 0.3, rng.normal(4.0, 0.3, 25), rng.normal(1.0, 0.5, 25))

    def response(x: Any) -> Any:
        return 1e6 * (x + 0.1 * x**2)

    with pm.Model():
        w = pm.Beta("w", 1.0, 1.0)
        mu = pm.Normal("mu", 0.0, 5.0)
        population = pm.NormalMixture.dist(
            pm.math.stack([1 - w, w]), mu=pm.math.stack([mu, 4.0]), sigma=[0.5, 0.3]
        )
        prb.Simulator("y", response, population, observed=response(x))
        draws = prb.sample(random_seed=1).posterior

    def log_posterior(w: Any, mu: Any) -> Any:
        population = stats.norm(mu[:, None], 0.5)
        first = population.pdf(x) + population.pdf(-10.0 - x)  # both roots of a reading
        density = (1 - w[:, None]) * first + w[:, None] * stats.norm(4.0, 0.3).pdf(x)
        return np.log(density).sum(axis=1) + stats.norm(0, 5).logpdf(mu)

    axes = {"w": np.linspace(0.0025, 0.9975, 200), "mu": np.linspace(-12.0, 2.0, 1401)}
    values, weights = on_grid(log_posterior, **axes)
    yield from moments(draws, values, weights)


@problem
def lognormal_and_weibull_specimens_with_errors() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(32)
    x = np.where(rng.random(30) < 0.4, rng.lognormal(0.0, 0.3, 30), 4.0 * rng.weibull(6, 30))

    def response(x: Any) -> Any:
        return x**1.5

    y = response(x) + 0.2 * rng.normal(size=30)
    with pm.Model():
        w, mu = pm.Beta("w", 2.0, 2.0), pm.Normal("mu", 0.0, 1.0)
        parts = [pm.LogNormal.dist(mu, 0.3), pm.Weibull.dist(6.0, 4.0)]
        population = pm.Mixture.dist(pm.math.stack([w, 1 - w]), parts)
        metric = prb.LogLikelihood(error=0.2)
        prb.Simulator("y", response, population, metric=metric, observed=y)
        draws = prb.sample(random_seed=1).posterior

    nodes = (np.arange(4000) + 0.5) * 0.0025
    of_reading = stats.norm.pdf(y[:, None], response(nodes), 0.2) * 0.0025
    second = of_reading @ stats.weibull_min(6, scale=4).pdf(nodes)

    def log_posterior(w: Any, mu: Any) -> Any:
        places, index = np.unique(mu, return_inverse=True)
        first = of_reading @ stats.lognorm(0.3, scale=np.exp(places)).pdf(nodes[:, None])
        density = w * first[:, index] + (1 - w) * second[:, None]
        logs = np.log(density).sum(axis=0) + stats.norm(0, 1).logpdf(mu)
        return logs + stats.beta(2, 2).logpdf(w)

    axes = {"w": np.linspace(0.005, 0.995, 199), "mu": np.linspace(-0.8, 1.6, 241)}
    values, weights = on_grid(log_posterior, **axes)
    yield from moments(draws, values, weights)


@problem
def two_exchangeable_kinds_of_specimens() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(33)
    x = np.where(rng.random(16) < 0.5, rng.normal(-1.5, 0.4, 16), rng.normal(1.0, 0.4, 16))

    def response(x: Any) -> Any:
        return np.exp(x) - 3.0

    with pm.Model():
        mu = pm.Normal("mu", [0.0, 0.0], 3.0)
        population = pm.NormalMixture.dist([0.5, 0.5], mu=mu, sigma=0.4)
        prb.Simulator("y", response, population, observed=response(x))
        draws = prb.sample(random_seed=1).posterior["mu"].values.reshape(-1, 2)

    def log_posterior(low: Any, high: Any) -> Any:
        density = stats.norm(low[:, None], 0.4).pdf(x) + stats.norm(high[:, None], 0.4).pdf(x)
        return np.log(density).sum(axis=1) + stats.norm(0, 3).logpdf([low, high]).sum(axis=0)

    axes = {"low": np.linspace(-2.5, -0.5, 301), "high": np.linspace(0.0, 2.0, 301)}
    values, weights = on_grid(log_posterior, **axes)
    yield from moments({"low": draws.min(axis=1), "high": draws.max(axis=1)}, values, weights)
    yield difference("share of labels", (draws[:, 0] < draws[:, 1]).mean(), 0.5, 0.1)


# -- truncated and bounded populations -------------------------------------------------------------


@problem
def normal_population_truncated_near_its_mean() -> Iterator[tuple[str, float]]:
    x = stats.truncnorm(-0.5, np.inf, loc=0.5, scale=1.0).rvs(30, random_state=34)

    def response(x: Any) -> Any:
        return np.log1p(x) * 1e-9

    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 1.0), pm.HalfNormal("sigma", 2.0)
        population = pm.TruncatedNormal.dist(mu, sigma, lower=0.0)
        prb.Simulator("y", response, population, observed=response(x))
        draws = prb.sample(random_seed=1).posterior

    def log_posterior(mu: Any, sigma: Any) -> Any:
        logs = stats.norm(mu[:, None], sigma[:, None]).logpdf(x).sum(axis=1)
        logs -= 30 * stats.norm.logcdf(mu / sigma)
        return logs + stats.norm(0, 1).logpdf(mu) + stats.halfnorm(scale=2).logpdf(sigma)

    axes = {"mu": np.linspace(-4.0, 2.0, 301), "sigma": np.linspace(0.3, 3.5, 321)}
    values, weights = on_grid(log_posterior, **axes)
    yield from moments(draws, values, weights)


@problem
def truncated_gamma_of_a_folded_response() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(35)
    x = rng.gamma(3.0, 1.0, 60)
    x = x[x < 4.0][:25]

    def response(x: Any) -> Any:
        return (x - 1.5) ** 2 + 0.2 * x

    y = response(x)
    with pm.Model():
        alpha, beta = pm.LogNormal("alpha", 1.0, 0.7), pm.LogNormal("beta", 0.0, 0.7)
        population = pm.Truncated.dist(pm.Gamma.dist(alpha, beta), upper=4.0)
        prb.Simulator("y", response, population, observed=y)
        draws = prb.sample(random_seed=1).posterior

    # Roots of x^2 - 2.8 x + 2.25 - y.
    half = np.sqrt(1.4**2 - 2.25 + y)
    roots, slope = np.stack([1.4 - half, 1.4 + half]), 2 * half

    def log_posterior(alpha: Any, beta: Any) -> Any:
        gamma = stats.gamma(alpha[:, None, None], scale=1 / beta[:, None, None])
        density = np.where((roots > 0) & (roots < 4.0), gamma.pdf(np.maximum(roots, 1e-9)), 0.0)
        logs = np.log(density.sum(axis=1) / slope).sum(axis=1)
        logs -= len(y) * np.log(special.gammainc(alpha, 4.0 * beta))
        logs += stats.norm(1, 0.7).logpdf(np.log(alpha)) - np.log(alpha)
        return logs + stats.norm(0, 0.7).logpdf(np.log(beta)) - np.log(beta)

    axes = {"alpha": np.linspace(0.3, 14.0, 180), "beta": np.linspace(0.02, 6.0, 180)}
    values, weights = on_grid(log_posterior, **axes)
    yield from moments(draws, values, weights)


@problem
def uniform_population_of_an_unknown_end() -> Iterator[tuple[str, float]]:
    x = np.random.default_rng(36).uniform(0.0, 3.0, 8)

    def response(x: Any) -> Any:
        return 1e6 / (1.0 + x)

    with pm.Model():
        end = pm.HalfNormal("end", 10.0)
        prb.Simulator("y", response, pm.Uniform.dist(0.0, end), observed=response(x))
        draws = prb.sample(random_seed=1).posterior

    ends = np.linspace(x.max(), 40.0, 200001)
    logs = stats.halfnorm(scale=10).logpdf(ends) - 8 * np.log(ends)
    weights = np.exp(logs - logs.max())
    yield from moments(draws, {"end": ends}, weights / weights.sum())


@problem
def beta_population_of_a_share() -> Iterator[tuple[str, float]]:
    x = np.random.default_rng(37).beta(2.0, 5.0, 20)

    def response(x: Any) -> Any:
        return x / (1.0 - x)

    with pm.Model():
        mean, nu = pm.Beta("mean", 1.0, 1.0), pm.LogNormal("nu", 2.0, 1.0)
        population = pm.Beta.dist(mean * nu, (1 - mean) * nu)
        prb.Simulator("y", response, population, observed=response(x))
        draws = prb.sample(random_seed=1).posterior

    def log_posterior(mean: Any, nu: Any) -> Any:
        population = stats.beta((mean * nu)[:, None], ((1 - mean) * nu)[:, None])
        logs = population.logpdf(x).sum(axis=1)
        return logs + stats.norm(2, 1).logpdf(np.log(nu)) - np.log(nu)

    axes = {"mean": np.linspace(0.1, 0.6, 251), "nu": np.linspace(0.5, 40.0, 300)}
    values, weights = on_grid(log_posterior, **axes)
    yield from moments(draws, values, weights)


# -- groups ----------------------------------------------------------------------------------------


@problem
def groups_of_very_different_sizes() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(41)
    names = ["A", "B", "C", "D"]
    who = np.repeat([0, 1, 2, 3], [1, 2, 15, 6])
    x = rng.normal(rng.normal(2.0, 0.5, 4)[who], 0.3)

    def response(x: Any) -> Any:
        return np.sinh(x) * 1e-9

    data = pd.Series(response(x), index=pd.Index(np.array(names)[who], name="maker"))
    with pm.Model(coords={"maker": names}):
        m, tau = pm.Normal("m", 0.0, 5.0), pm.HalfNormal("tau", 1.0)
        mu = pm.Normal("mu", m, tau, dims="maker")
        another = pm.Normal("another", m, tau)
        sigma = pm.HalfNormal("sigma", 1.0)
        population = pm.Normal.dist(mu[prb.response.group("maker")], sigma)
        prb.Simulator("y", response, population, observed=data)
        draws = prb.sample(random_seed=1).posterior

    assert another.name in draws
    n, total = np.bincount(who, minlength=5), np.bincount(who, x, minlength=5)
    within = sum(((x[who == g] - x[who == g].mean()) ** 2).sum() for g in range(4))
    middle = total / np.maximum(n, 1)

    def log_posterior(m: Any, tau: Any, sigma: Any) -> Any:
        logs = stats.norm(0, 5).logpdf(m) + stats.halfnorm.logpdf(tau)
        logs += stats.halfnorm.logpdf(sigma) - within / (2 * sigma**2) - 20 * np.log(sigma)
        for g in range(4):
            logs += stats.norm.logpdf(middle[g], m, np.sqrt(tau**2 + sigma**2 / n[g]))
        return logs

    axes = {
        "m": np.linspace(-1.0, 5.0, 121),
        "tau": np.linspace(0.005, 3.5, 140),
        "sigma": np.linspace(0.15, 0.7, 80),
    }
    values, weights = on_grid(log_posterior, **axes)
    yield from moments(draws, values, weights)
    m, tau, sigma = values.values()
    for g, name in enumerate([*names, another.name]):
        variance = 1 / (1 / tau**2 + n[g] / sigma**2)
        centre = variance * (m / tau**2 + total[g] / sigma**2)
        mean = weights @ centre
        sd = np.sqrt(weights @ (variance + (centre - mean) ** 2))
        drawn = (draws[name] if name in draws else draws["mu"].sel(maker=name)).values
        yield difference(f"mean of {name}", drawn.mean(), mean, 0.1 * sd)
        yield difference(f"sd of {name}", drawn.std(), sd, 0.1 * sd)


@problem
def weibull_groups_of_five_with_a_common_shape() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(42)
    scales, who = np.array([1.0, 1.5, 4.0]), np.repeat([0, 1, 2], 5)
    x = scales[who] * rng.weibull(3.0, 15)

    def response(x: Any) -> Any:
        return 1e3 * x**2 / (1.0 + x)

    index = pd.Index(np.array(["a", "b", "c"])[who], name="lot")
    data = pd.DataFrame({"y": response(x)}, index=index)["y"]
    with pm.Model(coords={"lot": ["a", "b", "c"]}):
        alpha = pm.LogNormal("alpha", 1.0, 1.0)
        beta = pm.LogNormal("beta", 0.0, 2.0, dims="lot")
        population = pm.Weibull.dist(alpha, beta[prb.response.group("lot")])
        prb.Simulator("y", response, population, observed=data)
        draws = prb.sample(random_seed=1).posterior

    alphas, logs_beta = np.linspace(0.8, 7.0, 250), np.linspace(-3.0, 4.0, 1401)
    total = stats.norm(1, 1).logpdf(np.log(alphas)) - np.log(alphas)
    conditional = []
    for g in range(3):
        population = stats.weibull_min(alphas[:, None, None], scale=np.exp(logs_beta)[:, None])
        logs = population.logpdf(x[who == g]).sum(axis=-1) + stats.norm(0, 2).logpdf(logs_beta)
        total += special.logsumexp(logs, axis=1)
        conditional.append(special.softmax(logs, axis=1))
    weights = special.softmax(total)
    yield from moments(draws, {"alpha": alphas}, weights)
    for g in range(3):
        drawn = {"log beta": np.log(draws["beta"].values[..., g])}
        yield from moments(drawn, {"log beta": logs_beta}, weights @ conditional[g])


@problem
def groups_with_two_outputs_and_missing_readings() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(43)
    who = np.repeat([0, 1], [8, 14])
    x = rng.normal(np.array([0.0, 0.6])[who], 0.3)
    error = np.array([0.1, 0.4])

    def response(x: Any) -> Any:
        return np.stack([np.exp(x), (x - 0.3) ** 2 * 4], axis=-1)

    y = response(x) + error * rng.normal(size=(22, 2))
    y[::3, 0] = np.nan
    y[1::6, 1] = np.nan
    index = pd.Index(np.array(["old", "new"])[who], name="rig")
    data = pd.DataFrame(y, index=index, columns=["force", "heat"])
    with pm.Model(coords={"rig": ["new", "old"]}):
        mu = pm.Normal("mu", 0.0, 1.0, dims="rig")
        sigma = pm.HalfNormal("sigma", 1.0)
        population = pm.Normal.dist(mu[prb.response.group("rig")], sigma)
        metric = prb.LogLikelihood(error=error)
        prb.Simulator("y", response, population, metric=metric, observed=data)
        draws = prb.sample(random_seed=1).posterior

    nodes = np.linspace(-4.0, 5.0, 3001)
    logs = stats.norm.logpdf(y[:, None], response(nodes), error)
    of_reading = np.exp(np.where(np.isnan(y)[:, None], 0.0, logs).sum(axis=-1)) * 0.003
    mus, sigmas = np.linspace(-2.0, 2.5, 181), np.linspace(0.02, 1.2, 119)
    table = np.zeros((2, 119, 181))
    for k, sigma in enumerate(sigmas):
        density = np.log(of_reading @ stats.norm.pdf(nodes[:, None], mus, sigma) + 1e-300)
        for g in range(2):
            table[g, k] = density[who == g].sum(axis=0) + stats.norm.logpdf(mus)
    totals = special.logsumexp(table, axis=2).sum(axis=0) + stats.halfnorm.logpdf(sigmas)
    weights = special.softmax(totals)
    yield from moments(draws, {"sigma": sigmas}, weights)
    for g, name in enumerate(["old", "new"]):
        drawn = {f"mu {name}": draws["mu"].sel(rig=name).values}
        conditional = special.softmax(table[g], axis=1)
        yield from moments(drawn, {f"mu {name}": mus}, weights @ conditional)


# -- covariates and conditions ---------------------------------------------------------------------


@problem
def regression_of_an_input_on_a_pressure_in_pascal() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(44)
    pressure, load = rng.uniform(1e6, 5e6, 15), rng.uniform(1.0, 3.0, 15)
    x = 0.5 + 2e-7 * pressure + rng.normal(0, 0.2, 15)

    def response(x: Any, load: Any) -> Any:
        return load * x + 0.3 * x**3

    with pm.Model():
        a, b = pm.Normal("a", 0.0, 10.0), pm.Normal("b", 0.0, 1e-5)
        sigma = pm.HalfNormal("sigma", 1.0)
        p = prb.response.condition("pressure", pressure)
        population = pm.Normal.dist(a + b * p, sigma)
        given = prb.response.condition("load", load)
        prb.Simulator("y", response, population, given, observed=response(x, load))
        draws = prb.sample(random_seed=1).posterior

    def log_posterior(theta: Any) -> Any:
        a, b, sigma = theta[:, 0], theta[:, 1] * 1e-6, np.exp(theta[:, 2])
        logs = stats.norm.logpdf(x[:, None], a + b * pressure[:, None], sigma).sum(axis=0)
        logs += stats.norm(0, 10).logpdf(a) + stats.norm(0, 1e-5).logpdf(b)
        return logs + stats.halfnorm.logpdf(sigma) + theta[:, 2]

    points, weights = by_importance(log_posterior, [0.5, 0.2, -1.5])
    got = {
        "a": draws["a"].values,
        "b": draws["b"].values * 1e6,
        "log sigma": np.log(draws["sigma"].values),
    }
    yield from moments(got, dict(zip(got, points.T, strict=True)), weights)


@problem
def decay_at_times_of_each_specimen() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(45)
    x = rng.lognormal(-7.0, 0.5, 10)
    times = np.sort(
        rng.permuted(np.tile([100.0, 300.0, 700.0, 1500.0, 4000.0], (10, 1)), axis=1)[:, :3]
    )
    times[2:5, 2] = np.nan
    times[7, 1:] = np.nan

    def response(rate: Any, time: Any) -> Any:
        return 5.0 * np.exp(-np.asarray(rate)[..., None] * time)

    readings = response(x, times) + 0.3 * rng.normal(size=(10, 3))
    with pm.Model():
        mu, sigma = pm.Normal("mu", -6.0, 3.0), pm.HalfNormal("sigma", 1.0)
        time = prb.response.condition("time", times)
        metric = prb.LogLikelihood(error=0.3)
        rate = pm.LogNormal.dist(mu, sigma)
        prb.Simulator("y", response, rate, time, metric=metric, observed=readings)
        draws = prb.sample(random_seed=1).posterior

    nodes = np.linspace(-16.0, 2.0, 2401)
    fitted = 5.0 * np.exp(-np.exp(nodes)[:, None] * times[:, None])
    logs = stats.norm.logpdf(readings[:, None], fitted, 0.3)
    of_reading = np.exp(np.nansum(logs, axis=-1)) * 0.0075

    def log_posterior(mu: Any, sigma: Any) -> Any:
        logs = stats.norm(-6, 3).logpdf(mu) + stats.halfnorm.logpdf(sigma)
        for block in np.array_split(np.arange(len(mu)), 40):
            density = stats.norm.pdf(nodes[:, None], mu[block], sigma[block])
            logs[block] += np.log(of_reading @ density).sum(axis=0)
        return logs

    axes = {"mu": np.linspace(-9.0, -5.0, 101), "sigma": np.linspace(0.02, 2.5, 125)}
    values, weights = on_grid(log_posterior, **axes)
    yield from moments(draws, values, weights)


@problem
def gamma_population_whose_mean_has_a_covariate() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(46)
    age = rng.integers(1, 8, 24).astype(float)
    means = np.exp(0.2 + 0.15 * age)
    x = rng.gamma(8.0, means / 8.0)

    def response(x: Any) -> Any:
        return 1.0 / (0.5 + x)

    with pm.Model():
        a, b = pm.Normal("a", 0.0, 3.0), pm.Normal("b", 0.0, 1.0)
        shape = pm.LogNormal("shape", 1.5, 1.0)
        mean = pm.math.exp(a + b * prb.response.condition("age", age))
        population = pm.Gamma.dist(shape, shape / mean)
        prb.Simulator("y", response, population, observed=response(x))
        draws = prb.sample(random_seed=1).posterior

    def log_posterior(theta: Any) -> Any:
        shape = np.exp(theta[:, 2])
        mean = np.exp(theta[:, 0] + theta[:, 1] * age[:, None])
        logs = stats.gamma.logpdf(x[:, None], shape, scale=mean / shape).sum(axis=0)
        logs += stats.norm(0, 3).logpdf(theta[:, 0]) + stats.norm.logpdf(theta[:, 1])
        return logs + stats.norm(1.5, 1).logpdf(theta[:, 2])

    points, weights = by_importance(log_posterior, [0.2, 0.15, 2.0])
    got = {"a": draws["a"].values, "b": draws["b"].values, "s": np.log(draws["shape"].values)}
    yield from moments(got, dict(zip(got, points.T, strict=True)), weights)


# -- functions of each specimen --------------------------------------------------------------------


@problem
def exact_readings_of_functions_of_each_specimen() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(47)
    x, powers = rng.lognormal(0.5, 0.4, 12), np.linspace(-2.0, 3.0, 12)

    def power(p: float) -> Callable[[Any], Any]:
        return lambda x: 1e-9 * np.asarray(x) ** p

    functions = [power(p) for p in powers]
    y = np.array([function(v) for function, v in zip(functions, x, strict=True)])
    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 2.0), pm.HalfNormal("sigma", 1.0)
        population = pm.LogNormal.dist(mu, sigma)
        prb.Simulator("y", prb.response.by_specimen(functions), population, observed=y)
        draws = prb.sample(random_seed=1).posterior

    def log_posterior(mu: Any, sigma: Any) -> Any:
        logs = stats.norm(mu[:, None], sigma[:, None]).logpdf(np.log(x)).sum(axis=1)
        return logs + stats.norm(0, 2).logpdf(mu) + stats.halfnorm.logpdf(sigma)

    axes = {"mu": np.linspace(-0.3, 1.3, 301), "sigma": np.linspace(0.1, 1.4, 301)}
    values, weights = on_grid(log_posterior, **axes)
    yield from moments(draws, values, weights)


@problem
def records_of_each_specimen_with_errors() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(48)
    x = 2.0 * rng.weibull(2.5, 9)
    readings = np.full((9, 3), np.nan)
    records = [{"at": rng.uniform(0.2, 3.0, rng.integers(1, 4))} for _ in range(9)]

    def response(x: Any, record: Any) -> Any:
        return np.sin(np.asarray(x)[..., None] * record["at"] / 4) * 10

    for row, v, record in zip(readings, x, records, strict=True):
        count = len(record["at"])
        row[:count] = response(v, record) + 1.0 * rng.normal(size=count)
    with pm.Model():
        alpha, beta = pm.LogNormal("alpha", 1.0, 0.5), pm.LogNormal("beta", 0.5, 0.5)
        metric = prb.LogLikelihood(error=1.0)
        population = pm.Weibull.dist(alpha, beta)
        own = prb.response.by_specimen(response, records)
        prb.Simulator("y", own, population, metric=metric, observed=readings)
        draws = prb.sample(random_seed=1).posterior

    nodes = (np.arange(4000) + 0.5) * 0.004
    of_reading = np.empty((9, 4000))
    for i, (row, record) in enumerate(zip(readings, records, strict=True)):
        fitted = response(nodes, record)
        density = stats.norm.logpdf(row[: fitted.shape[1]], fitted, 1.0)
        of_reading[i] = np.exp(density.sum(axis=1)) * 0.004

    def log_posterior(alpha: Any, beta: Any) -> Any:
        logs = stats.norm(1, 0.5).logpdf(np.log(alpha)) - np.log(alpha)
        logs += stats.norm(0.5, 0.5).logpdf(np.log(beta)) - np.log(beta)
        for block in np.array_split(np.arange(len(alpha)), 40):
            population = stats.weibull_min(alpha[block], scale=beta[block])
            logs[block] += np.log(of_reading @ population.pdf(nodes[:, None])).sum(axis=0)
        return logs

    axes = {"alpha": np.linspace(0.4, 24.0, 119), "beta": np.linspace(0.6, 5.0, 100)}
    values, weights = on_grid(log_posterior, **axes)
    yield from moments(draws, values, weights)


@problem
def folded_functions_of_some_specimens() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(49)
    x = rng.normal(0.5, 1.0, 14)

    def folded(x: float) -> float:
        return x**2

    def straight(x: float) -> float:
        return 3.0 * x

    functions = [prb.scalar(folded)] * 9 + [prb.scalar(straight)] * 5
    y = np.r_[x[:9] ** 2, 3.0 * x[9:]]
    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 3.0), pm.HalfNormal("sigma", 2.0)
        population = pm.Normal.dist(mu, sigma)
        prb.Simulator("y", prb.response.by_specimen(functions), population, observed=y)
        draws = prb.sample(random_seed=1).posterior

    def log_posterior(mu: Any, sigma: Any) -> Any:
        population = stats.norm(mu[:, None], sigma[:, None])
        logs = np.log(population.pdf(x[:9]) + population.pdf(-x[:9])).sum(axis=1)
        logs += population.logpdf(x[9:]).sum(axis=1)
        return logs + stats.norm(0, 3).logpdf(mu) + stats.halfnorm(scale=2).logpdf(sigma)

    axes = {"mu": np.linspace(-2.5, 2.5, 301), "sigma": np.linspace(0.3, 3.0, 301)}
    values, weights = on_grid(log_posterior, **axes)
    yield from moments(draws, values, weights)


# -- random responses ------------------------------------------------------------------------------

# The emulator of a random response has an error of .3 exact standard deviations (its page).
OF_RANDOM_MEAN, OF_RANDOM_SD = 1.0, 0.35


def random_moments(draws: Any, values: Any, weights: Any) -> Iterator[tuple[str, float]]:
    """Yield differences with those that the page of random responses states."""
    for name, share in moments(draws, values, weights):
        yield name, share * (0.1 / (OF_RANDOM_MEAN if "mean of" in name else OF_RANDOM_SD))


@problem
def random_line_with_normal_noise() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(51)

    def response(x: Any, rng: Any) -> Any:
        return 1e6 * (2.0 * x + 0.8 * rng.normal(size=np.shape(x)))

    y = response(rng.normal(3.0, 0.7, 30), rng)
    with pm.Model():
        mu, sigma = pm.Normal("mu", 2.0, 2.0), pm.HalfNormal("sigma", 1.0)
        random = prb.response.Stochastic(response, random_seed=1)
        prb.Simulator("y", random, pm.Normal.dist(mu, sigma), observed=y)
        draws = prb.sample(random_seed=1).posterior

    def log_posterior(mu: Any, sigma: Any) -> Any:
        spread = np.sqrt(4 * sigma**2 + 0.64)
        logs = stats.norm(2 * mu[:, None], spread[:, None]).logpdf(y / 1e6).sum(axis=1)
        return logs + stats.norm(2, 2).logpdf(mu) + stats.halfnorm.logpdf(sigma)

    axes = {"mu": np.linspace(1.5, 4.5, 201), "sigma": np.linspace(0.003, 1.8, 200)}
    values, weights = on_grid(log_posterior, **axes)
    yield from random_moments(draws, values, weights)


@problem
def random_lifetimes_of_a_lognormal_stress() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(52)

    def response(stress: Any, rng: Any) -> Any:
        """Return the logarithm of a Weibull lifetime."""
        return 12.0 - 3.0 * np.log(stress) + np.log(rng.weibull(2.0, np.shape(stress)))

    y = response(rng.lognormal(1.0, 0.4, 25), rng)
    with pm.Model():
        mu, sigma = pm.Normal("mu", 1.0, 1.0), pm.HalfNormal("sigma", 0.5)
        random = prb.response.Stochastic(response, random_seed=2)
        prb.Simulator("y", random, pm.LogNormal.dist(mu, sigma), observed=y)
        draws = prb.sample(random_seed=1).posterior

    nodes = np.linspace(-4.0, 6.0, 2001)
    v = y[:, None] - 12.0 + 3.0 * nodes  # logarithm of a Weibull number
    of_reading = np.exp(np.log(2.0) + 2 * v - np.exp(np.minimum(2 * v, 600))) * 0.005

    def log_posterior(mu: Any, sigma: Any) -> Any:
        logs = stats.norm(1, 1).logpdf(mu) + stats.halfnorm(scale=0.5).logpdf(sigma)
        for block in np.array_split(np.arange(len(mu)), 20):
            density = stats.norm.pdf(nodes[:, None], mu[block], sigma[block])
            logs[block] += np.log(of_reading @ density + 1e-300).sum(axis=0)
        return logs

    axes = {"mu": np.linspace(0.3, 1.7, 81), "sigma": np.linspace(0.01, 1.2, 80)}
    values, weights = on_grid(log_posterior, **axes)
    yield from random_moments(draws, values, weights)


@problem
def random_outputs_with_common_noise_and_errors() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(53)
    root = np.array([[0.5, 0.0], [0.3, 0.4]])

    def response(x: Any, rng: Any) -> Any:
        x = np.asarray(x)
        noise = rng.normal(size=(*x.shape, 2)) @ root.T
        return np.stack([x, -2.0 * x], axis=-1) + noise

    y = response(rng.normal(1.0, 0.5, 20), rng) + [0.2, 0.3] * rng.normal(size=(20, 2))
    y[[2, 5, 11], [0, 1, 1]] = np.nan
    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 2.0), pm.HalfNormal("sigma", 1.0)
        random = prb.response.Stochastic(response, random_seed=3)
        metric = prb.LogLikelihood(error=[0.2, 0.3])
        prb.Simulator("y", random, pm.Normal.dist(mu, sigma), metric=metric, observed=y)
        draws = prb.sample(random_seed=1).posterior

    slope, own = np.array([1.0, -2.0]), root @ root.T + np.diag([0.04, 0.09])

    def log_posterior(mu: Any, sigma: Any) -> Any:
        logs = stats.norm(0, 2).logpdf(mu) + stats.halfnorm.logpdf(sigma)
        for row in y:
            seen = np.isfinite(row)
            a, r = slope[seen], row[seen] - mu[:, None] * slope[seen]
            covariance = own[np.ix_(seen, seen)] + sigma[:, None, None] ** 2 * np.outer(a, a)
            solved = np.linalg.solve(covariance, r[..., None])[..., 0]
            logs -= 0.5 * ((r * solved).sum(axis=1) + np.linalg.slogdet(covariance)[1])
        return logs

    axes = {"mu": np.linspace(-0.5, 2.5, 121), "sigma": np.linspace(0.004, 1.6, 120)}
    values, weights = on_grid(log_posterior, **axes)
    yield from random_moments(draws, values, weights)


# -- model discrepancy -----------------------------------------------------------------------------


def normal_populations(samples: Any, priors: Any, draws: Any) -> Iterator[tuple[str, float]]:
    """Yield differences for independent normal populations of known inputs.

    ``samples`` has inputs by the names of mean and standard deviation; ``priors`` the mean and
    standard deviation of the former's normal prior, and the scale of the latter's half-normal one.
    """
    for (mean, sd), x in samples.items():
        center, spread, n = x.mean(), x.std(), len(x)

        def log_posterior(m: Any, s: Any, x: Any = x, prior: Any = priors[mean, sd]) -> Any:
            logs = stats.norm(m[:, None], s[:, None]).logpdf(x).sum(axis=1)
            logs += stats.norm(prior[0], prior[1]).logpdf(m)
            return logs + stats.halfnorm(scale=prior[2]).logpdf(s)

        reach = 12 * spread / np.sqrt(n)
        of_m = np.linspace(center - reach, center + reach, 401)
        of_s = np.linspace(spread / 4, spread * 6, 801)
        values, weights = on_grid(log_posterior, m=of_m, s=of_s)
        yield from moments(draws, {mean: values["m"], sd: values["s"]}, weights)


@problem
def additive_discrepancy_from_exact_curves() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(54)
    loads = np.array([1e6, 2e6, 5e6])
    x, b = rng.lognormal(0.0, 0.3, 12), rng.normal(5.0, 1.0, 12)

    def response(x: Any) -> Any:
        return 1e-6 * loads * np.asarray(x)[..., None] ** 2

    growing = prb.response.Additive(loads)
    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 1.0), pm.HalfNormal("sigma", 1.0)
        size, scatter = pm.Normal("size", 0.0, 10.0), pm.HalfNormal("scatter", 3.0)
        inputs = pm.LogNormal.dist(mu, sigma), pm.Normal.dist(size, scatter)
        with_discrepancy = growing.of(response, loads)
        y = response(x) + b[:, None] * (loads - 1e6) / 4e6
        y[4, 1], y[7, 2] = np.nan, np.nan
        prb.Simulator("y", with_discrepancy, *inputs, observed=y)
        draws = prb.sample(random_seed=1).posterior

    samples = {("mu", "sigma"): np.log(x), ("size", "scatter"): b}
    priors = {("mu", "sigma"): (0, 1, 1), ("size", "scatter"): (0, 10, 3)}
    yield from normal_populations(samples, priors, draws)


@problem
def multiplicative_discrepancy_with_errors() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(55)
    ages = np.array([0.0, 1.0, 3.0])
    x, b = rng.normal(2.0, 0.3, 15), rng.normal(-0.4, 0.1, 15)
    curves = x[:, None] * np.exp(b[:, None] * (ages / 3.0) ** 2)
    y = curves * np.array([1.0, 1.1, 1.2]) + 0.1 * rng.normal(size=(15, 3))
    y[::4, 1] = np.nan

    def response(x: Any) -> Any:
        return np.asarray(x)[..., None] * np.array([1.0, 1.1, 1.2])

    ageing = prb.response.Multiplicative(ages, lambda age: (age / 3.0) ** 2)
    with pm.Model():
        mu, size = pm.Normal("mu", 0.0, 5.0), pm.Normal("size", 0.0, 1.0)
        inputs = pm.Normal.dist(mu, 0.3), pm.Normal.dist(size, 0.1)
        metric = prb.LogLikelihood(error=0.1)
        prb.Simulator("y", ageing.of(response, ages), *inputs, metric=metric, observed=y)
        draws = prb.sample(random_seed=1).posterior

    of_x, of_b = np.linspace(0.2, 4.0, 191), np.linspace(-1.2, 0.4, 161)
    fitted = of_x[:, None, None] * np.exp(of_b[:, None] * (ages / 3) ** 2) * [1.0, 1.1, 1.2]
    logs = np.nansum(stats.norm.logpdf(y[:, None, None], fitted, 0.1), axis=-1)
    mus, sizes = np.linspace(1.5, 2.5, 101), np.linspace(-0.7, -0.1, 91)
    first, second = (
        stats.norm.pdf(of_x, mus[:, None], 0.3),
        stats.norm.pdf(of_b, sizes[:, None], 0.1),
    )
    density = np.einsum("mx,ixb,sb->ims", first, np.exp(logs), second, optimize=True)
    total = np.log(density).sum(axis=0) + stats.norm(0, 5).logpdf(mus)[:, None]
    weights = special.softmax(total + stats.norm.logpdf(sizes))
    yield from moments(draws, {"mu": mus}, weights.sum(axis=1))
    yield from moments(draws, {"size": sizes}, weights.sum(axis=0))


@problem
def smooth_discrepancy_of_each_specimen() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(56)
    loads = np.array([0.5, 1.0, 2.0])
    stiffening = prb.response.Additive(loads, prb.response.Smooth(zero_at=0.0))
    (n,) = stiffening.event
    basis = np.stack([stiffening.value(row, loads) for row in np.eye(n)], axis=-1)  # (3, n)
    x = rng.normal(5.0, 0.5, 12)
    y = x[:, None] * loads + 0.8 * rng.normal(size=(12, n)) @ basis.T
    y = y + 0.1 * rng.normal(size=y.shape)

    def response(x: Any) -> Any:
        return np.asarray(x)[..., None] * loads

    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 10.0), pm.HalfNormal("sigma", 1.0)
        b = pm.MvNormal.dist(np.zeros(n), 0.8**2 * np.eye(n))
        metric = prb.LogLikelihood(error=0.1)
        inputs = pm.Normal.dist(mu, sigma), b
        prb.Simulator("y", stiffening.of(response, loads), *inputs, metric=metric, observed=y)
        draws = prb.sample(random_seed=1).posterior

    own = 0.64 * basis @ basis.T + 0.01 * np.eye(3)

    def log_posterior(mu: Any, sigma: Any) -> Any:
        covariance = own + sigma[:, None, None] ** 2 * np.outer(loads, loads)
        r = y[:, None] - mu[:, None] * loads  # (N, S, 3)
        square = np.einsum("isj,sjk,isk->s", r, np.linalg.inv(covariance), r)
        logs = -0.5 * square - 6 * np.linalg.slogdet(covariance)[1]
        return logs + stats.norm(0, 10).logpdf(mu) + stats.halfnorm.logpdf(sigma)

    axes = {"mu": np.linspace(3.5, 6.5, 121), "sigma": np.linspace(0.01, 2.0, 100)}
    values, weights = on_grid(log_posterior, **axes)
    yield from moments(draws, values, weights)


# -- tables of runs and surrogates -----------------------------------------------------------------


def known_normals(x: Any, mean: float, sd: float, scale: float) -> Any:
    """Return values and weights of a normal population whose inputs are known exactly."""
    middle, spread = x.mean(), x.std()

    def log_posterior(mu: Any, sigma: Any) -> Any:
        logs = stats.norm(mu[:, None], sigma[:, None]).logpdf(x).sum(axis=1)
        return logs + stats.norm(mean, sd).logpdf(mu) + stats.halfnorm(scale=scale).logpdf(sigma)

    reach = 8 * spread / np.sqrt(len(x)) + spread / 2
    axes = {
        "mu": np.linspace(middle - reach, middle + reach, 401),
        "sigma": np.linspace(spread / 4, 5 * spread, 501),
    }
    return on_grid(log_posterior, **axes)


@problem
def table_of_one_input_in_nanometres() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(57)
    runs = rng.uniform(100e-9, 900e-9, 40)

    def response(x: Any) -> Any:
        return np.log(x / 1e-9) + 1e6 * x

    x = rng.normal(500e-9, 40e-9, 15)
    with pm.Model():
        mu, sigma = pm.Normal("mu", 450e-9, 100e-9), pm.HalfNormal("sigma", 50e-9)
        table = prb.Runs(pd.DataFrame({"d": runs}), pd.Series(response(runs), name="y"))
        prb.Simulator("y", table, pm.Normal.dist(mu, sigma), observed=response(x))
        draws = prb.sample(random_seed=1).posterior

    values, weights = known_normals(x, 450e-9, 100e-9, 50e-9)
    yield from moments(draws, values, weights)


@problem
def table_with_empty_cells_and_missing_readings() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(58)
    design = np.column_stack([rng.uniform(0.0, 6.0, 90), rng.uniform(-2.0, 4.0, 90)])

    def response(a: Any, b: Any) -> Any:
        return np.stack([np.exp(a / 3) + b, a - b + 0.1 * b**2], axis=-1)

    outputs = pd.DataFrame(response(*design.T), columns=["p", "q"])
    outputs.iloc[[3, 40]] = np.nan
    a, b = rng.normal(3.0, 0.4, 14), rng.normal(1.0, 0.3, 14)
    y = pd.DataFrame(response(a, b) + 0.05 * rng.normal(size=(14, 2)), columns=["p", "q"])
    y.iloc[[1, 6], [0, 1]] = y.iloc[[1, 6], [0, 1]]
    y.iloc[2, 0], y.iloc[9, 1] = np.nan, np.nan
    with pm.Model():
        m, n = pm.Normal("m", 3.0, 1.0), pm.Normal("n", 1.0, 1.0)
        inputs = pm.Normal.dist(m, 0.4), pm.Normal.dist(n, 0.3)
        table = prb.Runs(pd.DataFrame(design, columns=["a", "b"]), outputs)
        metric = prb.LogLikelihood(error=0.05)
        prb.Simulator("y", table, *inputs, metric=metric, observed=y)
        draws = prb.sample(random_seed=1).posterior

    of_a, of_b = np.linspace(0.8, 5.2, 441), np.linspace(-1.0, 3.0, 401)
    fitted = response(of_a[:, None], of_b)
    ms, ns = np.linspace(2.4, 3.6, 81), np.linspace(0.5, 1.5, 81)
    first, second = stats.norm.pdf(of_a, ms[:, None], 0.4), stats.norm.pdf(of_b, ns[:, None], 0.3)
    total = stats.norm(3, 1).logpdf(ms)[:, None] + stats.norm(1, 1).logpdf(ns)
    for row in y.values:
        density = np.exp(np.nansum(stats.norm.logpdf(row, fitted, 0.05), axis=-1))
        total += np.log(first @ density @ second.T)
    weights = special.softmax(total)
    yield from moments(draws, {"m": ms}, weights.sum(axis=1))
    yield from moments(draws, {"n": ns}, weights.sum(axis=0))


@problem
def surrogate_of_an_oscillating_response() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(59)

    def response(x: Any) -> Any:
        return x + 0.6 * np.sin(1.5 * x)

    x = rng.normal(1.0, 0.5, 12)
    surrogate = prb.Surrogate.fit(response, {"x": (-8.0, 10.0)}, 60, progressbar=False)
    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 1.5), pm.HalfNormal("sigma", 1.0)
        prb.Simulator("y", surrogate, pm.Normal.dist(mu, sigma), observed=response(x))
        draws = prb.sample(random_seed=1).posterior

    values, weights = known_normals(x, 0.0, 1.5, 1.0)  # the response is monotone: 1 - .9 > 0
    yield from moments(draws, values, weights)


# -- updates ---------------------------------------------------------------------------------------


@problem
def updates_of_five_one_and_twenty_specimens() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(61)
    x = 2.0 * rng.weibull(3.0, 32)

    def response(x: Any) -> Any:
        return 1e-9 * x**2

    y = response(x) + 0.3e-9 * rng.normal(size=32)
    with pm.Model() as model:
        alpha, beta = pm.LogNormal("alpha", 1.0, 0.7), pm.LogNormal("beta", 0.5, 0.7)
        metric = prb.LogLikelihood(error=0.3e-9)
        prb.Simulator("y", response, pm.Weibull.dist(alpha, beta), metric=metric, observed=y[:6])
        result = prb.sample(random_seed=1)
        for part in (y[6:11], y[11:12], y[12:]):
            result = prb.update(result, observed=part, model=model, random_seed=1)

    nodes = (np.arange(3000) + 0.5) * 0.003
    of_reading = stats.norm.pdf(y[:, None] * 1e9, nodes**2, 0.3) * 0.003

    def log_posterior(alpha: Any, beta: Any) -> Any:
        logs = stats.norm(1, 0.7).logpdf(np.log(alpha)) - np.log(alpha)
        logs += stats.norm(0.5, 0.7).logpdf(np.log(beta)) - np.log(beta)
        for block in np.array_split(np.arange(len(alpha)), 20):
            population = stats.weibull_min(alpha[block], scale=beta[block])
            logs[block] += np.log(of_reading @ population.pdf(nodes[:, None])).sum(axis=0)
        return logs

    axes = {"alpha": np.linspace(1.2, 6.5, 70), "beta": np.linspace(1.3, 2.9, 70)}
    values, weights = on_grid(log_posterior, **axes)
    yield from moments(result.posterior, values, weights)


@problem
def update_of_two_outputs_with_missing_readings() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(62)
    x = rng.lognormal(1.0, 0.3, 18)

    def response(x: Any) -> Any:
        return {"force": 1e6 / x, "heat": 3.0 * x}

    y = pd.DataFrame(response(x))
    y.iloc[[2, 10, 13], 0] = np.nan
    y.iloc[[4, 9, 14], 1] = np.nan
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 0.0, 2.0), pm.HalfNormal("sigma", 1.0)
        population = pm.LogNormal.dist(mu, sigma)
        metric = prb.LogLikelihood(error=0.01, relative=True)
        prb.Simulator("y", response, population, metric=metric, observed=y.iloc[:8])
        result = prb.sample(random_seed=1)
        result = prb.update(result, observed=y.iloc[8:], model=model)

    nodes = np.linspace(-1.5, 3.5, 5001)
    fitted = np.stack([1e6 / np.exp(nodes), 3 * np.exp(nodes)], axis=-1)
    logs = stats.norm.logpdf(y.values[:, None], fitted, 0.01 * fitted)
    of_reading = np.exp(np.nansum(logs, axis=-1)) * 0.001
    scale = of_reading.max(axis=1, keepdims=True)

    def log_posterior(mu: Any, sigma: Any) -> Any:
        logs = stats.norm(0, 2).logpdf(mu) + stats.halfnorm.logpdf(sigma)
        for block in np.array_split(np.arange(len(mu)), 40):
            density = stats.norm.pdf(nodes[:, None], mu[block], sigma[block])
            logs[block] += np.log(of_reading / scale @ density).sum(axis=0)
        return logs

    axes = {"mu": np.linspace(0.6, 1.5, 81), "sigma": np.linspace(0.12, 0.8, 80)}
    values, weights = on_grid(log_posterior, **axes)
    yield from moments(result.posterior, values, weights)


@problem
def update_by_specimens_far_from_the_first() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(63)
    x = np.r_[rng.normal(10.0, 0.5, 8), 16.0, 4.5]

    def response(x: Any) -> Any:
        return 200.0 / (1.0 + np.exp(-(x - 10.0) / 3.0))

    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 0.0, 30.0), pm.HalfNormal("sigma", 5.0)
        prb.Simulator("y", response, pm.Normal.dist(mu, sigma), observed=response(x[:8]))
        result = prb.sample(random_seed=1)
        result = prb.update(result, observed=response(x[8:]), model=model)

    values, weights = known_normals(x, 0.0, 30.0, 5.0)
    yield from moments(result.posterior, values, weights)


# -- fleets ----------------------------------------------------------------------------------------


def of_few_normals(x: Any, mean: float, sd: float, scale: float) -> Any:
    """Return values and weights of a normal population of known inputs, by conditional moments.

    With the spread given the mean is normal, so that a grid of its scores serves few specimens.
    """
    s, z = np.linspace(0.002, 5.0, 4000) * scale, np.linspace(-6.0, 6.0, 121)
    n, center = len(x), x.mean()
    logs = -((x - center) ** 2).sum() / (2 * s**2) - (n - 1) * np.log(s)
    logs += stats.norm.logpdf(center, mean, np.hypot(sd, s / np.sqrt(n)))
    weights = special.softmax(logs + stats.halfnorm(scale=scale).logpdf(s))
    variance = 1 / (1 / sd**2 + n / s**2)
    middle = variance * (mean / sd**2 + n * center / s**2)
    of_z = stats.norm.pdf(z) / stats.norm.pdf(z).sum()
    mu = middle[:, None] + np.sqrt(variance)[:, None] * z
    values = {"mu": mu.ravel(), "sigma": np.repeat(s, len(z))}
    return values, (weights[:, None] * of_z).ravel()


@problem
def fleet_with_vague_priors_of_an_exponential_response() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(64)
    places = [-2.0, 0.0, 1.0, 3.0, 3.5, 6.0]
    x = {f"p{i}": rng.normal(m, 0.3 + 0.1 * i, 5 + 3 * i) for i, m in enumerate(places)}

    def response(x: Any) -> Any:
        return np.exp(x / 2.0)

    data = {name: response(v) for name, v in x.items()}
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 0.0, 10.0), pm.HalfNormal("sigma", 2.0)
        prb.Simulator("y", response, pm.Normal.dist(mu, sigma), observed=data["p0"])
    fleet = prb.calibrate_each(data, model=model, random_seed=1, progressbar=False)
    for name, v in x.items():
        found = of_few_normals(v, 0.0, 10.0, 2.0)
        of_product = fleet["posterior"].dataset.sel(product=name)
        for label, share in moments(of_product, *found):
            yield f"{name}: {label}", share


@problem
def fleet_of_a_folded_response_with_errors() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(65)
    x = {name: rng.normal(m, 0.6, 9) for name, m in [("a", 0.3), ("b", 1.5), ("c", 3.0)]}

    def response(x: Any) -> Any:
        return (x - 1.0) ** 2

    data = {name: response(v) + 0.2 * rng.normal(size=9) for name, v in x.items()}
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 2.0, 3.0), pm.HalfNormal("sigma", 2.0)
        metric = prb.LogLikelihood(error=0.2)
        prb.Simulator("y", response, pm.Normal.dist(mu, sigma), metric=metric, observed=data["a"])
    fleet = prb.calibrate_each(data, model=model, random_seed=1, progressbar=False)

    nodes = np.linspace(-9.0, 11.0, 4001)
    for name, y in data.items():
        of_reading = stats.norm.pdf(y[:, None], response(nodes), 0.2) * 0.005

        def log_posterior(mu: Any, sigma: Any, of_reading: Any = of_reading) -> Any:
            logs = stats.norm(2, 3).logpdf(mu) + stats.halfnorm(scale=2).logpdf(sigma)
            for block in np.array_split(np.arange(len(mu)), 20):
                density = stats.norm.pdf(nodes[:, None], mu[block], sigma[block])
                logs[block] += np.log(of_reading @ density + 1e-300).sum(axis=0)
            return logs

        axes = {"mu": np.linspace(-3.0, 5.0, 121), "sigma": np.linspace(0.02, 4.5, 112)}
        values, weights = on_grid(log_posterior, **axes)
        of_product = fleet["posterior"].dataset.sel(product=name)
        for label, share in moments(of_product, values, weights):
            yield f"{name}: {label}", share


@problem
def fleet_of_two_outputs_with_two_specimens() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(66)
    sizes = {"two": 2, "three": 3, "ten": 10}
    x = {k: rng.multivariate_normal([1.0, 2.0], np.diag([0.04, 0.09]), n) for k, n in sizes.items()}

    def response(a: Any, b: Any) -> Any:
        return np.stack([1e6 * np.exp(a), a * b + b], axis=-1)

    data = {name: response(*v.T) for name, v in x.items()}
    with pm.Model() as model:
        inputs = [pm.Normal.dist(pm.Normal(k, 0, 10), pm.HalfNormal(f"s{k}", 1)) for k in "ab"]
        prb.Simulator("y", response, *inputs, observed=data["ten"])
    fleet = prb.calibrate_each(data, model=model, random_seed=1, progressbar=False)
    for name, v in x.items():
        of_product = fleet["posterior"].dataset.sel(product=name)
        for k, values in zip("ab", v.T, strict=True):
            renamed = {"mu": of_product[k].values, "sigma": of_product[f"s{k}"].values}
            for label, share in moments(renamed, *of_few_normals(values, 0.0, 10.0, 1.0)):
                yield f"{name} {k}: {label}", share


# -- two simulators in one model -------------------------------------------------------------------


@problem
def two_tests_of_partly_the_same_specimens() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(71)
    x = rng.normal(3.0, 0.5, 14)
    first, second = rng.permutation(14)[:9], rng.permutation(14)[:10]
    y = 1e6 * x[first] + 2e5 * rng.normal(size=9)
    z = 1e-3 * x[second] + 4e-4 * rng.normal(size=10)
    labels = np.array([f"s{i}" for i in range(14)])

    def heavy(x: Any) -> Any:
        return 1e6 * x

    def light(x: Any) -> Any:
        return 1e-3 * x

    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 10.0), pm.HalfNormal("sigma", 1.0)
        population = pm.Normal.dist(mu, sigma)
        of_y, of_z = prb.LogLikelihood(error=2e5), prb.LogLikelihood(error=4e-4)
        prb.Simulator("y", heavy, population, metric=of_y, observed=y, specimens=labels[first])
        prb.Simulator("z", light, population, metric=of_z, observed=z, specimens=labels[second])
        draws = prb.sample(random_seed=1).posterior

    precision, weighted, square = np.zeros(14), np.zeros(14), np.zeros(14)
    for rows, readings, error in ((first, y / 1e6, 0.2), (second, z / 1e-3, 0.4)):
        precision[rows] += error**-2
        weighted[rows] += readings / error**2
        square[rows] += readings**2 / error**2
    seen = precision > 0
    middle, variance = weighted[seen] / precision[seen], 1 / precision[seen]

    def log_posterior(mu: Any, sigma: Any) -> Any:
        spread = np.sqrt(variance + sigma[:, None] ** 2)
        logs = stats.norm(mu[:, None], spread).logpdf(middle).sum(axis=1)
        return logs + stats.norm(0, 10).logpdf(mu) + stats.halfnorm.logpdf(sigma)

    axes = {"mu": np.linspace(2.0, 4.0, 201), "sigma": np.linspace(0.003, 1.8, 200)}
    values, weights = on_grid(log_posterior, **axes)
    yield from moments(draws, values, weights)


@problem
def two_kinds_of_specimens_with_a_common_parameter() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(72)
    x, z = rng.lognormal(0.5, 0.4, 7), rng.gamma(4.0, np.exp(0.5) / 4.0, 25)

    def first(x: Any) -> Any:
        return 1e9 * np.sqrt(x)

    def second(x: Any) -> Any:
        return x**2 - 0.3 * x**1.5

    with pm.Model():
        mu, sigma = pm.Normal("mu", 0.0, 3.0), pm.HalfNormal("sigma", 1.0)
        shape = pm.LogNormal("shape", 1.0, 1.0)
        gamma = pm.Gamma.dist(shape, shape * pm.math.exp(-mu))
        prb.Simulator("a", first, pm.LogNormal.dist(mu, sigma), observed=first(x))
        prb.Simulator("b", second, gamma, observed=second(z))
        draws = prb.sample(random_seed=1).posterior

    # z^2 - .3 z^1.5 has its minimum, -.00027, at .0506, so that readings of 0 and more have one
    # root.
    assert (second(z) > 0).all()

    def log_posterior(theta: Any) -> Any:
        mu, sigma, shape = theta[:, 0], np.exp(theta[:, 1]), np.exp(theta[:, 2])
        logs = stats.norm.logpdf(np.log(x)[:, None], mu, sigma).sum(axis=0)
        logs += stats.gamma.logpdf(z[:, None], shape, scale=np.exp(mu) / shape).sum(axis=0)
        logs += stats.norm(0, 3).logpdf(mu) + stats.halfnorm.logpdf(sigma) + theta[:, 1]
        return logs + stats.norm(1, 1).logpdf(theta[:, 2])

    points, weights = by_importance(log_posterior, [0.5, -0.8, 1.0])
    names = {"mu": "mu", "sigma": "log sigma", "shape": "log shape"}
    got = {v: draws[k].values if k == "mu" else np.log(draws[k].values) for k, v in names.items()}
    yield from moments(got, dict(zip(got, points.T, strict=True)), weights)


@problem
def curve_and_folded_response_of_the_same_specimens() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(73)
    a, b = rng.normal(1.0, 0.4, 16), rng.normal(-0.5, 0.3, 16)
    labels = [f"no. {i}" for i in range(16)]

    def folded(a: Any, b: Any) -> Any:
        return a**2 + 0.0 * b

    def curve(a: Any, b: Any) -> Any:
        return np.stack([a + b, np.exp(a - b)], axis=-1)

    y = folded(a, b) + 0.1 * rng.normal(size=16)
    z = pd.DataFrame(curve(a, b), columns=["u", "v"]) + 0.3 * rng.normal(size=(16, 2))
    z.iloc[[1, 5], 0] = np.nan
    z.iloc[[5, 7], 1] = np.nan
    z = z.drop(index=5)
    with pm.Model():
        m, n = pm.Normal("m", 0.0, 2.0), pm.Normal("n", 0.0, 2.0)
        inputs = pm.Normal.dist(m, 0.4), pm.Normal.dist(n, 0.3)
        of_y, of_z = prb.LogLikelihood(error=0.1), prb.LogLikelihood(error=0.3)
        prb.Simulator("y", folded, *inputs, metric=of_y, observed=y, specimens=labels)
        others = [label for label in labels if label != "no. 5"]
        prb.Simulator("z", curve, *inputs, metric=of_z, observed=z.values, specimens=others)
        draws = prb.sample(random_seed=1).posterior

    of_a, of_b = np.linspace(-4.0, 4.0, 401), np.linspace(-3.0, 2.5, 221)
    mesh = np.meshgrid(of_a, of_b, indexing="ij")
    ms, ns = np.linspace(-2.0, 2.0, 161), np.linspace(-1.3, 0.5, 91)
    first, second = stats.norm.pdf(of_a, ms[:, None], 0.4), stats.norm.pdf(of_b, ns[:, None], 0.3)
    total = stats.norm(0, 2).logpdf(ms)[:, None] + stats.norm(0, 2).logpdf(ns)
    for i in range(16):
        logs = stats.norm.logpdf(y[i], folded(*mesh), 0.1)
        if i in z.index:
            of_curve = stats.norm.logpdf(z.loc[i].values, curve(*mesh), 0.3)
            logs = logs + np.nansum(of_curve, axis=-1)
        total += np.log(first @ np.exp(logs) @ second.T + 1e-300)
    weights = special.softmax(total)
    yield from moments(draws, {"m": ms}, weights.sum(axis=1))
    yield from moments(draws, {"n": ns}, weights.sum(axis=0))


# -- inputs of each specimen -----------------------------------------------------------------------


def specimens_by_quadrature(of_reading: Any, density: Any, nodes: Any, weights: Any) -> Any:
    """Return mean and standard deviation of each specimen's input over a posterior of populations.

    ``of_reading`` is (N, n), the density of the populations (S, n), their weights (S,).
    """
    joint = of_reading[:, None] * density  # (N, S, n)
    joint /= joint.sum(axis=-1, keepdims=True)
    of_nodes = np.einsum("s,isn->in", weights, joint)
    mean = of_nodes @ nodes
    return mean, np.sqrt(of_nodes @ nodes**2 - mean**2)


@problem
def individuals_with_errors_of_their_own() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(74)
    x, errors = rng.normal(5.0, 0.5, 8), np.geomspace(0.02, 3.0, 8)

    def response(x: Any) -> Any:
        return x + 0.02 * x**3

    y = response(x) + errors * rng.normal(size=8)
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 0.0, 10.0), pm.HalfNormal("sigma", 1.0)
        metric = prb.LogLikelihood(error=errors)
        population = pm.Normal.dist(mu, sigma, name="x")
        prb.Simulator("y", response, population, metric=metric, observed=y)
        result = prb.sample(random_seed=1)
        drawn = prb.individuals(result, model=model, n_draws=4000)["posterior"].dataset["x"]

    nodes = np.linspace(-4.0, 12.0, 3201)
    of_reading = stats.norm.pdf(y[:, None], response(nodes), errors[:, None]) * 0.005
    axes = {"mu": np.linspace(2.8, 7.0, 64), "sigma": np.linspace(0.03, 2.8, 60)}

    def log_posterior(mu: Any, sigma: Any) -> Any:
        density = stats.norm.pdf(nodes[:, None], mu, sigma)
        logs = np.log(of_reading @ density + 1e-300).sum(axis=0)
        return logs + stats.norm(0, 10).logpdf(mu) + stats.halfnorm.logpdf(sigma)

    values, weights = on_grid(log_posterior, **axes)
    yield from moments(result.posterior, values, weights)
    kept = weights > 1e-6 * weights.max()
    density = stats.norm.pdf(nodes, values["mu"][kept, None], values["sigma"][kept, None])
    share = weights[kept] / weights[kept].sum()
    for i in range(8):
        mean, sd = specimens_by_quadrature(of_reading[i : i + 1], density, nodes, share)
        yield difference(f"mean of specimen {i}", drawn[..., i].mean(), mean, 0.1 * sd)
        yield difference(f"sd of specimen {i}", drawn[..., i].std(), sd, 0.1 * sd)


@problem
def individuals_of_a_folded_response() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(75)
    x = rng.normal(0.4, 0.8, 12)

    def response(x: Any) -> Any:
        return 1e-9 * (x**2 + 0.2 * x)

    y = response(x)
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 1.0, 1.0), pm.HalfNormal("sigma", 1.0)
        population = pm.Normal.dist(mu, sigma, name="x")
        prb.Simulator("y", response, population, observed=y)
        result = prb.sample(random_seed=1)
        drawn = prb.individuals(result, model=model, n_draws=4000)["posterior"].dataset["x"]

    other = -0.2 - x

    def log_posterior(mu: Any, sigma: Any) -> Any:
        population = stats.norm(mu[:, None], sigma[:, None])
        logs = np.logaddexp(population.logpdf(x), population.logpdf(other)).sum(axis=1)
        return logs + stats.norm(1, 1).logpdf(mu) + stats.halfnorm.logpdf(sigma)

    axes = {"mu": np.linspace(-2.5, 2.5, 301), "sigma": np.linspace(0.03, 2.5, 200)}
    values, weights = on_grid(log_posterior, **axes)
    yield from moments(result.posterior, values, weights)
    population = stats.norm(values["mu"][:, None], values["sigma"][:, None])
    share = weights @ special.expit(population.logpdf(x) - population.logpdf(other))
    is_first = np.abs(drawn.values - x) < np.abs(drawn.values - other)
    yield difference("shares of roots", is_first.mean(axis=(0, 1)), share, 0.05)


@problem
def individuals_of_two_inputs_and_one_reading() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(76)
    a, b = rng.normal(2.0, 0.4, 10), rng.lognormal(0.0, 0.2, 10)

    def response(a: Any, b: Any) -> Any:
        return a * b

    y = response(a, b)
    with pm.Model() as model:
        mu = pm.Normal("mu", 0.0, 5.0)
        inputs = pm.Normal.dist(mu, 0.4, name="a"), pm.LogNormal.dist(0.0, 0.2, name="b")
        prb.Simulator("y", response, *inputs, observed=y)
        result = prb.sample(random_seed=1)
        drawn = prb.individuals(result, model=model, n_draws=4000)["posterior"].dataset

    logs_b = np.linspace(-1.6, 1.6, 1601)
    of_a = y[:, None] / np.exp(logs_b)
    mus = np.linspace(0.9, 3.1, 221)
    # p(y) is the integral of p(a = y / b) p(b) / b.
    joint = stats.norm.pdf(of_a, mus[:, None, None], 0.4)  # (S, N, n)
    joint = joint * stats.norm.pdf(logs_b, 0.0, 0.2) * np.exp(-logs_b)
    total = np.log(joint.sum(axis=-1)).sum(axis=1) + stats.norm(0, 5).logpdf(mus)
    weights = special.softmax(total)
    yield from moments(result.posterior, {"mu": mus}, weights)
    of_nodes = np.einsum("s,sin->in", weights, joint / joint.sum(axis=-1, keepdims=True))
    for name, nodes in (("a", of_a), ("b", np.broadcast_to(np.exp(logs_b), of_a.shape))):
        mean = (of_nodes * nodes).sum(axis=1)
        sd = np.sqrt((of_nodes * nodes**2).sum(axis=1) - mean**2)
        got = drawn[name].values.reshape(-1, 10)
        yield difference(f"means of {name}", got.mean(axis=0), mean, 0.1 * sd)
        yield difference(f"sds of {name}", got.std(axis=0), sd, 0.1 * sd)


# -- leave-one-out and diagnosis -------------------------------------------------------------------


def left_out(of_specimens: Any, log_prior: Any) -> Any:
    """Return exact log p(y_i | others), (N,), from log-likelihoods on a grid, (N, S)."""
    total = of_specimens.sum(axis=0) + log_prior
    without = total - of_specimens
    return special.logsumexp(total) - special.logsumexp(without, axis=1)


@problem
def leave_one_out_of_eight_exact_readings() -> Iterator[tuple[str, float]]:
    x = np.random.default_rng(77).weibull(2.0, 8) * 3.0

    def response(x: Any) -> Any:
        return 1e6 * x**3

    with pm.Model() as model:
        alpha, beta = pm.LogNormal("alpha", 0.5, 0.7), pm.LogNormal("beta", 1.0, 0.7)
        prb.Simulator("y", response, pm.Weibull.dist(alpha, beta), observed=response(x))
        result = prb.sample(random_seed=1)
        prb.diagnose(result, model=model)
    loo = az.loo(result, pointwise=True)

    alphas, betas = np.meshgrid(np.linspace(0.3, 8.0, 401), np.linspace(0.8, 8.0, 401))
    logs = stats.weibull_min(alphas, scale=betas).logpdf(x[:, None, None])
    logs = logs - np.log(3e6 * x**2)[:, None, None]
    prior = stats.norm(0.5, 0.7).logpdf(np.log(alphas)) - np.log(alphas)
    prior += stats.norm(1.0, 0.7).logpdf(np.log(betas)) - np.log(betas)
    exact = left_out(logs.reshape(8, -1), prior.ravel())
    yield difference("elpd of specimens", loo.elpd_i, exact, 0.1)
    yield difference("elpd", loo.elpd, exact.sum(), 0.2)


@problem
def leave_one_out_of_repeated_readings() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(78)
    x, who = rng.normal(1.0, 0.3, 12), np.repeat(np.arange(12), 3)

    def response(x: Any) -> Any:
        return np.exp(x)

    y = response(x)[who] + 0.4 * rng.normal(size=36)
    order = rng.permutation(36)
    y, who = y[order], who[order]
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 0.0, 2.0), pm.HalfNormal("sigma", 1.0)
        metric = prb.LogLikelihood(error=0.4)
        population = pm.Normal.dist(mu, sigma)
        prb.Simulator("y", response, population, metric=metric, observed=y, specimens=who)
        result = prb.sample(random_seed=1)
        prb.diagnose(result, model=model)
    loo = az.loo(result, pointwise=True)

    nodes = np.linspace(-3.0, 4.0, 1401)
    by_reading = stats.norm.logpdf(y[:, None], response(nodes), 0.4)
    of_reading = np.stack([np.exp(by_reading[who == i].sum(axis=0)) for i in range(12)]) * 0.005
    mus, sigmas = np.meshgrid(np.linspace(0.3, 1.6, 101), np.linspace(0.01, 1.3, 100))
    density = stats.norm.pdf(nodes[:, None], mus.ravel(), sigmas.ravel())
    prior = stats.norm(0, 2).logpdf(mus.ravel()) + stats.halfnorm.logpdf(sigmas.ravel())
    exact = left_out(np.log(of_reading @ density), prior)[pd.unique(who)]
    reliable = np.asarray(loo.pareto_k) < 0.7  # the others are reported as unreliable
    yield difference("unreliable specimens", (~reliable).sum(), 0, 2)
    yield difference("elpd", np.asarray(loo.elpd_i)[reliable], exact[reliable], 0.1)


@problem
def leave_one_out_where_one_specimen_is_an_outlier() -> Iterator[tuple[str, float]]:
    x = np.r_[np.random.default_rng(79).normal(2.0, 0.2, 14), 3.6]

    def response(x: Any) -> Any:
        return x + 0.5 * np.tanh(x - 2.0)

    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 0.0, 5.0), pm.HalfNormal("sigma", 1.0)
        prb.Simulator("y", response, pm.Normal.dist(mu, sigma), observed=response(x))
        result = prb.sample(random_seed=1)
        diagnosis = prb.diagnose(result, model=model)
    loo = az.loo(result, pointwise=True)

    mus, sigmas = np.meshgrid(np.linspace(1.2, 3.0, 401), np.linspace(0.08, 1.6, 400))
    logs = stats.norm.logpdf(x[:, None], mus.ravel(), sigmas.ravel())
    logs = logs - np.log(1 + 0.5 / np.cosh(x - 2.0) ** 2)[:, None]
    prior = stats.norm(0, 5).logpdf(mus.ravel()) + stats.halfnorm.logpdf(sigmas.ravel())
    exact = left_out(logs, prior)
    yield difference("elpd of others", np.asarray(loo.elpd_i)[:-1], exact[:-1], 0.1)
    codes = {finding.code for finding in (*diagnosis.findings, *diagnosis.remarks)}
    is_named = bool({"influential-specimens", "population-misfit", "outlying-data"} & codes)
    yield difference("outlier is named", is_named, True, 0.5)


# -- combinations ----------------------------------------------------------------------------------


@problem
def correlated_inputs_of_five_specimens_from_one_output() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(81)
    x = rng.multivariate_normal([0.5, -1.0], [[0.04, -0.03], [-0.03, 0.09]], 5)

    def response(x: Any) -> Any:
        return 1e-6 * (np.exp(x[..., 0]) - 2.0 * x[..., 1])

    y = response(x)
    with pm.Model():
        mean = pm.Normal("mean", [0.5, -1.0], [0.5, 1.0])
        rho = pm.Uniform("rho", -0.99, 0.99)
        c = 0.06 * rho
        rows = [pm.math.stack([0.04, c]), pm.math.stack([c, 0.09])]
        population = pm.MvNormal.dist(mean, pm.math.stack(rows))
        prb.Simulator("y", response, population, observed=y)
        draws = prb.sample(random_seed=1).posterior

    z, p = normal_nodes(161)

    def log_posterior(a: Any, b: Any, rho: Any) -> Any:
        logs = stats.norm(0.5, 0.5).logpdf(a) + stats.norm(-1, 1).logpdf(b)
        for block in np.array_split(np.arange(len(a)), 200):
            m, n, r = (v[block, None, None] for v in (a, b, rho))
            first = m + 0.2 * z
            second = (np.exp(first) - y[:, None] * 1e6) / 2.0
            sd = 0.3 * np.sqrt(1 - r**2)
            density = stats.norm.pdf(second, n + 0.3 * r * z, sd) / 2.0
            logs[block] += np.log(density @ p).sum(axis=1)
        return logs

    axes = {
        "a": np.linspace(-1.2, 2.2, 41),
        "b": np.linspace(-3.2, 1.6, 41),
        "rho": np.linspace(-0.98, 0.98, 21),
    }
    values, weights = on_grid(log_posterior, **axes)
    got = {
        "a": draws["mean"].values[..., 0],
        "b": draws["mean"].values[..., 1],
        "rho": draws["rho"],
    }
    yield from moments(got, values, weights)


@problem
def uniform_population_of_two_unknown_ends_with_errors() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(82)
    x = rng.uniform(1.0, 3.0, 12)

    def response(x: Any) -> Any:
        return x**2

    y = response(x) + 0.2 * rng.normal(size=12)
    with pm.Model():
        low, width = pm.Normal("low", 1.0, 2.0), pm.HalfNormal("width", 4.0)
        population = pm.Uniform.dist(low, low + width)
        metric = prb.LogLikelihood(error=0.2)
        prb.Simulator("y", response, population, metric=metric, observed=y)
        draws = prb.sample(random_seed=1).posterior

    nodes = np.linspace(-14.0, 22.0, 36001)
    of_reading = stats.norm.pdf(y[:, None], response(nodes), 0.2) * 0.001
    cumulative = np.cumsum(of_reading, axis=1)

    def log_posterior(low: Any, width: Any) -> Any:
        at = [cumulative[:, np.searchsorted(nodes, v)] for v in (low, low + width)]
        mass = np.maximum(at[1] - at[0], 1e-300)
        logs = np.log(mass).sum(axis=0) - 12 * np.log(width)
        return logs + stats.norm(1, 2).logpdf(low) + stats.halfnorm(scale=4).logpdf(width)

    axes = {"low": np.linspace(-6.0, 2.0, 801), "width": np.linspace(0.3, 12.0, 1171)}
    values, weights = on_grid(log_posterior, **axes)
    yield from moments(draws, values, weights)


@problem
def groups_with_a_covariate_and_a_condition() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(83)
    who, heat, load = np.repeat([0, 1, 2], 6), rng.uniform(200, 500, 18), rng.uniform(1, 4, 18)
    x = np.array([0.0, 0.5, 0.2])[who] + 0.002 * (heat - 300) + 0.15 * rng.normal(size=18)

    def response(x: Any, load: Any) -> Any:
        return load * np.exp(x)

    index = pd.Index(np.array(["u", "v", "w"])[who], name="mill")
    data = pd.Series(response(x, load), index=index)
    with pm.Model(coords={"mill": ["u", "v", "w"]}):
        a = pm.Normal("a", 0.0, 1.0, dims="mill")
        b, sigma = pm.Normal("b", 0.0, 0.01), pm.HalfNormal("sigma", 0.5)
        warm = prb.response.condition("heat", heat)
        mean = a[prb.response.group("mill")] + b * (warm - 300.0)
        inputs = pm.Normal.dist(mean, sigma), prb.response.condition("load", load)
        prb.Simulator("y", response, *inputs, observed=data)
        draws = prb.sample(random_seed=1).posterior

    def log_posterior(theta: Any) -> Any:
        slope, sigma = 1e-3 * theta[:, 3], np.exp(theta[:, 4])
        mean = theta[:, who].T + slope * (heat - 300)[:, None]
        logs = stats.norm.logpdf(x[:, None], mean, sigma).sum(axis=0)
        logs += stats.norm.logpdf(theta[:, :3]).sum(axis=1) + stats.norm(0, 0.01).logpdf(slope)
        return logs + stats.halfnorm(scale=0.5).logpdf(sigma) + theta[:, 4]

    points, weights = by_importance(log_posterior, [0.0, 0.5, 0.2, 2.0, -2.0])
    got = {f"a{i}": draws["a"].values[..., i] for i in range(3)}
    got |= {"b": 1e3 * draws["b"].values, "log sigma": np.log(draws["sigma"].values)}
    yield from moments(got, dict(zip(got, points.T, strict=True)), weights)


@problem
def groups_of_functions_of_each_specimen() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(84)
    who, times = np.repeat([0, 1], [5, 9]), rng.uniform(0.5, 2.0, 14)
    x = rng.normal(np.array([1.0, 2.0])[who], 0.3)

    def response(x: Any, time: Any) -> Any:
        return 1e6 * np.expm1(np.asarray(x) * time)

    y = [float(response(v, time)) for v, time in zip(x, times, strict=True)]
    data = pd.Series(y, index=pd.Index(np.array(["p", "q"])[who], name="batch"))
    with pm.Model(coords={"batch": ["p", "q"]}):
        mu = pm.Normal("mu", 0.0, 2.0, dims="batch")
        sigma = pm.HalfNormal("sigma", 1.0)
        population = pm.Normal.dist(mu[prb.response.group("batch")], sigma)
        own = prb.response.by_specimen(response, list(times))
        prb.Simulator("y", own, population, observed=data)
        draws = prb.sample(random_seed=1).posterior

    s = np.linspace(0.05, 1.5, 3000)
    logs = stats.halfnorm.logpdf(s)
    parts = []
    for g in range(2):
        v = x[who == g]
        n, center = len(v), v.mean()
        logs -= ((v - center) ** 2).sum() / (2 * s**2) + (n - 1) * np.log(s)
        logs += stats.norm.logpdf(center, 0.0, np.hypot(2.0, s / np.sqrt(n)))
        variance = 1 / (0.25 + n / s**2)
        parts.append((variance * n * center / s**2, variance))
    weights = special.softmax(logs)
    yield from moments(draws, {"sigma": s}, weights)
    for g, (middle, variance) in enumerate(parts):
        mean = weights @ middle
        sd = np.sqrt(weights @ (variance + (middle - mean) ** 2))
        drawn = draws["mu"].values[..., g]
        yield difference(f"mean of mu {g}", drawn.mean(), mean, 0.1 * sd)
        yield difference(f"sd of mu {g}", drawn.std(), sd, 0.1 * sd)


@problem
def three_kinds_of_specimens_with_unknown_shares() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(85)
    kinds = rng.choice(3, 30, p=[0.5, 0.3, 0.2])
    x = np.exp(rng.normal(np.array([-1.0, 0.5, 2.0])[kinds], 0.3))

    def response(x: Any) -> Any:
        return 1e-9 * np.log(x) ** 2 + 4e-9 * np.log(x)

    with pm.Model():
        w = pm.Dirichlet("w", np.array([1.0, 1.0, 1.0]))
        parts = [pm.LogNormal.dist(m, 0.3) for m in (-1.0, 0.5, 2.0)]
        prb.Simulator("y", response, pm.Mixture.dist(w, parts), observed=response(x))
        draws = prb.sample(random_seed=1).posterior["w"].values

    v = np.log(x)
    roots = np.stack([v, -4.0 - v])
    density = stats.norm.pdf(roots[:, :, None], [-1.0, 0.5, 2.0], 0.3).sum(axis=0)
    points = np.random.default_rng(0).dirichlet(np.ones(3), 400_000)
    logs = np.log(points @ density.T).sum(axis=1)
    weights = special.softmax(logs)
    got = {f"w{i}": draws[..., i] for i in range(3)}
    yield from moments(got, dict(zip(got, points.T, strict=True)), weights)


@problem
def table_of_runs_for_groups() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(86)
    who = np.repeat([0, 1], [7, 12])
    x = rng.normal(np.array([2.0e6, 2.6e6])[who], 2e5)
    runs = np.sort(rng.uniform(0.8e6, 4e6, 35))

    def response(x: Any) -> Any:
        return 1e-6 * x + 0.2 * (1e-6 * x) ** 3

    data = pd.Series(response(x), index=pd.Index(np.array(["l", "r"])[who], name="side"))
    with pm.Model(coords={"side": ["l", "r"]}):
        mu = pm.Normal("mu", 2.3e6, 4e5, dims="side")
        sigma = pm.HalfNormal("sigma", 2e5)
        population = pm.Normal.dist(mu[prb.response.group("side")], sigma)
        table = prb.Runs(pd.DataFrame({"E": runs}), pd.Series(response(runs), name="y"))
        prb.Simulator("y", table, population, observed=data)
        draws = prb.sample(random_seed=1).posterior

    mus, sigmas = np.linspace(1.5e6, 3.2e6, 851), np.linspace(8e4, 6e5, 261)
    tables = []
    for g in range(2):
        v = x[who == g][:, None, None]
        logs = stats.norm(mus, sigmas[:, None]).logpdf(v).sum(axis=0)
        tables.append(logs + stats.norm(2.3e6, 4e5).logpdf(mus))
    total = sum(special.logsumexp(t, axis=1) for t in tables)
    weights = special.softmax(total + stats.halfnorm(scale=2e5).logpdf(sigmas))
    yield from moments(draws, {"sigma": sigmas}, weights)
    for g, table_of in enumerate(tables):
        conditional = weights @ special.softmax(table_of, axis=1)
        yield from moments({"mu": draws["mu"].values[..., g]}, {"mu": mus}, conditional)


@problem
def fleet_of_sinh_arcsinh_populations() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(87)
    x = {"right": rng.gamma(2.0, 0.5, 30), "left": 3.0 - rng.gamma(2.0, 0.3, 20)}

    def response(x: Any) -> Any:
        return x + 0.1 * x**3

    data = {name: response(v) for name, v in x.items()}
    with pm.Model() as model:
        mu, s = pm.Normal("mu", 0.0, 5.0), pm.HalfNormal("s", 2.0)
        population = prb.families.SinhArcsinh.dist(mu, s, name="x")
        prb.Simulator("y", response, population, observed=data["right"])
    fleet = prb.calibrate_each(data, model=model, draws=4000, progressbar=False)
    for name, v in x.items():

        def log_posterior(theta: Any, v: Any = v) -> Any:
            s, tail = np.exp(theta[:, 1]), np.exp(theta[:, 3])
            logs = sinh_arcsinh(v[:, None], theta[:, 0], s, theta[:, 2], tail=tail).sum(axis=0)
            logs += stats.norm(0, 5).logpdf(theta[:, 0]) + stats.halfnorm(scale=2).logpdf(s)
            logs += stats.norm(0, 0.35).logpdf(theta[:, 2]) + stats.norm(0, 0.25).logpdf(
                theta[:, 3]
            )
            return logs + theta[:, 1]

        points, weights = by_importance(log_posterior, [v.mean(), np.log(v.std()), 0.0, 0.0])
        draws = fleet["posterior"].dataset.sel(product=name)
        got = {
            f"{name} mu": draws["mu"].values,
            f"{name} log s": np.log(draws["s"].values),
            f"{name} skew": draws["x_skew"].values,
            f"{name} log tail": np.log(draws["x_tail"].values),
        }
        yield from moments(got, dict(zip(got, points.T, strict=True)), weights)


@problem
def update_of_correlated_inputs() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(88)
    covariance = np.array([[1.0, 0.8e-6], [0.8e-6, 1e-12]])
    x = rng.multivariate_normal([5.0, 3e-6], covariance, 13)

    def response(x: Any) -> Any:
        return np.stack([x[..., 0] * (1 + 1e5 * x[..., 1]), 1e6 * x[..., 1]], axis=-1)

    y = response(x)
    with pm.Model() as model:
        mean = pm.Normal("mean", [0.0, 0.0], [10.0, 1e-5])
        population = pm.MvNormal.dist(mean, covariance)
        prb.Simulator("y", response, population, observed=y[:4])
        result = prb.sample(random_seed=1)
        for part in (y[4:5], y[5:]):
            result = prb.update(result, observed=part, model=model)
    draws = result.posterior["mean"].values.reshape(-1, 2) * [1.0, 1e6]

    scaled, v = np.array([[1.0, 0.8], [0.8, 1.0]]), x * [1.0, 1e6]
    precision = 13 * np.linalg.inv(scaled) + np.diag([1e-2, 1e-2])
    exact = np.linalg.inv(precision)
    middle = exact @ np.linalg.inv(scaled) @ v.sum(axis=0)
    sd = np.sqrt(np.diag(exact))
    yield difference("means", draws.mean(axis=0), middle, 0.1 * sd)
    yield difference("sds", draws.std(axis=0), sd, 0.1 * sd)


@problem
def random_response_of_two_groups() -> Iterator[tuple[str, float]]:
    rng = np.random.default_rng(89)
    who = np.repeat([0, 1], [12, 12])

    def response(x: Any, rng: Any) -> Any:
        return x + 0.4 * rng.normal(size=np.shape(x))

    y = response(rng.normal(np.array([0.0, 1.5])[who], 0.5), rng)
    data = pd.Series(y, index=pd.Index(np.array(["s", "t"])[who], name="site"))
    with pm.Model(coords={"site": ["s", "t"]}):
        mu = pm.Normal("mu", 0.0, 2.0, dims="site")
        sigma = pm.HalfNormal("sigma", 1.0)
        population = pm.Normal.dist(mu[prb.response.group("site")], sigma)
        random = prb.response.Stochastic(response, random_seed=1)
        prb.Simulator("y", random, population, observed=data)
        draws = prb.sample(random_seed=1).posterior

    s = np.linspace(0.002, 2.0, 2000)
    spread = np.hypot(s, 0.4)
    logs = stats.halfnorm.logpdf(s)
    for g in range(2):
        v = y[who == g]
        logs -= ((v - v.mean()) ** 2).sum() / (2 * spread**2) + 11 * np.log(spread)
        logs += stats.norm.logpdf(v.mean(), 0.0, np.hypot(2.0, spread / np.sqrt(12)))
    yield from random_moments(draws, {"sigma": s}, special.softmax(logs))
