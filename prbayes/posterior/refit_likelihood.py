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

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.special import logsumexp

from prbayes._checks import AT_ONCE, Floats
from prbayes._threads import one_thread
from prbayes.estimate.continuation import Continuation, ContinuedEvaluator, continuation_of
from prbayes.estimate.data_sets import (
    groups,
    observable,
    observed_set,
    points_along,
    sets_at,
    specimens,
    stored_populations,
)
from prbayes.estimate.optimum import Optimum
from prbayes.estimate.refit import SamplingDistribution
from prbayes.metrics.score import prepared_on_population
from prbayes.model.evaluator import Evaluator
from prbayes.model.support import TOLERABLE, supports_each
from prbayes.posterior.importance import importance_sample, laplace
from prbayes.posterior.saddlepoint import (
    Cumulants,
    SaddlepointOptions,
    Scores,
    cumulants,
    density_at,
    minimum,
)
from prbayes.propagation.points import sobol


@dataclass(frozen=True)
class RefitLikelihoodOptions:
    """Options of the likelihood given an estimate, from refits.

    Attributes
    ----------
    n_sets : int
        Number of synthetic data sets.
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
    converged : float
        Smallest share of refits that have to converge.
    whitenings : int
        Times that metrics of several outputs are minimised again, whitened by the population at
        the estimate before.
    seed : int
    saddlepoint : SaddlepointOptions
    """

    n_sets: int = 1024
    rounds: int = 2
    radius: float = 4.0
    inflation: float = 1.5
    weakest: float = 10.0
    tail: float = 10.0
    prior_sets: float = 1.0
    reach: float = 10.0
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
    sampling : SamplingDistribution
        Of the estimate; in coordinates of the continuation.
    continuation : Continuation
    point : ndarray, shape (d,)
        Theta of the estimate, moved within the ends of the prior.
    scale : ndarray, shape (d,)
        Unit of each element for `laplace`.
    sets : SyntheticSets
    options : RefitLikelihoodOptions
    """

    evaluator: Evaluator
    sampling: SamplingDistribution
    continuation: Continuation
    point: Floats
    scale: Floats
    sets: SyntheticSets
    options: RefitLikelihoodOptions

    @one_thread()
    def log_likelihood(self, thetas: Floats) -> Floats:
        """Return the log-density of the observed estimate, (S, d) -> (S,)."""
        if self.sets.estimates.shape[1] == 0:
            return np.zeros(len(thetas))
        x, _ = self.sampling.coordinates(self.continuation.coordinates(thetas))
        largest = max(count.shape[1] for count in self.sets.counts)
        rows = max(16, AT_ONCE // max(largest, len(self.sets.estimates)))
        blocks = [self._block(x[first : first + rows]) for first in range(0, len(x), rows)]
        return np.concatenate(blocks)

    def _block(self, x: Floats) -> Floats:
        result = np.full(len(x), -np.inf)
        logs = self.log_weights(x)
        is_supported = np.isfinite(logs).any(axis=1)
        if is_supported.any():
            logs, x = logs[is_supported], x[is_supported]
            result[is_supported] = extended_log_density(logs, self.sets.estimates, x, self.options)
        return result

    def log_weights(self, x: Floats) -> Floats:
        """Return log weights of the data sets at coordinates, (S, r) -> (S, R); they sum to one."""
        logs = _log_likelihoods(self.sampling, self.sets.counts, x) - self.sets.log_mixture
        with np.errstate(invalid="ignore"):
            return np.asarray(logs - logsumexp(logs, axis=1, keepdims=True))

    def log_posterior(self, thetas: Floats) -> Floats:
        """Return the unnormalised log-posterior density in unconstrained space, (S, d) -> (S,)."""
        thetas = np.ascontiguousarray(thetas)
        evaluator = self.evaluator
        logs = evaluator.hyperparameters.log_prior(thetas)
        logs = logs + evaluator.log_other(thetas)
        is_possible = np.isfinite(logs)
        if not is_possible.any():
            return np.full(len(thetas), -np.inf)
        log_likelihood = self.log_likelihood(thetas[is_possible])
        result = np.full(len(thetas), -np.inf)
        result[is_possible] = logs[is_possible] + log_likelihood
        return result


def extended_log_density(
    log_weights: Floats, estimates: Floats, x: Floats, options: RefitLikelihoodOptions
) -> Floats:
    """Return the log-density of an estimate of zero, (S,).

    The cumulant function is that of the weighted estimates, mixed with that of a normal
    distribution with their moments. Few effective data sets are joined by the normal distribution
    around x with one standard error.

    Parameters
    ----------
    log_weights : ndarray, shape (S, R)
    estimates : ndarray, shape (R, r)
    x : ndarray, shape (S, r)
        Where the populations are.
    options : RefitLikelihoodOptions
    """
    r = estimates.shape[1]
    scores = [Scores(estimates, 1)]
    untilted = cumulants([log_weights], scores, np.zeros_like(x))
    effective = 1 / np.exp(2 * log_weights).sum(axis=1)
    prior = options.prior_sets * (r + 1)
    part = effective / (effective + prior)
    mean = part[:, None] * untilted.gradients + (1 - part)[:, None] * x
    covariance = part[:, None, None] * untilted.hessians
    covariance += (1 - part)[:, None, None] * np.eye(r)
    standardised = np.linalg.solve(covariance, mean[:, :, None])[:, :, 0]
    distance = (mean * standardised).sum(axis=1)
    share = part * np.exp(-distance / options.tail)

    def function(tilts: Floats, rows: NDArray[np.intp]) -> Cumulants:
        empirical = cumulants([log_weights[rows]], scores, tilts)
        linear = np.einsum("skl,sl->sk", covariance[rows], tilts)
        normal = (mean[rows] * tilts).sum(axis=1) + (linear * tilts).sum(axis=1) / 2
        own = share[rows]
        rest = 1 - own
        return Cumulants(
            own * empirical.values + rest * normal,
            own[:, None] * empirical.gradients + rest[:, None] * (mean[rows] + linear),
            own[:, None, None] * empirical.hessians + rest[:, None, None] * covariance[rows],
        )

    points = minimum(function, x.shape, 1, options.saddlepoint)
    return density_at(points, 1, options.saddlepoint)


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
    TypeError
        If responses are not stored.
    ValueError
        If the estimate is at an edge, stored responses do not support populations around it, or
        refits do not converge.
    """
    _require_stored(evaluator)
    order = [optimum.names.index(name) for name in evaluator.names]
    rivals = [rival["theta"] for rival in optimum.rivals if rival["comparable"]]
    thetas = np.array([optimum.theta, *rivals])[:, order]
    scales = np.array([optimum.scales[node.name] for node in evaluator.nodes])
    continuation = continuation_of(evaluator, thetas[:1])
    start, *others = continuation.coordinates(thetas)
    for _ in range(options.whitenings):
        evaluator, start = _whitened(evaluator, continuation, start, scales, options)
    continued = _continued(evaluator, continuation)
    sampling = _at_minimiser(continued, start, scales, options)
    point = continuation.within(sampling.theta[None], margin=0.05)[0]
    likelihood = RefitLikelihood(
        evaluator=evaluator,
        sampling=sampling,
        continuation=continuation,
        point=point,
        scale=evaluator.prior_sd,
        sets=SyntheticSets((), np.empty(0), np.empty((0, sampling.stderr.size))),
        options=options,
    )
    number = options.n_sets // options.rounds
    centers = [sampling, *(SamplingDistribution.of(continued, x, scales) for x in others)]
    x = _around(sampling, centers, number, options)
    drawn = _draw(sampling, x, options, seed=0)
    for i in range(1, options.rounds):
        likelihood = replace(likelihood, sets=_pooled(sampling, [drawn]))
        modes = laplace(likelihood.log_posterior, likelihood.point[None], likelihood.scale)
        sample = importance_sample(likelihood.log_posterior, modes, number, options.seed)
        near, _ = sampling.coordinates(continuation.coordinates(sample.draws))
        middle = np.median(near, axis=0)
        more = _draw(sampling, middle + options.inflation * (near - middle), options, seed=i)
        drawn = drawn.joined(more)
    sets = _pooled(sampling, [drawn])
    return replace(likelihood, sets=sets)


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Data sets drawn at coordinates, with their estimates."""

    x: Floats  # (R, r)
    counts: tuple[csr_array, ...]
    estimates: Floats  # (R, r)

    def joined(self, other: _Drawn) -> _Drawn:
        """Return these and others."""
        from scipy.sparse import vstack

        counts = [vstack(pair, format="csr") for pair in zip(self.counts, other.counts)]
        return _Drawn(
            np.concatenate([self.x, other.x]),
            tuple(counts),
            np.concatenate([self.estimates, other.estimates]),
        )


def _pooled(sampling: SamplingDistribution, drawn: list[_Drawn]) -> SyntheticSets:
    (one,) = drawn
    logs = _log_likelihoods(sampling, one.counts, one.x)
    return SyntheticSets(one.counts, logsumexp(logs, axis=0), one.estimates)


def _draw(
    sampling: SamplingDistribution, x: Floats, options: RefitLikelihoodOptions, seed: int
) -> _Drawn:
    """Draw a data set at each of some coordinates, (R, r), and refit it."""
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
    estimates, converged = sampling.refit(sets, roughly=True)
    if converged.mean() < options.converged:
        raise ValueError(
            f"got {int(converged.sum())} of {converged.size} refits that converged, expected at "
            f"least {options.converged:.0%}; use another metric, or prb.sample_smc"
        )
    estimates = np.clip(estimates, -options.reach, options.reach)
    numbers, _ = specimens(evaluator.nodes)
    counts = []
    for members in groups(evaluator.nodes):
        columns = np.unique(np.concatenate([numbers[k] for k in members]))
        first = members[0]
        size = evaluator.designs[evaluator.nodes[first].name].n_points
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
        design = evaluator.designs[name]
        supported &= supports_each(support, design.required_ess, design.config.max_lost, TOLERABLE)
    return supported


def _around(
    sampling: SamplingDistribution,
    centers: list[SamplingDistribution],
    number: int,
    options: RefitLikelihoodOptions,
) -> Floats:
    """Return points of balls of standard errors around estimates, in coordinates of the first."""
    r = sampling.stderr.size
    result = []
    for i, center in enumerate(centers):
        size = center.stderr.size
        u = sobol(number // len(centers), size + 1, options.seed + i)
        from scipy.special import ndtri

        direction = ndtri(u[:, :size])
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        away = options.radius * u[:, size:] ** (1 / max(size, 1)) * direction
        x, _ = sampling.coordinates(center.thetas(away))
        result.append(x)
    return np.concatenate(result).reshape(-1, r)


def _continued(evaluator: Evaluator, continuation: Continuation) -> Evaluator:
    if not continuation.is_continued.any():
        return evaluator
    return ContinuedEvaluator.of(evaluator, continuation)


def _at_minimiser(
    evaluator: Evaluator, start: Floats, scales: Floats, options: RefitLikelihoodOptions
) -> SamplingDistribution:
    """Return the sampling distribution at the minimiser that observed responses reach from a start."""
    for _ in range(5):
        sampling = SamplingDistribution.of(evaluator, start, scales, options.weakest)
        (x,), (converged,) = sampling.refit(observed_set(evaluator))
        start = sampling.thetas(x)
        if converged and np.abs(x).max(initial=0.0) < 0.5:
            break
    else:
        raise ValueError("got an estimate that does not converge")
    return replace(sampling, theta=start)


def _whitened(
    evaluator: Evaluator,
    continuation: Continuation,
    start: Floats,
    scales: Floats,
    options: RefitLikelihoodOptions,
) -> tuple[Evaluator, Floats]:
    """Return metrics of several outputs with the whitening of the population, and their minimiser."""
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


def _require_stored(evaluator: Evaluator) -> None:
    """Raise if responses are not stored."""
    if not evaluator.nodes:
        raise TypeError("model: got no simulator with a metric, expected one")
    for node in evaluator.nodes:
        if not node.bound.stored:
            raise TypeError(
                f"{node.name}: propagation: got {type(node.propagation).__name__}, expected "
                "prb.Reweighted(), whose stored responses serve all hyperparameters"
            )
