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
    """Limits of the Newton iteration and of the density.

    Attributes
    ----------
    iterations : int
        Largest number of Newton steps.
    tolerance : float
        Largest gradient of the cumulant function by specimen, in standard deviations of the score.
    smallest_variance : float
        Smallest determinant of the tilted covariance, to the power of one over its dimension, in
        units of the covariance at the estimate. Below, the tilted distribution is nearly one atom
        and the approximation has no meaning.
    smallest_value : float
        Smallest value of the cumulant function, in nats. Below, the density counts as zero.
    smallest_eigenvalue : float
        Combinations of scores with smaller eigenvalues of their correlation matrix are dropped.
    """

    iterations: int = 40
    tolerance: float = 1e-5
    smallest_variance: float = 1e-4
    smallest_value: float = -1000.0
    smallest_eigenvalue: float = 1e-6


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of stored responses, and the number of specimens that they stand for.

    Attributes
    ----------
    values : ndarray, shape (M, r)
        Less the mean over the observed specimens.
    size : int
        Number of observed specimens.
    """

    values: Floats
    size: int

    @property
    def rank(self) -> int:
        """The number of combinations of scores, r."""
        return int(self.values.shape[1])

    @cached_property
    def pairs(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """The elements of the upper triangle of a covariance."""
        first, second = np.triu_indices(self.rank)
        return first, second

    @cached_property
    def powers(self) -> Floats:
        """Ones, scores and products of two scores, (1 + r + r (r + 1) / 2, M)."""
        first, second = self.pairs
        scores = self.values.T
        ones = np.ones((1, scores.shape[1]))
        return np.concatenate([ones, scores, scores[first] * scores[second]])


@dataclass(frozen=True, eq=False)
class Cumulants:
    """The cumulant function with its derivatives, at S tilts.

    Attributes
    ----------
    values : ndarray, shape (S,)
    gradients : ndarray, shape (S, r)
    hessians : ndarray, shape (S, r, r)
    """

    values: Floats
    gradients: Floats
    hessians: Floats


# Tilts (A, r) and the rows (A,) that they belong to -> cumulant functions of these.
CumulantFunction = Callable[[Floats, NDArray[np.intp]], Cumulants]


@dataclass(frozen=True, eq=False)
class Saddlepoints:
    """Minima of cumulant functions.

    Attributes
    ----------
    tilts : ndarray, shape (S, r)
    cumulants : Cumulants
    converged : ndarray of bool, shape (S,)
    """

    tilts: Floats
    cumulants: Cumulants
    converged: NDArray[np.bool_]


def cumulants(log_weights: Sequence[Floats], scores: Sequence[Scores], tilts: Floats) -> Cumulants:
    """Return the sum of N_j K_j(a) over simulators, with gradient and Hessian.

    Parameters
    ----------
    log_weights : sequence of ndarray, shapes (S, M_j)
        Log weights of the stored responses of each simulator; the weights of a row sum to one.
    scores : sequence of Scores
    tilts : ndarray, shape (S, r)
    """
    count, r = tilts.shape
    values = np.zeros(count)
    gradients = np.zeros((count, r))
    hessians = np.zeros((count, r, r))
    first, second = scores[0].pairs
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
        squares = means[:, first] * means[:, second]
        cumulant = np.log(totals[:, 0]) + largest
        covariances = products - squares
        values += score.size * cumulant
        gradients += score.size * means
        hessians[:, first, second] += score.size * covariances
    hessians[:, second, first] = hessians[:, first, second]
    return Cumulants(values, gradients, hessians)


def saddlepoints(
    log_weights: Sequence[Floats],
    scores: Sequence[Scores],
    options: SaddlepointOptions = SaddlepointOptions(),
) -> Saddlepoints:
    """Minimise the cumulant functions of means of scores.

    Parameters
    ----------
    log_weights : sequence of ndarray, shapes (S, M_j)
        Each row has a finite element.
    scores : sequence of Scores
    options : SaddlepointOptions
    """

    def function(tilts: Floats, rows: NDArray[np.intp]) -> Cumulants:
        if len(rows) == len(log_weights[0]):
            return cumulants(log_weights, scores, tilts)
        return cumulants([logs[rows] for logs in log_weights], scores, tilts)

    shape = len(log_weights[0]), scores[0].rank
    size = sum(score.size for score in scores)
    return minimum(function, shape, size, options)


def minimum(
    function: CumulantFunction,
    shape: tuple[int, int],
    size: int,
    options: SaddlepointOptions = SaddlepointOptions(),
) -> Saddlepoints:
    """Minimise convex cumulant functions by Newton steps no longer than 1 + |a|.

    Parameters
    ----------
    function : callable
        ``function(tilts, rows)``, shapes (A, r), (A,): cumulant functions ``rows``.
    shape : tuple of int
        Number of functions S, and of elements of a tilt r.
    size : int
        Number of observed specimens.
    options : SaddlepointOptions
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
        hessians = state.hessians[rows] + ridge
        gradients = state.gradients[rows, :, None]
        steps = np.linalg.solve(hessians, gradients)
        steps = steps[:, :, 0]
        lengths = np.linalg.norm(steps, axis=1)
        longest = 1 + np.linalg.norm(tilts[rows], axis=1)
        factors = longest / np.maximum(lengths, longest)
        tilts[rows] -= steps * factors[:, None]
        step = function(tilts[rows], rows)
        state.values[rows] = step.values
        state.gradients[rows] = step.gradients
        state.hessians[rows] = step.hessians
        sizes = np.linalg.norm(step.gradients, axis=1)
        converged[rows] = sizes < limit
    return Saddlepoints(tilts, state, converged)


