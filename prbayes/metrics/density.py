"""Density estimates, bandwidth rules, and discrepancies of two densities.

A metric compares the simulated density with the observed one on the same *cells*. They are laid out
once, from the observed values; a density is then linear in the weights of the sample, which makes
the metrics cheap and differentiable.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar, Self, cast

import numpy as np

from prbayes._stats import finite_sample, positive_scale, quantile
from prbayes._validate import (
    AT_ONCE,
    ArrayPair,
    Floats,
    Names,
    positive_integer,
    positive_number,
    sample_weights,
)
from prbayes.metrics.base import (
    Basis,
    DenseBasis,
    Discrepancy,
    Features,
    Minimum,
    Part,
    PartSum,
    projected,
)
from prbayes.metrics.grid import BinCells, Cells, KernelCells, product

# Number of grid nodes per bandwidth. The density is exact to 3e-5 of a kernel's peak (test).
_PER_BANDWIDTH = 4

# Largest number of cells, which limits the memory of one population's density to 64 kB.
_MAX_CELLS = 8192

# Weight of the uniform density that is mixed into densities before a logarithm is taken. Any value
# up to 1e-6 gives the same minimum on normal data; 1e-7 lets a forward divergence leave out an
# outlier that 1e-9 keeps in (tests). Grids end where a kernel has 1e-9 of its mass left.
_FLOOR = 1e-9

BandwidthRule = Callable[[Floats, Floats], float]


def spread(sample: Floats, weights: Floats) -> float:
    """Return min(standard deviation, IQR / 1.34) of a weighted sample; the former if IQR is zero.

    1.34 is the interquartile range of the standard normal distribution.
    """
    sample = sample - sample.min()  # so that equal values give exactly zero
    mean = weights @ sample
    sd = float(np.sqrt(weights @ (sample - mean) ** 2))
    low, high = quantile(sample, weights, [0.25, 0.75])
    iqr = float(high - low)
    return min(sd, iqr / 1.34) if iqr > 0 else sd


def silverman(sample: Floats, weights: Floats) -> float:
    """Return Silverman's bandwidth (1986, eq. 3.31), 0.9 min(sd, IQR/1.34) n^(-1/5).

    The sample size n is the effective one.

    >>> import numpy as np
    >>> round(silverman(np.arange(32.0), np.full(32, 1 / 32)), 3)
    4.155
    """
    return float(0.9 * spread(sample, weights) * (weights**2).sum() ** 0.2)


def twice_silverman(sample: Floats, weights: Floats) -> float:
    """Return two Silverman bandwidths: the default of the metrics that smooth both sides alike."""
    return 2 * silverman(sample, weights)


def likelihood_bandwidth(sample: Floats, weights: Floats) -> float:
    """Return 0.35 min(sd, IQR/1.34) n^(-1/4), the default of the kernel log-likelihood.

    It smooths the simulated side only, so that the fitted population is too narrow by about
    h^2 / (2 sd^2), which is at most a tenth of the sampling error sd / sqrt(2 n).
    """
    return float(0.35 * spread(sample, weights) * (weights**2).sum() ** 0.25)


class DensityEstimator(ABC):
    """A density estimator; ``cells(observed, weights)`` lays out its cells once."""

    @abstractmethod
    def cells(self, observed: Floats, weights: Floats) -> Cells:
        """Return the cells for observed values, shape (N,), with weights that sum to one."""


@dataclass(frozen=True)
class GaussianKDE(DensityEstimator):
    """Gaussian kernel density with one bandwidth, fixed by the observed side, for both sides.

    The sample is binned on a regular grid of four nodes per bandwidth, with cubic B-spline weights,
    and smoothed there. The kernel is narrowed by the spline's variance. The density thus has the
    exact variance and an error of fourth order in the spacing. It is twice differentiable in the
    sample, also where the grid ends.

    Parameters
    ----------
    bandwidth : float or callable, optional
        In units of the response, or a rule ``(observed, weights) -> float``. By default the rule of
        the metric: ``likelihood_bandwidth`` in `LogLikelihood`, two Silverman bandwidths elsewhere.

    Raises
    ------
    TypeError, ValueError
        If ``bandwidth`` is not as described; when prepared against observed values that are all
        equal, or that span more than 1024 bandwidths.

    References
    ----------
    .. [1] Oh et al. (2019), eq. 9, doi:10.1007/s00158-019-02288-6.
    .. [2] Hall, P. and M. P. Wand (1996), On the accuracy of binned kernel density estimators,
       J. Multivariate Anal. 56, 165-184.

    Examples
    --------
    >>> import numpy as np
    >>> cells = GaussianKDE(bandwidth=0.5).cells(np.array([0.0, 1.0]), np.array([0.5, 0.5]))
    >>> density = cells.density(np.array([0.0]), np.ones(1))
    >>> bool(np.isclose(density @ cells.widths, 1.0))
    True
    """

    bandwidth: float | BandwidthRule | None = None

    def __post_init__(self) -> None:
        if self.bandwidth is not None and not callable(self.bandwidth):
            positive_number(self.bandwidth, "bandwidth")

    def cells(self, observed: Floats, weights: Floats) -> Cells:
        """Return a grid over the observed range and a margin: six bandwidths, or half the range."""
        observed, weights = finite_sample(observed, weights)
        rule = twice_silverman if self.bandwidth is None else self.bandwidth
        h = rule(observed, weights) if callable(rule) else float(rule)
        if not np.isfinite(h) or h <= 0:
            raise ValueError(
                f"bandwidth: got {h:g} from {observed.size} observed values with spread "
                f"{np.ptp(observed):g}, expected a positive one; pass GaussianKDE(bandwidth=...) "
                "in units of the response, or use AreaMetric, which needs none"
            )
        # The grid ends where kernels of observed values have at most `_FLOOR` of their mass left.
        step = h / _PER_BANDWIDTH
        length = float(np.ptp(observed))
        margin = max(6.0 * h, length / 2)
        low = float(observed.min()) - margin
        n_nodes = int(np.ceil((float(observed.max()) - low + margin) / step)) + 1
        if n_nodes > _MAX_CELLS:
            allowed = _MAX_CELLS / _PER_BANDWIDTH / 2
            raise ValueError(
                f"bandwidth: got {h:g} for observed values that span {length:g}, expected a span "
                f"below {allowed:g} bandwidths; look for outliers, pass a larger "
                "GaussianKDE(bandwidth=...), or use AreaMetric"
            )
        # The kernel at the nodes, up to 2e-11 of its peak. Its variance is reduced by that of a
        # cubic B-spline, step^2 / 3, which binning adds.
        s = np.sqrt(h**2 - step**2 / 3)
        reach = int(np.ceil(7 * s / step))
        u = step * np.arange(-reach, reach + 1) / s
        kernel = np.exp(-0.5 * u**2) / (s * np.sqrt(2 * np.pi))
        # The mass of a kernel at each node that is beyond the lower end of the grid; reversed, it
        # is the mass beyond the upper end.
        mass = np.concatenate([[0.0], np.cumsum(kernel * step)])
        nodes = np.arange(n_nodes + 2 * (reach + 2)) - (reach + 2)
        below = mass[np.clip(reach - nodes, 0, mass.size - 1)]
        tight = 2 * np.sqrt(np.pi) * h  # the integral of a kernel's square is 1 / tight
        centers = low + step * np.arange(n_nodes, dtype=np.float64)
        widths = np.r_[np.full(n_nodes, step), tight, tight]
        return KernelCells(
            widths=widths,
            centers=centers,
            smooth=True,
            floor=_FLOOR / widths.sum(),
            bandwidth=h,
            step=step,
            kernel=kernel,
            low=float(centers[0] / step),
            margin=reach + 2,
            mass_outside=np.stack([below, below[::-1]]),
        )


@dataclass(frozen=True)
class Histogram(DensityEstimator):
    """Normalised histogram on equal bins over the observed range, and two for the mass outside.

    Parameters
    ----------
    bins : int, optional
        Number of bins over the observed range; by default ceil(range / (2 s N^(-1/3))), the
        Freedman-Diaconis rule with s = min(1.34 sd, IQR), at least five.

    Raises
    ------
    TypeError, ValueError
        If ``bins`` is not as described; when prepared against observed values that are all equal.

    References
    ----------
    .. [1] Oh et al. (2019), eq. 7 and 8, doi:10.1007/s00158-019-02288-6.

    Examples
    --------
    >>> import numpy as np
    >>> cells = Histogram(bins=2).cells(np.array([0.0, 2.0]), np.array([0.5, 0.5]))
    >>> cells.density(np.array([0.5, 0.6, 1.5, 9.0]), np.full(4, 0.25))
    array([0.5 , 0.25, 0.  , 0.25])
    """

    bins: int | None = None

    def __post_init__(self) -> None:
        if self.bins is not None:
            positive_integer(self.bins, "bins")

    def cells(self, observed: Floats, weights: Floats) -> Cells:
        """Return equal bins over the observed range, and one bin's width for either outside."""
        observed, weights = finite_sample(observed, weights)
        low = float(observed.min())
        high = float(observed.max())
        if high <= low:
            raise ValueError(
                f"histogram: got {observed.size} observed values, all {low:g}, expected at least "
                "two different ones; use AreaMetric, which needs no bins"
            )
        bins = self.bins
        if bins is None:
            bin_width = 2 * 1.34 * spread(observed, weights) * float((weights**2).sum()) ** (1 / 3)
            # There are at least five bins, so that few observations show some shape.
            n_bins = np.ceil((high - low) / bin_width) if bin_width > 0 else _MAX_CELLS
            bins = int(np.clip(n_bins, 5, _MAX_CELLS))
        width = (high - low) / bins
        widths = np.full(bins + 2, width)
        return BinCells(
            widths=widths,
            centers=low + width * (np.arange(bins, dtype=np.float64) + 0.5),
            smooth=False,
            floor=_FLOOR / widths.sum(),
        )


