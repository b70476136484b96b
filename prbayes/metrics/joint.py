"""Several outputs by a metric of one: the mean over directions in whitened coordinates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from prbayes._checks import Floats, called, positive_integer
from prbayes.metrics.base import Discrepancy, Metric, Minimum, Part
from prbayes.metrics.composite import CompositeDiscrepancy, OnlyOutput, Projection
from prbayes.metrics.directions import directions, enough
from prbayes.metrics.whitening import whitening

# Patterns of missing outputs that are compared by themselves.
_PATTERNS = 8


@dataclass(frozen=True)
class Joint(Metric):
    """Several outputs of a specimen, compared on directions in whitened coordinates."""

    metric: Metric
    directions: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        liftable(self.metric)
        if self.directions is not None:
            positive_integer(self.directions, "directions")
        positive_integer(self.seed, "seed", minimum=0)

    if not TYPE_CHECKING:

        @property
        def minimum(self) -> Minimum:
            """How a mean of discrepancies behaves: as each of them."""
            return self.metric.minimum

        @property
        def tail_responses(self) -> int:
            """As many as the metric of one output needs."""
            return self.metric.tail_responses

        @property
        def distance(self) -> bool:
            """Whether equal samples have a discrepancy of zero."""
            return self.metric.distance

    @property
    def additive(self) -> bool:
        """Whether the gradient is a mean over observations: where all outputs are measured."""
        return self.metric.additive

    @property
    def takes_weights(self) -> bool:
        """Whether simulated responses may have unequal weights."""
        return self.metric.takes_weights

    @property
    def takes_outputs(self) -> bool:
        """Yes."""
        return True

    def like(self, metric: Metric) -> Metric:
        """Return the same directions for another metric of one output."""
        return replace(self, metric=metric)

    def against(self, observed: ArrayLike, weights: ArrayLike | None = None) -> Discrepancy:
        """Prepare the observed side, shape (N, m); with shape (N,) it is the metric itself."""
        if np.ndim(observed) < 2:
            return self.metric.against(observed, weights)
        return super().against(observed, weights)

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        if observed.shape[1] == 1:
            target = self.metric.against(observed[:, 0], weights)
            parts: list[Part] = [Part(target, 1.0, "output", OnlyOutput())]
        else:
            caps = failure_caps(observed)
            parts = []
            for outputs, share in patterns(observed, weights):
                parts += self._slices(observed, weights, outputs, caps, share)
        return CompositeDiscrepancy.of_parts(self, observed, weights, parts)

    def _slices(
        self,
        observed: Floats,
        weights: Floats,
        outputs: NDArray[np.intp],
        caps: Floats,
        share: float,
    ) -> list[Part]:
        """Return the parts that compare some outputs of all specimens that have them."""
        chosen = observed[:, outputs]
        whole = np.isfinite(chosen).all(axis=-1)
        white = whitening(chosen[whole], weights[whole], outputs)
        m = outputs.size
        number = 1 if m == 1 else self.directions or enough(m)
        parts: list[Part] = []
        for k, u in enumerate(directions(m, number, self.seed)):
            label = f"direction {k + 1}"
            along = white.axes @ u
            see = Projection(outputs, caps[outputs], white.center, along)
            values, index = see.observed_of(observed)
            target = self.metric.against(values, weights[index])
            parts.append(Part(target, share / number, label, see))
        return parts


def liftable(metric: object) -> None:
    """Raise if this is no metric of one output."""
    if not isinstance(metric, Metric):
        raise TypeError(
            f"metric: got {called(metric)}, expected a metric of one output, such as "
            "prb.ProbabilityResidual()"
        )
    if metric.takes_outputs:
        raise TypeError(
            f"metric: got {called(metric)}, which compares several outputs already, expected a "
            "metric of one output, such as prb.ProbabilityResidual()"
        )


def failure_caps(observed: Floats) -> Floats:
    """Return what a failure counts as in each output: the largest value, and the range beyond."""
    finite = np.where(np.isfinite(observed), observed, np.nan)
    highest = np.nanmax(finite, axis=0)
    return highest + (highest - np.nanmin(finite, axis=0))


def patterns(observed: Floats, weights: Floats) -> list[tuple[NDArray[np.intp], float]]:
    """Return the sets of outputs that specimens have, and the weight of those that have them.

    Of more than eight, the rarest is merged with the one that has most outputs in common.
    """
    found: dict[frozenset[int], float] = {}
    for row, weight in zip(~np.isnan(observed), weights, strict=True):
        key = frozenset(np.flatnonzero(row).tolist())
        found[key] = found.get(key, 0.0) + float(weight)
    while len(found) > _PATTERNS:
        rarest = min(found, key=lambda key: (found[key], sorted(key)))
        others = [key for key in found if key != rarest]
        nearest = max(others, key=lambda key: (len(key & rarest), found[key], sorted(key)))
        common = nearest & rarest
        if not common:
            break
        share = found.pop(rarest) + found.pop(nearest)
        found[common] = found.get(common, 0.0) + share
    every = sorted(found, key=lambda key: (-len(key), sorted(key)))
    return [(np.array(sorted(key)), found[key]) for key in every if found[key] > 0]
