"""Importance sampling of a density from Laplace approximations of its modes.

The proposal is a mixture of multivariate t distributions with five degrees of freedom, one for each
mode. A second round takes the moments of the first. Pareto-smoothed importance sampling judges the
weights (Vehtari et al. 2024, J. Mach. Learn. Res. 25(72)).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from scipy.special import chdtri, gammaln, logsumexp, ndtri

from prbayes._checks import Floats
from prbayes.propagation.points import sobol

LogDensity = Callable[[Floats], Floats]  # (S, d) -> (S,)


@dataclass(frozen=True)
class ImportanceOptions:
    """Sizes and limits of importance sampling.

    Attributes
    ----------
    oversampling : int
        Points of the proposal for each draw.
    degrees : float
        Degrees of freedom of the proposal's t distributions.
    pareto_k : float
        Largest shape of the weights' tail with which the draws are trusted (Vehtari et al. 2024).
    efficiency : float
        Smallest effective sample size, as a share of the points.
    rounds : int
    """

    oversampling: int = 2
    degrees: float = 5.0
    pareto_k: float = 0.7
    efficiency: float = 0.25
    rounds: int = 2


@dataclass(frozen=True, eq=False)
class Laplace:
    """A mode of a log-density with the inverse of its negative Hessian.

    Attributes
    ----------
    mode : ndarray, shape (d,)
    covariance : ndarray, shape (d, d)
    log_mass : float
        Logarithm of the mass by Laplace's approximation.
    converged : bool
    """

    mode: Floats
    covariance: Floats
    log_mass: float
    converged: bool


@dataclass(frozen=True, eq=False)
class ImportanceSample:
    """Equally weighted draws by resampling, with diagnostics of the weights.

    Attributes
    ----------
    draws : ndarray, shape (n, d)
    log_density : ndarray, shape (n,)
    pareto_k : float
        Shape of the tail of the weights.
    efficiency : float
        Effective sample size as a share of the proposal's points.
    log_evidence : float
        Logarithm of the integral of the density.
    """

    draws: Floats
    log_density: Floats
    pareto_k: float
    efficiency: float
    log_evidence: float

    def is_reliable(self, options: ImportanceOptions) -> bool:
        """Return whether the weights are even enough."""
        return self.pareto_k <= options.pareto_k and self.efficiency >= options.efficiency


def laplace(
    log_density: LogDensity, starts: Floats, scale: Floats, steps: int = 20
) -> list[Laplace]:
    """Return the modes near starts by damped Newton steps, with differences of the log-density.

    Parameters
    ----------
    log_density : callable
    starts : ndarray, shape (M, d)
    scale : ndarray, shape (d,)
        Standard deviations of the prior. Less curvature than a hundredth of theirs counts as that.
    steps : int

    Raises
    ------
    ValueError
        If the log-density is not finite around a mode, as at the end of a support.
    """
    modes = np.array(starts)
    count, d = modes.shape
    sd = np.tile(0.1 * scale, (count, 1))
    lengths = np.array([2.0, 1.0, 0.5, 0.25, 0.1, 0.03, 0.01, 0.003])
    for _ in range(steps):
        value, gradient, hessian = _derivatives(log_density, modes, 0.05 * sd)
        # In units of the prior.
        values, vectors = np.linalg.eigh(-hessian * np.outer(scale, scale))
        # Absolute values: a step away from a saddle, and Newton's at a mode.
        size = np.maximum(np.abs(values), 0.01)
        inverse = (vectors / size[:, None, :]) @ vectors.swapaxes(1, 2)
        covariance = inverse * np.outer(scale, scale)
        direction = np.einsum("mde,me->md", covariance, gradient)
        decrement = np.einsum("md,md->m", gradient, direction)
        new_sd = np.sqrt(np.einsum("mdd->md", covariance))
        ratio = new_sd / sd
        same_step = ((ratio < 2) & (ratio > 0.5)).all(axis=1)
        is_maximum = values.min(axis=1) > -0.01
        settled = same_step & (decrement < 1e-3) & is_maximum
        if settled.all():
            break
        sd = np.minimum(new_sd, 10 * sd)
        trials = modes[:, None] + lengths[:, None] * direction[:, None]
        heights = np.nan_to_num(log_density(trials.reshape(-1, d)), nan=-np.inf)
        heights = heights.reshape(count, -1)
        best = heights.argmax(axis=1)
        rises = ~settled & (heights[np.arange(count), best] > value)
        modes[rises] = trials[rises, best[rises]]
    _, log_det = np.linalg.slogdet(covariance)
    log_mass = value + log_det / 2 + d / 2 * np.log(2 * np.pi)
    parts = zip(modes, covariance, log_mass.tolist(), settled.tolist(), strict=True)
    return [Laplace(*part) for part in parts]


def _derivatives(
    log_density: LogDensity, thetas: Floats, steps: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return values, gradients and Hessians at M points by central differences, in one call."""
    count, d = thetas.shape
    axes = steps[:, None] * np.eye(d)
    first, second = np.triu_indices(d, 1)
    diagonals = axes[:, first] + axes[:, second]
    center = np.zeros((count, 1, d))
    shifts = np.concatenate([center, axes, -axes, diagonals, -diagonals], axis=1)
    points = thetas[:, None] + shifts
    values = log_density(points.reshape(-1, d)).reshape(count, -1)
    if not np.isfinite(values).all():
        raise ValueError("got a log-density that is not finite around a mode")
    ends = np.cumsum([1, d, d, len(first)]).tolist()
    middle, up, down, ahead, behind = np.split(values, ends, axis=1)
    gradient = (up - down) / (2 * steps)
    bends = up + down - 2 * middle
    hessian = (bends / steps**2)[..., None] * np.eye(d)
    cross = (ahead + behind - 2 * middle - bends[:, first] - bends[:, second]) / 2
    cross /= steps[:, first] * steps[:, second]
    hessian[:, first, second] = cross
    hessian[:, second, first] = cross
    return middle[:, 0], gradient, hessian