def log_density(
    log_weights: Sequence[Floats],
    scores: Sequence[Scores],
    options: SaddlepointOptions = SaddlepointOptions(),
) -> Floats:
    """Return the log-density of a mean score of zero, up to a constant, (S,).

    It is -inf without a saddlepoint: then zero is outside of the convex hull of the scores.

    Parameters
    ----------
    log_weights : sequence of ndarray, shapes (S, M_j)
        -inf or NaN throughout a row if no stored response supports its population.
    scores : sequence of Scores
        In units in which their covariance is about one.
    options : SaddlepointOptions
    """
    size = sum(score.size for score in scores)
    result = np.full(len(log_weights[0]), -np.inf)
    is_supported = np.ones(len(result), dtype=bool)
    for logs in log_weights:
        largest = logs.max(axis=1)
        is_supported &= np.isfinite(largest)
    if not is_supported.any():
        return result
    supported = [logs[is_supported] for logs in log_weights]
    points = saddlepoints(supported, scores, options)
    result[is_supported] = density_at(points, size, options)
    return result


def density_at(points: Saddlepoints, size: int, options: SaddlepointOptions) -> Floats:
    """Return log-densities up to a constant, (S,): -inf without a saddlepoint.

    Parameters
    ----------
    points : Saddlepoints
    size : int
        Number of observed specimens.
    options : SaddlepointOptions
    """
    smallest = points.tilts.shape[1] * np.log(options.smallest_variance)
    covariances = points.cumulants.hessians / size
    signs, log_dets = np.linalg.slogdet(covariances)
    is_usable = points.converged & (signs > 0)
    is_usable &= log_dets > smallest
    log_densities = points.cumulants.values - log_dets / 2
    log_densities[~is_usable] = -np.inf
    return np.asarray(log_densities)


def varying_combinations(covariance: Floats, options: SaddlepointOptions) -> Floats:
    """Return the standardised combinations of scores that vary, (d, r).

    A hyperparameter without influence has a score of zero, and two that only act together have
    proportional scores. Neither enters the density, so their posterior is their prior given the
    rest.

    Parameters
    ----------
    covariance : ndarray, shape (d, d)
        Of the scores.
    options : SaddlepointOptions
    """
    tolerance = options.smallest_eigenvalue
    variances = np.diag(covariance)
    spread = np.sqrt(variances)
    largest = spread.max()
    if not largest > 0:
        return np.zeros((len(spread), 0))
    varies = spread > tolerance * largest
    units = np.where(varies, spread, 1.0)
    scaling = np.diag(1 / units)
    scaling = scaling[:, varies]
    correlation = scaling.T @ covariance @ scaling
    eigenvalues, vectors = np.linalg.eigh(correlation)
    is_large = eigenvalues > tolerance
    sizes = np.sqrt(eigenvalues[is_large])
    standardised = vectors[:, is_large] / sizes
    return np.asarray(scaling @ standardised)
