r"""Likelihood of the hyperparameters given a metric's estimate, from refits of synthetic data sets.

Data sets are drawn once from stored responses, at points :math:`\theta_r` around the estimate, and
refitted once. The balance heuristic weights them under any theta (Veach and Guibas 1995,
doi:10.1145/218380.218498):

.. math:: W_r(\theta) \propto \frac{p(data_r | \theta)}{\sum_s p(data_r | \theta_s)}.

The density of the observed estimate is a saddlepoint approximation over the weighted estimates. Its
cumulant function is mixed with that of a normal distribution in the tail (Fasiolo et al. 2018,
doi:10.1214/18-EJS1433).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, vstack
from scipy.special import logsumexp, ndtri

from prbayes._validate import AT_ONCE, Floats
from prbayes.inference.batched_objective import BatchObjective
from prbayes.inference.prior_continuation import Continuation, ContinuedEvaluator, continuation_of
from prbayes.inference.refits import SamplingDistribution
from prbayes.inference.resampling import (
    DataSets,
    groups,
    observable,
    observed_set,
    points_along,
    sets_at,
    specimens,
    stored_populations,
)
from prbayes.metrics.score import prepared_on_population
from prbayes.model.coverage import TOLERABLE, supports_each
from prbayes.model.evaluator import Evaluator, coarse_where_sufficient
from prbayes.model.parameters import THETAS
from prbayes.numerics.points import sobol
from prbayes.numerics.threads import one_thread
from prbayes.optimize.optimum import Optimum, optima_of
from prbayes.posterior.importance import importance_sample, laplace
from prbayes.posterior.saddlepoint import (
    Cumulants,
    SaddlepointOptions,
    Scores,
    cumulants,
    density_at,
    minimum,
)


@dataclass(frozen=True)
class RefitLikelihoodOptions:
    """Options of the likelihood given an estimate, from refits.

    Attributes
    ----------
    n_sets : int
        Number of synthetic data sets.
    n_starts : int
        Points around the estimate, the best of which a refit starts from if there are other optima.
    rounds : int
        Rounds that share the data sets. Those of the first are drawn around the estimate, those of
        others around the posterior before.
    radius : float
        Radius of the ball that the first ones are drawn in, in standard errors.
    inflation : float
        Standard deviations of the others, relative to the posterior's.
    weakest : float
        Standard error in prior standard deviations up to which a direction is identified.
    tail : float
        Squared distance of the observed estimate from its mean, in standard deviations, at which
        the normal distribution takes over.
    prior_sets : float
        Data sets that a standard error in place of the weighted estimates counts for, for each
        element of the estimate and one more.
    reach : float
        Largest distance of an estimate from the observed one, in standard errors.
    far : float
        Largest share of estimates beyond.
    converged : float
        Smallest share of refits that have to converge.
    whitenings : int
        Times that metrics of several outputs are minimised again, whitened by the population at
        the estimate before.
    seed : int
    saddlepoint : SaddlepointOptions
    """

    n_sets: int = 1024
    n_starts: int = 64
    rounds: int = 2
    radius: float = 4.0
    inflation: float = 1.5
    weakest: float = 10.0
    tail: float = 40.0
    prior_sets: float = 1.0
    reach: float = 10.0
    far: float = 0.1
    converged: float = 0.9
    whitenings: int = 2
    seed: int = 0
    saddlepoint: SaddlepointOptions = field(default_factory=SaddlepointOptions)


@dataclass(frozen=True, eq=False)
class SyntheticSets:
    """Synthetic data sets with their estimates.

    Attributes
    ----------
    counts : tuple of csr_array, shapes (R, M_j)
        Specimens of each data set at the stored responses, by set of simulators that share them.
    log_mixture : ndarray, shape (R,)
        Log-density of each data set in the mixture of the populations that they are drawn from.
    estimates : ndarray, shape (R, r)
        In coordinates of the sampling distribution.
    """

    counts: tuple[csr_array, ...]
    log_mixture: Floats
    estimates: Floats


@dataclass(frozen=True, eq=False)
class RefitLikelihood:
    """The likelihood given the estimate, for `importance_sample` and `laplace`.

    Attributes
    ----------
    evaluator : Evaluator
    centers : tuple of SamplingDistribution
        At the estimate and at optima that are as good; in coordinates of the continuation.
    continuation : Continuation
    starts : ndarray, shape (M, d)
        Thetas of these, moved within the ends of the prior.
    scale : ndarray, shape (d,)
        Unit of each element for `laplace`.
    sets : SyntheticSets
    options : RefitLikelihoodOptions
    """

    evaluator: Evaluator
    centers: tuple[SamplingDistribution, ...]
    continuation: Continuation
    starts: Floats
    scale: Floats
    sets: SyntheticSets
    options: RefitLikelihoodOptions

    @property
    def point(self) -> Floats:
        """Theta of the estimate, moved within the ends of the prior, (d,)."""
        return np.asarray(self.starts[0])

    @property
    def sampling(self) -> SamplingDistribution:
        """The sampling distribution of the estimate."""
        return self.centers[0]

    @one_thread()
    def log_likelihood(self, thetas: Floats) -> Floats:
        """Return the log-density of the observed estimate, (S, d) -> (S,)."""
        if self.sets.estimates.shape[1] == 0:
            return np.zeros(len(thetas))
        x = self.sampling.coordinates(self.continuation.coordinates(thetas))
        largest = max(count.shape[1] for count in self.sets.counts)
        rows = max(16, AT_ONCE // max(largest, len(self.sets.estimates)))
        blocks = [self._block(x[first : first + rows]) for first in range(0, len(x), rows)]
        return np.concatenate(blocks)

    def _block(self, x: Floats) -> Floats:
        result = np.full(len(x), -np.inf)
        logs = self.log_weights(x)
        is_supported = np.isfinite(logs).any(axis=1)
        if is_supported.any():
            logs = logs[is_supported]
            away = nearest(self.centers, self.sampling.thetas(x[is_supported]))[1]
            result[is_supported] = extended_log_density(
                logs, self.sets.estimates, away, self.options
            )
        return result

    def log_weights(self, x: Floats) -> Floats:
        """Return log weights of the data sets at coordinates, (S, r) -> (S, R); they sum to one."""
        logs = _log_likelihoods(self.sampling, self.sets.counts, x) - self.sets.log_mixture
        with np.errstate(invalid="ignore"):
            return np.asarray(logs - logsumexp(logs, axis=1, keepdims=True))


def nearest(
    centers: Sequence[SamplingDistribution], thetas: Floats
) -> tuple[NDArray[np.intp], Floats]:
    """Return the nearest center of each theta, (S,), and coordinates around it, (S, r)."""
    x = np.stack([center.coordinates(thetas) for center in centers])
    distances = np.linalg.norm(x, axis=2)
    chosen = distances.argmin(axis=0)
    return chosen, x[chosen, np.arange(len(thetas))]


def extended_log_density(
    log_weights: Floats, estimates: Floats, away: Floats, options: RefitLikelihoodOptions
) -> Floats:
    """Return the log-density of an estimate of zero, (S,).

    The cumulant function is that of the weighted estimates, mixed with that of a normal
    distribution with their moments. A few data sets with one standard error join the moments, which
    matters where few of the synthetic ones have weights.

    Parameters
    ----------
    log_weights : ndarray, shape (S, R)
    estimates : ndarray, shape (R, r)
    away : ndarray, shape (S, r)
        Where the populations are, relative to the observed estimate.
    options : RefitLikelihoodOptions
    """
    r = estimates.shape[1]
    scores = [Scores(estimates, 1)]
    untilted = cumulants([log_weights], scores, np.zeros_like(away))
    effective = 1 / np.exp(2 * log_weights).sum(axis=1)
    part = effective / (effective + options.prior_sets * (r + 1))
    # Beyond all data sets the mean is as far away as the population.
    lengths = np.linalg.norm(untilted.gradients, axis=1)
    ratios = np.linalg.norm(away, axis=1) / np.maximum(lengths, 1e-300)
    factors = np.maximum(ratios, 1) ** (1 - part)
    mean = factors[:, None] * untilted.gradients
    covariance = part[:, None, None] * untilted.hessians
    covariance += (1 - part)[:, None, None] * np.eye(r)
    standardised = np.linalg.solve(covariance, mean[:, :, None])[:, :, 0]
    distance = (mean * standardised).sum(axis=1)
    share = part * np.exp(-distance / options.tail)

    def function(tilts: Floats, rows: NDArray[np.intp]) -> Cumulants:
        empirical = cumulants([log_weights[rows]], scores, tilts)
        linear = np.einsum("skl,sl->sk", covariance[rows], tilts)
        normal = (mean[rows] * tilts).sum(axis=1) + (linear * tilts).sum(axis=1) / 2
        weight = share[rows]
        normal_weight = 1 - weight
        gradients = normal_weight[:, None] * (mean[rows] + linear)
        hessians = normal_weight[:, None, None] * covariance[rows]
        return Cumulants(
            weight * empirical.values + normal_weight * normal,
            weight[:, None] * empirical.gradients + gradients,
            weight[:, None, None] * empirical.hessians + hessians,
        )

    points = minimum(function, away.shape, 1, options.saddlepoint)
    mixed = density_at(points, 1, options.saddlepoint)
    normal = -(distance + np.linalg.slogdet(covariance)[1]) / 2
    return np.where(np.isfinite(mixed), mixed, normal)


def refit_likelihood(
    evaluator: Evaluator,
    optimum: Optimum,
    options: RefitLikelihoodOptions = RefitLikelihoodOptions(),
) -> RefitLikelihood:
    """Return the likelihood of the hyperparameters given the minimiser of any metrics.

    Parameters
    ----------
    evaluator : Evaluator
        Of a model whose simulators have stored responses.
    optimum : Optimum
    options : RefitLikelihoodOptions

    Raises
    ------
    ValueError
        If the estimate is at an edge, stored responses do not support populations around it, or
        refits do not converge.
    """
    if optimum.search.at_edge:
        raise ValueError(_at_edge(", ".join(optimum.search.at_edge)))
    thetas = optima_of(optimum, evaluator)
    scales = np.array([optimum.scales[node.name] for node in evaluator.nodes])
    continuation = continuation_of(evaluator, thetas[:1])
    start, *others = continuation.coordinates(thetas)
    for _ in range(options.whitenings):
        evaluator, start = _whitened(evaluator, continuation, start, scales, options)
    continued = _continued(evaluator, continuation)
    sampling = _at_minimiser(continued, start, scales, options)
    _require_inside(sampling, options)
    centers = [sampling]
    for other in others:
        center = SamplingDistribution.of(continued, other, scales, options.weakest)
        if center.stderr.size == sampling.stderr.size:
            centers.append(center)
    # Identified directions are known from all stored responses; an eighth is enough for the rest.
    evaluator = coarse_where_sufficient(evaluator, continuation.within(thetas[:1])[0])
    continued = _continued(evaluator, continuation)
    centers = [replace(center, evaluator=continued) for center in centers]
    sampling = centers[0] = _moved_to_minimiser(centers[0])
    places = np.array([center.theta for center in centers])
    likelihood = RefitLikelihood(
        evaluator=evaluator,
        centers=tuple(centers),
        continuation=continuation,
        starts=continuation.within(places, margin=0.05),
        scale=_scale(evaluator, sampling, continuation),
        sets=SyntheticSets((), np.empty(0), np.empty((0, sampling.stderr.size))),
        options=options,
    )
    if not sampling.stderr.size:
        return likelihood
    number = options.n_sets // options.rounds
    drawn = _draw(centers, _balls(centers, number, options), options, seed=0)
    for i in range(1, options.rounds):
        likelihood = replace(likelihood, sets=_pooled(sampling, drawn))
        x = _posterior_points(likelihood, number)
        drawn = drawn.joined(_draw(centers, x, options, seed=i))
    return replace(likelihood, sets=_pooled(sampling, drawn))


def _posterior_points(likelihood: RefitLikelihood, number: int) -> Floats:
    """Return coordinates of draws from the posterior, spread out around each optimum, (n, r)."""
    options = likelihood.options
    evaluator = likelihood.evaluator

    def log_likelihood(thetas: Floats) -> Floats:
        return likelihood.log_likelihood(thetas) + evaluator.log_other(thetas)

    density = partial(evaluator.hyperparameters.log_posterior, log_likelihood=log_likelihood)
    modes = laplace(density, likelihood.starts, likelihood.scale)
    sample = importance_sample(density, modes, number, options.seed)
    thetas = likelihood.continuation.coordinates(sample.draws)
    x = likelihood.sampling.coordinates(thetas)
    chosen, _ = nearest(likelihood.centers, thetas)
    for i in np.unique(chosen):
        members = chosen == i
        middle = np.median(x[members], axis=0)
        x[members] = middle + options.inflation * (x[members] - middle)
    return x


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Data sets drawn at coordinates, with their estimates."""

    x: Floats  # (R, r)
    counts: tuple[csr_array, ...]
    estimates: Floats  # (R, r)

    def joined(self, other: _Drawn) -> _Drawn:
        """Return these and others."""
        pairs = zip(self.counts, other.counts, strict=True)
        counts = [vstack(pair, format="csr") for pair in pairs]
        return _Drawn(
            np.concatenate([self.x, other.x]),
            tuple(counts),
            np.concatenate([self.estimates, other.estimates]),
        )


