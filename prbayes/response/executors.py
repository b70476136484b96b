"""What is known of executors: how much they take, and whether their workers are lost or gone.

The interface of `concurrent.futures.Executor` tells none of that. What is read beyond it, by names
that others may change, stands here, and `tests/test_contracts.py` tests it on real executors.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    wait,
)
from dataclasses import dataclass
from inspect import signature
from pathlib import Path
from traceback import walk_tb
from typing import Any
from weakref import WeakKeyDictionary

from prbayes._finding import Finding, report
from prbayes._validate import called, positive_number
from prbayes.response.failures import ResponseError


@dataclass(frozen=True)
class Capacity:
    """How many workers an executor has, and how many chunks it is sent at a time."""

    workers: int
    chunks: int


def capacity(executor: Executor | None) -> Capacity:
    """Return how much an executor takes.

    Processes, threads and loky keep ``_max_workers``, MPI ``num_workers``, and Dask's client knows.
    Of others many chunks are sent out, lest workers wait.
    """
    if executor is None:
        return Capacity(1, 1)
    workers = getattr(executor, "_max_workers", 0) or getattr(executor, "num_workers", 0)
    workers = workers or sum((_threads(executor) or {}).values())
    if not workers:
        # As many as workers that are known of in practice; what one costs in memory is measured by
        # `python -m benchmarks.scale`.
        return Capacity(os.cpu_count() or 1, 1024)
    # While a worker computes a chunk, the next one is there already.
    return Capacity(int(workers), 2 * int(workers))


def _threads(executor: Executor | None) -> dict[str, int] | None:
    """Return how many threads each worker of Dask has, by its address; None for others."""
    threads = getattr(getattr(executor, "_client", None), "nthreads", None)
    return dict(threads()) if callable(threads) else None


def refuse_timeout(timeout: object, executor: Executor | None) -> None:
    """Raise if it is no time, or one that the executor's workers cannot keep."""
    if timeout is None:
        return
    positive_number(timeout, "timeout")
    if not _has_processes(executor):
        raise ValueError(
            f"timeout: got {timeout} with executor {called(executor)}, expected an executor of "
            "processes, such as concurrent.futures.ProcessPoolExecutor(4), or of Dask with workers "
            "in other processes: nothing else ends a response that hangs; prb.command, "
            "prb.umbridge and prb.fmu have a timeout= of their own, which is kept anywhere"
        )


def _has_processes(executor: Executor | None) -> bool:
    """Return whether workers are processes of their own, which may be ended."""
    if _kind(executor) is not None:
        return True
    addresses = _threads(executor)
    # Dask calls those in this process so.
    return addresses is not None and not any(a.startswith("inproc:") for a in addresses)


def _kind(executor: Executor | None) -> type[Executor] | None:
    """Return the class of an executor of processes: loky's has the name of the standard one."""
    kinds = type(executor).__mro__
    return next((kind for kind in kinds if kind.__name__ == "ProcessPoolExecutor"), None)


# -- workers that are lost -------------------------------------------------------------------------


def failure_of(future: Future[Any]) -> BaseException | None:
    """Return why a future that is done has no result; one that was cancelled raises elsewhere."""
    return CancelledError("it was cancelled") if future.cancelled() else future.exception()


def is_loss(failure: BaseException | None) -> bool:
    """Return whether a chunk failed since its worker was lost; Dask names that by a class."""
    names = {kind.__name__ for kind in type(failure).__mro__}
    return isinstance(failure, BrokenExecutor) or "KilledWorker" in names


def has_slipped(failure: BaseException | None) -> bool:
    """Return whether a result was there and is not, as its worker left at that very moment.

    Dask's executor reads the state of a task after its result: by then it may be at work again
    elsewhere, and the executor takes the result for an exception.
    """
    if not isinstance(failure, TypeError):
        return False
    file = ""
    for frame, _ in walk_tb(failure.__traceback__):
        file = frame.f_code.co_filename
    return Path(file).parts[-2:] == ("distributed", "cfexecutor.py")


