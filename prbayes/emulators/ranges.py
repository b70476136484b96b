"""Where a surrogate holds: a range for each input of a response."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pytensor.graph.basic import Variable

from prbayes._validate import Floats, real_array
from prbayes.emulators.prior_predictive import POPULATIONS, SPECIMENS, predictive_inputs
from prbayes.numerics.points import sobol


@dataclass(frozen=True, eq=False)
class Range:
    """The range of one input."""

    name: str
    # (*event): lowest and highest value, in the input's own units.
    low: Floats
    high: Floats
    constant: bool = False  # whether it is one value only

    @property
    def proper(self) -> bool:
        """Whether it is finite, and not empty unless it is to be constant."""
        finite = np.isfinite(self.low) & np.isfinite(self.high)
        wide = self.low < self.high
        return bool((finite & (wide | self.constant)).all())

    @property
    def size(self) -> int:
        """Of how many numbers the input is made."""
        return self.low.size

    @property
    def event(self) -> tuple[int, ...]:
        """The shape of one value."""
        return self.low.shape


@dataclass(frozen=True, eq=False)
class Ranges:
    """The ranges of all inputs; specimens are rows with one column for each number."""

    inputs: tuple[Range, ...]

    @cached_property
    def low(self) -> Floats:
        """Lowest values, shape (columns,)."""
        return np.concatenate([one.low.ravel() for one in self.inputs])

    @cached_property
    def high(self) -> Floats:
        """Highest values, shape (columns,)."""
        return np.concatenate([one.high.ravel() for one in self.inputs])

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """Which columns are not constant."""
        return np.repeat(
            [not one.constant for one in self.inputs],
            [one.size for one in self.inputs],
        )

    @property
    def varying(self) -> list[bool]:
        """Which inputs are not constant."""
        return [not one.constant for one in self.inputs]

    @property
    def dimensions(self) -> int:
        """Number of columns that are not constant."""
        return int(self.free.sum())

    def scaled(self, columns: Floats) -> Floats:
        """Return the free columns with their ranges mapped to [0, 1]."""
        low = self.low[self.free]
        high = self.high[self.free]
        return np.asarray((columns[:, self.free] - low) / (high - low))

    def at(self, unit: Floats) -> Floats:
        """Return rows for points of the unit cube, shape (n, dimensions)."""
        columns = np.tile(self.low, (len(unit), 1))
        columns[:, self.free] += unit * (self.high - self.low)[self.free]
        return columns

    def like(self, rows: Floats, unit: Floats) -> Floats:
        """Return points of the unit cube whose coordinates are distributed as those of rows are."""
        known = self.scaled(rows)
        each = [np.quantile(own, u) for own, u in zip(known.T, unit.T, strict=True)]
        return np.stack(each, axis=1)

    def outside(self, columns: Floats) -> NDArray[np.bool_]:
        """Return which numbers are outside of their range, NaN included, shape (n, columns)."""
        # For a bound that was computed in another way: far above rounding, and far below any
        # distance at which a surface would go astray.
        slack = 1e-9 * (self.high - self.low)
        above_low = columns >= self.low - slack
        below_high = columns <= self.high + slack
        # Comparisons with NaN are false.
        return np.asarray(~(above_low & below_high))

    def complaint(self, columns: Floats, out: NDArray[np.bool_]) -> str:
        """Say which inputs of rows are outside, given what `outside` returned."""
        said = []
        for one, where in self._by_input():
            wrong = columns[:, where][out[:, where]]
            if not wrong.size:
                continue
            got = f"{wrong.min():.6g} to {wrong.max():.6g}"
            lowest = np.min(one.low)
            highest = np.max(one.high)
            expected = f"{lowest:.6g} to {highest:.6g}"
            said.append(f"{one.name} from {got}, expected {expected}")
        bad = out.any(axis=1).sum()
        return f"got {bad} of {len(columns)} points outside its design: {'; '.join(said)}"

    def arguments(self, columns: Floats) -> list[Any]:
        """Return the response's arguments for rows: arrays (n, *event), and numbers."""
        found: list[Any] = []
        for one, where in self._by_input():
            if one.constant:
                found.append(float(one.low))
            else:
                found.append(columns[:, where].reshape(-1, *one.event))
        return found

    def columns(self, values: Sequence[ArrayLike]) -> tuple[Floats, tuple[int, ...]]:
        """Return inputs as rows, and their leading shape.

        Parameters
        ----------
        values : sequence of array_like, shapes (..., *event)
            One per input; leading shapes broadcast.

        Raises
        ------
        TypeError, ValueError
            If there are too few or many inputs, or one has the wrong shape.
        """
        if len(values) != len(self.inputs):
            names = ", ".join(one.name for one in self.inputs)
            raise TypeError(
                f"surrogate: got {len(values)} inputs, expected {len(self.inputs)}: {names}"
            )
        arrays = []
        leading = []
        for one, value in zip(self.inputs, values, strict=True):
            array = real_array(value, one.name)
            arrays.append(array)
            leading.append(_leading_shape(one, array))
        batch = np.broadcast_shapes(*leading)
        rows = []
        for one, array in zip(self.inputs, arrays, strict=True):
            full = np.broadcast_to(array, batch + one.event)
            rows.append(full.reshape(-1, one.size))
        return np.concatenate(rows, axis=1), batch

    def _by_input(self) -> Iterator[tuple[Range, slice]]:
        """Yield inputs with their columns."""
        start = 0
        for one in self.inputs:
            yield one, slice(start, start + one.size)
            start += one.size


