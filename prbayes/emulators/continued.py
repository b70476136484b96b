"""Surfaces of tables of runs beyond their ranges, and their errors at runs that were left out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from prbayes._validate import Floats
from prbayes.emulators.runs import Runs
from prbayes.emulators.surrogate import Surrogate


@dataclass(frozen=True, eq=False)
class Continued:
    """The surface of a table, continued linearly from the nearest point of the ranges."""

    runs: Runs

    def __call__(self, *inputs: ArrayLike) -> Any:
        """Return the response, (...) or (..., m); NaN beside failed runs."""
        surrogate, step = self.runs.surrogate, 1e-3
        domain = surrogate.domain
        columns, batch = domain.columns(inputs)
        unit = domain.scaled(columns)
        inner = np.clip(unit, step, 1 - step)
        values = surrogate._at(domain.at(inner))
        rows = np.flatnonzero(domain.outside(columns).any(axis=1))
        away = unit[rows] - inner[rows]
        for j, shift in enumerate(step * np.eye(unit.shape[1])):
            ends = [surrogate._at(domain.at(inner[rows] + s * shift)) for s in (1, -1)]
            slope = (ends[0] - ends[1]) / (2 * step)
            values[rows] += slope * away[:, j].reshape(-1, *[1] * (slope.ndim - 1))
        return labelled(surrogate, values, batch)


@dataclass(frozen=True, eq=False)
class LeftOut:
    """The cross-validation residual of the nearest run."""

    runs: Runs

    def __call__(self, *inputs: ArrayLike) -> Any:
        """Return residuals, (...) or (..., m)."""
        surrogate = self.runs.surrogate
        columns, batch = surrogate.domain.columns(inputs)
        residuals = surrogate._surface.nearby(surrogate.error.residuals, columns)[:, 0]
        return labelled(surrogate, residuals, batch)


def labelled(surrogate: Surrogate, values: Floats, batch: tuple[int, ...]) -> Any:
    """Return values of rows in the shape of a batch, with the labels of the outputs."""
    values = values.reshape((*batch, *surrogate.responses.shape[1:]))
    return values if surrogate._named is None else surrogate._named.by_key(values)
