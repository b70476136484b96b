"""Several processes and threads that write to one store at once lose nothing and find all."""

from __future__ import annotations

from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from benchmarks.attacks import go_on, told, writer
from prbayes.response.store import Store


@pytest.mark.long
def test_two_processes_of_two_threads_lose_nothing_and_find_all(tmp_path: Path) -> None:
    processes = [writer(tmp_path, number, 60) for number in range(2)]
    # Both make the store, write at the same time, and then look for the other's responses.
    for word in ("ready", "done"):
        for process in processes:
            told(process, word)
        for process in processes:
            go_on(process)
    for process in processes:
        assert process.communicate()[0] == "600\n"
        assert process.returncode == 0
    keys, values = Store(tmp_path, "y", columns=2).known()
    assert len(keys) == 600
    np.testing.assert_array_equal(values, keys @ [1e6, 1.0])


def in_child(store: Store) -> None:
    inherited = store._local.session
    assert len(store) == 1
    store.add(np.array([[2.0]]), np.array([20.0]))
    # The parent's connection is neither used nor closed.
    assert store._local.session.connection is not inherited.connection
    inherited.connection.execute("PRAGMA user_version")


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning", "ignore:os.fork:RuntimeWarning")
def test_a_store_survives_a_fork(tmp_path: Path) -> None:
    store = Store(tmp_path, "y", columns=1)
    store.add(np.array([[1.0]]), np.array([10.0]))
    process = get_context("fork").Process(target=in_child, args=(store,))
    process.start()
    process.join()
    assert process.exitcode == 0
    store.add(np.array([[3.0]]), np.array([30.0]))
    values, known = store.find(np.array([[1.0], [2.0], [3.0]]))
    assert known.all()
    np.testing.assert_array_equal(values, [10.0, 20.0, 30.0])
