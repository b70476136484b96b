"""Functional Mock-up Units (FMU) in a process: read, unzipped and loaded once, instances lent.

What is told to FMPy is the FMI standard (https://fmi-standard.org), versions 2 and 3.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import threading
import zipfile
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

# Messages of a unit that an error repeats: the last ones say what went wrong.
_MESSAGES = 5
# Names of variables that an error lists: what fits a few lines.
_LISTED = 10

type Value = float | int | bool | str


# -- the unit --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Unit:
    """A file that holds a unit, and what it takes to instantiate it."""

    path: str
    digest: str  # of the file
    name: str
    identifier: str
    token: str
    version: int  # of FMI
    once: bool  # whether a process may have one instance only


def _fmpy() -> Any:
    """Return the package that speaks FMI."""
    try:
        import fmpy
    except ImportError:
        raise ImportError(
            "fmu: got no package fmpy, expected it for Functional Mock-up Units; run pip install "
            "prbayes[codes]"
        ) from None
    return fmpy


def _digest(path: str | Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_unit(path: Path) -> tuple[Unit, Any]:
    """Return a unit, and what it says of itself.

    Raises
    ------
    ValueError
        If it is none, or none that can be simulated here.
    """
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
    kind = getattr(description, "coSimulation", None)
    if description is None or kind is None:
        lacks = "" if description is None else " without co-simulation"
        raise ValueError(
            f"fmu: path: got {path}, of FMI {version}{lacks}, expected FMI 2 or 3 for "
            "co-simulation; let the tool that made it export it so"
        )
    if fmpy.platform not in platforms:
        raise ValueError(
            f"fmu: path: got {path}, which runs on {', '.join(platforms) or 'no platform'}, "
            f"expected {fmpy.platform}; let the tool that made it export it for that, or, where it "
            "has c-code, run `fmpy compile`"
        )
    whole = str(path.absolute())
    once = bool(kind.canBeInstantiatedOnlyOncePerProcess)
    unit = Unit(
        whole,
        _digest(path),
        str(description.modelName),
        str(kind.modelIdentifier),
        str(description.guid),
        int(version[0]),
        once,
    )
    return unit, description


_WHOLE = tuple(f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64))


@dataclass(frozen=True)
class Variable:
    """A variable of a unit."""

    name: str
    reference: int
    kind: str  # as in the names of functions that set and get it

    def typed(self, value: Value) -> Value:
        """Return a value as the unit takes it.

        Raises
        ------
        ValueError
            If it is of another kind.
        """
        if isinstance(value, str) == (self.kind == "String"):
            if isinstance(value, str):
                return value
            if self.kind in ("Real", "Float64", "Float32"):
                return float(value)
            if float(value).is_integer() and (self.kind != "Boolean" or value in (0, 1)):
                return bool(value) if self.kind == "Boolean" else int(value)
        expected = {"String": "a text", "Boolean": "0 or 1"}.get(self.kind)
        if expected is None:
            expected = "a whole number" if self.kind in ("Integer", *_WHOLE) else "a number"
        raise ValueError(f"got {value!r} for {self.name}, expected {expected}")


@dataclass(frozen=True)
class Variables:
    """The variables of a unit, by name."""

    unit: Unit
    known: dict[str, Any]

    def settable(self, name: str, argument: str) -> Variable:
        """Return a variable that can be set before a simulation begins."""
        found = self._found(name, argument)
        if not _is_settable(found):
            others = [n for n, v in self.known.items() if _is_settable(v)]
            raise ValueError(
                f"fmu: {argument}: got {name!r}, which {self.unit.name} computes itself ("
                f"{found.causality}, {found.initial or found.variability}), expected a parameter "
                f"or an input: {listed(others)}"
            )
        return self._variable(found, argument, argument == "parameters")

    def readable(self, name: str) -> Variable:
        """Return a variable that has numbers."""
        return self._variable(self._found(name, "outputs"), "outputs", False)

    def _found(self, name: str, argument: str) -> Any:
        if name in self.known:
            return self.known[name]
        close = get_close_matches(name, self.known, n=3)
        hint = f"did you mean {' or '.join(map(repr, close))}?"
        raise ValueError(
            f"fmu: {argument}: got {name!r}, expected a variable of {self.unit.name}; "
            f"{hint if close else 'it has ' + listed(list(self.known))}"
        )

    def _variable(self, found: Any, argument: str, texts: bool) -> Variable:
        kind = str(found.type)
        if kind == "Enumeration":
            kind = "Integer" if self.unit.version == 2 else "Int64"
        numbers = ("Real", "Float64", "Float32", "Integer", "Boolean", *_WHOLE)
        if found.shape or not (kind in numbers or (texts and kind == "String")):
            what = "an array" if found.shape else f"of type {kind}"
            raise ValueError(
                f"fmu: {argument}: got {found.name!r}, which is {what} in {self.unit.name}, "
                f"expected a variable with {'one value' if texts else 'one number'}"
            )
        return Variable(str(found.name), int(found.valueReference), kind)


def _is_settable(variable: Any) -> bool:
    given = variable.causality in ("input", "parameter")
    return variable.variability != "constant" and (given or variable.initial in ("exact", "approx"))


def listed(names: Sequence[str]) -> str:
    """Return the first of some names, for messages."""
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(map(repr, names[:_LISTED])) + more if names else "none"


# -- in a process ----------------------------------------------------------------------------------


class _Said(threading.local):
    """What units say in a thread while they are at work there."""

    def __init__(self) -> None:
        self.lines: deque[bytes] = deque(maxlen=_MESSAGES)


_said = _Said()


def _note(*said: Any) -> None:
    """Keep a message that is more than information, in FMI 2 and 3; units may have many others."""
    status, _, message = said[-3:]
    if status != 0 and message:
        _said.lines.append(message)


def last_words() -> str:
    """Return what the unit at work in this thread logged last, to add to an error."""
    lines = [" ".join(line.decode("utf-8", "replace").split()) for line in _said.lines]
    return f"; it logged: {' | '.join(lines)}" if lines else "; it logged nothing"


@cache
def _callbacks() -> Any:
    """Return what units of FMI 2 call, for as long as this process lives.

    Without FMPy's proxy for messages with arguments, which knows one logger of a process, also when
    that is gone: these messages come as they are written, with %s in them.
    """
    from fmpy import calloc, fmi2, free

    found = fmi2.fmi2CallbackFunctions()
    found.logger = fmi2.fmi2CallbackLoggerTYPE(_note)
    found.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(calloc)
    found.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(free)
    return found


class _Opened:
    """A unit that is unzipped in this process, and its instances that wait for work."""

    def __init__(self, unit: Unit) -> None:
        if not Path(unit.path).is_file() or _digest(unit.path) != unit.digest:
            what = "has changed since" if Path(unit.path).is_file() else "is not there"
            raise RuntimeError(
                f"{unit.name}: got {unit.path}, which {what}, expected the file with which the "
                "response was made, also where its workers are; make the response again"
            )
        self.unit = unit
        self.folder = tempfile.mkdtemp(prefix="prbayes-fmu-")
        # Also in workers, which end without `atexit`; those that are killed leave it.
        Finalize(None, shutil.rmtree, (self.folder, True), exitpriority=0)
        fmpy = _fmpy()
        try:
            fmpy.extract(unit.path, self.folder)
        except Exception as error:
            raise ValueError(
                f"{unit.name}: got {unit.path}, which cannot be unzipped ({error!s:.200}), "
                "expected a sound archive; copy it anew"
            ) from None
        self.spare: list[Any] = []
        self.count = 0
        # For units of which a process may have one.
        self.only: AbstractContextManager[Any] = threading.Lock() if unit.once else nullcontext()

    @contextmanager
    def instance(self, reset: bool) -> Iterator[Any]:
        """Lend an instance at its start; one with which something went wrong is not used again."""
        from fmpy.fmi1 import FMICallException

        with self.only:
            _said.lines.clear()
            slave = self._taken(reset)
            try:
                yield slave
            except FMICallException as error:
                # After 4, fatal, nothing may be called any more.
                if error.status != 4:
                    _free(slave)
                text = f"{self.unit.name}: {str(error).rstrip('.')}{last_words()}"
                raise RuntimeError(text) from None
            except BaseException:
                _free(slave)
                raise
            self.spare.append(slave)

    def _taken(self, reset: bool) -> Any:
        """Return an instance at its start."""
        try:
            slave = self.spare.pop()
        except IndexError:
            return self._new()
        if reset:
            # Some units cannot, and say so.
            with suppress(Exception):
                slave.reset()
                return slave
        _free(slave)
        self._instantiate(slave)
        return slave

    def _new(self) -> Any:
        """Return a new instance."""
        from fmpy import fmi2, fmi3

        unit = self.unit
        self.count += 1
        kind = fmi2.FMU2Slave if unit.version == 2 else fmi3.FMU3Slave
        with _turn:
            # FMPy changes into the folder of the library, and stays there where that fails.
            before = os.getcwd()
            try:
                slave = kind(
                    guid=unit.token,
                    unzipDirectory=self.folder,
                    modelIdentifier=unit.identifier,
                    instanceName=f"{unit.identifier}-{self.count}",
                )
            except Exception as error:
                raise RuntimeError(
                    f"{unit.name}: got a library that cannot be loaded from {unit.path} "
                    f"({error!s:.300}), expected one for this machine; it may need others that are "
                    "not installed"
                ) from None
            finally:
                os.chdir(before)
        self._instantiate(slave)
        return slave

    def _instantiate(self, slave: Any) -> None:
        try:
            if self.unit.version == 2:
                slave.instantiate(callbacks=_callbacks(), loggingOn=True)
            else:
                slave.instantiate(logMessage=_note, loggingOn=True)
        except Exception as error:
            raise RuntimeError(
                f"{self.unit.name}: got no instance of {self.unit.path} ({error!s:.200})"
                f"{last_words()}, expected one; look at its licence, and at what it needs"
            ) from None


def _free(slave: Any) -> None:
    """Free an instance, and leave its library loaded."""
    with suppress(Exception):
        free = getattr(slave, "fmi2FreeInstance", None) or slave.fmi3FreeInstance
        free(slave.component)


_units: dict[Unit, _Opened] = {}
_turn = threading.RLock()


def opened(unit: Unit) -> _Opened:
    """Return a unit that is open in this process."""
    with _turn:
        if unit not in _units:
            _units[unit] = _Opened(unit)
        return _units[unit]


def _forget() -> None:
    """Begin anew in a process that was forked: instances stay with the parent."""
    global _turn
    _inherited.append(dict(_units))  # and are freed by nobody
    _units.clear()
    _turn = threading.RLock()


_inherited: list[Any] = []
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
