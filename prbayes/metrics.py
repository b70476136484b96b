"""Calibration metrics: how much the simulated responses disagree with the measured ones. Smaller is better.

A new metric is a `Metric` with ``_prepare`` and a ``Discrepancy`` with ``outer``: this file is all it touches.

References
----------
.. [1] Oh et al. (2019), A robust and convex metric for unconstrained optimization in statistical model
   calibration - probability residual (PR), Struct. Multidisc. Optim., doi:10.1007/s00158-019-02288-6.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from prbayes._arrays import Floats, positive_number
from prbayes.density import DensityEstimator, GaussianKDE, likelihood_bandwidth
from prbayes.discrepancy import DensityDiscrepancy, Discrepancy, Metric


def _density_estimator(density: object) -> None:
    if not isinstance(density, DensityEstimator):
        got = f"the class {density.__name__}" if isinstance(density, type) else f"{type(density).__name__} {density!r}"
        raise TypeError(f"density: got {got}, expected prb.GaussianKDE() or prb.Histogram(), perhaps with arguments")


@dataclass(frozen=True)
class ProbabilityResidual(Metric):
    r"""Probability residual: the scaled squared difference of two densities.

    With a `GaussianKDE` the integral form, :math:`S \int (p - q)^2 dz`, one bandwidth for both sides; it
    equals a squared maximum mean discrepancy with a Gaussian kernel of bandwidth :math:`\sqrt 2 h`, so
    its minimiser is right for every bandwidth. With a `Histogram` the sum form, :math:`S \sum (p_i - q_i)^2`
    over densities in bins. The scale factor is :math:`S = C^{-\lfloor \log_{10} \max q \rfloor}`.

    Parameters
    ----------
    density : GaussianKDE or Histogram
    scale_base : float
        The constant C. It has no influence on the minimiser, only on an optimiser's absolute tolerances.

    Raises
    ------
    ValueError
        When prepared against observed values that are all equal (no bandwidth).

    References
    ----------
    .. [1] Oh et al. (2019), eq. 6-10, doi:10.1007/s00158-019-02288-6.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.linspace(0, 1, 50)
    >>> metric = ProbabilityResidual()
    >>> metric(x, x)
    0.0
    >>> metric(x + 0.2, x) > metric(x + 0.1, x)
    True
    """

    density: DensityEstimator = field(default_factory=GaussianKDE)
    scale_base: float = 100.0

    def __post_init__(self) -> None:
        _density_estimator(self.density)
        positive_number(self.scale_base, "scale_base")

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        return ResidualDiscrepancy(self, observed, weights, self.density.cells(observed, weights))


@dataclass(frozen=True, eq=False)
class ResidualDiscrepancy(DensityDiscrepancy):
    """The probability residual against fixed observed values; ``scale_factor`` is S of eq. 10."""

    metric: ProbabilityResidual
    scale_factor: float = field(init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        power = np.floor(np.log10(self.density.max()))
        object.__setattr__(self, "scale_factor", float(self.metric.scale_base**-power))

    def with_observed(self, observed: Floats, weights: Floats | None = None) -> Discrepancy:
        """Return the same metric, with the same scale factor, on the same cells, against other values."""
        other = super().with_observed(observed, weights)
        object.__setattr__(other, "scale_factor", self.scale_factor)
        return other

    @property
    def _measure(self) -> Any:
        return self.cells.widths if self.cells.smooth else 1.0

    @property
    def scale(self) -> float:
        """The residual of a population with no overlap and no density: S times the integral of q squared."""
        return float(self.scale_factor * (self.density**2 * self._measure).sum())

    def outer(self, *features: Any, xp: Any) -> Any:
        """Return S times the integral (or sum) of (p - q)^2: eq. 6, 8, 9."""
        (p,) = features
        q = self.density
        return self.scale_factor * ((p - q) ** 2 * self._measure).sum(axis=-1)


@dataclass(frozen=True)
class KullbackLeibler(Metric):
    r"""Kullback-Leibler divergence between the observed density q and the simulated density p.

    Forward (default): :math:`\int q \log(q / p)\,dz`; reverse: :math:`\int p \log(p / q)\,dz`. Both
    densities have the same bandwidth and the floor of ``DensityDiscrepancy.floored``; the reverse one
    depends on it, because the observed density vanishes quickly outside the data.

    Eq. 4 of [1]_ as printed, :math:`\sum_i p(z_i) \log(p(z_i)/q(z_i))` over the observed points with p
    the simulated density, is ill-posed as an objective: its terms are not normalised over the points, so
    that it goes negative, and it is made small by moving the population away from the data altogether.
    Hence the integral, and the forward direction, which is maximum likelihood of smoothed data.

    Parameters
    ----------
    density : GaussianKDE or Histogram
    reverse : bool

    References
    ----------
    .. [1] Oh et al. (2019), eq. 4, doi:10.1007/s00158-019-02288-6.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.linspace(0, 1, 50)
    >>> round(KullbackLeibler()(x, x), 12)
    0.0
    """

    density: DensityEstimator = field(default_factory=GaussianKDE)
    reverse: bool = False
    likelihood: ClassVar[bool] = True

    def __post_init__(self) -> None:
        _density_estimator(self.density)

    @property
    def additive(self) -> bool:
        """Whether the gradient in the hyperparameters is a mean over observations."""
        return not self.reverse

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        return DivergenceDiscrepancy(self, observed, weights, self.density.cells(observed, weights))


class DivergenceDiscrepancy(DensityDiscrepancy):
    """The Kullback-Leibler divergence against fixed observed values."""

    metric: KullbackLeibler

    def outer(self, *features: Any, xp: Any) -> Any:
        """Return the integral of a log(a / b), (a, b) = (q, p) forward, (p, q) in reverse."""
        p, q = self.floored(features[0]), self.floored(self.density)
        a, b = (p, q) if self.metric.reverse else (q, p)
        return (a * xp.log(a / b) * self.cells.widths).sum(axis=-1)


@dataclass(frozen=True)
class LogLikelihood(Metric):
    r"""Negative mean log-likelihood of the observed values, :math:`-\frac1N \sum_i \log p(z_i)`.

    Only the simulated side is smoothed, which makes the fitted population narrower by about
    :math:`h^2/(2\sigma^2)`; the default bandwidth keeps that below a tenth of the sampling error.

    Parameters
    ----------
    density : GaussianKDE or Histogram

    References
    ----------
    .. [1] Oh et al. (2019), eq. 3, doi:10.1007/s00158-019-02288-6.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.stats import norm
    >>> simulated = norm.ppf((np.arange(4000) + 0.5) / 4000)
    >>> bool(np.isclose(LogLikelihood()(simulated, [-1.0, 0.0, 1.0]), -norm.logpdf([-1, 0, 1]).mean(), rtol=0.05))
    True
    """

    density: DensityEstimator = field(default_factory=lambda: GaussianKDE(likelihood_bandwidth))
    likelihood: ClassVar[bool] = True

    def __post_init__(self) -> None:
        _density_estimator(self.density)

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        return LikelihoodDiscrepancy(self, observed, weights, self.density.cells(observed, weights))


@dataclass(frozen=True, eq=False)
class LikelihoodDiscrepancy(DensityDiscrepancy):
    """The mean log-likelihood of fixed observed values."""

    reading: Floats = field(init=False)
    _by_data_set: ClassVar[tuple[str, ...]] = ("weights", "density", "reading")

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "reading", self.cells.reading(self.observed, self.weights))

    def outer(self, *features: Any, xp: Any) -> Any:
        """Return minus the weighted mean of log p at the observed values."""
        (p,) = features
        return -(xp.log(self.floored(p)) * self.reading).sum(axis=-1)


@dataclass(frozen=True)
class AreaMetric(Metric):
    r"""Area between two distribution functions, :math:`\int |F(z) - S_N(z)|\,dz`, in units of the response.

    Exact for any sizes and weights; in one dimension it is the 1-Wasserstein distance. Simulated
    specimens that failed (+inf) count in F below; the infinite last interval is left out.

    References
    ----------
    .. [1] Oh et al. (2019), eq. 5, doi:10.1007/s00158-019-02288-6.

    Examples
    --------
    >>> AreaMetric()([0.0, 1.0], [0.5, 1.5])
    0.5
    """

    smooth: ClassVar[bool] = False

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        return AreaDiscrepancy(self, observed, weights)


class AreaDiscrepancy(Discrepancy):
    """The area metric against fixed observed values."""

    @property
    def scale(self) -> float:
        """Mean absolute deviation from the mean of the observed values, or one if they are all equal."""
        observed = self.observed - self.observed.min()  # equal values give exactly zero
        mad = float(self.weights @ np.abs(observed - self.weights @ observed))
        return mad if mad > 0 else 1.0

    def features(self, simulated: Any, weights: Any, xp: Any) -> tuple[Any, ...]:
        """Return F - S_N on each interval of the pooled values, and the interval's length."""
        batch = simulated.shape[:-1]
        observed, u = self.observed, self.weights
        if xp is np:
            observed = np.broadcast_to(observed, (*batch, observed.size))
            u, weights = np.broadcast_to(u, observed.shape), np.broadcast_to(weights, simulated.shape)
        pooled = xp.concatenate([simulated, observed], axis=-1)
        order = xp.argsort(pooled, axis=-1)
        pooled = xp.take_along_axis(pooled, order, axis=-1)
        signed = xp.take_along_axis(xp.concatenate([weights, -u], axis=-1), order, axis=-1)
        del order  # a population of ten million is to fit into little memory
        return xp.cumsum(signed, axis=-1)[..., :-1], _lengths(pooled, xp)

    def basis(self, simulated: Floats) -> tuple[NDArray[Any], ...]:
        """Return, for the simulated and for the observed values, their order and how many are below each knot.

        Last come the lengths of the intervals between the knots, which are all finite values.
        """
        knots = np.unique(np.concatenate([simulated[np.isfinite(simulated)], self.observed]))
        order, own = np.argsort(simulated), np.argsort(self.observed)
        below = np.searchsorted(simulated[order], knots, side="right")
        own_below = np.searchsorted(self.observed[own], knots, side="right")
        return order, below[:-1], own, own_below[:-1], np.diff(knots)

    def from_basis(self, weights: Any, basis: tuple[Any, ...], xp: Any) -> tuple[Any, ...]:
        """Return F - S_N on each interval between knots, and the interval's length."""
        order, below, own, own_below, lengths = basis

        def cdf(w: Any, order: Any, below: Any) -> Any:
            total = xp.cumsum(xp.take(w, order, axis=-1), axis=-1)
            return xp.take(xp.concatenate([xp.zeros_like(total[..., :1]), total], axis=-1), below, axis=-1)

        return cdf(weights, order, below) - cdf(self.weights, own, own_below), lengths

    def outer(self, *features: Any, xp: Any) -> Any:
        """Return the sum of |F - S_N| times length: eq. 5."""
        gap, lengths = features
        return (xp.abs(gap) * lengths).sum(axis=-1)


