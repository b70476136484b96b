"""Log scores: how likely single specimens are under a population that was found without them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from prbayes._stats import finite_sample, quantile
from prbayes._validate import Floats
from prbayes.metrics.base import Discrepancy, Metric, Part
from prbayes.metrics.density import DensityDiscrepancy, GaussianKDE, spread
from prbayes.metrics.joint import Joint
from prbayes.metrics.likelihood import LogLikelihood

# Share of every population that is taken to be spread widely over the data, so that no specimen
# decides alone: a single value in the light tail of a wrong family weighs more than all others, and
# a few data sets that have one than all that do not. By judgement: with a hundredth error bars were
# too short by half on 30 normal data against a gamma, with a tenth by a third.
_GROSS = 0.1
# Its Student's t distribution has tails that exceed those of all common families, but a mean and a
# variance.
_WIDE_DEGREES = 3


@dataclass(frozen=True, eq=False)
class Scoring:
    """How the specimens of a simulator are scored: the same way for all models of the same data."""

    # Minus a log-likelihood of the data, of which cells and views are taken. Of several outputs it
    # is the mean over directions in white coordinates of the data.
    target: Discrepancy

    @classmethod
    def of(cls, observed: Floats, weights: Floats) -> Self:
        """Return that of observed values (N,) or (N, m) with weights; no model has a say in it.

        Raises
        ------
        ValueError
            If they have no density, as where all are equal.
        """
        metric: Metric = LogLikelihood(density=GaussianKDE())
        if observed.ndim > 1:
            metric = Joint(metric)
        return cls(metric.against(observed, weights))

    def scores(self, values: Floats, weights: Floats, rows: NDArray[np.intp]) -> Floats:
        """Return scores of some of the observations, (r,), under one population.

        Each is the logarithm of a density, times the observation's weight and the number of them.
        An observation without weight scores zero.

        Parameters
        ----------
        values : ndarray, shape (n,) or (n, m)
            Responses of the population: +inf is a specimen that failed, and NaN one without a
            response, which is left out.
        weights : ndarray, shape (n,)
        rows : ndarray of int, shape (r,)
        """
        observed = self.target.observed
        total = np.zeros(len(observed))
        for part in self.target.parts:
            seen, index = part.observed_of(observed)
            mine = np.isin(index, rows)
            logs = _logs(part, seen[mine], part.of(values), weights)
            total[index[mine]] += part.share * part.target.weights[mine] * logs
        return np.asarray(total[rows] * len(observed))


def _logs(part: Part, points: Floats, simulated: Floats, weights: Floats) -> Floats:
    """Return the log density of a population at points, (n',), with its share spread widely."""
    assert isinstance(part.target, DensityDiscrepancy)  # as a log-likelihood is
    cells = part.target.cells
    # The population is that of the points with a response.
    known = np.where(np.isnan(simulated), 0.0, weights)
    density = cells.density(simulated, known) / known.sum()
    at_points = cells.reading(points, np.eye(points.size)) @ density
    # Between nodes a density may be read as less than nothing, by rounding.
    own = np.maximum(at_points, 0.0)
    own = np.where(np.isnan(at_points), np.nan, own)
    return np.asarray(np.log((1 - _GROSS) * own + _GROSS * _wide(part.target, points)))


def _wide(target: Discrepancy, points: Floats) -> Floats:
    """Return the density at points of what is spread widely over the observed values."""
    values, weights = finite_sample(target.observed, target.weights)
    middle = quantile(values, weights, 0.5)
    return np.asarray(student.pdf(points, _WIDE_DEGREES, middle, spread(values, weights)))
