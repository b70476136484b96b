"""The store: nothing is lost and nothing misread; several writers, kills, damage, full disks."""

from __future__ import annotations

import pickle
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import prbayes
from prbayes.response.store import Store, StoreError

KEYS = np.random.default_rng(1).normal(size=(300, 3))
VALUES = KEYS @ [1.0, 10.0, 100.0]
PACKAGE = str(Path(prbayes.__file__).parent)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A store of 300 responses of y and 40 of z, closed."""
    path = tmp_path / "store"
    store, other = Store(path, "y", 3), Store(path, "z", 1)
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
    store = Store(folder, "y", 3)
    assert all_right(store)
    assert len(store) == 300
    assert len(Store(folder, "z", 1)) == 40
    elsewhere = KEYS + 1e-15 * np.sign(KEYS)
    values, known = store.find(elsewhere[(elsewhere != KEYS).any(axis=1)])
    assert not known.any()
    assert np.isnan(values).all()
    store.add(elsewhere[:1], np.array([7.0]))
    assert len(store) == 301
    assert Store(folder, "y", 3).find(elsewhere[:1])[0] == 7.0


def test_nothing_is_found_in_a_new_store_nor_for_no_inputs(tmp_path: Path) -> None:
    store = Store(tmp_path / "a" / "b", "y", 2)
    values, known = store.find(np.zeros((2, 2)))
    np.testing.assert_array_equal(known, [False, False])
    np.testing.assert_array_equal(values, [np.nan, np.nan])
    values, known = store.find(np.zeros((0, 2)))
    assert values.shape == known.shape == (0,)
    assert len(store) == 0


def test_every_bit_of_inputs_and_responses_survives(tmp_path: Path) -> None:
    payload = np.array([0x7FF8000000000123, 0xFFF8000000000001], dtype="<u8").view("<f8")
    special = [0.0, -0.0, np.inf, -np.inf, 5e-324, -1.7976931348623157e308, 0.1, np.nan, *payload]
    values = np.array(special)
    store = Store(tmp_path, "y", 1)
    store.add(values[:, None], values[::-1])
    for found, known in (
        store.find(values[:, None]),
        Store(tmp_path, "y", 1).find(values[:, None]),
    ):
        assert known.all()
        np.testing.assert_array_equal(found.view(np.uint64), values[::-1].view(np.uint64))


def test_columns_are_told_apart(tmp_path: Path) -> None:
    store = Store(tmp_path, "y", 2)
    store.add(np.array([[1.0, 2.0], [2.0, 1.0]]), np.array([12.0, 21.0]))
    values, _ = store.find(np.array([[2.0, 1.0], [1.0, 2.0]]))
    np.testing.assert_array_equal(values, [21.0, 12.0])


def test_the_last_of_two_responses_at_one_point_holds(tmp_path: Path) -> None:
    store = Store(tmp_path, "y", 1)
    for value in (1.0, 2.0):
        store.add(np.array([[0.5]]), np.array([value]))
    for again in (store, Store(tmp_path, "y", 1)):
        assert again.find(np.array([[0.5]]))[0] == 2.0
        assert len(again) == 1


def test_why_a_response_failed_is_kept(tmp_path: Path) -> None:
    store = Store(tmp_path, "y", 1)
    store.add(np.arange(3.0)[:, None], np.array([1.0, np.nan, np.nan]), {1: "no licence"})
    with sqlite3.connect(store.path) as connection:
        found = connection.execute("SELECT state, reason FROM run ORDER BY id").fetchall()
    connection.close()
    assert found == [("computed", None), ("failed", "no licence"), ("computed", None)]
    assert store.find(np.arange(3.0)[:, None])[1].all()  # as yet a failure is found, too


def test_names_of_any_kind_have_their_own_responses(tmp_path: Path) -> None:
    names = ["y", "Y", "y ", "größe/2", "a'); DROP TABLE run; --", "../y"]
    for i, name in enumerate(names):
        Store(tmp_path / "s", name, 1).add(np.zeros((1, 1)), np.array([float(i)]))
    for i, name in enumerate(names):
        assert Store(tmp_path / "s", name, 1).find(np.zeros((1, 1)))[0] == i
    assert {p.name.split("-")[0] for p in (tmp_path / "s").iterdir()} == {"responses.sqlite"}
    assert [p.name for p in tmp_path.iterdir()] == ["s"]


@pytest.mark.parametrize("name", ["y%2f1.nc", "y%2f1.journal"])
def test_files_of_an_older_version_are_refused_and_not_ignored(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"prbayes1")
    with pytest.raises(StoreError, match=rf"y/1: store: .*beside {name}.*older version.*move it"):
        Store(tmp_path, "y/1", 2)
    assert (tmp_path / name).read_bytes() == b"prbayes1"
    assert len(Store(tmp_path, "z", 2)) == 0
    (tmp_path / name).unlink()
    assert len(Store(tmp_path, "y/1", 2)) == 0


def test_responses_go_to_other_programs_as_a_data_set(folder: Path, tmp_path: Path) -> None:
    Store(folder, "y").to_dataset().to_netcdf(tmp_path / "y.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "y.nc", engine="h5netcdf") as data:
        np.testing.assert_array_equal(data["inputs"], KEYS)
        np.testing.assert_array_equal(data["response"], VALUES)
        assert data.attrs["simulator"] == "y"
    assert Store(tmp_path / "new", "y", 2).to_dataset()["inputs"].shape == (0, 2)


def test_a_hundred_thousand_responses_take_a_second_or_two(tmp_path: Path) -> None:
    keys = np.random.default_rng(2).normal(size=(100_000, 5))
    store = Store(tmp_path, "y", 5)
    clock = time.process_time()
    for i in range(0, len(keys), 1000):
        store.add(keys[i : i + 1000], keys[i : i + 1000, 0])
    values, known = store.find(keys)
    spent = time.process_time() - clock
    assert known.all()
    np.testing.assert_array_equal(values, keys[:, 0])
    assert spent < 5.0  # about 1 s on an idle machine


# -- several at once -----------------------------------------------------------------------------

WRITER = """
import sys, types, numpy as np

