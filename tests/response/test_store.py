"""The store: what was added is found, what was changed is named; `tests/faults` attacks its file."""

from __future__ import annotations

import errno
import os
import pickle
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from prbayes.response.store import (
    INSERT_RUN,
    Store,
    StoreError,
    check_file,
    checksum,
    connect,
    create,
    explanation,
    replace_files,
    transaction,
)

KEYS = np.random.default_rng(1).normal(size=(300, 3))
VALUES = KEYS @ [1.0, 10.0, 100.0]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A store of 300 responses of y and 40 of z, closed."""
    path = tmp_path / "store"
    store, other = Store(path, "y", columns=3), Store(path, "z", columns=1)
    for rows in np.array_split(np.arange(300), 6):
        store.add(KEYS[rows], VALUES[rows])
    other.add(KEYS[:40, :1], VALUES[:40])
    assert sorted(p.name for p in path.iterdir()) == [
        "responses.sqlite",
        "responses.sqlite-shm",
        "responses.sqlite-wal",
    ]
    store.close()
    other.close()
    assert [p.name for p in path.iterdir()] == ["responses.sqlite"]
    return path


def file_of(folder: Path) -> Path:
    return folder / "responses.sqlite"


def all_right(store: Store) -> bool:
    values, known = store.find(KEYS)
    return bool(known.all()) and bool(np.array_equal(values, VALUES))


# -- finding -------------------------------------------------------------------------------------


def test_what_was_added_is_found_by_this_store_and_the_next(folder: Path) -> None:
    new = Store(folder / "a" / "b", "y", columns=3)
    assert not new.find(KEYS)[1].any()
    assert new.find(KEYS[:0])[0].shape == (0,)
    assert len(new) == 0
    store = Store(folder, "y", columns=3)
    assert all_right(store)
    assert len(store) == 300
    assert len(Store(folder, "z", columns=1)) == 40
    elsewhere = KEYS + 1e-15 * np.sign(KEYS)
    values, known = store.find(elsewhere[(elsewhere != KEYS).any(axis=1)])
    assert not known.any()
    assert np.isnan(values).all()
    store.add(elsewhere[:1], np.array([7.0]))
    assert len(store) == 301
    assert Store(folder, "y", columns=3).find(elsewhere[:1])[0] == 7.0


def test_every_bit_of_inputs_and_responses_survives(tmp_path: Path) -> None:
    payload = np.array([0x7FF8000000000123, 0xFFF8000000000001], dtype="<u8").view("<f8")
    special = [0.0, -0.0, np.inf, -np.inf, 5e-324, -1.7976931348623157e308, 0.1, np.nan, *payload]
    values = np.array(special)
    store = Store(tmp_path, "y", columns=1)
    store.add(values[:, None], values[::-1])
    for found, known in (
        store.find(values[:, None]),
        Store(tmp_path, "y", columns=1).find(values[:, None]),
    ):
        assert known.all()
        np.testing.assert_array_equal(found.view(np.uint64), values[::-1].view(np.uint64))


def test_columns_are_told_apart_and_the_last_response_at_a_point_counts(tmp_path: Path) -> None:
    store = Store(tmp_path, "y", columns=2)
    keys = np.array([[1.0, 2.0], [2.0, 1.0], [0.5, 0.5]])
    store.add(keys, np.array([12.0, 21.0, np.nan]), {2: "no licence"})
    assert store.failed(keys) == {2: "no licence"}
    store.add(keys[2:], np.array([np.nan]))
    for again in (store, Store(tmp_path, "y", columns=2)):
        values, known = again.find(keys[::-1])
        np.testing.assert_array_equal(values, [np.nan, 21.0, 12.0])
        assert known.all()
        assert (len(again), again.failed(keys)) == (3, {})
    with closing(sqlite3.connect(store.path)) as connection:
        found = connection.execute("SELECT state, reason FROM run ORDER BY id").fetchall()
    computed = ("computed", None)
    assert found == [computed, computed, ("failed", "no licence"), computed]


def test_names_of_any_kind_have_their_own_responses(tmp_path: Path) -> None:
    names = ["y", "Y", "y ", "größe/2", "a'); DROP TABLE run; --", "../y"]
    for i, name in enumerate(names):
        Store(tmp_path / "s", name, columns=1).add(np.zeros((1, 1)), np.array([float(i)]))
    for i, name in enumerate(names):
        assert Store(tmp_path / "s", name, columns=1).find(np.zeros((1, 1)))[0] == i
    assert {p.name.split("-")[0] for p in (tmp_path / "s").iterdir()} == {"responses.sqlite"}
    assert [p.name for p in tmp_path.iterdir()] == ["s"]


def test_responses_go_to_other_programs_as_a_data_set(folder: Path, tmp_path: Path) -> None:
    Store(folder, "y").to_dataset().to_netcdf(tmp_path / "y.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "y.nc", engine="h5netcdf") as data:
        np.testing.assert_array_equal(data["inputs"], KEYS)
        np.testing.assert_array_equal(data["response"], VALUES)
        assert data.attrs["simulator"] == "y"
    assert Store(tmp_path / "new", "y", columns=2).to_dataset()["inputs"].shape == (0, 2)


# -- closed, sent elsewhere, removed -------------------------------------------------------------


def test_a_store_is_pickled_as_folder_and_name_and_opens_again(folder: Path) -> None:
    store = Store(folder, "y", columns=3)
    text = pickle.dumps(store)
    assert len(text) < 500
    assert all_right(pickle.loads(text))
    store.close()
    store.close()
    assert all_right(store)


def test_a_store_that_was_removed_begins_anew(folder: Path) -> None:
    store = Store(folder, "y", columns=3)
    assert all_right(store)
    for path in folder.iterdir():
        path.unlink()
    store.add(KEYS[:2], VALUES[:2])
    assert len(store) == len(Store(folder, "y", columns=3)) == 2
    assert (folder / "responses.sqlite-wal").exists()  # not deleted with the file before


# -- damage --------------------------------------------------------------------------------------


def changed(folder: Path, statement: str, *values: object) -> None:
    with closing(sqlite3.connect(file_of(folder))) as connection, connection:
        connection.execute(statement, values)


def refused(folder: Path, match: str) -> None:
    """Check that a store is refused with a sentence, and left as it is."""
    before = file_of(folder).read_bytes()
    with pytest.raises(StoreError, match=rf"y: store: got .*responses.sqlite, {match}"):
        Store(folder, "y", columns=3)
    assert file_of(folder).read_bytes() == before


CHANGED = "run 17 does not match its checksum, expected .*put back"


@pytest.mark.parametrize(
    ("statement", "values", "damage"),
    [
        ("UPDATE run SET value = ? WHERE id = 17", [np.array(99.0).tobytes()], CHANGED),
        ("UPDATE run SET key = ? WHERE id = 17", [np.zeros(3).tobytes()], CHANGED),
        ("UPDATE run SET state = 'failed' WHERE id = 17", [], CHANGED),
        ("UPDATE run SET checksum = 1 WHERE id = 17", [], CHANGED),
        (
            "UPDATE run SET key = (SELECT key FROM run AS other WHERE other.id = 7 - run.id) "
            "WHERE id IN (3, 4)",
            [],
            "run 3 does not match",
        ),
        ("DELETE FROM run WHERE id = 5", [], "run 5 is missing"),
        ("UPDATE response SET name = 'x' WHERE name = 'y'", [], "response 1 does not match its"),
    ],
)
def test_a_row_that_was_changed_is_named(
    statement: str, values: list[bytes], damage: str, folder: Path
) -> None:
    changed(folder, statement, *values)
    refused(folder, f"which is damaged: {damage}")


def test_damage_that_happens_during_a_run_is_noticed(folder: Path) -> None:
    store = Store(folder, "y", columns=3)
    insert = (
        "INSERT INTO run (response, key, state, value, checksum) VALUES (1, ?, 'computed', ?, 0)"
    )
    changed(folder, insert, KEYS[0].tobytes(), b"12345678")
    with pytest.raises(StoreError, match="run 341 does not match its checksum"):
        store.find(KEYS)


def test_what_is_no_store_is_refused(folder: Path, tmp_path: Path) -> None:
    path = file_of(folder)
    path.write_bytes(b"not a file of ours " * 99)
    refused(folder, "which is damaged: file is not a database")
    path.unlink()
    connection = sqlite3.connect(path)
    with connection:
        connection.execute("CREATE TABLE run (id INTEGER)")
    refused(folder, "which is a database of another program, expected a store of prbayes; nothing")
    path.unlink()
    path.mkdir()
    with pytest.raises(StoreError, match=r"responses\.sqlite, which cannot be opened \(unable to"):
        Store(folder, "y", columns=3)
    connection.close()
    (tmp_path / "file").touch()
    with pytest.raises(StoreError, match=r"got .*file, which is a file, expected a folder"):
        Store(tmp_path / "file", "y", columns=3)


def test_another_format_and_other_inputs_are_refused(folder: Path) -> None:
    held = r"y: store: .* has inputs of 3 values for simulator 'y', expected 2 values; no"
    with pytest.raises(StoreError, match=held):
        Store(folder, "y", columns=2)
    with pytest.raises(
        StoreError, match=r"no responses of simulator 'x', expected one of \['y', 'z'\]"
    ):
        Store(folder, "x")
    with pytest.raises(StoreError, match="'x', expected a file with responses; look at name"):
        Store(folder / "empty", "x")
    assert all_right(Store(folder, "y", columns=3))
    changed(folder, "PRAGMA user_version = 3")
    refused(
        folder, r"which has format 3, expected format 10 \(numbers below 10 are .*use the version"
    )


# -- a disk that is full, a file that is locked --------------------------------------------------


def test_a_full_disk_is_named_and_the_store_works_again_with_space(folder: Path) -> None:
    store = Store(folder, "y", columns=3)
    connection = store._read().connection
    (pages,) = connection.execute("PRAGMA page_count").fetchone()
    (most,) = connection.execute(f"PRAGMA max_page_count = {pages + 1}").fetchone()
    assert most == pages + 1
    more = np.random.default_rng(4).normal(size=(1000, 3))
    with pytest.raises(
        StoreError, match=r"cannot grow \(database or disk is full\).*free some space"
    ):
        store.add(more, more[:, 0])
    # Nothing of the chunk is there, all else is; also for another process.
    for again in (store, Store(folder, "y", columns=3)):
        assert all_right(again)
        assert len(again) == 300
    connection.execute("PRAGMA max_page_count = 1000000")
    store.add(more, more[:, 0])
    values, known = Store(folder, "y", columns=3).find(more)
    assert known.all()
    np.testing.assert_array_equal(values, more[:, 0])
    assert len(store) == 1300


def test_a_writer_that_hangs_is_reported(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("prbayes.response.store._PATIENCE", 0.05)
    store = Store(folder, "y", columns=3)
    hanging = sqlite3.connect(file_of(folder), isolation_level=None)
    hanging.execute("BEGIN IMMEDIATE")
    assert all_right(store)  # readers do not wait
    with pytest.raises(StoreError, match=r"which another process has locked .*run again"):
        store.add(KEYS[:1], VALUES[:1])
    hanging.execute("ROLLBACK")
    hanging.close()
    store.add(KEYS[:1], VALUES[:1])


# -- the file ------------------------------------------------------------------------------------


def runs(path: Path) -> int:
    with closing(connect(path)) as connection:
        return int(connection.execute("SELECT count(*) FROM run").fetchone()[0])


@pytest.mark.parametrize("has_links", [True, False])
def test_a_new_file_is_sound_and_replaces_none(
    has_links: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def link(*_: object) -> None:
        raise PermissionError("no links here")

    if not has_links:
        monkeypatch.setattr(os, "link", link)
    path = tmp_path / "a b?c#d%20é" / "r.sqlite"
    create(path)
    with closing(connect(path)) as connection:
        check_file(path, connection)
        assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)
        assert connection.execute("PRAGMA synchronous").fetchone() == (2,)
        with transaction(connection):
            connection.execute(INSERT_RUN, (1, b"", "computed", None, b"", 0))
    if has_links:
        create(path)
    assert runs(path) == 1
    assert [p.name for p in path.parent.iterdir()] == ["r.sqlite"]
    assert [p.name for p in tmp_path.iterdir()] == ["a b?c#d%20é"]


def test_files_are_replaced_together_or_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second, link = (tmp_path / name for name in ("a.html", "b.svg", "link"))
    first.write_text("old")
    first.chmod(0o640)
    link.symlink_to(first)
    flush, seen = os.fsync, list[int]()

    def full(file: int) -> None:
        seen.append(file)
        if len(seen) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        flush(file)

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match=r"Report: got .*b.svg, .*No space left.*is kept: free") as e:
        replace_files({first: b"new", second: b"picture"}, "Report")
    assert e.value.errno == errno.ENOSPC
    assert first.read_text() == "old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.html", "link"]
    replace_files({link: b"new", second: b"picture", Path(os.devnull): b"x"}, "Report")
    assert (first.read_bytes(), second.read_bytes()) == (b"new", b"picture")
    assert link.is_symlink()
    assert first.stat().st_mode & 0o777 == 0o640
    with pytest.raises(FileNotFoundError, match="cannot be written"):
        replace_files({tmp_path / "none" / "a": b""}, "Report")


def test_a_checksum_is_that_of_files_in_use() -> None:
    assert checksum(1, b"key", "computed", None, b"value") == 0xB6772A52
    assert checksum(1, b"key", "computed", "None", b"value") != 0xB6772A52


def test_an_unknown_error_of_sqlite_is_damage() -> None:
    unknown, *_ = explanation(sqlite3.InterfaceError("something new"))
    assert unknown == "which is damaged: something new"
