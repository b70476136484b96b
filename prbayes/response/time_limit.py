"""A time limit for a response, kept in the process that computes it.

Two things keep it. An exception, raised inside the response, ends what runs in Python; what hangs
elsewhere, never to come back, ends with its process a while later.
"""

from __future__ import annotations

import ctypes
import faulthandler
import os
import signal as signals
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache


class _LateError(TimeoutError):
    """What is raised inside a response; by a class of its own, as responses have time limits."""


@contextmanager
def limited(seconds: float | None) -> Iterator[None]:
    """Raise `TimeoutError` inside after some seconds; end this process if that does not help.

    What is inside has to be a call: what is raised at the jump of a loop that stands in the same
    function passes by ``with`` and ``try`` (seen in CPython 3.13).
    """
    if seconds is None:
        yield
        return
    # Signals reach the main thread only: there they also end what waits for a program.
    main = threading.current_thread() is threading.main_thread()
    raised = _by_signal if main and hasattr(signals, "setitimer") else _by_injection
    # Half as long again, and a second, so that the exception comes first.
    with _or_end(1.5 * seconds + 1):
        began = time.monotonic()
        message = f"no result within timeout = {seconds:g} s"
        try:
            with raised(seconds):
                yield
        except _LateError:
            raise TimeoutError(message) from None
        except Exception as error:
            # Other languages inside tell of what was raised in their own words.
            if time.monotonic() - began < seconds:
                raise
            raise TimeoutError(message) from error


@contextmanager
def _by_signal(seconds: float) -> Iterator[None]:
    """Raise inside, in the main thread."""
    over = False

    def late(*_: object) -> None:
        if not over:
            raise _LateError

    before = signals.signal(signals.SIGALRM, late)
    try:
        try:
            signals.setitimer(signals.ITIMER_REAL, seconds)
            yield
        finally:
            # From here on it comes too late to be raised, so that what follows is done in any case.
            over = True
    finally:
        signals.setitimer(signals.ITIMER_REAL, 0)
        signals.signal(signals.SIGALRM, before)


@contextmanager
def _by_injection(seconds: float) -> Iterator[None]:
    """Raise inside, in any thread, such as those of Dask, as soon as it runs in Python."""
    thread = ctypes.c_ulong(threading.get_ident())
    inject = ctypes.pythonapi.PyThreadState_SetAsyncExc
    turn = threading.Lock()
    over = threading.Event()

    def late() -> None:
        with turn:
            if not over.is_set():
                inject(thread, ctypes.py_object(_LateError))

    timer = threading.Timer(seconds, late)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        with turn:
            over.set()
        # What was raised and has not arrived yet is taken back.
        inject(thread, None)


# -- ending the process ----------------------------------------------------------------------------

# When the process is to end, by what waits for it: a process may have several threads at work, and
# Python has one clock that works whatever they do.
_ends: dict[object, float] = {}
_turn = threading.Lock()


@contextmanager
def _or_end(seconds: float) -> Iterator[None]:
    """End this process if what is inside takes longer."""
    own = object()
    with _turn:
        _ends[own] = time.monotonic() + seconds
        _wind()
    try:
        yield
    finally:
        with _turn:
            del _ends[own]
            _wind()


def _wind() -> None:
    """Set the clock to the first of the ends."""
    faulthandler.cancel_dump_traceback_later()
    if _ends:
        # A millisecond where that has passed just now: the clock takes nothing less.
        left = max(min(_ends.values()) - time.monotonic(), 1e-3)
        faulthandler.dump_traceback_later(left, exit=True, file=_nowhere())


@lru_cache(maxsize=1)
def _nowhere() -> int:
    return os.open(os.devnull, os.O_WRONLY)
