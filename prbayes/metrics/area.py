"""The area metric: the area between two distribution functions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from prbayes._stats import cumulated, finite_sample, ranked, summed_below
from prbayes._validate import AT_ONCE, ArrayPair, Floats, Indices
from prbayes.metrics.base import (
    Basis,
    Discrepancy,
    Features,
    Metric,
    Minimum,
    Part,
    PartSum,
    projected,
)
from prbayes.metrics.grid import compiled


@dataclass(frozen=True)
class AreaMetric(Metric):
    r"""Area between two distribution functions, in units of the response.

    :math:`\int |F(z) - S_N(z)|\,dz`, F of the simulated and :math:`S_N` of the observed values.
    Exact for any sizes and weights; in one dimension it is the 1-Wasserstein distance. Specimens
    that failed (+inf) count below, in F and in S_N; the infinite last interval is left out.

    Notes
    -----
    A sum of areas underestimates a spread in common: that of a single specimen is least for a
    population without spread. In a model of several simulators the discrepancy of each is therefore
    :math:`\int |F - S_N| + g_N(S_N) - g_N(F)\,dz` with

    .. math:: g_N(p) = \int_0^p P(K < N q) - P(K > N q)\,dq, \quad K \sim \mathrm{Bin}(N, q).

    It is a strictly proper scoring rule, positive unless the functions are equal: for one specimen
    the continuous ranked probability score [2]_, for many the area. With relative weights N is
    their effective number, which removes most of the bias. A simulator alone, a direct call and
    the area test have the area itself.

    References
    ----------
    .. [1] Oh et al. (2019), eq. 5, doi:10.1007/s00158-019-02288-6.
    .. [2] Gneiting, T. and A. E. Raftery (2007), Strictly proper scoring rules, prediction, and
       estimation, JASA 102, 359-378, doi:10.1198/016214506000001437.

    Examples
    --------
    >>> AreaMetric()([0.0, 1.0], [0.5, 1.5])
    0.5
    """

    minimum: ClassVar[Minimum] = Minimum.ABSOLUTE
    counts_failures: ClassVar[bool] = True

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        return AreaDiscrepancy(self, observed, weights)


@dataclass(frozen=True, eq=False)
class AreaDiscrepancy(Discrepancy):
    """The area metric against fixed observed values."""

    specimens: int = 0  # N in the correction for few specimens; zero for the area itself

    @property
    def scale(self) -> float:
        """Mean absolute deviation of observed values from their mean, or one if they are equal."""
        values, weights = finite_sample(self.observed, self.weights)
        values = values - values.min()  # so that equal values give exactly zero
        mean_deviation = float(weights @ np.abs(values - weights @ values))
        return mean_deviation if mean_deviation > 0 else 1.0

    def features(self, simulated: Any, weights: Any, xp: Any) -> Features:
        """Return the area, (..., 1): the sum of |F - S_N| times length over intervals, eq. 5."""
        observed = self.observed
        observed_weights = self.weights
        if xp is np:
            observed = np.broadcast_to(observed, (*simulated.shape[:-1], observed.size))
            observed_weights = np.broadcast_to(observed_weights, observed.shape)
            weights = np.broadcast_to(weights, simulated.shape)
        pooled = xp.concatenate([simulated, observed], axis=-1)
        order = xp.argsort(pooled, axis=-1)
        pooled = xp.take_along_axis(pooled, order, axis=-1)
        # F goes up by the weight at each simulated value, S_N by that at each observed one.
        steps = xp.concatenate([weights, -observed_weights], axis=-1)
        steps = xp.take_along_axis(steps, order, axis=-1)
        del order  # frees memory, for populations of ten million
        # The last interval begins at the largest value and has no end.
        gap = xp.cumsum(steps, axis=-1)[..., :-1]
        below = xp.cumsum(xp.maximum(steps, 0.0), axis=-1)[..., :-1] if self.specimens else gap
        heights = _heights(below, below - gap, correction_table(self.specimens), xp)
        # Intervals that end at infinity are left out: their length is set to zero.
        is_finite = xp.abs(pooled[..., 1:]) < np.inf
        upper = xp.where(is_finite, pooled[..., 1:], 0.0)
        lower = xp.where(is_finite, pooled[..., :-1], 0.0)
        return ((heights * (upper - lower)).sum(axis=-1)[..., None],)

    def basis(self, simulated: Floats, most: float = AT_ONCE) -> Basis:
        """Return ranks of the values among the knots, all finite values, and S_N at the knots."""
        pooled = np.concatenate([simulated, self.observed])
        knots = np.unique(pooled[np.isfinite(pooled)])
        starts = knots[:-1]
        order, below = ranked(simulated, starts, kind="quicksort")
        observed = summed_below(self.weights, *ranked(self.observed, starts, kind="quicksort"))
        rows = tuple(array[None] for array in (order, below, observed, np.diff(knots)))
        return RankedBasis(rows, (self.specimens,))

    def outer(self, *features: Any, xp: Any) -> Any:
        """Return the area."""
        (areas,) = features
        return areas[..., 0]

    def together(self, parts: tuple[Part, ...]) -> PartSum:
        """Combine the area metrics of several projections into one vectorised metric."""
        return AreaSum(parts)


class AreaSum(PartSum):
    """Sum of the areas of several projections; its feature is the vector of areas, (..., K)."""

    def features(self, simulated: Any, weights: Any, xp: Any) -> Features:
        """Return the areas, (..., K)."""
        return (xp.concatenate(super().features(simulated, weights, xp), axis=-1),)

    def basis(self, simulated: Floats, most: float) -> Basis:
        """Return the ranks of all projections."""
        bases = [target.basis(values) for target, values in projected(self.parts, simulated)]
        columns = zip(*[basis.arrays for basis in bases], strict=True)
        arrays = [_padded([row for (row,) in column]) for column in columns]
        specimens = tuple(getattr(part.target, "specimens", 0) for part in self.parts)
        return RankedBasis(tuple(arrays), specimens)

    def outer(self, features: Features, shares: Floats, xp: Any) -> Any:
        """Return the sum of the areas times their shares."""
        (areas,) = features
        return (areas * shares).sum(axis=-1)


@dataclass(frozen=True, eq=False)
class RankedBasis(Basis):
    """The ranks of stored values among the knots, for each of K projections.

    The arrays, with a row for each projection, are the order of the values, the number of values up
    to each knot, S_N at the knots, (K, m) or (K, ..., m) for several data sets, and the lengths of
    the intervals between knots. Intervals of zero length fill shorter rows, so that the graph of
    many projections is no larger than that of one.
    """

    specimens: tuple[int, ...]  # N in the correction of each projection, or zero

    def features(self, weights: Any, xp: Any = np) -> Features:
        """Return the areas, (..., K)."""
        if xp is np or len(self.specimens) == 1:  # a loop takes less memory than one array
            areas = []
            for k, n in enumerate(self.specimens):
                order, below, observed, lengths = [a[k] for a in self.arrays]
                table = correction_table(n)
                if xp is np and observed.ndim == 1 and lengths.size > 16 * order.size:
                    areas.append(self._integrals[k].areas(weights, table))
                    continue
                if xp is np:
                    areas.append(_areas_by_loop(weights, order, below, observed, lengths, table))
                    continue
                simulated = summed_below(weights, order, below, xp)
                heights = _heights(simulated, observed, table, xp)
                areas.append((heights * lengths).sum(axis=-1))
            return (xp.stack(areas, axis=-1),)
        order, below, observed, lengths = self.arrays
        simulated = _rows_summed_below(xp.take(weights, order), below, xp)
        tables = np.stack([correction_table(n) for n in self.specimens])
        return ((_heights(simulated, observed, tables, xp) * lengths).sum(axis=-1),)

    @cached_property
    def _integrals(self) -> list[_Integral]:
        """The integral of S_N for each projection."""
        return [_Integral.of(*row) for row in zip(*self.arrays, strict=True)]

    def rows(self, index: Any) -> Self:
        """Return the ranks for some of several data sets."""
        order, below, observed, lengths = self.arrays
        return replace(self, arrays=(order, below, observed[:, index], lengths))


@dataclass(frozen=True, eq=False)
class _Integral:
    """Integral of the observed distribution function S_N, which makes an area cheap to compute.

    Between two simulated values the simulated distribution function F is constant, so that the
    increasing S_N crosses F at most once.
    """

    order: Indices  # order of the simulated values, (n,)
    edges: Indices  # first knots of the intervals in which F is constant, and the end, (n + 2,)
    observed: Floats  # S_N at the knots, (m,)
    positions: Floats  # distances of the knots from the first one, (m + 1,)
    integral: Floats  # integral of S_N up to each knot, (m + 1,)
    complement: Floats  # integral of 1 - S_N up to each knot, (m + 1,)

    @classmethod
    def of(
        cls,
        order: Indices,
        below: Indices,
        observed: Floats,
        lengths: Floats,
    ) -> _Integral:
        """Integrate S_N, known at the knots."""
        starts = np.searchsorted(below, np.arange(order.size) + 1)
        edges = np.concatenate([[0], starts, [lengths.size]])
        observed = without_rounding(observed)
        positions, integral, complement = (
            np.concatenate([[0.0], np.cumsum(heights * lengths)])
            for heights in (1.0, observed, 1.0 - observed)
        )
        return cls(order, edges, observed, positions, integral, complement)

    def areas(self, weights: Floats, correction: Floats) -> Floats:
        """Return the areas for weights of the simulated values, (..., n) -> (...)."""
        simulated = without_rounding(cumulated(weights, self.order))
        first = self.edges[:-1]
        last = self.edges[1:]
        crossing = np.searchsorted(self.observed, simulated).clip(first, last)
        below = self._area(simulated, first, crossing)
        above = self._area(simulated, crossing, last)
        areas = np.asarray((below - above).sum(axis=-1))
        if correction.any():
            widths = self.positions[last] - self.positions[first]
            areas += interpolated(correction, self.observed) @ np.diff(self.positions)
            areas -= (interpolated(correction, simulated) * widths).sum(axis=-1)
        return areas

    def _area(self, simulated: Floats, start: Indices, end: Indices) -> Floats:
        """Return the integrals of F - S_N between knots, where F is constant."""
        width = self.positions[end] - self.positions[start]
        direct = simulated * width - (self.integral[end] - self.integral[start])
        # In the upper half the integral of 1 - S_N has the smaller rounding error.
        by_complement = self.complement[end] - self.complement[start] - (1 - simulated) * width
        return np.where(simulated > 0.5, by_complement, direct)


def with_unbiased_areas(target: Discrepancy) -> Discrepancy:
    """Return a discrepancy in which areas have the correction for few specimens; see `AreaMetric`.

    N is the effective number of observed weights. A discrepancy without areas is returned as it is.
    """
    if isinstance(target, AreaDiscrepancy):
        n = max(1, round(target.n_effective))
        return target if n == target.specimens else replace(target, specimens=n)
    parts = target.parts
    if parts[0].target is target:
        return target
    areas = [with_unbiased_areas(part.target) for part in parts]
    pairs = list(zip(parts, areas, strict=True))
    if all(part.target is area for part, area in pairs):
        return target
    members: Any = {"members": tuple(replace(part, target=area) for part, area in pairs)}
    return replace(target, **members)


@lru_cache(maxsize=256)
def correction_table(n: int) -> Floats:
    """Return the correction g_n at equal steps from 0 to 1, (1025,); zeros for n = 0."""
    levels = np.linspace(0, 1, 1025)
    if not n:
        return np.zeros(levels.size)
    from scipy.special import betainc

    # For q between k / n and (k + 1) / n, K exceeds n q with probability P(K > k), else it is
    # below.
    q = np.union1d(levels, np.arange(n) / n)
    k = np.floor(n * (q[1:] + q[:-1]) / 2)

    def integral(q: Floats) -> Floats:
        """Integral of P(K > k), an incomplete beta function, from 0 to q."""
        mean = (k + 1) / (n + 1)
        return np.asarray(q * betainc(k + 1, n - k, q) - mean * betainc(k + 2, n - k, q))

    pieces = np.diff(q) - 2 * (integral(q[1:]) - integral(q[:-1]))
    return np.asarray(np.interp(levels, q, np.append(0.0, np.cumsum(pieces))))


def bias_and_density(n: int, p: Floats) -> ArrayPair:
    """Return the derivative of g_n at p, and the mean curvature in p of a corrected area.

    The derivative is the mean of sign(p - K / n) for a binomial K with n and p, the curvature is
    twice a beta density.
    """
    from scipy.special import betainc
    from scipy.stats import beta

    p = np.clip(p, 0.0, 1.0)
    k = np.minimum(np.floor(n * p), n - 1)
    return 1 - 2 * betainc(k + 1, n - k, p), 2 * beta.pdf(p, k + 1, n - k)


def interpolated(tables: Floats, p: Any, xp: Any = np) -> Any:
    """Interpolate tables at equal steps of p from 0 to 1, (m,) or (K, m), linearly."""
    last = tables.shape[-1] - 1
    place = p * last
    cell = xp.where(place < last - 1, xp.maximum(xp.floor(place), 0.0), last - 1.0)
    index = cell.astype("int64")
    if tables.ndim > 1:
        index = index + (last + 1) * np.arange(len(tables))[:, None]
    lower = xp.take(tables.ravel(), index)
    return lower + (place - cell) * (xp.take(tables.ravel(), index + 1) - lower)


def _heights(simulated: Any, observed: Any, tables: Floats, xp: Any) -> Any:
    """Return |F - S_N|, or with tables of a correction |F - S_N| + g(S_N) - g(F)."""
    heights = xp.abs(simulated - observed)
    if tables.any():
        heights = heights + interpolated(tables, observed, xp) - interpolated(tables, simulated, xp)
    # Otherwise the intervals between responses far beyond the data, as of an exponential function,
    # have an area by rounding.
    return xp.where(_is_equal(simulated, observed, xp), 0.0, heights)


def _is_equal(simulated: Any, observed: Any, xp: Any = np) -> Any:
    """Return whether sums of weights are equal but for rounding."""
    return xp.abs(simulated - observed) < 1e-13


def without_rounding(levels: Floats) -> Floats:
    """Return sums of weights with exact ones in place of sums that are one but for rounding."""
    return np.where(_is_equal(levels, 1.0), 1.0, levels)


def _padded(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Stack arrays as rows of one array; append zeros to those whose last axis is shorter."""
    sizes = [array.shape[-1] for array in arrays]
    out = np.zeros((len(arrays), *arrays[0].shape[:-1], max(sizes)), dtype=arrays[0].dtype)
    for row, array, size in zip(out, arrays, sizes, strict=True):
        row[..., :size] = array
    return out


