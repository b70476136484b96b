"""Posteriors from counts, errors with two parts, a bias and limits, beside exact ones by quadrature.

The inputs are a normal population with mean 1 and standard deviation .5; the response is exp(x), and
1 / (1 + exp(-x)) of the binomial numbers. Each specimen has one count, with an exposure of its own,
or two readings. ``gaver`` are ten pumps with a gamma population of failure rates [1]_, and ``limit``
has all readings of a second output at a limit.

The reference integrates the input over 131 equidistant points and the hyperparameters by importance
sampling from a t distribution.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.kinds_of_readings [--data-sets 5]

.. [1] Gaver and O'Muircheartaigh (1987), Technometrics 29, 1-15, table 1.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
from scipy import stats
from scipy.special import expit, gammaln, logsumexp, ndtri

import prbayes as prb
from benchmarks.study import Study
from prbayes._validate import Floats

FAILURES = np.array([5, 1, 5, 14, 3, 19, 1, 1, 4, 22])
HOURS = np.array([94.32, 15.72, 62.88, 125.76, 5.24, 31.44, 1.048, 1.048, 2.096, 10.48])
_N, _DEGREES = 24, 5.0
_Z = np.linspace(-6.5, 6.5, 131)


@dataclass(frozen=True)
class Prior:
    """A hyperparameter: its prior, and whether the reference has its logarithm."""

    name: str
    frozen: Any  # distribution of SciPy
    variable: Callable[[], Any]
    is_log: bool


def half_normal(name: str, scale: float) -> Prior:
    return Prior(name, stats.halfnorm(scale=scale), lambda: pm.HalfNormal(name, scale), True)


def normal(name: str, mean: float, sd: float) -> Prior:
    return Prior(name, stats.norm(mean, sd), lambda: pm.Normal(name, mean, sd), False)


def exponential(name: str) -> Prior:
    return Prior(name, stats.expon(), lambda: pm.Exponential(name, 1.0), True)


def lognormal(name: str, mean: float, sd: float) -> Prior:
    frozen = stats.lognorm(sd, scale=np.exp(mean))
    return Prior(name, frozen, lambda: pm.LogNormal(name, mean, sd), True)


@dataclass(frozen=True)
class Case:
    """A model of readings, and its exact log-likelihood."""

    priors: Sequence[Prior]
    observed: Floats
    response: Callable[[Floats], Floats]
    # Variables by name to the metric
    metric: Callable[[dict[str, Any]], prb.Metric]
    # Values by name, (P, 1, 1) each, to log-likelihoods of specimens, (P, N)
    log_likelihood: Callable[[dict[str, Floats]], Floats]
    population: Callable[[dict[str, Any]], Any] = lambda v: pm.Normal.dist(v["mu"], v["sigma"])


def of_normal(
    log_density: Callable[[Floats, dict[str, Floats]], Floats],
) -> Callable[[dict[str, Floats]], Floats]:
    """Return log-likelihoods of a normal population, from densities of all readings (P, Z, N)."""
    log_weight = stats.norm.logpdf(_Z) + np.log(_Z[1] - _Z[0])

    def log_likelihood(values: dict[str, Floats]) -> Floats:
        x = np.clip(values["mu"] + values["sigma"] * _Z[:, None], -50, 50)
        logs = log_density(x, values) + log_weight[:, None]
        return np.asarray(logsumexp(logs, axis=1))

    return log_likelihood


def both(x: Floats) -> Floats:
    """Return two readings of exp(x)."""
    return np.stack([np.exp(x)] * 2, axis=-1)


def input_and_exponential(x: Floats) -> Floats:
    return np.stack([x, np.exp(x)], axis=-1)


def case_of(cell: str, seed: int) -> Case:
    """Return the case of a cell with its data."""
    rng = np.random.default_rng([seed, 1])
    x, kinds = rng.normal(1.0, 0.5, _N), prb.readings
    mean, size = np.exp(x), rng.uniform(0.5, 4.0, _N).round(2)
    mu, sigma = normal("mu", 1.0, 1.0), half_normal("sigma", 1.0)
    if cell == "gaver":
        alpha, beta = exponential("alpha"), exponential("beta")

        def gaver(v: dict[str, Floats]) -> Floats:
            a, b = v["alpha"][:, 0], v["beta"][:, 0]
            share = b / (b + HOURS)
            log_gamma = gammaln(FAILURES + a) - gammaln(a) - gammaln(FAILURES + 1)
            return np.asarray(log_gamma + a * np.log(share) + FAILURES * np.log1p(-share))

        return Case(
            [alpha, beta],
            FAILURES.astype(float),
            np.positive,
            lambda v: prb.LogLikelihood(error=kinds.Poisson(HOURS)),
            gaver,
            lambda v: pm.Gamma.dist(v["alpha"], v["beta"]),
        )
    if cell == "poisson":
        y = rng.poisson(size * mean).astype(float)
        exact = of_normal(lambda x, v: stats.poisson.logpmf(y, size * np.exp(x)))
        metric = prb.LogLikelihood(error=kinds.Poisson(size))
        return Case([mu, sigma], y, np.exp, lambda v: metric, exact)
    if cell == "negative binomial":
        y = rng.poisson(size * mean * rng.gamma(4.0, 0.25, _N)).astype(float)

        def nbinom(x: Floats, v: dict[str, Floats]) -> Floats:
            return np.asarray(
                stats.nbinom.logpmf(y, v["alpha"], 1 / (1 + size * np.exp(x) / v["alpha"]))
            )

        return Case(
            [mu, sigma, lognormal("alpha", np.log(4.0), 0.5)],
            y,
            np.exp,
            lambda v: prb.LogLikelihood(error=kinds.NegativeBinomial(v["alpha"], size)),
            of_normal(nbinom),
        )
    if cell == "binomial":
        n = rng.integers(5, 40, _N)
        y = rng.binomial(n, expit(x)).astype(float)
        exact = of_normal(lambda x, v: stats.binom.logpmf(y, n, expit(x)))
        metric = prb.LogLikelihood(error=kinds.Binomial(n))
        return Case([mu, sigma], y, expit, lambda v: metric, exact)
    if cell == "combined":
        sd = np.hypot(0.2, 0.1 * mean)[:, None]
        y = mean[:, None] + sd * rng.standard_normal((_N, 2))

        def combined(x: Floats, v: dict[str, Floats]) -> Floats:
            f = np.exp(x)[..., None]
            scale = np.hypot(v["a"][..., None], v["b"][..., None] * f)
            return np.asarray(stats.norm.logpdf(y, f, scale).sum(axis=-1))

        return Case(
            [mu, sigma, half_normal("a", 0.3), half_normal("b", 0.2)],
            y,
            both,
            lambda v: prb.LogLikelihood(error=kinds.Combined(v["a"], v["b"])),
            of_normal(combined),
        )
    if cell == "bias":
        y = mean + 0.5 + 0.3 * rng.standard_normal(_N)
        exact = of_normal(lambda x, v: stats.norm.logpdf(y, np.exp(x) + v["bias"], 0.3))
        priors = [mu, sigma, normal("bias", 0.3, 0.2)]
        return Case(
            priors, y, np.exp, lambda v: prb.LogLikelihood(error=0.3, bias=v["bias"]), exact
        )
    assert cell == "limit"
    y = np.stack([x + 0.3 * rng.standard_normal(_N), np.full(_N, 2.0)], axis=1)

    def limit(x: Floats, v: dict[str, Floats]) -> Floats:
        beyond = stats.norm.logsf(2.0, np.exp(x), 0.2)
        return np.asarray(stats.norm.logpdf(y[:, 0], x, 0.3) + beyond)

    metric = prb.LogLikelihood(error=[0.3, 0.2], censored=(None, [np.inf, 2.0]))
    return Case([mu, sigma], y, input_and_exponential, lambda v: metric, of_normal(limit))


def exact(case: Case, size: int = 2**11) -> tuple[Floats, Floats]:
    """Return posterior means and standard deviations of the hyperparameters."""
    d = len(case.priors)
    is_log = np.array([p.is_log for p in case.priors])

    def log_density(theta: Floats) -> Floats:
        natural = np.where(is_log, np.exp(np.clip(theta, -50, 20)), theta)
        total = theta[:, is_log].sum(axis=1)
        for p, column in zip(case.priors, natural.T, strict=True):
            total = total + p.frozen.logpdf(column)
        parts = []
        for block in np.array_split(natural, 1 + len(natural) // 64):
            values = {p.name: block[:, k, None, None] for k, p in enumerate(case.priors)}
            parts.append(case.log_likelihood(values).sum(axis=1))
        return np.asarray(total + np.concatenate(parts))

    u = stats.qmc.Sobol(d, rng=0).random(size)
    natural = np.column_stack([p.frozen.ppf(c) for p, c in zip(case.priors, u.T, strict=True)])
    theta = np.where(is_log, np.log(np.where(is_log, natural, 1.0)), natural)
    log_prior = theta[:, is_log].sum(axis=1)
    for p, column in zip(case.priors, natural.T, strict=True):
        log_prior = log_prior + p.frozen.logpdf(column)
    log_w = log_density(theta) - log_prior
    for seed in range(1, 5):
        w = np.exp(log_w - log_w.max())
        w /= w.sum()
        center = w @ theta
        covariance = ((theta - center).T * w) @ (theta - center) + 1e-6 * np.eye(d)
        u = np.clip(stats.qmc.Sobol(d + 1, rng=seed).random(2 * size), 1e-9, 1 - 1e-9)
        radius = np.sqrt(_DEGREES / stats.chi2.ppf(u[:, d:], _DEGREES))
        theta = center + radius * ndtri(u[:, :d]) @ np.linalg.cholesky(1.5 * covariance).T
        log_q = stats.multivariate_t(center, 1.5 * covariance, df=_DEGREES).logpdf(theta)
        log_w = log_density(theta) - log_q
    w = np.exp(log_w - log_w.max())
    w /= w.sum()
    natural = np.where(is_log, np.exp(theta), theta)
    mean = w @ natural
    return mean, np.sqrt(w @ (natural - mean) ** 2)


def row(cell: str, seed: int) -> dict[str, Any]:
    """Return offsets in exact standard deviations, ratios of these, runs and CPU seconds."""
    case = case_of(cell, seed)
    mean, sd = exact(case)
    start = time.process_time()
    with pm.Model() as model:
        variables = {p.name: p.variable() for p in case.priors}
        population = case.population(variables)
        metric = case.metric(variables)
        prb.Simulator("y", case.response, population, metric=metric, observed=case.observed)
    draws = prb.sample(4000, model=model, random_seed=seed, progressbar=False)
    seconds = time.process_time() - start
    samples = [draws.posterior[p.name].values for p in case.priors]
    offset = [(x.mean() - m) / s for x, m, s in zip(samples, mean, sd, strict=True)]
    width = [x.std() / s for x, s in zip(samples, sd, strict=True)]
    return {"offset": offset, "width": width, "seconds": seconds}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the largest offset and the range of widths over data sets and hyperparameters."""
    offsets, widths = (np.array([row[key] for row in rows]) for key in ("offset", "width"))
    return {
        "largest offset": round(float(np.abs(offsets).max()), 3),
        "mean offset": round(float(np.abs(offsets.mean(axis=0)).max()), 3),
        "widths": [round(float(widths.min()), 3), round(float(widths.max()), 3)],
        "CPU seconds": round(float(np.median([row["seconds"] for row in rows])), 1),
        "data sets": len(rows),
    }


CELLS = ["gaver", "poisson", "negative binomial", "binomial", "combined", "bias", "limit"]
STUDY = Study("kinds_of_readings", __doc__, CELLS, row, 5, summary)

if __name__ == "__main__":
    STUDY.main()
