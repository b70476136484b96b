"""Workers that are lost, and responses that end or hang them: each costs its point, not the study."""

from __future__ import annotations

import time
from concurrent.futures import (
    BrokenExecutor,
    Future,
    ThreadPoolExecutor,
)
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import prbayes as prb
from benchmarks.hostile import ENDING, EXECUTORS, REASONS, hostile
from prbayes.response.call import CallSettings, Points, Tally, respond
from prbayes.response.failures import OnFailure, ResponseError
from prbayes.response.store import Store

Replace, Retry, Abort = prb.response.Replace, prb.response.Retry, prb.response.Abort


def line(n: int) -> Points:
    return Points([np.arange(float(n))], [True])


def by_input(tally: Tally) -> dict[float, str]:
    return {float(f.inputs[0]): f.reason for f in tally.failed.values()}


# -- hostile responses -----------------------------------------------------------------------------


def long(where: str) -> Any:
    return pytest.param(where, marks=pytest.mark.long)


def slow(where: str) -> Any:
    """Return an executor whose losses are those of processes; by hand alone."""
    return pytest.param(where, marks=pytest.mark.slow)


NEEDED = {"loky": "joblib.externals.loky", "dask": "distributed"}


@pytest.mark.filterwarnings("ignore::DeprecationWarning:(distributed|dask|tornado).*")
@pytest.mark.parametrize(
    "where", [*map(long, ("nothing", "processes")), *map(slow, ("loky", "dask"))]
)
def test_hostile_responses_cost_their_points(
    where: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    safe = where == "nothing"
    limit = 6.0 if where == "dask" else 0.4
    if where in NEEDED:
        pytest.importorskip(NEEDED[where])
    n, points = 16, line(16)
    if safe:
        points = Points([np.delete(np.arange(float(n)), ENDING)], [True])
    x = points.arguments[0]
    expected = np.where(np.isin(x, list(REASONS)), -1.0, 2 * x)
    tally = Tally()
    store = Store(tmp_path, "y", columns=1)
    with EXECUTORS[where]() as executor:
        calling = CallSettings(
            "y",
            prb.scalar(hostile),
            executor,
            store,
            Replace(-1.0),
            timeout=None if safe else limit,
        )
        found = respond(calling, points, tally)
        np.testing.assert_array_equal(found, expected)
        # They are kept as failed, in a few words each, and none is computed again.
        again = Tally()
        np.testing.assert_array_equal(respond(calling, points, again), expected)
        assert again.computed <= 1
    told = by_input(tally)
    assert set(told) == set(x) & set(REASONS)
    for point, reason in told.items():
        in_thread = where == "dask" and point == 8  # which no alarm interrupts
        expected_reason = "it ended its worker (" if in_thread else REASONS[int(point)]
        assert reason.startswith(expected_reason), reason
        assert len(reason) < 1100
    assert store.failed(points.keys()) == {
        row: told[p] for row, p in enumerate(x) if p in told and p != 2
    }
    assert len(caplog.text) < 20_000


def test_a_failure_that_cannot_say_what_it_is_is_told() -> None:
    class Mute(Exception):  # noqa: N818
        def __str__(self) -> str:
            raise RuntimeError

    def response(x: float) -> float:
        raise Mute

    tally = Tally()
    respond(CallSettings("y", prb.scalar(response), None, None, Replace()), line(1), tally)
    assert by_input(tally) == {0.0: "it raised Mute: (its text raises RuntimeError)"}


@pytest.mark.parametrize("wrap", [prb.scalar, lambda f: f], ids=["scalar", "batched"])
@pytest.mark.parametrize("where", ["nothing", "threads"])
def test_a_response_that_changes_its_arguments_changes_nothing_else(where: str, wrap: Any) -> None:
    def greedy(x: Any, a: Any) -> Any:
        if np.ndim(x):
            x += a[0]
            if (x == 8).any():
                raise ArithmeticError("too steep")
        elif x == 7:
            raise ArithmeticError("too steep")
        else:
            x = x + a[0]
        a *= 2
        return x

    points = Points([np.arange(12.0), np.array([1.0, 5.0])], [True, False])
    expected = np.where(np.arange(12) == 7, -1.0, np.arange(12) + 1.0)
    with EXECUTORS[where]() as executor:
        calling = CallSettings("y", wrap(greedy), executor, None, Replace(-1.0))
        np.testing.assert_array_equal(respond(calling, points, Tally()), expected)


@pytest.mark.filterwarnings("ignore::DeprecationWarning:(distributed|dask|tornado).*")
@pytest.mark.parametrize("where", [long("processes"), slow("loky")])
def test_a_response_that_ends_its_worker_aborts_where_the_policy_says_so(
    where: str, tmp_path: Path
) -> None:
    def repaired(x: float) -> float:
        return 2 * x

    store = Store(tmp_path, "y", columns=1, version="1")
    with EXECUTORS[where]() as executor:
        points = Points([np.array([0.0, 10.0, 11.0, 6.0, 12.0])], [True])
        for policy in (Abort(), Retry(1, then=Abort())):
            calling = CallSettings("y", prb.scalar(hostile), executor, store, policy)
            with pytest.raises(ResponseError, match=r"y: a worker was lost \(.*on_failure=.*store"):
                respond(calling, points, Tally())
        # The same executor serves on, and what was finished before is kept.
        kept = len(store)
        assert kept >= 1
        tally = Tally()
        calling = CallSettings("y", prb.scalar(repaired), executor, store)
        np.testing.assert_array_equal(respond(calling, points, tally), 2 * points.arguments[0])
        assert tally.computed == 5 - kept


# -- executors in the place of those, for what takes them long ---------------------------------------


class KilledWorker(Exception):  # noqa: N818
    """By this name Dask says that several workers were lost with a task."""


class Fragile(ThreadPoolExecutor):
    """Loses a worker when a response ends it: as a whole, like pools of processes, or as Dask."""

    def __init__(self, max_workers: int = 2, loss: Any = BrokenExecutor) -> None:
        super().__init__(max_workers)
        self.loss, self.broken = loss, False

    def submit(self, work: Any, /, *job: Any, **keywords: Any) -> Any:
        if self.broken:
            raise BrokenExecutor("broken before")
        if job and 7.0 in job[0].arguments[0]:
            self.broken = self.loss is BrokenExecutor
            future: Any = Future()
            future.set_exception(self.loss("a process ended"))
            return future
        return super().submit(work, *job, **keywords)


# By this name those of the standard library and of loky are known.
Fragile.__name__ = "ProcessPoolExecutor"


def twice(x: Any) -> Any:
    return 2 * x


@pytest.mark.parametrize("response", [prb.scalar(twice), twice], ids=["scalar", "batched"])
@pytest.mark.parametrize("policy", [Replace(), Retry(1, then=Replace())])
@pytest.mark.parametrize("loss", [BrokenExecutor, KilledWorker])
def test_a_response_that_ends_its_worker_costs_that_point(
    response: Any, policy: OnFailure, loss: Any
) -> None:
    points = line(24)
    pool, tally = Fragile(loss=loss), Tally()
    for _ in range(2):  # the executor that is broken serves again
        found = respond(CallSettings("y", response, pool, None, policy), points, tally)
        expected = 2 * np.arange(24.0)
        expected[7] = np.nan
        np.testing.assert_array_equal(found, expected)
    ((point, reason),) = by_input(tally).items()
    assert point == 7.0
    assert reason.startswith(f"it ended its worker ({loss.__name__})")


class Unlucky(ThreadPoolExecutor):
    """Is broken from the start, and of no kind that can be made anew."""

    def submit(self, work: Any, /, *job: Any, **keywords: Any) -> Any:
        raise BrokenExecutor("its initializer failed")


def test_no_response_is_blamed_for_workers_that_end_by_themselves(tmp_path: Path) -> None:
    store = Store(tmp_path, "y", columns=1)
    with pytest.raises(
        ResponseError, match=r"y: a worker was lost .*also when it computed no response"
    ):
        respond(CallSettings("y", twice, Unlucky(), store, Replace()), line(4), Tally())
    assert len(store) == 0


def test_an_executor_that_is_closed_meanwhile_is_reported_and_nothing_finished_is_lost(
    tmp_path: Path,
) -> None:
    store, points = Store(tmp_path, "y", columns=1), line(8)
    pool = ThreadPoolExecutor(1)

    def response(x: float) -> float:
        time.sleep(0.05)
        if x == 2:
            pool.shutdown(wait=False, cancel_futures=True)  # the next one waits by now
        return 2 * x

    with pytest.raises(ResponseError, match=r"y: the executor (was closed|failed) .*run again"):
        respond(CallSettings("y", prb.scalar(response), pool, store, Replace()), points, Tally())
    values, known = store.find(points.keys())
    np.testing.assert_array_equal(np.flatnonzero(known), [0, 1, 2])
    np.testing.assert_array_equal(values[known], 2 * np.arange(8.0)[known])
    # It is closed for good.
    with pytest.raises(ResponseError, match=r"y: the executor failed \(RuntimeError: cannot sche"):
        respond(CallSettings("y", twice, pool, store, Replace()), points, Tally())
