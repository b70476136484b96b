"""Importance sampling of a density from Laplace approximations of its modes.

The first proposal is a mixture of multivariate t distributions with five degrees of freedom, one
for each mode. If it does not suffice, further rounds fit mixtures to all weighted points. Draws of
the prior cover regions without points. The weights are those of the mixture of all proposals
(adaptive multiple importance sampling: Cornuet et al. 2012, Scand. J. Stat. 39(4)).
Pareto-smoothed importance sampling judges them (Vehtari et al. 2024, J. Mach. Learn. Res. 25(72)).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np
from scipy.special import chdtri, gammaln, logsumexp, ndtri

from prbayes._validate import Floats
from prbayes.numerics.points import sobol

LogDensity = Callable[[Floats], Floats]  # (S, d) -> (S,)
# The prior as a proposal: draws by size and seed, (size, d), and its log-density.
Prior = tuple[Callable[[int, int], Floats], LogDensity]


@dataclass(frozen=True)
class ImportanceOptions:
    """Sizes and limits of importance sampling."""

    oversampling: int = 2  # points of the first proposal for each draw
    degrees: float = 5.0  # of freedom of the proposal's t distributions
    pareto_k: float = 0.7  # largest shape of the weights' tail of reliable draws (Vehtari et al.)
    effective: float = 0.5  # smallest effective sample size of reliable draws, for each draw
    rounds: int = 6  # largest number of proposals; the r-th fitted one has r / 2 points a draw
    components: int = 4  # of a fitted mixture
    prior_share: float = 0.1  # of the points of a fitted proposal; half in the first


@dataclass(frozen=True, eq=False)
class Laplace:
    """A mode of a log-density with the inverse of its negative Hessian."""

    mode: Floats  # (d,)
    covariance: Floats  # (d, d)
    log_mass: float  # logarithm of the mass by Laplace's approximation
    converged: bool


@dataclass(frozen=True, eq=False)
class ImportanceSample:
    """Equally weighted draws by resampling, with diagnostics of the weights."""

    draws: Floats  # (n, d)
    log_density: Floats  # (n,)
    pareto_k: float  # shape of the tail of the weights
    efficiency: float  # effective sample size for each point
    effective_size: float  # of the points of all proposals
    log_evidence: float  # logarithm of the integral of the density
    is_reliable: bool  # whether the weights are even enough


def laplace(
    log_density: LogDensity, starts: Floats, scale: Floats, steps: int = 20
) -> list[Laplace]:
    """Return the modes near starts, (M, d), by damped Newton steps with finite differences."""
    modes = np.array(starts)
    count, d = modes.shape
    sd = np.tile(0.1 * scale, (count, 1))
    lengths = np.array([2.0, 1.0, 0.5, 0.25, 0.1, 0.03, 0.01, 0.003])
    for _ in range(steps):
        value, gradient, hessian = _derivatives(log_density, modes, 0.05 * sd)
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
        converged = same_step & (decrement < 1e-3) & is_maximum
        if converged.all():
            break
        sd = np.minimum(new_sd, 10 * sd)
        trials = modes[:, None] + lengths[:, None] * direction[:, None]
        heights = np.nan_to_num(log_density(trials.reshape(-1, d)), nan=-np.inf)
        heights = heights.reshape(count, -1)
        best = heights.argmax(axis=1)
        rises = ~converged & (heights[np.arange(count), best] > value)
        modes[rises] = trials[rises, best[rises]]
    _, log_det = np.linalg.slogdet(covariance)
    log_mass = value + log_det / 2 + d / 2 * np.log(2 * np.pi)
    results = zip(modes, covariance, log_mass.tolist(), converged.tolist(), strict=True)
    return [Laplace(*result) for result in results]


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
    prior: Prior | None = None,
) -> ImportanceSample:
    """Return ``size`` draws by importance sampling around modes and from the prior."""
    masses = np.array([mode.log_mass for mode in modes])
    # A mode whose mass the approximation gets wrong still has points.
    shares = np.maximum(np.exp(masses - logsumexp(masses)), 0.1 / len(masses))
    proposal = _Mixture(
        np.stack([mode.mode for mode in modes]),
        np.stack([np.linalg.cholesky(mode.covariance) for mode in modes]),
        shares / shares.sum(),
        options.degrees,
    )
    points = proposal.draws(options.oversampling * size, seed)
    # A few points show whether the rest are worth their time.
    pilot = min(max(len(points) // 8, 512), len(points))
    log_p = log_density(points[:pilot])
    log_ratio = log_p - logsumexp(proposal.log_densities(points[:pilot]), axis=1)
    weights = np.exp(log_ratio - logsumexp(log_ratio))
    is_poor = (weights**2).sum() * pilot > options.oversampling / options.effective
    if is_poor and options.rounds > 1:
        points = points[:pilot]
    elif pilot < len(points):
        log_p = np.concatenate([log_p, log_density(points[pilot:])])
    proposals, n_prior = [(proposal, len(points))], 0
    if prior is not None:
        # A ridge between modes has no points of theirs.
        n_prior = int(options.prior_share * len(points))
        new = prior[0](n_prior, seed)
        points, log_p = np.concatenate([points, new]), np.concatenate([log_p, log_density(new)])
    rng = np.random.default_rng([seed, 1])
    for round_ in range(1, options.rounds + 1):
        terms = [
            logsumexp(mixture.log_densities(points), axis=1) + np.log(n / len(points))
            for mixture, n in proposals
        ]
        if prior is not None and n_prior:
            terms.append(prior[1](points) + np.log(n_prior / len(points)))
        log_ratio = log_p - logsumexp(terms, axis=0)
        sample = _resampled(points, log_p, log_ratio, size, seed, options)
        # Too few effective points have no moments.
        is_lost = round_ > 2 and sample.effective_size < 10 * points.shape[1]
        # Fitted proposals look better than they are until the points are in all regions.
        is_enough = round_ == 1 or sample.effective_size >= size
        if (sample.is_reliable and is_enough) or round_ == options.rounds or is_lost:
            break
        proposal = _fitted_mixture(points, log_ratio, options, rng)
        count = round_ * size // 2
        share = 0.0 if prior is None else 0.5 if round_ == 1 else options.prior_share
        n_added = int(share * count)
        new = proposal.draws(count - n_added, seed + round_)
        if prior is not None:
            new = np.concatenate([new, prior[0](n_added, seed + round_)])
        points = np.concatenate([points, new])
        log_p = np.concatenate([log_p, log_density(new)])
        proposals.append((proposal, count - n_added))
        n_prior += n_added
    return sample


def _fitted_mixture(
    points: Floats, log_ratio: Floats, options: ImportanceOptions, rng: np.random.Generator
) -> _Mixture:
    """Return a mixture of t distributions fitted to weighted points by the EM algorithm."""
    for power in np.linspace(1, 0, 20, endpoint=False):
        weights = np.exp(power * (log_ratio - log_ratio.max()))
        weights /= weights.sum()
        if 1 / (weights**2).sum() >= 100:
            break
    points, weights = points[weights > 0], weights[weights > 0]
    d, m, nu = points.shape[1], options.components, options.degrees
    deviations = points - weights @ points
    covariance = (deviations * weights[:, None]).T @ deviations
    ridge = 1e-9 * np.diag(np.diag(covariance))
    root = np.linalg.cholesky(covariance + ridge)
    # The first centers are far from each other (k-means++).
    standard = np.linalg.solve(root, deviations.T)
    squares = (standard**2).sum(axis=0)
    first: list[int] = []
    for _ in range(m):
        chances = weights * squares
        first.append(int(rng.choice(len(points), p=chances / chances.sum())))
        to_last = ((standard - standard[:, first[-1:]]) ** 2).sum(axis=0)
        squares = to_last if len(first) == 1 else np.minimum(squares, to_last)
    roots = np.tile(root / np.sqrt(m), (m, 1, 1))
    mixture = _Mixture(points[first], roots, np.full(m, 1 / m), nu)
    for _ in range(15):
        logs = mixture.log_densities(points)
        logs -= logsumexp(logs, axis=1, keepdims=True)
        masses = (np.exp(logs) * weights[:, None]).T
        shares = masses.sum(axis=1, keepdims=True)
        rows = masses / np.maximum(shares, 1e-300)
        # The expected precision of a t distribution's normal variable, given the point.
        precise = rows * (nu + d) / (nu + mixture.squares(points))
        centers = precise @ points / precise.sum(axis=1, keepdims=True)
        deviations = points - centers[:, None]
        within = (deviations * precise[..., None]).swapaxes(1, 2) @ deviations
        # With few effective points: the covariance of all, scaled to an m-th of the volume.
        effective = 1 / (rows**2).sum(axis=1)
        trust = (effective / (effective + 2 * d))[:, None, None]
        roots = np.linalg.cholesky(trust * within + (1 - trust) * covariance / m + ridge)
        mixture = _Mixture(centers, roots, shares[:, 0], nu)
    shares = np.maximum(mixture.shares, 0.01 / m)
    return replace(mixture, shares=shares / shares.sum())


def _resampled(
    points: Floats,
    log_p: Floats,
    log_ratio: Floats,
    size: int,
    seed: int,
    options: ImportanceOptions,
) -> ImportanceSample:
    """Return draws by Pareto-smoothed weights and systematic resampling."""
    stats: Any = import_module("arviz_stats")
    # ArviZ takes log-likelihoods, whose negatives are log weights of leave-one-out.
    smoothed, pareto_k = stats.base.array_stats.psislw(-log_ratio)
    weights = np.exp(smoothed - logsumexp(smoothed))
    rng = np.random.default_rng(seed)
    # In random order: every fourth point of a Sobol sequence is in the same quarter.
    order = rng.permutation(len(weights))
    positions = (np.arange(size) + rng.random()) / size
    places = np.searchsorted(np.cumsum(weights[order]), positions)
    # In random order again: copies of a point are next to each other.
    rows = rng.permutation(order[places.clip(max=len(weights) - 1)])
    efficiency = float(1 / (weights**2).sum() / len(weights))
    effective = efficiency * len(points)
    return ImportanceSample(
        points[rows],
        log_p[rows],
        pareto_k=float(pareto_k),
        efficiency=efficiency,
        effective_size=effective,
        log_evidence=float(logsumexp(log_ratio) - np.log(len(log_ratio))),
        is_reliable=pareto_k <= options.pareto_k and effective >= options.effective * size,
    )


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
        component = np.searchsorted(np.cumsum(self.shares), u[:, d + 1])
        component = component.clip(max=len(self.shares) - 1)
        radius = np.sqrt(self.degrees / chdtri(self.degrees, u[:, d]))
        standard = ndtri(u[:, :d]) * radius[:, None]
        shifts = np.einsum("sde,se->sd", self.roots[component], standard)
        return np.asarray(self.centers[component] + shifts)

    def log_densities(self, points: Floats) -> Floats:
        """Return log(share times density) of each component, (S, M)."""
        nu, d = self.degrees, points.shape[1]
        log_det = np.log(np.einsum("mdd->md", self.roots)).sum(axis=1)
        constant = gammaln((nu + d) / 2) - gammaln(nu / 2) - d / 2 * np.log(nu * np.pi)
        tail = (nu + d) / 2 * np.log1p(self.squares(points) / nu)
        return np.asarray((np.log(self.shares) + constant - log_det)[:, None] - tail).T

    def squares(self, points: Floats) -> Floats:
        """Return squared standardised distances from the centers, (M, S)."""
        deviations = points - self.centers[:, None]
        standard = np.linalg.solve(self.roots, deviations.swapaxes(1, 2))
        return np.asarray(np.einsum("mds,mds->ms", standard, standard))
