"""Scores of single specimens: their contributions to the gradient of a metric.

A metric with ``additive`` has a gradient that is a mean over the observed specimens,
``G(t) = mean_i psi(y_i, t)``, so that its minimiser is an M-estimator with the score psi.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from prbayes._checks import Floats
from prbayes._weighted import finite_sample
from prbayes.metrics.base import Discrepancy, Part
from prbayes.metrics.density import BandwidthRule, GaussianKDE, twice_silverman


@dataclass(frozen=True)
class ScoreOptions:
    """Options of scores.

    Attributes
    ----------
    reach : float
        Default bandwidths of the data beyond their ends from which on the score of a log-density is
        constant. It would grow without bound there, and the tail of the population would decide on
        the posterior.
    step : float
        Relative step of central differences.
    block : int
        Number of specimens that are evaluated at once.
    """

    reach: float = 2.0
    step: float = 1e-4
    block: int = 128


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


def prepared_on_population(target: Discrepancy, responses: Floats, weights: Floats) -> Discrepancy:
    """Return the discrepancy from the same data with the whitening of a population.

    The whitening by few data depends on them, and the minimiser with it. That of the population at
    an estimate is about the same for all data sets with this estimate. The bandwidth is that of as
    many specimens as are observed.

    Parameters
    ----------
    target : Discrepancy
        Of several outputs.
    responses : ndarray, shape (M, m)
        Rows that lack a number are left out.
    weights : ndarray, shape (M,)
    """
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
    is_finite = np.isfinite(table).all(axis=1)
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
    population: WeightSlopes,
    specimens: Floats,
    options: ScoreOptions = ScoreOptions(),
) -> Floats:
    """Return the score of each specimen, (n, d).

    Bandwidths, grids and whitening are those of the target. Each specimen is a data set of its own,
    whose discrepancy is differentiated by central differences.

    Parameters
    ----------
    target : Discrepancy
        With ``additive``.
    population : WeightSlopes
    specimens : ndarray, shape (n,) or (n, m)
    options : ScoreOptions
    """
    if not target.additive:
        raise TypeError(
            f"metric: got {type(target.metric).__name__}, whose gradient is no mean over specimens "
            "of complete records, expected prb.ProbabilityResidual() or prb.KullbackLeibler()"
        )
    n = len(specimens)
    d = len(population.slopes)
    scores = np.zeros((n, d))
    for part in target.parts:
        terms = _part_scores(part, population, specimens, options)
        scores += part.share * terms
    return scores


def _part_scores(
    part: Part, population: WeightSlopes, specimens: Floats, options: ScoreOptions
) -> Floats:
    """Return the scores of specimens in one part of a metric, (n, d)."""
    target = part.target
    responses = part.of(population.responses)
    basis = target.stored(responses)
    weights = population.weights[None]
    features = target.from_basis(weights, basis, np)
    slopes = target.from_basis(population.slopes, basis, np)
    smallest = np.finfo(float).tiny
    spread = np.maximum(population.spread, smallest)
    steps = options.step / spread
    column = steps[:, None]
    upper, lower = [], []
    for feature, slope in zip(features, slopes, strict=True):
        shift = column * slope
        upper.append(feature + shift)
        lower.append(feature - shift)
    values = _within_reach(part, specimens, options)
    blocks = []
    for first in range(0, len(values), options.block):
        block = values[first : first + options.block]
        one_each = np.eye(len(block))
        single = target.with_observed(block, one_each[:, None])
        up = single.outer(*upper, xp=np)
        down = single.outer(*lower, xp=np)
        blocks.append(up - down)
    differences = np.concatenate(blocks)
    return np.asarray(differences / (2 * steps))


def _within_reach(part: Part, specimens: Floats, options: ScoreOptions) -> Floats:
    """Return what a part compares of specimens, held within reach of the data, (n,)."""
    values = np.asarray(part.of(specimens))
    target = part.target
    if not target.metric.likelihood:
        return values
    observed, weights = finite_sample(target.observed, target.weights)
    margin = options.reach * twice_silverman(observed, weights)
    lower = observed.min() - margin
    upper = observed.max() + margin
    clipped = np.clip(values, lower, upper)
    is_finite = np.isfinite(values)
    return np.where(is_finite, clipped, values)
