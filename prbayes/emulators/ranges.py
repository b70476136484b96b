"""Ranges of a surrogate's inputs, given or from their prior predictive distributions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pytensor.graph.basic import Variable

from prbayes._validate import Bools, Floats, Names, Shape, real_array
from prbayes.numerics.points import sobol
from prbayes.response.call import column_names
from prbayes.response.compile import compile_batched
from prbayes.response.distributions import PopulationSampler, PriorSampler, valid
from prbayes.response.inputs import model_on_context, read_inputs

# Ranges are quantiles of 512 x 64 = 2^15 draws. With a coverage of .999 about 16 draws are beyond
# either end, so that the share left out has a standard error of a quarter.
POPULATIONS, SPECIMENS = 512, 64


@dataclass(frozen=True, eq=False)
class Range:
    """The range of one input."""

    name: str
    # Lowest and highest value, (*event), in the input's own units.
    low: Floats
    high: Floats
    constant: bool = False  # whether the input is a constant

    @property
    def size(self) -> int:
        """The number of elements of the input."""
        return self.low.size

    @property
    def event(self) -> Shape:
        """The shape of one value."""
        return self.low.shape


@dataclass(frozen=True, eq=False)
class Ranges:
    """The ranges of all inputs; specimens are rows with one column for each number."""

    inputs: tuple[Range, ...]

    @cached_property
    def low(self) -> Floats:
        """Lowest values, shape (columns,)."""
        return np.concatenate([r.low.ravel() for r in self.inputs])

    @cached_property
    def high(self) -> Floats:
        """Highest values, shape (columns,)."""
        return np.concatenate([r.high.ravel() for r in self.inputs])

    @cached_property
    def free(self) -> Bools:
        """Which columns are not constant."""
        return np.repeat(self.varying, self.sizes)

    @property
    def sizes(self) -> list[int]:
        """Number of columns of each input."""
        return [r.size for r in self.inputs]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return tuple(r.name for r in self.inputs)

    @property
    def column_names(self) -> Names:
        """Name of each column."""
        return column_names(self.names, self.sizes)

    @property
    def varying(self) -> list[bool]:
        """Which inputs are not constant."""
        return [not r.constant for r in self.inputs]

    @property
    def dimensions(self) -> int:
        """Number of columns that are not constant."""
        return int(self.free.sum())

    def scaled(self, columns: Floats) -> Floats:
        """Return the free columns with their ranges mapped to [0, 1]."""
        low = self.low[self.free]
        high = self.high[self.free]
        return (columns[:, self.free] - low) / (high - low)

    def at(self, unit: Floats) -> Floats:
        """Return rows for points of the unit cube, shape (n, dimensions)."""
        columns = np.tile(self.low, (len(unit), 1))
        columns[:, self.free] += unit * (self.high - self.low)[self.free]
        return columns

    def like(self, rows: Floats, unit: Floats) -> Floats:
        """Map points of the unit cube so that each coordinate has the distribution of the rows."""
        scaled = self.scaled(rows)
        return np.stack([np.quantile(x, u) for x, u in zip(scaled.T, unit.T, strict=True)], axis=1)

    def outside(self, columns: Floats) -> Bools:
        """Return which numbers are outside of their range, NaN included, shape (n, columns)."""
        # The slack, far above rounding, is for bounds that the user has computed in another way.
        slack = 1e-9 * (self.high - self.low)
        # Comparisons with NaN are false, so that NaN is outside.
        inside = (columns >= self.low - slack) & (columns <= self.high + slack)
        return ~inside

    def complaint(self, columns: Floats, is_outside: Bools) -> str:
        """Return a sentence about the inputs of rows that are `outside`."""
        inputs = []
        for r, place in self._places():
            wrong = columns[:, place][is_outside[:, place]]
            if wrong.size:
                inputs.append(
                    f"{r.name} from {wrong.min():.6g} to {wrong.max():.6g}, expected "
                    f"{np.min(r.low):.6g} to {np.max(r.high):.6g}"
                )
        n_outside = is_outside.any(axis=1).sum()
        return f"got {n_outside} of {len(columns)} points outside its design: {'; '.join(inputs)}"

    def arguments(self, columns: Floats) -> list[Any]:
        """Return the response's arguments for rows: arrays (n, *event), and numbers."""
        return [
            float(r.low) if r.constant else columns[:, place].reshape(-1, *r.event)
            for r, place in self._places()
        ]

    def columns(self, values: Sequence[ArrayLike]) -> tuple[Floats, Shape]:
        """Return inputs, (..., *event) each, as rows, and their leading shape; or raise."""
        if len(values) != len(self.inputs):
            raise TypeError(
                f"surrogate: got {len(values)} inputs, expected {len(self.inputs)}: "
                f"{', '.join(self.names)}"
            )
        arrays = [real_array(x, r.name) for r, x in zip(self.inputs, values, strict=True)]
        leading = []
        for r, array in zip(self.inputs, arrays, strict=True):
            if r.event and array.shape[-len(r.event) :] != r.event:
                event = ", ".join(map(str, r.event))
                raise ValueError(f"{r.name}: got shape {array.shape}, expected (..., {event})")
            leading.append(array.shape[: array.ndim - len(r.event)])
        batch = np.broadcast_shapes(*leading)
        rows = [
            np.broadcast_to(array, batch + r.event).reshape(-1, r.size)
            for r, array in zip(self.inputs, arrays, strict=True)
        ]
        return np.concatenate(rows, axis=1), batch

    def _places(self) -> Iterator[tuple[Range, slice]]:
        """Yield the range of each input with the input's columns."""
        start = 0
        for r in self.inputs:
            yield r, slice(start, start + r.size)
            start += r.size


