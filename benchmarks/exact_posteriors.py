"""Exact posteriors of hyperparameters by grids and importance sampling, with NumPy and SciPy alone.

Coordinates are unconstrained: logarithms of positive hyperparameters, logits of bounded ones.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import Any

import numpy as np
from scipy import ndimage, optimize, stats
from scipy.special import expit, logsumexp

from benchmarks.scoreboard.problem import Draws, Prior

LogDensity = Callable[[Any], Any]  # coordinates (S, q) -> (S,)
_AT_ONCE = 4_000_000  # numbers of an array


def values_of(priors: dict[str, Prior], u: Any) -> Draws:
    """Return hyperparameters by name, each (S,), of coordinates (S, q)."""
    values = {}
    for (name, prior), column in zip(priors.items(), np.transpose(u), strict=True):
        low, high = prior.distribution().support()
        if np.isfinite(high):
            values[name] = low + (high - low) * expit(column)
        else:
            values[name] = low + np.exp(column) if np.isfinite(low) else column
    return values


def coordinates_of(priors: dict[str, Prior], values: Draws) -> Any:
    """Return coordinates (S, q) of hyperparameters; (q,) of single numbers."""
    columns = []
    for name, prior in priors.items():
        low, high = prior.distribution().support()
        value = np.asarray(values[name], dtype=float)
        if np.isfinite(high):
            columns.append(np.log(value - low) - np.log(high - value))
        else:
            columns.append(np.log(value - low) if np.isfinite(low) else value)
    return np.stack(columns, axis=-1)


def log_posterior(
    priors: dict[str, Prior], log_likelihood: Callable[[Draws], Any]
) -> LogDensity:  # fmt: skip
    """Return the log-density of coordinates, up to a constant."""

    def function(u: Any) -> Any:
        values = values_of(priors, u)
        with np.errstate(all="ignore"):
            logs = np.asarray(log_likelihood(values), dtype=float)
            for (name, prior), column in zip(priors.items(), np.transpose(u), strict=True):
                low, high = prior.distribution().support()
                logs = logs + prior.distribution().logpdf(values[name])
                if np.isfinite(high):
                    logs = logs - np.logaddexp(0, column) - np.logaddexp(0, -column)
                elif np.isfinite(low):
                    logs = logs + column
        return np.where(np.isfinite(logs), logs, -1e300)

    return function


def on_grid(
    log_density: LogDensity, low: Any, high: Any, refinements: int = 1, points: int = 61
) -> tuple[Any, Any, Any]:
    """Return cells' centres (S, q), weights (S,), and the weights as an array of the whole grid.

    Cells within 25 nats of the highest, and their neighbours, are split in three in each direction.
    """
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    kept = np.ones((points,) * len(low), dtype=bool)
    while True:
        index = np.argwhere(kept)
        u = low + (high - low) * (index + 0.5) / points
        logs = np.concatenate([log_density(part) for part in np.array_split(u, len(u) // 512 + 1)])
        if refinements == 0:
            break
        refinements -= 1
        kept[tuple(index[logs < logs.max() - 25].T)] = False
        kept = ndimage.binary_dilation(kept, np.ones((3,) * len(low)))
        for axis in range(len(low)):
            kept = np.repeat(kept, 3, axis=axis)
        points *= 3
    weights = np.exp(logs - logsumexp(logs))
    whole = np.zeros(kept.shape)
    whole[tuple(index.T)] = weights
    return u, weights, whole


def modes(u: Any, weights: Any, whole: Any, least: float = 1e-4) -> list[dict[str, Any]]:
    """Return mass, mean and standard deviation of each mode of a grid, in the coordinates.

    A cell belongs to the local maximum that steepest ascent over neighbours leads to. Modes whose means
    are within two standard deviations of their difference are one.
    """
    shape, size = whole.shape, whole.size
    order = np.arange(size).reshape(shape)
    best, target = whole.copy(), order.copy()
    padded, numbers = np.pad(whole, 1, constant_values=-1), np.pad(order, 1)
    for shift in np.ndindex(*(3,) * whole.ndim):
        part = tuple(slice(s, s + n) for s, n in zip(shift, shape, strict=True))
        higher = padded[part] > best
        best[higher], target[higher] = padded[part][higher], numbers[part][higher]
    target = target.ravel()
    while not np.array_equal(target, target[target]):
        target = target[target]
    label = target[np.flatnonzero(whole.ravel() > 0)]
    inside = weights > 0
    u, weights = u[inside], weights[inside]

    def described(peak: Any) -> tuple[float, Any, Any]:
        w, x = weights[label == peak], u[label == peak]
        mean = w @ x / w.sum()
        return float(w.sum()), mean, np.sqrt(w @ (x - mean) ** 2 / w.sum())

    parts = {peak: described(peak) for peak in np.unique(label)}
    parts = {peak: part for peak, part in parts.items() if part[0] > least}
    while close := [
        (a, b)
        for a, b in combinations(parts, 2)
        if (np.abs(parts[a][1] - parts[b][1]) < 2 * np.hypot(parts[a][2], parts[b][2])).all()
    ]:
        a, b = close[0]
        label[label == b] = a
        parts[a] = described(a)
        del parts[b]
    return [{"mass": w, "mean": m.tolist(), "sd": s.tolist()} for w, m, s in parts.values()]


def classified(found: list[dict[str, Any]], u: Any) -> Any:
    """Return the number of the mode of each point (S,), by normal classification."""
    logs = [
        np.log(mode["mass"])
        - (np.log(mode["sd"]) + 0.5 * ((u - mode["mean"]) / np.array(mode["sd"])) ** 2).sum(axis=1)
        for mode in found
    ]
    return np.argmax(logs, axis=0)


def importance(
    log_density: LogDensity, start: Any, count: int = 8192, rounds: int = 4
) -> tuple[Any, Any]:
    """Return points (S, q) and weights (S,): a t distribution at the mode, refitted to its points."""
    q = len(start)

    def slope(u: Any, step: float = 1e-4) -> Any:
        shifts = step * np.eye(q)
        logs = log_density(np.concatenate([u + shifts, u - shifts]))
        return (logs[:q] - logs[q:]) / (2 * step)

    mode = optimize.minimize(
        lambda u: -float(log_density(u[None])[0]), start, jac=lambda u: -slope(u), method="BFGS"
    ).x
    hessian = -np.array([slope(mode + h) - slope(mode - h) for h in 0.01 * np.eye(q)]) / 0.02
    size, vectors = np.linalg.eigh((hessian + hessian.T) / 2)
    parts = [(1.0, mode, (vectors / np.maximum(size, 0.05)) @ vectors.T)]
    for seed in range(rounds):
        n = count if seed == rounds - 1 else max(count // 4, 1024)
        u, log_q = _drawn(parts, n, seed)
        blocks = np.array_split(u, max(1, n // 64))
        logs = np.concatenate([log_density(block) for block in blocks]) - log_q
        weights = np.exp(logs - logsumexp(logs))
        parts = _mixture(u, weights)
    return u, weights


Part = tuple[float, Any, Any]  # share, centre (q,), covariance (q, q)


def _log_t(u: Any, center: Any, covariance: Any, degrees: float = 5.0) -> Any:
    """Return the log-density of a t distribution, up to a constant."""
    root = np.linalg.cholesky(covariance)
    square = (np.linalg.solve(root, (u - center).T) ** 2).sum(axis=0)
    constant = np.log(np.diag(root)).sum()
    return -(degrees + len(center)) / 2 * np.log1p(square / degrees) - constant


def _drawn(parts: list[Part], count: int, seed: int, degrees: float = 5.0) -> tuple[Any, Any]:
    """Return points (S, q) of a mixture of t distributions, and their log-density."""
    q = len(parts[0][1])
    sobol = np.clip(stats.qmc.Sobol(q + 2, seed=seed).random(count), 1e-10, 1 - 1e-10)
    which = np.searchsorted(np.cumsum([share for share, *_ in parts])[:-1], sobol[:, 0])
    radius = np.sqrt(degrees / stats.chi2.ppf(sobol[:, 1], degrees))
    standard = stats.norm.ppf(sobol[:, 2:]) * radius[:, None]
    roots = np.array([np.linalg.cholesky(covariance) for *_, covariance in parts])
    u = np.array([center for _, center, _ in parts])[which]
    u = u + np.einsum("sde,se->sd", roots[which], standard)
    return u, logsumexp([np.log(p) + _log_t(u, m, c) for p, m, c in parts], axis=0)


def _mixture(u: Any, weights: Any, count: int = 8, least: float = 300.0) -> list[Part]:
    """Return a mixture fitted to weighted points by the EM algorithm, with their overall moments.

    Weights are tempered until their effective number is large enough.
    """
    while 1 / (weights**2).sum() < least:
        weights = weights**0.8 / (weights**0.8).sum()
    q, rng = u.shape[1], np.random.default_rng(0)
    center = weights @ u
    overall = (weights[:, None] * (u - center)).T @ (u - center) + 1e-9 * np.eye(q)
    means = u[rng.choice(len(u), count, p=weights)]
    shares, covariances = np.full(count, 1 / count), np.repeat(overall[None] / 2, count, axis=0)
    for _ in range(30):
        logs = [
            np.log(p) + _log_t(u, m, c) for p, m, c in zip(shares, means, covariances, strict=True)
        ]
        share = np.exp(logs - logsumexp(logs, axis=0)) * weights
        shares = share.sum(axis=1) + 1e-6
        means = (share @ u + 1e-6 * center) / shares[:, None]
        for k, (row, mean) in enumerate(zip(share, means, strict=True)):
            own = (row[:, None] * (u - mean)).T @ (u - mean)
            covariances[k] = (own + 0.02 * overall) / (shares[k] + 0.02)
        shares /= shares.sum()
    parts = [(0.9 * p, m, 1.1 * c) for p, m, c in zip(shares, means, covariances, strict=True)]
    return [*parts, (0.1, center, 1.5 * overall)]


def moments(values: Draws, weights: Any) -> dict[str, Any]:
    """Return means and standard deviations by name, and Kish's effective number."""
    mean = {name: float(weights @ value) for name, value in values.items()}
    sd = {n: float(np.sqrt(weights @ (value - mean[n]) ** 2)) for n, value in values.items()}
    return {"mean": mean, "sd": sd, "effective": float(1 / (weights**2).sum())}


