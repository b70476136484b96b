"""Probabilities of rare responses, from points that are drawn where they occur."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import logsumexp

from prbayes._validate import AT_ONCE, Floats
from prbayes.decision.inverse_transform import Specimens

# Parts of all points of which one is spent on each step towards the limit: half of them are taken.
_SEARCH_PARTS = 16
# Points that count for one from the wide proposal, which bounds weights. By judgement, as a tenth
# of them costs a twentieth of the accuracy.
_TO_ONE = 9
# How much wider than the population the first points are, in standard deviations, over the root of
# the number of dimensions; they keep weights bounded. By judgement: of one input eight points in a
# thousand are then four standard deviations out, and of ten weights are as even as of one.
_ROOM_AT_FIRST = 0.5
# Share of a step's points that the next one is drawn towards, as in Rubinstein's method, where .1
# to .2 are usual.
_ELITE = 0.2
# Variances beyond one by fewer of their standard errors are taken for one. By judgement: where a
# proposal is too narrow the error is not seen, and where it is too wide it is only larger.
_SURE = 3.0
# Factor of the variance across: weights far out are then bounded. By judgement, as that of ten
# dimensions costs a third of the points.
_ROOMY = 1.2
# Variance towards the limit at least: of the tail of a normal population beyond four standard
# deviations it is .05, and a proposal may be wider.
_LEAST_ALONG = 0.1


@dataclass(frozen=True, eq=False)
class _Proposal:
    """A normal distribution of z."""

    mean: Floats  # (D,)
    root: Floats  # (D, D): lower

    def draw(self, n: int, rng: np.random.Generator) -> Floats:
        """Return n points, (n, D)."""
        z = rng.standard_normal((n, self.mean.size))
        return np.asarray(self.mean + z @ self.root.T)

    def log_density(self, z: Floats) -> Floats:
        """Return the log density at points, (n, D) -> (n,)."""
        standard = np.linalg.solve(self.root, (z - self.mean).T).T
        return log_normal(standard) - float(np.log(np.diag(self.root)).sum())


@dataclass(eq=False)
class Points:
    """Points drawn one proposal after the other, with their responses."""

    z: list[Floats] = field(default_factory=list)
    values: list[Floats] = field(default_factory=list)
    log_ratio: list[Floats] = field(default_factory=list)
    # Each with the number of points that are drawn from it.
    proposals: list[tuple[int, _Proposal]] = field(default_factory=list)

    def all(self) -> tuple[Floats, Floats, Floats]:
        """Return points (n, D), responses (n,) and the log ratios of populations, (k, n)."""
        return (
            np.concatenate(self.z),
            np.concatenate(self.values),
            np.concatenate(self.log_ratio, axis=1),
        )

    def log_mixture(self, z: Floats) -> Floats:
        """Return the log density of the mixture that all points are drawn from, (n,)."""
        sizes = np.array([size for size, _ in self.proposals])
        logs = [one.log_density(z) for _, one in self.proposals]
        return np.asarray(logsumexp(logs, axis=0, b=sizes[:, None] / sizes.sum()))


@dataclass(frozen=True, eq=False)
class Rare:
    """Probabilities of each population, and the error of their mean."""

    by_draw: Floats  # (k,)
    error: float  # standard error of their mean
    lost: float  # share of the populations' weight that has no response


def rare(
    specimens: Specimens,
    roots: Sequence[Floats],
    respond: Callable[[Floats], Floats],
    limit: float,
    size: int,
    rng: np.random.Generator,
) -> Rare:
    r"""Return the probability that a response is above a limit, in each of k populations.

    Points are standard normal numbers z behind the inputs of one population
    :math:`\theta_*`. Half of them are drawn towards the limit step by step, by the cross-entropy
    method. The other half is drawn from the mixture q that these tell, and counts:

    .. math:: P_j = \frac{1}{n} \sum_i 1[y_i > c] \frac{p(x_i | \theta_j)}{p(x_i | \theta_*)}
        \frac{\phi(z_i)}{q(z_i)}

    Parameters
    ----------
    specimens : Specimens
        Of the population in the middle.
    roots : sequence of ndarray, shapes (k, *shape)
        The populations.
    respond : callable
        Normal numbers (n, D) -> responses (n,).
    limit : float
    size : int
        How many responses are computed.
    rng : Generator

    References
    ----------
    .. [1] Rubinstein, R. Y. and D. P. Kroese (2004), The cross-entropy method, Springer,
       doi:10.1007/978-1-4757-4321-0.
    .. [2] Owen, A. B. and Y. Zhou (2000), Safe and effective importance sampling, J. Am. Stat.
       Assoc. 95, 135-143, doi:10.1080/01621459.2000.10473909.
    """
    d = specimens.size
    points = Points()
    widest = _Proposal(np.zeros(d), (1 + _ROOM_AT_FIRST / np.sqrt(d)) * np.eye(d))
    proposals = [widest]
    # More dimensions need more points for a step.
    part = max(size // _SEARCH_PARTS, min(10 * d, size // 8), 1)
    # Towards the limit; once there, where it is exceeded becomes known better.
    search = size // 2
    while search:
        n = min(part, search)
        _add(points, proposals, n, specimens, roots, respond, rng)
        search -= n
        proposals = _towards(points, _level(points, limit), limit) or proposals
    # The proposals know nothing of these points, so that their mean is not off.
    final = Points()
    _add(final, [*_repeated(proposals), widest], size - size // 2, specimens, roots, respond, rng)
    z, values, log_ratio = final.all()
    log_weight = log_normal(z) - final.log_mixture(z)
    known = ~np.isnan(values)
    weights = np.exp(log_ratio + log_weight)
    pooled = weights.mean(axis=0)
    beyond = known & (values > limit)
    each = np.where(beyond, pooled, 0.0)
    error = each.std(ddof=1) / np.sqrt(len(each))
    if not beyond.any():
        error = pooled.max() / len(each)  # what one point would tell
    return Rare(
        by_draw=np.where(beyond, weights, 0.0).mean(axis=1),
        error=float(error),
        lost=_lost(points),
    )


def _lost(points: Points) -> float:
    """Return the share of the populations' weight on points without response."""
    _, values, log_weight = _weighed(points)
    weights = np.exp(log_weight - log_weight.max())
    lost = weights[np.isnan(values)]
    return float(lost.sum() / weights.sum())


