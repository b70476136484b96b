"""Weights of points, and mixtures of multivariate t distributions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri, gammaln, logsumexp, ndtri

from prbayes._stats import reached
from prbayes._validate import Floats
from prbayes.numerics.points import sobol


def normalised_weights(log_w: Floats) -> Floats:
    """Return weights with sum 1 along the last axis."""
    weights = np.exp(log_w - log_w.max(axis=-1, keepdims=True))
    return weights / weights.sum(axis=-1, keepdims=True)


def effective_sample_size(weights: Floats) -> Floats:
    """Return how many equal weights are as informative as weights with sum 1, (..., n) -> (...)."""
    return 1 / (weights**2).sum(axis=-1)


def student_vectors(u: Floats, degrees: float) -> Floats:
    """Return vectors of a standard t distribution, (n, d), from uniform numbers, (n, d + 1)."""
    radius = np.sqrt(degrees / chdtri(degrees, u[:, -1]))
    return np.asarray(ndtri(u[:, :-1]) * radius[:, None])


@dataclass(frozen=True, eq=False)
class StudentMixture:
    """A mixture of multivariate t distributions."""

    centers: Floats  # (M, d): centers
    roots: Floats  # (M, d, d): lower Cholesky factors of the scale matrices
    shares: Floats  # (M,): mixing weights
    degrees: float

    @classmethod
    def fitted(
        cls,
        points: Floats,
        weights: Floats,
        components: int,
        degrees: float,
        rng: np.random.Generator,
    ) -> StudentMixture:
        """Return a mixture fitted to weighted points, (n, d), by the EM algorithm."""
        d, m = points.shape[1], components
        deviations = points - weights @ points
        covariance = (deviations * weights[:, None]).T @ deviations
        ridge = 1e-9 * np.diag(np.diag(covariance))
        root = np.linalg.cholesky(covariance + ridge)
        # Begin with centers that are far from each other (k-means++).
        standard = np.linalg.solve(root, deviations.T)
        squares = (standard**2).sum(axis=0)
        first: list[int] = []
        for _ in range(m):
            chances = weights * squares
            first.append(int(rng.choice(len(points), p=chances / chances.sum())))
            to_last = ((standard - standard[:, first[-1:]]) ** 2).sum(axis=0)
            squares = to_last if len(first) == 1 else np.minimum(squares, to_last)
        roots = np.tile(root / np.sqrt(m), (m, 1, 1))
        mixture = cls(points[first], roots, np.full(m, 1 / m), degrees)
        for _ in range(15):
            logs = mixture.log_densities(points)
            logs -= logsumexp(logs, axis=1, keepdims=True)
            masses = (np.exp(logs) * weights[:, None]).T
            shares = masses.sum(axis=1, keepdims=True)
            rows = masses / np.maximum(shares, 1e-300)
            # A t distribution is a normal one with random precision: weigh by its expected value
            # given the point.
            precise = rows * (degrees + d) / (degrees + mixture.squares(points))
            centers = precise @ points / precise.sum(axis=1, keepdims=True)
            deviations = points - centers[:, None]
            within = (deviations * precise[..., None]).swapaxes(1, 2) @ deviations
            # Shrink the covariance towards that of all points over m if the effective sample size
            # is small.
            effective = effective_sample_size(rows)
            trust = (effective / (effective + 2 * d))[:, None, None]
            roots = np.linalg.cholesky(trust * within + (1 - trust) * covariance / m + ridge)
            mixture = cls(centers, roots, shares[:, 0], degrees)
        shares = np.maximum(mixture.shares, 0.01 / m)
        return replace(mixture, shares=shares / shares.sum())

    def draws(self, size: int, seed: int) -> Floats:
        """Return Sobol points of the mixture, (size, d), with each component's share of them."""
        d = self.centers.shape[1]
        u = sobol(size, d + 2, seed)
        component = reached(self.shares, u[:, d + 1])
        standard = student_vectors(u[:, : d + 1], self.degrees)
        shifts = np.einsum("sde,se->sd", self.roots[component], standard)
        return np.asarray(self.centers[component] + shifts)

    def log_densities(self, points: Floats) -> Floats:
        """Return log(share times density) of each component, (S, M)."""
        nu, d = self.degrees, points.shape[1]
        log_det = np.log(np.einsum("mdd->md", self.roots)).sum(axis=1)
        constant = gammaln((nu + d) / 2) - gammaln(nu / 2) - d / 2 * np.log(nu * np.pi)
        tail = (nu + d) / 2 * np.log1p(self.squares(points) / nu)
        return np.asarray((np.log(self.shares) + constant - log_det)[:, None] - tail).T

    def log_density(self, points: Floats) -> Floats:
        """Return the log-density, (S,)."""
        return np.asarray(logsumexp(self.log_densities(points), axis=1))

    def squares(self, points: Floats) -> Floats:
        """Return squared standardised distances from the centers, (M, S)."""
        deviations = points - self.centers[:, None]
        standard = np.linalg.solve(self.roots, deviations.swapaxes(1, 2))
        return np.asarray(np.einsum("mds,mds->ms", standard, standard))
