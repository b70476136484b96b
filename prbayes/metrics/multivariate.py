"""Discrepancies that are a sum of others, each of which sees several outputs in its own way."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self, cast

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats, sample_weights
from prbayes.metrics.base import Cellwise, CellwiseDiscrepancy, Discrepancy, Minimum, Part, View
from prbayes.metrics.components import Components
from prbayes.metrics.grid import Cells, product


@dataclass(frozen=True, eq=False)
class Centered(View):
    """Some of the outputs, less a center; those of one record share it in several projections."""

    outputs: NDArray[np.intp]  # (p,): which ones
    caps: Floats  # (p,): what a specimen counts as that failed there
    center: Floats  # (p,)

    def of(self, simulated: Any, xp: Any = np) -> Any:
        """Return the outputs (..., n, p), a failure as the cap; NaN stays."""
        chosen = simulated[..., self.outputs]
        return xp.where(chosen >= np.inf, self.caps, chosen) - self.center


@dataclass(frozen=True, eq=False)
class Projection(View):
    """One linear combination of outputs."""

    centered: Centered
    direction: Floats  # (p,)

    def of(self, simulated: Any, xp: Any = np) -> Any:
        """Return the combination, shape (..., n)."""
        return self.centered.of(simulated, xp) @ self.direction

    def observed_of(self, values: Floats) -> tuple[Floats, NDArray[np.intp]]:
        """Return the combination, of the rows that have all outputs that it needs."""
        index = np.flatnonzero(~np.isnan(values[:, self.centered.outputs]).any(axis=-1))
        return self.of(values[index]), index


@dataclass(frozen=True, eq=False)
class Standardized(View):
    """Several outputs, each in a unit of its own; rows that lack some of them count as well."""

    centered: Centered
    unit: Floats  # (p,)

    def of(self, simulated: Any, xp: Any = np) -> Any:
        """Return the outputs, shape (..., n, p)."""
        return self.centered.of(simulated, xp) / self.unit


@dataclass(frozen=True, eq=False)
class OnlyOutput(View):
    """The only output there is, as it is."""

    def of(self, simulated: Any, xp: Any = np) -> Any:
        """Return the output, (..., n, 1) -> (..., n)."""
        return simulated[..., 0]


def seen_by(
    parts: Sequence[Part], simulated: Any, xp: Any = np
) -> Iterator[tuple[Discrepancy, Any]]:
    """Yield the target of each part and what it compares; outputs are centered once for many."""
    shared: Centered | None = None
    outputs: Any = None
    for part in parts:
        view = part.view
        if not isinstance(view, Projection):
            yield part.target, part.of(simulated, xp)
            continue
        if view.centered is not shared:
            shared = view.centered
            outputs = view.centered.of(simulated, xp)
        yield part.target, outputs @ view.direction


@dataclass(frozen=True, eq=False)
class CompositeDiscrepancy(Discrepancy):
    """A sum of discrepancies, its parts, against fixed observed values of several outputs."""

    members: tuple[Part, ...]
    # (K,) or (..., K): by part, those of the data set, which may lack all specimens that a part
    # needs.
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

    def beside(self, design: Floats, inputs: int) -> Discrepancy:
        """Return the same with the principal components of data and design together.

        Fewer inputs than outputs matter as well.
        """
        if not self.components and inputs >= self.observed.shape[1]:
            return self
        return self.metric.beside(self.observed, self.weights, design, inputs)

    @property
    def parts(self) -> tuple[Part, ...]:
        """The terms of the sum."""
        return self.members

    @property
    def told(self) -> str:
        """How many principal components there are, and what they leave out."""
        return "; ".join(found.told for found in self.components)

    @property
    def missed(self) -> str:
        """What principal components leave out that is no noise."""
        return "; ".join(filter(None, (found.missed for found in self.components)))

    @property
    def targets(self) -> list[Discrepancy]:
        """The discrepancies of the parts."""
        return [part.target for part in self.members]

    def with_observed(self, observed: Floats, weights: Floats | None = None) -> Self:
        """Return the same metric, on the same cells and slices, against other values.

        Parameters
        ----------
        observed : ndarray, shape (n, m)
            NaN is an output that was not measured.
        weights : ndarray, shape (n,) or (..., n), optional
            Equal by default. A part sees the rows that have the outputs that it needs. If none of
            these has weight in a data set, the other parts take its share there.
        """
        w = sample_weights(weights, len(observed))
        parts = []
        seen = np.zeros((*w.shape[:-1], len(self.members)), dtype=bool)
        for k, part in enumerate(self.members):
            values, index = part.observed_of(observed)
            own = w[..., index]
            seen[..., k] = own.sum(axis=-1) > 0
            if not index.size:  # any values do, as they do not count
                values = part.target.observed
                own = np.zeros((*w.shape[:-1], len(values)))
            own = np.where(seen[..., k, None], own, 1.0)
            target = part.target.with_observed(values, own)
            parts.append(replace(part, target=target))
        if not seen.any(axis=-1).all():
            raise ValueError(
                "observed: got specimens that lack outputs which every part of the metric needs, "
                f"expected some that have those of {self.members[0].label!r} or another part; "
                "prepare the metric against them by Metric.against"
            )
        nominal = np.array([part.share for part in parts])
        shares = nominal * seen
        left = shares.sum(axis=-1, keepdims=True)
        shares = shares * (nominal.sum() / left)
        if seen.all():
            shares = np.broadcast_to(nominal, seen.shape)
        return replace(self, observed=observed, weights=w, members=tuple(parts), shares=shares)

    def rows(self, index: Any) -> Self:
        """Return some of the data sets of which there are several; nothing is computed anew."""
        parts = tuple(replace(p, target=p.target.rows(index)) for p in self.members)
        return replace(super().rows(index), members=parts)

    @property
    def likelihood(self) -> bool:
        """Whether N times it is on the scale of a log-likelihood: not a mean over directions."""
        return len(self.members) == 1 and self.targets[0].likelihood

    @property
    def exact(self) -> bool:
        """Whether N times it is minus a log-likelihood itself."""
        return len(self.members) == 1 and self.targets[0].exact

    @property
    def additive(self) -> bool:
        """Whether the gradient is a mean over observations: not where some see fewer outputs."""
        complete = not np.isnan(self.observed).any()
        return complete and self.metric.additive

    @property
    def symbolic(self) -> bool:
        """Whether all parts can be written as a graph."""
        return all(target.symbolic for target in self.targets)

    @property
    def differentiable(self) -> bool:
        """Whether all parts have second derivatives."""
        return all(target.differentiable for target in self.targets)

    @property
    def scale(self) -> float:
        """The sum of the typical sizes of the parts."""
        return float(sum(part.share * part.target.scale for part in self.members))

    def overlap(self, simulated: Floats, weights: Floats) -> Floats:
        """Return the smallest overlap of any part, (..., n, m) -> (...)."""
        overlaps = []
        for target, seen in seen_by(self.members, simulated):
            overlap = target.overlap(seen, weights)
            overlaps.append(overlap)
        return np.min(overlaps, axis=0)

    @cached_property
    def _groups(self) -> tuple[_Group, ...]:
        """The parts by how they are evaluated together; the last has any number of arrays."""
        groups: list[_Group] = []
        single = []
        for k, part in enumerate(self.members):
            if part.target.event:
                groups.append(_Each((k,), (part,)))
            else:
                single.append(k)
        if single:
            parts = tuple(self.members[k] for k in single)
            kind: type[_Group] = _Each
            if all(part.target.density_cells is not None for part in parts):
                kind = _Densities
            elif all(part.target.metric.minimum is Minimum.ABSOLUTE for part in parts):
                kind = _Values
            groups.append(kind(tuple(single), parts))
        return tuple(groups)

    def features(self, simulated: Any, weights: Any, xp: Any) -> tuple[Any, ...]:
        """Return the features of the parts."""
        found = [group.features(simulated, weights, xp) for group in self._groups]
        return sum(found, ())

    def basis(self, simulated: Floats) -> tuple[NDArray[Any], ...]:
        """Return arrays that turn weights of stored values, (n, m), into features."""
        if not self.symbolic:
            return (simulated,)
        return sum((group.basis(simulated) for group in self._groups), ())

    @property
    def columns(self) -> int:
        """How many numbers the basis has for each value, if all parts compare densities."""
        first, *others = self._groups
        return 0 if others or not self.symbolic else first.columns

    def compact(self, simulated: Floats) -> tuple[NDArray[Any], ...]:
        """Return what each part sees, (n, K), instead of densities of it, (n, cells)."""
        return self._groups[0].compact(simulated) if self.columns else self.basis(simulated)

    def pulled_back(self, basis: Floats, cotangent: Floats) -> Floats:
        """Return the derivatives for the weights, (..., n), of a sum over densities."""
        return self._groups[0].pulled_back(basis, cotangent)

    def from_basis(self, weights: Any, basis: tuple[Any, ...], xp: Any) -> tuple[Any, ...]:
        """Return the features of the values that the basis was made for."""
        if not self.symbolic:
            (values,) = basis
            values = np.broadcast_to(values, (*weights.shape, *self.event))
            return self.features(values, weights, xp)
        divided = self._divided(basis)
        found = []
        for group, own in zip(self._groups, divided, strict=True):
            features = group.from_basis(weights, own, xp)
            found.append(features)
        return sum(found, ())

    @property
    def cellwise(self) -> Cellwise | None:
        """How all parts are one sum over the cells of all of them."""
        first, *others = self._groups
        if others or not self.symbolic:
            return None
        return first.cellwise(self.shares[..., list(first.places)])

    def outer(self, *features: Any, xp: Any) -> Any:
        """Return the sum of the parts, each times its share."""
        total: Any = 0.0
        for group, own in zip(self._groups, self._divided(features), strict=True):
            shares = self.shares[..., list(group.places)]
            total = total + group.outer(own, shares, xp)
        return total

    def _divided(self, arrays: tuple[Any, ...]) -> list[tuple[Any, ...]]:
        """Return the arrays of each group: one each, and for the last all others."""
        last = len(self._groups) - 1
        found = []
        for place in range(last):
            found.append(arrays[place : place + 1])
        found.append(arrays[last:])
        return found


@dataclass(frozen=True, eq=False)
class _Group(ABC):
    """Parts that are evaluated together."""

    places: tuple[int, ...]  # of the parts in the sum
    parts: tuple[Part, ...]

    @abstractmethod
    def features(self, simulated: Any, weights: Any, xp: Any) -> tuple[Any, ...]:
        """Return the features of all parts."""

    @abstractmethod
    def basis(self, simulated: Floats) -> tuple[NDArray[Any], ...]:
        """Return the arrays that turn weights into features."""

    @property
    def columns(self) -> int:
        """As of a discrepancy."""
        return 0

    def compact(self, simulated: Floats) -> tuple[NDArray[Any], ...]:
        """As of a discrepancy."""
        return self.basis(simulated)

    def pulled_back(self, basis: Floats, cotangent: Floats) -> Floats:
        """As of a discrepancy."""
        raise NotImplementedError

    @abstractmethod
    def from_basis(self, weights: Any, basis: tuple[Any, ...], xp: Any) -> tuple[Any, ...]:
        """Return the features."""

    def cellwise(self, shares: Floats) -> Cellwise | None:
        """As of a discrepancy."""
        return None

    @abstractmethod
    def outer(self, features: tuple[Any, ...], shares: Floats, xp: Any) -> Any:
        """Return the sum of the parts, each times its share, shape (..., K)."""

    def _of_each(self, arrays: tuple[Any, ...]) -> list[tuple[Any, ...]]:
        """Return the arrays of each part, of which all have as many."""
        size = len(arrays) // len(self.parts)
        found = []
        for k in range(len(self.parts)):
            begin = k * size
            own = arrays[begin : begin + size]
            found.append(own)
        return found


class _Each(_Group):
    """Parts one after the other, each with features of its own."""

    def features(self, simulated: Any, weights: Any, xp: Any) -> tuple[Any, ...]:
        """Return the features of all parts."""
        seen = seen_by(self.parts, simulated, xp)
        return sum((target.features(y, weights, xp) for target, y in seen), ())

    def basis(self, simulated: Floats) -> tuple[NDArray[Any], ...]:
        """Return the arrays of all parts."""
        return sum((target.basis(y) for target, y in seen_by(self.parts, simulated)), ())

    def from_basis(self, weights: Any, basis: tuple[Any, ...], xp: Any) -> tuple[Any, ...]:
        """Return the features of all parts."""
        found = []
        for part, own in zip(self.parts, self._of_each(basis), strict=True):
            features = part.target.from_basis(weights, own, xp)
            found.append(features)
        return sum(found, ())

    def outer(self, features: tuple[Any, ...], shares: Floats, xp: Any) -> Any:
        """Return the sum of the parts."""
        total: Any = 0.0
        divided = self._of_each(features)
        for k, part in enumerate(self.parts):
            own = divided[k]
            value = part.target.outer(*own, xp=xp)
            total = total + shares[..., k] * value
        return total


class _Values(_Each):
    """Parts whose only features are their values.

    What they are made of has a number for each point and part, and depends on the observed side.
    """

    def features(self, simulated: Any, weights: Any, xp: Any) -> tuple[Any, ...]:
        """Return the values of all parts, (..., K)."""
        found = []
        for target, seen in seen_by(self.parts, simulated, xp):
            own = target.features(seen, weights, xp)
            found.append(target.outer(*own, xp=xp))
        return (xp.stack(found, axis=-1),)

    def basis(self, simulated: Floats) -> tuple[NDArray[Any], ...]:
        """Return the arrays of all parts, stacked where the targets can."""
        bases = [target.basis(seen) for target, seen in seen_by(self.parts, simulated)]
        stacked = self.parts[0].target.stacked(bases)
        return sum(bases, ()) if stacked is None else stacked

    def from_basis(self, weights: Any, basis: tuple[Any, ...], xp: Any) -> tuple[Any, ...]:
        """Return the values of all parts, (..., K)."""
        targets = [part.target for part in self.parts]
        values = targets[0].side_by_side(targets, weights, basis, xp)
        if values is None:
            found = []
            for target, own in zip(targets, self._of_each(basis), strict=True):
                features = target.from_basis(weights, own, xp)
                found.append(target.outer(*features, xp=xp))
            values = xp.stack(found, axis=-1)
        return (values,)

    def outer(self, features: tuple[Any, ...], shares: Floats, xp: Any) -> Any:
        """Return their sum."""
        return (features[0] * shares).sum(axis=-1)


class _Densities(_Group):
    """Parts that compare densities: those lie side by side, so that one product gives them all."""

    @cached_property
    def _sizes(self) -> list[int]:
        """How many cells each part has."""
        return [cast(Cells, part.target.density_cells).widths.size for part in self.parts]

    @cached_property
    def _slices(self) -> list[slice]:
        """Where the cells of each part are."""
        ends = np.cumsum(self._sizes).tolist()
        return [slice(end - size, end) for end, size in zip(ends, self._sizes, strict=True)]

    @cached_property
    def _cellwise(self) -> bool:
        """Whether all parts are sums over cells, and so are one sum over all cells."""
        return all(type(part.target).outer is CellwiseDiscrepancy.outer for part in self.parts)

    @cached_property
    def _constants(self) -> tuple[Floats, ...]:
        """What the sum over cells takes beside the density, of all parts side by side."""
        by_part = [cast(CellwiseDiscrepancy, part.target).constants for part in self.parts]
        return tuple(self._side_by_side(each) for each in zip(*by_part, strict=True))

    def _side_by_side(self, each: Sequence[Any]) -> Floats:
        """Return numbers by cell, (..., m_k) or one for all of a part, as (..., all cells)."""
        batch = np.broadcast_shapes(*(np.shape(one)[:-1] for one in each))
        columns = []
        for one, size in zip(each, self._sizes, strict=True):
            columns.append(np.broadcast_to(one, (*batch, size)))
        return np.concatenate(columns, axis=-1)

    def features(self, simulated: Any, weights: Any, xp: Any) -> tuple[Any, ...]:
        """Return the densities side by side, (..., cells)."""
        found: list[Any] = []
        for target, seen in seen_by(self.parts, simulated, xp):
            found += target.features(seen, weights, xp)
        return (xp.concatenate(found, axis=-1),)

    def basis(self, simulated: Floats) -> tuple[NDArray[Any], ...]:
        """Return one matrix, (n, cells)."""
        out = np.empty((len(simulated), sum(self._sizes)))
        seen_by_part = seen_by(self.parts, simulated)
        for (target, seen), cells in zip(seen_by_part, self._slices, strict=True):
            (out[:, cells],) = target.basis(seen)
        return (out,)

    @property
    def columns(self) -> int:
        """How many cells there are, if there are several parts."""
        return sum(self._sizes) if len(self.parts) > 1 else 0

    def compact(self, simulated: Floats) -> tuple[NDArray[Any], ...]:
        """Return what each part sees, (n, K)."""
        return (np.stack([seen for _, seen in seen_by(self.parts, simulated)], axis=-1),)

    def from_basis(self, weights: Any, basis: tuple[Any, ...], xp: Any) -> tuple[Any, ...]:
        """Return the densities side by side, (..., cells)."""
        (matrix,) = basis
        if xp is not np:
            return (weights @ matrix,)
        if self._is_compact(matrix):
            return (self._binned(matrix, weights),)
        return (product(weights, matrix),)

    def _is_compact(self, matrix: Floats) -> bool:
        """Whether this is what each part sees; densities have several cells a part."""
        return self.columns > 0 and matrix.shape[-1] == len(self.parts)

    def pulled_back(self, basis: Floats, cotangent: Floats) -> Floats:
        """Return the derivatives for the weights of a sum over the densities."""
        total: Any = 0.0
        for part, values, cells in zip(self.parts, basis.T, self._slices, strict=True):
            own = cast(Cells, part.target.density_cells)
            total = total + own.value(values, cotangent[..., cells])
        return np.asarray(total)

    def _binned(self, seen: Floats, weights: Floats) -> Floats:
        """Return the densities side by side of what each part sees, (n, K), (..., n)."""
        found: list[Any] = []
        for part, values in zip(self.parts, seen.T, strict=True):
            sample = np.broadcast_to(values, weights.shape)
            found += part.target.features(sample, weights, np)
        return np.concatenate(found, axis=-1)

    def outer(self, features: tuple[Any, ...], shares: Floats, xp: Any) -> Any:
        """Return the sum of the parts, in one pass over all cells where that can be."""
        (densities,) = features
        over = self.cellwise(shares)
        if over is None:
            return self._one_by_one(densities, shares, xp)
        return over.outer(densities, xp)

    def cellwise(self, shares: Floats) -> Cellwise | None:
        """Return the parts as one sum over all cells, if each is one over its own."""
        if not self._cellwise:
            return None
        first = cast(CellwiseDiscrepancy, self.parts[0].target)
        return Cellwise(first, self._constants, np.repeat(shares, self._sizes, axis=-1))

    def _one_by_one(self, densities: Any, shares: Floats, xp: Any) -> Any:
        """Return the sum of parts with an outer function of their own."""
        total: Any = 0.0
        for k, (part, cells) in enumerate(zip(self.parts, self._slices, strict=True)):
            total = total + shares[..., k] * part.target.outer(densities[..., cells], xp=xp)
        return total