def _pooled(sampling: SamplingDistribution, drawn: _Drawn) -> SyntheticSets:
    logs = _log_likelihoods(sampling, drawn.counts, drawn.x)
    return SyntheticSets(drawn.counts, logsumexp(logs, axis=0), drawn.estimates)


def _draw(
    centers: Sequence[SamplingDistribution],
    x: Floats,
    options: RefitLikelihoodOptions,
    seed: int,
) -> _Drawn:
    """Draw a data set at each of some coordinates, (R, r), and refit it."""
    sampling = centers[0]
    evaluator = sampling.evaluator
    thetas = sampling.thetas(x)
    supported = _is_supported(evaluator, thetas)
    if supported.mean() < 0.5:
        raise ValueError(
            f"got stored responses that support {supported.mean():.0%} of the populations around "
            "the estimate, expected at least half; widen the prior, or use prb.sample_smc"
        )
    x, thetas = x[supported], thetas[supported]
    rng = np.random.default_rng([options.seed, seed])
    points = points_along(evaluator, thetas, rng)
    sets = sets_at(evaluator, stored_populations(evaluator, thetas), points)
    starts = x if len(centers) == 1 else _best_starts(centers, sets, options)
    estimates, converged = sampling.refit(sets, starts, roughly=True)
    if converged.mean() < options.converged:
        raise ValueError(
            f"got {int(converged.sum())} of {converged.size} refits that converged, expected at "
            f"least {options.converged:.0%}; use another metric, or prb.sample_smc"
        )
    is_far = np.abs(estimates).max(axis=1) > options.reach
    if is_far.mean() > options.far:
        raise ValueError(_at_edge(f"{is_far.mean():.0%} of the estimates of synthetic data sets"))
    estimates = np.clip(estimates, -options.reach, options.reach)
    numbers, _ = specimens(evaluator.nodes)
    counts = []
    for members in groups(evaluator.nodes):
        columns = np.unique(np.concatenate([numbers[k] for k in members]))
        first = members[0]
        size = evaluator.nodes[first].bound.n_points
        chosen = points[first][np.ix_(converged, columns)]
        counts.append(_counted(chosen, size))
    return _Drawn(x[converged], tuple(counts), estimates[converged])


