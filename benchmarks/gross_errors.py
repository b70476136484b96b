"""Price and gain of ``LogLikelihood(gross_errors=True)``: clean data, gross errors of 4 and of 8 sd.

The readings are a normal population, mean 10 and standard deviation 1. A twentieth of them is moved
up by 4 or by 8 standard deviations. The posterior with and without ``gross_errors`` is integrated by
importance sampling: uniform Sobol points first, then a t distribution with their moments. The
reference is the exact posterior of the readings without a gross error, on a grid.

    uv run python -m benchmarks.gross_errors [--data-sets 20]
"""

from __future__ import annotations

import argparse
import logging
from itertools import product
from typing import Any

import numpy as np
import pymc as pm
from scipy import stats
from scipy.special import ndtri

import prbayes as prb
from benchmarks import record
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator

OUT = record.RESULTS / "gross_errors.json"
SIZES = (20, 60)
SHIFTS = (0.0, 4.0, 8.0)
# Unconstrained ranges of mu, log sigma and logit of the share of gross errors.
_LOW, _HIGH = np.array([8.5, -1.2, -9.0]), np.array([13.0, 1.6, 2.0])
_DEGREES = 5.0


def readings(size: int, seed: int) -> Floats:
    """Return readings without gross errors, (size,)."""
    return np.random.default_rng([seed, size]).normal(10.0, 1.0, size)


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
        x = pm.Normal.dist(mu, sigma)
        prb.Simulator("y", np.positive, x, metric=metric, observed=observed, progressbar=False)
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
    mean, covariance = moments(
        np.column_stack([mu, sigma]), log - len(values) * np.log(sigma) - square / (2 * sigma**2)
    )
    return mean, np.sqrt(np.diag(covariance))


def row(size: int, shift: float, *, gross_errors: bool, data_sets: int) -> dict[str, Any]:
    """Return mean and standard error of the bias, in exact sd, and mean ratios of sd."""
    biases, widths = [], []
    gross = size // 20 if shift else 0
    for seed in range(data_sets):
        values = readings(size, seed)
        center, sd = exact(values[gross:])
        values[:gross] += shift
        mean, width = posterior(values, gross_errors=gross_errors)
        biases.append((mean - center) / sd)
        widths.append(width / sd)
    bias, error = np.mean(biases, axis=0), np.std(biases, axis=0, ddof=1) / np.sqrt(data_sets)
    numbers = {"bias": bias, "error": error, "width": np.mean(widths, axis=0)}
    cell = {"size": size, "shift": shift, "gross_errors": gross_errors, "data sets": data_sets}
    return cell | {name: value.round(4).tolist() for name, value in numbers.items()}


def main() -> None:
    """Compute, print and save."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data-sets", type=int, default=20)
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    rows = []
    for size, shift, flag in product(SIZES, SHIFTS, (False, True)):
        rows.append(row(size, shift, gross_errors=flag, data_sets=arguments.data_sets))
        print(rows[-1], flush=True)
    record.save(OUT, rows)


if __name__ == "__main__":
    main()
