"""The area metric: the area between two distribution functions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats
from prbayes.metrics.base import Discrepancy, Metric, Minimum


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

    minimum: ClassVar[Minimum] = Minimum.ABSOLUTE

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
