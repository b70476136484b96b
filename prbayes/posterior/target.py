r"""Posterior density: priors and a log-likelihood, by specimen or given the estimate.

Without scores, the likelihood given the estimate comes from refits of synthetic data sets. These
are drawn once from stored responses, at points :math:`\theta_r` around the estimate, and refitted
once. The balance heuristic weights them under any theta (Veach and Guibas 1995,
doi:10.1145/218380.218498):

.. math:: W_r(\theta) \propto \frac{p(data_r | \theta)}{\sum_s p(data_r | \theta_s)}.

The density of the observed estimate is a saddlepoint approximation over the weighted estimates. Its
cumulant function is mixed with that of a normal distribution in the tail (Fasiolo et al. 2018,
doi:10.1214/18-EJS1433).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import csr_array, vstack
from scipy.special import ndtri

from prbayes._finding import Findings
from prbayes._stats import log_sum_exp
from prbayes._validate import IN_CACHE, Bools, Floats, Indices, complete_rows
from prbayes.inference.checks.prior import conflict_findings
from prbayes.inference.prior_continuation import Continuation, ContinuedEvaluator, continuation_of
from prbayes.inference.refits import (
    SamplingDistribution,
    needs_refits,
    objectives,
    refit,
    summary_obstacle,
)
from prbayes.inference.resampling import groups, observable, observed_set, sets_along
from prbayes.metrics.score import prepared_on_population
from prbayes.model.evaluator import (
    TOLERABLE,
    Evaluator,
    epsilons,
    supports_each,
    with_targets,
)
from prbayes.model.parameters import THETAS, log_posterior
from prbayes.model.specimen_preparation import prepared
from prbayes.numerics.modes import Laplace, LogDensity, far_apart, laplace, modes_each, of_one
from prbayes.numerics.points import sobol
from prbayes.numerics.threads import one_thread
from prbayes.optimize.optimum import Optimum, element_order, optima_of
from prbayes.posterior.importance import importance_sample
from prbayes.posterior.saddlepoint import (
    Cumulants,
    EstimateLikelihood,
    SaddlepointOptions,
    Scores,
    cumulants,
    estimate_likelihood,
    saddlepoint_density,
    score_obstacle,
)

# what works where the density of an estimate is not known
_REMEDY = (
    "use prb.LogLikelihood(), or draw from the discrepancy with prb.sample_smc(adjustment=None)"
)


@dataclass(frozen=True, eq=False)
class Target:
    """A posterior density in unconstrained space."""

    evaluator: Evaluator
    log_likelihood: LogDensity  # sum of all terms except the priors
    starts: Floats  # (M, d): points near the modes
    scale: Floats  # (d,): unit of each element for `laplace`
    # log-likelihoods, each without a block of the synthetic data sets; none without refits
    without_blocks: Sequence[LogDensity] = ()

    def errors_of_shares(self, modes: Floats, shares: Floats) -> Floats:
        """Return jackknife standard errors, (M,), of shares of modes, (M, d), because of refits.

        Without a block of the data sets a share changes as the density at its mode does.
        """
        if not self.without_blocks:
            return np.zeros(len(shares))
        changes = np.array([block(modes) for block in self.without_blocks])
        weights = shares * np.exp(changes - changes.mean(axis=0))
        replicates = weights / weights.sum(axis=1, keepdims=True)
        return np.asarray(np.sqrt((len(changes) - 1) * replicates.var(axis=0)))

    def log_posterior(self, thetas: Floats) -> Floats:
        """Return the unnormalised log-density, (S, d) -> (S,); -inf where it is not known."""
        return log_posterior(self.evaluator.hyperparameters, thetas, self.log_likelihood)


def specimen_target(evaluator: Evaluator, optimum: Optimum | None) -> Target:
    """Return the posterior of a model whose simulators have a log-likelihood by specimen."""
    from scipy.spatial import cKDTree

    prior_sd = evaluator.hyperparameters.prior_sd
    if optimum is not None:
        return Target(evaluator, evaluator.log_other, optima_of(optimum, evaluator), prior_sd)
    target = Target(evaluator, evaluator.log_other, np.empty((0, len(prior_sd))), prior_sd)
    thetas = evaluator.hyperparameters.prior_points(1024, 0)
    starts = [specimen_starts(thetas, target.log_posterior(thetas), prior_sd)]
    # Points of the prior may miss the modes of narrow populations.
    for likelihood in evaluator.likelihoods:
        draws = prepared(likelihood).thetas
        # In units of the distances within modes, which are far less than those between them.
        _, near = cKDTree(draws / prior_sd).query(draws / prior_sd, min(16, len(draws)))
        within = np.abs(draws[near[:, 1:]] - draws[:, None])
        unit = np.median(within, axis=(0, 1)) + 1e-3 * prior_sd
        starts.append(far_apart(draws, 8, unit))
    return replace(target, starts=np.concatenate(starts))


def specimen_starts(thetas: Floats, log_p: Floats, unit: Floats) -> Floats:
    """Return eight of the thetas, (n, d), from their likeliest quarter; far apart in a unit."""
    order = np.argsort(-log_p, kind="stable")
    return far_apart(thetas[order[: len(thetas) // 4]], 8, unit)


def estimate_target(evaluator: Evaluator, optimum: Optimum) -> Target:
    """Return the posterior given the metrics' own estimate, by scores or refits, or raise.

    For data sheets the log-density of the metric is the likelihood.
    """
    require_density(evaluator)
    if summary_obstacle(evaluator) is not None:

        def log_likelihood(thetas: Floats) -> Floats:
            return evaluator(thetas).log_likelihood(epsilons(evaluator))

        prior_sd = evaluator.hyperparameters.prior_sd
        return Target(evaluator, log_likelihood, optima_of(optimum, evaluator), prior_sd)
    is_mean = score_obstacle(evaluator) is None
    likelihood_of = estimate_likelihood if is_mean else refit_likelihood
    return _target_of(likelihood_of(evaluator, optimum))


def posterior_target(evaluator: Evaluator, optimum: Optimum | None) -> Target:
    """Return the posterior given the metrics' estimate, or that of log-likelihoods by specimen."""
    if not evaluator.nodes:
        return specimen_target(evaluator, optimum)
    assert optimum is not None
    return estimate_target(evaluator, optimum)


