"""Where a surrogate holds: a range for each input of a response, given or from a prior predictive distribution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pytensor.graph.basic import Variable

from prbayes._checks import Floats, real_array
from prbayes.model.node import model_on_context
from prbayes.propagation.points import sobol
from prbayes.response.compilation import compile_batched
from prbayes.response.distributions import PopulationSampler, prior_draws, valid
from prbayes.response.inputs import read_inputs

_POPULATIONS, _SPECIMENS = 512, 64  # of the prior predictive, by which inputs get their ranges
_ROUNDING = 1e-9  # of a range


@dataclass(frozen=True, eq=False)
class Input:
    """The range of one input: its lowest and highest value, shape (*event)."""

    name: str
    low: Floats
    high: Floats
    constant: bool = False


@dataclass(frozen=True, eq=False)
class Region:
    """The ranges of all inputs; specimens are rows with one column for each number."""

    inputs: tuple[Input, ...]

    @cached_property
    def low(self) -> Floats:
        """Lowest values, shape (columns,)."""
        return np.concatenate([e.low.ravel() for e in self.inputs])

    @cached_property
    def high(self) -> Floats:
        """Highest values, shape (columns,)."""
        return np.concatenate([e.high.ravel() for e in self.inputs])

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """Which columns are not constant."""
        return np.concatenate([np.full(e.low.size, not e.constant) for e in self.inputs])

    @property
    def dimensions(self) -> int:
        """Number of columns that are not constant."""
        return int(self.free.sum())

    def scaled(self, columns: Floats) -> Floats:
        """Return the free columns with their ranges mapped to [0, 1]."""
        low, high = self.low[self.free], self.high[self.free]
        return np.asarray((columns[:, self.free] - low) / (high - low))

    def at(self, unit: Floats) -> Floats:
        """Return rows for points of the unit cube."""
        columns = np.tile(self.low, (len(unit), 1))
        columns[:, self.free] += unit * (self.high - self.low)[self.free]
        return columns

    def outside(self, columns: Floats) -> NDArray[np.bool_]:
        """Return which numbers are outside of their range, NaN included."""
        slack = _ROUNDING * (self.high - self.low)
        return np.asarray(~((columns >= self.low - slack) & (columns <= self.high + slack)))

    def complaint(self, columns: Floats, out: NDArray[np.bool_]) -> str:
        """Say which inputs are outside."""
        said, at = [], 0
        for e in self.inputs:
            part, wrong = columns[:, at : at + e.low.size], out[:, at : at + e.low.size]
            at += e.low.size
            if wrong.any():
                got = f"{part[wrong].min():.6g} to {part[wrong].max():.6g}"
                said.append(f"{e.name} from {got}, expected {np.min(e.low):.6g} to {np.max(e.high):.6g}")
        return f"got {out.any(axis=1).sum()} of {len(columns)} points outside its design: {'; '.join(said)}"

    def arguments(self, columns: Floats) -> list[Any]:
        """Return the response's arguments for rows: arrays (n, *event), and numbers."""
        edges = np.cumsum([0, *(e.low.size for e in self.inputs)])
        return [
            float(e.low) if e.constant else columns[:, a:b].reshape(-1, *e.low.shape)
            for e, a, b in zip(self.inputs, edges[:-1], edges[1:], strict=True)
        ]

    def columns(self, values: Sequence[ArrayLike]) -> tuple[Floats, tuple[int, ...]]:
        """Return inputs, shapes (..., *event), as rows, and their leading shape."""
        if len(values) != len(self.inputs):
            names = ", ".join(e.name for e in self.inputs)
            raise TypeError(f"surrogate: got {len(values)} inputs, expected {len(self.inputs)}: {names}")
        arrays = [real_array(x, e.name) for x, e in zip(values, self.inputs, strict=True)]
        for a, e in zip(arrays, self.inputs, strict=True):
            if e.low.ndim and a.shape[-e.low.ndim :] != e.low.shape:
                raise ValueError(f"{e.name}: got shape {a.shape}, expected (..., {', '.join(map(str, e.low.shape))})")
        batch = np.broadcast_shapes(*(a.shape[: a.ndim - e.low.ndim] for a, e in zip(arrays, self.inputs, strict=True)))
        full = [np.broadcast_to(a, batch + e.low.shape) for a, e in zip(arrays, self.inputs, strict=True)]
        return np.concatenate(
            [a.reshape(-1, e.low.size) for a, e in zip(full, self.inputs, strict=True)], axis=1
        ), batch


