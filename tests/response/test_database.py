"""The file of a store: made whole and once, opened without trust, complaints in words."""

from __future__ import annotations

import os
import sqlite3
import threading
from contextlib import closing
from pathlib import Path

import pytest

from prbayes.response.database import (
    INSERT_RUN,
    checksum,
    complaint_about,
    complaint_of,
    connected,
    create,
    transaction,
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    create(tmp_path / "r.sqlite")
    return tmp_path / "r.sqlite"


def runs(path: Path) -> int:
    with closing(connected(path)) as connection:
        return int(connection.execute("SELECT count(*) FROM run").fetchone()[0])


def test_a_new_file_is_sound_and_leaves_nothing_beside_it(path: Path) -> None:
    assert [p.name for p in path.parent.iterdir()] == ["r.sqlite"]
    with closing(connected(path)) as connection:
        assert complaint_about(path, connection) is None
        assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)
        assert connection.execute("PRAGMA synchronous").fetchone() == (2,)


def test_a_file_that_is_there_is_not_replaced(path: Path) -> None:
    with closing(connected(path)) as connection, transaction(connection):
        connection.execute(INSERT_RUN, (1, b"", "computed", None, b"", 0))
    create(path)
    assert runs(path) == 1
    assert [p.name for p in path.parent.iterdir()] == ["r.sqlite"]


def test_many_may_make_it_at_once(tmp_path: Path) -> None:
    path = tmp_path / "new" / "r.sqlite"
    threads = [threading.Thread(target=create, args=(path,)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [p.name for p in path.parent.iterdir()] == ["r.sqlite"]
    assert runs(path) == 0


def test_a_file_system_without_links_will_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def link(*_: object) -> None:
        raise PermissionError("no links here")

    monkeypatch.setattr(os, "link", link)
    create(tmp_path / "r.sqlite")
    assert [p.name for p in tmp_path.iterdir()] == ["r.sqlite"]
    assert runs(tmp_path / "r.sqlite") == 0


def test_nothing_of_a_transaction_that_fails_is_written(path: Path) -> None:
    def write(connection: sqlite3.Connection, *values: bytes | None) -> None:
        with transaction(connection):
            for value in values:
                connection.execute(INSERT_RUN, (1, b"", "computed", None, value, 0))

    with closing(connected(path)) as connection:
        with pytest.raises(sqlite3.IntegrityError, match="NOT NULL"):
            write(connection, b"first", None)
        assert runs(path) == 0
        write(connection, b"first")
    assert runs(path) == 1


def test_a_checksum_tells_bits_types_and_order_apart() -> None:
    row = (1, b"key", "computed", None, b"value")
    others = [
        (2, b"key", "computed", None, b"value"),
        (1, b"kez", "computed", None, b"value"),
        (1, b"key", "computed", "None", b"value"),
        (1, "key", "computed", None, b"value"),
        (1, b"value", "computed", None, b"key"),
        (1, b"keyv", "computed", None, b"alue"),
        (1.0, b"key", "computed", None, b"value"),
    ]
    assert checksum(*row) == 0xB6772A52  # files in use rest on it
    assert len({checksum(*r) for r in [row, *others]}) == 8


def test_paths_of_any_kind_are_opened(tmp_path: Path) -> None:
    path = tmp_path / "a b?c#d%20é" / "r.sqlite"
    create(path)
    assert runs(path) == 0
    assert [p.name for p in tmp_path.iterdir()] == ["a b?c#d%20é"]


def test_what_sqlite_reports_becomes_words(tmp_path: Path) -> None:
    with pytest.raises(sqlite3.OperationalError) as missing:
        connected(tmp_path / "missing")
    assert complaint_of(missing.value).got.startswith("which cannot be opened (unable to open")
    assert not (tmp_path / "missing").exists()
    (tmp_path / "text").write_text("no database " * 200)
    with pytest.raises(sqlite3.DatabaseError) as text:
        connected(tmp_path / "text").execute("PRAGMA user_version")
    assert complaint_of(text.value).got == "which is damaged: file is not a database"
    unknown = complaint_of(sqlite3.InterfaceError("something new"))
    assert unknown.got == "which is damaged: something new"
