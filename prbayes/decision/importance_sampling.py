"""Probabilities of rare responses by importance sampling with the cross-entropy method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from prbayes._validate import AT_ONCE, Floats
from prbayes.decision.populations import InverseTransform


@dataclass(frozen=True, eq=False)
class RareEvent:
    """Probabilities of an event in each population, and the error of their mean."""

    by_draw: Floats  # (k,)
    error: float  # standard error of their mean
    lost: float  # share of the populations' weight that has no response


@dataclass(frozen=True, eq=False)
class _Normal:
    """A normal proposal of z."""

    mean: Floats  # (D,)
    root: Floats  # (D, D): lower Cholesky factor of the covariance

    def draw(self, n: int, rng: np.random.Generator) -> Floats:
        z = rng.standard_normal((n, self.mean.size))
        return np.asarray(self.mean + z @ self.root.T)

    def log_density(self, z: Floats) -> Floats:
        standard = np.linalg.solve(self.root, (z - self.mean).T).T
        return log_normal(standard) - float(np.log(np.diag(self.root)).sum())


@dataclass(frozen=True, eq=False)
class _Points:
    """Points from several proposals, with their responses."""

    sizes: list[int]  # number of points from each proposal
    proposals: list[_Normal]
    z: Floats  # (n, D)
    values: Floats  # (n,)
    log_ratio: Floats  # (k, n): of the density of each population to that of the central one

    def log_mixture(self) -> Floats:
        """Return the log-density of the mixture of all proposals at the points, (n,)."""
        sizes = np.array(self.sizes)
        logs = [proposal.log_density(self.z) for proposal in self.proposals]
        return np.asarray(logsumexp(logs, axis=0, b=sizes[:, None] / sizes.sum()))

    def log_weights(self) -> Floats:
        """Return the log importance weights for all populations together, (n,)."""
        pooled = logsumexp(self.log_ratio, axis=0)
        return np.asarray(pooled + log_normal(self.z) - self.log_mixture())


def rare_event(
    transform: InverseTransform,
    parents: Sequence[Floats],
    respond: Callable[[Floats], Floats],
    limit: float,
    size: int,
    rng: np.random.Generator,
) -> RareEvent:
    r"""Return the probability that a response is above a limit, in each of k populations.

    Points are standard normal numbers z behind the inputs of a central population
    :math:`\theta_*`. One half is drawn towards the limit step by step, by the cross-entropy method.
    The other half is drawn from the mixture q of the last proposals, and counts:

    .. math:: P_j = \frac{1}{n} \sum_i 1[y_i > c] \frac{p(x_i | \theta_j)}{p(x_i | \theta_*)}
        \frac{\phi(z_i)}{q(z_i)}

    Parameters
    ----------
    transform : InverseTransform
        Of the central population.
    parents : sequence of ndarray, shapes (k, *shape)
        Of the populations.
    respond : callable
        Normal numbers (n, D) -> responses (n,).
    limit : float
    size : int
        Number of responses to compute.
    rng : Generator

    References
    ----------
    .. [1] Rubinstein, R. Y. and D. P. Kroese (2004), The cross-entropy method, Springer,
       doi:10.1007/978-1-4757-4321-0.
    .. [2] Owen, A. B. and Y. Zhou (2000), Safe and effective importance sampling, J. Am. Stat.
       Assoc. 95, 135-143, doi:10.1080/01621459.2000.10473909.
    """
    d = transform.size
    # Wider than the population, which bounds the weights; less so in each of many dimensions.
    widest = _Normal(np.zeros(d), (1 + 0.5 / np.sqrt(d)) * np.eye(d))
    proposals = [widest]
    # A sixteenth of the points a step; more dimensions need more.
    step = max(size // 16, min(10 * d, size // 8), 1)
    batches: list[_Points] = []
    remaining = size // 2
    while remaining:
        n = min(step, remaining)
        batches.append(_draw_points(proposals, n, transform, parents, respond, rng))
        remaining -= n
        level = min(_elite_quantile(batches[-1].values, limit), limit)
        proposals = _cross_entropy_proposals(_concatenated(batches), level, limit) or proposals
    search = _concatenated(batches)
    # The proposals do not depend on the final points, whose mean is unbiased. One point in ten
    # comes from the widest proposal, which bounds weights.
    copies = max(1, 9 // len(proposals))
    mixture = [proposal for proposal in proposals for _ in range(copies)] + [widest]
    final = _draw_points(mixture, size - size // 2, transform, parents, respond, rng)
    weights = np.exp(final.log_ratio + (log_normal(final.z) - final.log_mixture()))
    mean_weights = weights.mean(axis=0)
    is_beyond = ~np.isnan(final.values) & (final.values > limit)
    terms = np.where(is_beyond, mean_weights, 0.0)
    error = terms.std(ddof=1) / np.sqrt(len(terms))
    if not is_beyond.any():
        error = mean_weights.max() / len(terms)  # the contribution of a single point
    log_weights = search.log_weights()
    shares = np.exp(log_weights - log_weights.max())
    return RareEvent(
        by_draw=np.where(is_beyond, weights, 0.0).mean(axis=1),
        error=float(error),
        lost=float(shares[np.isnan(search.values)].sum() / shares.sum()),
    )


def _draw_points(
    proposals: list[_Normal],
    n: int,
    transform: InverseTransform,
    parents: Sequence[Floats],
    respond: Callable[[Floats], Floats],
    rng: np.random.Generator,
) -> _Points:
    """Draw n points, in equal parts from each proposal, and compute their responses."""
    sizes = [len(part) for part in np.array_split(np.arange(n), len(proposals))]
    draws = [proposal.draw(size, rng) for proposal, size in zip(proposals, sizes, strict=True)]
    z = np.concatenate(draws)
    x = transform(z)
    central = transform.log_density(transform.parents, x)
    step = max(1, AT_ONCE // n)
    log_ratio = [
        transform.log_density([values[first : first + step] for values in parents], x) - central
        for first in range(0, len(parents[0]), step)
    ]
    return _Points(sizes, proposals, z, respond(z), np.concatenate(log_ratio))


def _concatenated(batches: Sequence[_Points]) -> _Points:
    return _Points(
        sizes=[size for batch in batches for size in batch.sizes],
        proposals=[proposal for batch in batches for proposal in batch.proposals],
        z=np.concatenate([batch.z for batch in batches]),
        values=np.concatenate([batch.values for batch in batches]),
        log_ratio=np.concatenate([batch.log_ratio for batch in batches], axis=1),
    )


def _elite_quantile(values: Floats, limit: float) -> float:
    """Return the level that the highest fifth of responses exceeds, as is usual for the method."""
    values = values[~np.isnan(values)]
    return float(np.quantile(values, 1 - 0.2, method="lower")) if values.size else limit


def _cross_entropy_proposals(points: _Points, level: float, limit: float) -> list[_Normal]:
    """Return the normal distribution nearest to the populations above a level, if any point is.

    Two of them if the points above spread wider than the population, as on both sides of it.
    """
    is_above = points.values >= level
    if not is_above.any():
        return []
    z = points.z[is_above]
    log_weights = points.log_weights()[is_above]
    weights = np.exp(log_weights - log_weights.max())
    total = weights.sum()
    # Variance towards the limit. Before the limit is reached, narrow proposals slow the search;
    # beyond four standard deviations a normal tail has a variance of .05.
    least = 0.1 if level >= limit else 1.0
    mean = weights @ z / total
    deviation = z - mean
    covariance = (deviation.T * weights) @ deviation / total
    variances, axes = np.linalg.eigh(covariance)
    error = np.sqrt(2 * (weights**2).sum()) / total  # of a variance of one
    # The largest of several variances is larger by chance (Marchenko and Pastur 1967).
    by_chance = (1 + np.sqrt(mean.size / 2) * error) ** 2
    if variances[-1] <= max(by_chance, 1 + 3 * error):
        return [_tail_normal(z, weights, least)]
    side = deviation @ axes[:, -1] > 0
    return [_tail_normal(z[part], weights[part], least) for part in (side, ~side)]


def _tail_normal(z: Floats, weights: Floats, least: float) -> _Normal:
    """Return a normal distribution with the mean of points, and their variance along it.

    Few points do not determine a covariance of several dimensions: across the mean it is isotropic.
    """
    total = weights.sum()
    mean = weights @ z / total
    direction = mean / max(float(np.linalg.norm(mean)), 1e-300)
    shares = weights / total
    deviation = z - mean
    whole = float(shares @ (deviation**2).sum(axis=1))
    along = float(shares @ (deviation @ direction) ** 2)
    # A fifth wider across, which bounds weights far out.
    across = 1.2 * max((whole - along) / max(mean.size - 1, 1), 1.0)
    outer = np.outer(direction, direction)
    covariance = across * (np.eye(mean.size) - outer) + max(along, least) * outer
    return _Normal(mean, np.linalg.cholesky(covariance))


def log_normal(z: Floats) -> Floats:
    """Return the log-density of independent standard normal numbers, (n, D) -> (n,)."""
    return np.asarray(-0.5 * (z**2).sum(axis=1) - 0.5 * z.shape[1] * np.log(2 * np.pi))
