"""Scores of single specimens: their contributions to the gradient of a metric.

A metric with ``additive`` has a gradient that is a mean over the observed specimens,
``G(t) = mean_i psi(y_i, t)``, so that its minimiser is an M-estimator with the score psi.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from prbayes._stats import finite_sample, positive_scale, quantile
from prbayes._validate import ArrayFunction, Floats, complete_rows, finite_or_nan, flat_rows
from prbayes.metrics.base import Discrepancy, Part, is_additive
from prbayes.metrics.density import BandwidthRule, GaussianKDE, twice_silverman


@dataclass(frozen=True)
class ScoreOptions:
    """Options for the computation of scores."""

    # Distance from the ends of the data, in default bandwidths, beyond which the score of a
    # log-density is constant. Otherwise it would grow without bound, and the tail of the population
    # would decide on the posterior. The extremes that all specimens of the model are expected to
    # have count as data.
    reach: float = 2.0
    step: float = 1e-4  # relative step of central differences
    block: int = 128  # number of specimens that are evaluated at once
    nodes: int = 1024  # number of nodes in tables of scores as functions of a response
    # Number of default bandwidths by which these tables extend beyond the smallest and the largest
    # response.
    margin: float = 10.0


@dataclass(frozen=True, eq=False)
class WeightSlopes:
    """Stored responses with their weights at one theta, and the derivatives of the weights."""

    responses: Floats  # stored responses, (M,) or (M, m)
    weights: Floats  # weights at theta, (M,)
    slopes: Floats  # derivatives of the weights with respect to the elements of theta, (d, M)
    # weights at other optima, (J, M); the discrepancy there, less that at theta, is a further score
    optima: Floats = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def spread(self) -> Floats:
        """Standard deviations of the derivatives of the log weights, (d,)."""
        # At an edge of the support a weight may be zero although its derivative is not.
        positive = np.maximum(self.weights, 1e-3 * self.weights.mean())
        return np.sqrt((self.slopes**2 / positive).sum(axis=1))

    def neighbours(
        self, part: Part, options: ScoreOptions
    ) -> tuple[list[Floats], list[Floats], Floats]:
        """Return features of a part at theta plus and minus a step, (d, ...), and steps, (d,).

        J other optima are further rows: their features, those at theta, and half as step.
        """
        steps = np.asarray(options.step / np.maximum(self.spread, np.finfo(float).tiny))
        basis = part.target.basis(part.of(self.responses))
        features = basis.features(self.weights[None])
        slopes = basis.features(self.slopes)
        upper, lower = [], []
        for feature, slope in zip(features, slopes, strict=True):
            shift = steps[:, None] * slope
            upper.append(feature + shift)
            lower.append(feature - shift)
        count = len(self.optima)
        if not count:
            return upper, lower, steps
        at_optima = basis.features(self.optima)
        upper = [np.concatenate(pair) for pair in zip(upper, at_optima, strict=True)]
        lower = [
            np.concatenate([rows, np.repeat(feature, count, axis=0)])
            for rows, feature in zip(lower, features, strict=True)
        ]
        return upper, lower, np.append(steps, np.full(count, 0.5))


@dataclass(frozen=True, eq=False)
class ShiftedResponses:
    """Responses at theta plus and minus a step along each element, from common random numbers."""

    responses: Floats  # responses at theta itself, (M,) or (M, m)
    upper: Floats  # responses at theta plus a step, (d, M) or (d, M, m)
    lower: Floats  # responses at theta minus a step
    steps: Floats  # steps, (d,)

    @property
    def weights(self) -> Floats:
        """Equal weights of the responses, (M,)."""
        return np.full(len(self.responses), 1 / len(self.responses))

    @property
    def spread(self) -> Floats:
        """Root mean squares of the derivatives, in standard deviations of the responses, (d,)."""
        steps = self.steps.reshape(-1, *[1] * self.responses.ndim)
        slopes = (self.upper - self.lower) / (2 * steps)
        finite = finite_or_nan(self.responses)
        scale = np.nanstd(finite, axis=0)
        relative = np.where(np.isfinite(slopes), slopes, 0.0) / positive_scale(scale)
        squares = np.mean(relative**2, axis=1)
        return np.sqrt(squares.reshape(len(steps), -1).sum(axis=1))

    def neighbours(
        self, part: Part, options: ScoreOptions
    ) -> tuple[list[Floats], list[Floats], Floats]:
        """Return features of a part at theta plus and minus a step, (d, ...), and steps, (d,)."""
        weights = np.full(self.upper.shape[:2], 1 / self.upper.shape[1])
        upper = part.target.features(part.of(self.upper), weights, np)
        lower = part.target.features(part.of(self.lower), weights, np)
        return list(upper), list(lower), self.steps


def prepared_on_population(target: Discrepancy, responses: Floats, weights: Floats) -> Discrepancy:
    """Return the discrepancy from the same data with the whitening of a population.

    A whitening by few data depends on these data, and so does the minimiser. The whitening by the
    population at an estimate is about the same for all data sets with this estimate. The bandwidth
    is for as many specimens as are observed. Data with gaps keep their whitening. Responses,
    (M, m), with a missing number are left out.
    """
    if np.isnan(target.observed).any():
        # If no specimen has two outputs together, they may depend on each other linearly.
        return target
    metric = target.metric
    inner: Any = getattr(metric, "metric", metric)
    density = getattr(inner, "density", None)
    if isinstance(density, GaussianKDE) and callable(density.bandwidth):
        rule = partial(_bandwidth_of_fewer, rule=density.bandwidth, size=len(target.observed))
        inner = replace(inner, density=GaussianKDE(rule))
    rows = flat_rows(responses)
    # Leave out remote responses without weight, because they would stretch the grid.
    is_used = complete_rows(rows) & (weights > 1e-8 * weights.max())
    used_weights = weights[is_used] / weights[is_used].sum()
    prepared = metric.like(inner).against(responses[is_used], used_weights)
    return prepared.with_observed(target.observed)


def _bandwidth_of_fewer(sample: Floats, weights: Floats, rule: BandwidthRule, size: int) -> float:
    """Return the bandwidth for ``size`` specimens, by a rule that is proportional to n^(-1/5)."""
    factor = ((weights**2).sum() * size) ** -0.2
    return float(factor * rule(sample, weights))


def specimen_scores(
    target: Discrepancy,
    population: WeightSlopes | ShiftedResponses,
    specimens: Floats,
    options: ScoreOptions = ScoreOptions(),
    total: int = 0,
) -> Floats:
    """Return the score of each specimen, (n,) or (n, m) -> (n, d).

    Bandwidths, grids and whitening are those of the target, which is additive. Each specimen is a
    data set, whose discrepancy is differentiated by central differences. ``total`` is the number of
    observed specimens of all simulators.
    """
    if not is_additive(target):
        raise TypeError(
            f"metric: got {type(target.metric).__name__}, whose gradient is no mean over specimens "
            "of complete records, expected prb.ProbabilityResidual() or prb.KullbackLeibler()"
        )
    scores: Any = 0.0
    for part in target.parts:
        part_scores = _part_scores(part, population, part.of(specimens), options, total)
        scores = scores + part.share * part_scores
    return np.asarray(scores)


def tabulated_scores(
    target: Discrepancy,
    population: ShiftedResponses,
    specimens: Floats,
    options: ScoreOptions,
    total: int,
) -> ArrayFunction:
    """Return the scores as a function of responses, (..., n) or (..., n, m) -> (..., n, d).

    A score is a smooth function of the number that a part compares: it is interpolated. Arguments
    are those of `specimen_scores`.
    """
    from scipy.interpolate import CubicSpline

    tables = []
    for part in target.parts:
        values = np.concatenate([np.ravel(part.of(x)) for x in (specimens, population.responses)])
        values = values[np.isfinite(values)]
        observed, weights = finite_sample(part.target.observed, part.target.weights)
        margin = options.margin * twice_silverman(observed, weights)
        nodes = np.linspace(values.min() - margin, values.max() + margin, options.nodes)
        scores = part.share * _part_scores(part, population, nodes, options, total)
        failed = part.share * _part_scores(part, population, np.array([np.inf]), options, total)
        tables.append((part, CubicSpline(nodes, scores), failed[0]))

    def function(responses: Floats) -> Floats:
        scores = 0.0
        for part, spline, failed in tables:
            values = np.asarray(part.of(responses))
            first, last = spline.x[[0, -1]]
            part_scores = spline(np.clip(np.nan_to_num(values), first, last))
            part_scores[np.isposinf(values)] = failed
            scores = scores + part_scores
        return np.asarray(scores)

    return function


def _part_scores(
    part: Part,
    population: WeightSlopes | ShiftedResponses,
    values: Floats,
    options: ScoreOptions,
    total: int,
) -> Floats:
    """Return the scores, (n, d), of values that a part compares, (n,)."""
    target = part.target
    if target.metric.likelihood:
        # Limit the values to the range of the data and a margin. With several simulators the range
        # is that expected of as many specimens as all simulators have together.
        observed, weights = finite_sample(target.observed, target.weights)
        lowest = observed.min()
        highest = observed.max()
        if total > len(target.observed):
            simulated = np.asarray(part.of(population.responses))
            mass = population.weights
            is_finite = np.isfinite(simulated)
            prob = 1 / (total + 1)
            extremes = quantile(simulated[is_finite], mass[is_finite], [prob, 1 - prob])
            lowest = min(lowest, extremes[0])
            highest = max(highest, extremes[1])
        margin = options.reach * twice_silverman(observed, weights)
        limited = np.clip(values, lowest - margin, highest + margin)
        values = np.where(np.isfinite(values), limited, values)
    # Take central differences of the discrepancy between population and each specimen.
    upper, lower, steps = population.neighbours(part, options)
    blocks = []
    for start in range(0, len(values), options.block):
        block = values[start : start + options.block]
        single = target.with_observed(block, np.eye(len(block))[:, None])
        blocks.append(single.outer(*upper, xp=np) - single.outer(*lower, xp=np))
    return np.concatenate(blocks) / (2 * steps)
