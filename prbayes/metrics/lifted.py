"""What metrics of several outputs have in common that are made of a metric of one."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from prbayes._validate import Floats, called, real_array
from prbayes.metrics.base import Discrepancy, Metric, Minimum, Part
from prbayes.metrics.multivariate import CompositeDiscrepancy, OnlyOutput


@dataclass(frozen=True)
class LiftedMetric(Metric):
    """A metric of several outputs, made of a metric of one, whose properties it has."""

    metric: Metric
    counts_failures: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not isinstance(self.metric, Metric):
            raise TypeError(
                f"metric: got {called(self.metric)}, expected a metric of one output, such as "
                "prb.ProbabilityResidual()"
            )
        if self.metric.takes_outputs:
            raise TypeError(
                f"metric: got {called(self.metric)}, which compares several outputs already, "
                "expected a metric of one output, such as prb.ProbabilityResidual()"
            )

    @property
    def minimum(self) -> Minimum:  # type: ignore[override]
        """How a discrepancy behaves around its minimum: as those of one output do."""
        return self.metric.minimum

    @property
    def tail_responses(self) -> int:  # type: ignore[override]
        """Simulated responses for each observation that one output needs."""
        return self.metric.tail_responses

    @property
    def distance(self) -> bool:  # type: ignore[override]
        """Whether equal samples have a discrepancy of zero."""
        return self.metric.distance

    @property
    def additive(self) -> bool:
        """Whether the gradient is a mean over observations, where all outputs are measured."""
        return self.metric.additive

    @property
    def takes_weights(self) -> bool:
        """Whether simulated responses may have unequal weights, as under `Reweighted`."""
        return self.metric.takes_weights

    @property
    def takes_outputs(self) -> bool:
        """Yes."""
        return True

    def like(self, metric: Metric) -> Metric:
        """Return the same comparison of outputs by another metric of one."""
        return replace(self, metric=metric)

    def against(self, observed: ArrayLike, weights: ArrayLike | None = None) -> Discrepancy:
        """Prepare the observed side.

        Parameters
        ----------
        observed : array_like, shape (N, m)
            Measured responses, a row for each specimen. NaN, or a mask, is an output that was not
            measured, +inf a specimen that failed. Shape (N,) is left to the metric of one output.
        weights : array_like, shape (N,), optional
            Weights of the specimens; equal by default.

        Returns
        -------
        Discrepancy
            ``discrepancy(simulated, weights=None)``, shapes (..., n, m), (..., n) -> (...).

        Raises
        ------
        TypeError, ValueError
            If the observed values are not real, if a specimen has no output, an output no specimen,
            or too few for a comparison.
        """
        if real_array(observed, "observed").ndim < 2:
            return self.metric.against(observed, weights)
        return super().against(observed, weights)

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        if observed.shape[1] == 1:
            target = self.metric.against(observed[:, 0], weights)
            parts: Sequence[Part] = [Part(target, 1.0, "output", OnlyOutput())]
        else:
            parts = self._parts(observed, weights)
        return CompositeDiscrepancy.of_parts(self, observed, weights, parts)

    @abstractmethod
    def _parts(self, observed: Floats, weights: Floats) -> Sequence[Part]:
        """Return the terms of the sum for at least two outputs."""


def failure_caps(observed: Floats) -> Floats:
    """Return what a failure counts as in each output: the largest value, and the range beyond."""
    finite = np.where(np.isfinite(observed), observed, np.nan)
    highest = np.nanmax(finite, axis=0)
    lowest = np.nanmin(finite, axis=0)
    return np.asarray(highest + (highest - lowest))