def modes_of(log_density: LogDensity, starts: Floats, scale: Floats) -> list[Laplace] | None:
    """Return Laplace approximations of the modes, None if the density jumps at a start."""
    try:
        (modes,) = modes_each(of_one(log_density), [starts], scale)
    except (ValueError, np.linalg.LinAlgError):
        return None
    return modes or None


def _target_of(likelihood: EstimateLikelihood | RefitLikelihood) -> Target:
    """Return the posterior of a likelihood given the estimate, with the model's other terms."""
    evaluator = likelihood.evaluator

    def log_likelihood(thetas: Floats) -> Floats:
        return likelihood.log_likelihood(thetas) + evaluator.log_other(thetas)

    blocks = []
    if isinstance(likelihood, RefitLikelihood) and likelihood.counts:
        blocks = [likelihood.without_block(block, 8).log_likelihood for block in range(8)]
    return Target(evaluator, log_likelihood, likelihood.starts, likelihood.scale, blocks)


def require_density(evaluator: Evaluator) -> None:
    """Raise if the density of the metrics' estimate is not known."""
    is_sheet = [node.metric.exact_likelihood for node in evaluator.nodes]
    if all(is_sheet):
        return
    if any(is_sheet):
        name = evaluator.nodes[is_sheet.index(True)].name
        raise ValueError(
            f"{name}: observed: got a prb.Summary in a model with a metric of distributions, "
            "expected prb.LogLikelihood() for the specimens of other simulators: leave their "
            "metric= out, or use prb.sample_smc with adjustment=None"
        )
    obstacle = score_obstacle(evaluator)
    for node in evaluator.nodes:
        if node.bound.random:
            reason = "its discrepancy is random"
            expected = "prb.Reweighted() or prb.Resimulated()"
        elif obstacle is not None and not node.bound.stored:
            reason = obstacle
            expected = "prb.Reweighted(), whose stored responses can be refitted"
        else:
            continue
        raise ValueError(
            f"{node.name}: propagation: got {type(node.propagation).__name__}, with which the "
            f"distribution of the estimate is not known ({reason}); expected {expected}, or "
            "prb.sample_smc with adjustment=None, whose draws are as wide as epsilon "
            "makes them"
        )