def _counted(points: NDArray[np.intp], size: int) -> csr_array:
    """Return how often each stored response is a specimen of each data set, (R, M)."""
    count, each = points.shape
    ends = each * np.arange(count + 1)
    ones = np.ones(points.size)
    result = csr_array((ones, points.ravel(), ends), shape=(count, size))
    result.sum_duplicates()
    return result


def _log_likelihoods(
    sampling: SamplingDistribution, counts: tuple[csr_array, ...], x: Floats
) -> Floats:
    """Return log p(data_r | theta) at coordinates, (S, R)."""
    evaluator = sampling.evaluator
    thetas = sampling.thetas(x)
    total = np.zeros((len(x), counts[0].shape[0]))
    for members, count in zip(groups(evaluator.nodes), counts, strict=True):
        mask = np.ones(count.shape[1], dtype=bool)
        for k in members:
            responses, weights = evaluator.populations(thetas, k)
            mask &= observable(responses[0], evaluator.nodes[k].target)
        rows = np.where(mask, weights, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.log(rows / rows.sum(axis=1, keepdims=True))
        total += (count @ np.ascontiguousarray(logs.T)).T
    return total


def _is_supported(evaluator: Evaluator, thetas: Floats) -> NDArray[np.bool_]:
    """Return at which thetas stored responses support the populations, (S,)."""
    supported = np.ones(len(thetas), dtype=bool)
    for name, support in evaluator.support(thetas).items():
        bound = evaluator.reweighted[name]
        supported &= supports_each(support, bound.required_ess, bound.max_lost, TOLERABLE)
    return supported


def _balls(
    centers: Sequence[SamplingDistribution], number: int, options: RefitLikelihoodOptions
) -> Floats:
    """Return points of balls of standard errors around estimates, in coordinates of the first."""
    sampling = centers[0]
    r = sampling.stderr.size
    points = []
    for i, center in enumerate(centers):
        ball = _ball(number // len(centers), r, options, options.seed + i)
        x = sampling.coordinates(center.thetas(ball))
        points.append(x)
    return np.concatenate(points)


def _ball(number: int, r: int, options: RefitLikelihoodOptions, seed: int) -> Floats:
    """Return evenly spread points of a ball, (number, r)."""
    u = sobol(number, r + 1, seed)
    directions = ndtri(u[:, :r])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radii = options.radius * u[:, r:] ** (1 / r)
    return np.asarray(radii * directions)


def _best_starts(
    centers: Sequence[SamplingDistribution], sets: DataSets, options: RefitLikelihoodOptions
) -> Floats:
    """Return the best of some points around the estimate for each data set, (R, r).

    Points nearer to another optimum are left out: all refits are minimisers near the estimate.
    """
    sampling = centers[0]
    ball = _ball(options.n_starts, sampling.stderr.size, options, options.seed)
    thetas = sampling.thetas(ball)
    chosen, _ = nearest(centers, thetas)
    ball, thetas = ball[chosen == 0], thetas[chosen == 0]
    objective = BatchObjective.of(sampling.evaluator, sampling.scales, sets)
    best = []
    for first in range(0, objective.n_sets, 16):
        values = objective(thetas[None], slice(first, first + 16))
        best.append(values.argmin(axis=1))
    return np.asarray(ball[np.concatenate(best)])


def _continued(evaluator: Evaluator, continuation: Continuation) -> Evaluator:
    if not continuation.is_continued.any():
        return evaluator
    return ContinuedEvaluator.continuing(evaluator, continuation)


def _at_minimiser(
    evaluator: Evaluator, start: Floats, scales: Floats, options: RefitLikelihoodOptions
) -> SamplingDistribution:
    """Return the sampling distribution at the minimiser for the observed responses near a start."""
    for _ in range(5):
        sampling = SamplingDistribution.of(evaluator, start, scales, options.weakest)
        moved = _moved_to_minimiser(sampling)
        x = sampling.coordinates(moved.theta)
        start = moved.theta
        if np.abs(x).max(initial=0.0) < 0.5:
            return moved
    raise ValueError(
        "got an estimate that still moves by half a standard error when it is minimised again, "
        "expected a minimum; use another metric, or prb.sample_smc"
    )


def _moved_to_minimiser(sampling: SamplingDistribution) -> SamplingDistribution:
    """Return the sampling distribution with the minimiser for the observed responses as theta."""
    (x,), _ = sampling.refit(observed_set(sampling.evaluator))
    return replace(sampling, theta=sampling.thetas(x))


def _whitened(
    evaluator: Evaluator,
    continuation: Continuation,
    start: Floats,
    scales: Floats,
    options: RefitLikelihoodOptions,
) -> tuple[Evaluator, Floats]:
    """Return metrics of several outputs, whitened by the population, and their minimiser."""
    targets = [node.target for node in evaluator.nodes]
    if not any(target.event for target in targets):
        return evaluator, start
    continued = _continued(evaluator, continuation)
    for k, target in enumerate(targets):
        if target.event:
            responses, weights = continued.populations(start[None], k)
            targets[k] = prepared_on_population(target, responses[0], weights[0])
    prepared = evaluator.with_targets(targets)
    sampling = _at_minimiser(_continued(prepared, continuation), start, scales, options)
    return prepared, sampling.theta


def _require_inside(sampling: SamplingDistribution, options: RefitLikelihoodOptions) -> None:
    """Raise if the data identify more at the middle of the prior than at the estimate."""
    local = sampling.local
    if not local.unidentified.size:
        return
    evaluator = sampling.evaluator
    middle = np.median(evaluator.hyperparameters.prior_points(THETAS, 0), axis=0)
    shift = (middle - sampling.theta) / local.prior_sd
    along = local.identified @ (local.identified.T @ shift)
    inside = sampling.theta + (shift - along) * local.prior_sd
    there = SamplingDistribution.of(evaluator, inside, sampling.scales, options.weakest)
    if there.stderr.size > sampling.stderr.size:
        names = np.array(evaluator.hyperparameters.readable_names)
        is_flat = (local.unidentified**2).sum(axis=1) > 0.5
        raise ValueError(_at_edge(", ".join(names[is_flat])))


def _at_edge(what: str) -> str:
    return (
        f"got {what} at an edge, as where a standard deviation is about zero, where estimates pile "
        "up and have no density; use prb.LogLikelihood(), or prb.sample_smc"
    )


def _scale(
    evaluator: Evaluator, sampling: SamplingDistribution, continuation: Continuation
) -> Floats:
    """Return prior standard deviations, or a hundred standard errors if these are less, (d,)."""
    axes = sampling.axes * sampling.stderr
    errors = np.sqrt((axes**2).sum(axis=1))
    is_known = ~continuation.is_continued & (errors > 0)
    units = np.where(is_known, np.minimum(100 * errors, 1), 1.0)
    return np.asarray(units * evaluator.hyperparameters.prior_sd)
