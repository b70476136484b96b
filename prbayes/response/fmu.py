"""A Functional Mock-up Unit (FMU): a model of another tool, run in this process for each specimen.

What is told here to FMPy is the FMI standard (https://fmi-standard.org) for co-simulation, versions
2 and 3: a unit is unzipped and loaded once in a process, and its instances are used again.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from prbayes._validate import Floats, called, file_path, flag, positive_number, real_array
from prbayes.response.call import scalar
from prbayes.response.fmi import (
    Unit,
    Value,
    Variable,
    Variables,
    last_words,
    listed,
    opened,
    read_unit,
)
from prbayes.response.outputs import Outputs

# Steps from start to stop where neither the user nor the unit says how many: those of FMPy. The
# error of a unit that takes an internal step for each is its own; `step=` sets others.
_STEPS_IN_ALL = 500
# Relative to a step: how far a time may be from a whole number of steps, for rounding; any value
# from 1e-9 to 1e-3 does that.
_OFF_GRID = 1e-6


def fmu(
    path: str | PathLike[str],
    *,
    inputs: Sequence[str],
    outputs: Sequence[str] | Mapping[str, str],
    parameters: Mapping[str, Value] | None = None,
    times: ArrayLike | None = None,
    start_time: float | None = None,
    stop_time: float | None = None,
    step: float | None = None,
    timeout: float | None = None,
    reset: bool = True,
) -> scalar:
    """Turn a Functional Mock-up Unit into a response, of one output or several, or of curves.

    It is simulated once for each specimen, from start to stop. The unit is read, unzipped and
    instantiated at once; a `Simulator` compares its inputs and outputs with its own before anything
    is computed.

    Parameters
    ----------
    path : str or path
        The unit: an ``.fmu`` for co-simulation, FMI 2 or 3.
    inputs : sequence of str
        The unit's variables, parameters or inputs, that are the simulator's inputs, in their order.
    outputs : sequence of str, or mapping of str to str
        The unit's variables that are the outputs; with a mapping, by the names that they have in
        what was observed.
    parameters : mapping, optional
        Values of other variables of the unit, the same for all specimens: numbers, flags, texts.
    times : array_like, shape (T,), optional
        Times, increasing, at which each output is read: curves. By default outputs are read at the
        end.
    start_time, stop_time : float, optional
        In the unit's own; by default those that the unit states. With ``times`` the last of them is
        the end.
    step : float, optional
        Longest step between two points of communication. By default that which the unit states, or
        a 500th of the whole.
    timeout : float, optional
        Seconds that one response may take. It is looked at between steps; what hangs within one
        ends by the propagation's ``timeout=``, with processes.
    reset : bool
        Whether an instance of the unit is used for one specimen after the other. Pass False for
        units that ``fmi2Reset`` does not bring back to their start: each specimen has a new one.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, the file is no unit that can be simulated here, or it
        has no such variables.
    FileNotFoundError
        If there is no such file.
    ImportError
        If FMPy is not installed.

    Notes
    -----
    One output is a number, (T,) of them with ``times``. Several come as a mapping by their names,
    and what was observed has the same names, so that none is taken for another: a DataFrame, or a
    mapping of arrays (N,), with ``times`` (N, T).

    A response fails where the unit says so, stops before its end, or takes too long; the error
    repeats what it logged. Units compute outside Python as a rule, so that threads serve as an
    executor; each that is at work at the same time has an instance of its own, but for units that
    may be instantiated only once. A unit runs in this process, and may end it: with processes as
    an executor that costs a specimen. The response can be pickled; the file has to be where it was.

    Examples
    --------
    >>> fmu(
    ...     "spring.fmu",
    ...     inputs=["stiffness", "damping"],
    ...     outputs={"deflection_mm": "mass.s", "force_n": "spring.f"},
    ...     parameters={"mass.m": 2.0},
    ...     stop_time=5.0,
    ... )
    Traceback (most recent call last):
    FileNotFoundError: fmu: path: got spring.fmu, which is not there, expected an FMU
    """
    where = file_path(path, "fmu: path")
    if not where.is_file():
        raise FileNotFoundError(f"fmu: path: got {where}, which is not there, expected an FMU")
    chosen = _Chosen(_names(inputs), _labelled(outputs), _parameters(parameters))
    limit = None if timeout is None else positive_number(timeout, "fmu: timeout")
    again = flag(reset, "fmu: reset")
    unit, description = read_unit(where)
    grid = _grid(description, times, start_time, stop_time, step)
    variables = Variables(unit, {v.name: v for v in description.modelVariables})
    found = MockUp(
        unit,
        tuple(variables.settable(name, "inputs") for name in chosen.inputs),
        {label: variables.readable(name) for label, name in chosen.outputs.items()},
        tuple((variables.settable(n, "parameters"), v) for n, v in chosen.parameters.items()),
        grid,
        limit,
        again,
    )
    found.refuse_unfit_parameters()
    with opened(unit).instance(again):
        pass
    return scalar(found)


# -- what is asked for -----------------------------------------------------------------------------


@dataclass(frozen=True)
class _Chosen:
    """Variables by name, as the user chose them."""

    inputs: tuple[str, ...]
    outputs: dict[str, str]  # by their names in what was observed
    parameters: dict[str, Value]

    def __post_init__(self) -> None:
        twice = set(self.inputs) & set(self.parameters)
        if twice:
            raise ValueError(
                f"fmu: parameters: got {min(twice)!r}, which is among the inputs too, expected "
                "each variable once"
            )


def _names(inputs: object) -> tuple[str, ...]:
    texts = not isinstance(inputs, str) and isinstance(inputs, Sequence)
    if not isinstance(inputs, Sequence) or not texts or not _are_names(inputs):
        raise TypeError(
            f"fmu: inputs: got {called(inputs)}, expected a list of the unit's variables, each "
            'once, such as ["stiffness", "damping"]'
        )
    return tuple(inputs)


def _labelled(outputs: object) -> dict[str, str]:
    """Return variables by the names of the outputs."""
    if isinstance(outputs, Mapping):
        labels = list(outputs)
        names = list(outputs.values())
    elif isinstance(outputs, Sequence) and not isinstance(outputs, str):
        labels = list(outputs)
        names = list(outputs)
    else:
        labels, names = [], []
    if not labels or not _are_names(labels) or not all(isinstance(name, str) for name in names):
        raise TypeError(
            f"fmu: outputs: got {called(outputs)}, expected a list of the unit's variables, each "
            'once, such as ["mass.s"], or a mapping of names to these'
        )
    return dict(zip(labels, names, strict=True))


def _are_names(names: Sequence[object]) -> bool:
    return bool(names) and all(isinstance(n, str) and names.count(n) == 1 for n in names)


def _parameters(parameters: object) -> dict[str, Value]:
    if parameters is None:
        return {}
    if not isinstance(parameters, Mapping) or not all(isinstance(name, str) for name in parameters):
        raise TypeError(
            f"fmu: parameters: got {called(parameters)}, expected a mapping of the unit's "
            'variables to their values, such as {"mass.m": 2.0}'
        )
    plain = {name: v.item() if isinstance(v, np.generic) else v for name, v in parameters.items()}
    for name, value in plain.items():
        if not isinstance(value, bool | int | float | str):
            raise TypeError(
                f"fmu: parameters: got {called(value)} for {name!r}, expected a number, a flag or "
                "a text"
            )
    return plain


@dataclass(frozen=True)
class _Grid:
    """The points of communication of a simulation."""

    start: float
    marks: tuple[float, ...]  # where outputs are read; the last is the end
    curves: bool  # whether the times were asked for
    step: float  # at most
    even: bool  # whether all steps have to be of this size
    tolerance: float | None  # that the unit states

    def steps(self) -> Iterator[tuple[float, float, bool]]:
        """Yield where each step begins, its size, and whether outputs are read behind it."""
        first, done = self.start, 0
        for mark in self.marks:
            n = max(1, math.ceil((mark - first) / self.step - _OFF_GRID))
            for i in range(n):
                last = i == n - 1
                if self.even:
                    yield self.start + done * self.step, self.step, last
                else:
                    size = (mark - first) / n
                    yield first + i * size, size, last
                done += 1
            first = mark


def _grid(description: Any, times: Any, start: Any, stop: Any, step: Any) -> _Grid:
    """Return the points of communication that a unit and the user state.

    Raises
    ------
    TypeError, ValueError
        If there are none, or the unit cannot take such steps.
    """
    stated = description.defaultExperiment
    kind = description.coSimulation

    def known(given: Any, name: str, key: str) -> float | None:
        if given is not None:
            return float(_number(given, name))
        value = getattr(stated, key, None)
        return None if value is None else float(value)

    begin = known(start, "start_time", "startTime") or 0.0
    marks = _marks(times, begin, known(stop, "stop_time", "stopTime"), stop is not None)
    duration = marks[-1] - begin
    size = getattr(stated, "stepSize", None) if step is None else positive_number(step, "fmu: step")
    inner = getattr(kind, "fixedInternalStepSize", None)
    even = not kind.canHandleVariableCommunicationStepSize
    if size is None and inner is not None:
        size = float(inner) * max(1, round(duration / _STEPS_IN_ALL / float(inner)))
    if size is None and even:
        raise ValueError(
            f"fmu: step: got none, and {description.modelName} takes steps of one size only and "
            "does not say which, expected a number"
        )
    size = duration / _STEPS_IN_ALL if size is None else float(size)
    if even:
        _refuse_uneven(description.modelName, begin, marks, size)
    tolerance = getattr(stated, "tolerance", None)
    told = None if tolerance is None else float(tolerance)
    return _Grid(begin, marks, times is not None, size, even, told)


def _number(value: object, name: str) -> float:
    array = real_array(value, f"fmu: {name}")  # type: ignore[arg-type]
    if array.ndim or not np.isfinite(array):
        raise ValueError(f"fmu: {name}: got {value!r:.60}, expected a finite number")
    return float(array)


def _marks(times: Any, begin: float, end: float | None, asked: bool) -> tuple[float, ...]:
    """Return the times at which outputs are read."""
    if times is None:
        if end is None or end <= begin:
            got = "none, and the unit states none" if end is None else f"{end:g}"
            raise ValueError(
                f"fmu: stop_time: got {got}, expected a time after start_time = {begin:g}"
            )
        return (end,)
    marks = real_array(times, "fmu: times")
    rising = marks.ndim == 1 and marks.size > 0 and np.isfinite(marks).all()
    if not rising or marks[0] <= begin or (np.diff(marks) <= 0).any():
        raise ValueError(
            f"fmu: times: got {times!r:.60}, expected increasing times after start_time = "
            f"{begin:g}, (T,)"
        )
    if asked and end is not None and marks[-1] > end:
        raise ValueError(
            f"fmu: times: got {marks[-1]:g} as the last, expected none after stop_time = {end:g}; "
            "leave stop_time out"
        )
    return tuple(marks.tolist())


def _refuse_uneven(name: str, begin: float, marks: tuple[float, ...], step: float) -> None:
    """Raise if a time is not reached by steps of one size."""
    for mark in marks:
        count = (mark - begin) / step
        if abs(count - round(count)) > _OFF_GRID or round(count) < 1:
            raise ValueError(
                f"fmu: got the time {mark:g}, which steps of {step:g} from {begin:g} do not reach, "
                f"expected multiples of the step, as {name} takes steps of one size only; pass "
                "other times, or step="
            )


# -- at work ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MockUp:
    """A unit as a function of one specimen's inputs."""

    unit: Unit
    inputs: tuple[Variable, ...]
    outputs: dict[str, Variable]  # by their names
    parameters: tuple[tuple[Variable, Value], ...]
    grid: _Grid
    timeout: float | None
    reset: bool

    @property
    def __name__(self) -> str:
        """The name of the unit."""
        return self.unit.name

    def __call__(self, *values: float) -> float | Floats | dict[str, Any]:
        """Simulate one specimen: a number, a curve, or a mapping of these.

        Raises
        ------
        RuntimeError
            If the unit says that something went wrong, or ends too early.
        TimeoutError
            If it takes too long.
        ValueError
            If there are more or fewer inputs than variables, or they are of another kind.
        """
        if len(values) != len(self.inputs):
            self._refuse_inputs(self.unit.name, [1] * len(values))
        pairs = [*self.parameters, *zip(self.inputs, map(float, values), strict=True)]
        given = [(variable, self._typed(variable, value)) for variable, value in pairs]
        with opened(self.unit).instance(self.reset) as slave:
            rows = self._simulated(slave, given)
        columns = np.array(rows).T
        found = dict(zip(self.outputs, columns if self.grid.curves else columns[:, 0], strict=True))
        if len(found) > 1:
            return found
        (lone,) = found.values()
        return lone if self.grid.curves else float(lone)

    def _typed(self, variable: Variable, value: Value) -> Value:
        try:
            return variable.typed(value)
        except ValueError as error:
            raise ValueError(f"{self.unit.name}: {error}") from None

    def _simulated(self, slave: Any, given: list[tuple[Variable, Value]]) -> list[list[float]]:
        """Return the outputs at each time."""
        clock = time.monotonic()
        grid = self.grid
        stop = self.grid.marks[-1]
        stated = {"tolerance": grid.tolerance, "startTime": grid.start, "stopTime": stop}
        if self.unit.version == 2:
            slave.setupExperiment(**stated)
        for variable, value in given:
            getattr(slave, f"set{variable.kind}")([variable.reference], [value])
        slave.enterInitializationMode(**({} if self.unit.version == 2 else stated))
        slave.exitInitializationMode()
        rows = []
        for begin, size, last in grid.steps():
            if self.timeout is not None and time.monotonic() - clock > self.timeout:
                raise TimeoutError(
                    f"{self.unit.name}: no result within timeout = {self.timeout:g} s, at time "
                    f"{begin:g} of {stop:g}{last_words()}"
                )
            told = slave.doStep(currentCommunicationPoint=begin, communicationStepSize=size)
            # In FMI 3: an event, the end, an early return, and the time that was reached.
            if told is not None and (told[1] or told[2]):
                raise RuntimeError(
                    f"{self.unit.name}: it ended at time {told[3]:g}, expected {stop:g}"
                    f"{last_words()}"
                )
            if last:
                rows.append([self._value(slave, v) for v in self.outputs.values()])
        slave.terminate()
        return rows

    def _value(self, slave: Any, variable: Variable) -> float:
        (value,) = getattr(slave, f"get{variable.kind}")([variable.reference])
        return float(value)

    def refuse_unfit_parameters(self) -> None:
        """Raise if a parameter has a value of another kind."""
        for variable, value in self.parameters:
            try:
                variable.typed(value)
            except ValueError as error:
                raise ValueError(f"fmu: parameters: {error}") from None

    def refuse_misfit(self, name: str, sizes: Sequence[int], outputs: Outputs | None) -> None:
        """Raise if a simulator has other inputs or outputs than the unit."""
        self._refuse_inputs(name, sizes)
        if outputs is None:
            return
        size = len(self.grid.marks) if self.grid.curves else None
        if len(self.outputs) == 1:
            event = () if size is None else (size,)
            if outputs.event != event:
                shape = "(N,)" if size is None else f"(N, {size}), a column for each time"
                got = ", ".join(["N", *map(str, outputs.event)])
                raise ValueError(
                    f"{name}: observed: got shape ({got}), expected {shape}, for "
                    f"{next(iter(self.outputs))!r} of {self.unit.name}"
                )
        elif set(outputs.keys) != {(label, size) for label in self.outputs}:
            each = "(N,)" if size is None else f"(N, {size})"
            named = [key if n is None else f"{key} (N, {n})" for key, n in outputs.keys]
            raise ValueError(
                f"{name}: observed: got {', '.join(named) or 'outputs without names'}, expected a "
                f"mapping of names to arrays {each}{'' if size else ', or a DataFrame'}, with "
                f"{listed(list(self.outputs))}: the outputs of {self.unit.name}"
            )

    def _refuse_inputs(self, name: str, sizes: Sequence[int]) -> None:
        if list(sizes) != [1] * len(self.inputs):
            raise ValueError(
                f"{name}: got inputs of {', '.join(map(str, sizes))} numbers, expected "
                f"{len(self.inputs)} of one each: {', '.join(v.name for v in self.inputs)}, for "
                f"{self.unit.name}"
            )
