"""Posteriors of random responses, beside exact ones by quadrature with the true density.

Noise is gamma distributed with a skewness of 1; its spread depends on the inputs. ``one`` has one
input and output, ``two`` has two inputs and two outputs with correlated noise. Inputs are normal,
and all their means and standard deviations are unknown. The first number of runs is 128. The
reference knows the density of the noise. It integrates over a grid of the inputs, and over the
hyperparameters by importance sampling from a t distribution.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.random_responses [--data-sets 40]
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
from scipy import stats

import prbayes as prb
from benchmarks.study import Study
from prbayes._validate import Floats

_SHAPE, _N, _PROB = 4.0, 40, 0.89


def gamma_noise(rng: np.random.Generator, shape: Any) -> Floats:
    """Return noise with mean zero, variance one and skewness one."""
    return np.asarray((rng.gamma(_SHAPE, size=shape) - _SHAPE) / np.sqrt(_SHAPE))


def log_noise(e: Floats) -> Floats:
    logs = stats.gamma.logpdf(e * np.sqrt(_SHAPE) + _SHAPE, _SHAPE)
    return np.asarray(logs + 0.5 * np.log(_SHAPE))


@dataclass(frozen=True)
class Case:
    """A random response, its density, and the true means of its inputs; their sd is .5."""

    response: Callable[..., Floats]
    log_density: Callable[[Floats, Floats], Floats]  # y (N, m) and x (K, d) to (N, K)
    means: tuple[float, ...]
    grid: int  # points of the reference for each input


def one(x: Floats, rng: np.random.Generator) -> Floats:
    return x + 0.15 * x**2 + 0.25 * np.exp(0.25 * x) * gamma_noise(rng, np.shape(x))


def log_one(y: Floats, x: Floats) -> Floats:
    x1 = x[:, 0]
    spread = 0.25 * np.exp(0.25 * x1)
    return log_noise((y - x1 - 0.15 * x1**2) / spread) - np.log(spread)


def two(a: Floats, b: Floats, rng: np.random.Generator) -> Floats:
    g, h = gamma_noise(rng, np.shape(a)), gamma_noise(rng, np.shape(a))
    first = a + 0.3 * b + 0.1 * a**2 + 0.25 * np.exp(0.2 * a) * g
    second = b - 0.5 * a + 0.3 * np.exp(-0.2 * b) * (0.6 * g + 0.8 * h)
    return np.stack([first, second], axis=-1)


def log_two(y: Floats, x: Floats) -> Floats:
    a, b = x.T
    spreads = 0.25 * np.exp(0.2 * a), 0.3 * np.exp(-0.2 * b)
    g = (y[:, :1] - (a + 0.3 * b + 0.1 * a**2)) / spreads[0]
    h = ((y[:, 1:] - (b - 0.5 * a)) / spreads[1] - 0.6 * g) / 0.8
    return np.asarray(log_noise(g) + log_noise(h) - np.log(0.8 * spreads[0] * spreads[1]))


CASES = {"one": Case(one, log_one, (1.0,), 800), "two": Case(two, log_two, (1.0, 0.0), 70)}


def exact(case: Case, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Return means, standard deviations, and ends of 89 % intervals, (2, 2 d).

    They are those of means and log standard deviations of the inputs.
    """
    d = len(case.means)
    axis = [mean - 3.5 + 7.0 * (np.arange(case.grid) + 0.5) / case.grid for mean in case.means]
    x = np.stack([v.ravel() for v in np.meshgrid(*axis, indexing="ij")], axis=1)
    log_a = case.log_density(y.reshape(len(y), -1), x)
    largest = log_a.max(axis=1)
    likelihoods = np.exp(log_a - largest[:, None]).T
    cell = (7.0 / case.grid) ** d

    def log_posterior(theta: Floats) -> Floats:
        mean, log_sd = theta[:, :d], theta[:, d:]
        sd = np.exp(log_sd)
        density = cell * np.ones((len(theta), 1))
        for k, values in enumerate(axis):  # the last input varies fastest
            of_input = stats.norm.pdf(values, mean[:, k, None], sd[:, k, None])
            density = (density[:, :, None] * of_input[:, None]).reshape(len(theta), -1)
        with np.errstate(divide="ignore"):
            logs = np.log(density @ likelihoods).sum(axis=1)
        prior = stats.norm.logpdf(mean, case.means, 1.0) + stats.halfnorm.logpdf(sd) + log_sd
        return np.asarray(logs + prior.sum(axis=1))

    center = np.r_[case.means, np.full(d, np.log(0.5))]
    covariance = np.diag(np.full(2 * d, 0.15**2))
    rng = np.random.default_rng(0)
    for _ in range(5):
        proposal = stats.multivariate_t(center, covariance, df=5, seed=rng)
        theta = proposal.rvs(1500)
        logs = log_posterior(theta) - proposal.logpdf(theta)
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        center = weights @ theta
        covariance = 1.2 * (theta - center).T @ ((theta - center) * weights[:, None])
    sd = np.sqrt(weights @ (theta - center) ** 2)
    tail = (1 - _PROB) / 2
    columns = [quantiles(column, weights, np.array([tail, 1 - tail])) for column in theta.T]
    return center, sd, np.stack(columns, axis=1)


