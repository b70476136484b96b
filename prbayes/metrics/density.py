"""Density estimates: Gaussian kernels, histograms, bandwidth rules.

A calibration metric compares the simulated density with the observed one on the same *cells*. The
cells are laid out once, from the observed values; afterwards a density is linear in the weights of
the sample, which is what makes every metric of this package cheap and differentiable.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from prbayes._stats import finite_sample, quantile
from prbayes._validate import Floats, positive_integer, positive_number
from prbayes.metrics.grid import BinCells, Cells, KernelCells

# Grid nodes per bandwidth. The density is then exact to 3e-5 of a kernel's peak, which a test
# holds; with three nodes to 1e-4, with six to 6e-6. The cost of comparing densities grows in
# proportion.
_PER_BANDWIDTH = 4

# By judgement: a limit to memory, 64 kB for the density of one population. It is met where an
# outlier stands a thousand bandwidths away from the other observations.
_MAX_CELLS = 8192


BandwidthRule = Callable[[Floats, Floats], float]


def spread(sample: Floats, weights: Floats) -> float:
    """Return min(standard deviation, IQR / 1.34) of a weighted sample.

    1.34 is the interquartile range of the standard normal distribution. Where the IQR is zero, it
    is the standard deviation alone.
    """
    sample = sample - sample.min()  # equal values give exactly zero
    mean = weights @ sample
    variance = weights @ (sample - mean) ** 2
    sd = float(np.sqrt(variance))
    upper = quantile(sample, weights, 0.75)
    lower = quantile(sample, weights, 0.25)
    iqr = float(upper - lower)
    return min(sd, iqr / 1.34) if iqr > 0 else sd


def silverman(sample: Floats, weights: Floats) -> float:
    """Return Silverman's bandwidth, 0.9 min(sd, IQR/1.34) n^(-1/5), n the effective sample size.

    Parameters
    ----------
    sample, weights : ndarray, shape (N,)
        Weights sum to one.

    References
    ----------
    .. [1] Silverman, B. W. (1986), Density Estimation for Statistics and Data Analysis, eq. 3.31.

    Examples
    --------
    >>> import numpy as np
    >>> round(silverman(np.arange(32.0), np.full(32, 1 / 32)), 3)
    4.155
    """
    inverse_n = (weights**2).sum()
    return float(0.9 * spread(sample, weights) * inverse_n**0.2)


def twice_silverman(sample: Floats, weights: Floats) -> float:
    """Return two Silverman bandwidths: the default of the metrics that smooth both sides alike."""
    return 2.0 * silverman(sample, weights)


def likelihood_bandwidth(sample: Floats, weights: Floats) -> float:
    """Return 0.35 min(sd, IQR/1.34) n^(-1/4), the default of the kernel log-likelihood.

    Only the simulated side is smoothed there, which makes the fitted population too narrow by about
    h^2 / (2 sd^2); with this rule that is at most a tenth of the sampling error sd / sqrt(2 n) for
    every n.
    """
    inverse_n = (weights**2).sum()
    return float(0.35 * spread(sample, weights) * inverse_n**0.25)


class DensityEstimator(ABC):
    """How densities are estimated; ``cells(observed, weights)`` lays out the cells once."""

    @abstractmethod
    def cells(self, observed: Floats, weights: Floats) -> Cells:
        """Return the cells for observed values, shape (N,), with weights that sum to one."""


@dataclass(frozen=True)
class GaussianKDE(DensityEstimator):
    """Gaussian kernel density with one bandwidth, fixed by the observed side, for both sides.

    The sample is binned on a regular grid of four nodes per bandwidth, with cubic B-spline weights,
    and smoothed there; the kernel is narrowed by the spline's variance, so that the density's
    variance is exact, its error is of fourth order in the spacing, and it is twice differentiable
    in the sample, also where the grid ends.

    Parameters
    ----------
    bandwidth : float or callable, optional
        In units of the response, or a rule ``(observed, weights) -> float``. By default the rule of
        the metric: ``likelihood_bandwidth`` in `LogLikelihood`, two Silverman bandwidths elsewhere.

    Raises
    ------
    ValueError
        If the observed values are all equal, so that no rule gives a bandwidth, or if they span so
        many bandwidths that the grid would be unreasonably long.

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
        h = self._bandwidth(observed, weights)
        step = h / _PER_BANDWIDTH
        low, n_nodes = _grid(observed, h, step)
        tight = 2 * np.sqrt(np.pi) * h  # the integral of a kernel's square is 1 / tight
        return KernelCells(
            widths=np.r_[np.full(n_nodes, step), tight, tight],
            centers=low + step * np.arange(n_nodes, dtype=np.float64),
            smooth=True,
            bandwidth=h,
            step=step,
            kernel=_narrowed_kernel(h, step),
        )

    def _bandwidth(self, observed: Floats, weights: Floats) -> float:
        """Return the bandwidth for observed values, or raise if it is not positive."""
        rule = twice_silverman if self.bandwidth is None else self.bandwidth
        h = rule(observed, weights) if callable(rule) else float(rule)
        if not np.isfinite(h) or h <= 0:
            raise ValueError(
                f"bandwidth: got {h:g} from {observed.size} observed values with spread "
                f"{np.ptp(observed):g}, expected a positive one; pass GaussianKDE(bandwidth=...) "
                "in units of the response, or use AreaMetric, which needs none"
            )
        return h


