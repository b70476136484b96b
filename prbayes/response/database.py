"""The SQLite file of a store: its tables, how it is made and opened, what can be wrong."""

from __future__ import annotations

import os
import sqlite3
import uuid
import zlib
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# Tells our files from other databases (https://www.sqlite.org/pragma.html#pragma_application_id).
APPLICATION = int.from_bytes(b"prby")
# Counts the changes of the tables below: a file of another layout is refused, and not misread.
LAYOUT = 2
# Seconds to wait for other writers. By judgement: a chunk is written in some 10 ms, so that a
# thousand writers wait less, and one that hangs is told of within a minute.
PATIENCE = 60.0

# Responses are told apart by name and version. Key and value of a run are float64, little-endian:
# every bit survives, those of NaN too; a key holds the constants as well. Runs are numbered without
# a gap, so that one that is lost is missed.
TABLES = (
    "CREATE TABLE response (id INTEGER PRIMARY KEY, name TEXT NOT NULL, columns INTEGER NOT NULL, "
    "version TEXT, checksum INTEGER NOT NULL)",
    "CREATE TABLE run (id INTEGER PRIMARY KEY, response INTEGER NOT NULL, key BLOB NOT NULL, "
    "state TEXT NOT NULL, reason TEXT, value BLOB NOT NULL, checksum INTEGER NOT NULL)",
)
INSERT_RESPONSE = (
    "INSERT INTO response (name, columns, version, checksum) SELECT ?, ?, ?, ? "
    "WHERE NOT EXISTS (SELECT 1 FROM response WHERE name = ? AND version IS ?)"
)
SELECT_RESPONSES = "SELECT id, name, columns, version, checksum FROM response ORDER BY id"
INSERT_RUN = (
    "INSERT INTO run (response, key, state, reason, value, checksum) VALUES (?, ?, ?, ?, ?, ?)"
)
SELECT_RUNS = (
    "SELECT id, response, key, state, reason, value, checksum FROM run WHERE id > ? ORDER BY id"
)
# The first three are what SQLite recommends for files that may be damaged
# (https://www.sqlite.org/security.html); with the last, what is committed has been flushed to disk.
_SETTINGS = (
    "trusted_schema = OFF",
    "cell_size_check = ON",
    "mmap_size = 0",
    "synchronous = FULL",
)
# States of a run.
COMPUTED, FAILED = "computed", "failed"


@dataclass(frozen=True)
class Complaint:
    """What is wrong with a file: got, expected, what to do."""

    got: str
    expected: str
    todo: str


def damaged(what: str) -> Complaint:
    """Return the complaint about a file whose contents are not what was written."""
    return Complaint(
        f"which is damaged: {what}",
        "what was written",
        "nothing was changed: put back a copy, move the file away, or pass another folder; the "
        "program sqlite3 may recover what is left (.recover)",
    )


_CUT = damaged("it was cut to less than a page")
_FOREIGN = Complaint(
    "which is a database of another program",
    "a store of prbayes",
    "nothing was changed: pass another folder",
)
_FULL = Complaint(
    "which cannot grow",
    "space on the disk, and within its quota and the largest size of a file",
    "all that was written before is kept: free some space and run again",
)
_LOCKED = Complaint(
    f"which another process has locked for {PATIENCE:.0f} s",
    "to wait for milliseconds",
    "end that process, if it hangs, and run again",
)
_CLOSED = Complaint(
    "which cannot be opened",
    "a file that may be read and written",
    "nothing was changed: look at the rights of folder and file, or pass another folder",
)
_COMPLAINTS = {
    sqlite3.SQLITE_FULL: _FULL,
    sqlite3.SQLITE_IOERR_WRITE: _FULL,
    sqlite3.SQLITE_IOERR_FSYNC: _FULL,
    sqlite3.SQLITE_IOERR_TRUNCATE: _FULL,
    sqlite3.SQLITE_IOERR_SHMSIZE: _FULL,
    sqlite3.SQLITE_BUSY: _LOCKED,
    sqlite3.SQLITE_LOCKED: _LOCKED,
    sqlite3.SQLITE_CANTOPEN: _CLOSED,
    sqlite3.SQLITE_READONLY: _CLOSED,
    sqlite3.SQLITE_PERM: _CLOSED,
    sqlite3.SQLITE_IOERR: _CLOSED,
}


def complaint_of(error: sqlite3.Error) -> Complaint:
    """Return what SQLite reported, and what to do; what is not known to be harmless is damage."""
    code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT)
    # These bits of an extended result code make its kind (https://www.sqlite.org/rescode.html).
    known = _COMPLAINTS.get(code) or _COMPLAINTS.get(code & 0xFF)
    if known is None:
        return damaged(f"{error!s:.200}")  # it may quote what is damaged
    return Complaint(f"{known.got} ({error})", known.expected, known.todo)


def create(path: Path) -> None:
    """Make an empty store; it appears whole or not at all, and takes the place of none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{uuid.uuid4().hex}.part")
    try:
        _fill(part)
        try:
            os.link(part, path)
        except FileExistsError:
            return  # another process was faster
        except OSError:
            part.rename(path)  # a file system without links
    finally:
        part.unlink(missing_ok=True)


def _fill(path: Path) -> None:
    with closing(connected(path, "rwc")) as connection:
        # Readers do not wait for the writer, nor the writer for them; and a commit is one flush.
        connection.execute("PRAGMA journal_mode = WAL")
        with transaction(connection):
            for table in TABLES:
                connection.execute(table)
            connection.execute(f"PRAGMA application_id = {APPLICATION}")
            connection.execute(f"PRAGMA user_version = {LAYOUT}")


def connected(path: Path, mode: str = "rw") -> sqlite3.Connection:
    """Return a connection that takes nothing in the file on trust."""
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?mode={mode}",
        uri=True,
        timeout=PATIENCE,
        isolation_level=None,  # transactions begin where the code says so
        check_same_thread=False,  # the garbage collector may close it in another thread
    )
    try:
        for setting in _SETTINGS:
            connection.execute(f"PRAGMA {setting}")
    except sqlite3.Error:
        connection.close()
        raise
    return connection


def complaint_about(path: Path, connection: sqlite3.Connection) -> Complaint | None:
    """Return what is wrong with a file as a whole."""
    # The smallest page (https://www.sqlite.org/fileformat.html): SQLite takes a file that was cut
    # to nothing for a new one.
    if path.stat().st_size < 512:
        return _CUT
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    if application != APPLICATION:
        return _FOREIGN
    (layout,) = connection.execute("PRAGMA user_version").fetchone()
    if layout != LAYOUT:
        todo = "use the version of prbayes that wrote it, or pass another folder"
        return Complaint(f"which has layout {layout}", f"layout {LAYOUT}", todo)
    tables = connection.execute("SELECT sql FROM sqlite_master ORDER BY name").fetchall()
    if tables != [(table,) for table in TABLES]:
        return damaged("its tables are others")
    (found,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    *_, last = found.splitlines()  # the lines before say which database
    return None if last == "ok" else damaged(last)


@contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[None]:
    """Write all or nothing; other writers are waited for at the beginning, not in the middle."""
    connection.execute("BEGIN IMMEDIATE")
    with connection:
        yield


def checksum(*row: Any) -> int:
    """Return the checksum of a row's entries, types included."""
    return zlib.crc32(ascii(row).encode())