def quantiles(values: Floats, weights: Floats, probabilities: Floats) -> Floats:
    """Return quantiles of a weighted sample."""
    order = np.argsort(values)
    below = np.cumsum(weights[order]) - weights[order] / 2
    return np.interp(probabilities, below, values[order])


def row(cell: str, number: int) -> dict[str, Any]:
    case = CASES[cell]
    rng = np.random.default_rng([number, 11])
    d = len(case.means)
    x = rng.normal(case.means, 0.5, (_N, d))
    y = case.response(*x.T, rng=rng)
    center, sd, exact_ends = exact(case, y)
    response = prb.response.Stochastic(case.response, random_seed=number)
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    clock = time.process_time()
    with pm.Model() as model:
        inputs = [
            pm.Normal.dist(pm.Normal(f"mu{k}", mean, 1), pm.HalfNormal(f"s{k}", 1))
            for k, mean in enumerate(case.means)
        ]
        prb.Simulator("y", response, *inputs, observed=y)
    posterior = prb.sample(1000, model=model, random_seed=number, progressbar=False)["posterior"]
    seconds = time.process_time() - clock
    draws = [np.ravel(posterior[f"mu{k}"]) for k in range(d)]
    draws += [np.log(np.ravel(posterior[f"s{k}"])) for k in range(d)]
    truth = np.r_[case.means, np.full(d, np.log(0.5))]
    tail = (1 - _PROB) / 2
    ends = [np.quantile(draw, [tail, 1 - tail]) for draw in draws]
    return {
        "offset": [float((v.mean() - c) / s) for v, c, s in zip(draws, center, sd, strict=True)],
        "width": [float(v.std() / s) for v, s in zip(draws, sd, strict=True)],
        "covered": [bool(e[0] <= t <= e[1]) for e, t in zip(ends, truth, strict=True)],
        "exact covered": ((exact_ends[0] <= truth) & (truth <= exact_ends[1])).tolist(),
        "runs": int(prb.cost(model).simulators[0].computed),
        "seconds": seconds,
    }


def summary(rows: list[Any]) -> dict[str, Any]:
    """Return means and root mean squares: of the means of inputs, then of log standard deviations.

    The expected coverage is the probability of an interval under the exact posterior, which is
    normal: its scatter between data sets is far smaller than that of the coverage.
    """
    good = [r for r in rows if "error" not in r]
    offset, width = (np.array([r[key] for r in good]) for key in ("offset", "width"))
    half = -stats.norm.ppf((1 - _PROB) / 2) * width
    expected = stats.norm.cdf(offset + half) - stats.norm.cdf(offset - half)
    return {
        "data sets": len(rows),
        "failures": len(rows) - len(good),
        "mean offset": offset.mean(axis=0).round(3).tolist(),
        "rms offset": np.sqrt((offset**2).mean(axis=0)).round(3).tolist(),
        "mean width": width.mean(axis=0).round(3).tolist(),
        "coverage": np.mean([r["covered"] for r in good], axis=0).round(3).tolist(),
        "expected coverage": expected.mean(axis=0).round(3).tolist(),
        "exact coverage": np.mean([r["exact covered"] for r in good], axis=0).round(3).tolist(),
        "runs": float(np.mean([r["runs"] for r in good])),
        "CPU seconds": round(float(np.median([r["seconds"] for r in good])), 1),
    }


STUDY = Study(
    "random_responses",
    __doc__ or "",
    CASES,
    row,
    data_sets=40,
    summary=summary,
    failures=(RuntimeError, ValueError),
    block=5,
)

if __name__ == "__main__":
    STUDY.main()
