"""Exact posteriors of a normal population, and those given the estimate of a metric."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
from scipy import stats

import prbayes as prb
from prbayes._validate import Floats
from prbayes.metrics.base import Metric
from prbayes.numerics.modes import laplace
from prbayes.posterior.importance import importance_sample
from prbayes.posterior.target import Target

LogPrior = Callable[[Floats, Floats], Floats]  # of mu and sigma


@dataclass(frozen=True)
class Prior:
    """Mean and standard deviation of a population: their variables within a model, and density."""

    variables: Callable[[], tuple[Any, Any]]
    log_density: LogPrior


VAGUE = Prior(
    lambda: (pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1)),
    lambda mu, s: stats.norm(0, 2).logpdf(mu) + stats.halfnorm.logpdf(s),
)
SHARP = Prior(
    lambda: (pm.Normal("mu", 0.7, 0.1), pm.LogNormal("sigma", np.log(0.4), 0.1)),
    lambda mu, s: stats.norm(0.7, 0.1).logpdf(mu) + stats.lognorm(0.1, scale=0.4).logpdf(s),
)
BOUNDED = Prior(
    lambda: (pm.Uniform("mu", 0, 1.05), pm.Uniform("sigma", 0, 0.55)),
    lambda mu, s: stats.uniform(0, 1.05).logpdf(mu) + stats.uniform(0, 0.55).logpdf(s),
)


def normal_model(
    metric: Metric, *parts: Floats, prior: Prior = VAGUE, n: int = 512, **keywords: Any
) -> pm.Model:
    """Return a model of a normal population, with a simulator y = x for each part of the data."""
    settings = {"metric": metric, "propagation": prb.Reweighted(n), **keywords}
    with pm.Model() as model:
        x = pm.Normal.dist(*prior.variables())
        for k, part in enumerate(parts):
            prb.Simulator(f"y{k}", lambda x: 1.0 * x, x, observed=part, **settings)
    return model


@dataclass(frozen=True)
class Moments:
    """Means and standard deviations of mu and log sigma."""

    mean: Floats
    sd: Floats


def draws_of(target: Target, size: int = 1000) -> dict[str, Floats]:
    """Return draws of a posterior by name."""
    modes = laplace(target.log_posterior, target.starts, target.scale)
    sample = importance_sample(target.log_posterior, modes, size, seed=0)
    assert sample.pareto_k < 0.7
    return target.evaluator.hyperparameters.constrained(sample.draws)


def moments_of(draws: Mapping[str, Any], mu: str = "mu", sigma: str = "sigma") -> Moments:
    """Return moments of draws by name."""
    pair = np.stack([np.ravel(draws[mu]), np.log(np.ravel(draws[sigma]))])
    return Moments(pair.mean(axis=1), pair.std(axis=1))


def exact_moments(log_prior: LogPrior, y: Floats) -> Moments:
    """Return those of the posterior given the observed specimens, on a grid."""
    center, error = y.mean(), y.std() / np.sqrt(len(y))
    mu = np.linspace(center - 12 * error, center + 12 * error, 1201)
    log_sd = np.linspace(np.log(y.std()) - 2, np.log(y.std()) + 2, 1200)
    squares = len(y) * ((center - mu[:, None]) ** 2 + y.var()) / (2 * np.exp(2 * log_sd))
    with np.errstate(divide="ignore"):
        logs = log_prior(mu[:, None], np.exp(log_sd)) - squares - (len(y) - 1) * log_sd
    return grid_moments(mu, log_sd, logs)


def grid_moments(mu: Floats, log_sd: Floats, logs: Floats) -> Moments:
    """Return moments of an unnormalised log-density on a grid of mu (n,) and log sigma (m,)."""
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    means, variances = [], []
    for values, marginal in ((mu, weights.sum(axis=1)), (log_sd, weights.sum(axis=0))):
        mean = marginal @ values
        means.append(mean)
        variances.append(marginal @ (values - mean) ** 2)
    return Moments(np.array(means), np.sqrt(variances))


def require_close(
    found: Moments, exact: Moments, offset: float = 0.2, widths: tuple[float, float] = (0.9, 1.15)
) -> None:
    """Require means within a share of the exact standard deviation, and ratios of widths."""
    offsets = (found.mean - exact.mean) / exact.sd
    assert (np.abs(offsets) < offset).all(), offsets
    ratios = found.sd / exact.sd
    assert ((ratios > widths[0]) & (ratios < widths[1])).all(), ratios
