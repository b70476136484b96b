"""Executors: how much they take, workers that are lost, silence, none that are left."""

from __future__ import annotations

import gc
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from multiprocessing import get_context
from typing import Any, cast

import pytest

from prbayes.response import executors
from prbayes.response.executors import (
    Pool,
    capacity,
    failure_of,
    failure_text,
    is_loss,
    refuse_timeout,
    time_limit,
)
from prbayes.response.failures import ResponseError


class Client:
    """As much of Dask's as is asked."""

    def __init__(self, **threads: int) -> None:
        self.threads = {address.replace("_", ":"): n for address, n in threads.items()}

    def nthreads(self) -> dict[str, int]:
        return self.threads


class Dask(ThreadPoolExecutor):
    """Begins nothing."""

    def __init__(self, client: Client) -> None:
        self._client = client

    def submit(self, work: Any, /, *job: Any, **keywords: Any) -> Any:
        return Future()


class Mpi(ThreadPoolExecutor):
    """Of processes, of which none may be ended without all of the others."""

    num_workers = 4


def test_how_much_an_executor_takes() -> None:
    assert capacity(None) == (1, 1)
    with ThreadPoolExecutor(3) as pool:
        assert capacity(pool) == (3, 6)
    assert capacity(Dask(Client(tcp_a=2, tcp_b=3))) == (5, 10)
    mpi = Mpi(1)
    mpi._max_workers = 0
    assert capacity(mpi) == (4, 8)
    for silent in (Executor(), Dask(Client())):
        assert capacity(silent)[1] == 1024


# -- time limits ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "executor",
    [
        None,
        ThreadPoolExecutor(1),
        Mpi(1),
        Dask(Client(inproc_a=2)),
        Dask(Client(tcp_a=1, inproc_b=1)),
    ],
)
def test_a_time_limit_that_nobody_keeps_is_refused(executor: Any) -> None:
    with pytest.raises(
        ValueError, match=r"timeout: got 5 with executor .*expected an executor of .*of their own"
    ):
        refuse_timeout(5, executor)
    refuse_timeout(None, executor)


def test_processes_keep_a_time_limit() -> None:
    with ProcessPoolExecutor(1) as pool:
        refuse_timeout(5, pool)
    refuse_timeout(0.5, Dask(Client(tcp_a=1)))
    with pytest.raises(ValueError, match="timeout"):
        refuse_timeout(-1, pool)


MAIN_OR_THREAD = pytest.mark.parametrize("where", ["main", "thread"])


def spin(seconds: float) -> None:
    """Work in Python for so long."""
    until = time.perf_counter() + seconds
    while time.perf_counter() < until:
        pass


def run(where: str, work: Callable[[], object]) -> object:
    if where == "main":
        return work()
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(work).result()


def nothing_is_left() -> bool:
    return (
        not executors._deadlines
        and signal.getsignal(signal.SIGALRM) is signal.SIG_DFL
        and signal.getitimer(signal.ITIMER_REAL)[0] == 0
    )


@MAIN_OR_THREAD
def test_what_is_in_time_is_left_alone(where: str) -> None:
    def quick() -> int:
        for _ in range(200):
            with time_limit(0.2):
                pass
        # None of those that were set comes later.
        spin(0.25)
        return 3

    assert run(where, quick) == 3
    assert nothing_is_left()


