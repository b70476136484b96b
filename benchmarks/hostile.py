"""A response that fails in all ways that are known, and the executors to try it on."""

from __future__ import annotations

import importlib
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

import prbayes as prb
from prbayes.response.call import CallSettings, Points, Tally, respond
from prbayes.response.failures import OnFailure, ResponseError
from prbayes.response.store import Store


@contextmanager
def processes() -> Iterator[Executor]:
    context = get_context("forkserver")
    # Workers are forked from a process that has imported already what takes long.
    context.set_forkserver_preload(["prbayes.response.call", "cloudpickle"])
    with ProcessPoolExecutor(2, context) as pool:
        yield pool


@contextmanager
def loky() -> Iterator[Executor]:
    loky = importlib.import_module("joblib.externals.loky")
    pool = loky.get_reusable_executor(2)
    yield pool
    pool.shutdown(wait=True, kill_workers=True)


@contextmanager
def dask() -> Iterator[Executor]:
    distributed = importlib.import_module("distributed")
    config = importlib.import_module("dask.config")
    where: dict[str, Any] = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
    # One worker that is lost with a task is enough: by default it takes four, of seconds each.
    with config.set({"distributed.scheduler.allowed-failures": 0}):
        cluster = distributed.LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            processes=True,
            silence_logs=logging.CRITICAL,
            **where,
        )
        with cluster, distributed.Client(cluster) as client:
            yield client.get_executor(pure=False)


@contextmanager
def threads() -> Iterator[Executor]:
    with ThreadPoolExecutor(2) as pool:
        yield pool


@contextmanager
def nothing() -> Iterator[None]:
    yield None


EXECUTORS: dict[str, Callable[[], AbstractContextManager[Any]]] = {
    f.__name__: f for f in (nothing, threads, processes, loky, dask)
}


# -- hostile responses -----------------------------------------------------------------------------


def hostile(x: float) -> Any:
    """Return 2 x, but at some points."""
    if x == 1:
        raise ArithmeticError("too steep")
    if x == 2:
        return np.nan
    if x == 3:
        sys.exit("bye")
    if x == 4:
        raise ValueError("long, \0 and \ud800 " + 10_000_000 * "x")
    if x == 5:
        return "text"
    if x in (6, 7) and "distributed.worker" in sys.modules:
        # A worker that ends as soon as it is there is not started again by Dask 2026.8.
        time.sleep(3)
    if x == 6:
        os._exit(3)
    if x == 7:
        os.kill(os.getpid(), signal.SIGKILL)
    if x == 8:
        spin()
    if x == 9:
        time.sleep(600)
    return 2 * x


def spin() -> None:
    while True:
        pass


REASONS = {
    1: "it raised ArithmeticError: too steep",
    2: "it is NaN",
    3: "it raised SystemExit: bye",
    4: "it raised ValueError: long, \\0 and \\ud800 xxx",
    5: "it raised ValueError: could not convert string to float: 'text'",
    6: "it ended its worker (",
    7: "it ended its worker (",
    8: "it raised TimeoutError: no result within timeout = ",
    9: "it ",  # a signal ends a sleep, where there is one
}
# Points of the table that end the process, which nothing survives that runs in it; and those that hang.
ENDING = (6, 7, 8, 9)


def on_workers(
    where: str, executor: Executor | None, policy: OnFailure, folder: Path, seed: int
) -> Iterator[str]:
    """Call the response at each of its hostile points, among five others, and say what came of it."""
    rng = np.random.default_rng(seed)
    safe = where in ("nothing", "threads")
    for bad in REASONS:
        if safe and bad in ENDING:
            continue
        points = Points([rng.permutation([float(bad), *rng.uniform(20, 30, 5)])], [True])
        x = points.arguments[0]
        store, tally = Store(folder, f"{where}, {policy}, {bad}", columns=1), Tally()
        timeout = None if safe else 0.5
        calling = CallSettings("y", prb.scalar(hostile), executor, store, policy, timeout=timeout)
        try:
            found = respond(calling, points, tally)
        except ResponseError as error:
            values, known = store.find(points.keys())
            kept = np.array_equal(values[known], 2 * x[known])
            said = "y: " in str(error) and ("store=" in str(error) or "are kept in" in str(error))
            yield "refused" if kept and said else f"poor words: {error}"
            continue
        wanted = np.where(x == bad, -1.0, 2 * x)
        told = [failure.reason for failure in tally.failed.values()]
        if not isinstance(policy.final, prb.response.Replace):
            right = bad == 2 and np.array_equal(found, np.where(x == 2, np.nan, 2 * x), True)
        else:
            right = np.array_equal(found, wanted) and told[0].startswith(REASONS[bad])
        yield "that point failed" if right else f"wrong: {found} at {x}, {told}"
