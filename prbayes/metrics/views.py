"""Projections of a response: the numbers of a specimen that a component of a metric compares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats


@dataclass(frozen=True, eq=False)
class View:
    """The whole response."""

    def of(self, simulated: Any, xp: Any = np) -> Any:
        """Return the projection of simulated responses, outputs along the last axis."""
        return simulated

    def observed_of(self, values: Floats) -> tuple[Floats, NDArray[np.intp]]:
        """Return the projection of observed values, and the rows that have one."""
        return self.of(values), np.arange(len(values))


@dataclass(frozen=True, eq=False)
class OnlyOutput(View):
    """The only output, without its axis."""

    def of(self, simulated: Any, xp: Any = np) -> Any:
        """Return the output, (..., n, 1) -> (..., n)."""
        return simulated[..., 0]


@dataclass(frozen=True, eq=False)
class Centered(View):
    """Some of the outputs, less a center; several projections share one record."""

    outputs: NDArray[np.intp]  # (p,): indices
    caps: Floats  # (p,): the value of a specimen that failed
    center: Floats  # (p,)

    def of(self, simulated: Any, xp: Any = np) -> Any:
        """Return the outputs (..., n, p), a failure as the cap; NaN stays."""
        outputs = simulated[..., self.outputs]
        return xp.where(outputs >= np.inf, self.caps, outputs) - self.center


@dataclass(frozen=True, eq=False)
class Projection(View):
    """A linear combination of outputs."""

    centered: Centered
    direction: Floats  # (p,)

    def of(self, simulated: Any, xp: Any = np) -> Any:
        """Return the combination, shape (..., n)."""
        return self.centered.of(simulated, xp) @ self.direction

    def observed_of(self, values: Floats) -> tuple[Floats, NDArray[np.intp]]:
        """Return the combination, of the rows that have all necessary outputs."""
        index = np.flatnonzero(~np.isnan(values[:, self.centered.outputs]).any(axis=-1))
        return self.of(values[index]), index


@dataclass(frozen=True, eq=False)
class Standardized(View):
    """Several outputs, each in its unit; rows that lack some of them count as well."""

    centered: Centered
    unit: Floats  # (p,)

    def of(self, simulated: Any, xp: Any = np) -> Any:
        """Return the outputs, shape (..., n, p)."""
        return self.centered.of(simulated, xp) / self.unit
