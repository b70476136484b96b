"""Digests of the variables that a function reads, which show a change without a call.

Code, defaults, closure, attributes, classes, global variables, arrays, and the times of files that
a text names are walked breadth first. Functions of libraries count by name and file. Digests are
the same in every process with the same Python.
"""

from __future__ import annotations

import dis
import os
import stat
import sys
import sysconfig
import zlib
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from types import CodeType, FunctionType, MemberDescriptorType, ModuleType
from typing import Any
from weakref import WeakValueDictionary

import numpy as np

# A text that identifies an object without its parts, and pairs of a name and a part. A part
# without a name belongs to the variable of its owner.
type Opened = tuple[str, Iterable[tuple[str, Any]]]

_CONSTANTS = frozenset({int, float, complex, bool, type(None), type(...)})
# Folders of installed packages and of this package.
_FOLDERS = sysconfig.get_path("purelib"), sysconfig.get_path("platlib"), Path(__file__).parents[1]
_LIBRARIES = tuple(os.path.join(folder, "") for folder in _FOLDERS)
# Packages whose objects are resources: they change by themselves, and hold no numbers.
_RESOURCES = frozenset({"asyncio", "concurrent", "distributed", "logging", "threading"})


def digests_of(function: object, most: int = 10_000) -> dict[str, str]:
    """Return a digest of each variable that a function reads, by its name.

    The function's own code has the name "". The function is not called, and no object is kept. Of
    more than ``most`` objects those that are nearest to the function count.
    """
    hashes: dict[str, Any] = {}
    opened: dict[int, tuple[str, Any]] = {}  # objects with their variables; kept, so that ids stay
    waiting = deque([("", function)])
    while waiting and len(opened) < most:
        path, value = waiting.popleft()
        token, parts = "object", []
        try:  # an object may raise anything
            token = repr(value) if type(value) in _CONSTANTS else _type_name(value)
            if type(value) is str:
                token = f"{value!r} {_file_state(value)}"
            elif id(value) in opened:  # a cycle, or a second way to the same object
                token = f"as {opened[id(value)][0]}"
            elif type(value) not in _CONSTANTS:
                opened[id(value)] = path, value
                token, iterable = _opened(value)
                parts = list(iterable)
        except Exception:
            parts = []
        digest = hashes.setdefault(path, blake2b(digest_size=8))
        digest.update(f"{len(token)} {token}".encode(errors="backslashreplace"))
        for name, part in parts:
            is_variable = name and path.count(".") < 5
            waiting.append((f"{path}.{name}".lstrip(".") if is_variable else path, part))
    return {path: digest.hexdigest() for path, digest in hashes.items()}


def _type_name(value: object) -> str:
    return f"{type(value).__module__}.{type(value).__qualname__}"


def _opened(value: Any) -> Opened:
    """Return what identifies an object, and its parts."""
    name = _type_name(value)
    if isinstance(value, FunctionType):
        return _opened_function(value)
    if isinstance(value, CodeType):
        names = value.co_names, value.co_freevars, value.co_argcount, value.co_flags
        return f"{value.co_code!r} {names}", [("", x) for x in value.co_consts]
    if isinstance(value, type):
        user_classes = [base for base in value.__mro__ if _is_own(base.__module__)]
        variables = [item for base in user_classes for item in list(vars(base).items())]
        parts = [x for x in variables if isinstance(x[1], FunctionType) or x[0][:2] != "__"]
        return f"class {value.__module__}.{value.__qualname__}", parts
    if isinstance(value, ModuleType) or name.partition(".")[0] in _RESOURCES:
        return f"{name} {getattr(value, '__name__', '')}", ()
    if isinstance(value, os.PathLike):
        return name, [("", str(os.fspath(value)))]
    if isinstance(value, bytes | bytearray | memoryview):
        return f"{name} {len(value)} {zlib.crc32(value)}", ()
    attributes = _attributes(value)
    wrapped = [(k, v) for k, v in attributes.items() if k in ("__wrapped__", "py_func")]
    if wrapped and not _is_own(type(value).__module__):  # memory, or compiled code, of a function
        return name, wrapped
    parts = list(attributes.items())
    if _is_own(type(value).__module__):
        parts.append((type(value).__name__, type(value)))
    else:  # a look at a table fills its memory
        parts = [(k, v) for k, v in parts if not k.endswith("_cache")]
    text, elements = _elements(value, is_plain=not parts)
    return f"{name} {text}", [*parts, *elements]


