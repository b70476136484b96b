"""The negative mean log-likelihood."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from prbayes._checks import Floats
from prbayes.metrics.base import DensityDiscrepancy, Discrepancy, Metric, Minimum
from prbayes.metrics.density import DensityEstimator, GaussianKDE, density_estimator, likelihood_bandwidth


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
    minimum: ClassVar[Minimum] = Minimum.QUADRATIC
    likelihood: ClassVar[bool] = True
    tail_responses: ClassVar[int] = 300  # from which standard errors are right to a tenth

    def __post_init__(self) -> None:
        density_estimator(self.density)

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