def told(failure: BaseException) -> str:
    """Return what became of an executor that has no result."""
    text = f"{type(failure).__name__}: {failure!s:.200}"
    if is_loss(failure):
        return f"a worker was lost ({text})"
    if isinstance(failure, CancelledError):
        return f"the executor was closed while it was at work ({text})"
    return f"the executor failed ({text})"


# Seconds without a result after which the log says so. By judgement: longer than most responses
# take, and shorter than one waits for nothing.
_SILENCE = 60.0
# So many times in a row no worker is seen before it is believed that none will come: ten minutes,
# as one that is started again after a loss is away for seconds, on a busy machine for minutes.
_ABSENCES = 10

# Executors in the place of those whose workers were lost, as long as those are there.
_renewed: WeakKeyDictionary[Executor, Executor] = WeakKeyDictionary()


@dataclass
class Pool:
    """An executor, or a new one like it where its workers were lost."""

    name: str  # of the simulator, for messages
    given: Executor | None

    @property
    def executor(self) -> Executor | None:
        """The executor at work."""
        return None if self.given is None else _renewed.get(self.given, self.given)

    def renew(self, failure: BaseException | None) -> None:
        """Take a new executor if this one is broken; those of others start workers themselves."""
        if self.given is None or not isinstance(failure, BrokenExecutor):
            return
        kind = _kind(self.given)
        if kind is not None:
            _renewed[self.given] = _alike(self.given, kind)

    def refuse_dead(self) -> None:
        """Raise if workers are lost whatever they do: then no response is to blame.

        Raises
        ------
        ResponseError
            If they are.
        """
        future = self.submitted(os.getpid)
        self.done([future])
        failure = failure_of(future)
        if failure is not None:
            raise ResponseError(
                f"{self.name}: {told(failure)}, also without a response at work, expected an "
                "executor whose workers stay; make a new one, and look at what its workers do "
                "when they start: its initializer, or a script that runs without "
                "`if __name__ == '__main__':`"
            )

    def submitted(self, work: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Return work as a future: done already without an executor, failed if that is broken."""
        future: Future[Any] = Future()
        try:
            if self.executor is not None:
                return self.executor.submit(work, *arguments)
            future.set_result(work(*arguments))
        except Exception as error:
            future.set_exception(error)
        return future

    def done(self, begun: Iterable[Future[Any]]) -> set[Future[Any]]:
        """Return futures that are done; waits for one, and says so after a minute.

        Raises
        ------
        ResponseError
            If no worker is left, so that none will ever be done.
        """
        waiting = list(begun)
        silent, absences = 0.0, 0
        while True:
            # Those that a pool cancels when it is closed, `wait` waits for in vain.
            found = {future for future in waiting if future.cancelled()}
            patience = 0.0 if found else _SILENCE
            found |= wait(waiting, timeout=patience, return_when=FIRST_COMPLETED).done
            if found or not waiting:
                return found
            silent += _SILENCE
            absent = _threads(self.executor) == {}
            absences = absences + 1 if absent else 0
            workers = ", and there is no worker" if absent else ""
            text = f"{self.name}: no response for {silent:.0f} s; {len(waiting)} chunks are at work"
            report(Finding("no-response-yet", f"{text}{workers}."))
            if absences == _ABSENCES:
                for future in waiting:
                    future.cancel()
                raise ResponseError(
                    f"{self.name}: got no response for {silent:.0f} s, and no worker is left, "
                    "expected workers; start some, wait for them, and run again: with store= "
                    "nothing that was computed is computed again"
                )


def _alike(executor: Executor, kind: type[Executor]) -> Executor:
    """Return a new executor of processes like one whose workers were lost.

    How one was made, the standard library and loky keep under the same names.
    """
    known = signature(kind).parameters
    made: dict[str, Any] = {"max_workers": getattr(executor, "_max_workers", None)}
    for name, kept in (
        ("mp_context", "_mp_context"),
        ("context", "_context"),
        ("initializer", "_initializer"),
        ("initargs", "_initargs"),
    ):
        if name in known and getattr(executor, kept, None) is not None:
            made[name] = getattr(executor, kept)
    return kind(**made)
