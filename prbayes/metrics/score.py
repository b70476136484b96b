"""Scores of single specimens: their contributions to the gradient of a metric.

A metric with ``additive`` has a gradient that is a mean over the observed specimens,
``G(t) = mean_i psi(y_i, t)``, so that its minimiser is an M-estimator with the score psi.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prbayes._checks import Floats
from prbayes.metrics.base import Discrepancy, Part
from prbayes.metrics.cells import KernelCells


@dataclass(frozen=True)
class ScoreOptions:
    """Options of scores.

    Attributes
    ----------
    reach : float
        Bandwidths beyond the data from which on the score of a log-density is constant. It would
        grow without bound there, and the tail of the population would decide on the posterior.
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
        positive = np.maximum(self.weights, np.finfo(float).tiny)
        squares = self.slopes**2 / positive
        return np.asarray(np.sqrt(squares.sum(axis=1)))


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
    scores = np.zeros((len(specimens), len(population.slopes)))
    for part in target.parts:
        scores += part.share * _part_scores(part, population, specimens, options)
    return scores


def _part_scores(
    part: Part, population: WeightSlopes, specimens: Floats, options: ScoreOptions
) -> Floats:
    """Return the scores of specimens in one part of a metric, (n, d)."""
    target = part.target
    d = len(population.slopes)
    basis = target.stored(part.of(population.responses))
    features = target.from_basis(population.weights[None], basis, np)
    slopes = target.from_basis(population.slopes, basis, np)
    steps = options.step / np.maximum(population.spread, np.finfo(float).tiny)
    shifts = np.concatenate([steps, -steps])[:, None]
    ends = [
        feature + shifts * np.tile(slope, (2, 1))
        for feature, slope in zip(features, slopes, strict=True)
    ]
    values = _within_reach(part, specimens, options)
    scores = np.empty((len(values), d))
    for first in range(0, len(values), options.block):
        rows = slice(first, first + options.block)
        block = values[rows]
        one_each = np.eye(len(block))[:, None]
        single = target.with_observed(block, one_each)
        discrepancies = single.outer(*ends, xp=np)
        up, down = np.split(discrepancies, 2, axis=1)
        scores[rows] = (up - down) / (2 * steps)
    return scores


def _within_reach(part: Part, specimens: Floats, options: ScoreOptions) -> Floats:
    """Return what a part compares of specimens, held within reach of the data, (n,)."""
    values = np.asarray(part.of(specimens))
    target = part.target
    cells = target.density_cells
    if not (target.metric.likelihood and isinstance(cells, KernelCells)):
        return values
    finite = target.observed[np.isfinite(target.observed)]
    margin = options.reach * cells.bandwidth
    lower = finite.min() - margin
    upper = finite.max() + margin
    clipped = np.clip(values, lower, upper)
    return np.where(np.isfinite(values), clipped, values)