def density_estimator(
    density: object, bandwidth: BandwidthRule = twice_silverman
) -> DensityEstimator:
    """Return a density estimator with the metric's bandwidth rule, or raise TypeError."""
    if isinstance(density, GaussianKDE) and density.bandwidth is None:
        return replace(density, bandwidth=bandwidth)
    if isinstance(density, DensityEstimator):
        return density
    got = f"{type(density).__name__} {density!r}"
    if isinstance(density, type):
        got = f"the class {density.__name__}"
    raise TypeError(
        f"density: got {got}, expected prb.GaussianKDE() or prb.Histogram(), perhaps with arguments"
    )


@dataclass(frozen=True, eq=False)
class DensityDiscrepancy(Discrepancy):
    """A discrepancy of two densities on the same cells.

    The only feature is the simulated density, shape (..., m). A metric that derives from this class
    defines `outer`, and nothing else unless it needs further fields; ``on_cells`` constructs it. In
    ``outer``, ``self.density`` is the observed density, and an integral is a sum over the last axis
    of values times ``self.cells.widths``. The last two cells are the mass below and above all
    others.

    Attributes
    ----------
    metric, observed, weights
        As for `Discrepancy`.
    cells : Cells
        Laid out once, from the values that the metric was prepared with.
    density : ndarray, shape (m,) or (..., m)
        Observed density on the cells, in 1 / units of the response; a row for each data set.
    """

    cells: Cells
    density: Floats
    _by_data_set: ClassVar[Names] = ("weights", "density")

    @classmethod
    def on_cells(cls, metric: Any, observed: Floats, weights: Floats, cells: Cells) -> Self:
        """Return the discrepancy from observed values with their density on given cells.

        Parameters
        ----------
        metric : Metric
        observed, weights : ndarray, shape (N,)
        cells : Cells
            Usually those that the metric's estimator lays out for the observed values.
        """
        return cls(metric, observed, weights, cells, cells.density(observed, weights))

    def with_observed(self, observed: Floats, weights: Floats | None = None) -> Self:
        """Return the same metric, on the same cells, against other values; for resampling."""
        w = sample_weights(weights, observed.size)
        if w.ndim == 1:
            density = self.cells.density(observed, w)
        else:
            density = product(w, self.cells.basis(observed))
        return replace(self, observed=observed, weights=w, density=density)

    def features(self, simulated: Any, weights: Any, xp: Any) -> Features:
        """Return the density on the cells."""
        return (self.cells.density(simulated, weights),)

    def basis(self, simulated: Floats, most: float = AT_ONCE) -> Basis:
        """Return the matrix A with density = weights @ A."""
        return DenseBasis((self.cells.basis(simulated),))

    def together(self, parts: tuple[Part, ...]) -> PartSum:
        """Combine discrepancies of several projections into one, with all cells in one array."""
        return DensitySum(parts)

    @property
    def scale(self) -> float:
        """One: divergences and log densities have no units."""
        return 1.0

    def floored(self, density: Any, floor: Any = None) -> Any:
        """Mix a density with 1e-9 of the uniform density over all cells: the package's only floor.

        It bounds logarithms at log(1e-9 / length) where a population leaves the observed values.
        """
        return (1 - _FLOOR) * density + (self.cells.floor if floor is None else floor)