# The package without PyMC, which takes seconds to import.
sys.modules["prbayes"] = types.ModuleType("prbayes")
sys.modules["prbayes"].__path__ = [sys.argv[4]]
from prbayes.response.store import Store

folder, number, chunks = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
store = Store(folder, "y", 2)
print("ready", flush=True)
sys.stdin.readline()
for i in range(chunks):
    keys = np.column_stack([np.full(5, float(number)), 5.0 * i + np.arange(5)])
    store.add(keys, keys @ [1e6, 1.0])
    print(i, flush=True)
both = np.array([(n, k) for n in range(2) for k in range(5 * chunks)], dtype=float)
print("done", flush=True)
sys.stdin.readline()
values, known = store.find(both)
print(int(known.sum()), int((values == both @ [1e6, 1.0]).sum()), flush=True)
"""


def writer(folder: Path, number: int, chunks: int) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", WRITER, str(folder), str(number), str(chunks), PACKAGE],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def told(process: subprocess.Popen[str], word: str) -> None:
    """Wait until a process says a word."""
    assert process.stdout is not None
    for line in process.stdout:
        if line.strip() == word:
            return
    pytest.fail("the process ended")


def go_on(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()


def test_two_processes_that_write_at_once_lose_nothing_and_find_all(tmp_path: Path) -> None:
    processes = [writer(tmp_path, number, 60) for number in range(2)]
    # Both make the store, write at the same time, and then look for the other's responses.
    for word in ("ready", "done"):
        for process in processes:
            told(process, word)
        for process in processes:
            go_on(process)
    for process in processes:
        assert process.communicate()[0] == "600 600\n"
        assert process.returncode == 0
    assert len(Store(tmp_path, "y", 2)) == 600


def test_a_writer_that_is_killed_leaves_all_that_it_committed(tmp_path: Path) -> None:
    process = writer(tmp_path, 0, 100_000)
    told(process, "ready")
    go_on(process)
    told(process, "20")
    process.send_signal(signal.SIGKILL)
    out = process.communicate()[0].splitlines()
    assert process.returncode == -signal.SIGKILL
    said = 5 * (int(out[-1]) + 1) if out else 105
    store = Store(tmp_path, "y", 2)
    # The kill may fall between a commit and the word of it.
    assert len(store) in (said, said + 5)
    keys = np.column_stack([np.zeros(said), np.arange(said)])
    values, known = store.find(keys)
    assert known.all()
    np.testing.assert_array_equal(values, np.arange(said))
    store.add(np.array([[7.0, 7.0]]), np.array([7.0]))
    assert Store(tmp_path, "y", 2).find(np.array([[7.0, 7.0]]))[0] == 7.0


def in_thread(store: Store, number: int) -> None:
    for i in range(20):
        store.add(np.array([[number, i]], dtype=float), np.array([100.0 * number + i]))


def test_threads_share_a_store_object(tmp_path: Path) -> None:
    store = Store(tmp_path, "y", 2)
    threads = [threading.Thread(target=in_thread, args=(store, n)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    keys = np.array([(n, i) for n in range(4) for i in range(20)], dtype=float)
    values, known = store.find(keys)
    assert known.all()
    np.testing.assert_array_equal(values, keys @ [100.0, 1.0])


def in_child(store: Store) -> None:
    inherited = store._local.session
    assert len(store) == 1
    store.add(np.array([[2.0]]), np.array([20.0]))
    # The parent's connection is neither used nor closed.
    assert store._local.session.connection is not inherited.connection
    inherited.connection.execute("PRAGMA user_version")


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_store_survives_a_fork(tmp_path: Path) -> None:
    store = Store(tmp_path, "y", 1)
    store.add(np.array([[1.0]]), np.array([10.0]))
    process = get_context("fork").Process(target=in_child, args=(store,))
    process.start()
    process.join()
    assert process.exitcode == 0
    store.add(np.array([[3.0]]), np.array([30.0]))
    values, known = store.find(np.array([[1.0], [2.0], [3.0]]))
    assert known.all()
    np.testing.assert_array_equal(values, [10.0, 20.0, 30.0])


def test_a_pickled_store_is_folder_and_name(folder: Path) -> None:
    text = pickle.dumps(Store(folder, "y", 3))
    assert len(text) < 500
    assert all_right(pickle.loads(text))


def test_a_store_that_was_closed_opens_again(folder: Path) -> None:
    store = Store(folder, "y", 3)
    store.close()
    store.close()
    assert [p.name for p in folder.iterdir()] == ["responses.sqlite"]
    assert all_right(store)


def test_a_store_that_was_removed_begins_anew(folder: Path) -> None:
    store = Store(folder, "y", 3)
    assert all_right(store)
    for path in folder.iterdir():
        path.unlink()
    store.add(KEYS[:2], VALUES[:2])
    assert len(store) == len(Store(folder, "y", 3)) == 2
    assert (folder / "responses.sqlite-wal").exists()  # not deleted with the file before


# -- damage --------------------------------------------------------------------------------------


def refused(folder: Path, match: str) -> None:
    """A store that is refused, with a sentence, and left as it is."""
    before = file_of(folder).read_bytes()
    with pytest.raises(StoreError, match=rf"y: store: got .*responses.sqlite, {match}"):
        Store(folder, "y", 3)
    assert file_of(folder).read_bytes() == before


@pytest.mark.parametrize("part", [slice(None), slice(0, 200)], ids=["file", "header"])
def test_flipped_bits_never_give_a_wrong_number_silently(part: slice, folder: Path) -> None:
    path, rng = file_of(folder), np.random.default_rng(3)
    sound = path.read_bytes()
    places = np.arange(len(sound))[part]
    refusals = 0
    for place in rng.choice(places, 200, replace=False):
        damaged = bytearray(sound)
        damaged[place] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        try:
            # Where nothing is said the bit was in use by nothing: all is found, and right.
            store = Store(folder, "y", 3)
        except StoreError:
            refusals += 1
        else:
            assert all_right(store)
            store.close()
        for left in folder.iterdir():
            if left != path:
                left.unlink()
    assert 50 < refusals < 200


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("value", np.array(99.0, dtype="<f8").tobytes()),
        ("key", np.zeros(3, dtype="<f8").tobytes()),
        ("response", 2),
        ("state", "failed"),
        ("reason", "none"),
        ("checksum", 1),
        ("value", "text"),
    ],
)
def test_a_row_that_was_changed_is_named(column: str, value: object, folder: Path) -> None:
    connection = sqlite3.connect(file_of(folder))
    with connection:
        connection.execute(f"UPDATE run SET {column} = ? WHERE id = 17", (value,))
    connection.close()
    refused(folder, r"which is damaged: run 17 does not match its checksum, expected .*put back")


def test_keys_that_were_swapped_are_named(folder: Path) -> None:
    connection = sqlite3.connect(file_of(folder))
    with connection:
        ((one,), (two,)) = connection.execute("SELECT key FROM run WHERE id IN (3, 4)").fetchall()
        connection.execute("UPDATE run SET key = ? WHERE id = 3", (two,))
        connection.execute("UPDATE run SET key = ? WHERE id = 4", (one,))
    connection.close()
    refused(folder, "which is damaged: run 3 does not match")


def test_a_row_that_is_gone_is_missed(folder: Path) -> None:
    connection = sqlite3.connect(file_of(folder))
    with connection:
        connection.execute("DELETE FROM run WHERE id = 5")
    connection.close()
    refused(folder, "which is damaged: run 5 is missing")


def test_a_response_of_another_name_is_noticed(folder: Path) -> None:
    connection = sqlite3.connect(file_of(folder))
    with connection:
        connection.execute("UPDATE response SET name = 'x' WHERE name = 'y'")
    connection.close()
    refused(folder, "which is damaged: response 1 does not match its checksum")


def test_damage_that_happens_during_a_run_is_noticed(folder: Path) -> None:
    store = Store(folder, "y", 3)
    connection = sqlite3.connect(file_of(folder))
    with connection:
        connection.execute(
            "INSERT INTO run (response, key, state, value, checksum) "
            "VALUES (1, ?, 'computed', ?, 0)",
            (KEYS[0].tobytes(), b"12345678"),
        )
    connection.close()
    with pytest.raises(StoreError, match="run 341 does not match its checksum"):
        store.find(KEYS)


def test_zeros_at_the_end_are_no_damage(folder: Path) -> None:
    path = file_of(folder)
    for size in (1, 100, 4096, 50_000):
        with path.open("ab") as file:
            file.write(bytes(size))
        store = Store(folder, "y", 3)
        assert all_right(store)
        store.add(np.full((1, 3), float(size)), np.array([1.0 * size]))
        assert Store(folder, "y", 3).find(np.full((1, 3), float(size)))[0] == size
        store.close()


def test_an_end_of_zeros_is_refused(folder: Path) -> None:
    # What a power cut may leave: the length is right, the last pages never arrived.
    path = file_of(folder)
    text = path.read_bytes()
    path.write_bytes(text[:-6000] + bytes(6000))
    refused(folder, "which is damaged: ")


def test_zeros_at_the_end_of_the_log_are_no_damage(tmp_path: Path) -> None:
    process = writer(tmp_path, 0, 100_000)
    told(process, "ready")
    go_on(process)
    told(process, "20")
    process.send_signal(signal.SIGKILL)
    process.communicate()
    log = tmp_path / "responses.sqlite-wal"
    with log.open("ab") as file:
        file.write(bytes(10_000))
    assert len(Store(tmp_path, "y", 2)) >= 105


@pytest.mark.parametrize("size", [0, 1, 50, 100, 4096, 20_000])
def test_a_file_that_was_cut_is_refused(size: int, folder: Path) -> None:
    path = file_of(folder)
    path.write_bytes(path.read_bytes()[:size])
    refused(folder, "which is damaged: .*, expected what was written; nothing was changed")


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
    with pytest.raises(StoreError, match=r"responses\.sqlite"):
        Store(folder, "y", 3)
    connection.close()
    (tmp_path / "file").touch()
    with pytest.raises(StoreError, match=r"got .*file, which is a file, expected a folder"):
        Store(tmp_path / "file", "y", 3)


def test_another_layout_is_refused(folder: Path) -> None:
    connection = sqlite3.connect(file_of(folder))
    connection.execute("PRAGMA user_version = 3")
    connection.close()
    refused(
        folder, "which has layout 3, expected layout 2; use the version of prbayes that wrote it"
    )


def test_other_inputs_are_refused(folder: Path) -> None:
    with pytest.raises(
        StoreError,
        match=r"y: store: .* holds inputs of 3 values for simulator 'y', expected 2 values; no",
    ):
        Store(folder, "y", 2)
    assert all_right(Store(folder, "y", 3))
    with pytest.raises(
        StoreError, match=r"no responses of simulator 'x', expected one of \['y', 'z'\]"
    ):
        Store(folder, "x")


# -- a disk that is full, a file that is locked --------------------------------------------------


def test_a_full_disk_is_named_and_the_store_works_again_with_space(folder: Path) -> None:
    store = Store(folder, "y", 3)
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
    for again in (store, Store(folder, "y", 3)):
        assert all_right(again)
        assert len(again) == 300
    connection.execute("PRAGMA max_page_count = 1000000")
    store.add(more, more[:, 0])
    values, known = Store(folder, "y", 3).find(more)
    assert known.all()
    np.testing.assert_array_equal(values, more[:, 0])
    assert len(store) == 1300


def test_a_writer_that_hangs_is_told_of(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("prbayes.response.database.PATIENCE", 0.05)
    store = Store(folder, "y", 3)
    hanging = sqlite3.connect(file_of(folder), isolation_level=None)
    hanging.execute("BEGIN IMMEDIATE")
    assert all_right(store)  # readers do not wait
    with pytest.raises(StoreError, match=r"which another process has locked .*run again"):
        store.add(KEYS[:1], VALUES[:1])
    hanging.execute("ROLLBACK")
    hanging.close()
    store.add(KEYS[:1], VALUES[:1])
