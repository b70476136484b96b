"""Executors of concurrent calls: capacity, time limits, and lost workers.

The interface of `concurrent.futures.Executor` has none of these. Attributes beyond the interface,
whose names may change, are read in this module only; `tests/test_contracts.py` tests them.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import threading
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    wait,
)
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from inspect import signature
from pathlib import Path
from traceback import walk_tb
from typing import Any
from weakref import WeakKeyDictionary

from prbayes._finding import Finding, report
from prbayes._validate import Function, called, positive_number
from prbayes.response.failures import ResponseError


def capacity(executor: Executor | None) -> tuple[int, int]:
    """Return the numbers of workers, and of chunks that are sent to them at a time."""
    if executor is None:
        return 1, 1
    # The first attribute is that of process pools, thread pools and loky, the second that of MPI;
    # Dask has neither.
    workers = getattr(executor, "_max_workers", 0) or getattr(executor, "num_workers", 0)
    workers = workers or sum((_dask_threads(executor) or {}).values())
    if not workers:
        return os.cpu_count() or 1, 1024  # enough chunks for the largest clusters in practice
    return int(workers), 2 * int(workers)  # so that each worker has its next chunk ready


def _dask_threads(executor: Executor | None) -> dict[str, int] | None:
    """Return the number of threads of each Dask worker by address; None for other executors."""
    threads = getattr(getattr(executor, "_client", None), "nthreads", None)
    return dict(threads()) if callable(threads) else None


def _process_pool_class(executor: Executor | None) -> type[Executor] | None:
    """Return the class of a pool of processes, also of loky, which has the same name; or None."""
    classes = type(executor).__mro__
    return next((c for c in classes if c.__name__ == "ProcessPoolExecutor"), None)


# -- time limits -----------------------------------------------------------------------------------


def refuse_timeout(timeout: object, executor: Executor | None) -> None:
    """Raise for a time limit that is not a number, or that the executor cannot enforce."""
    if timeout is None:
        return
    positive_number(timeout, "timeout")
    addresses = _dask_threads(executor)
    in_dask_processes = addresses is not None and not any(
        address.startswith("inproc:") for address in addresses
    )
    if _process_pool_class(executor) is None and not in_dask_processes:
        raise ValueError(
            f"timeout: got {timeout} with executor {called(executor)}, expected an executor of "
            "processes, such as concurrent.futures.ProcessPoolExecutor(4), or of Dask with workers "
            "in other processes: nothing else ends a response that hangs; prb.command, "
            "prb.umbridge and prb.fmu have a timeout= of their own, which applies anywhere"
        )


class _AlarmError(TimeoutError):
    """Raised in a response that takes too long; distinct from the response's own TimeoutError."""


@contextmanager
def time_limit(seconds: float | None) -> Iterator[None]:
    """Raise `TimeoutError` in the block after some seconds, or end this process a while later."""
    # A signal interrupts the main thread only. Other threads, and code that never returns to
    # Python, can only be ended together with their process.
    if seconds is None:
        yield
        return
    start = time.monotonic()
    message = f"no result within timeout = {seconds:g} s"
    # The watchdog is late enough that the signal comes first, even if a busy machine stalls for
    # seconds.
    with _watchdog(1.5 * seconds + 5):
        try:
            in_main = threading.current_thread() is threading.main_thread()
            if in_main and hasattr(signal, "setitimer"):
                with _alarm(seconds):
                    yield
            else:
                yield
        except _AlarmError:
            raise TimeoutError(message) from None
        except Exception as error:
            # Compiled code may replace the exception of the alarm by another one.
            if time.monotonic() - start < seconds:
                raise
            raise TimeoutError(message) from error


@contextmanager
def _alarm(seconds: float) -> Iterator[None]:
    """Raise `_AlarmError` in the main thread after some seconds."""
    is_over = False

    def interrupt(*_: object) -> None:
        nonlocal is_over
        if not is_over:
            is_over = True  # so that a second alarm does not interrupt the clean-up
            raise _AlarmError

    previous = signal.signal(signal.SIGALRM, interrupt)
    try:
        try:
            # Repeat the alarm each second, because another thread may receive the signal while the
            # main thread sleeps.
            signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)
            yield
        finally:
            is_over = True  # an alarm from here on must not break the clean-up
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous)


# Time at which the process ends, for each block. Python has only one watchdog for all threads,
# which is set to the earliest time.
_deadlines: dict[object, float] = {}
_deadlines_lock = threading.Lock()


@contextmanager
def _watchdog(seconds: float) -> Iterator[None]:
    """End this process if the block takes longer."""
    block = object()
    with _deadlines_lock:
        _deadlines[block] = time.monotonic() + seconds
        _set_watchdog()
    try:
        yield
    finally:
        with _deadlines_lock:
            del _deadlines[block]
            _set_watchdog()


def _set_watchdog() -> None:
    faulthandler.cancel_dump_traceback_later()
    if _deadlines:
        remaining = max(
            min(_deadlines.values()) - time.monotonic(), 1e-3
        )  # the watchdog takes no zero
        faulthandler.dump_traceback_later(remaining, exit=True, file=_devnull())


