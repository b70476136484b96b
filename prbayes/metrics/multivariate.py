"""Metrics of several outputs: sums of a metric of one number over projections."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from prbayes._validate import AT_ONCE, Floats, called, real_array, sample_weights
from prbayes.metrics.base import (
    Basis,
    Discrepancy,
    Features,
    Metric,
    Minimum,
    Part,
    PartSum,
    StoredBasis,
    joined,
)
from prbayes.metrics.components import Components
from prbayes.metrics.views import OnlyOutput


@dataclass(frozen=True, eq=False)
class CompositeDiscrepancy(Discrepancy):
    """A sum of discrepancies of projections against fixed observed values of several outputs."""

    members: tuple[Part, ...]
    # (K,) or (..., K): by component and data set, which may lack all specimens of a component.
    shares: Floats
    # Of sets of outputs that are compared by principal components.
    components: tuple[Components, ...] = ()
    _by_data_set: ClassVar[tuple[str, ...]] = ("weights", "shares")

    @classmethod
    def of_parts(
        cls,
        metric: Any,
        observed: Floats,
        weights: Floats,
        parts: Sequence[Part],
        components: tuple[Components, ...] = (),
    ) -> Self:
        """Return the sum of parts that have been prepared against these values, (N, m) and (N,)."""
        shares = np.array([part.share for part in parts])
        return cls(metric, observed, weights, tuple(parts), shares, components)

    @property
    def parts(self) -> tuple[Part, ...]:
        """The components of the sum."""
        return self.members

    @property
    def scale(self) -> float:
        """The sum of the typical sizes of the components."""
        return float(sum(part.share * part.target.scale for part in self.members))

    def with_observed(self, observed: Floats, weights: Floats | None = None) -> Self:
        """Return the same metric, on the same cells and projections, against other values (n, m).

        A component sees the rows that have its outputs. If none of these has weight in a data set,
        the other components take its share there.
        """
        w = sample_weights(weights, len(observed))
        batch = w.shape[:-1]
        parts = []
        has_specimens = np.zeros((*batch, len(self.members)), dtype=bool)
        for k, part in enumerate(self.members):
            values, index = part.observed_of(observed)
            part_weights = w[..., index]
            has_specimens[..., k] = part_weights.sum(axis=-1) > 0
            if not index.size:  # any values do, as they do not count
                values = part.target.observed
                part_weights = np.zeros((*batch, len(values)))
            part_weights = np.where(has_specimens[..., k, None], part_weights, 1.0)
            parts.append(replace(part, target=part.target.with_observed(values, part_weights)))
        if not has_specimens.any(axis=-1).all():
            raise ValueError(
                "observed: got specimens that lack outputs which every part of the metric needs, "
                f"expected some that have those of {self.members[0].label!r} or another part; "
                "prepare the metric against them by Metric.against"
            )
        nominal = np.array([part.share for part in parts])
        if has_specimens.all():
            shares = np.broadcast_to(nominal, has_specimens.shape)
        else:
            shares = nominal * has_specimens
            shares = shares * (nominal.sum() / shares.sum(axis=-1, keepdims=True))
        return replace(self, observed=observed, weights=w, members=tuple(parts), shares=shares)

    def rows(self, index: Any) -> Self:
        """Return some of several data sets."""
        parts = tuple(replace(p, target=p.target.rows(index)) for p in self.members)
        return replace(super().rows(index), members=parts)

    @cached_property
    def _sums(self) -> list[tuple[list[int], PartSum]]:
        """Components that are evaluated together, with their places; the last have one number."""
        several = [k for k, part in enumerate(self.members) if part.target.event]
        single = [k for k, part in enumerate(self.members) if not part.target.event]
        sums: list[tuple[list[int], PartSum]] = [
            ([k], PartSum((self.members[k],))) for k in several
        ]
        if single:
            parts = tuple(self.members[k] for k in single)
            sums.append((single, parts[0].target.together(parts)))
        return sums

    def features(self, simulated: Any, weights: Any, xp: Any) -> Features:
        """Return the features of the components."""
        return sum((terms.features(simulated, weights, xp) for _, terms in self._sums), ())

    def basis(self, simulated: Floats, most: float = AT_ONCE) -> Basis:
        """Return the map from weights of stored values, (n, m), to features."""
        if not self.metric.symbolic:
            return StoredBasis((simulated,), self)
        return joined([terms.basis(simulated, most) for _, terms in self._sums])

    def outer(self, *features: Any, xp: Any) -> Any:
        """Return the sum of the components, each times its share."""
        total: Any = 0.0
        last = len(self._sums) - 1
        for i, (places, terms) in enumerate(self._sums):
            # A component of several outputs has one feature; the others are of the last sum.
            terms_features = features[i:] if i == last else features[i : i + 1]
            total = total + terms.outer(terms_features, self.shares[..., places], xp)
        return total


def components_summary(target: Discrepancy) -> str:
    """Return what principal components leave out, for a reader; empty if there are none."""
    components = target.components if isinstance(target, CompositeDiscrepancy) else ()
    return "; ".join(c.summary for c in components)


def components_missed(target: Discrepancy) -> str:
    """Return the structure of the data that principal components leave out; empty if none."""
    components = target.components if isinstance(target, CompositeDiscrepancy) else ()
    return "; ".join(c.missed for c in components if c.missed)


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
        """How a discrepancy behaves around its minimum: as that of one output does."""
        return self.metric.minimum

    @property
    def symbolic(self) -> bool:  # type: ignore[override]
        """Whether the outer function can be written as a graph."""
        return self.metric.symbolic

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
            measured, +inf a specimen that failed. The metric of one output takes shape (N,).
        weights : array_like, shape (N,), optional
            Weights of the specimens; equal by default.

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
        if observed.shape[1] > 1:
            return self._prepare_outputs(observed, weights)
        target = self.metric.against(observed[:, 0], weights)
        part = Part(target, 1.0, "output", OnlyOutput())
        return CompositeDiscrepancy.of_parts(self, observed, weights, [part])

    @abstractmethod
    def _prepare_outputs(self, observed: Floats, weights: Floats) -> Discrepancy:
        """Return the discrepancy of at least two outputs."""


def failure_caps(observed: Floats) -> Floats:
    """Return the value of a failure in each output: the largest one plus the range."""
    finite = np.where(np.isfinite(observed), observed, np.nan)
    highest = np.nanmax(finite, axis=0)
    lowest = np.nanmin(finite, axis=0)
    return np.asarray(highest + (highest - lowest))


def sufficient_directions(m: int) -> int:
    """Return a sufficient number of directions for m outputs, at least two.

    Twice as many as a scatter's shape has parameters. Errors of means, standard deviations and
    correlations are then those of ten times as many, to 3% (`benchmarks/directions.py`).
    """
    return (m - 1) * (m + 2)


@cache
def directions(m: int, number: int, seed: int) -> Floats:
    """Return well-spread unit vectors, shape (number, m), the same for the same arguments.

    In the plane they are at equal angles. With more outputs they start from random places, and
    each repels the others and their opposites.
    """
    if m == 1:
        return np.ones((number, 1))
    if m == 2:
        angles = np.pi * (np.arange(number) + 0.5) / number
        return np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return repelled(np.random.default_rng(seed).standard_normal((number, m)))


def repelled(u: Floats, steps: int = 2000) -> Floats:
    """Return unit vectors at a low energy, the sum of -log(1 - cosine^2) over their pairs.

    With twice as many steps the largest cosine is the same to .03 (test).
    """

    def normalized(vectors: Floats) -> Floats:
        return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))

    u = normalized(u)
    number, m = u.shape
    # A fraction of the distance between neighbours: after longer steps rounding decides.
    longest = 0.2 * number ** (-1 / (m - 1))
    for step in range(steps):
        cosine = u @ u.T
        np.fill_diagonal(cosine, 0.0)
        # The constant lets all vectors move, where two start close together.
        force = (cosine / (1 - cosine**2 + 1e-3)) @ u
        force -= (force * u).sum(axis=-1, keepdims=True) * u
        largest = np.linalg.norm(force, axis=-1).max()
        if largest == 0:
            break
        move = longest * (1 - step / steps) / max(largest, 1.0)
        u = normalized(u - move * force)
    return u
