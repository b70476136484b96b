"""Densities of minimisers for a normal population, y = x, as references for the study ``refits``.

The minimiser (mean, log sd) of a data set is equivariant, so that one density of pivots serves all
hyperparameters. Data sets are drawn from populations in a ball of standard errors and refitted without
prbayes. The density of pivots is that of all minimisers, times the mean likelihood ratio of the standard
normal population, by a log-linear regression: unlike a density of standard normal data alone it is known
six standard errors away.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from scipy import stats
from scipy.spatial import cKDTree
from scipy.special import logsumexp

RADIUS = 6.5
DEGREE = 6


def area(y: Any, steps: int = 60) -> Any:
    """Return minimisers of the area metric for data sets (S, N).

    The area between distribution functions is that between quantile functions, |mu + sigma z(p) - y(p)|
    integrated over p: a regression by least absolute deviations.
    """
    size = y.shape[1]
    nodes = max(4, 160 // size)
    z = stats.norm.ppf((np.arange(size * nodes) + 0.5) / (size * nodes))
    result = []
    for block in np.array_split(y, max(1, y.size * nodes // 2_000_000)):
        values = np.repeat(np.sort(block, axis=1), nodes, axis=1)
        mean, sd = block.mean(axis=1), block.std(axis=1)
        for _ in range(steps):
            away = np.abs(values - mean[:, None] - sd[:, None] * z)
            w = 1 / np.maximum(away, 1e-3 * sd[:, None])
            s0, s1, s2 = w.sum(axis=1), w @ z, w @ z**2
            r0, r1 = (w * values).sum(axis=1), (w * values) @ z
            determinant = s0 * s2 - s1**2
            mean = (s2 * r0 - s1 * r1) / determinant
            sd = np.maximum((s0 * r1 - s1 * r0) / determinant, 1e-3 * sd)
        result.append(np.stack([mean, np.log(sd)], axis=1))
    return np.concatenate(result)


def cramer_von_mises(y: Any, steps: int = 40) -> Any:
    """Return minimisers of mean_i (Phi((y_i - mu) / sigma) - (i - 1/2) / N)^2 by Gauss-Newton steps."""
    values = np.sort(y, axis=1)
    size = y.shape[1]
    p = (np.arange(size) + 0.5) / size
    t = np.stack([np.median(y, axis=1), np.log(y.std(axis=1))], axis=1)
    for _ in range(steps):
        u = (values - t[:, :1]) * np.exp(-t[:, 1:])
        residual = stats.norm.cdf(u) - p
        density = stats.norm.pdf(u)
        first, second = -density * np.exp(-t[:, 1:]), -density * u
        a, b, c = (first**2).sum(1), (first * second).sum(1), (second**2).sum(1)
        g, h = (first * residual).sum(1), (second * residual).sum(1)
        determinant = a * c - b**2
        move = -np.stack([c * g - b * h, a * h - b * g], axis=1) / determinant[:, None]
        scale = np.stack([np.exp(t[:, 1]), np.ones(len(t))], axis=1)
        longest = np.abs(move / scale).max(axis=1, keepdims=True)
        t = t + move * 0.5 / np.maximum(longest, 0.5)
    return t


REFITS: dict[str, Callable[[Any], Any]] = {"area": area, "Cramér-von Mises": cramer_von_mises}


def terms(u: Any) -> Any:
    """Return monomials of two variables, (S, terms)."""
    pairs = [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
    return np.stack([u[:, 0] ** i * u[:, 1] ** j for i, j in pairs], axis=1)


@cache
def pivots(name: str, size: int, count: int = 20000) -> Any:
    """Return standard errors and coefficients of the log-density of the pivots of a metric."""
    rng = np.random.default_rng([11, size])
    units = np.array([1.1 / np.sqrt(size), 1.1 / np.sqrt(2 * size)])
    angle = 2 * np.pi * rng.random(count)
    radius = RADIUS * np.sqrt(rng.random(count))
    mean, log_sd = (units * np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)).T
    y = mean[:, None] + np.exp(log_sd)[:, None] * rng.standard_normal((count, size))
    u = REFITS[name](y) / units
    first, second = y.mean(axis=1)[:, None], y.var(axis=1)[:, None]
    mixture = []
    for i in range(0, count, 1000):
        squares = (first[i : i + 1000] - mean) ** 2 + second[i : i + 1000]
        logs = -size * (log_sd + squares * np.exp(-2 * log_sd) / 2)
        mixture.append(logsumexp(logs, axis=1))
    log_ratio = -size * (first**2 + second)[:, 0] / 2 - np.concatenate(mixture)
    inside = (np.abs(u) < 6).all(axis=1)
    neighbours = cKDTree(u).query_ball_point(u[inside], 0.5, return_length=True)
    x, y = terms(u[inside] / 4), log_ratio[inside]
    q, r = np.linalg.qr(x)
    coefficients = q.T @ y
    for _ in range(30):  # E[ratio | u] by a gamma regression with a log link
        excess = np.exp(np.clip(y - q @ coefficients, -20, 20)) - 1
        coefficients = coefficients + np.clip(q.T @ excess, -50, 50)
    log_mixture = np.linalg.lstsq(x, np.log(neighbours), rcond=None)[0]
    return units, np.linalg.solve(r, coefficients) + log_mixture


def log_likelihood(name: str, y: Any) -> Callable[[Any, Any], Any]:
    """Return that of a normal population given the minimiser."""
    (t,) = REFITS[name](y[None])
    units, coefficients = pivots(name, len(y))

    def function(mu: Any, log_sd: Any) -> Any:
        first, second = np.broadcast_arrays((t[0] - mu) * np.exp(-log_sd), t[1] - log_sd)
        u = np.stack([first.ravel(), second.ravel()], axis=1) / units
        inside = (np.abs(u) < 5.5).all(axis=1)
        logs = np.where(inside, terms(u / 4) @ coefficients, -1e3)
        return logs.reshape(first.shape) - log_sd

    return function