class CellwiseDiscrepancy(DensityDiscrepancy):
    """A discrepancy of two densities that is a sum over the cells.

    Several of them, on cells of their own, are one sum over all cells.
    """

    @property
    @abstractmethod
    def constants(self) -> tuple[Any, ...]:
        """Arguments of `terms` besides the density: arrays (m,) or (..., m) by cell, or numbers."""

    @abstractmethod
    def terms(self, density: Any, constants: tuple[Any, ...], xp: Any) -> Any:
        """Return the term of each cell, shape (..., m), from these arguments and the metric only.

        The constants may be concatenated from several discrepancies.
        """

    def outer(self, *features: Any, xp: Any) -> Any:
        """Return the sum over the cells."""
        # Numbers become arrays, so that graphs of other data have the same structure.
        constants = tuple(map(np.atleast_1d, self.constants))
        return self.terms(features[0], constants, xp).sum(axis=-1)


class DensitySum(PartSum):
    """Sum of components that compare densities; one matrix product gives all densities."""

    @cached_property
    def cells(self) -> list[Cells]:
        """The cells of each component."""
        return [cast(DensityDiscrepancy, part.target).cells for part in self.parts]

    @cached_property
    def _slices(self) -> list[slice]:
        """The slice of each component's cells in the array of all cells."""
        ends = np.cumsum([0, *(cells.widths.size for cells in self.cells)]).tolist()
        return [slice(start, end) for start, end in pairwise(ends)]

    @property
    def n_cells(self) -> int:
        """Number of all cells."""
        return int(self._slices[-1].stop)

    @cached_property
    def _constants(self) -> tuple[Floats, ...] | None:
        """Constants of one sum over all cells; None unless all components are sums over cells."""
        targets = [part.target for part in self.parts]
        if not all(isinstance(target, CellwiseDiscrepancy) for target in targets):
            return None
        by_part = [cast(CellwiseDiscrepancy, target).constants for target in targets]
        concatenated = []
        for numbers in zip(
            *by_part, strict=True
        ):  # an array by cell, or one number for a component
            batch = np.broadcast_shapes(*(np.shape(x)[:-1] for x in numbers))
            shapes = [(*batch, cells.widths.size) for cells in self.cells]
            columns = map(np.broadcast_to, numbers, shapes)
            concatenated.append(np.concatenate(list(columns), axis=-1))
        return tuple(concatenated)

    def features(self, simulated: Any, weights: Any, xp: Any) -> Features:
        """Return the densities on all cells, (..., cells)."""
        return (xp.concatenate(super().features(simulated, weights, xp), axis=-1),)

    def basis(self, simulated: Floats, most: float) -> Basis:
        """Return one matrix, (n, cells), or the projections if the matrix would be too large."""
        if len(self.parts) > 1 and len(simulated) * self.n_cells > most:
            projections = np.stack(
                [values for _, values in projected(self.parts, simulated)], axis=-1
            )
            return BinnedBasis((projections,), self)
        matrix = np.empty((len(simulated), self.n_cells))
        values_by_part = (values for _, values in projected(self.parts, simulated))
        for values, cells, place in zip(values_by_part, self.cells, self._slices, strict=True):
            matrix[:, place] = cells.basis(values)
        return DenseBasis((matrix,))

    def binned(self, projections: Floats, weights: Floats) -> Floats:
        """Return the densities on all cells, (n, K), (..., n) -> (..., cells)."""
        densities = [
            cells.density(np.broadcast_to(values, weights.shape), weights)
            for values, cells in zip(projections.T, self.cells, strict=True)
        ]
        return np.concatenate(densities, axis=-1)

    def outer(self, features: Features, shares: Floats, xp: Any) -> Any:
        """Return the sum of the components, if possible in one pass over all cells."""
        (densities,) = features
        if self._constants is None:
            by_part = tuple(densities[..., place] for place in self._slices)
            return super().outer(by_part, shares, xp)
        sizes = [cells.widths.size for cells in self.cells]
        by_cell = np.repeat(shares, sizes, axis=-1)
        first = cast(CellwiseDiscrepancy, self.parts[0].target)
        return (first.terms(densities, self._constants, xp) * by_cell).sum(axis=-1)