def _grid(observed: Floats, h: float, step: float) -> tuple[float, int]:
    """Return the first node of a grid over observed values and their margins, and its length."""
    length = float(np.ptp(observed))
    # Farther out a Gaussian kernel has 1e-9 of its mass, as much as the floor of logarithms
    # (`DensityDiscrepancy.floored`).
    margin = max(6.0 * h, length / 2)
    low = float(observed.min()) - margin
    high = float(observed.max())
    n_nodes = int(np.ceil((high - low + margin) / step)) + 1
    if n_nodes > _MAX_CELLS:
        allowed = _MAX_CELLS / _PER_BANDWIDTH / 2
        raise ValueError(
            f"bandwidth: got {h:g} for observed values that span {length:g}, expected a span below "
            f"{allowed:g} bandwidths; look for outliers, pass a larger GaussianKDE(bandwidth=...), "
            "or use AreaMetric"
        )
    return low, n_nodes


def _narrowed_kernel(h: float, step: float) -> Floats:
    """Return a Gaussian kernel at the nodes, less the variance step^2 / 3 of a cubic B-spline."""
    s = np.sqrt(h**2 - step**2 / 3)
    # The kernel ends where it is 2e-11 of its peak.
    reach = int(np.ceil(7 * s / step))
    nodes = np.arange(-reach, reach + 1)
    u = step * nodes / s
    height = np.exp(-0.5 * u**2)
    area = s * np.sqrt(2 * np.pi)
    return np.asarray(height / area)


@dataclass(frozen=True)
class Histogram(DensityEstimator):
    """Normalised histogram on equal bins over the observed range, and two for the mass outside.

    Parameters
    ----------
    bins : int, optional
        Number of bins over the observed range; by default ceil(range / (2 s N^(-1/3))), the
        Freedman-Diaconis rule with s = min(1.34 sd, IQR), at least five.

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
        bins = self._bins(high - low, observed, weights)
        width = (high - low) / bins
        return BinCells(
            widths=np.full(bins + 2, width),
            centers=low + width * (np.arange(bins, dtype=np.float64) + 0.5),
            smooth=False,
        )

    def _bins(self, length: float, observed: Floats, weights: Floats) -> int:
        """Return the number of bins over an observed range of this length."""
        if self.bins is not None:
            return self.bins
        inverse_n = float((weights**2).sum())
        width = 2 * 1.34 * spread(observed, weights) * inverse_n ** (1 / 3)
        if not width > 0:
            return _MAX_CELLS
        # At least five, so that few observations still show a shape.
        return int(np.clip(np.ceil(length / width), 5, _MAX_CELLS))


def density_estimator(
    density: object, bandwidth: BandwidthRule = twice_silverman
) -> DensityEstimator:
    """Return a metric's density estimator, where a kernel without bandwidth has the metric's rule.

    Raises
    ------
    TypeError
        If it is not a density estimator.
    """
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
