"""Time limits: what runs in Python ends, also in a thread; what hangs elsewhere ends its process."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest

from prbayes.response import time_limit
from prbayes.response.time_limit import limited

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
        not time_limit._ends
        and signal.getsignal(signal.SIGALRM) is signal.SIG_DFL
        and signal.getitimer(signal.ITIMER_REAL)[0] == 0
    )


@MAIN_OR_THREAD
def test_what_runs_in_python_is_ended(where: str) -> None:
    def hangs() -> None:
        with limited(0.05):
            spin(10.0)

    begun = time.perf_counter()
    with pytest.raises(TimeoutError, match=r"^no result within timeout = 0.05 s$"):
        run(where, hangs)
    assert time.perf_counter() - begun < 1.0
    assert nothing_is_left()


@MAIN_OR_THREAD
def test_what_is_in_time_is_left_alone(where: str) -> None:
    def quick() -> int:
        for _ in range(200):
            with limited(0.02):
                pass
        # None of those that were set comes later.
        spin(0.04)
        return 3

    assert run(where, quick) == 3
    assert nothing_is_left()


@MAIN_OR_THREAD
def test_a_limit_at_the_very_end_is_one_or_the_other(where: str) -> None:
    def at_the_edge() -> int:
        late = 0
        for i in range(60):
            try:
                with limited(0.002):
                    spin(0.002 + 1e-5 * (i - 30))
            except TimeoutError:
                late += 1
        time.sleep(0.01)
        return late

    assert 0 <= int(str(run(where, at_the_edge))) <= 60
    assert nothing_is_left()


def test_an_alarm_while_the_clock_is_stopped_comes_too_late(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stop = signal.setitimer

    def stopped(which: int, seconds: float) -> None:
        if seconds == 0:
            signal.raise_signal(signal.SIGALRM)
        stop(which, seconds)

    monkeypatch.setattr(signal, "setitimer", stopped)
    with limited(5.0):
        spin(0.001)
    assert nothing_is_left()


def test_a_time_limit_of_the_response_s_own_is_its_own() -> None:
    def own() -> None:
        with limited(5.0):
            raise TimeoutError("no answer from the license server")

    with pytest.raises(TimeoutError, match="license server"):
        own()
    with limited(None):
        assert nothing_is_left()


@MAIN_OR_THREAD
def test_what_is_said_in_other_words_of_what_was_late_is_a_time_limit(where: str) -> None:
    def respond() -> None:
        try:
            spin(10.0)
        except BaseException as error:
            raise RuntimeError("Failed to instantiate model") from error

    def late() -> None:
        with limited(0.05):
            respond()

    with pytest.raises(TimeoutError, match=r"^no result within timeout = 0.05 s$"):
        run(where, late)
    assert nothing_is_left()


def test_without_signals_the_main_thread_is_ended_like_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delattr(signal, "setitimer")
    with pytest.raises(TimeoutError), limited(0.05):
        spin(10.0)


def test_two_threads_have_a_clock_each(monkeypatch: pytest.MonkeyPatch) -> None:
    wound: list[float] = []
    monkeypatch.setattr(
        "faulthandler.dump_traceback_later", lambda left, **_: wound.append(round(left, 1))
    )
    first, second = threading.Event(), threading.Event()

    def long() -> None:
        with limited(20.0):
            first.set()
            second.wait(10)

    thread = threading.Thread(target=long)
    thread.start()
    first.wait(10)
    with limited(2.0):
        pass
    second.set()
    thread.join()
    # The shorter one is first, and then the longer one again.
    assert wound == [31.0, 4.0, 31.0]
    assert nothing_is_left()


HANGS = """
import importlib.util, sys, threading, time
spec = importlib.util.spec_from_file_location("time_limit", sys.argv[1])
time_limit = importlib.util.module_from_spec(spec)
spec.loader.exec_module(time_limit)

def hangs():
    with time_limit.limited(0.05):
        try:
            time.sleep(600)
        except TimeoutError:
            time.sleep(600)

thread = threading.Thread(target=hangs)
thread.start()
thread.join()
"""


def test_what_hangs_elsewhere_ends_its_process() -> None:
    begun = time.perf_counter()
    command = [sys.executable, "-c", HANGS, time_limit.__file__]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 1
    assert done.stderr == ""
    assert 1.0 < time.perf_counter() - begun < 20.0
