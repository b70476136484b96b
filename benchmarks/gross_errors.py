"""Price and gain of ``LogLikelihood(gross_errors=True)``: clean data, gross errors of 4 and of 8 sd.

The readings are a normal population, mean 10 and standard deviation 1. A twentieth of them is moved
up by 4 or by 8 standard deviations. The posterior with and without ``gross_errors`` is integrated by
importance sampling: uniform Sobol points first, then a t distribution with their moments. The
reference is the exact posterior of the readings without a gross error, on a grid.

    uv run python -m benchmarks.gross_errors [--data-sets 20]
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pymc as pm
from scipy import stats
from scipy.special import ndtri

import prbayes as prb
from benchmarks.study import Study
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator

# Unconstrained ranges of mu, log sigma and logit of the share of gross errors.
_LOW, _HIGH = np.array([8.5, -1.2, -9.0]), np.array([13.0, 1.6, 2.0])
_DEGREES = 5.0


def moments(theta: Floats, log_w: Floats) -> tuple[Floats, Floats]:
    """Return mean and covariance of weighted points, (n, d)."""
    w = np.exp(log_w - log_w.max())
    w /= w.sum()
    mean = w @ theta
    away = theta - mean
    return mean, (w[:, None] * away).T @ away


def posterior(observed: Floats, *, gross_errors: bool) -> tuple[Floats, Floats]:
    """Return posterior means and standard deviations of mu and sigma, (2,) each."""
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 10, 3), pm.HalfNormal("sigma", 3)
        metric = prb.LogLikelihood(gross_errors=gross_errors)
        prb.Simulator("y", np.positive, pm.Normal.dist(mu, sigma), metric=metric, observed=observed)
    evaluator = Evaluator.of(model)
    d = evaluator.hyperparameters.size

    def log_density(theta: Floats) -> Floats:
        values = evaluator(np.ascontiguousarray(theta))
        return np.asarray(values.log_prior + values.log_other)

    theta = _LOW[:d] + (_HIGH - _LOW)[:d] * stats.qmc.Sobol(d, rng=0).random(2**13)
    mean, covariance = moments(theta, log_density(theta))
    for seed in (1, 2):
        u = np.clip(stats.qmc.Sobol(d + 1, rng=seed).random(2**13), 1e-9, 1 - 1e-9)
        radius = np.sqrt(_DEGREES / stats.chi2.ppf(u[:, d:], _DEGREES))
        theta = mean + radius * ndtri(u[:, :d]) @ np.linalg.cholesky(covariance).T
        proposal = stats.multivariate_t(mean, covariance, df=_DEGREES).logpdf(theta)
        log_w = log_density(theta) - proposal
        mean, covariance = moments(theta, log_w)
    natural = np.column_stack([theta[:, 0], np.exp(theta[:, 1])])
    mean, covariance = moments(natural, log_w)
    return mean, np.sqrt(np.diag(covariance))


def exact(values: Floats) -> tuple[Floats, Floats]:
    """Return the same of the exact posterior of readings, on a grid."""
    mu, sigma = (a.ravel() for a in np.meshgrid(np.linspace(8, 12, 801), np.geomspace(0.3, 4, 801)))
    log = stats.norm.logpdf(mu, 10, 3) + stats.halfnorm.logpdf(sigma, scale=3) + np.log(sigma)
    square = ((values - values.mean()) ** 2).sum() + len(values) * (values.mean() - mu) ** 2
    log_w = log - len(values) * np.log(sigma) - square / (2 * sigma**2)
    mean, covariance = moments(np.column_stack([mu, sigma]), log_w)
    return mean, np.sqrt(np.diag(covariance))


def row(cell: str, seed: int) -> dict[str, Any]:
    """Return biases in exact standard deviations, and ratios of standard deviations."""
    size, shift, flag = cell.split("/")
    values = np.random.default_rng([seed, int(size)]).normal(10.0, 1.0, int(size))
    gross = int(size) // 20 if float(shift) else 0
    center, sd = exact(values[gross:])
    values[:gross] += float(shift)
    mean, width = posterior(values, gross_errors=flag == "True")
    return {"bias": ((mean - center) / sd).tolist(), "width": (width / sd).tolist()}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return mean and standard error of the bias, and mean ratios."""
    biases, widths = (np.array([row[key] for row in rows]) for key in ("bias", "width"))
    error = biases.std(axis=0, ddof=1) / np.sqrt(len(rows))
    numbers = {"bias": biases.mean(axis=0), "error": error, "width": widths.mean(axis=0)}
    rounded = {name: value.round(4).tolist() for name, value in numbers.items()}
    return rounded | {"data sets": len(rows)}


CELLS = [f"{n}/{shift}/{flag}" for n, shift, flag in product((20, 60), (0, 4, 8), (False, True))]
STUDY = Study("gross_errors", __doc__, CELLS, row, 20, summary, has_rows=False)

if __name__ == "__main__":
    STUDY.main()
