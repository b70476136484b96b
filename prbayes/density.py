"""Density estimates on cells fixed by the observed side: Gaussian kernels, histograms, bandwidth rules.

A calibration metric compares the simulated density with the observed one on the same *cells*. The cells
are laid out once, from the observed values; afterwards a density is linear in the weights of the sample,
which is what makes every metric of this package cheap and differentiable.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from prbayes._arrays import Floats, positive_integer, positive_number

_MARGIN = 6.0  # bandwidths of grid beyond the outermost observation, at least
_PER_BANDWIDTH = 4  # grid nodes per bandwidth
_MAX_CELLS = 8192
_CHUNK = 1 << 18  # sample values binned at a time: bounds memory, stays in cache

NDArrayInt = NDArray[np.intp]
NDArrayBool = NDArray[np.bool_]
BandwidthRule = Callable[[Floats, Floats], float]


def weighted_quantile(sample: Floats, weights: Floats, probability: float) -> float:
    """Return the quantile of a weighted sample, linear between the mid-points of its steps."""
    order = np.argsort(sample, kind="stable")
    w = weights[order]
    return float(np.interp(probability, np.cumsum(w) - 0.5 * w, sample[order]))


def spread(sample: Floats, weights: Floats) -> float:
    """Return min(standard deviation, IQR / 1.34) of a weighted sample; the sd alone where the IQR is zero."""
    sample = sample - sample.min()  # equal values give exactly zero
    mean = weights @ sample
    sd = float(np.sqrt(weights @ (sample - mean) ** 2))
    iqr = weighted_quantile(sample, weights, 0.75) - weighted_quantile(sample, weights, 0.25)
    return float(min(sd, iqr / 1.34)) if iqr > 0 else sd


def silverman(sample: Floats, weights: Floats) -> float:
    """Return Silverman's bandwidth, 0.9 min(sd, IQR/1.34) n^(-1/5), n the effective sample size.

    Parameters
    ----------
    sample, weights : ndarray, shape (N,)
        Weights sum to one.

    References
    ----------
    .. [1] B. W. Silverman (1986), Density Estimation for Statistics and Data Analysis, eq. 3.31.

    Examples
    --------
    >>> import numpy as np
    >>> round(silverman(np.arange(32.0), np.full(32, 1 / 32)), 3)
    4.155
    """
    return float(0.9 * spread(sample, weights) * (weights**2).sum() ** 0.2)


def twice_silverman(sample: Floats, weights: Floats) -> float:
    """Return two Silverman bandwidths: the default of the metrics that smooth both sides alike."""
    return 2.0 * silverman(sample, weights)


def likelihood_bandwidth(sample: Floats, weights: Floats) -> float:
    """Return 0.35 min(sd, IQR/1.34) n^(-1/4), the default of the log-likelihood.

    Only the simulated side is smoothed there, which makes the fitted population too narrow by about
    h^2 / (2 sd^2); with this rule that is at most a tenth of the sampling error sd / sqrt(2 n) for every n.
    """
    return float(0.35 * spread(sample, weights) * (weights**2).sum() ** 0.25)


@dataclass(frozen=True, eq=False)
class Cells(ABC):
    """Cells on which densities are compared, the last two for the mass below and above all others.

    Attributes
    ----------
    widths : ndarray, shape (m,)
        Length that each cell stands for; the outer two are as long as documented by the estimator.
    centers : ndarray, shape (m - 2,)
        Positions of the inner cells, in units of the response.
    smooth : bool
        Whether the density has derivatives with respect to the sample's values.
    """

    widths: Floats
    centers: Floats
    smooth: bool

    @abstractmethod
    def density(self, sample: Floats, weights: Floats) -> Floats:
        """Return the density of weighted samples, shape (..., n) -> (..., m); NaN values count nowhere."""

    def basis(self, sample: Floats) -> Floats:
        """Return A, shape (n, m), with ``density(sample, w) == w @ A``."""
        return self.density(sample[:, None], np.ones(1))

    @abstractmethod
    def reading(self, points: Floats, weights: Floats) -> Floats:
        """Return r, shape (..., m), such that ``r @ g`` is the weighted mean of g (given on the cells) at the points.

        The points have shape (n,), their weights (..., n).
        """

    @abstractmethod
    def pullback(self, sample: Floats, weights: Floats, cotangent: Floats) -> tuple[Floats, Floats]:
        """Return the derivatives of ``(density(sample, weights) * cotangent).sum()`` for sample and weights."""


class DensityEstimator(ABC):
    """How densities are estimated; ``cells(observed, weights)`` lays out the cells once."""

    @abstractmethod
    def cells(self, observed: Floats, weights: Floats) -> Cells:
        """Return the cells for observed values, shape (N,), with weights that sum to one."""


@dataclass(frozen=True)
class GaussianKDE(DensityEstimator):
    """Gaussian kernel density with one bandwidth, fixed by the observed side, for both sides.

    The sample is binned on a regular grid of four nodes per bandwidth, with cubic B-spline weights, and
    smoothed there; the kernel is narrowed by the spline's variance, so that the density's variance is
    exact, its error is of fourth order in the spacing, and it is twice differentiable in the sample inside the
    grid.

    Parameters
    ----------
    bandwidth : float or callable, optional
        In units of the response, or a rule ``(observed, weights) -> float``. Two Silverman bandwidths
        by default.

    Raises
    ------
    ValueError
        If the observed values are all equal, so that no rule gives a bandwidth, or if they span so many
        bandwidths that the grid would be unreasonably long.

    References
    ----------
    .. [1] Oh et al. (2019), eq. 9, doi:10.1007/s00158-019-02288-6.
    .. [2] P. Hall and M. P. Wand (1996), On the accuracy of binned kernel density estimators,
       J. Multivariate Anal. 56, 165-184.

    Examples
    --------
    >>> import numpy as np
    >>> cells = GaussianKDE(bandwidth=0.5).cells(np.array([0.0, 1.0]), np.array([0.5, 0.5]))
    >>> density = cells.density(np.array([0.0]), np.ones(1))
    >>> bool(np.isclose(density @ cells.widths, 1.0))
    True
    """

    bandwidth: float | BandwidthRule = twice_silverman

    def __post_init__(self) -> None:
        if not callable(self.bandwidth):
            positive_number(self.bandwidth, "bandwidth")

    def cells(self, observed: Floats, weights: Floats) -> Cells:
        """Return a grid over the observed range plus six bandwidths, or half the range, at either side."""
        h = self.bandwidth(observed, weights) if callable(self.bandwidth) else float(self.bandwidth)
        if not np.isfinite(h) or h <= 0:
            raise ValueError(
                f"bandwidth: got {h:g} from {observed.size} observed values with spread "
                f"{np.ptp(observed):g}, expected a positive one; pass GaussianKDE(bandwidth=...) in units "
                "of the response, or use AreaMetric, which needs none"
            )
        step = h / _PER_BANDWIDTH
        margin = max(_MARGIN * h, float(np.ptp(observed)) / 2)
        low = float(observed.min()) - margin
        n_cells = int(np.ceil((float(observed.max()) - low + margin) / step)) + 1
        if n_cells > _MAX_CELLS:
            raise ValueError(
                f"bandwidth: got {h:g} for observed values that span {np.ptp(observed):g}, expected a span "
                f"below {_MAX_CELLS / _PER_BANDWIDTH / 2:g} bandwidths; look for outliers, pass a larger "
                "GaussianKDE(bandwidth=...), or use AreaMetric"
            )
        tight = 2 * np.sqrt(np.pi) * h  # the integral of a kernel's square is 1 / tight
        s = np.sqrt(h**2 - step**2 / 3)
        reach = int(np.ceil(7 * s / step))
        offsets = step * np.arange(-reach, reach + 1)
        kernel = np.exp(-0.5 * (offsets / s) ** 2) / (s * np.sqrt(2 * np.pi))
        return KernelCells(
            widths=np.r_[np.full(n_cells, step), tight, tight],
            centers=low + step * np.arange(n_cells, dtype=np.float64),
            smooth=True,
            bandwidth=h,
            step=step,
            kernel=kernel,
        )


@dataclass(frozen=True, eq=False)
class KernelCells(Cells):
    """Nodes of a regular grid; mass outside counts as one tight cluster on either side, at its most conspicuous."""

    bandwidth: float
    step: float
    kernel: Floats

    def _locate(self, sample: Floats) -> tuple[NDArrayInt, Floats, NDArrayBool, NDArrayBool, NDArrayBool]:
        with np.errstate(invalid="ignore"):
            u = (sample - self.centers[0]) / self.step
            below, above = u < 1, u >= self.centers.size - 2
            inside = (u >= 1) & ~above
        u = np.where(inside, u, 1.0)
        node = u.astype(np.intp)
        return node, u - node, inside, below, above

    def density(self, sample: Floats, weights: Floats) -> Floats:
        """Return densities at the nodes, then mass below and above divided by the width of a cluster."""
        batch, n, g = sample.shape[:-1], sample.shape[-1], self.centers.size
        rows = int(np.prod(batch, dtype=int))
        flat = sample.reshape(rows, n)
        w = np.broadcast_to(weights, (*batch, n)).reshape(rows, n)
        counts = np.zeros((rows, g))
        outside = np.zeros((rows, 2))
        rows_at_once = max(1, _CHUNK // n)
        for r in range(0, rows, rows_at_once):
            for i in range(0, n, _CHUNK):
                block = np.s_[r : r + rows_at_once, i : i + _CHUNK]
                self._count(flat[block], w[block], counts[r : r + rows_at_once], outside[r : r + rows_at_once])
        grid = self._smooth(counts)
        return np.concatenate([grid, outside / self.widths[-1]], axis=-1).reshape(*batch, g + 2)

    def _smooth(self, counts: Floats) -> Floats:
        from scipy.ndimage import convolve1d  # takes longer to import than the whole package

        return np.asarray(convolve1d(counts, self.kernel, axis=-1, mode="constant"))

    def _count(self, sample: Floats, weights: Floats, counts: Floats, outside: Floats) -> None:
        rows, g = counts.shape
        node, t, inside, below, above = self._locate(sample)
        outside[:, 0] += np.where(below, weights, 0.0).sum(axis=-1)
        outside[:, 1] += np.where(above, weights, 0.0).sum(axis=-1)
        w = np.where(inside, weights, 0.0)
        index = (node - 1 + g * np.arange(rows)[:, None]).ravel()
        for k, b in enumerate(_spline(t)):
            counts += np.bincount(index + k, (w * b).ravel(), rows * g).reshape(rows, g)

    def reading(self, points: Floats, weights: Floats) -> Floats:
        """Return cubic convolution weights (Keys 1981), which interpolate and are exact for parabolas."""
        node, t, inside, _, _ = self._locate(points)
        s = 1 - t
        keys = (-t * s**2 / 2, 1 - 2.5 * t**2 + 1.5 * t**3, 1 - 2.5 * s**2 + 1.5 * s**3, -s * t**2 / 2)
        each = np.zeros((points.size, self.widths.size))
        for k, b in enumerate(keys):
            each[np.arange(points.size), node - 1 + k] += np.where(inside, b, 0.0)
        return np.asarray(weights @ each)

    def pullback(self, sample: Floats, weights: Floats, cotangent: Floats) -> tuple[Floats, Floats]:
        """Return the derivatives for sample and weights; the smoothing kernel is its own transpose."""
        node, t, inside, below, above = self._locate(sample)
        c = self._smooth(cotangent[..., :-2])
        gathered = [np.take_along_axis(c, node + (k - 1), axis=-1) for k in range(4)]
        slope = sum(b * ck for b, ck in zip(_spline_slope(t), gathered, strict=True))
        value = sum(b * ck for b, ck in zip(_spline(t), gathered, strict=True))
        outer = cotangent[..., -2:] / self.widths[-1]
        for_weights = np.where(inside, value, below * outer[..., :1] + above * outer[..., 1:])
        for_sample = np.where(inside, weights * slope / self.step, 0.0)
        return for_sample, cast(Floats, for_weights)


def _spline(t: Floats) -> tuple[Floats, ...]:
    """Return the four cubic B-spline weights at fraction t between two nodes."""
    s = 1 - t
    return s**3 / 6, 2 / 3 - t**2 + t**3 / 2, 2 / 3 - s**2 + s**3 / 2, t**3 / 6


def _spline_slope(t: Floats) -> tuple[Floats, ...]:
    """Return the derivatives of the four weights with respect to t."""
    s = 1 - t
    return -(s**2) / 2, t * (1.5 * t - 2), s * (2 - 1.5 * s), t**2 / 2


@dataclass(frozen=True)
class Histogram(DensityEstimator):
    """Normalised histogram on equal bins over the observed range, with two bins for the mass outside.

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
        low, high = float(observed.min()), float(observed.max())
        if high <= low:
            raise ValueError(
                f"histogram: got {observed.size} observed values, all {low:g}, expected at least two different "
                "ones; use AreaMetric, which needs no bins"
            )
        bins = self.bins
        if bins is None:
            wide = 2 * 1.34 * spread(observed, weights) * float((weights**2).sum()) ** (1 / 3)
            bins = int(np.clip(np.ceil((high - low) / wide), 5, _MAX_CELLS)) if wide > 0 else _MAX_CELLS
        width = (high - low) / bins
        return BinCells(
            widths=np.full(bins + 2, width),
            centers=low + width * (np.arange(bins, dtype=np.float64) + 0.5),
            smooth=False,
        )


