"""Store of computed responses on disk, keyed by their inputs.

A store is a folder with one SQLite file for all of its simulators. Runs are only appended, with a
transaction for each chunk, so committed runs survive a killed process, and several processes may
write at once. A checksum of every run reveals damage.
"""

from __future__ import annotations

import json
import os
import re
import sqlite3
import stat
import threading
import uuid
import weakref
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from prbayes._validate import (
    FORMAT,
    Bools,
    Floats,
    plain_text,
    positive_integer,
    stated_path,
)

_NAN = np.array(np.nan, dtype="<f8").tobytes()


class StoreError(RuntimeError):
    """A store that cannot be read or written, or of something else; it is never overwritten."""


@dataclass(eq=False)
class _Session:
    """A connection of one thread of one process, and the runs that it has read."""

    connection: sqlite3.Connection
    opened: tuple[int, ...]  # process, device and inode of the file
    response: int  # row of the store's response in the file
    columns: int  # number of values that make the inputs of one run
    values: dict[bytes, bytes] = field(default_factory=dict)  # outputs of runs by their inputs
    failed: dict[bytes, str] = field(default_factory=dict)  # reasons of failures by inputs
    n_read: int = 0  # number of runs that were read, also those of other responses

    def __post_init__(self) -> None:
        self.close = weakref.finalize(self, _close, self.connection, os.getpid())


# Connections of the parent process after a fork. They are kept, since closing them in the child
# would harm the parent.
_inherited: list[sqlite3.Connection] = []