def _rows_summed_below(ordered: Any, below: Any, xp: Any) -> Any:
    """Return sums of the first ``below`` numbers of each row, (K, n), (K, m) -> (K, m)."""
    total = xp.cumsum(ordered, axis=-1)
    last = xp.maximum(below - 1, 0)
    return xp.where(below > 0, xp.take_along_axis(total, last, axis=-1), 0.0)


def _areas_by_loop(
    weights: Floats, order: Indices, below: Indices, observed: Floats, *knots: Floats
) -> Floats:
    """Return areas for weights (..., n) and S_N at the knots, (..., m), of broadcast shape (...).

    ``knots`` are the lengths of the intervals and the table of a correction.
    """
    batches = [array.shape[:-1] for array in (weights, observed)]
    shape = np.broadcast_shapes(*batches)
    places = [
        np.broadcast_to(np.arange(math.prod(batch)).reshape(batch), shape).ravel()
        for batch in batches
    ]
    rows = [
        np.ascontiguousarray(array).reshape(math.prod(batch), array.shape[-1])
        for array, batch in zip((weights, observed), batches, strict=True)
    ]
    out = np.empty(len(places[0]))
    sum_areas(*places, *rows, order, below, *knots, out)
    return out.reshape(shape)


@compiled
def sum_areas(
    population: Indices,
    data_set: Indices,
    weights: Floats,
    observed: Floats,
    order: Indices,
    below: Indices,
    lengths: Floats,
    table: Floats,
    out: Floats,
) -> None:
    """Write areas between populations and data sets into ``out``; their rows are (R,) each.

    Weights have the shape (P, n), S_N at the knots (D, m), and the other arrays are those of a
    `RankedBasis` with a table of `correction_table`.
    """
    last = len(table) - 1
    has_correction = table.max() > 0
    sums = np.zeros(len(order) + 1)
    for r in range(len(out)):
        if r == 0 or population[r] != population[r - 1]:
            row = weights[population[r]]
            total = 0.0
            for i in range(len(order)):
                total += row[order[i]]
                sums[i + 1] = total
        levels = observed[data_set[r]]
        area = 0.0
        for k in range(len(below)):
            simulated = sums[below[k]]
            measured = levels[k]
            height = abs(simulated - measured)
            if height < 1e-13:  # equal but for rounding, see `_heights`
                continue
            if has_correction:
                for sign, p in ((1, measured), (-1, simulated)):
                    place = p * last
                    cell = min(max(int(place), 0), last - 1)
                    lower = table[cell]
                    rise = table[cell + 1] - lower
                    height += sign * (lower + (place - cell) * rise)
            area += height * lengths[k]
        out[r] = area
