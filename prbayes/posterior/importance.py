"""Importance sampling of a density from Laplace approximations of its modes.

The first proposal is a mixture of multivariate t distributions with five degrees of freedom, one
for each mode, and for the ridge between the first mode and each of the others. If it does not
suffice, further rounds fit mixtures to all weighted points. Draws of the prior cover regions
without points. The weights are those of the mixture of all proposals (adaptive multiple importance
sampling: Cornuet et al. 2012, Scand. J. Stat. 39(4)). Pareto-smoothed importance sampling judges
them (Vehtari et al. 2024, J. Mach. Learn. Res. 25(72)).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from prbayes._stats import reached
from prbayes._validate import ArrayPair, Floats
from prbayes.numerics.mixtures import (
    StudentMixture,
    effective_sample_size,
    pareto_smoothed,
    student_vectors,
)
from prbayes.numerics.modes import Laplace, LogDensity, ridges
from prbayes.numerics.points import sobol

# prior as a proposal: function of size and seed that returns draws, (size, d), and log-density
Prior = tuple[Callable[[int, int], Floats], LogDensity]


@dataclass(frozen=True)
class ImportanceOptions:
    """Sizes and limits of importance sampling."""

    oversampling: int = 2  # number of points of the first proposal for each draw
    degrees: float = 5.0  # degrees of freedom of the proposal's t distributions
    pareto_k: float = 0.7  # largest shape of the weights' tail of reliable draws (Vehtari et al.)
    effective: float = 0.5  # smallest effective sample size of reliable draws, for each draw
    rounds: int = 6  # largest number of proposals; the r-th fitted one has r / 2 points a draw
    components: int = 4  # number of components of a fitted mixture
    # share of the points that come from the prior; half in the first fitted proposal
    prior_share: float = 0.1


@dataclass(frozen=True, eq=False)
class ImportanceSample:
    """Equally weighted draws by resampling, with diagnostics of the weights."""

    draws: Floats  # (n, d)
    log_density: Floats  # (n,)
    pareto_k: float  # shape of the tail of the weights
    efficiency: float  # effective sample size for each point
    effective_size: float  # effective sample size of the points of all proposals
    log_evidence: float  # logarithm of the integral of the density
    is_reliable: bool  # whether the weights are even enough


def importance_sample(
    log_density: LogDensity,
    modes: Sequence[Laplace],
    size: int,
    seed: int,
    options: ImportanceOptions = ImportanceOptions(),
    prior: Prior | None = None,
) -> ImportanceSample:
    """Return ``size`` draws by importance sampling around modes and from the prior."""
    proposal = laplace_mixture([*modes, *ridges(log_density, modes)], options.degrees)
    points = proposal.draws(options.oversampling * size, seed)
    # Evaluate a few points first: they show whether the rest are worth the time.
    pilot = min(max(len(points) // 8, 512), len(points))
    log_p = log_density(points[:pilot])
    log_ratio = log_p - proposal.log_density(points[:pilot])
    weights = np.exp(log_ratio - logsumexp(log_ratio))
    is_poor = (weights**2).sum() * pilot > options.oversampling / options.effective
    if is_poor and options.rounds > 1:
        points = points[:pilot]
    elif pilot < len(points):
        log_p = np.concatenate([log_p, log_density(points[pilot:])])
    proposals, n_prior = [(proposal.log_density, len(points))], 0
    if prior is not None:
        # Draws of the prior cover ridges between the modes.
        n_prior = int(options.prior_share * len(points))
        new = prior[0](n_prior, seed)
        points, log_p = np.concatenate([points, new]), np.concatenate([log_p, log_density(new)])
    rng = np.random.default_rng([seed, 1])
    for round_ in range(1, options.rounds + 1):
        densities = (
            [*proposals, (prior[1], n_prior)] if prior is not None and n_prior else proposals
        )
        log_ratio = log_p - balance_heuristic(points, densities)
        (sample,) = _resampled(points[None], log_p[None], log_ratio[None], size, seed, options)
        # Stop if there are too few effective points for the moments of a mixture.
        is_lost = round_ > 2 and sample.effective_size < 10 * points.shape[1]
        # Require more effective points of fitted proposals, which look better than they are until
        # all regions have points.
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
        proposals.append((proposal.log_density, count - n_added))
        n_prior += n_added
    return sample


def laplace_mixture(modes: Sequence[Laplace], degrees: float) -> StudentMixture:
    """Return a mixture of t distributions with the moments and masses of approximated modes."""
    masses = np.array([mode.log_mass for mode in modes])
    # Bound the mixing weights from below, because the approximation may underestimate a mode's
    # mass.
    shares = np.maximum(np.exp(masses - logsumexp(masses)), 0.1 / len(masses))
    return StudentMixture(
        np.stack([mode.mode for mode in modes]),
        np.stack([np.linalg.cholesky(mode.covariance) for mode in modes]),
        shares / shares.sum(),
        degrees,
    )


def balance_heuristic(points: Floats, proposals: Sequence[tuple[LogDensity, int]]) -> Floats:
    """Return the log-density, (n,), of all proposals, mixed by their numbers of points."""
    terms = [log_density(points) + np.log(n / len(points)) for log_density, n in proposals]
    return np.asarray(logsumexp(terms, axis=0))


def _fitted_mixture(
    points: Floats, log_ratio: Floats, options: ImportanceOptions, rng: np.random.Generator
) -> StudentMixture:
    """Return a mixture fitted to points, with tempered weights if few points have them all."""
    for power in np.linspace(1, 0, 20, endpoint=False):
        weights = np.exp(power * (log_ratio - log_ratio.max()))
        weights /= weights.sum()
        if effective_sample_size(weights) >= 100:
            break
    has_weight = weights > 0
    return StudentMixture.fitted(
        points[has_weight], weights[has_weight], options.components, options.degrees, rng
    )


def _resampled(
    points: Floats,
    log_p: Floats,
    log_ratio: Floats,
    size: int,
    seed: int,
    options: ImportanceOptions,
) -> list[ImportanceSample]:
    """Return draws of P densities from points, (P, n, d), with log densities and ratios, (P, n).

    By Pareto-smoothed weights and systematic resampling.
    """
    smoothed, pareto_k = pareto_smoothed(log_ratio)
    weights, n = np.exp(smoothed), log_ratio.shape[1]
    rng = np.random.default_rng(seed)
    # Shuffle the points, because every fourth point of a Sobol sequence is in the same quarter.
    order = rng.permutation(n)
    positions = (np.arange(size) + rng.random()) / size
    # Shuffle the draws, because copies of a point are next to each other.
    shuffled = rng.permutation(size)
    rows = order[reached(weights[:, order], positions)[:, shuffled]]
    effective = effective_sample_size(weights)
    is_reliable = effective >= options.effective * size
    is_reliable &= pareto_k <= options.pareto_k
    log_evidence = logsumexp(log_ratio, axis=1) - np.log(n)
    return [
        ImportanceSample(
            points[i, rows[i]],
            log_p[i, rows[i]],
            pareto_k=float(pareto_k[i]),
            efficiency=float(effective[i] / n),
            effective_size=float(effective[i]),
            log_evidence=float(log_evidence[i]),
            is_reliable=bool(is_reliable[i]),
        )
        for i in range(len(points))
    ]


def importance_samples(
    log_density: Callable[[Floats], ArrayPair],
    modes: Sequence[Laplace],
    prior_points: Floats,
    size: int,
    seed: int,
    options: ImportanceOptions = ImportanceOptions(),
) -> list[ImportanceSample | None]:
    """Return the first round of `importance_sample` of P densities with one mode each.

    The function returns log-densities of points, (P, n, d) -> (P, n), and those of the prior, from
    which the prior's points, (m, d), are drawn. None where the first round does not suffice.
    """
    centers = np.stack([mode.mode for mode in modes])
    roots = np.linalg.cholesky([mode.covariance for mode in modes])
    count, d = options.oversampling * size, centers.shape[1]
    u = sobol(count, d + 2, seed)
    standard = student_vectors(u[:, : d + 1], options.degrees)
    drawn = centers[:, None] + standard @ roots.swapaxes(1, 2)
    of_prior = np.broadcast_to(prior_points, (len(modes), *prior_points.shape))
    points = np.concatenate([drawn, of_prior], axis=1)
    log_p, log_prior = log_density(points)
    n = points.shape[1]
    proposals = StudentMixture(centers, roots, np.ones(len(modes)), options.degrees)
    log_q = proposals.log_densities(points).T
    from_modes = log_q + np.log(count / n)
    from_prior = log_prior + np.log((n - count) / n)
    log_ratio = log_p - np.logaddexp(from_modes, from_prior)
    samples = _resampled(points, log_p, log_ratio, size, seed, options)
    return [sample if sample.is_reliable else None for sample in samples]
