"""The negative mean log-likelihood, estimated from a kernel density or a histogram."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

from prbayes._checks import Floats
from prbayes.metrics.base import (
    CellwiseDiscrepancy,
    Discrepancy,
    Metric,
    Minimum,
    observed_density,
    raised,
)
from prbayes.metrics.cells import Cells
from prbayes.metrics.density import (
    DensityEstimator,
    GaussianKDE,
    density_estimator,
    likelihood_bandwidth,
)
from prbayes.metrics.readings import Readings


@dataclass(frozen=True)
class LogLikelihood(Metric):
    r"""Negative mean log-likelihood of observed values, :math:`-\frac{1}{N} \sum_i \log p(z_i)`.

    The density p is that of the simulated responses. Only this side is smoothed, which makes the
    fitted population narrower by about :math:`h^2/(2\sigma^2)`; the default bandwidth keeps that
    below a tenth of the sampling error of a normal population. Where it is more, as of responses in
    groups, an optimum warns.

    Parameters
    ----------
    density : GaussianKDE or Histogram
        Estimates the simulated density. A `GaussianKDE` without bandwidth has the default one.

    Raises
    ------
    TypeError
        When prepared against observed values without a density.

    References
    ----------
    .. [1] Oh et al. (2019), eq. 3, doi:10.1007/s00158-019-02288-6.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.stats import norm
    >>> simulated = norm.ppf((np.arange(4000) + 0.5) / 4000)
    >>> metric = LogLikelihood(density=GaussianKDE())
    >>> value = metric(simulated, [-1.0, 0.0, 1.0])
    >>> bool(np.isclose(value, -norm.logpdf([-1, 0, 1]).mean(), rtol=0.05))
    True
    """

    density: DensityEstimator | None = field(default=None, kw_only=True)
    minimum: ClassVar[Minimum] = Minimum.QUADRATIC
    counts_failures: ClassVar[bool] = True
    likelihood: ClassVar[bool] = True
    distance: ClassVar[bool] = False
    tail_responses: ClassVar[int] = 300  # from which standard errors are right to a tenth

    def __post_init__(self) -> None:
        if self.density is not None:
            density = density_estimator(self.density, likelihood_bandwidth)
            object.__setattr__(self, "density", density)

    @property
    def by_specimen(self) -> bool:
        """Whether it is the log-likelihood by specimen, which is no distance of two samples."""
        return self.density is None

    def readings(self, values: Floats) -> Readings:
        """Return measured outputs, (N, m), with what is known of their measurement."""
        return Readings.exact(values)

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        if self.density is None:
            raise TypeError(
                "LogLikelihood: got density=None, expected prb.GaussianKDE() or prb.Histogram(); "
                "pass prb.LogLikelihood(density=prb.GaussianKDE())"
            )
        cells = self.density.cells(observed, weights)
        return LikelihoodDiscrepancy.on_cells(self, observed, weights, cells)


@dataclass(frozen=True, eq=False)
class LikelihoodDiscrepancy(CellwiseDiscrepancy):
    """The mean log-likelihood of fixed observed values."""

    # (m,) or (..., m): ``reading @ g`` is the weighted mean of g, given on the cells, at the
    # observed values.
    reading: Floats
    _by_data_set: ClassVar[tuple[str, ...]] = ("weights", "density", "reading")

    @classmethod
    def on_cells(cls, metric: Any, observed: Floats, weights: Floats, cells: Cells) -> Self:
        """Return the likelihood of observed values, to be read from densities on given cells."""
        density = observed_density(cells, observed, weights)
        reading = cells.reading(observed, weights)
        return cls(metric, observed, weights, cells, density, reading)

    def with_observed(self, observed: Floats, weights: Floats | None = None) -> Self:
        """Return the same metric, on the same cells, against other values; for resampling."""
        other = super().with_observed(observed, weights)
        reading = self.cells.reading(other.observed, other.weights)
        return replace(other, reading=reading)

    @property
    def exact(self) -> bool:
        """Whether the kernel is as narrow as the default."""
        return bool(self.metric == LogLikelihood(density=GaussianKDE()))

    @property
    def resolution(self) -> float:
        """That of a Gaussian kernel; a histogram has none."""
        return float(getattr(self.cells, "bandwidth", 0.0))

    def narrowed(self, factor: float) -> Discrepancy:
        """Return the same with a narrower kernel; a histogram stays as it is."""
        if not self.resolution:
            return self
        kernel = GaussianKDE(factor * self.resolution)
        return LogLikelihood(density=kernel).against(self.observed, self.weights)

    @property
    def constants(self) -> tuple[Any, ...]:
        """The floor of the density, and how it is read at the observed values."""
        return self.least, self.reading

    def terms(self, density: Any, constants: tuple[Any, ...], xp: Any) -> Any:
        """Return what each cell adds to minus the weighted mean of log p at the observed values."""
        least, reading = constants
        logs = xp.log(raised(density, least))
        return -(logs * reading)
