"""Several outputs by a metric of one: marginal discrepancies and residuals of correlations."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from prbayes._validate import AT_ONCE, Floats, positive_number, sample_weights
from prbayes.metrics.base import (
    Basis,
    DenseBasis,
    Discrepancy,
    Features,
    Minimum,
    Part,
    Projection,
)
from prbayes.metrics.grid import product
from prbayes.metrics.multivariate import CompositeDiscrepancy, LiftedMetric, failure_caps
from prbayes.metrics.whitening import units

# Least variance, in squared spreads of an observed output: a constant has no correlations.
_LEAST_VARIANCE = 1e-10


@dataclass(frozen=True)
class MarginalCorrelation(LiftedMetric):
    r"""Several outputs of a specimen: marginal discrepancies, and residuals of correlations.

    :math:`w_1 \sum_j d_j / s_j + w_2 \sum_{i<j} (\rho_{ij} - r_{ij})^2`, with :math:`d_j` the
    metric of output j in units of its observed spread, :math:`s_j` its typical size
    (``Discrepancy.scale``: for the probability residual its value without any density, for the area
    metric the observed mean deviation, or else one), and :math:`\rho` and :math:`r` the simulated
    and observed Pearson correlations. The idea is that of [1]_: normalised residuals of the
    marginals and of the correlations describe a joint distribution. It follows the paper's summary;
    the paper's norms of the two residuals may differ.

    Dependence other than correlation is not compared, and moments are not robust. Under the area
    metric estimates of strong correlations scatter more than with `Joint`.

    Parameters
    ----------
    metric : Metric
        Of one output.
    weights : tuple of two floats
        w_1, of each marginal discrepancy, and w_2, of each residual of a correlation.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described.

    Notes
    -----
    A specimen that failed (+inf) counts as the largest observed value of that output plus the
    range. Missing outputs (NaN): each marginal has the specimens with the output, each correlation
    those with both.

    References
    ----------
    .. [1] Kim, W., H. Yoon, G. Lee, T. Kim and B. D. Youn (2019), A new calibration metric that
       considers statistical correlation: Marginal Probability and Correlation Residuals, Reliab.
       Eng. Syst. Saf., 106677, doi:10.1016/j.ress.2019.106677.

    Examples
    --------
    >>> import numpy as np
    >>> from prbayes import ProbabilityResidual
    >>> x = np.random.default_rng(0).normal(size=(50, 2))
    >>> residual = MarginalCorrelation(ProbabilityResidual()).against(x)
    >>> residual(x) < 1e-20 < residual(x @ [[1.0, 0.5], [0.5, 1.0]])
    True
    """

    _: KW_ONLY
    weights: tuple[float, float] = (1.0, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.weights, tuple) or len(self.weights) != 2:
            raise TypeError(
                f"weights: got {type(self.weights).__name__} {self.weights!r:.60}, expected two "
                "positive numbers, of marginals and of correlations, such as (1.0, 1.0)"
            )
        for weight in self.weights:
            positive_number(weight, "weights")
        # Correlations have squares, and are not linear in the observed specimens.
        is_quadratic = self.metric.minimum is Minimum.QUADRATIC
        object.__setattr__(self, "minimum", Minimum.QUADRATIC if is_quadratic else Minimum.UNKNOWN)
        object.__setattr__(self, "additive", False)

    def _prepare_outputs(self, observed: Floats, weights: Floats) -> Discrepancy:
        caps = failure_caps(observed)
        m = observed.shape[1]
        marginal_weight, correlation_weight = self.weights
        parts: list[Part] = []
        center = np.empty(m)
        unit = np.empty(m)
        for j in range(m):
            index = np.array([j])
            is_finite = np.isfinite(observed[:, j])
            column_weights = weights[is_finite]
            column_weights = column_weights / column_weights.sum()
            column = observed[is_finite][:, index]
            center[index], unit[index] = units(column, column_weights, index)
            view = Projection(index, caps[index], center[index], direction=1 / unit[index])
            values, rows = view.observed_of(observed)
            target = self.metric.against(values, weights[rows])
            parts.append(Part(target, marginal_weight / target.scale, f"output {j}", view))
        # Rows that lack some of the outputs count in the correlations of the others.
        together = Projection(np.arange(m), caps, center, unit=unit)
        values, _ = together.observed_of(observed)
        has = ~np.isnan(values[weights > 0])
        for i, k in zip(*np.tril_indices(m, -1), strict=True):
            n_complete = int((has[:, i] & has[:, k]).sum())
            if n_complete < 3:
                raise ValueError(
                    f"observed: got {n_complete} specimens that have both output {i} and "
                    f"output {k} (counted from 0), expected at least 3; leave one of the outputs "
                    "out"
                )
        correlations = CorrelationDiscrepancy(
            self, values, weights, _observed_correlations(values, weights)
        )
        parts.append(Part(correlations, correlation_weight, "correlations", together))
        shares = np.array([part.share for part in parts])
        return CompositeDiscrepancy(self, observed, weights, tuple(parts), shares)


@dataclass(frozen=True, eq=False)
class CorrelationDiscrepancy(Discrepancy):
    """The sum of squared residuals of correlations, of outputs in units of their spread."""

    correlations: Floats  # (pairs,) or (..., pairs): the observed ones; NaN where there is none
    _by_data_set: ClassVar[tuple[str, ...]] = ("weights", "correlations")

    def with_observed(self, observed: Floats, weights: Floats | None = None) -> Self:
        """Return the residuals from correlations of other values."""
        w = sample_weights(weights, len(observed))
        correlations = _observed_correlations(observed, w)
        return replace(self, observed=observed, weights=w, correlations=correlations)

    @property
    def scale(self) -> float:
        """The number of correlations."""
        return float(self.correlations.shape[-1])

    def features(self, simulated: Any, weights: Any, xp: Any) -> Features:
        """Return the moments: of order zero, one and two, (..., n, m) -> (..., M)."""
        is_finite = xp.abs(simulated.sum(axis=-1)) < np.inf
        values = xp.where(is_finite[..., None], simulated, 0.0)
        weights = xp.where(is_finite, weights, 0.0)
        weighted = values * weights[..., None]
        total = weights.sum(axis=-1)[..., None]
        first = weighted.sum(axis=-2)
        products = xp.swapaxes(weighted, -1, -2) @ values
        i, j = np.tril_indices(self.event[0])
        return (xp.concatenate([total, first, products[..., i, j]], axis=-1),)

    def basis(self, simulated: Floats, most: float = AT_ONCE) -> Basis:
        """Return the powers of the values whose weighted sums are moments, (n, M)."""
        return DenseBasis((_powers(simulated),))

    def outer(self, *features: Any, xp: Any) -> Any:
        """Return the sum of squared residuals of the correlations."""
        (moments,) = features
        is_observed = ~np.isnan(self.correlations)
        observed = np.where(is_observed, self.correlations, 0.0)
        residual = (_correlations(moments, self.event[0], xp) - observed) * is_observed
        return (residual**2).sum(axis=-1)


def _powers(values: Floats) -> Floats:
    """Return 1, the values and their products, (n, m) -> (n, M); zero where one is NaN."""
    is_complete = ~np.isnan(values).any(axis=-1, keepdims=True)
    values = np.where(is_complete, values, 0.0)
    i, j = np.tril_indices(values.shape[-1])
    products = values[:, i] * values[:, j]
    return np.concatenate([is_complete, values, products], axis=-1, dtype=np.float64)


def _correlations(moments: Any, m: int, xp: Any) -> Any:
    """Return the correlations of pairs, from moments, (..., M) -> (..., pairs)."""
    rows, columns = np.tril_indices(m)
    place = np.zeros((m, m), dtype=int)
    place[rows, columns] = np.arange(rows.size)
    i, j = np.tril_indices(m, -1)
    total = xp.maximum(moments[..., 0], 1e-300)[..., None]
    mean = moments[..., 1 : m + 1] / total
    second = moments[..., m + 1 :] / total
    squares = second[..., np.diag(place)]
    variance = xp.maximum(squares - mean**2, _LEAST_VARIANCE)
    sd = xp.sqrt(variance)
    products = second[..., place[i, j]]
    covariance = products - mean[..., i] * mean[..., j]
    correlation = covariance / (sd[..., i] * sd[..., j])
    return xp.clip(correlation, -1.0, 1.0)


def _observed_correlations(values: Floats, weights: Floats) -> Floats:
    """Return the correlation of each pair, of the rows that have both; NaN without variance."""
    i, j = np.tril_indices(values.shape[-1], -1)
    correlations = np.full((*weights.shape[:-1], i.size), np.nan)
    for k, pair in enumerate(zip(i, j, strict=True)):
        moments = product(weights, _powers(values[:, pair]))
        total = moments[..., :1]
        mean = moments[..., 1:3] / np.where(total > 0, total, 1.0)
        variance = moments[..., [3, 5]] - total * mean**2
        has_variance = (variance > _LEAST_VARIANCE).all(axis=-1)
        correlations[has_variance, k] = _correlations(moments[has_variance], 2, np)[..., 0]
    return correlations
