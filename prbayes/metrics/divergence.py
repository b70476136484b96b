"""The Kullback-Leibler divergence, forward and reverse."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field
from typing import Any, ClassVar

from prbayes._validate import Floats, flag
from prbayes.metrics.base import Discrepancy, Metric, Minimum
from prbayes.metrics.density import (
    CellwiseDiscrepancy,
    DensityEstimator,
    GaussianKDE,
    density_estimator,
    floored,
)


@dataclass(frozen=True)
class KullbackLeibler(Metric):
    r"""Kullback-Leibler divergence between the observed density q and the simulated density p.

    Forward (default): :math:`\int q \log(q / p)\,dz`; reverse: :math:`\int p \log(p / q)\,dz`. Both
    densities have the same bandwidth and the floor of ``DensityDiscrepancy.floored``; the reverse
    one depends on it, because the observed density vanishes quickly outside the data.

    Eq. 4 of [1]_ as printed, :math:`\sum_i p(z_i) \log(p(z_i)/q(z_i))` over the observed points
    with p the simulated density, is ill-posed as an objective: its terms are not normalised over
    the points, so that it goes negative, and it is made small by moving the population away from
    the data altogether. Hence the integral, and the forward direction, which is maximum likelihood
    of smoothed data.

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
        return self.floored(self.density), self.floor, self.cells.widths

    def terms(self, density: Any, constants: tuple[Any, ...], xp: Any) -> Any:
        """Return the integral of a log(a / b), (a, b) = (q, p) forward, (p, q) in reverse."""
        q, floor, widths = constants
        p = floored(density, floor)
        a, b = (p, q) if self.metric.reverse else (q, p)
        return a * xp.log(a / b) * widths