def read_ranges(
    name: str, inputs: Any, coverage: float, random_seed: int
) -> tuple[Ranges, Floats | None]:
    """Return the ranges of inputs, and rows (n, columns) of the prior predictive inside them.

    An input is (low, high), a ``.dist()``, a variable of the model, or a number. ``coverage`` is
    the share of its prior predictive distribution that the range of a random input covers. The rows
    are None where no input is random; inputs with a range are uniform.
    """
    is_collection = isinstance(inputs, Mapping | Sequence) and not isinstance(inputs, str)
    if not is_collection or not len(inputs):
        raise TypeError(
            f"{name}: inputs: got {inputs!r:.60}, expected a dict such as {{'k': (200, 300)}}, "
            "or a list"
        )
    if isinstance(inputs, Mapping) and not all(isinstance(key, str) for key in inputs):
        raise TypeError(f"{name}: inputs: got {list(inputs)} as names, expected texts")
    entries = dict(inputs if isinstance(inputs, Mapping) else enumerate(inputs, 1))
    random = {key: x for key, x in entries.items() if isinstance(x, Variable)}
    draws = {}
    if random:
        samples = predictive_inputs(name, list(random.values()), random_seed)
        draws = dict(zip(random, samples, strict=True))
    ranges = Ranges(
        tuple(_range_of(name, k, x, draws.get(k), coverage) for k, x in entries.items())
    )
    if not ranges.dimensions:
        raise ValueError(
            f"{name}: inputs: got constants only, expected at least one range or distribution"
        )
    if not draws:
        return ranges, None
    # Inputs that are given by a range have a uniform distribution.
    unit = sobol(POPULATIONS * SPECIMENS, ranges.dimensions, random_seed)
    values = ranges.arguments(ranges.at(unit))
    for i, (key, r) in enumerate(zip(entries, ranges.inputs, strict=True)):
        if key in draws:
            values[i] = draws[key].reshape(-1, *r.event)
    rows, _ = ranges.columns(values)
    return ranges, rows[~ranges.outside(rows).any(axis=1)]


def _range_of(
    name: str, key: str | int, entry: Any, draws: Floats | None, coverage: float
) -> Range:
    """Return the range of an input: as given, of the central share of draws, or a constant."""
    label = key if isinstance(key, str) else str(getattr(entry, "name", None) or f"input {key}")
    if draws is not None:  # (populations, specimens, *event)
        tail = (1 - coverage) / 2
        low, high = np.quantile(draws, [tail, 1 - tail], axis=(0, 1))
        is_constant = False
    else:
        # NumPy would convert a list of numbers and booleans to numbers without an error.
        if isinstance(entry, list | tuple) and any(isinstance(x, bool) for x in entry):
            entry = np.asarray(entry, dtype=object)
        array = real_array(entry, f"{name}: inputs: {label}")
        is_constant = array.shape == ()
        if not is_constant and array.shape != (2,):
            raise ValueError(
                f"{name}: inputs: {label}: got shape {array.shape}, expected a range (low, high), "
                "a `.dist()`, a variable of the model or a number"
            )
        low, high = (array, array) if is_constant else (array[0, ...], array[1, ...])
    low, high = np.asarray(low), np.asarray(high)
    is_proper = np.isfinite(low) & np.isfinite(high) & ((low < high) | is_constant)
    if not is_proper.all():
        raise ValueError(
            f"{name}: inputs: {label}: got {low} to {high}, expected a range (low, high) with low "
            "< high"
        )
    return Range(label, low, high, is_constant)


def predictive_inputs(name: str, variables: list[Any], random_seed: int) -> list[Floats]:
    """Return prior predictive draws of variables, shapes (populations, specimens, *event).

    Raises ValueError if the parameters of the inputs are invalid at all draws of the priors.
    """
    model = model_on_context(None, f"{name}: inputs that are distributions")
    inputs = read_inputs(name, variables, model)
    parents = PriorSampler(inputs.parents)(POPULATIONS, random_seed)
    symbols = inputs.placeholders()
    (is_valid,) = compile_batched(symbols, [valid(inputs, inputs.rebuilt(symbols)[0])])(*parents)
    usable = np.flatnonzero(np.broadcast_to(is_valid, POPULATIONS))
    if not usable.size:
        raise ValueError(
            f"{name}: got invalid parameters of the inputs at all draws of the priors, "
            "expected valid ones"
        )
    # Valid draws are used twice where others have invalid parameters, such as a negative standard
    # deviation.
    places = usable[np.arange(POPULATIONS) % usable.size]
    valid_values = [values[places] for values in parents]
    rng = np.random.default_rng(random_seed)
    aleatory, epistemic = PopulationSampler(inputs)(valid_values, SPECIMENS, rng)
    # An epistemic value is the same for all specimens of a population, and is repeated for them.
    return [
        np.broadcast_to(values, (POPULATIONS, SPECIMENS, *values.shape[2:])).astype(np.float64)
        for values in inputs.fill(aleatory, epistemic)
    ]