@dataclass(frozen=True, eq=False)
class BinnedBasis(Basis):
    """Projections of stored responses, (n, K), which are binned for each row of weights."""

    densities: DensitySum

    def features(self, weights: Any, xp: Any = np) -> Features:
        """Return the densities on all cells, (..., n) -> (..., cells)."""
        (projections,) = self.arrays
        return (self.densities.binned(projections, weights),)


def is_differentiable(target: Discrepancy) -> bool:
    """Return whether a discrepancy has second derivatives in the population's values and weights.

    A histogram has none in the values.
    """
    for part in target.parts:
        inner = part.target
        has_bins = isinstance(inner, DensityDiscrepancy) and not inner.cells.smooth
        if has_bins or inner.metric.minimum is not Minimum.QUADRATIC:
            return False
    return True


def overlap(target: Discrepancy, simulated: Floats, weights: Floats) -> Floats:
    """Return the smallest cosine of a simulated and an observed density, (..., n) -> (...).

    The cosine is one if the densities are equal, or if no component compares densities, and zero if
    they are disjoint. Mass outside the inner cells does not count.
    """
    batch = np.shape(simulated)[: np.ndim(simulated) - 1 - len(target.event)]
    cosines = [np.ones(batch)]
    for inner, values in projected(target.parts, simulated):
        if not isinstance(inner, DensityDiscrepancy):
            continue
        p = inner.cells.density(values, weights)[..., :-2]
        q = inner.density[..., :-2]
        dz = inner.cells.widths[:-2]
        p_squared = (p**2 * dz).sum(axis=-1)
        q_squared = (q**2 * dz).sum(axis=-1)
        size = np.sqrt(p_squared * q_squared)
        product_sum = (p * q * dz).sum(axis=-1)
        cosine = product_sum / positive_scale(size)
        cosines.append(np.nan_to_num(cosine))
    return np.asarray(np.min(cosines, axis=0))