def log_sum(logs: Any) -> Any:
    """Return the logarithm of the sum of exponentials over the last axis; the array is overwritten."""
    largest = np.maximum(logs.max(axis=-1), -1e300)
    logs -= largest[..., None]
    return largest + np.log(np.exp(logs, out=logs).sum(axis=-1))


def normal_at_shared_nodes(nodes: Any, likelihood: Any) -> Callable[[Any, Any], Any]:
    """Return log L of normal populations, (S,), from p(y_i | x_k) (N, K) at equidistant nodes (K,).

    The trapezoidal rule needs a standard deviation of a step at least.
    """
    step = nodes[1] - nodes[0]

    def function(mean: Any, sd: Any) -> Any:
        total = np.empty(len(mean))
        for rows in np.array_split(np.arange(len(mean)), len(mean) * len(nodes) // _AT_ONCE + 1):
            z = (nodes - mean[rows, None]) / sd[rows, None]
            density = np.exp(-0.5 * z**2) * (step / sd[rows, None] / np.sqrt(2 * np.pi))
            total[rows] = np.log(density @ likelihood.T + 1e-300).sum(axis=1)
        return np.where(sd > step, total, -np.inf)

    return function


def normal_at_nodes(x: Any, log_a: Any) -> Callable[[Any, Any], Any]:
    """Return log L of independent normal inputs, (S,), from nodes (N, K, d) and log weights (N, K).

    The function takes means and standard deviations (S, d).
    """
    n, k, d = x.shape
    middle = x.reshape(-1, d).mean(axis=0)
    away = (x - middle).reshape(-1, d).T
    features = np.concatenate([away**2, away])

    def function(mean: Any, sd: Any) -> Any:
        total = np.empty(len(mean))
        for rows in np.array_split(np.arange(len(mean)), len(mean) * n * k // _AT_ONCE + 1):
            m, precision = mean[rows] - middle, 1 / sd[rows] ** 2
            logs = np.concatenate([-0.5 * precision, m * precision], axis=1) @ features
            logs = logs.reshape(len(rows), n, k)
            logs += log_a
            constant = -0.5 * (m**2 * precision + np.log(2 * np.pi)) - np.log(sd[rows])
            total[rows] = log_sum(logs).sum(axis=1) + n * constant.sum(axis=1)
        return total

    return function