def _lengths(pooled: Any, xp: Any) -> Any:
    """Return the lengths of the intervals between sorted values, zero for those that end in inf or NaN."""
    upper, lower = pooled[..., 1:], pooled[..., :-1]
    finite = xp.abs(upper) < np.inf
    return xp.where(finite, upper, 0.0) - xp.where(finite, lower, 0.0)


@dataclass(frozen=True)
class FunctionMetric(Metric):
    """A user's own metric from a function; samplers that need gradients refuse it.

    Parameters
    ----------
    function : callable
        ``function(simulated, observed) -> discrepancy``, shapes (..., n), (N,) -> (...); smaller is better.
    weighted : bool
        Whether the function takes the weights of the simulated values, shape (..., n), as a third
        argument. `Reweighted` needs that; the other propagations do not.

    Raises
    ------
    TypeError
        If ``function`` is not callable.

    Examples
    --------
    >>> import numpy as np
    >>> metric = FunctionMetric(lambda simulated, observed: abs(np.mean(simulated, -1) - observed.mean()))
    >>> metric([0.0, 2.0], [4.0])
    3.0
    """

    function: Callable[..., Any]
    weighted: bool = False
    smooth: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not callable(self.function):
            raise TypeError(f"function: got {type(self.function).__name__}, expected f(simulated, observed)")

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        if not np.allclose(weights, weights[0]):
            raise ValueError("observed weights: got unequal ones, expected none; a FunctionMetric has no use for them")
        return FunctionDiscrepancy(self, observed, weights)


