"""A real Dask cluster: in threads, and on the loopback interface, where a worker is killed while it computes."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
import units
from first_use import first_use
from one_input import one_input
from um_server import Real

import prbayes as prb
from prbayes.model.random_variable import nodes
from prbayes.response.call import CallSettings, Points, Tally, respond
from prbayes.response.executors import capacity
from prbayes.response.outputs import Outputs
from prbayes.response.store import Store

distributed = pytest.importorskip("distributed")

N = 96


def slow(x: float) -> float:
    time.sleep(0.03)
    return 2 * x


def build(**keywords: object) -> pm.Model:
    model = one_input(
        [1, 2.0],
        prb.AreaMetric(),
        response=prb.scalar(slow),
        propagation=prb.Reweighted(N, **keywords),
        mu=(1, 1),
        sd=1.0,
    )
    first_use(model)
    return model


def all_there(model: pm.Model, store: Path) -> None:
    """The responses are those of this process, and all of them are stored."""
    (node,), (expected,) = nodes(model).values(), nodes(build()).values()
    np.testing.assert_array_equal(
        node.bound.design.sample.values, expected.bound.design.sample.values
    )
    again = next(iter(nodes(build(store=store)).values())).bound.responses
    assert again.computed == 3  # whether the response is still the same


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning:(distributed|dask|tornado).*")
def test_a_worker_that_leaves_while_it_computes_loses_nothing(tmp_path: Path) -> None:
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0"
    )
    with cluster, distributed.Client(cluster) as client:
        executor = client.get_executor(pure=False)
        assert capacity(executor) == (2, 4)
        leaving = threading.Timer(0.6, cluster.scale, (1,))
        leaving.start()
        begun = time.perf_counter()
        model = build(executor=executor, store=tmp_path)
        assert time.perf_counter() - begun > 0.6, "the worker was to leave while it computes"
        leaving.join()
    all_there(model, tmp_path)


@contextmanager
def losing_a_worker(seconds: float) -> Iterator[Executor]:
    """Give the executor of two processes, one of which is killed during the block."""
    cluster = distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
    )
    with cluster, distributed.Client(cluster) as client:
        pids = list(client.run(os.getpid).values())
        killer = threading.Timer(seconds, os.kill, (pids[0], signal.SIGKILL))
        killer.start()
        begun = time.perf_counter()
        yield client.get_executor(pure=False)
        spent = time.perf_counter() - begun
        assert spent > seconds, "the worker was to be killed while it computes"
        killer.join()
        assert pids[0] not in client.run(os.getpid).values()


# -- models of other programs ----------------------------------------------------------------------


def by_command(folder: Path) -> Iterator[prb.scalar]:
    code = "import time; time.sleep(0.05); print({x} - 2 * {y}, {x} * {x} * {y})"

    def read(run: Path) -> list[float]:
        return [float(text) for text in (run / "stdout.txt").read_text().split()]

    yield prb.command([sys.executable, "-S", "-c", code], inputs=["x", "y"], read=read)


def by_umbridge(folder: Path) -> Iterator[prb.scalar]:
    server = Real(folder)
    try:
        yield prb.umbridge(server.url, "beam", config={"seconds": 0.05})
    finally:
        server.kill()


def by_fmu(folder: Path) -> Iterator[prb.scalar]:
    unit = units.built(folder)
    # A force above 100 takes as many milliseconds for each of the steps.
    yield prb.fmu(unit, inputs=["stiffness", "force"], outputs=["position", "work"])


NAMED = Outputs(("position", "work"), keys=(("position", None), ("work", None)))
# What each gives at a point, from which second input on, and how many take two workers seconds.
CODES: dict[str, Any] = {
    "command": (by_command, lambda x, y: [x - 2 * y, x * x * y], Outputs((0, 1)), 0.0, 100),
    "umbridge": (by_umbridge, lambda x, y: [x - 2 * y, x * x * y], Outputs((0, 1)), 0.0, 100),
    "fmu": (by_fmu, lambda x, y: [3 * y / x, 2 * y * y], NAMED, 101.0, 20),
}


def study(code: str, folder: Path, executor: Any, n: int) -> Tally:
    """Compute n specimens on a cluster, and see that all are right, and stored."""
    make, formula, outputs, start, _ = CODES[code]
    x = 1.0 + np.arange(n) / n
    points = Points([x, start + 3 * x], [True, True])
    store, tally = Store(folder, "y", columns=2, version="1", outputs=2), Tally()
    making = make(folder)
    response = next(making)
    try:
        calling = CallSettings("y", response, executor, store, outputs=outputs)
        found = respond(calling, points, tally)
    finally:
        making.close()
    expected = np.array([formula(*pair) for pair in zip(*points.arguments, strict=True)])
    np.testing.assert_allclose(found, expected, rtol=1e-13)
    np.testing.assert_array_equal(store.find(points.keys())[0], found)
    return tally


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::DeprecationWarning:(distributed|dask|tornado).*")
def test_models_of_other_programs_are_computed_by_a_cluster_s_threads(tmp_path: Path) -> None:
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=2, processes=False, dashboard_address="127.0.0.1:0"
    )
    with cluster, distributed.Client(cluster) as client:
        for code in CODES:
            folder = tmp_path / code
            folder.mkdir()
            assert study(code, folder, client.get_executor(pure=False), 4).computed == 4


@pytest.mark.slow
@pytest.mark.parametrize("code", list(CODES))
@pytest.mark.filterwarnings("ignore::DeprecationWarning:(distributed|dask|tornado).*")
def test_a_worker_that_is_killed_with_a_model_of_another_program_loses_nothing(
    code: str, tmp_path: Path
) -> None:
    with losing_a_worker(1.0) as executor:
        study(code, tmp_path, executor, CODES[code][-1])