def test_an_alarm_while_the_clock_is_stopped_comes_too_late(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stop = signal.setitimer

    def stopped(which: int, seconds: float, interval: float = 0.0) -> None:
        if seconds == 0:
            signal.raise_signal(signal.SIGALRM)
        stop(which, seconds, interval)

    monkeypatch.setattr(signal, "setitimer", stopped)
    with time_limit(5.0):
        spin(0.001)
    assert nothing_is_left()


def replacing_the_alarm() -> None:
    try:
        spin(60.0)
    except BaseException as error:
        raise RuntimeError("Failed to instantiate model") from error


@pytest.mark.parametrize("late", [lambda: spin(60.0), replacing_the_alarm])
def test_what_runs_in_python_is_ended(late: Callable[[], None]) -> None:
    def limited() -> None:
        with time_limit(0.05):
            late()

    begun = time.perf_counter()
    with pytest.raises(TimeoutError, match=r"^no result within timeout = 0.05 s$"):
        limited()
    assert time.perf_counter() - begun < 30.0
    assert nothing_is_left()


@pytest.mark.long
def test_an_alarm_comes_again_and_is_raised_once() -> None:
    """Another thread may receive the first one, while the main thread sleeps."""
    intervals, cleaned = [], []

    def late() -> None:
        with time_limit(0.05):
            intervals.append(signal.getitimer(signal.ITIMER_REAL)[1])
            try:
                spin(60.0)
            finally:
                spin(1.2)
                cleaned.append(True)

    with pytest.raises(TimeoutError):
        late()
    assert intervals == [1.0]
    assert cleaned == [True]
    assert nothing_is_left()


def test_a_time_limit_of_the_response_s_own_is_its_own() -> None:
    def own() -> None:
        with time_limit(5.0):
            raise TimeoutError("no answer from the license server")

    with pytest.raises(TimeoutError, match="license server"):
        own()
    with time_limit(None):
        assert nothing_is_left()


def test_two_threads_have_a_clock_each(monkeypatch: pytest.MonkeyPatch) -> None:
    wound: list[float] = []
    monkeypatch.setattr(
        "faulthandler.dump_traceback_later", lambda left, **_: wound.append(round(left, 1))
    )
    first, second = threading.Event(), threading.Event()

    def long() -> None:
        with time_limit(20.0):
            first.set()
            second.wait(10)

    thread = threading.Thread(target=long)
    thread.start()
    first.wait(10)
    with time_limit(2.0):
        pass
    second.set()
    thread.join()
    # The shorter one is first, and then the longer one again.
    assert wound == [35.0, 8.0, 35.0]
    assert nothing_is_left()


HANGS = """
import threading, time
from prbayes.response.executors import time_limit

def hangs():
    with time_limit(0.05):
        time.sleep(600)

thread = threading.Thread(target=hangs)
thread.start()
thread.join()
"""


@pytest.mark.long
def test_what_hangs_elsewhere_ends_its_process() -> None:
    start = time.perf_counter()
    command = [sys.executable, "-c", HANGS]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert done.stderr == ""
    assert 1.0 < time.perf_counter() - start < 40.0


# -- losses --------------------------------------------------------------------------------------


def test_losses_are_told_from_ends_and_failures() -> None:
    class KilledWorker(Exception):  # noqa: N818 (Dask's name)
        pass

    for loss in (BrokenExecutor("x"), KilledWorker("x")):
        assert is_loss(loss)
        assert failure_text(loss) == f"a worker was lost ({type(loss).__name__}: x)"
    for other in (None, CancelledError(), ValueError()):
        assert not is_loss(other)
    assert failure_text(CancelledError("x")).startswith(
        "the executor was closed while it was at work ("
    )
    assert failure_text(pickle.PicklingError("x")) == "the executor failed (PicklingError: x)"
    future: Future[Any] = Future()
    future.cancel()
    assert isinstance(failure_of(future), CancelledError)


def test_a_pool_is_renewed_as_it_was_made_and_no_other() -> None:
    # Its initializer shows in what the next call returns: the mask of before.
    with ProcessPoolExecutor(1, get_context("forkserver"), os.umask, (0o70,)) as given:
        pool = Pool("y", given)
        for harmless in (None, ValueError()):
            pool.renew(harmless)
            assert pool.executor is given
        loss = pool.submitted(os._exit, 3)
        pool.done([loss])
        pool.renew(failure_of(loss))
        assert pool.executor is not given
        pool.refuse_dead()
        # Whoever is given the broken one later gets that in its place.
        again = Pool("z", given)
        assert again.submitted(os.umask, 0o22).result() == 0o70
        assert capacity(again.executor) == capacity(given)
        assert again.executor is pool.executor
        cast(Executor, again.executor).shutdown()
    assert Pool("y", None).submitted(abs, -3).result() == 3


def test_an_executor_that_cannot_be_renewed_is_not_kept() -> None:
    gc.freeze()  # what other tests left is not looked at
    executor = ThreadPoolExecutor(1)
    Pool("y", executor).renew(BrokenExecutor())
    assert executor not in executors._replacements
    there = weakref.ref(executor)
    del executor
    gc.collect()
    assert there() is None


# -- silence -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("threads", "text"), [({}, ", and there is no worker."), ({"a": 1}, " at work.")]
)
def test_silence_is_reported_until_a_worker_comes(
    threads: dict[str, int], text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    findings: list[str] = []

    def report(finding: Any) -> None:
        findings.append(str(finding))
        if len(findings) == 3:
            future.set_result(0)

    monkeypatch.setattr(executors, "_SILENCE", 0.02)
    monkeypatch.setattr(executors, "report", report)
    pool = Pool("y", Dask(Client(**threads)))
    future = pool.submitted(len)
    assert pool.done([future]) == {future}
    assert findings[0].startswith("y: no response for 0 s; 1 chunks are at work")
    assert all(finding.endswith(text) for finding in findings)


def test_a_cluster_without_workers_is_given_up_after_a_while(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(executors, "_SILENCE", 0.005)
    pool = Pool("y", Dask(Client()))
    futures = [pool.submitted(len) for _ in range(2)]
    with pytest.raises(
        ResponseError, match=r"y: got no response .*no worker is left, expected wor"
    ):
        pool.done(futures)
    assert all(future.cancelled() for future in futures)