def prior_conflicts(optimum: Optimum, evaluator: Evaluator, thetas: Floats) -> Findings:
    """Report hyperparameters whose prior pulls the posterior thetas from the estimate."""
    size = 4096
    comparable = [mode["comparable"] for mode in optimum.local_optima]
    if optimum.search.prior or any(comparable):
        return ()
    order = element_order(optimum, evaluator)
    covariance = optimum.covariance[np.ix_(order, order)]
    is_identified = np.isfinite(np.diag(covariance))
    if not is_identified.any():
        return ()
    within = covariance[np.ix_(is_identified, is_identified)]
    prior = evaluator.hyperparameters.prior_thetas(size, 0)[:, is_identified]
    rng = np.random.default_rng(5)
    errors = rng.multivariate_normal(np.zeros(len(within)), within, size, method="eigh")
    names = np.array(evaluator.hyperparameters.readable_names)[is_identified]
    return conflict_findings(
        names.tolist(),
        prior,
        optimum.theta[order][is_identified],
        np.sqrt(np.diag(within)),
        thetas.reshape(-1, evaluator.hyperparameters.size)[:, is_identified].mean(axis=0),
        prior + errors,
    )


@dataclass(frozen=True)
class RefitLikelihoodOptions:
    """Options of the likelihood given an estimate, from refits."""

    n_sets: int = 1024  # number of synthetic data sets
    # Number of rounds that share the data sets. The first round draws in a ball of ``radius``
    # standard errors around the estimate, later rounds from the previous posterior, ``inflation``
    # times wider.
    rounds: int = 2
    radius: float = 4.0
    inflation: float = 1.5
    # largest standard error of an identified direction, in prior standard deviations
    weakest: float = 10.0
    # Standard error, in prior standard deviations, above which an estimate may be near an edge.
    # Estimates of data sets pile up there, as at a standard deviation of zero.
    weak: float = 0.5
    # Squared distance of the observed estimate from its mean, in standard deviations, at which the
    # normal distribution takes over.
    tail: float = 40.0
    # Number of data sets, for each element of the estimate and one more, that the standard error
    # weighs in the moments
    prior_sets: float = 1.0
    reach: float = 10.0  # largest distance of an estimate from the observed one, in standard errors
    # Largest share of estimates beyond the reach. The rest, 256 by default, decides on the density.
    far: float = 0.75
    converged: float = 0.9  # smallest share of refits that converge
    # Number of repeated minimisations of metrics of several outputs, whitened by the population at
    # the previous estimate
    whitenings: int = 2
    seed: int = 0
    saddlepoint: SaddlepointOptions = field(default_factory=SaddlepointOptions)


