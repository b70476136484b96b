"""Computed responses on disk, keyed by their inputs: none is lost.

A store is a folder with one SQLite file for all simulators that were given it. Runs are only ever
appended, a transaction for each chunk of them: whatever moment a process is killed at, what was
committed is found again, and several processes may write at once. Every run carries a checksum: a
damaged file is refused with a sentence, and never read as other numbers.
"""

from __future__ import annotations

import os
import sqlite3
import threading
import weakref
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from prbayes._validate import Floats, plain_text, positive_integer, stated_path
from prbayes.response.database import (
    COMPUTED,
    FAILED,
    INSERT_RESPONSE,
    INSERT_RUN,
    SELECT_RESPONSES,
    SELECT_RUNS,
    Complaint,
    checksum,
    complaint_about,
    complaint_of,
    connected,
    create,
    damaged,
    transaction,
)

_FILE = "responses.sqlite"  # what users see in their folder
_NAN = np.array(np.nan, dtype="<f8").tobytes()


class StoreError(RuntimeError):
    """A store that cannot be read or written, or is of something else; never overwritten."""


@dataclass(frozen=True)
class _Entry:
    """A response in the file: its number there, and of how many values its inputs are made."""

    number: int
    columns: int


@dataclass(eq=False)
class _Session:
    """The file as one thread of one process has it open, and what it has read of it.

    Attributes
    ----------
    connection : sqlite3.Connection
    opened : tuple of int
        Process, and device and number of the file.
    entry : _Entry
    known : dict
        Values of the store's response, all outputs of a run together, by keys, both as bytes.
    failed : dict
        Why there is no value, by the keys of those that failed.
    seen : int
        The last run that was read, of any response.
    """

    connection: sqlite3.Connection
    opened: tuple[int, ...]
    entry: _Entry
    known: dict[bytes, bytes] = field(default_factory=dict)
    failed: dict[bytes, str] = field(default_factory=dict)
    seen: int = 0

    def __post_init__(self) -> None:
        self.close = weakref.finalize(self, _close, self.connection, os.getpid())