def importance_sample(
    log_density: LogDensity,
    modes: Sequence[Laplace],
    size: int,
    seed: int,
    options: ImportanceOptions = ImportanceOptions(),
) -> ImportanceSample:
    """Return draws of a density by importance sampling around its modes.

    Parameters
    ----------
    log_density : callable
    modes : sequence of Laplace
    size : int
        Number of draws.
    seed : int
    options : ImportanceOptions
    """
    centers = np.stack([mode.mode for mode in modes])
    roots = np.stack([np.linalg.cholesky(mode.covariance) for mode in modes])
    masses = np.array([mode.log_mass for mode in modes])
    shares = np.exp(masses - logsumexp(masses))
    for round_ in range(options.rounds):
        # A mode whose mass the approximation gets wrong still has points.
        shares = np.maximum(shares, 0.1 / len(shares))
        proposal = _Mixture(centers, roots, shares / shares.sum(), options.degrees)
        points = proposal.draws(options.oversampling * size, seed + round_)
        by_component = proposal.log_densities(points)
        log_q = logsumexp(by_component, axis=1)
        log_p = log_density(points)
        weights, sample = _weighted(points, log_p, log_p - log_q, size, seed + round_)
        if sample.is_reliable(options):
            break
        responsibilities = np.exp(by_component - log_q[:, None])
        responsibilities = responsibilities * weights[:, None]
        shares = responsibilities.sum(axis=0)
        for m, share in enumerate(shares):
            if share * len(points) * sample.efficiency < 10 * points.shape[1]:
                continue  # too few effective points for moments
            rows = responsibilities[:, m] / share
            centers[m] = rows @ points
            away = points - centers[m]
            covariance = (away * rows[:, None]).T @ away
            roots[m] = np.linalg.cholesky(covariance)
    return sample


def _weighted(
    points: Floats, log_p: Floats, log_ratio: Floats, size: int, seed: int
) -> tuple[Floats, ImportanceSample]:
    """Return smoothed weights with sum 1, and draws by systematic resampling."""
    stats: Any = import_module("arviz_stats")
    log_evidence = float(logsumexp(log_ratio) - np.log(len(log_ratio)))
    # ArviZ takes log-likelihoods, whose negatives are log weights of leave-one-out.
    smoothed, pareto_k = stats.base.array_stats.psislw(-log_ratio)
    weights = np.exp(smoothed - logsumexp(smoothed))
    efficiency = float(1 / (weights**2).sum() / len(weights))
    rng = np.random.default_rng(seed)
    # In random order: every fourth point of a Sobol sequence is in the same quarter.
    order = rng.permutation(len(weights))
    positions = (np.arange(size) + rng.random()) / size
    chosen = np.searchsorted(np.cumsum(weights[order]), positions)
    # Copies of a point are next to each other.
    rows = rng.permutation(order[chosen.clip(max=len(weights) - 1)])
    sample = ImportanceSample(
        points[rows],
        log_p[rows],
        float(pareto_k),
        efficiency,
        log_evidence,
    )
    return weights, sample


@dataclass(frozen=True, eq=False)
class _Mixture:
    """A mixture of multivariate t distributions."""

    centers: Floats  # (M, d)
    roots: Floats  # (M, d, d): lower Cholesky factors of the scale matrices
    shares: Floats  # (M,)
    degrees: float

    def draws(self, size: int, seed: int) -> Floats:
        """Return Sobol points of the mixture, (size, d), with each component's share of them."""
        d = self.centers.shape[1]
        u = sobol(size, d + 2, seed)
        component = np.searchsorted(np.cumsum(self.shares), u[:, d + 1]).clip(
            max=len(self.shares) - 1
        )
        radius = np.sqrt(self.degrees / chdtri(self.degrees, u[:, d]))
        standard = ndtri(u[:, :d]) * radius[:, None]
        away = np.einsum("sde,se->sd", self.roots[component], standard)
        return np.asarray(self.centers[component] + away)

    def log_densities(self, points: Floats) -> Floats:
        """Return log(share times density) of each component, (S, M)."""
        nu, d = self.degrees, points.shape[1]
        away = points - self.centers[:, None]
        standard = np.linalg.solve(self.roots, away.swapaxes(1, 2))
        square = np.einsum("mds,mds->ms", standard, standard)
        log_det = np.log(np.einsum("mdd->md", self.roots)).sum(axis=1)
        constant = gammaln((nu + d) / 2) - gammaln(nu / 2) - d / 2 * np.log(nu * np.pi)
        tail = (nu + d) / 2 * np.log1p(square / nu)
        return np.asarray((np.log(self.shares) + constant - log_det)[:, None] - tail).T
