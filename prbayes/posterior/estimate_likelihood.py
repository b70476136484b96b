"""Likelihood of the hyperparameters given a metric's estimate, from stored responses.

The statistic is the metric's gradient at the estimate, the mean of the specimens' scores. Its
density for any theta is a saddlepoint approximation over the weights of the stored responses: no
refit and no synthetic data set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import IN_CACHE, Floats
from prbayes._threads import one_thread
from prbayes.estimate.data_sets import aligned, groups, observable, specimens
from prbayes.estimate.optimum import Optimum
from prbayes.metrics.score import (
    ScoreOptions,
    WeightSlopes,
    prepared_on_population,
    specimen_scores,
)
from prbayes.model.evaluator import Evaluator
from prbayes.posterior.saddlepoint import (
    SaddlepointOptions,
    Scores,
    cumulants,
    log_density,
    varying_combinations,
)


@dataclass(frozen=True)
class EstimateLikelihoodOptions:
    """Options of the likelihood given an estimate.

    Attributes
    ----------
    score : ScoreOptions
    saddlepoint : SaddlepointOptions
    rounds : int
        Times that metrics are minimised again, with whitening and bandwidth of the population at
        the estimate before. With zero they are those of the observed data.
    several_outputs : bool
        Whether only metrics of several outputs are, or those of one as well.
    step : float
        Step of differences of log weights, in standard deviations of the prior.
    wide_step : float
        The same if the support of an input moves.
    effective_responses : float
        Smallest effective number of stored responses at the point of the score. An estimate at an
        edge is moved inside until it is reached.
    distance : float
        Distance from the middle of the prior, in its standard deviations, beyond which an element
        may be at an edge.
    smallest_spread : float
        Smallest standard deviation of an element's likelihood score there, relative to the largest
        of all elements: less where a bounded prior ends.
    """

    score: ScoreOptions = field(default_factory=ScoreOptions)
    saddlepoint: SaddlepointOptions = field(default_factory=SaddlepointOptions)
    rounds: int = 2
    several_outputs: bool = True
    step: float = 1e-5
    wide_step: float = 0.05
    effective_responses: float = 50.0
    distance: float = 3.0
    smallest_spread: float = 1e-4


@dataclass(frozen=True, eq=False)
class EstimateLikelihood:
    """The likelihood given the estimate, for `importance_sample` and `laplace`.

    Attributes
    ----------
    evaluator : Evaluator
    point : ndarray, shape (d,)
        Where the score is taken: the estimate, or a point inside if it is at an edge.
    simulators : tuple of int
        The first simulator of each set of simulators that share specimens.
    observable : tuple of ndarray of bool, shapes (M_j,)
        Stored responses that could be observed.
    scores : tuple of Scores
        Of these.
    combinations : ndarray, shape (d, r)
        Combinations of the scores that vary.
    scale : ndarray, shape (d,)
        Unit of each element for `laplace`: a standard deviation of the prior, or a hundred standard
        errors of the element alone if these are less.
    options : SaddlepointOptions
    """

    evaluator: Evaluator
    point: Floats
    simulators: tuple[int, ...]
    observable: tuple[NDArray[np.bool_], ...]
    scores: tuple[Scores, ...]
    combinations: Floats
    scale: Floats
    options: SaddlepointOptions

    @one_thread()
    def log_likelihood(self, thetas: Floats) -> Floats:
        """Return the log-density of the score at the estimate, (S, d) -> (S,)."""
        if self.combinations.shape[1] == 0:
            return np.zeros(len(thetas))
        largest = max(len(score.values) for score in self.scores)
        # Weights of a block of populations stay in the cache of the processor.
        rows = max(16, IN_CACHE // largest)
        blocks = []
        for first in range(0, len(thetas), rows):
            block = self._block(thetas[first : first + rows])
            blocks.append(block)
        return np.concatenate(blocks)

    def _block(self, thetas: Floats) -> Floats:
        log_weights = []
        for k, known in zip(self.simulators, self.observable, strict=True):
            _, weights = self.evaluator.populations(thetas, k)
            logs = _log_normalised(weights[:, known])
            log_weights.append(logs)
        return log_density(log_weights, self.scores, self.options)

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


def _log_normalised(weights: Floats) -> Floats:
    """Return logarithms of weights (S, M) that sum to one; NaN where a population has none."""
    totals = weights.sum(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = weights / totals
        return np.asarray(np.log(shares))


def estimate_likelihood(
    evaluator: Evaluator,
    optimum: Optimum,
    options: EstimateLikelihoodOptions = EstimateLikelihoodOptions(),
) -> EstimateLikelihood:
    """Return the likelihood of the hyperparameters given the minimiser of their metrics.

    Simulators that share specimens add the scores of a specimen. Independent simulators add their
    cumulant functions.

    Parameters
    ----------
    evaluator : Evaluator
        Of a model whose simulators have stored responses and metrics with ``additive``.
    optimum : Optimum
    options : EstimateLikelihoodOptions

    Raises
    ------
    TypeError
        If responses are not stored, or a metric's gradient is no mean over specimens.
    ValueError
        If observed specimens have unequal weights, or are shared in part.
    """
    _require_stored(evaluator)
    order = [optimum.names.index(name) for name in evaluator.names]
    point = move_inside(evaluator, optimum.theta[order], options)
    for _ in range(options.rounds):
        evaluator, point = _minimised_on_population(evaluator, point, optimum, options)
    evaluator = _coarse_where_sufficient(evaluator, point)
    parts = [
        _group_scores(evaluator, members, point, optimum, options)
        for members in groups(evaluator.nodes)
    ]
    log_weights = [part.log_weights for part in parts]
    centered = [part.centered for part in parts]
    untilted = cumulants(log_weights, centered, np.zeros((1, len(point))))
    size = sum(score.size for score in centered)
    covariance = untilted.hessians[0] / size
    combinations = varying_combinations(covariance, options.saddlepoint)
    scores = [Scores(score.values @ combinations, score.size) for score in centered]
    # With a prior far wider than the population a step in its unit would miss all data.
    precision = _likelihood_spread(evaluator, point, options) * np.sqrt(size)
    units = 100 / np.maximum(precision, 100)
    return EstimateLikelihood(
        evaluator=evaluator,
        point=point,
        simulators=tuple(part.simulator for part in parts),
        observable=tuple(part.observable for part in parts),
        scores=tuple(scores),
        combinations=combinations,
        scale=units * evaluator.prior_sd,
        options=options.saddlepoint,
    )


def _minimised_on_population(
    evaluator: Evaluator, point: Floats, optimum: Optimum, options: EstimateLikelihoodOptions
) -> tuple[Evaluator, Floats]:
    """Return metrics of several outputs with the whitening of the population, and their minimiser.

    Metrics of one output are not whitened: without others all is as it was. A minimiser that stored
    responses do not support is not taken.
    """
    from scipy.optimize import minimize

    targets = [node.target for node in evaluator.nodes]
    is_chosen = [bool(target.event) or not options.several_outputs for target in targets]
    if not any(is_chosen):
        return evaluator, point
    for k, target in enumerate(targets):
        responses, weights = evaluator.populations(point[None], k)
        if is_chosen[k]:
            targets[k] = prepared_on_population(target, responses[0], weights[0])
    prepared = evaluator.with_targets(targets)
    scales = np.array([optimum.scales[node.name] for node in evaluator.nodes])
    unit = evaluator.prior_sd

    def objective(shift: Floats) -> tuple[float, Floats]:
        step = 1e-4 * unit
        axes = np.diag(step)
        theta = point + shift * unit
        thetas = np.vstack([theta, theta + axes, theta - axes])
        totals = prepared.total(thetas, scales)
        value, up, down = np.split(totals, [1, 1 + len(theta)])
        return float(value[0]), (up - down) / 2e-4

    minimum = minimize(objective, np.zeros(len(point)), jac=True, method="BFGS")
    minimiser = move_inside(prepared, point + minimum.x * unit, options)
    sizes = [design["weight_ess"] for design in prepared.support(minimiser[None]).values()]
    is_supported = np.min(sizes) >= options.effective_responses
    return prepared, minimiser if is_supported else point


@dataclass(frozen=True, eq=False)
class _GroupScores:
    """Scores of simulators that share specimens."""

    simulator: int  # the first of them
    observable: NDArray[np.bool_]  # (M,): stored responses that could be observed by all
    log_weights: Floats  # (1, M'): of these, at the point of the score
    stored: Floats  # (M', d)
    observed: Floats  # (N, d)

    @property
    def centered(self) -> Scores:
        """The scores of stored responses, less the mean over the observed specimens."""
        mean = self.observed.mean(axis=0)
        return Scores(self.stored - mean, len(self.observed))


def _group_scores(
    evaluator: Evaluator,
    members: Sequence[int],
    point: Floats,
    optimum: Optimum,
    options: EstimateLikelihoodOptions,
) -> _GroupScores:
    """Return the scores of specimens in the sum of their simulators' discrepancies."""
    _require_same_specimens(evaluator, members)
    numbers, _ = specimens(evaluator.nodes)
    nodes = [evaluator.nodes[k] for k in members]
    populations = [_weight_slopes(evaluator, k, point, options) for k in members]
    mask = np.ones(len(populations[0].weights), dtype=bool)
    for node, population in zip(nodes, populations, strict=True):
        mask &= observable(population.responses, node.target)
    n = len(nodes[0].observed)
    d = len(point)
    stored = np.zeros((mask.sum(), d))
    observed = np.zeros((n, d))
    for k, node, population in zip(members, nodes, populations, strict=True):
        # The gradient of the objective is a sum over specimens of these, by units of the prior.
        scale = n * optimum.scales[node.name]
        factor = evaluator.prior_sd / scale
        score = partial(
            specimen_scores,
            node.target,
            population,
            options=options.score,
        )
        order = np.argsort(numbers[k])
        stored += factor * score(population.responses[mask])
        observed += factor * score(node.observed[order])
    weights = populations[0].weights[mask]
    return _GroupScores(
        simulator=members[0],
        observable=mask,
        log_weights=_log_normalised(weights[None]),
        stored=stored,
        observed=observed,
    )