def with_common_bandwidths(
    targets: Sequence[Discrepancy], responses: Sequence[int], conditions: Sequence[int]
) -> list[Discrepancy]:
    """Return discrepancies in which a bandwidth rule is applied to all data of a response together.

    With a bandwidth for each few data, simulators that happen to scatter little would count most,
    and a common spread would be underestimated. This concerns metrics on the scale of a likelihood.
    Targets with equal numbers in ``responses`` have the same units, and those with equal numbers in
    ``conditions`` the same population. Data of one condition are pooled as they are. Data of
    several conditions are pooled as deviations from their means, unless Bartlett's test finds that
    their spreads differ.
    """
    from scipy.stats import bartlett  # takes a third of the import of the package

    result = list(targets)
    kinds: list[tuple[int, Any]] = []
    for response, target in zip(responses, targets, strict=True):
        kinds.append((response, target.metric if _has_bandwidth_rule(target) else None))
    for kind in [kind for k, kind in enumerate(kinds) if kind not in kinds[:k]]:
        members = [k for k, second in enumerate(kinds) if second == kind]
        metric = kind[1]
        if metric is None or len(members) < 2:
            continue
        rule = metric.density.bandwidth
        pools = []
        for condition in dict.fromkeys(conditions[k] for k in members):
            pools.append([k for k in members if conditions[k] == condition])
        samples = [_pooled([targets[k] for k in pool]) for pool in pools]
        if len(pools) > 1 and bartlett(*(values for values, _ in samples)).pvalue > 0.01:
            deviations = []
            for values, counts in samples:
                mean = counts @ values / counts.sum()
                deviations.append(values - mean)
            pooled_counts = np.concatenate([counts for _, counts in samples])
            pools = [members]
            samples = [(np.concatenate(deviations), pooled_counts)]
        for pool, (values, counts) in zip(pools, samples, strict=True):
            if len(pool) < 2:
                continue
            width = rule(values, counts / counts.sum())
            for k in pool:
                result[k] = _with_bandwidth(targets[k], width)
    return result


def _has_bandwidth_rule(target: Discrepancy) -> bool:
    """Return whether a log-likelihood or divergence has a kernel whose width its data decide."""
    density = getattr(target.metric, "density", None)
    has_rule = isinstance(density, GaussianKDE) and callable(density.bandwidth)
    return isinstance(target, DensityDiscrepancy) and target.metric.likelihood and has_rule


def _pooled(targets: Sequence[Discrepancy]) -> ArrayPair:
    """Return the finite observed values of all targets, with weights in units of specimens."""
    values = np.concatenate([target.observed for target in targets])
    counts = np.concatenate([target.weights * target.n_effective for target in targets])
    is_counted = np.isfinite(values)
    is_counted &= counts > 0
    return values[is_counted], counts[is_counted]


def _with_bandwidth(target: Any, width: float) -> Discrepancy:
    """Return the discrepancy with a kernel of another width, unchanged if the width is the same."""
    if np.isclose(target.cells.bandwidth, width, rtol=1e-9, atol=0.0):
        return cast(Discrepancy, target)
    metric = replace(target.metric, density=GaussianKDE(width))
    prepared: Discrepancy = metric.against(target.observed, target.weights)
    return replace(prepared, metric=target.metric)