def _close(connection: sqlite3.Connection, process: int) -> None:
    if process == os.getpid():
        connection.close()
    else:
        _inherited.append(connection)


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
        Number of values that make the inputs of one point. By default that of the stored
        responses; there must be one.
    version : str, optional
        Of the response; those of each version are kept apart, as are those without one.
    outputs : int, optional
        Number of outputs of a run. By default that of the stored responses, or one.

    Attributes
    ----------
    verified : bool
        Whether the stored responses are known to be those of the present response: by a version, or
        because one of them was computed again.

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
        for argument, value in (("columns", columns), ("outputs", outputs)):
            if value is not None:
                positive_integer(value, argument)
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
        return self.folder / "responses.sqlite"

    def __len__(self) -> int:
        return len(self._read().values)

    def find(self, inputs: Floats) -> tuple[Floats, Bools]:
        """Return stored responses, and whether there is one.

        Parameters
        ----------
        inputs : ndarray, shape (n, columns)

        Returns
        -------
        responses : ndarray, shape (n,) or (n, m)
            NaN where there is none.
        is_known : ndarray of bool, shape (n,)

        Raises
        ------
        StoreError
            If the file cannot be read, or is damaged.
        """
        session = self._read()
        values = [session.values.get(key) for key in _keys(inputs)]
        is_known = np.array([value is not None for value in values], dtype=bool)
        missing = _NAN * self._n_outputs(session)
        return self._as_array(session, (v or missing for v in values)), is_known

    def failed(self, inputs: Floats) -> dict[int, str]:
        """Return the reasons of inputs that are stored as failed.

        Parameters
        ----------
        inputs : ndarray, shape (n, columns)

        Returns
        -------
        dict of int to str
            By row.

        Raises
        ------
        StoreError
            If the file cannot be read, or is damaged.
        """
        failed = self._read().failed
        if not failed:
            return {}
        return {row: failed[key] for row, key in enumerate(_keys(inputs)) if key in failed}

    def known(self) -> tuple[Floats, Floats]:
        """Return inputs, (n, columns), and values, (n,) or (n, m), in the order of their storage.

        NaN is a result, or a response that failed; see `failed`.
        """
        session = self._read()
        inputs = _numbers(session.values).reshape(-1, session.columns)
        return inputs, self._as_array(session, session.values.values())

    def add(self, inputs: Floats, values: Floats, reasons: Mapping[int, str] | None = None) -> None:
        """Append responses, safe on disk when this returns.

        Parameters
        ----------
        inputs : ndarray, shape (n, columns)
        values : ndarray, shape (n,) or (n, m)
        reasons : mapping, optional
            Reasons of failed responses, by row.

        Raises
        ------
        StoreError
            If the file cannot be written, is locked for a minute, or is damaged.
        """
        self.add_all([(inputs, values, reasons or {})])

    def add_all(self, parts: Iterable[tuple[Floats, Floats, Mapping[int, str]]]) -> None:
        """Append several batches of responses, all or none of them.

        Parameters
        ----------
        parts : sequence of tuple
            Arguments of `add`, with ``reasons`` as a mapping.

        Raises
        ------
        StoreError
            As for `add`.
        """
        session = self._read()
        rows = []
        for inputs, values, reasons in parts:
            numbers = np.asarray(values, dtype="<f8")
            for i, key in enumerate(_keys(inputs)):
                state = "failed" if i in reasons else "computed"
                row = (session.response, key, state, reasons.get(i), numbers[i].tobytes())
                rows.append((*row, checksum(*row)))
        with self._explained(), transaction(session.connection):
            session.connection.executemany(INSERT_RUN, rows)

    def to_dataset(self) -> xr.Dataset:
        """Return the stored responses for other programs: ``store.to_dataset().to_netcdf(path)``.

        Returns
        -------
        Dataset
            ``inputs``, dims (point, column), ``response``, dim (point) or dims (point, output), and
            ``reason``, dim (point), in the order of their storage; a reason is empty where the
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
        session = getattr(self._local, "session", None)
        if session is not None:
            session.close()
            del self._local.session

    def _n_outputs(self, session: _Session) -> int:
        first = next(iter(session.values.values()), _NAN)
        return self.outputs or len(first) // len(_NAN)

    def _as_array(self, session: _Session, values: Iterable[bytes]) -> Floats:
        """Return responses as numbers, (n,), or (n, m) of several outputs."""
        n_outputs = self._n_outputs(session)
        numbers = _numbers(values)
        return numbers if n_outputs == 1 else numbers.reshape(-1, n_outputs)

    def _read(self) -> _Session:
        """Return the session of this thread with all runs that are in the file."""
        session = getattr(self._local, "session", None)
        with self._explained():
            # A session from before a fork, or of a file that was replaced, is closed before the
            # file is opened, because closing deletes the log of writes by its name.
            if session is not None and session.opened != self._file_identity():
                session.close()
                session = None
            if session is None:
                session = self._open()
            self._read_new_runs(session)
        self._local.session = session
        return session

    def _file_identity(self) -> tuple[int, ...]:
        """Return process, device and inode of the file; an empty tuple without a file."""
        try:
            file = self.path.stat()
        except FileNotFoundError:
            return ()
        return os.getpid(), file.st_dev, file.st_ino

    def _open(self) -> _Session:
        """Open the file and check it; create it if it does not exist."""
        if self.folder.exists() and not self.folder.is_dir():
            raise StoreError(
                f"{self.name}: store: got {self.folder}, which is a file, expected a folder"
            )
        if not self.path.exists():
            create(self.path)
        connection = connect(self.path)
        try:
            check_file(self.path, connection)
            response, columns = self._response(connection)
            return _Session(connection, self._file_identity(), response, columns)
        except BaseException:
            connection.close()
            raise

    def _response(self, connection: sqlite3.Connection) -> tuple[int, int]:
        """Return row and columns of the store's response in the file; add it if it is new."""
        # If another process adds the same response first, its row is used.
        name = self.name, self.version
        responses = _responses(connection)
        if name not in responses and self.columns is not None:
            row = (self.name, self.columns, self.version)
            insert = (
                "INSERT INTO response (name, columns, version, checksum) SELECT ?, ?, ?, ? "
                "WHERE NOT EXISTS (SELECT 1 FROM response WHERE name = ? AND version IS ?)"
            )
            with transaction(connection):
                connection.execute(insert, (*row, checksum(*row), *name))
            responses = _responses(connection)
        if name not in responses:
            raise _FileError(
                f"which has no responses of simulator {_name_text(*name)}",
                f"one of [{', '.join(_name_text(*response) for response in responses)}]"
                if responses
                else "a file with responses",
                "look at name, version and folder",
            )
        _, columns = responses[name]
        if self.columns not in (None, columns):
            raise _FileError(
                f"which has inputs of {columns} values for simulator {self.name!r}",
                f"{self.columns} values",
                "nothing was changed: give the simulator another name, or pass another folder",
            )
        return responses[name]

    def _read_new_runs(self, session: _Session) -> None:
        """Read the runs that the session has not read; check their numbers and checksums."""
        select = (
            "SELECT id, response, key, state, reason, value, checksum FROM run "
            "WHERE id > ? ORDER BY id"
        )
        with closing(session.connection.execute(select, (session.n_read,))) as runs:
            for number, *row, stored_checksum in runs:
                if number != session.n_read + 1:
                    raise _damaged(f"run {session.n_read + 1} is missing")
                if stored_checksum != checksum(*row):
                    raise _damaged(f"run {number} does not match its checksum")
                response, key, state, reason, value = row
                if response == session.response:
                    self._refuse_other_outputs(session, value)
                    # The last run of a point counts, because a failed one may be repeated.
                    session.values[key] = value
                    session.failed.pop(key, None)
                    if state == "failed":
                        session.failed[key] = reason
                session.n_read = number

    def _refuse_other_outputs(self, session: _Session, value: bytes) -> None:
        """Raise if a stored run has another number of outputs."""
        n = len(value) // len(_NAN)
        expected = self._n_outputs(session)
        if (session.values and n != expected) or self.outputs not in (None, n):
            raise _FileError(
                f"which has runs with {n} outputs for simulator {self.name!r}",
                f"{expected}",
                "nothing was changed: pass version= with a name for the response as it is now",
            )

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Turn errors of the file into `StoreError`."""
        try:
            yield
        except (sqlite3.Error, _FileError) as error:
            got, expected, action = explanation(error)
            cause = error if isinstance(error, sqlite3.Error) else None
            raise StoreError(
                f"{self.name}: store: got {self.path}, {got}, expected {expected}; {action}"
            ) from cause


def _name_text(name: str, version: str | None) -> str:
    return repr(name) if version is None else f"{name!r}, version {version!r}"


def _keys(inputs: Floats) -> list[bytes]:
    return [row.tobytes() for row in np.ascontiguousarray(inputs, dtype="<f8")]


def _numbers(values: Iterable[bytes]) -> Floats:
    return np.frombuffer(bytearray(b"".join(values)), dtype="<f8").astype(np.float64)


# -- the file --------------------------------------------------------------------------------------

# Distinguishes stores from other databases (https://www.sqlite.org/pragma.html).
_APPLICATION = int.from_bytes(b"prby")
# Seconds to wait for other writers. A chunk takes 10 ms, so that a thousand writers may queue.
_PATIENCE = 60.0

# A response has a name and a version. Key and value of a run are little-endian float64, so that
# every bit is kept; the key includes the constants. Runs are numbered without gaps, so that a loss
# shows.
_TABLES = (
    "CREATE TABLE response (id INTEGER PRIMARY KEY, name TEXT NOT NULL, columns INTEGER NOT NULL, "
    "version TEXT, checksum INTEGER NOT NULL)",
    "CREATE TABLE run (id INTEGER PRIMARY KEY, response INTEGER NOT NULL, key BLOB NOT NULL, "
    "state TEXT NOT NULL, reason TEXT, value BLOB NOT NULL, checksum INTEGER NOT NULL)",
)
# Digests of the functions with which runs agree, as JSON. Older files have no such table.
_CODE = (
    "CREATE TABLE code (id INTEGER PRIMARY KEY, response INTEGER NOT NULL, digests TEXT NOT NULL, "
    "checksum INTEGER NOT NULL)"
)
INSERT_RUN = (
    "INSERT INTO run (response, key, state, reason, value, checksum) VALUES (?, ?, ?, ?, ?, ?)"
)


def checksum(*row: Any) -> int:
    """Return the checksum of a row's entries, types included."""
    return zlib.crc32(ascii(row).encode())