def _weight_slopes(
    evaluator: Evaluator, k: int, theta: Floats, options: EstimateLikelihoodOptions
) -> WeightSlopes:
    """Return the k-th simulator's stored responses with weights, and their derivatives."""
    moves = evaluator.nodes[k].bound.support_moves
    share = options.wide_step if moves else options.step
    steps = share * evaluator.prior_sd
    axes = np.diag(steps)
    thetas = np.vstack([theta, theta + axes, theta - axes])
    responses, weights = evaluator.populations(thetas, k)
    center, up, down = np.split(weights, [1, 1 + len(theta)])
    # Log weights are nearly parabolas, whose differences are right at any step. A weight that
    # vanishes within the step has none.
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.log(up) - np.log(down)
        relative = center * ratios
    is_finite = np.isfinite(relative)
    differences = np.where(is_finite, relative, up - down)
    lengths = 2 * steps
    slopes = differences / lengths[:, None]
    return WeightSlopes(responses[0], center[0], slopes)


def move_inside(evaluator: Evaluator, theta: Floats, options: EstimateLikelihoodOptions) -> Floats:
    """Return the estimate, (d,), or a point inside if it is at an edge.

    At an edge the scores of an element vanish, or stored responses are too few for them. The score
    at a point inside is as good a statistic. Elements at an edge are moved towards the middle of
    their prior.
    """
    middle = np.median(evaluator.prior_points(256, 0), axis=0)
    way = middle - theta
    is_far = np.abs(way) > options.distance * evaluator.prior_sd
    way[~is_far] = 0
    for share in np.linspace(0, 1, 33):
        point = theta + share * way
        spread = _likelihood_spread(evaluator, point, options)
        smallest = options.smallest_spread * spread.max()
        is_still = is_far & (spread < smallest)
        support = evaluator.support(point[None])
        sizes = [design["weight_ess"] for design in support.values()]
        effective = np.min(sizes)
        is_inside = not is_still.any()
        if is_inside and effective >= options.effective_responses:
            return point
    return theta


