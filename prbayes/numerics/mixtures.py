"""Weights of points, and mixtures of multivariate t distributions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri, gammaln, logsumexp, ndtri

from prbayes._stats import reached
from prbayes._validate import ArrayPair, Floats, complete_rows
from prbayes.numerics.points import sobol


def normalised_weights(log_w: Floats) -> Floats:
    """Return weights with sum 1 along the last axis."""
    weights = np.exp(log_w - log_w.max(axis=-1, keepdims=True))
    return weights / weights.sum(axis=-1, keepdims=True)


def effective_sample_size(weights: Floats) -> Floats:
    """Return how many equal weights are as informative as weights with sum 1, (..., n) -> (...)."""
    return 1 / (weights**2).sum(axis=-1)


def pareto_smoothed(log_w: Floats) -> ArrayPair:
    """Return log weights (P, n) so that rows are smooth and sum to one, and tail shapes k, (P,).

    The largest weights are replaced by quantiles of a generalised Pareto distribution [1]_, which
    is fitted as by Zhang and Stephens [2]_. The shape is NaN, and nothing is replaced, if a quarter
    of the tail is equal.

    References
    ----------
    .. [1] Vehtari, A., D. Simpson, A. Gelman, Y. Yao and J. Gabry (2024), Pareto smoothed
       importance sampling, J. Mach. Learn. Res. 25(72), 1-58.
    .. [2] Zhang, J. and M. A. Stephens (2009), A new and efficient estimation method for the
       generalized Pareto distribution, Technometrics 51(3), 316-325, doi:10.1198/tech.2009.08017.
    """
    size = log_w.shape[1]
    result = log_w - log_w.max(axis=1, keepdims=True)
    n = int(3 * np.sqrt(size)) if size > 225 else size // 5
    order = np.argsort(result, axis=1)
    order = order[:, -n - 1 :]
    weights = np.exp(np.take_along_axis(result, order, axis=1))
    order = order[:, 1:]
    cutoff = weights[:, :1]
    tail = weights[:, 1:] - cutoff
    m = 30 + int(np.sqrt(n))
    quarter = tail[:, int(n / 4 + 0.5) - 1, None]
    largest = tail[:, -1:]
    grid = 1 - np.sqrt(m / (np.arange(m) + 0.5))
    levels = (np.arange(n) + 0.5) / n
    log_p = np.log1p(-levels)
    with np.errstate(all="ignore"):
        # Profile likelihoods of candidates b = -k / sigma, (rows, m).
        b = grid / (3 * quarter) + 1 / largest
        terms = 1 - b[:, :, None] * tail[:, None]
        k = np.log(terms).mean(axis=2)
        profile = n * (np.log(-b / k) - k - 1)
        weights = normalised_weights(profile)
        b = (b * weights).sum(axis=1, keepdims=True)
        k = np.log1p(-b * tail).mean(axis=1, keepdims=True)
        sigma = -k / b
        k = (n * k + 5) / (n + 10)  # a weak prior with the mean .5
        quantiles = np.expm1(-k * log_p) / k
        smoothed = np.log(cutoff + sigma * quantiles)
    k[quarter <= tail[:, :1]] = np.nan
    is_smoothed = complete_rows(smoothed)
    is_smoothed &= np.isfinite(k[:, 0])
    rows = np.flatnonzero(is_smoothed)
    result[rows[:, None], order[rows]] = np.minimum(smoothed[rows], 0.0)
    result -= logsumexp(result, axis=1, keepdims=True)
    return result, k[:, 0]


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
        first = []
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
        """Return log(share times density) of each component, (S, M).

        Points are (S, d), or (M, S, d) where each component has its own.
        """
        nu, d = self.degrees, points.shape[-1]
        log_det = np.log(np.einsum("mdd->md", self.roots)).sum(axis=1)
        constant = gammaln((nu + d) / 2) - gammaln(nu / 2)
        constant -= d / 2 * np.log(nu * np.pi)
        at_center = np.log(self.shares) + constant - log_det
        tail = (nu + d) / 2 * np.log1p(self.squares(points) / nu)
        return np.asarray(at_center[:, None] - tail).T

    def log_density(self, points: Floats) -> Floats:
        """Return the log-density, (S,)."""
        return np.asarray(logsumexp(self.log_densities(points), axis=1))

    def squares(self, points: Floats) -> Floats:
        """Return squared standardised distances from the centers, (M, S)."""
        deviations = points - self.centers[:, None]
        standard = np.linalg.solve(self.roots, deviations.swapaxes(1, 2))
        return np.asarray(np.einsum("mds,mds->ms", standard, standard))