class FunctionDiscrepancy(Discrepancy):
    """A user's metric against fixed observed values."""

    metric: FunctionMetric

    @property
    def scale(self) -> float:
        """One: nothing is known about the function."""
        return 1.0

    def features(self, simulated: Any, weights: Any, xp: Any) -> tuple[Any, ...]:
        """Return the value of the function."""
        if self.metric.weighted:
            value = self.metric.function(simulated, self.observed, np.broadcast_to(weights, simulated.shape))
        elif not np.allclose(weights, np.asarray(weights)[..., :1]):
            raise ValueError(
                "weights: got unequal ones for a FunctionMetric whose function takes none; write "
                "function(simulated, observed, weights) and pass weighted=True, or use prb.Resimulated"
            )
        else:
            value = self.metric.function(simulated, self.observed)
        value = np.asarray(value, dtype=np.float64)
        if value.shape != simulated.shape[:-1]:
            raise ValueError(
                f"FunctionMetric: got a result of shape {value.shape} for simulated values of shape "
                f"{simulated.shape}, expected {simulated.shape[:-1]}; reduce over the last axis"
            )
        return (value,)

    def basis(self, simulated: Floats) -> tuple[NDArray[Any], ...]:
        """Return the simulated values themselves."""
        return (simulated,)

    def from_basis(self, weights: Any, basis: tuple[Any, ...], xp: Any) -> tuple[Any, ...]:
        """Return the value of the function."""
        return self.features(np.broadcast_to(basis[0], weights.shape), weights, xp)

    def outer(self, *features: Any, xp: Any) -> Any:
        """Return the value of the function."""
        return features[0]