def _likelihood_spread(
    evaluator: Evaluator, theta: Floats, options: EstimateLikelihoodOptions
) -> Floats:
    """Return standard deviations of the derivatives of log weights, in units of the prior, (d,)."""
    variance = np.zeros(len(theta))
    for k in range(len(evaluator.nodes)):
        population = _weight_slopes(evaluator, k, theta, options)
        variance += population.spread**2
    return np.asarray(np.sqrt(variance) * evaluator.prior_sd)


def _coarse_where_sufficient(evaluator: Evaluator, point: Floats) -> Evaluator:
    """Return an evaluator with an eighth of the points of large designs, if they are sufficient."""
    coarse = evaluator.coarser()
    if coarse is None:
        return evaluator
    support = coarse.support(point[None])
    is_sufficient = [
        support[name]["weight_ess"][0] >= design.required_ess
        for name, design in coarse.designs.items()
    ]
    return coarse if all(is_sufficient) else evaluator


def _require_stored(evaluator: Evaluator) -> None:
    """Raise if responses are not stored, or observed specimens have unequal weights."""
    if not evaluator.nodes:
        raise TypeError("model: got no simulator with a metric, expected one")
    for node in evaluator.nodes:
        if not node.bound.stored:
            raise TypeError(
                f"{node.name}: propagation: got {type(node.propagation).__name__}, expected "
                "prb.Reweighted(), whose stored responses serve all hyperparameters"
            )
        if np.ptp(node.target.weights) > 1e-12:
            raise ValueError(
                f"{node.name}: got observed responses of unequal weights, expected equal ones"
            )


def _require_same_specimens(evaluator: Evaluator, members: Sequence[int]) -> None:
    """Raise unless simulators have the same specimens, each measured once in each."""
    numbers, _ = specimens(evaluator.nodes)
    nodes = [evaluator.nodes[k] for k in members]
    names = ", ".join(node.name for node in nodes)
    expected = np.unique(numbers[members[0]])
    is_same = [np.array_equal(np.sort(numbers[k]), expected) for k in members]
    if not all(is_same):
        raise ValueError(
            f"specimens: got some that {names} share in part or measure twice, expected each "
            "specimen once in every simulator that shares it"
        )
    if not aligned(nodes):
        raise ValueError(
            f"specimens: got the same labels in {names} with different inputs or designs, expected "
            "the same .dist() objects, n and seed in all"
        )
