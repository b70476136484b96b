"""The probability residual (PR): the scaled squared difference of two densities."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from prbayes._checks import Floats, positive_number
from prbayes.metrics.base import DensityDiscrepancy, Discrepancy, Metric, Minimum
from prbayes.metrics.density import DensityEstimator, GaussianKDE, density_estimator


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
    minimum: ClassVar[Minimum] = Minimum.QUADRATIC

    def __post_init__(self) -> None:
        density_estimator(self.density)
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
