"""Exact posteriors of a normal population with a prior of its mean and standard deviation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from prbayes._validate import Floats

LogPrior = Callable[[Floats, Floats], Floats]  # of mu and sigma


@dataclass(frozen=True)
class Moments:
    """Means and standard deviations of mu and log sigma."""

    mean: Floats
    sd: Floats


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
