"""The area metric: the area between two distribution functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from prbayes._stats import finite_sample, ranked, summed_below
from prbayes._validate import Floats
from prbayes.metrics._loops import sum_below
from prbayes.metrics.base import Discrepancy, Metric, Minimum

# Weights from which on a compiled loop repays its loading; by judgement.
_MANY = 1 << 16


@dataclass(frozen=True)
class AreaMetric(Metric):
    r"""Area between two distribution functions, in units of the response.

    :math:`\int |F(z) - S_N(z)|\,dz`, F of the simulated and :math:`S_N` of the observed values.
    Exact for any sizes and weights; in one dimension it is the 1-Wasserstein distance. Specimens
    that failed (+inf) count below, in F and in S_N; the infinite last interval is left out.

    References
    ----------
    .. [1] Oh et al. (2019), eq. 5, doi:10.1007/s00158-019-02288-6.

    Examples
    --------
    >>> AreaMetric()([0.0, 1.0], [0.5, 1.5])
    0.5
    """

    minimum: ClassVar[Minimum] = Minimum.ABSOLUTE
    counts_failures: ClassVar[bool] = True

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        return AreaDiscrepancy(self, observed, weights)


class AreaDiscrepancy(Discrepancy):
    """The area metric against fixed observed values."""

    @property
    def scale(self) -> float:
        """Mean absolute deviation of observed values from their mean, or one if they are equal."""
        values, weights = finite_sample(self.observed, self.weights)
        from_least = values - values.min()  # equal values give exactly zero
        mean = weights @ from_least
        deviations = np.abs(from_least - mean)
        mean_deviation = float(weights @ deviations)
        return mean_deviation if mean_deviation > 0 else 1.0

    def features(self, simulated: Any, weights: Any, xp: Any) -> tuple[Any, ...]:
        """Return F - S_N on each interval of the pooled values, and the interval's length."""
        observed = self.observed
        u = self.weights
        if xp is np:
            batch = simulated.shape[:-1]
            observed = np.broadcast_to(observed, (*batch, observed.size))
            u = np.broadcast_to(u, observed.shape)
            weights = np.broadcast_to(weights, simulated.shape)
        # Sort both sides together.
        pooled = xp.concatenate([simulated, observed], axis=-1)
        order = xp.argsort(pooled, axis=-1)
        pooled = xp.take_along_axis(pooled, order, axis=-1)
        # F goes up by the weight at each simulated value, S_N by that at each observed one.
        signed = xp.concatenate([weights, -u], axis=-1)
        signed = xp.take_along_axis(signed, order, axis=-1)
        del order  # a population of ten million is to fit into little memory
        # The last interval begins at the largest value and has no end.
        gap = xp.cumsum(signed, axis=-1)
        gap = gap[..., :-1]
        return gap, _lengths(pooled, xp)

    def basis(self, simulated: Floats) -> tuple[NDArray[Any], ...]:
        """Return the order of the values and how many are below each knot, for both sides.

        The knots are all finite values; last come the lengths of the intervals between them.
        """
        both = np.concatenate([simulated, self.observed])
        knots = np.unique(both[np.isfinite(both)])
        starts = knots[:-1]
        order, below = ranked(simulated, starts, kind="quicksort")
        own, own_below = ranked(self.observed, starts, kind="quicksort")
        lengths = np.diff(knots)
        return order, below, own, own_below, lengths

    def from_basis(self, weights: Any, basis: tuple[Any, ...], xp: Any) -> tuple[Any, ...]:
        """Return F - S_N on each interval between knots, and the interval's length."""
        order, below, own, own_below, lengths = basis
        if xp is np and weights.size > _MANY:
            simulated = _many_summed_below(weights, order, below)
        else:
            simulated = summed_below(weights, order, below, xp)
        observed = summed_below(self.weights, own, own_below, xp)
        return simulated - observed, lengths

    def outer(self, *features: Any, xp: Any) -> Any:
        """Return the sum of |F - S_N| times length: eq. 5."""
        gap, lengths = features
        areas = xp.abs(gap) * lengths
        return areas.sum(axis=-1)

    @staticmethod
    def stacked(bases: Sequence[tuple[NDArray[Any], ...]]) -> tuple[NDArray[Any], ...]:
        """Return bases with a leading axis, padded by intervals without length."""
        return tuple(_padded(arrays) for arrays in zip(*bases, strict=True))

    @staticmethod
    def side_by_side(
        targets: Sequence[AreaDiscrepancy], weights: Any, basis: tuple[Any, ...], xp: Any
    ) -> Any:
        """Return the areas from a stacked basis, (..., K); in a graph all at a time."""
        if xp is np:  # one after the other, as it takes less memory
            areas = []
            for target, own in zip(targets, zip(*basis, strict=True), strict=True):
                features = target.from_basis(weights, own, np)
                areas.append(target.outer(*features, xp=np))
            return np.stack(areas, -1)
        order, below, own_order, own_below, lengths = basis
        ordered = xp.take(weights, order)
        simulated = _rows_summed_below(ordered, below, xp)
        observed = _padded([target.weights for target in targets])
        rows = np.arange(len(targets))[:, None]
        own_ordered = xp.as_tensor(observed)[rows, own_order]
        of_data = _rows_summed_below(own_ordered, own_below, xp)
        gaps = xp.abs(simulated - of_data)
        return (gaps * lengths).sum(axis=-1)


def _many_summed_below(weights: Floats, order: NDArray[np.intp], below: NDArray[np.intp]) -> Floats:
    """Return what `summed_below` does, reading and writing each number once."""
    rows = np.ascontiguousarray(weights).reshape(-1, weights.shape[-1])
    out = np.empty((len(rows), len(below)))
    sum_below(rows, order, below, out)
    return out.reshape(*weights.shape[:-1], -1)


def _padded(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return arrays of one axis as rows of one array, with zeros behind those that are shorter."""
    out = np.zeros((len(arrays), max(map(len, arrays))), dtype=arrays[0].dtype)
    for row, array in zip(out, arrays, strict=True):
        row[: array.size] = array
    return out


def _rows_summed_below(ordered: Any, below: Any, xp: Any) -> Any:
    """Return for each row the sums of its first ``below`` numbers, (K, n), (K, m) -> (K, m)."""
    total = xp.cumsum(ordered, axis=-1)
    last = xp.maximum(below - 1, 0)
    return xp.where(below > 0, xp.take_along_axis(total, last, axis=-1), 0.0)


def _lengths(pooled: Any, xp: Any) -> Any:
    """Return the lengths of intervals between sorted values, zero for those that have no end."""
    upper = pooled[..., 1:]
    lower = pooled[..., :-1]
    finite = xp.abs(upper) < np.inf
    end = xp.where(finite, upper, 0.0)
    start = xp.where(finite, lower, 0.0)
    return end - start
