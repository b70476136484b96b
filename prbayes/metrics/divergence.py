"""Differences of two densities: the probability residual, and the Kullback-Leibler divergence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from prbayes._validate import Floats, flag, positive_number
from prbayes.metrics.base import Discrepancy, Metric, Minimum
from prbayes.metrics.density import (
    CellwiseDiscrepancy,
    DensityEstimator,
    GaussianKDE,
    density_estimator,
)


@dataclass(frozen=True)
class ProbabilityResidual(Metric):
    r"""Probability residual: the scaled squared difference of two densities.

    With a `GaussianKDE` the integral form, :math:`S \int (p - q)^2 dz`, one bandwidth for both
    sides. It equals a squared maximum mean discrepancy with a Gaussian kernel of bandwidth
    :math:`\sqrt 2 h`, so its minimiser is right for every bandwidth, except for mass beyond the
    grid, which counts as one tight cluster on either side. With a `Histogram` the sum form,
    :math:`S \sum (p_i - q_i)^2` over densities in bins. The scale factor is :math:`S =
    C^{-\lfloor \log_{10} \max q \rfloor}`.

    Parameters
    ----------
    density : GaussianKDE or Histogram
        Estimates both densities.
    scale_base : float
        The constant C. It has no influence on the minimiser, only on an optimiser's absolute
        tolerances.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described; when prepared against observed values that are all
        equal (no bandwidth).

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

    density: DensityEstimator = field(default=GaussianKDE())
    _: KW_ONLY
    scale_base: float = 100.0
    minimum: ClassVar[Minimum] = Minimum.QUADRATIC
    counts_failures: ClassVar[bool] = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "density", density_estimator(self.density))
        positive_number(self.scale_base, "scale_base")

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        cells = self.density.cells(observed, weights)
        density = cells.density(observed, weights)
        scale_factor = float(self.scale_base ** -np.floor(np.log10(density.max())))  # eq. 10
        return ResidualDiscrepancy(self, observed, weights, cells, density, scale_factor)

    def on_one_scale(self, slices: Sequence[Any]) -> Sequence[Any]:
        """Return the residuals with one factor S, the smallest: that of the highest peak."""
        smallest = min(target.scale_factor for target in slices)
        return [replace(target, scale_factor=smallest) for target in slices]


@dataclass(frozen=True, eq=False)
class ResidualDiscrepancy(CellwiseDiscrepancy):
    """The probability residual against fixed observed values.

    Against other values, by `with_observed`, it keeps its scale factor S.
    """

    metric: ProbabilityResidual
    scale_factor: float

    @property
    def scale(self) -> float:
        """The residual of a population without any density: S times the integral of q squared."""
        root, observed, measure = self.constants
        return float(((root * observed) ** 2 * measure).sum())

    @property
    def constants(self) -> tuple[Any, ...]:
        """The root of S, which gives densities of the order of one, q, and the measure of a cell.

        The measure is the width in the integral form, one in the sum form.
        """
        root = np.sqrt(self.scale_factor)
        return root, self.density, self.cells.widths if self.cells.smooth else 1.0

    def terms(self, density: Any, constants: tuple[Any, ...], xp: Any) -> Any:
        """Return S times (p - q)^2, times the width of the cell: eq. 6, 8, 9."""
        root, observed, measure = constants
        return (root * (density - observed)) ** 2 * measure


@dataclass(frozen=True)
class KullbackLeibler(Metric):
    r"""Kullback-Leibler divergence between the observed density q and the simulated density p.

    Forward (default): :math:`\int q \log(q / p)\,dz`; reverse: :math:`\int p \log(p / q)\,dz`. Both
    densities have the same bandwidth and the floor of ``DensityDiscrepancy.floored``; the reverse
    one depends on it, because the observed density vanishes quickly outside the data.

    Eq. 4 of [1]_ as printed, :math:`\sum_i p(z_i) \log(p(z_i)/q(z_i))` over the observed points
    with p the simulated density, is ill-posed as an objective. Its terms are not normalised over
    the points, so that it is negative and smallest for populations far from the data. Hence the
    integral, and the forward direction, which is maximum likelihood of smoothed data.

    Parameters
    ----------
    density : GaussianKDE or Histogram
        Estimates both densities.
    reverse : bool
        Whether the divergence is the reverse one.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described; when prepared against observed values that are all
        equal (no bandwidth).

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

    density: DensityEstimator = field(default=GaussianKDE())
    _: KW_ONLY
    reverse: bool = False
    minimum: ClassVar[Minimum] = Minimum.QUADRATIC
    counts_failures: ClassVar[bool] = True
    likelihood: ClassVar[bool] = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "density", density_estimator(self.density))
        flag(self.reverse, "reverse")

    @property
    def additive(self) -> bool:
        """Whether the gradient in the hyperparameters is a mean over observations."""
        return not self.reverse

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        cells = self.density.cells(observed, weights)
        return DivergenceDiscrepancy.on_cells(self, observed, weights, cells)


class DivergenceDiscrepancy(CellwiseDiscrepancy):
    """The Kullback-Leibler divergence against fixed observed values."""

    metric: KullbackLeibler

    @property
    def constants(self) -> tuple[Any, ...]:
        """The observed density, the floor of the simulated one, and the widths."""
        return self.floored(self.density), self.cells.floor, self.cells.widths

    def terms(self, density: Any, constants: tuple[Any, ...], xp: Any) -> Any:
        """Return the integral of a log(a / b), (a, b) = (q, p) forward, (p, q) in reverse."""
        q, floor, widths = constants
        p = self.floored(density, floor)
        a, b = (p, q) if self.metric.reverse else (q, p)
        return a * xp.log(a / b) * widths
