"""Distribution functions, quantiles and envelopes of weighted samples.

A distribution function at fixed points is linear in the weights; the rest depends on the order of
the values alone. `ranked` finds that order, and `cumulated` sums weights in it.

NaN is above +inf, as when NumPy sorts: it keeps its weight and is below no point.

The min-P combination of p-values (Westfall and Young 1993) and the log of a sum of exponentials are
here as well.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from prbayes._validate import ArrayPair, Floats, Indices

# Algorithm of a sort. The order of equal values affects only the last digit of a sum of weights.
# "stable" gives the same order on every processor, "quicksort" is seven times faster for 100 000
# values.
Sorting = Literal["stable", "quicksort"]

# Probability of intervals, which is ArviZ's default az.rcParams["stats.ci_prob"]
INTERVAL = 0.89

# Number of replicates for an envelope. The coverage for right models then has a standard error of
# .007, and more would only cost memory.
ENVELOPED = 999


def finite_sample(values: Floats, weights: Floats) -> ArrayPair:
    """Return the finite values with positive weight, (n,), and weights that sum to one."""
    is_positive = weights > 0
    is_finite = is_positive & np.isfinite(values)
    w = weights[is_finite]
    if is_finite.sum() < is_positive.sum():
        w = w / w.sum()
    return values[is_finite], w


def positive_scale(scale: Floats, otherwise: float = 1.0) -> Floats:
    """Return a scale by which numbers are divided, with another number where it is not positive."""
    return np.where(scale > 0, scale, otherwise)


def ranked(values: Floats, points: Floats, *, kind: Sorting = "stable") -> tuple[Indices, Indices]:
    """Return the order of values, (n,), and how many of them are not above each point, (m,)."""
    order = np.argsort(values, kind=kind)
    below = np.searchsorted(values[order], points, side="right")
    return order, below


def cumulated(weights: Floats, order: Indices) -> Floats:
    """Return sums of the first 0, 1, ... n weights in an order, (..., n), (n,) -> (..., n + 1)."""
    total = np.cumsum(weights[..., order], axis=-1)
    zero = np.zeros((*total.shape[:-1], 1))
    return np.concatenate([zero, total], axis=-1)


def summed_below(weights: Any, order: Indices, below: Any, xp: Any = np) -> Any:
    """Return the sums of the first ``below`` weights in an order, (..., n), (n,), (m,) -> (..., m).

    ``cumulated(weights, order)[..., below]`` by operations that JAX differentiates too: no array is
    split into parts of unknown length. ``xp`` is `numpy` or `pytensor.tensor`.
    """
    total = xp.cumsum(xp.take(weights, order, axis=-1), axis=-1)
    last = xp.maximum(below - 1, 0)
    return xp.where(below > 0, xp.take(total, last, axis=-1), 0.0)


def distribution_function(
    values: Floats, weights: Floats, points: Floats, *, kind: Sorting = "stable"
) -> Floats:
    """Return the weight of the values that are not above each point, (..., m).

    Values have shape (n,) or (..., n), weights (..., n); the weights are not normalised here.
    """
    # A batch of values without strides repeats one row: sort it once.
    if values.ndim == 1 or (values.size > 0 and not any(values.strides[:-1])):
        first = (0,) * (values.ndim - 1)
        order, below = ranked(values[first], points, kind=kind)
        return cumulated(weights, order)[..., below]
    rows = np.broadcast_to(values, weights.shape)
    batch = weights.shape[:-1]
    out = np.empty((*batch, points.size))
    for i in np.ndindex(batch):
        out[i] = distribution_function(rows[i], weights[i], points, kind=kind)
    return out


def quantile(values: Floats, weights: Floats, probability: ArrayLike) -> Floats:
    """Return quantiles of weighted samples, linear between the mid-points of the function's steps.

    Values and weights, (..., n), and a probability, () or (m,), give (...) or (..., m). The weights
    of a row sum to one; with equal weights this is Hazen's definition. Leave out values of weight
    zero, which are corners of the curve like others, and NaN.
    """
    quantiles = np.asarray(_row_quantiles(values, weights, np.atleast_1d(probability)))
    return quantiles if np.ndim(probability) > 0 else quantiles[..., 0]


def ascending_quantile(values: Floats, weights: Floats, levels: float | Floats) -> Floats:
    """Return `quantile` of ascending values, (n,), with weights (n,): (), or (m,) of m levels."""
    middles = np.cumsum(weights) - 0.5 * weights
    return np.asarray(np.interp(levels, middles, values))


def _quantiles_of_row(values: Floats, weights: Floats, levels: Floats) -> Floats:
    # Sort equal values by weight, so that the result does not depend on their order in the sample.
    order = np.lexsort((weights, values))
    return ascending_quantile(values[order], weights[order], levels)


_row_quantiles = np.vectorize(_quantiles_of_row, [np.float64], signature="(n),(n),(m)->(m)")


def tail_levels(prob: float) -> list[float]:
    """Return the probabilities of the ends of an interval with equal tails."""
    return [(1 - prob) / 2, (1 + prob) / 2]


def reached(weights: Floats, levels: Floats, *, normalized: bool = False) -> Indices:
    """Return the index at which the running sum of weights first reaches each level.

    Weights (..., n) and levels (..., m) give indices (..., m): the step-wise quantile of ascending
    values, or systematic resampling with evenly spaced levels. A level that is never reached gives
    the last index; ``normalized`` levels are relative to the sum of the weights.
    """
    total = np.cumsum(weights, axis=-1)
    if normalized:
        whole = total[..., -1:]
        total = total / positive_scale(whole)
    last = total.shape[-1] - 1
    return np.asarray(np.minimum(_row_positions(total, levels), last), dtype=np.intp)


_row_positions = np.vectorize(np.searchsorted, [np.intp], signature="(n),(m)->(m)")


def envelope(replicates: Floats, level: float) -> tuple[Floats, Floats]:
    """Return bounds of n sorted values that contain a share 1 - level of replicates entirely.

    The bounds leave out the same number of the (r, n) replicates on either side, the largest that
    will do. This is the simulation of Säilynoja, Bürkner and Vehtari [1]_, with ranks among
    replicates in place of binomial tails: `arviz_stats.ecdf_utils` assumes independent uniform
    values, which those of a posterior's populations, or of one specimen under several conditions,
    are not.

    References
    ----------
    .. [1] Säilynoja, T., P.-C. Bürkner and A. Vehtari (2022), Graphical test for discrete
       uniformity and its applications in goodness-of-fit evaluation and multiple sample comparison,
       Stat. Comput. 32, 32, doi:10.1007/s11222-022-10090-6.
    """
    rows = np.sort(replicates, axis=1)
    columns = np.sort(rows, axis=0)
    size = len(rows)
    # depth: number of replicates that are as far out, on the nearer side, at each one's outermost
    # value
    depth = np.full(size, size)
    for column, values in zip(columns.T, rows.T, strict=True):
        as_low = np.searchsorted(column, values, side="right")
        as_high = size - np.searchsorted(column, values, side="left")
        depth = np.minimum(depth, np.minimum(as_low, as_high))
    depth.sort()
    k = max(1, int(depth[int(level * size)]))
    return columns[k - 1], columns[size - k]


def upper_p_values(statistics: Floats, null: Floats) -> Floats:
    """Return p-values of C statistics of S data sets, (S, C), large values rejecting.

    ``null``, (B, C), has the statistics of bootstrap samples.
    """
    sorted_null = np.sort(null, axis=0)
    smaller = [
        np.searchsorted(column, values)
        for column, values in zip(sorted_null.T, statistics.T, strict=True)
    ]
    return (len(null) - np.stack(smaller, axis=-1) + 1) / (len(null) + 1)


def adjusted_p_values(observed: Floats, null: Floats) -> Floats:
    """Return p-values adjusted for the choice among the statistics, (C,).

    The smallest is the p-value of the combined test: the share of bootstrap samples whose smallest
    p-value is as small.
    """
    p_values = upper_p_values(observed[None], null)[0]
    smallest = np.sort(upper_p_values(null, null).min(axis=1))
    adjusted: Floats = (np.searchsorted(smallest, p_values, side="right") + 1) / (len(null) + 1)
    return adjusted


def log_sum_exp(terms: Floats) -> Floats:
    """Return the log of the sum of exponentials over the last axis.

    -inf where there are no terms, or all are -inf. SciPy's takes four to ten times as long.
    """
    if terms.shape[-1] == 1:
        return terms[..., 0].copy()
    largest = terms.max(axis=-1, keepdims=True, initial=-np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = terms - largest
        # Exponentials that underflow take seven times as long.
        np.maximum(scaled, -700.0, out=scaled)
        np.exp(scaled, out=scaled)
        total, largest = np.log(scaled.sum(axis=-1)), largest[..., 0]
    return np.where(np.isfinite(largest), total + largest, largest)