def read_region(name: str, inputs: Any, coverage: float, seed: int) -> tuple[Region, Floats | None]:
    """Return the ranges of inputs, and rows from the prior predictive distribution inside them if one is random.

    Raises
    ------
    TypeError, ValueError
        If an input is no range, distribution or number, a range is empty, or all are constants.
    """
    if not isinstance(inputs, Mapping | Sequence) or isinstance(inputs, str) or not len(inputs):
        raise TypeError(f"{name}: inputs: got {inputs!r:.60}, expected a dict such as {{'k': (200, 300)}}, or a list")
    named = dict(inputs) if isinstance(inputs, Mapping) else dict(enumerate(inputs, 1))
    random = [key for key, x in named.items() if isinstance(x, Variable)]
    drawn = dict(zip(random, _predictive(name, [named[k] for k in random], seed), strict=True)) if random else {}
    found = []
    for key, x in named.items():
        label = key if isinstance(key, str) else str(getattr(x, "name", None) or f"input {key}")
        e = _covering(label, drawn[key], coverage) if key in drawn else _range(name, label, x)
        if not (np.isfinite(e.low) & np.isfinite(e.high) & (e.constant | (e.low < e.high))).all():
            raise ValueError(f"{name}: {label}: got {e.low} to {e.high}, expected a range (low, high) with low < high")
        found.append(e)
    region = Region(tuple(found))
    if not region.dimensions:
        raise ValueError(f"{name}: inputs: got constants only, expected at least one range or distribution")
    if not random:
        return region, None
    uniform = region.columns(region.arguments(region.at(sobol(_POPULATIONS * _SPECIMENS, region.dimensions, seed))))[0]
    full = [drawn.get(key, values) for key, values in zip(named, region.arguments(uniform), strict=True)]
    rows, _ = region.columns(
        [f.reshape(-1, *e.low.shape) if np.ndim(f) else f for f, e in zip(full, found, strict=True)]
    )
    return region, rows[~region.outside(rows).any(axis=1)]


def _range(name: str, label: str, x: Any) -> Input:
    array = real_array(x, f"{name}: {label}")
    if array.shape == ():
        return Input(label, array, array, constant=True)
    if array.shape != (2,):
        raise ValueError(
            f"{name}: {label}: got shape {array.shape}, expected a range (low, high), a `.dist()`, a variable of the "
            "model or a number"
        )
    return Input(label, array[0, ...], array[1, ...])


def _covering(label: str, draws: Floats, coverage: float) -> Input:
    tail = (1 - coverage) / 2
    low, high = np.quantile(draws, [tail, 1 - tail], axis=(0, 1))
    return Input(label, np.asarray(low), np.asarray(high))


def _predictive(name: str, variables: list[Any], seed: int) -> list[Floats]:
    """Return prior predictive draws of variables, shapes (populations, specimens, *event)."""
    inputs = read_inputs(name, variables, model_on_context(None, f"{name}: inputs that are distributions"))
    symbols = inputs.placeholders()
    thetas = prior_draws(inputs.roots, _POPULATIONS, seed)
    ok = compile_batched(symbols, [valid(inputs, inputs.rebuilt(symbols)[0])])(*thetas)[0]
    usable = np.flatnonzero(np.broadcast_to(ok, _POPULATIONS))
    if not usable.size:
        raise ValueError(
            f"{name}: got invalid parameters of the inputs at all draws of the priors, expected valid ones"
        )
    chosen = usable[np.arange(_POPULATIONS) % usable.size]
    drawn = PopulationSampler(inputs)([t[chosen] for t in thetas], _SPECIMENS, np.random.default_rng(seed))
    size = (_POPULATIONS, _SPECIMENS)
    return [np.broadcast_to(x, (*size, *x.shape[2:])).astype(np.float64) for x in inputs.fill(*drawn)]
