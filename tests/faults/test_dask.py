"""A real Dask cluster: in threads, and on the loopback interface, where a worker is killed while it computes."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.model.node import nodes
from prbayes.response.executors import Capacity, capacity

distributed = pytest.importorskip("distributed")

N = 96


def slow(x: float) -> float:
    time.sleep(0.03)
    return 2 * x


def build(**keywords: object) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        prb.Simulator(
            "y",
            prb.scalar(slow),
            x,
            metric=prb.AreaMetric(),
            observed=[1, 2.0],
            propagation=prb.Reweighted(N, **keywords),
        )
    return model


def all_there(model: pm.Model, store: Path) -> None:
    """The responses are those of this process, and all of them are stored."""
    responses = next(iter(nodes(model).values())).bound
    np.testing.assert_array_equal(
        responses.values, next(iter(nodes(build()).values())).bound.values
    )
    again = next(iter(nodes(build(store=store)).values())).bound.responses
    assert again.computed == 1  # whether the response is still the same


@pytest.mark.filterwarnings("ignore::DeprecationWarning:(distributed|dask|tornado).*")
def test_a_worker_that_leaves_while_it_computes_loses_nothing(tmp_path: Path) -> None:
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0"
    )
    with cluster, distributed.Client(cluster) as client:
        executor = client.get_executor(pure=False)
        assert capacity(executor) == Capacity(2, 4)
        leaving = threading.Timer(0.6, cluster.scale, (1,))
        leaving.start()
        begun = time.perf_counter()
        model = build(executor=executor, store=tmp_path)
        assert time.perf_counter() - begun > 0.6, "the worker was to leave while it computes"
        leaving.join()
    all_there(model, tmp_path)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning:(distributed|dask|tornado).*")
def test_a_worker_is_killed_and_nothing_is_lost(tmp_path: Path) -> None:
    cluster = distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
    )
    with cluster, distributed.Client(cluster) as client:
        # That of the cluster, not of this machine.
        assert capacity(client.get_executor(pure=False)) == Capacity(2, 4)
        pids = list(client.run(os.getpid).values())
        killer = threading.Timer(0.6, os.kill, (pids[0], signal.SIGKILL))
        killer.start()
        begun = time.perf_counter()
        model = build(executor=client.get_executor(pure=False), store=tmp_path)
        assert time.perf_counter() - begun > 0.6, "the worker was to be killed while it computes"
        killer.join()
        assert pids[0] not in client.run(os.getpid).values()
    all_there(model, tmp_path)