def create(path: Path) -> None:
    """Create an empty store, complete or not at all; an existing file is not replaced."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = _part_of(path)
    try:
        with closing(connect(part, "rwc")) as connection:
            # With a write-ahead log, readers and the writer do not wait for each other, and a
            # commit is one flush.
            connection.execute("PRAGMA journal_mode = WAL")
            with transaction(connection):
                for table in _TABLES:
                    connection.execute(table)
                connection.execute(f"PRAGMA application_id = {_APPLICATION}")
                connection.execute(f"PRAGMA user_version = {FORMAT}")
        try:
            os.link(part, path)
        except FileExistsError:
            return  # another process has created the store
        except OSError:
            part.rename(path)  # the file system has no hard links
    finally:
        part.unlink(missing_ok=True)


def _part_of(path: Path) -> Path:
    """Return a path for an unfinished file that no other process uses."""
    return path.with_name(f"{path.name[:40]}.{uuid.uuid4().hex}.part")


def replace_files(contents: Mapping[Path, bytes], name: str) -> None:
    """Write all files completely, or change none of them and raise an `OSError`."""
    parts = {}
    try:
        for path, content in contents.items():
            if path.exists() and not path.is_file():
                path.write_bytes(content)  # a device or a pipe
                continue
            target = path.resolve()  # a symbolic link stays, and its target is replaced
            part = _part_of(target)
            parts[part] = target
            with part.open("xb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            if target.exists():
                part.chmod(stat.S_IMODE(target.stat().st_mode))
        for part, target in parts.items():
            part.replace(target)
    except OSError as error:
        raise OSError(
            error.errno,
            f"{name}: got {path}, which cannot be written ({error.strerror}), expected space and "
            "the right to write there; what was there before is kept: free some space, or pass "
            "another path",
        ) from error
    finally:
        for part in parts:
            part.unlink(missing_ok=True)


@contextmanager
def only_writer(path: Path, name: str) -> Iterator[None]:
    """Lock a file until the block or the process ends; remove what killed writers left behind.

    Raises `StoreError` if it is locked, or cannot be written.
    """
    from filelock import FileLock, Timeout

    target = path.resolve()
    if not target.parent.is_dir():
        raise StoreError(f"{name}: got {path}, whose folder does not exist, expected one that does")
    if not os.access(target.parent, os.W_OK):
        raise StoreError(f"{name}: got {path}, expected a folder with the right to write there")
    lock = FileLock(target.with_name(f"{target.name}.lock"), timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        raise StoreError(
            f"{name}: got {path}, which another run is writing to, expected one run at a time; "
            "wait for its end, or pass another path"
        ) from error
    try:
        # `_part_of` truncates long names, so that such a part may belong to another file.
        if len(target.name) < 40:
            for part in target.parent.glob("*.part"):
                if re.fullmatch(re.escape(target.name) + r"\.[0-9a-f]{32}\.part", part.name):
                    part.unlink(missing_ok=True)
        yield
    finally:
        lock.release()


def connect(path: Path, mode: str = "rw") -> sqlite3.Connection:
    """Return a connection that does not trust the contents of the file."""
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?mode={mode}",
        uri=True,
        timeout=_PATIENCE,
        isolation_level=None,  # transactions are begun explicitly
        check_same_thread=False,  # the garbage collector may close it in another thread
    )
    try:
        # Precautions for files that may be damaged (https://www.sqlite.org/security.html).
        connection.execute("PRAGMA trusted_schema = OFF")
        connection.execute("PRAGMA cell_size_check = ON")
        connection.execute("PRAGMA mmap_size = 0")
        connection.execute("PRAGMA synchronous = FULL")  # a commit has been flushed to disk
    except sqlite3.Error:
        connection.close()
        raise
    return connection


@contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[None]:
    """Write all or nothing. Waiting for other writers happens at the beginning of the block."""
    connection.execute("BEGIN IMMEDIATE")
    with connection:
        yield


def check_file(path: Path, connection: sqlite3.Connection) -> None:
    """Raise if a file is damaged, or of another program or layout."""
    # SQLite takes an empty file for a new one. The smallest page has 512 bytes
    # (https://www.sqlite.org/fileformat.html).
    if path.stat().st_size < 512:
        raise _damaged("it was cut to less than a page")
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    if application != _APPLICATION:
        raise _FileError(
            "which is a database of another program",
            "a store of prbayes",
            "nothing was changed: pass another folder",
        )
    (number,) = connection.execute("PRAGMA user_version").fetchone()
    if number != FORMAT:
        raise _FileError(
            f"which has format {number}",
            f"format {FORMAT} (numbers below 10 are those of release candidates)",
            "use the version of prbayes that wrote it, or pass another folder",
        )
    tables = connection.execute("SELECT sql FROM sqlite_master ORDER BY name").fetchall()
    if [table for table in tables if table != (_CODE,)] != [(table,) for table in _TABLES]:
        raise _damaged("its tables are others")
    (result,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    last = result.splitlines()[-1]  # earlier lines only name the database
    if last != "ok":
        raise _damaged(last)


def _responses(connection: sqlite3.Connection) -> dict[tuple[str, str | None], tuple[int, int]]:
    """Return row and columns of the responses in the file, by name and version."""
    query = "SELECT id, name, columns, version, checksum FROM response ORDER BY id"
    responses = {}
    for number, *row, stored_checksum in connection.execute(query).fetchall():
        if stored_checksum != checksum(*row):
            raise _damaged(f"response {number} does not match its checksum")
        name, columns, version = row
        responses[name, version] = number, columns
    return responses


def stored_digests(store: Store) -> list[dict[str, str | None]]:
    """Return the digests of the functions with which the stored runs agree, by variable."""
    session = store._read()
    with store._explained():
        found = session.connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'code'")
        select = "SELECT response, digests, checksum FROM code ORDER BY id"
        rows = session.connection.execute(select).fetchall() if found.fetchall() else []
        for *row, stored_checksum in rows:
            if stored_checksum != checksum(*row):
                raise _damaged("the digests of a function do not match their checksum")
        return [json.loads(text) for response, text, _ in rows if response == session.response]


def add_digests(store: Store, digests: Mapping[str, str | None]) -> None:
    """Note the digests of a function with which the stored runs agree."""
    session = store._read()
    row = session.response, json.dumps(digests)
    with store._explained(), transaction(session.connection):
        session.connection.execute(_CODE.replace("TABLE", "TABLE IF NOT EXISTS"))
        insert = "INSERT INTO code (response, digests, checksum) VALUES (?, ?, ?)"
        session.connection.execute(insert, (*row, checksum(*row)))


# -- errors ----------------------------------------------------------------------------------------


class _FileError(Exception):
    """A file that is no store for this response; its arguments are got, expected, what to do."""


def _damaged(reason: str) -> _FileError:
    return _FileError(
        f"which is damaged: {reason}",
        "what was written",
        "nothing was changed: put back a copy, move the file away, or pass another folder; the "
        "program sqlite3 may recover what is left (.recover)",
    )


# Texts (got, expected, what to do) by names of SQLite errors (https://www.sqlite.org/rescode.html).
_EXPLANATIONS = {
    "FULL|IOERR_(WRITE|FSYNC|TRUNCATE|SHMSIZE)": (
        "which cannot grow",
        "space on the disk, and within its quota and the largest size of a file",
        "all that was written before is kept: free some space and run again",
    ),
    "BUSY|LOCKED": (
        f"which another process has locked for {_PATIENCE:.0f} s",
        "to wait for milliseconds",
        "end that process, if it hangs, and run again",
    ),
    "CANTOPEN|READONLY|PERM|IOERR": (
        "which cannot be opened",
        "a file that may be read and written",
        "nothing was changed: look at the rights of folder and file, or pass another folder",
    ),
}


def explanation(error: sqlite3.Error | _FileError) -> tuple[str, str, str]:
    """Return got, expected and what to do; an unknown error of SQLite is reported as damage."""
    if isinstance(error, _FileError):
        return error.args
    name = getattr(error, "sqlite_errorname", "")
    for pattern, (got, expected, action) in _EXPLANATIONS.items():
        if re.match(f"SQLITE_({pattern})", name):
            return f"{got} ({error})", expected, action
    return _damaged(f"{error!s:.200}").args  # cut, since it may quote damaged contents