@dataclass(frozen=True, eq=False)
class RefitLikelihood:
    """The likelihood given the estimate, for `importance_sample` and `laplace`."""

    evaluator: Evaluator
    # sampling distributions at the estimate and at optima that are as good, in coordinates of the
    # continuation
    centers: tuple[SamplingDistribution, ...]
    continuation: Continuation
    starts: Floats  # (M, d): thetas of the centers, moved within the ends of the prior
    scale: Floats  # (d,): unit of each element for `laplace`
    options: RefitLikelihoodOptions
    # Synthetic data sets, none if the data identify nothing: numbers of specimens at the stored
    # responses, (R, M_j) by group; estimates in coordinates of the first center, and the
    # standardised differences of the discrepancy between the other centers and it, (R', r), of the
    # data sets with an estimate near the observed one; which these are, (R,); and log-densities in
    # the mixture of all populations, (R,)
    counts: tuple[csr_array, ...] = ()
    estimates: Floats = field(default_factory=lambda: np.empty((0, 0)))
    is_near: Bools = field(default_factory=lambda: np.empty(0, dtype=bool))
    log_mixture: Floats = field(default_factory=lambda: np.empty(0))

    def without_block(self, block: int, number: int) -> RefitLikelihood:
        """Return the likelihood without one of a number of blocks of the synthetic data sets."""
        is_kept = np.arange(len(self.is_near)) % number != block
        return replace(
            self,
            counts=tuple(count[is_kept] for count in self.counts),
            estimates=self.estimates[is_kept[self.is_near]],
            is_near=self.is_near[is_kept],
            log_mixture=self.log_mixture[is_kept],
        )

    @one_thread()
    def log_likelihood(self, thetas: Floats) -> Floats:
        """Return the log-density of the observed estimate, (S, d) -> (S,)."""
        result = np.zeros(len(thetas))
        if not self.counts:
            return result
        sampling = self.centers[0]
        x = sampling.coordinates(self.continuation.coordinates(thetas))
        largest = max(count.shape[1] for count in self.counts)
        rows = max(16, IN_CACHE // max(largest, len(self.estimates)))
        for first in range(0, len(x), rows):
            block = x[first : first + rows]
            # logs: log weights of the data sets, up to a constant of each row
            logs = _log_likelihoods(sampling, self.counts, block) - self.log_mixture
            near = logs[:, self.is_near]
            is_supported = np.isfinite(near).any(axis=1)
            values = np.full(len(block), -np.inf)
            if is_supported.any():
                logs, near = logs[is_supported], near[is_supported]
                shifts = nearest(self.centers, sampling.thetas(block[is_supported]))[1]
                values[is_supported] = extended_log_density(
                    near, self.estimates, shifts, self.options
                )
                # The density near the observed estimate is that of the estimates there times their
                # probability. Others are at an edge or another optimum.
                values[is_supported] += log_sum_exp(near) - log_sum_exp(logs)
            result[first : first + rows] = values
        return result


def nearest(centers: Sequence[SamplingDistribution], thetas: Floats) -> tuple[Indices, Floats]:
    """Return the nearest center of each theta, (S,), and coordinates around it, (S, r)."""
    x = np.stack([center.coordinates(thetas) for center in centers])
    index = np.linalg.norm(x, axis=2).argmin(axis=0)
    return index, x[index, np.arange(len(thetas))]


def extended_log_density(
    log_weights: Floats, estimates: Floats, shifts: Floats, options: RefitLikelihoodOptions
) -> Floats:
    """Return the log-density of an estimate of zero, (S,), given log weights (S, R) of estimates.

    The weights are known up to a factor. The last columns of estimates may be further statistics.

    The cumulant function is that of the weighted estimates, mixed with that of a normal
    distribution with their moments. A few data sets with a scatter of one standard error are added
    to the moments, in case few of the synthetic ones have weights. ``shifts``, (S, r), are the
    populations relative to the observed estimate, without further statistics.
    """
    r = estimates.shape[1]
    scores = [Scores(estimates, 1)]
    untilted = cumulants([log_weights], scores, np.zeros((len(shifts), r)))
    log_weights = log_weights - untilted.values[:, None]  # so that the weights sum to one
    effective = 1 / np.exp(2 * log_weights).sum(axis=1)
    part = effective / (effective + options.prior_sets * (r + 1))
    # Scale the mean to the distance of the population where that is beyond all data sets.
    lengths = np.linalg.norm(untilted.gradients, axis=1)
    ratios = np.linalg.norm(shifts, axis=1) / np.maximum(lengths, 1e-300)
    factors = np.maximum(ratios, 1) ** (1 - part)
    mean = factors[:, None] * untilted.gradients
    covariance = part[:, None, None] * untilted.hessians
    covariance += (1 - part)[:, None, None] * np.eye(r)
    standardised = np.linalg.solve(covariance, mean[:, :, None])[:, :, 0]
    distance = (mean * standardised).sum(axis=1)
    share = part * np.exp(-distance / options.tail)

    def function(tilts: Floats, rows: Indices) -> Cumulants:
        empirical = cumulants([log_weights[rows]], scores, tilts)
        center, within = mean[rows], covariance[rows]
        linear = np.einsum("skl,sl->sk", within, tilts)
        values = (center * tilts).sum(axis=1)
        values += (linear * tilts).sum(axis=1) / 2
        normal = values, center + linear, within
        mixed = []
        for of_sets, of_normal in zip(empirical, normal, strict=True):
            ones = [1] * (of_sets.ndim - 1)
            weight = share[rows].reshape(-1, *ones)
            mixed.append(weight * of_sets + (1 - weight) * of_normal)
        return Cumulants(*mixed)

    logs = saddlepoint_density(function, (len(shifts), r), 1, options.saddlepoint)
    log_det = np.linalg.slogdet(covariance)[1]
    of_normal = -(distance + log_det) / 2
    return np.where(np.isfinite(logs), logs, of_normal)


def refit_likelihood(
    evaluator: Evaluator,
    optimum: Optimum,
    options: RefitLikelihoodOptions = RefitLikelihoodOptions(),
) -> RefitLikelihood:
    """Return the likelihood given the minimiser of any metrics, from refits, or raise."""
    if optimum.search.at_edge:
        raise ValueError(_at_edge(", ".join(optimum.search.at_edge)))
    thetas = optima_of(optimum, evaluator)
    scales = np.array([optimum.scales[node.name] for node in evaluator.nodes])
    continuation = continuation_of(evaluator, thetas[:1])
    start, *rest = continuation.coordinates(thetas)
    has_several_outputs = any(node.target.event for node in evaluator.nodes)
    for _ in range(options.whitenings if has_several_outputs else 0):
        evaluator = whitened_at(evaluator, continuation, start)
        continued = _continued(evaluator, continuation)
        start = _at_minimiser(continued, start, scales, options).theta
    continued = _continued(evaluator, continuation)
    sampling = _at_minimiser(continued, start, scales, options)
    inside = _moved_inside(sampling, options)
    is_linear = inside is not None
    if inside is not None:
        sampling, rest = inside, []
    local = [SamplingDistribution.of(continued, x, scales, options.weakest) for x in rest]
    centers = [sampling, *(c for c in local if c.stderr.size == sampling.stderr.size)]
    sampling = centers[0] = _moved_to_minimiser(centers[0], is_linear=is_linear)
    likelihood = RefitLikelihood(
        evaluator=evaluator,
        centers=tuple(centers),
        continuation=continuation,
        starts=continuation.within(np.array([center.theta for center in centers]), margin=0.05),
        scale=element_units(sampling, continuation) * evaluator.hyperparameters.prior_sd,
        options=options,
    )
    r = sampling.stderr.size
    if not r:
        return likelihood
    # Draw data sets in balls around the centers first, then around the posterior given these.
    number = options.n_sets // options.rounds
    balls = [
        sampling.coordinates(center.thetas(_points_of_ball(number // len(centers), r, options, i)))
        for i, center in enumerate(centers)
    ]
    x = np.concatenate(balls)
    drawn = []
    for i in range(options.rounds):
        if i:
            x = _posterior_points(likelihood, number)
        drawn.append(_draw(centers, x, options, seed=i, is_linear=is_linear))
        populations, counts, estimates = zip(*drawn, strict=True)
        joined = tuple(vstack(parts, format="csr") for parts in zip(*counts, strict=True))
        logs = _log_likelihoods(sampling, joined, np.concatenate(populations))
        near, is_near = near_statistics(np.concatenate(estimates), r, sampling.noise)
        likelihood = replace(
            likelihood,
            counts=joined,
            estimates=near,
            is_near=is_near,
            log_mixture=log_sum_exp(logs.T),
        )
    return likelihood


def element_units(sampling: SamplingDistribution, continuation: Continuation) -> Floats:
    """Return the unit of each element of theta, (d,), in prior standard deviations.

    It is a prior standard deviation, or a hundred standard errors if these are less.
    """
    errors = np.sqrt(((sampling.axes * sampling.stderr) ** 2).sum(axis=1))
    is_known = ~continuation.is_continued & (errors > 0)
    return np.where(is_known, np.minimum(100 * errors, 1), 1.0)


def whitened_at(evaluator: Evaluator, continuation: Continuation, x: Floats) -> Evaluator:
    """Return an evaluator whose metrics of several outputs are whitened by the population at x.

    These are coordinates of the continuation, (d,), such as the last minimiser.
    """
    continued = _continued(evaluator, continuation)
    targets = [node.target for node in evaluator.nodes]
    for k, target in enumerate(targets):
        if target.event:
            responses, weights = continued.populations(x[None], k)
            targets[k] = prepared_on_population(target, responses[0], weights[0])
    return with_targets(evaluator, targets)


def near_statistics(statistics: Floats, r: int, noise: float) -> tuple[Floats, Bools]:
    """Return the statistics of data sets whose estimate is near the observed one, and which are.

    Which center fits a data set better is a statistic beside the r coordinates of the estimate.
    Without it populations at another optimum would count like those at the best, however much worse
    they fit.
    """
    is_near = complete_rows(statistics)
    estimates, differences = np.split(statistics[is_near], [r], axis=1)
    spread = differences.std(axis=0)
    # A difference below a tenth of the noise comes from the stored responses.
    varies = spread > 0.1 * noise
    return np.hstack([estimates, differences[:, varies] / spread[varies]]), is_near


def _points_of_ball(number: int, r: int, options: RefitLikelihoodOptions, shift: int = 0) -> Floats:
    """Return evenly spread points of a ball around the estimate, (number, r)."""
    u = sobol(number, r + 1, options.seed + shift)
    directions = ndtri(u[:, :r])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.asarray(options.radius * u[:, r:] ** (1 / r) * directions)


def _posterior_points(likelihood: RefitLikelihood, number: int) -> Floats:
    """Return coordinates of draws from the posterior, spread out around each optimum, (n, r)."""
    options, target = likelihood.options, _target_of(likelihood)
    modes = laplace(target.log_posterior, target.starts, target.scale)
    sample = importance_sample(target.log_posterior, modes, number, options.seed)
    thetas = likelihood.continuation.coordinates(sample.draws)
    x = likelihood.centers[0].coordinates(thetas)
    center_of, _ = nearest(likelihood.centers, thetas)
    for i in np.unique(center_of):
        members = center_of == i
        median = np.median(x[members], axis=0)
        x[members] = median + options.inflation * (x[members] - median)
    return x


def _draw(
    centers: Sequence[SamplingDistribution],
    x: Floats,
    options: RefitLikelihoodOptions,
    seed: int,
    *,
    is_linear: bool,
) -> tuple[Floats, list[csr_array], Floats]:
    """Draw and refit data sets at coordinates, (R, r).

    Returns these, counts, and statistics, (R, r + C - 1): estimates, which are NaN where they are
    far, and the discrepancy at the other centers less that at the first one, less the same for the
    observed responses.
    """
    sampling = centers[0]
    evaluator = sampling.evaluator
    thetas = sampling.thetas(x)
    is_supported = np.ones(len(thetas), dtype=bool)
    for name, support in evaluator.support(thetas).items():
        bound = evaluator.reweighted[name]
        is_supported &= supports_each(support, bound.required_ess, bound.max_lost, TOLERABLE)
    if is_supported.mean() < 0.5:
        raise ValueError(
            f"got stored responses that support {is_supported.mean():.0%} of the populations "
            f"around the estimate, expected at least half; widen the prior, or {_REMEDY}"
        )
    x, thetas = x[is_supported], thetas[is_supported]
    rng = np.random.default_rng([options.seed, seed])
    data, counts = sets_along(evaluator, thetas, rng)
    # With several centers start from the first one, because populations at another optimum have
    # their estimates near it.
    starts = x if len(centers) == 1 else np.zeros_like(x)
    if is_linear:
        estimates = sampling.linear_estimates(data)
        estimates -= sampling.linear_estimates(observed_set(evaluator))
        converged = np.ones(len(estimates), dtype=bool)
    else:
        estimates, converged = refit(sampling, data, starts, is_rough=True)
    is_far = np.abs(estimates).max(axis=1) > options.reach
    if is_far.mean() > options.far:
        raise ValueError(_at_edge(f"{is_far.mean():.0%} of the estimates of synthetic data sets"))
    estimates[is_far] = np.nan
    converged |= is_far
    if converged.mean() < options.converged:
        raise ValueError(
            f"got {int(converged.sum())} of {converged.size} refits that converged, expected at "
            f"least {options.converged:.0%}; {_REMEDY}"
        )
    if len(centers) > 1:
        at = np.array([center.theta for center in centers])
        totals = objectives(sampling, data, at) - objectives(sampling, observed_set(evaluator), at)
        estimates = np.hstack([estimates, totals[:, 1:] - totals[:, :1]])
    return x[converged], [count[converged] for count in counts], estimates[converged]


def _log_likelihoods(
    sampling: SamplingDistribution, counts: tuple[csr_array, ...], x: Floats
) -> Floats:
    """Return log p(data_r | theta) at coordinates, (S, R)."""
    evaluator = sampling.evaluator
    thetas = sampling.thetas(x)
    total = np.zeros((len(x), counts[0].shape[0]))
    for members, count in zip(groups(evaluator.nodes), counts, strict=True):
        is_observable = np.ones(count.shape[1], dtype=bool)
        for k in members:
            responses, weights = evaluator.populations(thetas, k)
            is_observable &= observable(responses[0], evaluator.nodes[k].target)
        rows = np.where(is_observable, weights, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.log(rows / rows.sum(axis=1, keepdims=True))
        total += (count @ np.ascontiguousarray(logs.T)).T
    return total


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
        start = moved.theta
        if np.abs(sampling.coordinates(start)).max(initial=0.0) < 0.5:
            return moved
    raise ValueError(
        "got an estimate that still moves by half a standard error when it is minimised again, "
        f"expected a minimum; {_REMEDY}"
    )


def _moved_to_minimiser(
    sampling: SamplingDistribution, *, is_linear: bool = False
) -> SamplingDistribution:
    """Return the sampling distribution with the minimiser for the observed responses as theta."""
    observed = observed_set(sampling.evaluator)
    (x,) = sampling.linear_estimates(observed) if is_linear else refit(sampling, observed)[0]
    return replace(sampling, theta=sampling.thetas(x))


def _moved_inside(
    sampling: SamplingDistribution, options: RefitLikelihoodOptions
) -> SamplingDistribution | None:
    """Return the distribution at a point inside if the estimate is near an edge, else None.

    Near an edge, as where a standard deviation is about zero, estimates pile up and have no
    density. One linear step from a point inside has a density, because it may pass the edge.
    """
    evaluator, scales, theta = sampling.evaluator, sampling.scales, sampling.theta
    if needs_refits(evaluator):
        return None
    median = np.median(evaluator.hyperparameters.prior_points(THETAS, 0), axis=0)
    weak = SamplingDistribution.of(evaluator, theta, scales, options.weak)
    hidden = weak.local.unidentified
    if not hidden.size:
        return None
    shift = (median - theta) / weak.local.prior_sd
    step = hidden @ (hidden.T @ shift) * weak.local.prior_sd
    points = theta + np.linspace(0, 1, 9)[1:, None] * step
    at_median = SamplingDistribution.of(evaluator, points[-1], scales, options.weak)
    if at_median.stderr.size <= weak.stderr.size:
        return None
    for point in points[:-1]:
        inside = SamplingDistribution.of(evaluator, point, scales, options.weak)
        if inside.stderr.size >= at_median.stderr.size:
            return inside
    return at_median


def _at_edge(subject: str) -> str:
    return (
        f"got {subject} at an edge, such as a standard deviation of zero, where estimates have no "
        f"density; {_REMEDY}"
    )