def _elements(value: Any, *, is_plain: bool) -> Opened:
    """Open an array or a container; a plain object of another type by its state for a pickle."""
    if isinstance(value, np.ndarray | np.generic):
        array = np.asarray(value)
        text = f"{array.dtype.str} {array.shape}"
        if array.dtype.hasobject:
            return text, [("", array.ravel()[:10_000].tolist())]
        if array.nbytes > 2**28:  # a checksum takes 70 ms for 256 MiB; of more a part counts
            array = array.ravel(order="K")[:: array.size // 2**16]
        # As bytes, because an array of dates is no buffer.
        numbers = np.ascontiguousarray(array).ravel()
        checksum = zlib.crc32(numbers.view(np.uint8))
        return f"{text} {checksum}", ()
    if isinstance(value, dict):
        keys, values = list(dict.keys(value)), list(dict.values(value))
        if len(keys) <= 64 and all(type(key) is str for key in keys):
            return str(keys), zip(keys, values, strict=True)
        return f"{len(keys)}", [("", keys), ("", values)]
    if isinstance(value, set | frozenset):
        plain = [repr(x) for x in value if type(x) in _CONSTANTS or isinstance(x, str | bytes)]
        return f"{len(value)} {sorted(plain)}", ()
    if isinstance(value, list | tuple | deque):
        if len(value) > 16 and set(map(type, value)) == {float}:
            return "floats", [("", np.array(value))]
        return f"{len(value)}", [("", x) for x in list(value)[:10_000]]
    state = value.__reduce_ex__(4) if is_plain else ""
    return (state, ()) if isinstance(state, str) else ("", [("", x) for x in state[1:3]])


def _file_state(text: str) -> str:
    """Return size and time of the file that a text names, an empty text if there is none."""
    try:
        file = os.stat(text[:1000])
    except (OSError, ValueError):
        return ""
    return f"{file.st_size} {file.st_mtime_ns}" if stat.S_ISREG(file.st_mode) else ""


def _is_own(module: str) -> bool:
    """Return whether a module is the user's: not installed, and not of the standard library."""
    file = str(getattr(sys.modules.get(module), "__file__", None))
    is_installed = file.startswith(_LIBRARIES) and module != "__main__"
    return not is_installed and module.partition(".")[0] not in sys.stdlib_module_names


def _opened_function(function: FunctionType) -> Opened:
    """Open a function; the code of a library counts by its file, its closure as that of a user."""
    code = function.__code__
    closure = {}
    for variable, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        with suppress(ValueError):  # the variable has no value yet
            closure[variable] = cell.cell_contents
    parts = [(k, v) for k, v in vars(function).items() if k != "__signature__"]
    parts += [("defaults", x) for x in (function.__defaults__, function.__kwdefaults__)]
    name = f"function {function.__module__}.{function.__qualname__}"
    if not _is_own(str(function.__module__)):
        return f"{name} {_file_state(code.co_filename)}", [*parts, *closure.items()]
    read, imported, names = _names_of(code)
    folder = str(function.__globals__.get("__package__"))
    modules = {x: sys.modules.get(x) or sys.modules.get(f"{folder}.{x}") for x in imported}
    # Variables of the closure, global ones, then those of modules, which the code names as
    # attributes.
    variables = {**function.__globals__, **modules, **closure}
    spaces = [([*closure, *read, *modules], variables)]
    for of_code, space in spaces:
        for variable in [x for x in of_code if x in space]:
            value = space[variable]
            if not isinstance(value, ModuleType):
                parts.append((variable, value))
            elif all(vars(value) is not met for _, met in spaces):
                spaces.append((names, vars(value)))
    return name, [("", code), *parts]


@lru_cache(maxsize=1024)
def _names_of(code: CodeType) -> tuple[list[str], list[str], list[str]]:
    """Return names of global variables, of imported modules, and all names in code."""
    read = []
    imported = []
    names = list(code.co_names)
    for instruction in dis.get_instructions(code):
        if instruction.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
            read.append(instruction.argval)
        elif instruction.opname == "IMPORT_NAME":
            imported.append(instruction.argval)
    for part in code.co_consts:
        if isinstance(part, CodeType):
            inner = _names_of(part)
            read, imported, names = read + inner[0], imported + inner[1], names + inner[2]
    return list(dict.fromkeys(read)), imported, list(dict.fromkeys(names))


@lru_cache(maxsize=1024)
def _slots(kind: Any) -> tuple[Any, ...]:
    """Return the descriptors of attributes that are no entries of a dictionary."""
    variables = [x for base in kind.__mro__ for x in vars(base).values()]
    slots = [x for x in variables if isinstance(x, MemberDescriptorType)]
    return tuple(x for x in slots if not x.__name__.endswith("offset__"))  # no addresses


def _attributes(value: object) -> dict[str, Any]:
    """Return the attributes of an object without a call of its own methods."""
    attributes: dict[str, Any] = {}
    with suppress(AttributeError):
        variables = object.__getattribute__(value, "__dict__")
        attributes.update((k, v) for k, v in variables.items() if type(k) is str)
    kind: Any = type(value)
    for slot in _slots(kind):
        with suppress(AttributeError):  # the attribute has no value yet
            attributes.setdefault(slot.__name__, slot.__get__(value))
    # A signature is kept at its first look, and the dictionary has the attributes above.
    return {k: v for k, v in attributes.items() if k not in ("__signature__", "__dict__")}


# -- changes ---------------------------------------------------------------------------------------


class Watched:
    """A function that is compared with itself as it was after its last calls by this package.

    What calls change themselves, such as a counter, is no change. A variable that a call sets once
    counts again after calls that leave it as it is.
    """

    def __init__(self, function: object) -> None:
        self.function = function
        self.version = 0  # number of changes that were noticed
        self.names: list[str] = []  # names of the variables of the last change
        # Digests by variable, None for those that the last calls changed; empty before a call.
        self._digests: dict[str, str | None] = {}
        self._last: dict[str, str] = {}  # digests of the last comparison, or between calls
        self._is_called = False

    def __reduce__(self) -> tuple[Any, ...]:
        return watched, (self.function, self._digests)

    def digests(self) -> dict[str, str | None]:
        """Return the digests as they are now, None for variables that calls change."""
        self._last = digests_of(self.function)
        return self._last | {k: None for k, v in self._digests.items() if v is None}

    def compared(self) -> int:
        """Return the version of the function, which is a new one if a variable has changed."""
        now = self.digests()
        names = changed_names(self._digests, now) if self._digests else []
        if names:
            self.version += 1
            self.names = names
        self._digests = now
        return self.version

    @contextmanager
    def calls(self) -> Iterator[None]:
        """Compare the function before calls, and take what they change as no change."""
        if self._is_called:  # calls within calls, or in another thread
            yield
            return
        self.compared()
        self._is_called = True
        try:
            yield
        finally:
            self.called()
            self._is_called = False

    def called(self) -> None:
        """Note what the calls so far have changed; more calls follow, or they end."""
        if self._is_called:
            now = digests_of(self.function)
            self._digests = {**now, **dict.fromkeys(changed_names(self._last, now))}
            self._last = now


def changed_names(before: Mapping[str, str | None], now: Mapping[str, str | None]) -> list[str]:
    """Return the names of variables whose digests differ; those with None are not compared."""
    pairs = {name: (before.get(name, ""), now.get(name, "")) for name in [*now, *before]}
    return [name for name, pair in pairs.items() if pair[0] != pair[1] and None not in pair]


def listed(names: Sequence[str]) -> str:
    """Return the first names of variables as a text."""
    return ", ".join(name or "its code, or a file that it names," for name in names[:3])


_records: WeakValueDictionary[int, Watched] = WeakValueDictionary()


def watched(function: object, digests: Mapping[str, str | None] = {}) -> Watched:
    """Return the record of a function, one for all its simulators; the record keeps it."""
    record = _records.setdefault(id(function), Watched(function))
    record._digests = record._digests or dict(digests)
    return record