@lru_cache(maxsize=1)
def _devnull() -> int:
    return os.open(os.devnull, os.O_WRONLY)


# -- lost workers ----------------------------------------------------------------------------------


def failure_of(future: Future[Any]) -> BaseException | None:
    """Return why a finished future has no result, None if it has one."""
    return CancelledError("it was cancelled") if future.cancelled() else future.exception()


def is_loss(failure: BaseException | None) -> bool:
    """Return whether a chunk failed because its worker was lost (KilledWorker in Dask)."""
    names = {kind.__name__ for kind in type(failure).__mro__}
    return isinstance(failure, BrokenExecutor) or "KilledWorker" in names


def has_slipped(failure: BaseException | None) -> bool:
    """Return whether Dask lost a result at the moment when its worker left.

    Its executor then takes the result for an exception, because the task is already running again.
    """
    if not isinstance(failure, TypeError):
        return False
    frames = [frame for frame, _ in walk_tb(failure.__traceback__)]
    file = frames[-1].f_code.co_filename if frames else ""
    return Path(file).parts[-2:] == ("distributed", "cfexecutor.py")


def failure_text(failure: BaseException) -> str:
    """Return the reason why an executor has no result, as a clause."""
    text = f"{type(failure).__name__}: {failure!s:.200}"
    if is_loss(failure):
        return f"a worker was lost ({text})"
    if isinstance(failure, CancelledError):
        return f"the executor was closed while it was at work ({text})"
    return f"the executor failed ({text})"


_SILENCE = 60.0  # seconds without a result after which it is logged; most responses take less

# Replacements of executors whose workers were lost, by the original executor.
_replacements: WeakKeyDictionary[Executor, Executor] = WeakKeyDictionary()


@dataclass
class Pool:
    """An executor that is replaced by a similar one when its workers are lost."""

    name: str  # name of the simulator, for messages
    original: Executor | None  # executor of the user

    @property
    def executor(self) -> Executor | None:
        """The executor in use: the original, or its replacement."""
        return None if self.original is None else _replacements.get(self.original, self.original)

    def renew(self, failure: BaseException | None) -> None:
        """Replace a broken pool of processes; other executors start new workers themselves."""
        kind = _process_pool_class(self.original)
        if self.original is None or kind is None or not isinstance(failure, BrokenExecutor):
            return
        # The standard library and loky store the arguments of their constructors as attributes.
        parameters = signature(kind).parameters
        arguments = {"max_workers": getattr(self.original, "_max_workers", None)}
        for attribute in ("_mp_context", "_context", "_initializer", "_initargs"):
            value = getattr(self.original, attribute, None)
            if attribute[1:] in parameters and value is not None:
                arguments[attribute[1:]] = value
        _replacements[self.original] = kind(**arguments)

    def refuse_dead(self) -> None:
        """Raise if workers are lost even when they compute no response."""
        future = self.submitted(os.getpid)
        self.done([future])
        failure = failure_of(future)
        if failure is not None:
            raise ResponseError(
                f"{self.name}: {failure_text(failure)}, also when it computed no response, "
                "expected an executor whose workers do not end; make a new one, and check what "
                "its workers do when they start: its initializer, or a script that runs without "
                "`if __name__ == '__main__':`"
            )

    def submitted(self, work: Function, *arguments: Any) -> Future[Any]:
        """Return a future of the work. Without an executor the work is done here, at once."""
        future: Future[Any] = Future()
        try:
            if self.executor is not None:
                return self.executor.submit(work, *arguments)
            future.set_result(work(*arguments))
        except Exception as error:
            future.set_exception(error)
        return future

    def done(self, futures: Iterable[Future[Any]]) -> set[Future[Any]]:
        """Wait for at least one future, and return the finished ones.

        Raises `ResponseError` after ten minutes without any worker.
        """
        waiting = list(futures)
        silent, absences = 0.0, 0
        while True:
            # A pool that is closed cancels futures, which `wait` never returns.
            finished = {future for future in waiting if future.cancelled()}
            timeout = 0.0 if finished else _SILENCE
            finished |= wait(waiting, timeout=timeout, return_when=FIRST_COMPLETED).done
            if finished or not waiting:
                return finished
            silent += _SILENCE
            has_workers = _dask_threads(self.executor) != {}
            absences = 0 if has_workers else absences + 1
            text = f"{self.name}: no response for {silent:.0f} s; {len(waiting)} chunks are at work"
            text += "." if has_workers else ", and there is no worker."
            report(Finding("no-response-yet", text))
            if absences == 10:  # on a busy machine a worker may need minutes to start again
                for future in waiting:
                    future.cancel()
                raise ResponseError(
                    f"{self.name}: got no response for {silent:.0f} s, and no worker is left, "
                    "expected workers; start some, wait for them, and run again: with store= "
                    "finished responses are not computed again"
                )
