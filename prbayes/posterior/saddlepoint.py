r"""Saddlepoint density of a mean of independent scores.

The density of an M-estimating equation at its root follows from the cumulant function of one
specimen's score (Field and Hampel 1982, doi:10.1093/biomet/69.1.29):

.. math:: \log L = N K(a) - \tfrac{1}{2} \log\det N K''(a), \quad
          K(a) = \log \sum_m w_m e^{a' \psi_m}, \quad K'(a) = 0.

Independent simulators add their cumulant functions :math:`N_j K_j(a)` with one tilt :math:`a`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats


@dataclass(frozen=True)
class SaddlepointOptions:
    """Limits of the Newton iteration and of the density."""

    iterations: int = 40  # largest number of Newton steps
    tolerance: float = 1e-5  # largest gradient by specimen, in standard deviations of the score
    # Smallest determinant of the tilted covariance, to the power of one over its dimension,
    # relative to that at the estimate. Below, the tilted distribution is nearly one atom.
    smallest_variance: float = 1e-4
    smallest_value: float = -1000.0  # of the cumulant function; below, the density is zero
    smallest_eigenvalue: float = 1e-6  # of the correlation matrix of scores that vary


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


@dataclass(frozen=True, eq=False)
class Cumulants:
    """The cumulant function at S tilts, (S,), with gradients, (S, r), and Hessians, (S, r, r)."""

    values: Floats
    gradients: Floats
    hessians: Floats


# Tilts (A, r) and the rows (A,) that they belong to -> cumulant functions of these.
CumulantFunction = Callable[[Floats, NDArray[np.intp]], Cumulants]


def cumulants(log_weights: Sequence[Floats], scores: Sequence[Scores], tilts: Floats) -> Cumulants:
    """Return the sum of N_j K_j(a) over simulators at tilts, (S, r).

    Log weights of the stored responses have shapes (S, M_j); the weights of a row sum to one.
    """
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
        # The smaller matrix first: half of the time.
        sums = (score.powers @ weights.T).T
        totals = sums[:, :1]
        means, products = np.split(sums[:, 1:] / totals, [r], axis=1)
        values += score.size * (np.log(totals[:, 0]) + largest)
        gradients += score.size * means
        hessians[:, first, second] += score.size * (products - means[:, first] * means[:, second])
    hessians[:, second, first] = hessians[:, first, second]
    return Cumulants(values, gradients, hessians)


def minimum(
    function: CumulantFunction, shape: tuple[int, int], size: int, options: SaddlepointOptions
) -> tuple[Cumulants, NDArray[np.bool_]]:
    """Minimise S convex cumulant functions of r tilts by Newton steps no longer than 1 + |a|.

    ``size`` is the number of observed specimens. Return the values at the minima, and which
    converged.
    """
    count, r = shape
    ridge = 1e-8 * size * np.eye(r)
    tilts = np.zeros(shape)
    state = function(tilts, np.arange(count))
    limit = options.tolerance * size
    converged = np.linalg.norm(state.gradients, axis=1) < limit
    for _ in range(options.iterations):
        # Without a minimum, values fall and tilts grow without end.
        rows = np.flatnonzero(~converged & (state.values > options.smallest_value))
        if rows.size == 0:
            break
        steps = np.linalg.solve(state.hessians[rows] + ridge, state.gradients[rows, :, None])
        steps = steps[:, :, 0]
        lengths = np.linalg.norm(steps, axis=1)
        longest = 1 + np.linalg.norm(tilts[rows], axis=1)
        tilts[rows] -= steps * (longest / np.maximum(lengths, longest))[:, None]
        new = function(tilts[rows], rows)
        state.values[rows] = new.values
        state.gradients[rows] = new.gradients
        state.hessians[rows] = new.hessians
        converged[rows] = np.linalg.norm(new.gradients, axis=1) < limit
    return state, converged


def saddlepoint_density(
    function: CumulantFunction, shape: tuple[int, int], size: int, options: SaddlepointOptions
) -> Floats:
    """Return the log-density of a mean of zero, up to a constant, (S,); arguments as `minimum`.

    It is -inf without a saddlepoint: then zero is outside of the convex hull of the scores.
    """
    state, converged = minimum(function, shape, size, options)
    signs, log_dets = np.linalg.slogdet(state.hessians / size)
    smallest = shape[1] * np.log(options.smallest_variance)
    is_usable = converged & (signs > 0) & (log_dets > smallest)
    return np.where(is_usable, state.values - log_dets / 2, -np.inf)


def log_density(
    log_weights: Sequence[Floats],
    scores: Sequence[Scores],
    options: SaddlepointOptions = SaddlepointOptions(),
) -> Floats:
    """Return the log-density of a mean score of zero, up to a constant, (S,).

    Log weights have shapes (S, M_j); -inf or NaN throughout a row if no stored response supports
    its population. Scores are in units in which their covariance is about one.
    """
    result = np.full(len(log_weights[0]), -np.inf)
    is_supported = np.all([np.isfinite(logs.max(axis=1)) for logs in log_weights], axis=0)
    if not is_supported.any():
        return result
    supported = [logs[is_supported] for logs in log_weights]

    def function(tilts: Floats, rows: NDArray[np.intp]) -> Cumulants:
        if len(rows) == len(supported[0]):
            return cumulants(supported, scores, tilts)
        return cumulants([logs[rows] for logs in supported], scores, tilts)

    shape = len(supported[0]), scores[0].values.shape[1]
    size = sum(score.size for score in scores)
    result[is_supported] = saddlepoint_density(function, shape, size, options)
    return result


def varying_combinations(covariance: Floats, options: SaddlepointOptions) -> Floats:
    """Return the standardised combinations of scores that vary, (d, r), by their covariance.

    A hyperparameter without influence has a score of zero, and two that only act together have
    proportional scores. Neither enters the density: their posterior is their prior given the rest.
    """
    tolerance = options.smallest_eigenvalue
    spread = np.sqrt(np.diag(covariance))
    if not spread.max() > 0:
        return np.zeros((len(spread), 0))
    varies = spread > tolerance * spread.max()
    scaling = np.diag(1 / np.where(varies, spread, 1.0))[:, varies]
    eigenvalues, vectors = np.linalg.eigh(scaling.T @ covariance @ scaling)
    is_large = eigenvalues > tolerance
    return np.asarray(scaling @ (vectors[:, is_large] / np.sqrt(eigenvalues[is_large])))