def _leading_shape(one: Range, array: Floats) -> tuple[int, ...]:
    """Return the shape of an input without its event axes."""
    axes = len(one.event)
    if axes and array.shape[-axes:] != one.event:
        event = ", ".join(map(str, one.event))
        raise ValueError(f"{one.name}: got shape {array.shape}, expected (..., {event})")
    return array.shape[: array.ndim - axes]


def read_ranges(
    name: str, inputs: Any, coverage: float, random_seed: int
) -> tuple[Ranges, Floats | None]:
    """Return the ranges of inputs, and rows of the prior predictive distribution inside them.

    Parameters
    ----------
    name : str
        For messages.
    inputs : mapping or sequence
        One entry per input: (low, high), a ``.dist()``, a variable of the model, or a number.
    coverage : float
        Share of its prior predictive distribution that the range of a random input covers.
    random_seed : int

    Returns
    -------
    ranges : Ranges
    rows : ndarray, shape (n, columns), or None
        None where no input is random; inputs with a range are uniform.

    Raises
    ------
    TypeError, ValueError
        If an input is no range, distribution or number, a range is empty, or all are constants.
    """
    is_list = isinstance(inputs, Mapping | Sequence) and not isinstance(inputs, str)
    if not is_list or not len(inputs):
        raise TypeError(
            f"{name}: inputs: got {inputs!r:.60}, expected a dict such as {{'k': (200, 300)}}, "
            "or a list"
        )
    if isinstance(inputs, Mapping) and not all(isinstance(key, str) for key in inputs):
        raise TypeError(f"{name}: inputs: got {list(inputs)} as names, expected texts")
    named = dict(inputs) if isinstance(inputs, Mapping) else dict(enumerate(inputs, 1))
    drawn = _drawn(name, named, random_seed)
    ranges = _ranges(name, named, drawn, coverage)
    if not drawn:
        return ranges, None
    rows = _predictive_rows(ranges, list(named), drawn, random_seed)
    inside = ~ranges.outside(rows).any(axis=1)
    return ranges, rows[inside]


def _drawn(name: str, named: dict[Any, Any], random_seed: int) -> dict[Any, Floats]:
    """Return prior predictive draws of the inputs that are random."""
    random = {key: x for key, x in named.items() if isinstance(x, Variable)}
    if not random:
        return {}
    draws = predictive_inputs(name, list(random.values()), random_seed)
    return dict(zip(random, draws, strict=True))


def _ranges(name: str, named: dict[Any, Any], drawn: dict[Any, Floats], coverage: float) -> Ranges:
    """Return the ranges, given or from draws, each checked."""
    found = []
    for key, x in named.items():
        label = _label(key, x)
        draws = drawn.get(key)
        one = _given(name, label, x) if draws is None else _covering(label, draws, coverage)
        if not one.proper:
            raise ValueError(
                f"{name}: inputs: {label}: got {one.low} to {one.high}, expected a range (low, "
                "high) with low < high"
            )
        found.append(one)
    ranges = Ranges(tuple(found))
    if not ranges.dimensions:
        raise ValueError(
            f"{name}: inputs: got constants only, expected at least one range or distribution"
        )
    return ranges


def _label(key: str | int, x: Any) -> str:
    """Return what messages call an input."""
    if isinstance(key, str):
        return key
    return str(getattr(x, "name", None) or f"input {key}")


def _given(name: str, label: str, x: Any) -> Range:
    """Return the range that was given, or a constant."""
    # A list of a number and True is one of numbers to NumPy.
    if isinstance(x, list | tuple) and any(isinstance(one, bool) for one in x):
        x = np.asarray(x, dtype=object)
    array = real_array(x, f"{name}: inputs: {label}")
    if array.shape == ():
        return Range(label, array, array, constant=True)
    if array.shape != (2,):
        raise ValueError(
            f"{name}: inputs: {label}: got shape {array.shape}, expected a range (low, high), a "
            "`.dist()`, a variable of the model or a number"
        )
    return Range(label, array[0, ...], array[1, ...])


def _covering(label: str, draws: Floats, coverage: float) -> Range:
    """Return the range that covers the central share of draws, (populations, specimens, *event)."""
    tail = (1 - coverage) / 2
    low, high = np.quantile(draws, [tail, 1 - tail], axis=(0, 1))
    return Range(label, np.asarray(low), np.asarray(high))


def _predictive_rows(
    ranges: Ranges, keys: list[Any], drawn: dict[Any, Floats], random_seed: int
) -> Floats:
    """Return rows of the prior predictive distribution; inputs with a range are uniform."""
    unit = sobol(POPULATIONS * SPECIMENS, ranges.dimensions, random_seed)
    uniform = ranges.arguments(ranges.at(unit))
    values: list[Any] = []
    for key, one, otherwise in zip(keys, ranges.inputs, uniform, strict=True):
        if key in drawn:
            values.append(drawn[key].reshape(-1, *one.event))
        else:
            values.append(otherwise)
    rows, _ = ranges.columns(values)
    return rows