@dataclass(frozen=True, eq=False)
class BinCells(Cells):
    """Equal bins, closed on the left, the last one on both sides."""

    def density(self, sample: Floats, weights: Floats) -> Floats:
        """Return the normalised frequency per unit length of each bin, then of the outer two."""
        bins, width = self.centers.size, self.widths[0]
        batch, n = sample.shape[:-1], sample.shape[-1]
        rows = int(np.prod(batch, dtype=int))
        cell = self._cell(sample).reshape(rows, n) + (bins + 3) * np.arange(rows)[:, None]
        w = np.broadcast_to(weights, (*batch, n)).reshape(rows, n)
        counts = np.bincount(cell.ravel(), w.ravel(), rows * (bins + 3)).reshape(*batch, bins + 3)
        return cast(Floats, counts[..., :-1] / width)

    def reading(self, points: Floats, weights: Floats) -> Floats:
        """Return the weight of the points in each bin."""
        return np.asarray(weights @ self.basis(points) * self.widths)

    def _cell(self, sample: Floats) -> NDArrayInt:
        """Return cell numbers: bins, then below, above, and NaN."""
        bins, width = self.centers.size, self.widths[0]
        low = self.centers[0] - width / 2
        position = (sample - low) / width
        # The upper edge belongs to the last bin, also after rounding in low + bins * width.
        slack = 1e-9
        inner = np.clip(np.where(np.isfinite(position), position, 0.0), 0, bins - 1).astype(np.intp)
        outer = np.where(position < -slack, bins, np.where(position > bins + slack, bins + 1, inner))
        return np.where(np.isnan(position), bins + 2, outer)

    def pullback(self, sample: Floats, weights: Floats, cotangent: Floats) -> tuple[Floats, Floats]:
        """Return zero for the sample (a step function) and the cell's cotangent for the weights."""
        padded = np.concatenate([cotangent, np.zeros_like(cotangent[..., :1])], axis=-1) / self.widths[0]
        return np.zeros_like(sample * weights), np.take_along_axis(padded, self._cell(sample), axis=-1)
