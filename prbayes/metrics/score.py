"""Scores of single specimens: their contributions to the gradient of a metric.

A metric with ``additive`` has a gradient that is a mean over the observed specimens,
``G(t) = mean_i psi(y_i, t)``, so that its minimiser is an M-estimator with the score psi.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from prbayes._stats import finite_sample, quantile
from prbayes._validate import Floats
from prbayes.metrics.base import Discrepancy, Part, is_additive
from prbayes.metrics.density import BandwidthRule, GaussianKDE, twice_silverman


@dataclass(frozen=True)
class ScoreOptions:
    """Options of scores.

    Attributes
    ----------
    reach : float
        Default bandwidths of the data beyond their ends from which on the score of a log-density is
        constant. It would grow without bound there, and the tail of the population would decide on
        the posterior. The extremes expected of all specimens of the model count as data.
    step : float
        Relative step of central differences.
    block : int
        Number of specimens that are evaluated at once.
    nodes : int
        Nodes of the tables of scores as functions of a response.
    margin : float
        Default bandwidths beyond all responses at the estimate where the tables end.
    """

    reach: float = 2.0
    step: float = 1e-4
    block: int = 128
    nodes: int = 1024
    margin: float = 10.0


@dataclass(frozen=True, eq=False)
class WeightSlopes:
    """Stored responses with their weights at one theta, and the derivatives of the weights.

    Attributes
    ----------
    responses : ndarray, shape (M,) or (M, m)
    weights : ndarray, shape (M,)
    slopes : ndarray, shape (d, M)
        Derivatives with respect to the elements of theta.
    """

    responses: Floats
    weights: Floats
    slopes: Floats

    @property
    def spread(self) -> Floats:
        """Standard deviations of the derivatives of the log weights, (d,)."""
        # Where an edge of the support passes, weights are zero and their derivatives are not.
        smallest = 1e-3 * self.weights.mean()
        positive = np.maximum(self.weights, smallest)
        squares = self.slopes**2 / positive
        variances = squares.sum(axis=1)
        return np.asarray(np.sqrt(variances))

    def neighbours(self, part: Part, options: ScoreOptions) -> tuple[list[Floats], list[Floats]]:
        """Return features of a part at theta plus and minus a step, (d, ...) each."""
        target = part.target
        basis = target.basis(part.of(self.responses))
        features = basis.features(self.weights[None])
        slopes = basis.features(self.slopes)
        column = self.steps(options)[:, None]
        upper, lower = [], []
        for feature, slope in zip(features, slopes, strict=True):
            shift = column * slope
            upper.append(feature + shift)
            lower.append(feature - shift)
        return upper, lower

    def steps(self, options: ScoreOptions) -> Floats:
        """Return the steps of the elements, (d,)."""
        smallest = np.finfo(float).tiny
        return np.asarray(options.step / np.maximum(self.spread, smallest))


@dataclass(frozen=True, eq=False)
class ShiftedResponses:
    """Responses at theta plus and minus a step along each element, from common random numbers.

    Attributes
    ----------
    responses : ndarray, shape (M,) or (M, m)
        At theta itself.
    upper, lower : ndarray, shape (d, M) or (d, M, m)
    lengths : ndarray, shape (d,)
        The steps.
    """

    responses: Floats
    upper: Floats
    lower: Floats
    lengths: Floats

    @property
    def weights(self) -> Floats:
        """Equal weights of the responses, (M,)."""
        return np.full(len(self.responses), 1 / len(self.responses))

    def neighbours(self, part: Part, options: ScoreOptions) -> tuple[list[Floats], list[Floats]]:
        """Return features of a part at theta plus and minus a step, (d, ...) each."""
        weights = np.full(self.upper.shape[:2], 1 / self.upper.shape[1])
        upper = part.target.features(part.of(self.upper), weights, np)
        lower = part.target.features(part.of(self.lower), weights, np)
        return list(upper), list(lower)

    def steps(self, options: ScoreOptions) -> Floats:
        """Return the steps of the elements, (d,)."""
        return self.lengths


def prepared_on_population(target: Discrepancy, responses: Floats, weights: Floats) -> Discrepancy:
    """Return the discrepancy from the same data with the whitening of a population.

    The whitening by few data depends on them, and the minimiser with it. That of the population at
    an estimate is about the same for all data sets with this estimate. The bandwidth is that of as
    many specimens as are observed. Data with gaps keep their own whitening.

    Parameters
    ----------
    target : Discrepancy
        Of several outputs.
    responses : ndarray, shape (M, m)
        Rows that lack a number are left out.
    weights : ndarray, shape (M,)
    """
    if np.isnan(target.observed).any():
        # Outputs that no specimen has together may depend on each other linearly.
        return target
    metric = target.metric
    inner: Any = getattr(metric, "metric", metric)
    density = getattr(inner, "density", None)
    if isinstance(density, GaussianKDE) and callable(density.bandwidth):
        rule = partial(
            _bandwidth_of_fewer,
            rule=density.bandwidth,
            size=len(target.observed),
        )
        inner = replace(inner, density=GaussianKDE(rule))
    table = responses.reshape(len(responses), -1)
    # Far away responses of no weight would stretch the grid.
    is_finite = np.isfinite(table).all(axis=1) & (weights > 1e-8 * weights.max())
    shares = weights[is_finite]
    shares = shares / shares.sum()
    prepared = metric.like(inner).against(responses[is_finite], shares)
    return prepared.with_observed(target.observed)


def _bandwidth_of_fewer(sample: Floats, weights: Floats, rule: BandwidthRule, size: int) -> float:
    """Return the bandwidth of so many specimens, by a rule in proportion to n^(-1/5)."""
    squares = (weights**2).sum()
    factor = (squares * size) ** -0.2
    return float(factor * rule(sample, weights))


def specimen_scores(
    target: Discrepancy,
    population: WeightSlopes | ShiftedResponses,
    specimens: Floats,
    options: ScoreOptions = ScoreOptions(),
    total: int = 0,
) -> Floats:
    """Return the score of each specimen, (n, d).

    Bandwidths, grids and whitening are those of the target. Each specimen is a data set of its own,
    whose discrepancy is differentiated by central differences.

    Parameters
    ----------
    target : Discrepancy
        With ``additive``.
    population : WeightSlopes or ShiftedResponses
    specimens : ndarray, shape (n,) or (n, m)
    options : ScoreOptions
    total : int
        Number of observed specimens of all simulators.
    """
    if not is_additive(target):
        raise TypeError(
            f"metric: got {type(target.metric).__name__}, whose gradient is no mean over specimens "
            "of complete records, expected prb.ProbabilityResidual() or prb.KullbackLeibler()"
        )
    scores: Any = 0.0
    for part in target.parts:
        terms = _part_scores(part, population, part.of(specimens), options, total)
        scores = scores + part.share * terms
    return np.asarray(scores)


def tabulated_scores(
    target: Discrepancy,
    population: ShiftedResponses,
    specimens: Floats,
    options: ScoreOptions = ScoreOptions(),
    total: int = 0,
) -> Callable[[Floats], Floats]:
    """Return a function of responses, (..., n) or (..., n, m) -> (..., n, d), by interpolation.

    A score is a smooth function of the one number that a part compares.

    Parameters
    ----------
    target : Discrepancy
        With ``additive``.
    population : ShiftedResponses
    specimens : ndarray, shape (n,) or (n, m)
        Observed responses.
    options : ScoreOptions
    total : int
        Number of observed specimens of all simulators.
    """
    from scipy.interpolate import CubicSpline

    tables = []
    for part in target.parts:
        known = [np.ravel(part.of(x)) for x in (specimens, population.responses)]
        values = np.concatenate(known)
        values = values[np.isfinite(values)]
        inner = part.target
        observed, weights = finite_sample(inner.observed, inner.weights)
        margin = options.margin * twice_silverman(observed, weights)
        nodes = np.linspace(values.min() - margin, values.max() + margin, options.nodes)
        scores = part.share * _part_scores(part, population, nodes, options, total)
        failed = part.share * _part_scores(part, population, np.array([np.inf]), options, total)
        tables.append((part, CubicSpline(nodes, scores), failed[0]))

    def function(responses: Floats) -> Floats:
        total: Any = 0.0
        for part, spline, failed in tables:
            values = np.asarray(part.of(responses))
            first, last = spline.x[[0, -1]]
            inside = np.clip(np.nan_to_num(values), first, last)
            terms = spline(inside)
            terms[np.isposinf(values)] = failed
            total = total + terms
        return np.asarray(total)

    return function


def _part_scores(
    part: Part,
    population: WeightSlopes | ShiftedResponses,
    compared: Floats,
    options: ScoreOptions,
    total: int,
) -> Floats:
    """Return the scores, (n, d), of values that a part compares, (n,)."""
    target = part.target
    upper, lower = population.neighbours(part, options)
    values = _within_reach(part, population, compared, options, total)
    blocks = []
    for first in range(0, len(values), options.block):
        block = values[first : first + options.block]
        one_each = np.eye(len(block))
        single = target.with_observed(block, one_each[:, None])
        up = single.outer(*upper, xp=np)
        down = single.outer(*lower, xp=np)
        blocks.append(up - down)
    differences = np.concatenate(blocks)
    return np.asarray(differences / (2 * population.steps(options)))


def _within_reach(
    part: Part,
    population: WeightSlopes | ShiftedResponses,
    values: Floats,
    options: ScoreOptions,
    total: int,
) -> Floats:
    """Return values of a log-density's part limited to the reach of the data, (n,)."""
    target = part.target
    if not target.metric.likelihood:
        return values
    observed, weights = finite_sample(target.observed, target.weights)
    lower, upper = observed.min(), observed.max()
    if total > len(target.observed):
        simulated = np.asarray(part.of(population.responses))
        is_known = np.isfinite(simulated)
        level = 1 / (total + 1)
        low, high = quantile(simulated[is_known], population.weights[is_known], [level, 1 - level])
        lower, upper = min(lower, low), max(upper, high)
    margin = options.reach * twice_silverman(observed, weights)
    clipped = np.clip(values, lower - margin, upper + margin)
    is_finite = np.isfinite(values)
    return np.where(is_finite, clipped, values)