class Store:
    """The stored responses of one simulator, in ``<folder>/responses.sqlite``.

    Several processes and threads of one machine may use a folder at once. Each opens the file by
    itself when it needs it, also after a fork, and where the store was sent to another process.

    Parameters
    ----------
    folder : path-like
        Made if it does not exist.
    name : str
        Of the simulator.
    columns : int, optional
        Number of values that the inputs of one point are made of. By default that of the stored
        responses; there must be some, then.
    version : str, optional
        Of the response; those of each version are kept apart, as are those without one.
    outputs : int, optional
        Number of outputs of a run. By default that of the stored responses, or one.

    Attributes
    ----------
    verified : bool
        Whether the stored responses are known to be those of the response at hand: a version says
        so, or one of them was computed again.

    Raises
    ------
    StoreError
        If there is a file that cannot be read, or that was made for other inputs.

    Examples
    --------
    >>> import tempfile, numpy as np
    >>> folder = tempfile.mkdtemp()
    >>> store = Store(folder, "y", columns=2)
    >>> store.add(np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([10.0, 20.0]))
    >>> store.find(np.array([[3.0, 4.0], [5.0, 6.0]]))
    (array([20., nan]), array([ True, False]))
    >>> Store(folder, "y").to_dataset()["response"].values
    array([10., 20.])
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        name: str,
        *,
        columns: int | None = None,
        version: str | None = None,
        outputs: int | None = None,
    ) -> None:
        self.folder = stated_path(folder, "folder", "folder")
        self.name = plain_text(name, "name")
        if columns is not None:
            positive_integer(columns, "columns")
        if version is not None:
            plain_text(version, "version")
        self.columns = columns
        self.outputs = outputs
        self.version = version
        self.verified = version is not None
        self._local = threading.local()
        self._read()

    def __getstate__(self) -> dict[str, Any]:
        keys = ("folder", "name", "columns", "version", "outputs")
        return {key: vars(self)[key] for key in keys}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self.verified = self.version is not None
        self._local = threading.local()

    @property
    def path(self) -> Path:
        """The file."""
        return self.folder / _FILE

    def __len__(self) -> int:
        return len(self._read().known)

    def find(self, inputs: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Return stored responses of inputs (n, columns), and which were found, shape (n,).

        Of several outputs the responses have shape (n, m).
        """
        session = self._read()
        known = session.known
        found = [known.get(key) for key in _keys(inputs)]
        present = np.array([value is not None for value in found], dtype=bool)
        nothing = _NAN * self._width(session)
        return self._values(session, (nothing if v is None else v for v in found)), present

    def _width(self, session: _Session) -> int:
        """Return how many outputs a run has."""
        first = next(iter(session.known.values()), None)
        return self.outputs or (1 if first is None else len(first) // len(_NAN))

    def _values(self, session: _Session, values: Iterable[bytes]) -> Floats:
        """Return responses as numbers, (n,), or (n, m) of several outputs."""
        width = self._width(session)
        numbers = _numbers(values)
        return numbers if width == 1 else numbers.reshape(-1, width)

    def failed(self, inputs: Floats) -> dict[int, str]:
        """Return which of the inputs, (n, columns), are stored as failed, and why, by row."""
        failed = self._read().failed
        if not failed:
            return {}
        keys = enumerate(_keys(inputs))
        return {row: failed[key] for row, key in keys if key in failed}

    def known(self) -> tuple[Floats, Floats]:
        """Return inputs, (n, columns), and values, (n,) or (n, m), in the order in which they came.

        NaN is a result, or a response that failed; `failed` tells.
        """
        session = self._read()
        inputs = _numbers(session.known).reshape(-1, session.entry.columns)
        return inputs, self._values(session, session.known.values())

    def add(self, inputs: Floats, values: Floats, reasons: Mapping[int, str] | None = None) -> None:
        """Append responses, safe on disk when this returns.

        Parameters
        ----------
        inputs : ndarray, shape (n, columns)
        values : ndarray, shape (n,) or (n, m)
        reasons : mapping, optional
            Of those that failed: why, by row.
        """
        self.add_all([(inputs, values, reasons or {})])

    def add_all(self, parts: Iterable[tuple[Floats, Floats, Mapping[int, str]]]) -> None:
        """Append several batches of responses as `add` does, all or none of them."""
        session = self._read()
        rows = []
        for inputs, values, reasons in parts:
            rows += _rows(session.entry.number, inputs, values, reasons)
        with self._explained(), transaction(session.connection):
            session.connection.executemany(INSERT_RUN, rows)

    def to_dataset(self) -> xr.Dataset:
        """Return the stored responses for other programs: ``store.to_dataset().to_netcdf(path)``.

        Returns
        -------
        Dataset
            ``inputs``, dims (point, column), ``response``, dim (point) or dims (point, output), and
            ``reason``, dim (point), in the order in which they came; a reason is empty where the
            response did not fail.
        """
        inputs, values = self.known()
        failed = self.failed(inputs)
        reasons = np.array([failed.get(row, "") for row in range(len(values))], dtype=object)
        return xr.Dataset(
            {
                "inputs": (["point", "column"], inputs),
                "response": (["point", "output"][: values.ndim], values),
                "reason": ("point", reasons.astype(str)),
            },
            attrs={"simulator": self.name},
        )

    def close(self) -> None:
        """Close the file in this thread; it is opened again when it is needed."""
        session: _Session | None = getattr(self._local, "session", None)
        if session is not None:
            session.close()
            del self._local.session

    def _read(self) -> _Session:
        """Return the session of this thread, after reading what others have written meanwhile."""
        session: _Session | None = getattr(self._local, "session", None)
        with self._explained():
            # After a fork, and where another file is in its place, the session is an old one. It is
            # closed first: closing deletes the log of writes, by name.
            if session is not None and session.opened != self._opened():
                session.close()
                session = None
            if session is None:
                session = self._open()
            self._read_on(session)
        self._local.session = session
        return session

    def _opened(self) -> tuple[int, ...]:
        """Return what tells processes and files apart; nothing if there is no file."""
        try:
            file = self.path.stat()
        except FileNotFoundError:
            return ()
        return os.getpid(), file.st_dev, file.st_ino

    def _open(self) -> _Session:
        """Open the file, made if it does not exist, after a look whether it is a sound store."""
        if self.folder.exists() and not self.folder.is_dir():
            raise StoreError(
                f"{self.name}: store: got {self.folder}, which is a file, expected a folder"
            )
        if not self.path.exists():
            create(self.path)
        connection = connected(self.path)
        try:
            complaint = complaint_about(self.path, connection)
            if complaint is not None:
                raise self._refusal(complaint)
            return _Session(connection, self._opened(), self._entry(connection))
        except BaseException:
            connection.close()
            raise

    def _entry(self, connection: sqlite3.Connection) -> _Entry:
        """Return the store's response in the file, where it is entered if it is new."""
        own = self.name, self.version
        if own not in self._entries(connection):
            self._enter(connection)
        entries = self._entries(connection)
        if own not in entries:
            got = f"which holds no responses of simulator {_called(*own)}"
            todo = "look at name, version and folder"
            known = ", ".join(_called(*each) for each in entries)
            raise self._refusal(Complaint(got, f"one of [{known}]", todo))
        entry = entries[own]
        if self.columns not in (None, entry.columns):
            got = f"which holds inputs of {entry.columns} values for simulator {self.name!r}"
            todo = "nothing was changed: give the simulator another name, or pass another folder"
            raise self._refusal(Complaint(got, f"{self.columns} values", todo))
        return entry

    def _enter(self, connection: sqlite3.Connection) -> None:
        """Enter the response, unless another process has, or stores of before SQLite have it."""
        if self.columns is None:
            return
        safe = "".join(c if c.isalnum() or c in "-_." else f"%{ord(c):x}" for c in self.name)
        older = [end for end in (".nc", ".journal") if (self.folder / f"{safe}{end}").exists()]
        if older:
            got = f"beside {safe}{older[0]}, which an older version wrote"
            todo = "this version does not read it: move it away, or pass another folder"
            raise self._refusal(Complaint(got, "no such file", todo))
        row = (self.name, self.columns, self.version)
        with transaction(connection):
            connection.execute(INSERT_RESPONSE, (*row, checksum(*row), self.name, self.version))

    def _entries(self, connection: sqlite3.Connection) -> dict[tuple[str, str | None], _Entry]:
        """Return the responses in the file, by name and version."""
        entries = {}
        for number, *row, written in connection.execute(SELECT_RESPONSES).fetchall():
            if written != checksum(*row):
                raise self._refusal(damaged(f"response {number} does not match its checksum"))
            name, columns, version = row
            entries[name, version] = _Entry(number, columns)
        return entries

    def _read_on(self, session: _Session) -> None:
        """Read the runs that the session has not seen; every one has to be there, and sound."""
        with closing(session.connection.execute(SELECT_RUNS, (session.seen,))) as runs:
            for number, *row, written in runs:
                if number != session.seen + 1:
                    raise self._refusal(damaged(f"run {session.seen + 1} is missing"))
                if written != checksum(*row):
                    raise self._refusal(damaged(f"run {number} does not match its checksum"))
                response, key, state, reason, value = row
                if response == session.entry.number:
                    self._refuse_other_outputs(session, value)
                    session.known[key] = value
                    # The last run of a point counts: one that failed may have been tried again.
                    session.failed.pop(key, None)
                    if state == FAILED:
                        session.failed[key] = reason
                session.seen = number

    def _refuse_other_outputs(self, session: _Session, value: bytes) -> None:
        """Raise if a stored run has another number of outputs."""
        found = len(value) // len(_NAN)
        width = self._width(session)
        if (session.known and found != width) or self.outputs not in (None, found):
            got = f"which holds runs with {found} outputs for simulator {self.name!r}"
            todo = "nothing was changed: pass version= with a name for the response as it is now"
            raise self._refusal(Complaint(got, f"{width}", todo))

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Turn what SQLite reports into a sentence."""
        try:
            yield
        except sqlite3.Error as error:
            raise self._refusal(complaint_of(error)) from error

    def _refusal(self, complaint: Complaint) -> StoreError:
        return StoreError(
            f"{self.name}: store: got {self.path}, {complaint.got}, expected {complaint.expected}; "
            f"{complaint.todo}"
        )


def _called(name: str, version: str | None) -> str:
    """Return what a response is called, for messages."""
    return repr(name) if version is None else f"{name!r}, version {version!r}"


def _keys(inputs: Floats) -> list[bytes]:
    return [row.tobytes() for row in np.ascontiguousarray(inputs, dtype="<f8")]


def _numbers(values: Iterable[bytes]) -> Floats:
    return np.frombuffer(bytearray(b"".join(values)), dtype="<f8").astype(np.float64)


def _rows(
    response: int, inputs: Floats, values: Floats, reasons: Mapping[int, str]
) -> list[tuple[Any, ...]]:
    """Return rows of the table of runs."""
    numbers = np.asarray(values, dtype="<f8")
    rows = []
    for i, key in enumerate(_keys(inputs)):
        state = FAILED if i in reasons else COMPUTED
        row = (response, key, state, reasons.get(i), numbers[i].tobytes())
        rows.append((*row, checksum(*row)))
    return rows


# Connections that came with a fork: they are the parent's, and must not be closed here.
_inherited: list[sqlite3.Connection] = []


def _close(connection: sqlite3.Connection, process: int) -> None:
    if process == os.getpid():
        connection.close()
    else:
        _inherited.append(connection)
