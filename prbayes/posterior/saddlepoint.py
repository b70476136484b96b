r"""Saddlepoint density of a mean of independent scores.

The density of an M-estimating equation at its root follows from the cumulant function of one
specimen's score (Field and Hampel 1982, doi:10.1093/biomet/69.1.29):

.. math:: \log L = N K(a) - \tfrac12 \log\det N K''(a), \quad
          K(a) = \log \sum_m w_m e^{a' \psi_m}, \quad K'(a) = 0.

Independent simulators add their cumulant functions :math:`N_j K_j(a)` with one tilt :math:`a`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats


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
    smallest_eigenvalue : float
        Combinations of scores with smaller eigenvalues of their correlation matrix are dropped.
    """

    iterations: int = 40
    tolerance: float = 1e-5
    smallest_variance: float = 1e-4
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
    first, second = np.triu_indices(r)
    for logs, score in zip(log_weights, scores, strict=True):
        psi = score.values
        exponents = logs + tilts @ psi.T
        largest = exponents.max(axis=1, keepdims=True)
        weights = np.exp(exponents - largest)
        totals = weights.sum(axis=1, keepdims=True)
        means = weights @ psi / totals
        pairs = psi[:, first] * psi[:, second]
        products = weights @ pairs / totals
        covariances = products - means[:, first] * means[:, second]
        cumulant = np.log(totals) + largest
        values += score.size * cumulant[:, 0]
        gradients += score.size * means
        hessians[:, first, second] += score.size * covariances
    hessians[:, second, first] = hessians[:, first, second]
    return Cumulants(values, gradients, hessians)


def saddlepoints(
    log_weights: Sequence[Floats],
    scores: Sequence[Scores],
    options: SaddlepointOptions = SaddlepointOptions(),
) -> Saddlepoints:
    """Minimise convex cumulant functions by Newton steps no longer than 1 + |a|.

    Parameters
    ----------
    log_weights : sequence of ndarray, shapes (S, M_j)
        Each row has a finite element.
    scores : sequence of Scores
    options : SaddlepointOptions
    """
    count = len(log_weights[0])
    r = scores[0].values.shape[1]
    size = sum(score.size for score in scores)
    ridge = 1e-8 * size * np.eye(r)
    tilts = np.zeros((count, r))
    state = cumulants(log_weights, scores, tilts)
    converged = _is_small(state.gradients, size, options)
    for _ in range(options.iterations):
        rows = np.flatnonzero(~converged)
        if rows.size == 0:
            break
        hessians = state.hessians[rows] + ridge
        gradients = state.gradients[rows]
        steps = -np.linalg.solve(hessians, gradients[..., None])[..., 0]
        lengths = np.linalg.norm(steps, axis=1)
        limits = 1 + np.linalg.norm(tilts[rows], axis=1)
        factors = limits / np.maximum(lengths, limits)
        tilts[rows] += steps * factors[:, None]
        some = [logs[rows] for logs in log_weights]
        step = cumulants(some, scores, tilts[rows])
        state.values[rows] = step.values
        state.gradients[rows] = step.gradients
        state.hessians[rows] = step.hessians
        converged[rows] = _is_small(step.gradients, size, options)
    return Saddlepoints(tilts, state, converged)


def _is_small(gradients: Floats, size: int, options: SaddlepointOptions) -> NDArray[np.bool_]:
    """Return where the gradient by specimen is below the tolerance, (S,)."""
    return np.linalg.norm(gradients, axis=1) < options.tolerance * size


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
    r = scores[0].values.shape[1]
    size = sum(score.size for score in scores)
    result = np.full(len(log_weights[0]), -np.inf)
    supported = [np.isfinite(logs.max(axis=1)) for logs in log_weights]
    rows = np.flatnonzero(np.all(supported, axis=0))
    if rows.size == 0:
        return result
    some = [logs[rows] for logs in log_weights]
    points = saddlepoints(some, scores, options)
    covariances = points.cumulants.hessians / size
    signs, log_dets = np.linalg.slogdet(covariances)
    usable = points.converged & (signs > 0)
    usable &= log_dets > r * np.log(options.smallest_variance)
    logs = points.cumulants.values - log_dets / 2
    result[rows] = np.where(usable, logs, -np.inf)
    return result


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
    spread = np.sqrt(np.diag(covariance))
    varies = spread > tolerance * spread.max()
    if not spread.max() > 0:
        return np.zeros((len(spread), 0))
    units = np.where(varies, spread, 1.0)
    scaling = np.diag(1 / units)[:, varies]
    correlation = scaling.T @ covariance @ scaling
    eigenvalues, vectors = np.linalg.eigh(correlation)
    is_large = eigenvalues > tolerance
    standardised = vectors[:, is_large] / np.sqrt(eigenvalues[is_large])
    return np.asarray(scaling @ standardised)
