"""Executors: how much they take, workers that are lost, silence, none that are left."""

from __future__ import annotations

import gc
import logging
import os
import pickle
import weakref
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

import prbayes as prb
from prbayes.response import executors
from prbayes.response.executors import (
    Capacity,
    Pool,
    capacity,
    failure_of,
    is_loss,
    refuse_timeout,
    told,
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


def test_how_much_an_executor_takes() -> None:
    class Mpi:
        num_workers = 7

    class Silent:
        pass

    assert capacity(None) == Capacity(1, 1)
    with ThreadPoolExecutor(3) as pool:
        assert capacity(pool) == Capacity(3, 6)
    assert capacity(Mpi()) == Capacity(7, 14)  # type: ignore[arg-type]
    assert capacity(Dask(Client(tcp_a=2, tcp_b=3))) == Capacity(5, 10)
    for silent in (Silent(), Dask(Client())):
        assert capacity(silent).chunks == 1024  # type: ignore[arg-type]


# -- time limits ---------------------------------------------------------------------------------


class Mpi(ThreadPoolExecutor):
    """Of processes, of which none may be ended without all of the others."""

    num_workers = 4


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
    for propagation in (prb.Reweighted, prb.Resimulated, prb.Fresh):
        with pytest.raises(ValueError, match=r"timeout: got 5 with executor"):
            propagation(64, executor=executor, timeout=5)
    refuse_timeout(None, executor)


def test_processes_keep_a_time_limit() -> None:
    with ProcessPoolExecutor(1) as pool:
        refuse_timeout(5, pool)
    refuse_timeout(0.5, Dask(Client(tcp_a=1)))
    with pytest.raises(ValueError, match="timeout"):
        refuse_timeout(-1, pool)


# -- losses --------------------------------------------------------------------------------------


def test_losses_are_told_from_ends_and_failures() -> None:
    class KilledWorker(Exception):  # noqa: N818 (Dask's name)
        pass

    for loss in (BrokenExecutor("x"), KilledWorker("x")):
        assert is_loss(loss)
        assert told(loss) == f"a worker was lost ({type(loss).__name__}: x)"
    for other in (None, CancelledError(), ValueError()):
        assert not is_loss(other)
    assert told(CancelledError("x")).startswith("the executor was closed while it was at work (")
    assert told(pickle.PicklingError("x")) == "the executor failed (PicklingError: x)"


def test_a_future_that_was_cancelled_has_a_failure() -> None:
    future: Future[Any] = Future()
    future.cancel()
    assert isinstance(failure_of(future), CancelledError)
    done: Future[Any] = Future()
    done.set_result(1)
    assert failure_of(done) is None


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
    assert executor not in executors._renewed
    there = weakref.ref(executor)
    del executor
    gc.collect()
    assert there() is None


def test_workers_that_end_whatever_they_do_are_refused() -> None:
    class Dead(Executor):
        def submit(self, work: Any, /, *job: Any, **keywords: Any) -> Any:
            raise BrokenExecutor("its initializer failed")

    with pytest.raises(
        ResponseError, match=r"y: a worker was lost \(Broken.*also without a response .*make a new"
    ):
        Pool("y", Dead()).refuse_dead()


# -- silence -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("threads", "text"), [({}, ", and there is no worker"), ({"a": 1}, "")])
def test_silence_is_told(
    threads: dict[str, int],
    text: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(executors, "_SILENCE", 0.02)
    pool = Pool("y", Dask(Client(**threads)))
    future = pool.submitted(len)

    class Handler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if caplog.text.count("no response") == 3:
                future.set_result(0)  # a worker came, or was slow

    log = logging.getLogger("prbayes")
    handler = Handler()
    log.addHandler(handler)
    try:
        with caplog.at_level(logging.WARNING, "prbayes"):
            assert pool.done([future]) == {future}
    finally:
        log.removeHandler(handler)
    assert f"y: no response for 0 s; 1 chunks are at work{text}" in caplog.text
    assert ("there is no worker" in caplog.text) == bool(text)


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
