"""Functional Mock-up Units (FMU) as responses: co-simulation of another tool's model.

The FMI standard (https://fmi-standard.org), versions 2 and 3. A unit is unzipped and loaded once in
a process, and its instances are reused. FMPy calls the library; its driver `simulate_fmu` does not
serve here, as it repeats a discarded step without end, and has no points of communication between
equal steps, where curves are read.
"""

from __future__ import annotations

import hashlib
import math
import os
import shutil
import tempfile
import threading
import time
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike

from prbayes._validate import (
    Floats,
    Labels,
    StrPath,
    called,
    file_path,
    finite_number,
    flag,
    positive_number,
    real_array,
    wrong_value,
)
from prbayes.response.call import scalar
from prbayes.response.outputs import Outputs

type Value = float | int | bool | str


def fmu(
    path: StrPath,
    *,
    inputs: Sequence[str],
    outputs: Sequence[str] | Labels,
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
        Variables of the unit, parameters or inputs, for the simulator's inputs, in their order.
    outputs : sequence of str, or mapping of str to str
        Variables of the unit that are the outputs; a mapping has them by the names in ``observed``.
    parameters : mapping, optional
        Values of other variables of the unit, the same for all specimens: numbers, flags, texts.
    times : array_like, shape (T,), optional
        Times, increasing, at which each output is read: curves. By default outputs are read at the
        end.
    start_time, stop_time : float, optional
        In the time unit of the FMU; by default those that it states. With ``times`` the last one is
        the end.
    step : float, optional
        Longest step between two points of communication. By default the one that the unit states,
        or a 500th of the duration.
    timeout : float, optional
        Seconds for one response, checked between steps. A step that hangs is ended by the
        propagation's ``timeout=``, with processes.
    reset : bool
        Whether an instance of the unit is reused for the next specimen. Pass False for units that
        ``fmi2Reset`` does not return to their start: each specimen has a new instance.

    Returns
    -------
    callable
        The response, to be passed to `Simulator`, `Surrogate.fit` or `predict`.

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
    One output is a number, or (T,) numbers with ``times``. Several are a mapping by their names,
    which have to be those of ``observed``: a DataFrame, or a mapping of arrays (N,), with ``times``
    (N, T).

    A response fails if the unit reports a failure, stops before its end, or takes too long; the
    error repeats the unit's log. Most units compute outside Python, so threads serve as an
    executor. Each thread has its own instance, except for units that may be instantiated only once.
    A unit runs in this process and may end it; with processes as an executor that costs a specimen.
    The response can be pickled; the file has to stay where it is.

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
    file = file_path(path, "fmu: path")
    if not file.is_file():
        raise FileNotFoundError(f"fmu: path: got {file}, which is not there, expected an FMU")
    input_names = _names("inputs", inputs)
    output_names = _names("outputs", outputs)
    values = _parameter_values(parameters)
    repeated = set(input_names) & set(values)
    if repeated:
        raise ValueError(
            f"fmu: parameters: got {min(repeated)!r}, which is among the inputs too, expected each "
            "variable once"
        )
    limit = None if timeout is None else positive_number(timeout, "fmu: timeout")
    flag(reset, "fmu: reset")
    unit, description = _read_unit(file)
    grid = _time_grid(description, times, start_time, stop_time, step)
    parameter_values = []
    for name, value in values.items():
        parameter = _variable(description, name, "parameters")
        parameter_values.append((parameter, parameter.converted(value, "fmu: parameters")))
    model = Simulation(
        unit,
        tuple(_variable(description, name, "inputs") for name in input_names),
        {key: _variable(description, name, "outputs") for key, name in output_names.items()},
        tuple(parameter_values),
        grid,
        limit,
        reset,
    )
    with _opened(unit).instance(reset):
        pass  # raises here if the unit cannot be instantiated on this machine
    return scalar(model)


# -- arguments -------------------------------------------------------------------------------------


def _names(argument: str, value: object) -> dict[str, str]:
    """Return variables of the unit by the user's names, which in a list are the same."""
    pairs = []
    expected = 'a list of the unit\'s variables, each once, such as ["stiffness", "damping"]'
    if isinstance(value, Mapping) and argument == "outputs":
        pairs = list(value.items())
        expected += ", or a mapping of names to these"
    elif isinstance(value, Sequence) and not isinstance(value, str):
        pairs = [(name, name) for name in value]
    are_texts = all(isinstance(text, str) for pair in pairs for text in pair)
    if not pairs or not are_texts or len(dict(pairs)) < len(pairs):
        raise wrong_value(value, f"fmu: {argument}", expected)
    return dict(pairs)


def _parameter_values(parameters: object) -> dict[str, Value]:
    if parameters is None:
        return {}
    if not isinstance(parameters, Mapping) or not all(isinstance(name, str) for name in parameters):
        raise wrong_value(
            parameters,
            "fmu: parameters",
            'a mapping of the unit\'s variables to their values, such as {"mass.m": 2.0}',
        )
    values = {name: v.item() if isinstance(v, np.generic) else v for name, v in parameters.items()}
    for name, value in values.items():
        if not isinstance(value, bool | int | float | str):
            raise TypeError(
                f"fmu: parameters: got {called(value)} for {name!r}, expected a number, a flag or "
                "a text"
            )
    return values


# -- the file --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Unit:
    """The file of a unit, and the arguments of its instances."""

    path: str
    digest: str  # SHA-256 of the file
    name: str
    identifier: str
    token: str
    version: int  # version of the FMI standard
    is_single: bool  # whether a process may have only one instance


def _fmpy() -> Any:
    try:
        import fmpy
    except ImportError:
        raise ImportError(
            "fmu: got no package fmpy, expected it for Functional Mock-up Units; run pip install "
            "prbayes[codes]"
        ) from None
    return fmpy


def _file_digest(path: str | Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _read_unit(path: Path) -> tuple[Unit, Any]:
    """Return a unit and its model description, or raise if it cannot be simulated here."""
    fmpy = _fmpy()
    try:
        with zipfile.ZipFile(path) as archive, archive.open("modelDescription.xml") as file:
            version = str(ElementTree.parse(file).getroot().get("fmiVersion"))
        description = None
        if version[:2] in ("2.", "3."):
            description = fmpy.read_model_description(str(path), validate=False)
        platforms = fmpy.supported_platforms(str(path))
    except Exception as error:
        raise ValueError(
            f"fmu: path: got {path}, which cannot be read as an FMU ({type(error).__name__}: "
            f"{error!s:.200}), expected a zip archive with a modelDescription.xml"
        ) from None
    interface = getattr(description, "coSimulation", None)
    if description is None or interface is None:
        lack = "" if description is None else " without co-simulation"
        raise ValueError(
            f"fmu: path: got {path}, of FMI {version}{lack}, expected FMI 2 or 3 for "
            "co-simulation; let the tool that made it export it so"
        )
    if fmpy.platform not in platforms:
        raise ValueError(
            f"fmu: path: got {path}, which runs on {', '.join(platforms) or 'no platform'}, "
            f"expected {fmpy.platform}; let the tool that made it export it for that, or, where it "
            "has c-code, run `fmpy compile`"
        )
    unit = Unit(
        str(path.absolute()),
        _file_digest(path),
        str(description.modelName),
        str(interface.modelIdentifier),
        str(description.guid),
        int(version[0]),
        bool(interface.canBeInstantiatedOnlyOncePerProcess),
    )
    return unit, description


_INTEGERS = ("Integer", *(f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)))
_REALS = ("Real", "Float64", "Float32")


@dataclass(frozen=True)
class Variable:
    """A scalar variable of a unit."""

    name: str
    reference: int
    kind: str  # type, as it occurs in the names of FMI functions

    def converted(self, value: Value, label: str) -> Value:
        """Return a value in the type of the variable, or raise `ValueError`."""
        is_text = isinstance(value, str)
        if self.kind == "String":
            expected = "a text"
            if is_text:
                return value
        elif self.kind == "Boolean":
            expected = "0 or 1"
            if value in (0, 1):
                return bool(value)
        elif self.kind in _REALS:
            expected = "a number"
            if not is_text:
                return float(value)
        else:
            expected = "a whole number"
            if not is_text and float(value).is_integer():
                return int(value)
        raise ValueError(f"{label}: got {value!r} for {self.name}, expected {expected}")


def _variable(description: Any, name: str, argument: str) -> Variable:
    """Return a scalar variable, which must be settable unless it is an output, or raise."""
    unit = description.modelName
    described = {v.name: v for v in description.modelVariables}
    if name not in described:
        close = get_close_matches(name, described, n=3)
        hint = f"did you mean {' or '.join(map(repr, close))}?"
        raise ValueError(
            f"fmu: {argument}: got {name!r}, expected a variable of {unit}; "
            f"{hint if close else 'it has ' + _listed(list(described))}"
        )
    variable = described[name]
    if argument != "outputs" and not _is_settable(variable):
        settable = [n for n, v in described.items() if _is_settable(v)]
        raise ValueError(
            f"fmu: {argument}: got {name!r}, which {unit} computes itself ("
            f"{variable.causality}, {variable.initial or variable.variability}), expected a "
            f"parameter or an input: {_listed(settable)}"
        )
    kind = str(variable.type)
    if kind == "Enumeration":
        kind = "Integer" if description.fmiVersion.startswith("2") else "Int64"
    takes_text = argument == "parameters"
    kinds = (*_REALS, *_INTEGERS, "Boolean", *(("String",) if takes_text else ()))
    if variable.shape or kind not in kinds:
        got = "an array" if variable.shape else f"of type {kind}"
        raise ValueError(
            f"fmu: {argument}: got {name!r}, which is {got} in {unit}, expected a variable with "
            f"{'one value' if takes_text else 'one number'}"
        )
    return Variable(name, int(variable.valueReference), kind)


def _is_settable(variable: Any) -> bool:
    is_input = variable.causality in ("input", "parameter")
    has_start = variable.initial in ("exact", "approx")
    return variable.variability != "constant" and (is_input or has_start)


def _listed(names: Sequence[str]) -> str:
    """Return the first ten names as a text."""
    rest = f" and {len(names) - 10} more" if len(names) > 10 else ""
    return ", ".join(map(repr, names[:10])) + rest if names else "none"


# -- points of communication -----------------------------------------------------------------------


@dataclass(frozen=True)
class _TimeGrid:
    """The points of communication of a simulation."""

    start: float
    times: tuple[float, ...]  # times at which outputs are read; the last one is the end
    has_curves: bool  # whether the user stated the times
    step: float  # largest size of a step
    is_even: bool  # whether all steps have this size
    tolerance: float | None  # tolerance that the unit states

    def steps(self) -> Iterator[tuple[float, float, bool]]:
        """Yield the begin and size of each step, and whether outputs are read after it."""
        begin = self.start
        for end in self.times:
            n = max(1, math.ceil((end - begin) / self.step - 1e-6))
            size = self.step if self.is_even else (end - begin) / n
            for i in range(n):
                yield begin + i * size, size, i == n - 1
            begin = end


def _time_grid(description: Any, times: Any, start: Any, stop: Any, step: Any) -> _TimeGrid:
    """Return the points of communication, from the user's arguments and the unit's defaults."""
    interface = description.coSimulation

    def default(key: str) -> float | None:
        value = getattr(description.defaultExperiment, key, None)
        return None if value is None else float(value)

    begin = default("startTime") if start is None else finite_number(start, "fmu: start_time")
    begin = begin or 0.0
    end = default("stopTime") if stop is None else finite_number(stop, "fmu: stop_time")
    if times is not None:
        marks = real_array(times, "fmu: times")
        is_list = marks.ndim == 1 and marks.size > 0 and np.isfinite(marks).all()
        if not is_list or marks[0] <= begin or (np.diff(marks) <= 0).any():
            raise ValueError(
                f"fmu: times: got {times!r:.60}, expected increasing times after start_time = "
                f"{begin:g}, (T,)"
            )
        if stop is not None and marks[-1] > end:
            raise ValueError(
                f"fmu: times: got {marks[-1]:g} as the last, expected none after stop_time = "
                f"{end:g}; leave stop_time out"
            )
    elif end is None or end <= begin:
        got = "none, and the unit states none" if end is None else f"{end:g}"
        raise ValueError(f"fmu: stop_time: got {got}, expected a time after start_time = {begin:g}")
    else:
        marks = np.array([end])
    # If neither the user nor the unit states a step there are 500, as in FMPy.
    longest = float(marks[-1] - begin) / 500
    size = default("stepSize") if step is None else float(positive_number(step, "fmu: step"))
    internal = getattr(interface, "fixedInternalStepSize", None)
    is_even = not interface.canHandleVariableCommunicationStepSize
    if size is None and internal is not None:
        size = float(internal) * max(1, round(longest / float(internal)))
    if size is None and is_even:
        raise ValueError(
            f"fmu: step: got none, and {description.modelName} takes steps of one size only and "
            "does not say which, expected a number"
        )
    size = longest if size is None else size
    counts = (marks - begin) / size
    is_off = (np.abs(counts - np.round(counts)) > 1e-6) | (np.round(counts) < 1)
    if is_even and is_off.any():
        raise ValueError(
            f"fmu: got the time {marks[int(is_off.argmax())]:g}, which steps of {size:g} from "
            f"{begin:g} do not reach, expected multiples of the step, as {description.modelName} "
            "takes steps of one size only; pass other times, or step="
        )
    ends = tuple(marks.tolist())
    return _TimeGrid(begin, ends, times is not None, size, is_even, default("tolerance"))


# -- simulation ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Simulation:
    """The simulation of a unit as a function of one specimen's inputs."""

    unit: Unit
    inputs: tuple[Variable, ...]
    outputs: dict[str, Variable]  # outputs by the user's names
    parameters: tuple[tuple[Variable, Value], ...]
    grid: _TimeGrid
    timeout: float | None
    reset: bool

    @property
    def __name__(self) -> str:
        """The name of the unit."""
        return self.unit.name

    def __call__(self, *values: float) -> float | Floats | dict[str, Any]:
        """Simulate one specimen: a number, a curve, or a mapping of these."""
        self._refuse_inputs(self.unit.name, [1] * len(values))
        start_values = [*self.parameters]
        for variable, value in zip(self.inputs, values, strict=True):
            start_values.append((variable, variable.converted(float(value), self.unit.name)))
        with _opened(self.unit).instance(self.reset) as slave:
            rows = self._rows(slave, start_values)
        columns = np.array(rows).T
        curves = dict(zip(self.outputs, columns, strict=True))
        results = curves if self.grid.has_curves else {k: float(v[0]) for k, v in curves.items()}
        return results if len(results) > 1 else next(iter(results.values()))

    def _rows(self, slave: Any, start_values: list[tuple[Variable, Value]]) -> list[list[float]]:
        """Return the outputs at each time."""
        clock = time.monotonic()
        grid = self.grid
        stop = grid.times[-1]
        experiment = {"tolerance": grid.tolerance, "startTime": grid.start, "stopTime": stop}
        if self.unit.version == 2:
            slave.setupExperiment(**experiment)
        for variable, value in start_values:
            getattr(slave, f"set{variable.kind}")([variable.reference], [value])
        slave.enterInitializationMode(**({} if self.unit.version == 2 else experiment))
        slave.exitInitializationMode()
        rows = []
        for begin, size, is_read in grid.steps():
            if self.timeout is not None and time.monotonic() - clock > self.timeout:
                raise TimeoutError(
                    f"{self.unit.name}: no result within timeout = {self.timeout:g} s, at time "
                    f"{begin:g} of {stop:g}{_log_text()}"
                )
            state = slave.doStep(currentCommunicationPoint=begin, communicationStepSize=size)
            # With FMI 3 the state is: event needed, end requested, early return, and time reached.
            if state is not None and (state[1] or state[2]):
                raise RuntimeError(
                    f"{self.unit.name}: it ended at time {state[3]:g}, expected {stop:g}"
                    f"{_log_text()}"
                )
            if is_read:
                row = []
                for variable in self.outputs.values():
                    (number,) = getattr(slave, f"get{variable.kind}")([variable.reference])
                    row.append(float(number))
                rows.append(row)
        slave.terminate()
        return rows

    def refuse_misfit(self, name: str, sizes: Sequence[int], outputs: Outputs | None) -> None:
        """Raise if a simulator has other inputs or outputs than the unit."""
        self._refuse_inputs(name, sizes)
        if outputs is None:
            return
        size = len(self.grid.times) if self.grid.has_curves else None
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
            shape = "(N,)" if size is None else f"(N, {size})"
            named = [key if n is None else f"{key} (N, {n})" for key, n in outputs.keys]
            raise ValueError(
                f"{name}: observed: got {', '.join(named) or 'outputs without names'}, expected a "
                f"mapping of names to arrays {shape}{'' if size else ', or a DataFrame'}, with "
                f"{_listed(list(self.outputs))}: the outputs of {self.unit.name}"
            )

    def _refuse_inputs(self, name: str, sizes: Sequence[int]) -> None:
        if list(sizes) != [1] * len(self.inputs):
            raise ValueError(
                f"{name}: got inputs of {', '.join(map(str, sizes))} numbers, expected "
                f"{len(self.inputs)} of one each: {', '.join(v.name for v in self.inputs)}, for "
                f"{self.unit.name}"
            )


# -- instances in a process ------------------------------------------------------------------------


# Last five messages of the unit that a thread simulates.
_messages = threading.local()


def _record_message(*arguments: Any) -> None:
    """Record a warning or error of a unit; FMI 2 and 3 end their arguments alike."""
    status, _, message = arguments[-3:]
    if status != 0 and message:
        _messages.lines = [*getattr(_messages, "lines", ())[-4:], message]


def _log_text() -> str:
    """Return the last messages of the unit that this thread simulates, for an error."""
    messages = getattr(_messages, "lines", ())
    lines = [" ".join(message.decode("utf-8", "replace").split()) for message in messages]
    return f"; it logged: {' | '.join(lines)}" if lines else "; it logged nothing"


@cache
def _callbacks() -> Any:
    """Return the functions that units of FMI 2 call; they live as long as this process."""
    # FMPy's proxy for the logger is left out, because it may call the logger of a unit that was
    # freed. Messages therefore keep their %s.
    from fmpy import calloc, fmi2, free

    callbacks = fmi2.fmi2CallbackFunctions()
    callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(_record_message)
    callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(calloc)
    callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(free)
    return callbacks


class _OpenUnit:
    """A unit that is unzipped in this process, with its idle instances."""

    def __init__(self, unit: Unit) -> None:
        is_file = Path(unit.path).is_file()
        if not is_file or _file_digest(unit.path) != unit.digest:
            what = "has changed since" if is_file else "is not there"
            raise RuntimeError(
                f"{unit.name}: got {unit.path}, which {what}, expected the file with which the "
                "response was made, also where its workers are; make the response again"
            )
        self.unit = unit
        self.folder = tempfile.mkdtemp(prefix="prbayes-fmu-")
        # Remove the folder by a finalizer, because worker processes end without `atexit`.
        Finalize(None, shutil.rmtree, (self.folder, True), exitpriority=0)
        try:
            _fmpy().extract(unit.path, self.folder)
        except Exception as error:
            raise ValueError(
                f"{unit.name}: got {unit.path}, which cannot be unzipped ({error!s:.200}), "
                "expected a sound archive; copy it again"
            ) from None
        self.idle: list[Any] = []
        self.n_loaded = 0
        self.lock: AbstractContextManager[Any] = (
            threading.Lock() if unit.is_single else nullcontext()
        )

    @contextmanager
    def instance(self, reset: bool) -> Iterator[Any]:
        """Yield an instance in its initial state; it is freed after an error, else reused."""
        from fmpy.fmi1 import FMICallException

        with self.lock:
            _messages.lines = []
            slave = self._at_start(reset)
            try:
                yield slave
            except FMICallException as error:
                if error.status != 4:  # a unit may not be called again after a fatal error
                    _free(slave)
                text = f"{self.unit.name}: {str(error).rstrip('.')}{_log_text()}"
                raise RuntimeError(text) from None
            except BaseException:
                _free(slave)
                raise
            self.idle.append(slave)

    def _at_start(self, reset: bool) -> Any:
        """Return an instance in its initial state: a reset idle one, or a new one."""
        unit = self.unit
        try:
            slave = self.idle.pop()  # another thread may have taken the last one
        except IndexError:
            slave = self._loaded()
        else:
            if reset:
                with suppress(Exception):  # some units cannot be reset
                    slave.reset()
                    return slave
            _free(slave)
        try:
            if unit.version == 2:
                slave.instantiate(callbacks=_callbacks(), loggingOn=True)
            else:
                slave.instantiate(logMessage=_record_message, loggingOn=True)
        except Exception as error:
            raise RuntimeError(
                f"{unit.name}: got no instance of {unit.path} ({error!s:.200}){_log_text()}, "
                "expected one; look at its licence, and at what it needs"
            ) from None
        return slave

    def _loaded(self) -> Any:
        """Return an FMPy object that has loaded the library of the unit."""
        from fmpy import fmi2, fmi3

        unit = self.unit
        self.n_loaded += 1
        kind = fmi2.FMU2Slave if unit.version == 2 else fmi3.FMU3Slave
        with _lock:
            folder = os.getcwd()  # FMPy changes it, and does not return if loading fails
            try:
                return kind(
                    guid=unit.token,
                    unzipDirectory=self.folder,
                    modelIdentifier=unit.identifier,
                    instanceName=f"{unit.identifier}-{self.n_loaded}",
                )
            except Exception as error:
                raise RuntimeError(
                    f"{unit.name}: got a library that cannot be loaded from {unit.path} "
                    f"({error!s:.300}), expected one for this machine; it may need others that are "
                    "not installed"
                ) from None
            finally:
                os.chdir(folder)


def _free(slave: Any) -> None:
    """Free an instance; its library stays loaded."""
    with suppress(Exception):
        free = getattr(slave, "fmi2FreeInstance", None) or slave.fmi3FreeInstance
        free(slave.component)


_open_units: dict[Unit, _OpenUnit] = {}
_lock = threading.RLock()


def _opened(unit: Unit) -> _OpenUnit:
    """Return the unit as it is open in this process; open it at the first call."""
    with _lock:
        if unit not in _open_units:
            _open_units[unit] = _OpenUnit(unit)
        return _open_units[unit]


def _forget_units() -> None:
    """Start without open units after a fork, because instances belong to the parent process."""
    global _lock
    _inherited.append(dict(_open_units))  # so that they are not freed here
    _open_units.clear()
    _lock = threading.RLock()


_inherited: list[Any] = []
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_units)