def _weighed(points: Points) -> tuple[Floats, Floats, Floats]:
    """Return points (n, D), responses and log weights in all populations together, (n,) each."""
    z, values, log_ratio = points.all()
    all_together = logsumexp(log_ratio, axis=0)
    log_weight = all_together + log_normal(z) - points.log_mixture(z)
    return z, values, log_weight


def _repeated(proposals: list[_Proposal]) -> list[_Proposal]:
    """Return proposals as often as they are drawn from for each point of a wide one."""
    return [one for one in proposals for _ in range(max(1, _TO_ONE // len(proposals)))]


def _add(
    points: Points,
    proposals: list[_Proposal],
    n: int,
    specimens: Specimens,
    roots: Sequence[Floats],
    respond: Callable[[Floats], Floats],
    rng: np.random.Generator,
) -> None:
    """Draw points, and compute their responses."""
    sizes = [len(part) for part in np.array_split(np.arange(n), len(proposals))]
    drawn = [one.draw(size, rng) for one, size in zip(proposals, sizes, strict=True)]
    z = np.concatenate(drawn)
    x = specimens.at(z)
    own = specimens.log_density(specimens.roots, x)
    step = max(1, AT_ONCE // n)
    ratios = []
    for first in range(0, len(roots[0]), step):
        some = [root[first : first + step] for root in roots]
        ratios.append(specimens.log_density(some, x) - own)
    points.z.append(z)
    points.values.append(respond(z))
    points.log_ratio.append(np.concatenate(ratios))
    points.proposals += zip(sizes, proposals, strict=True)


def _level(points: Points, limit: float) -> float:
    """Return what the next points are drawn towards: the limit, or what some of the last reach."""
    last = points.values[-1]
    known = last[~np.isnan(last)]
    if not known.size:
        return limit
    reached = float(np.quantile(known, 1 - _ELITE, method="lower"))
    return min(reached, limit)


def _towards(points: Points, level: float, limit: float) -> list[_Proposal]:
    """Return about the normal distribution nearest to the populations above a level, if any is.

    Two, where what is above spreads wider than the population, as on two sides of it.
    """
    z, values, log_weight = _weighed(points)
    above = values >= level
    if not above.any():
        return []
    z = z[above]
    log_weight = log_weight[above]
    weights = np.exp(log_weight - log_weight.max())
    total = weights.sum()
    # Narrower only where the limit is reached: a step is longer for it before.
    least = _LEAST_ALONG if level >= limit else 1.0
    mean = weights @ z / total
    away = z - mean
    covariance = (away.T * weights) @ away / total
    variances, axes = np.linalg.eigh(covariance)
    error = np.sqrt(2 * (weights**2).sum()) / total  # of a variance of one
    # The largest of several is larger by chance (Marchenko and Pastur 1967).
    by_chance = (1 + np.sqrt(mean.size / 2) * error) ** 2
    if variances[-1] <= max(by_chance, 1 + _SURE * error):
        return [_nearest(z, weights, least)]
    side = away @ axes[:, -1] > 0
    return [_nearest(z[own], weights[own], least) for own in (side, ~side)]


def _nearest(z: Floats, weights: Floats, least: float) -> _Proposal:
    """Return a normal distribution with the mean of points, and their variance along it.

    Few points tell no covariance of several dimensions: across it is the same everywhere.
    """
    total = weights.sum()
    mean = weights @ z / total
    distance = float(np.linalg.norm(mean))
    towards = mean / max(distance, 1e-300)
    share = weights / total
    away = z - mean
    whole = float(share @ (away**2).sum(axis=1))
    own = float(share @ (away @ towards) ** 2)
    along = max(own, least)
    others = max(mean.size - 1, 1)
    across = _ROOMY * max((whole - own) / others, 1.0)
    outer = np.outer(towards, towards)
    identity = np.eye(mean.size)
    covariance = across * (identity - outer) + along * outer
    return _Proposal(mean, np.linalg.cholesky(covariance))


def log_normal(z: Floats) -> Floats:
    """Return the log density of independent standard normal numbers, (n, D) -> (n,)."""
    return np.asarray(-0.5 * (z**2).sum(axis=1) - 0.5 * z.shape[1] * np.log(2 * np.pi))
