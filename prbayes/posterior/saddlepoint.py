r"""Saddlepoint likelihood of the hyperparameters given a metric's estimate, from stored responses.

The statistic is the metric's gradient at the estimate, the mean of the specimens' scores. Its
density for any theta is a saddlepoint approximation over the weights of the stored responses: no
refit and no synthetic data set. The density of an M-estimating equation at its root follows from
the cumulant function of one specimen's score (Field and Hampel 1982, doi:10.1093/biomet/69.1.29):

.. math:: \log L = N K(a) - \tfrac{1}{2} \log\det N K''(a), \quad
          K(a) = \log \sum_m w_m e^{a' \psi_m}, \quad K'(a) = 0.

Independent simulators add their cumulant functions :math:`N_j K_j(a)` with one tilt :math:`a`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from prbayes._validate import IN_CACHE, ArrayFunction, Arrays, Bools, Floats, Indices
from prbayes.inference.resampling import SETS, aligned, groups, observable
from prbayes.metrics.base import is_additive
from prbayes.metrics.score import (
    ScoreOptions,
    ShiftedResponses,
    WeightSlopes,
    prepared_on_population,
    specimen_scores,
    tabulated_scores,
)
from prbayes.model.evaluator import Evaluator, coarser_evaluator, epsilons, with_targets
from prbayes.model.parameters import THETAS, log_posterior
from prbayes.model.simulator_with_data import number_specimens
from prbayes.numerics.derivatives import cross
from prbayes.numerics.modes import distinct_modes, far_apart, laplace
from prbayes.numerics.threads import one_thread
from prbayes.optimize.design_refinement import noise_floors
from prbayes.optimize.optimum import Optimum, element_order, optima_of


@dataclass(frozen=True)
class SaddlepointOptions:
    """Limits of the Newton iteration and of the density."""

    iterations: int = 40  # largest number of Newton steps
    tolerance: float = 1e-5  # largest gradient by specimen, in standard deviations of the score
    # Smallest determinant of the tilted covariance, to the power of one over its dimension,
    # relative to that at the estimate. Below this limit the tilted distribution is nearly a single
    # atom.
    smallest_variance: float = 1e-4
    # value of the cumulant function below which the density is zero
    smallest_value: float = -1000.0
    # smallest eigenvalue of the correlation matrix of scores that vary
    smallest_eigenvalue: float = 1e-6


@dataclass(frozen=True)
class EstimateLikelihoodOptions:
    """Options of the likelihood given an estimate; steps are in prior standard deviations."""

    score: ScoreOptions = field(default_factory=ScoreOptions)
    saddlepoint: SaddlepointOptions = field(default_factory=SaddlepointOptions)
    # Number of repeated minimisations with whitening and bandwidth of the population at the
    # previous estimate. With zero they are those of the observed data.
    rounds: int = 2
    # number of specimens below which metrics of one output are minimised again as well
    few_specimens: int = 10
    step: float = 1e-5  # step of differences of log weights
    wide_step: float = 0.05  # step of these differences if the support of an input moves
    # step of differences of responses that are computed at each theta
    resimulated_step: float = 1e-3
    # Smallest effective number of stored responses at the point of the score. An estimate at an
    # edge is moved inside until it is reached.
    effective_responses: float = 50.0
    # Distance from the middle of the prior beyond which an element may be at an edge, and the
    # smallest standard deviation of its likelihood score there, relative to the largest of all
    # elements
    distance: float = 3.0
    smallest_spread: float = 1e-4
    # Largest difference of the log mass between the best mode and another that has part of the
    # posterior, and the largest number of such modes
    gap: float = 10.0
    most_modes: int = 4


@dataclass(frozen=True, eq=False)
class EstimateLikelihood:
    """The likelihood given the estimate."""

    evaluator: Evaluator
    # (M, d): point of the score, then other modes. The point is the estimate, or a
    # point inside if the estimate is at an edge.
    starts: Floats
    # scores of each group of simulators that share specimens
    groups: Sequence[StoredScores | ResimulatedScores]
    combinations: Floats  # (d, r): combinations of the scores that vary
    # (d,): unit of `laplace`: a standard deviation of the prior, or a hundred standard errors if
    # these are less. The spread of a very wide prior would be a step past all data.
    scale: Floats
    options: SaddlepointOptions

    @one_thread()
    def log_likelihood(self, thetas: Floats) -> Floats:
        """Return the log-density of the score at the estimate, (S, d) -> (S,)."""
        if self.combinations.shape[1] == 0:
            return np.zeros(len(thetas))
        rows = min(group.rows for group in self.groups)
        blocks = []
        for first in range(0, len(thetas), rows):
            block = thetas[first : first + rows]
            pairs = [group.population(self.evaluator, block) for group in self.groups]
            log_weights, scores = zip(*pairs, strict=True)
            blocks.append(log_density(log_weights, scores, self.options))
        return np.concatenate(blocks)


@dataclass(frozen=True, eq=False)
class StoredScores:
    """Scores of the stored responses of simulators that share specimens."""

    simulator: int  # index of one of the simulators
    is_observable: Bools  # (M,): stored responses that all simulators can observe
    values: Floats  # (M', d): scores of the observable responses
    size: int  # number of observed specimens
    combinations: Floats  # (d, r)
    rows: int  # number of populations whose weights stay in the cache of the processor

    @cached_property
    def scores(self) -> Scores:
        """Combinations of the scores."""
        return Scores(self.values @ self.combinations, self.size)

    def population(self, evaluator: Evaluator, thetas: Floats) -> tuple[Floats, Scores]:
        """Return log weights of populations, (S, M'), and the scores of their responses."""
        _, weights = evaluator.populations(thetas, self.simulator)
        if not self.is_observable.all():
            weights = weights[:, self.is_observable]
            with np.errstate(invalid="ignore"):
                weights /= weights.sum(axis=1, keepdims=True)
        with np.errstate(divide="ignore"):
            return np.log(weights), self.scores


@dataclass(frozen=True, eq=False)
class ResimulatedScores:
    """Scores of responses computed at each theta, of simulators that share specimens."""

    # index, unit and score function of each simulator
    tables: tuple[tuple[int, Floats, ArrayFunction], ...]
    mean: Floats  # (d,): mean of the observed specimens' scores
    size: int  # number of observed specimens
    combinations: Floats  # (d, r)
    rows: int = 1

    def population(self, evaluator: Evaluator, thetas: Floats) -> tuple[Floats, Scores]:
        """Return log weights of one population, (1, M'), and the scores of its responses."""
        values: Any = -self.mean
        is_observable: Any = True
        for k, factor, table in self.tables:
            responses, _ = evaluator.populations(thetas, k)
            values = values + factor * table(responses[0])
            is_observable &= observable(responses[0], evaluator.nodes[k].target)
        count = int(is_observable.sum())
        if not count:
            zeros = np.zeros((1, len(self.mean)))
            return np.full((1, 1), -np.inf), Scores(zeros @ self.combinations, self.size)
        log_weights = np.full((1, count), -np.log(count))
        return log_weights, Scores(values[is_observable] @ self.combinations, self.size)


def estimate_likelihood(
    evaluator: Evaluator,
    optimum: Optimum,
    options: EstimateLikelihoodOptions = EstimateLikelihoodOptions(),
) -> EstimateLikelihood:
    """Return the likelihood of the hyperparameters given the minimiser of their metrics."""
    obstacle = score_obstacle(evaluator)
    if obstacle is not None:
        raise ValueError(f"metric: {obstacle}; expected a refit_likelihood")
    optima = optima_of(optimum, evaluator, comparable=False)
    point = move_inside(evaluator, optima[0], options)
    scales = np.array([optimum.scales[node.name] for node in evaluator.nodes])
    # Minimise again with whitening and bandwidths of the population. Those of few observed
    # specimens would bias the estimate: if the specimens scatter little by chance, the bandwidth is
    # small and the weight in the sum of simulators large.
    nodes = evaluator.nodes
    events = [node.target.event for node in nodes]
    fewest = min(len(node.observed) for node in nodes)
    if any(events) or len(nodes) > 1 or fewest < options.few_specimens:
        for _ in range(options.rounds):
            evaluator, scales, point = _minimised_on_population(evaluator, point, scales, options)
    evaluator = coarser_evaluator(evaluator, point)
    # The unit of an element is a hundred standard errors, or the prior's spread if it is less.
    hyperparameters = evaluator.hyperparameters
    is_stored = [node.bound.stored for node in nodes]
    if all(is_stored):
        n_observed = sum(len(node.observed) for node in nodes)
        precision = _likelihood_spread(evaluator, point, options) * np.sqrt(n_observed)
        scale = 100 / np.maximum(precision, 100) * hyperparameters.prior_sd
    else:
        errors = np.sqrt(np.diag(optimum.covariance))[element_order(optimum, evaluator)]
        scale = np.minimum(100 * errors, hyperparameters.prior_sd)
    likelihood = EstimateLikelihood(
        evaluator=evaluator,
        starts=np.vstack([point, optima[1:]]),
        groups=[],
        combinations=np.empty((0, 0)),
        scale=scale,
        options=options.saddlepoint,
    )
    likelihood = _with_scores(likelihood, point[None], scales, options)
    # Populations at another mode may have a score of zero at the estimate as well. Which of them
    # fits better is then a further statistic.
    modes = further_modes(likelihood, options)
    if not len(modes):
        return likelihood
    minima = [minimiser_near(evaluator, mode, scales) for mode in modes]
    likelihood = _with_scores(likelihood, np.vstack([point, *minima]), scales, options)
    starts = np.vstack([point, modes])
    is_start = np.isfinite(likelihood.log_likelihood(starts))
    return replace(likelihood, starts=starts[is_start])


def further_modes(likelihood: EstimateLikelihood, options: EstimateLikelihoodOptions) -> Floats:
    """Return modes of the posterior given the score, other than the estimate's own, (J, d)."""
    evaluator, starts = likelihood.evaluator, likelihood.starts
    hyperparameters = evaluator.hyperparameters

    def log_density(thetas: Floats) -> Floats:
        return log_posterior(hyperparameters, thetas, likelihood.log_likelihood)

    if not evaluator.responses_per_theta:
        thetas = hyperparameters.prior_points(THETAS, 0)
        order = np.argsort(-log_density(thetas), kind="stable")
        few = far_apart(thetas[order[: THETAS // 4]], 8, hyperparameters.prior_sd)
        starts = np.vstack([starts, few])
    is_start = np.isfinite(log_density(starts))
    if not is_start[0] or is_start.sum() < 2:
        return starts[:0]
    try:
        modes = laplace(log_density, starts[is_start], likelihood.scale)
    except (ValueError, np.linalg.LinAlgError):  # because the density jumps near a start
        return starts[1 : len(likelihood.starts)]
    lowest = max(mode.log_mass for mode in modes if mode.converged or mode is modes[0])
    lowest -= options.gap
    center, *candidates = modes
    far = [m for m in candidates if m.converged and m.log_mass > lowest and center.is_apart(m)]
    further = [mode.mode for mode in distinct_modes(far)[: options.most_modes]]
    return np.array(further).reshape(-1, starts.shape[1])


def _with_scores(
    likelihood: EstimateLikelihood,
    points: Floats,
    scales: Floats,
    options: EstimateLikelihoodOptions,
) -> EstimateLikelihood:
    """Return the likelihood given the score at the first of points, (M, d).

    Further statistics are the differences of the discrepancy between the other points and it.
    """
    evaluator = likelihood.evaluator
    score_groups = [
        _group_scores(evaluator, members, points, scales, options)
        for members in groups(evaluator.nodes)
    ]
    # Find the combinations of the scores that vary in the populations at the point.
    pairs = [group.population(evaluator, points[:1]) for group in score_groups]
    log_weights, scores = zip(*pairs, strict=True)
    untilted = cumulants(log_weights, scores, np.zeros((1, scores[0].values.shape[1])))
    size = sum(score.size for score in scores)
    combinations = varying_combinations(untilted.hessians[0] / size, options.saddlepoint)
    return replace(
        likelihood,
        groups=[replace(group, combinations=combinations) for group in score_groups],
        combinations=combinations,
    )


def _minimised_on_population(
    evaluator: Evaluator, point: Floats, scales: Floats, options: EstimateLikelihoodOptions
) -> tuple[Evaluator, Floats, Floats]:
    """Return metrics that are prepared on the population, with scales and minimiser."""
    targets = []
    for k, node in enumerate(evaluator.nodes):
        responses, weights = evaluator.populations(point[None], k)
        targets.append(prepared_on_population(node.target, responses[0], weights[0]))
    prepared = with_targets(evaluator, targets)
    unset = np.isnan(epsilons(prepared))
    if len(targets) > 1 and unset.any():
        scales = np.where(unset, noise_floors(prepared, point, SETS), scales)
    minimiser = move_inside(prepared, minimiser_near(prepared, point, scales), options)
    sizes = [design["weight_ess"] for design in prepared.support(minimiser[None]).values()]
    is_supported = np.min(sizes, initial=np.inf) >= options.effective_responses
    return prepared, scales, minimiser if is_supported else point


def minimiser_near(evaluator: Evaluator, point: Floats, scales: Floats) -> Floats:
    """Return the minimiser of the objective near a point, (d,)."""
    from scipy.optimize import minimize as scipy_minimize

    prior_sd = evaluator.hyperparameters.prior_sd
    # The tolerance of the optimiser is absolute; discrepancies have the unit of the response.
    nearby = evaluator.total(cross(point, 0.1 * prior_sd), scales)
    nearby = nearby[np.isfinite(nearby)]
    unit = (np.ptp(nearby) if nearby.size else 0.0) or 1.0

    def objective(shift: Floats) -> tuple[float, Floats]:
        center = point + shift * prior_sd
        thetas = cross(center, 1e-4 * prior_sd)
        totals = evaluator.total(thetas, scales) / unit
        d = len(shift)
        up, down = totals[1 : 1 + d], totals[1 + d :]
        return float(totals[0]), (up - down) / 2e-4

    minimum = scipy_minimize(objective, np.zeros(len(point)), jac=True, method="BFGS")
    return np.asarray(point + minimum.x * prior_sd)


def _group_scores(
    evaluator: Evaluator,
    members: Sequence[int],
    points: Floats,
    scales: Floats,
    options: EstimateLikelihoodOptions,
) -> StoredScores | ResimulatedScores:
    """Return the scores of specimens in the sum of their simulators' discrepancies.

    They are those at the first of the points, (M, d). The discrepancies at the others, less that at
    the first one, follow.
    """
    numbers, total = number_specimens(evaluator.nodes)
    nodes = [evaluator.nodes[k] for k in members]
    n = len(nodes[0].observed)
    populations = [_derivatives(evaluator, k, points[0], options, points[1:]) for k in members]
    functions = [
        partial(specimen_scores, node.target, population, options=options.score, total=total)
        for node, population in zip(nodes, populations, strict=True)
    ]
    # The gradient of the objective, in units of the prior, is the sum of these scores over
    # specimens.
    units = np.append(evaluator.hyperparameters.prior_sd, np.ones(len(points) - 1))
    factors = [units / (n * scales[k]) for k in members]
    parts = zip(members, nodes, factors, functions, strict=True)
    observed = sum(
        factor * score(node.observed[np.argsort(numbers[k])]) for k, node, factor, score in parts
    )
    mean = np.mean(observed, axis=0)
    identity = np.eye(len(units))
    if not all(node.bound.stored for node in nodes):
        tables = []
        for k, node, factor, population in zip(members, nodes, factors, populations, strict=True):
            assert isinstance(population, ShiftedResponses)
            table = tabulated_scores(node.target, population, node.observed, options.score, total)
            tables.append((k, factor, table))
        return ResimulatedScores(tuple(tables), mean, n, identity)
    responses = [population.responses for population in populations]
    targets = [node.target for node in nodes]
    is_observable = np.all(list(map(observable, responses, targets)), axis=0)
    stored = -mean + sum(
        factor * score(values[is_observable])
        for factor, score, values in zip(factors, functions, responses, strict=True)
    )
    rows = max(16, IN_CACHE // len(stored))
    return StoredScores(members[0], is_observable, stored, n, identity, rows)


def _derivatives(
    evaluator: Evaluator,
    k: int,
    theta: Floats,
    options: EstimateLikelihoodOptions,
    optima: Floats | None = None,
) -> WeightSlopes | ShiftedResponses:
    """Return the k-th simulator's stored responses with slopes of weights, or shifted responses.

    Other optima, (J, d), add their weights, or their responses as shifts of one.
    """
    bound = evaluator.nodes[k].bound
    step = options.wide_step if bound.support_moves else options.step
    steps = (
        step if bound.stored else options.resimulated_step
    ) * evaluator.hyperparameters.prior_sd
    d = len(theta)
    thetas = cross(theta, steps)
    if optima is not None:
        thetas = np.vstack([thetas, optima])
    responses, weights = evaluator.populations(thetas, k)
    ends = [1, 1 + d, 1 + 2 * d]
    if not bound.stored:
        center, upper, lower, at_optima = np.split(responses, ends)
        count = len(at_optima)
        upper = np.concatenate([upper, at_optima])
        lower = np.concatenate([lower, np.repeat(center, count, axis=0)])
        return ShiftedResponses(center[0], upper, lower, np.append(steps, np.full(count, 0.5)))
    center, up, down, at_optima = np.split(weights, ends)
    # Difference the log weights, which are nearly parabolas, so that central differences are
    # accurate at any step. Difference the weights themselves where one vanishes within the step.
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = center * (np.log(up) - np.log(down))
    differences = np.where(np.isfinite(relative), relative, up - down)
    return WeightSlopes(responses[0], center[0], differences / (2 * steps)[:, None], at_optima)


def move_inside(evaluator: Evaluator, theta: Floats, options: EstimateLikelihoodOptions) -> Floats:
    """Return the estimate, (d,), or a point towards the middle of the prior if it is at an edge."""
    hyperparameters = evaluator.hyperparameters
    direction = np.median(hyperparameters.prior_points(256, 0), axis=0) - theta
    is_far = np.abs(direction) > options.distance * hyperparameters.prior_sd
    direction[~is_far] = 0
    if not is_far.any() and not evaluator.reweighted:
        return theta
    for fraction in np.linspace(0, 1, 33):
        point = theta + fraction * direction
        spread = _likelihood_spread(evaluator, point, options)
        is_at_edge = is_far & (spread < options.smallest_spread * spread.max())
        support = evaluator.support(point[None])
        sizes = [design["weight_ess"] for design in support.values()]
        effective = np.min(sizes, initial=np.inf)
        if not is_at_edge.any() and effective >= options.effective_responses:
            return point
    return theta


def _likelihood_spread(
    evaluator: Evaluator, theta: Floats, options: EstimateLikelihoodOptions
) -> Floats:
    """Return changes of the populations over a prior standard deviation, (d,).

    The changes are those of log weights, or of responses in units of their standard deviation.
    """
    variance = np.zeros(len(theta))
    for k in range(len(evaluator.nodes)):
        population = _derivatives(evaluator, k, theta, options)
        variance += population.spread**2
    return np.sqrt(variance) * evaluator.hyperparameters.prior_sd


def score_obstacle(evaluator: Evaluator) -> str | None:
    """Return why the gradient of the objective is no mean over specimens, or None."""
    for node in evaluator.nodes:
        if not is_additive(node.target):
            metric = type(node.metric).__name__
            return f"{node.name} has a {metric}, whose gradient is no mean over specimens"
        if np.ptp(node.target.weights) > 1e-12:
            return f"{node.name} has observed responses of unequal weights"
    numbers, _ = number_specimens(evaluator.nodes)
    for members in groups(evaluator.nodes):
        expected = np.unique(numbers[members[0]])
        is_same = [np.array_equal(np.sort(numbers[k]), expected) for k in members]
        nodes = [evaluator.nodes[k] for k in members]
        if not all(is_same) or not aligned(nodes):
            names = ", ".join(node.name for node in nodes)
            return f"{names} share specimens in part, or have other inputs or designs"
    return None


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of stored responses, (M, r), less the mean over the ``size`` observed specimens."""

    values: Floats
    size: int

    @cached_property
    def powers(self) -> Floats:
        """Ones, scores and products of two scores, (1 + r + r (r + 1) / 2, M)."""
        scores = self.values.T
        first, second = np.triu_indices(len(scores))
        ones = np.ones((1, scores.shape[1]))
        return np.concatenate([ones, scores, scores[first] * scores[second]])


class Cumulants(NamedTuple):
    """The cumulant function at S tilts, (S,), with gradients, (S, r), and Hessians, (S, r, r)."""

    values: Floats
    gradients: Floats
    hessians: Floats


# function of tilts, (A, r), and the rows that they belong to, (A,), that returns their cumulants
CumulantFunction = Callable[[Floats, Indices], Cumulants]


def cumulants(log_weights: Arrays, scores: Sequence[Scores], tilts: Floats) -> Cumulants:
    """Return the sum of N_j K_j(a) over simulators at tilts, (S, r), given log weights (S, M_j)."""
    count, r = tilts.shape
    values = np.zeros(count)
    gradients = np.zeros((count, r))
    hessians = np.zeros((count, r, r))
    first, second = np.triu_indices(r)
    for logs, score in zip(log_weights, scores, strict=True):
        exponents = tilts @ score.powers[1 : 1 + r]
        exponents += logs
        largest = exponents.max(axis=1)
        exponents -= largest[:, None]
        weights = np.exp(exponents, out=exponents)
        # The product with the smaller matrix first takes half of the time.
        sums = (score.powers @ weights.T).T
        totals = sums[:, :1]
        means, products = np.split(sums[:, 1:] / totals, [r], axis=1)
        values += score.size * (np.log(totals[:, 0]) + largest)
        gradients += score.size * means
        hessians[:, first, second] += score.size * (products - means[:, first] * means[:, second])
    hessians[:, second, first] = hessians[:, first, second]
    return Cumulants(values, gradients, hessians)


def saddlepoint_density(
    function: CumulantFunction, shape: tuple[int, int], size: int, options: SaddlepointOptions
) -> Floats:
    """Return the log-density of a mean of zero, up to a constant, (S,), from cumulant functions.

    The S convex functions of r tilts are minimised by Newton steps no longer than 1 + |a|, which
    are shortened where a function would rise. ``size`` is the number of observed specimens. The
    density is -inf without a saddlepoint: then zero is outside of the convex hull of the scores.
    """
    count, r = shape
    ridge = 1e-8 * size * np.eye(r)
    tilts = np.zeros(shape)
    damping = np.ones(count)
    state = function(tilts, np.arange(count))
    limit = options.tolerance * size
    converged = np.linalg.norm(state.gradients, axis=1) < limit
    for _ in range(options.iterations):
        # Leave out functions without a minimum, whose values fall without end.
        rows = np.flatnonzero(~converged & (state.values > options.smallest_value))
        if rows.size == 0:
            break
        steps = np.linalg.solve(state.hessians[rows] + ridge, state.gradients[rows, :, None])
        steps = steps[:, :, 0]
        lengths = np.linalg.norm(steps, axis=1)
        longest = 1 + np.linalg.norm(tilts[rows], axis=1)
        factors = damping[rows] * longest / np.maximum(lengths, longest)
        trials = tilts[rows] - steps * factors[:, None]
        new = function(trials, rows)
        falls = new.values <= state.values[rows] + 1e-9 * size
        damping[rows] = np.where(falls, np.minimum(2 * damping[rows], 1), damping[rows] / 4)
        rows = rows[falls]
        tilts[rows] = trials[falls]
        state.values[rows] = new.values[falls]
        state.gradients[rows] = new.gradients[falls]
        state.hessians[rows] = new.hessians[falls]
        converged[rows] = np.linalg.norm(new.gradients[falls], axis=1) < limit
    signs, log_dets = np.linalg.slogdet(state.hessians / size)
    is_usable = converged & (signs > 0) & (log_dets > r * np.log(options.smallest_variance))
    return np.where(is_usable, state.values - log_dets / 2, -np.inf)


def log_density(
    log_weights: Sequence[Floats],
    scores: Sequence[Scores],
    options: SaddlepointOptions = SaddlepointOptions(),
) -> Floats:
    """Return the log-density of a mean score of zero, (S,), given log weights (S, M_j)."""
    result = np.full(len(log_weights[0]), -np.inf)
    is_supported = np.all([np.isfinite(logs.max(axis=1)) for logs in log_weights], axis=0)
    if not is_supported.any():
        return result
    supported = [logs[is_supported] for logs in log_weights]

    def function(tilts: Floats, rows: Indices) -> Cumulants:
        return cumulants([logs[rows] for logs in supported], scores, tilts)

    shape = len(supported[0]), scores[0].values.shape[1]
    size = sum(score.size for score in scores)
    result[is_supported] = saddlepoint_density(function, shape, size, options)
    return result


def varying_combinations(covariance: Floats, options: SaddlepointOptions) -> Floats:
    """Return the standardised combinations of scores that vary, (d, r), by their covariance.

    A hyperparameter without influence has a score of zero, and two that only act together have
    proportional scores. Neither enters the density, so that their posterior is their prior given
    the optima.
    """
    tolerance = options.smallest_eigenvalue
    spread = np.sqrt(np.diag(covariance))
    if not spread.max() > 0:
        return np.zeros((len(spread), 0))
    varies = spread > tolerance * spread.max()
    scaling = np.diag(1 / np.where(varies, spread, 1.0))[:, varies]
    eigenvalues, vectors = np.linalg.eigh(scaling.T @ covariance @ scaling)
    is_large = eigenvalues > tolerance
    return scaling @ (vectors[:, is_large] / np.sqrt(eigenvalues[is_large]))
