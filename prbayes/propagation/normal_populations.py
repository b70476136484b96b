"""Normal populations of specimens that are known by weighted points: fits by EM, and densities."""

from __future__ import annotations

import numpy as np

from prbayes._validate import IN_CACHE, Floats

type Normal = tuple[Floats, Floats]  # mean (d,) and lower Cholesky factor of the covariance (d, d)


def fit_normal(z: Floats, log_a: Floats) -> Normal:
    """Fit a normal population to specimens by EM.

    log p(z) + log_a, both (N, K), is the log of the terms of the likelihoods of N specimens, at
    points z, (N, K, d).
    """
    mean, covariance = _fit(z, log_a)
    return mean[0], np.linalg.cholesky(covariance)[0]


def bootstrap_normals(z: Floats, log_a: Floats, draws: int, seed: int) -> list[Normal]:
    """Fit normal populations to Bayesian bootstrap samples of the specimens."""
    n, count, _ = z.shape
    rng = np.random.default_rng([seed, 7])
    start = _fit(z, log_a)
    shares = np.stack([rng.dirichlet(np.ones(n)) for _ in range(draws)])
    # A bootstrap sample has its fit near that of all specimens. In blocks, for memory's sake.
    block = max(1, IN_CACHE // (n * count))
    fits = [
        _fit(z, log_a, shares[first : first + block], start) for first in range(0, draws, block)
    ]
    mean, covariance = (np.concatenate(parts) for parts in zip(*fits, strict=True))
    return list(zip(mean, np.linalg.cholesky(covariance), strict=True))


def _fit(
    z: Floats, log_a: Floats, shares: Floats | None = None, start: Normal | None = None
) -> tuple[Floats, Floats]:
    """Return means (B, d) and covariances (B, d, d) for shares (B, N) of the specimens."""
    n, _, d = z.shape
    columns = np.ascontiguousarray(z.reshape(-1, d).T)
    prior = 1e-12 * np.diag(np.maximum(columns.var(axis=1), 1e-300))

    def moments(weights: Floats) -> tuple[Floats, Floats]:
        weights = weights.reshape(len(weights), -1)
        mean = weights @ columns.T
        centred = columns - mean[..., None]
        return mean, (centred * weights[:, None]) @ centred.swapaxes(1, 2) + prior

    shares = np.full((1, n), 1 / n) if shares is None else shares
    mean, covariance = moments(normalised_weights(log_a)[None] / n) if start is None else start
    for _ in range(30 if start is None else 5):
        log_w = normal_log_density(z, mean, np.linalg.cholesky(covariance)) + log_a
        previous_mean, previous_covariance = mean, covariance
        mean, covariance = moments(normalised_weights(log_w) * shares[..., None])
        variance = np.einsum("...dd->...d", covariance)
        change = np.einsum("...dd->...d", covariance - previous_covariance) / variance
        shift = (mean - previous_mean) / np.sqrt(variance)
        if max(np.abs(change).max(), np.abs(shift).max()) < 1e-9:
            break
    return mean, covariance


def normalised_weights(log_w: Floats) -> Floats:
    """Return weights with sum 1 along the last axis."""
    weights = np.exp(log_w - log_w.max(axis=-1, keepdims=True))
    return np.asarray(weights / weights.sum(axis=-1, keepdims=True))


def normal_log_density(z: Floats, mean: Floats, root: Floats) -> Floats:
    """Return log-densities of points (..., d) in one normal population, (...), or in B, (B, ...).

    Means have shape (d,) or (B, d), and lower Cholesky factors of covariances one axis more.
    """
    d = z.shape[-1]
    centred = np.ascontiguousarray(z.reshape(-1, d).T) - mean[..., None]
    standard = np.linalg.inv(root) @ centred
    square = np.einsum("...dk,...dk->...k", standard, standard)
    constant = np.log(np.einsum("...dd->...d", root)).sum(axis=-1) + d / 2 * np.log(2 * np.pi)
    return np.asarray(-0.5 * square - constant[..., None]).reshape(*mean.shape[:-1], *z.shape[:-1])
