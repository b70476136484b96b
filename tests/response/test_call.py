"""Calls of the response at points: executors, chunks, failures, storage, and killed runs."""

from __future__ import annotations

import logging
import math
import re
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import (
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
from first_use import first_use

import prbayes as prb
from prbayes.model.random_variable import nodes
from prbayes.response.call import (
    CallSettings,
    Points,
    Tally,
    checked,
    chunk_size,
    chunks,
    compute,
    respond,
)
from prbayes.response.executors import has_slipped
from prbayes.response.failures import Abort, OnFailure, Replace
from prbayes.response.store import Store

N = 64


def model(response: Any, propagation: Any = None, **keywords: Any) -> pm.Model:
    propagation = prb.Reweighted(N, **keywords) if propagation is None else propagation
    with pm.Model() as found:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        prb.Simulator(
            "y",
            response,
            x,
            2.0,
            metric=prb.AreaMetric(),
            observed=[1, 2, 3, 5.0],
            propagation=propagation,
        )
    first_use(found)
    return found


def stored(found: pm.Model) -> Any:
    """Return the design's responses."""
    return next(iter(nodes(found).values())).bound.design.sample.values


def responses(found: pm.Model) -> Any:
    return next(iter(nodes(found).values())).bound.responses


def times(x: Any, a: Any) -> Any:
    return a * x


def slow_times(x: Any, a: Any) -> Any:
    time.sleep(0.002 * np.size(x))
    return a * x


def fails_above_two(x: float, a: float) -> float:
    if x > 2:
        raise ArithmeticError("too steep")
    return a * x


def nan_above_two(x: float, a: float) -> float:
    return np.nan if x > 2 else a * x


EXPECTED = stored(model(times))
POINTS = EXPECTED / 2


# -- the same numbers, wherever they are computed --------------------------------------------------


@pytest.fixture(scope="module")
def processes() -> Iterator[Executor]:
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        yield pool


@pytest.mark.long
@pytest.mark.parametrize("response", [times, slow_times, prb.scalar(times), lambda x, a: a * x])
def test_executors_give_the_same_responses(response: Any, processes: Executor) -> None:
    np.testing.assert_array_equal(stored(model(response)), EXPECTED)
    with ThreadPoolExecutor(3) as threads:
        for executor in (threads, processes):
            found = model(response, executor=executor)
            np.testing.assert_array_equal(stored(found), EXPECTED)
            assert responses(found).computed == N


def test_resimulated_and_fresh_use_the_executor_too() -> None:
    seen = set()

    def response(x: Any, a: Any) -> Any:
        seen.add(threading.current_thread().name)
        return a * x

    with ThreadPoolExecutor(2, thread_name_prefix="far") as pool:
        for propagation in (prb.Resimulated(N, executor=pool), prb.Fresh(N, executor=pool)):
            seen.clear()
            prb.sample_smc(
                20,
                chains=1,
                model=model(response, propagation),
                epsilon=1.0,
                adjustment=None,
                random_seed=1,
                progressbar=False,
            )
            assert seen
            assert all(name.startswith("far") for name in seen)


def test_a_multivariate_input_arrives_whole_at_a_scalar_function() -> None:
    shapes = set()

    def length(x: Any) -> float:
        shapes.add(np.shape(x))
        return float(np.hypot(*x))

    with pm.Model() as found:
        x = pm.MvNormal.dist(pm.Normal("mu", 0, 1, shape=2), np.eye(2))
        prb.Simulator(
            "y",
            prb.scalar(length),
            x,
            metric=prb.AreaMetric(),
            observed=[1, 2.0],
            propagation=prb.Reweighted(N),
        )
    assert (stored(found) > 0).all()
    assert shapes == {(2,)}


def line(n: int) -> Points:
    """The numbers 0 to n - 1, and a constant."""
    return Points([np.arange(float(n)), 2.0], [True, False])


def test_chunks_follow_the_measured_cost() -> None:
    sizes: list[int] = []

    def response(x: Any, a: Any) -> Any:
        sizes.append(len(x))
        time.sleep(0.01 * len(x))
        return a * x

    tally = Tally()
    found = respond(CallSettings("y", response), line(100), tally)
    np.testing.assert_array_equal(found, 2 * np.arange(100.0))
    assert sizes[0] == 16
    # 10 ms each: at most 20 of them make up the 200 ms of a chunk; a slow machine makes them fewer.
    assert all(5 <= s <= 20 for s in sizes[1:-1])
    assert tally.computed == 100


def test_a_scalar_function_that_is_slow_is_a_task_of_its_own() -> None:
    calling = CallSettings("y", prb.scalar(lambda x, a: time.sleep(0.02) or x))
    found = chunks(calling, line(5), np.arange(5), False, Tally())
    taken = [rows.size for done in found for rows, _ in done]
    assert taken == [1] * 5


def test_responses_that_are_done_while_the_disk_is_busy_are_stored_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commits, add = [], Store.add_all

    def slow(self: Store, parts: Any) -> None:
        commits.append(len(parts))
        time.sleep(0.03)
        add(self, parts)

    monkeypatch.setattr(Store, "add_all", slow)
    store = Store(tmp_path, "y", columns=2)
    with ThreadPoolExecutor(4) as pool:
        calling = CallSettings("y", prb.scalar(lambda x, a: time.sleep(0.01) or a * x), pool, store)
        found = respond(calling, line(40), Tally())
    assert sum(commits) == 40
    assert len(commits) < 20
    np.testing.assert_array_equal(store.find(line(40).keys())[0], found)
    np.testing.assert_array_equal(found, 2 * np.arange(40.0))


@pytest.mark.parametrize(
    ("seconds", "left", "workers", "alone", "batched"),
    [
        (0.0, 1000, 1, 1, 16),  # nothing is known yet
        (0.0, 10, 1, 1, 10),
        (1e-5, 1000, 1, 1000, 1000),  # all fit into 0.2 s
        (1e-3, 1000, 1, 200, 200),
        (0.02, 1000, 1, 1, 10),
        (1.0, 1000, 1, 1, 1),
        (1e-5, 1000, 5, 100, 100),  # the workers share them, and once more
        (1e-5, 3, 5, 1, 1),
    ],
)
def test_the_size_of_a_chunk(
    seconds: float, left: int, workers: int, alone: int, batched: int
) -> None:
    with ThreadPoolExecutor(workers) as pool:
        executor = pool if workers > 1 else None
        for function, expected in ((prb.scalar(times), alone), (times, batched)):
            calling = CallSettings("y", function, executor)
            found = chunk_size(calling, Tally(seconds=seconds), left, workers)
            assert found == pytest.approx(expected, abs=1)
            assert 1 <= found <= left


def test_a_tally_forgets_old_chunks_slowly() -> None:
    tally = Tally()
    tally.count(10, 5.0)
    assert tally == Tally(computed=10, seconds=0.5)
    tally.count(2, 3.0)
    assert tally.computed == 12
    assert tally.seconds == pytest.approx(0.7 * 0.5 + 0.3 * 1.5)


# -- failures --------------------------------------------------------------------------------------

STEEP = POINTS > 2
BATCHED = pytest.mark.parametrize("kind", ["scalar", "batched", "threads"])


def failing(
    kind: str, function: Any, on_failure: OnFailure | None = None, **keywords: Any
) -> pm.Model:
    keywords |= {} if on_failure is None else {"on_failure": on_failure}
    if kind == "batched":
        return model(lambda x, a: np.array([function(v, a) for v in x]), **keywords)
    if kind == "threads":
        with ThreadPoolExecutor(2) as pool:
            return model(prb.scalar(function), executor=pool, **keywords)
    return model(prb.scalar(function), **keywords)


@BATCHED
def test_an_exception_aborts_by_default(kind: str) -> None:
    with pytest.raises(prb.response.ResponseError, match=r"y: .*raised ArithmeticError: too steep"):
        failing(kind, fails_above_two)


@BATCHED
@pytest.mark.parametrize("function", [fails_above_two, nan_above_two])
def test_replaced(kind: str, function: Any, caplog: pytest.LogCaptureFixture) -> None:
    assert 3 < STEEP.sum() < N - 3
    with caplog.at_level(logging.WARNING, "prbayes"):
        found = failing(kind, function, prb.response.Replace(np.inf))
    np.testing.assert_array_equal(stored(found), np.where(STEEP, np.inf, EXPECTED))
    assert responses(found).failures == STEEP.sum()
    assert f"y: {STEEP.sum()} of {N} responses failed, replaced by inf" in caplog.text
    if function is fails_above_two:
        assert "too steep" in caplog.text


@BATCHED
def test_nan_is_a_result_by_default_and_a_failure_if_asked_for(kind: str) -> None:
    np.testing.assert_array_equal(np.isnan(stored(failing(kind, nan_above_two))), STEEP)
    with pytest.raises(prb.response.ResponseError, match="it is NaN"):
        failing(kind, nan_above_two, prb.response.Abort(on_nan=True))


def test_retried_once_and_then_it_works() -> None:
    calls: dict[float, int] = {}

    def moody(x: float, a: float) -> float:
        calls[x] = calls.get(x, 0) + 1
        if x > 2 and calls[x] == 1:
            raise OSError("license server")
        return a * x

    found = failing("scalar", moody, prb.response.Retry(1, then=prb.response.Abort()))
    np.testing.assert_array_equal(stored(found), EXPECTED)
    # The simulator tries 16 points of the prior only where it has to; here every design point,
    # the steep ones twice.
    assert sorted(set(calls.values())) == [1, 2]
    assert responses(found).computed == N + STEEP.sum()


@pytest.mark.exact
def test_retried_in_vain() -> None:
    found = failing(
        "scalar", fails_above_two, prb.response.Retry(2, then=prb.response.Replace(-1.0))
    )
    np.testing.assert_array_equal(stored(found), np.where(STEEP, -1.0, EXPECTED))
    assert responses(found).computed == N + 2 * STEEP.sum()
    with pytest.raises(prb.response.ResponseError, match="too steep"):
        failing("scalar", fails_above_two, prb.response.Retry(2, then=prb.response.Abort()))


@pytest.mark.exact
@BATCHED
def test_the_store_knows_which_points_failed_and_why(kind: str, tmp_path: Path) -> None:
    failing(
        kind,
        fails_above_two,
        prb.response.Retry(1, then=prb.response.Replace(-1.0)),
        store=tmp_path,
    )
    connection = sqlite3.connect(tmp_path / "responses.sqlite")
    query = "SELECT key, reason FROM run WHERE state = 'failed'"
    found = dict(connection.execute(query).fetchall())
    connection.close()
    keys = [np.array([x, 2.0]).tobytes() for x in POINTS[STEEP]]
    assert found == dict.fromkeys(keys, "it raised ArithmeticError: too steep")


def test_a_wrong_shape_is_a_mistake_and_no_failure() -> None:
    with pytest.raises(prb.response.ResponseError, match=r"y: the response returned shape \(2,\)"):
        model(lambda x, a: (a * x)[:2], on_failure=prb.response.Replace())


# -- what is stored --------------------------------------------------------------------------------


def test_a_failure_says_where() -> None:
    def root(x: float, y: float) -> float:
        return math.sqrt(x) + y  # which there is none of

    with pm.Model() as found:
        inputs = [pm.Normal.dist(pm.Normal(name, 0, 1), 1.0) for name in ("mu", "nu")]
        given = {"metric": prb.AreaMetric(), "observed": [1.0, 2.0, 3.0]}
        prb.Simulator("y", prb.scalar(root), *inputs, **given)
    with pytest.raises(
        prb.response.ResponseError,
        match=r"failed at 1 point\(s\), the first with inputs \(-[\d.]+, -?[\d.]+\): it raised "
        r"ValueError.*; repair it, keep priors and inputs where it has a response, or pass",
    ) as raised:
        first_use(found)
    x, y = map(float, re.findall(r"inputs \((.*?), (.*?)\)", str(raised.value))[0])
    with pytest.raises(ValueError, match="math domain"):
        root(x, y)


def test_a_function_that_never_gives_what_is_observed_ends_the_run_whatever_the_policy() -> None:
    columns = {"a": np.arange(20.0), "b": np.arange(20.0) ** 2}
    policy = prb.response.Retry(1, then=prb.response.Replace())
    calls = 0

    def outputs(x: float, y: float) -> dict[str, float]:
        nonlocal calls
        calls += 1
        return {"a": x, "c": y} if calls > good else {"a": x, "b": y}

    def run() -> prb.Optimum:
        with pm.Model() as model:
            inputs = [pm.Normal.dist(pm.Normal(name, 5, 5), 5.0) for name in ("mu", "nu")]
            prb.Simulator(
                "y", prb.scalar(outputs), *inputs, metric=prb.Joint(prb.AreaMetric()),
                observed=columns, propagation=prb.Reweighted(64, on_failure=policy),
            )  # fmt: skip
            return prb.minimize(model, progressbar=False)

    good = 0
    wrong = r"keys \['a', 'c'\], expected \['a', 'b'\].*; repair it; if this is what a run that"
    with pytest.raises(prb.response.ResponseError, match=wrong):
        run()
    assert calls < 5
    # Later on it is what some runs return that failed.
    good, calls = 60, 0
    with pytest.raises(prb.propagation.DesignError, match="lost mass"):
        run()
    assert calls >= 64


@pytest.mark.parametrize("version", [None, "1"])
def test_nothing_is_computed_twice_but_one_response_without_a_version(
    version: str | None, tmp_path: Path
) -> None:
    again = int(version is None)
    kept: dict[str, Any] = {"store": tmp_path, "version": version}
    first = model(prb.scalar(times), **kept)
    second = model(prb.scalar(times), **kept)
    np.testing.assert_array_equal(stored(second), EXPECTED)
    assert (responses(first).computed, responses(second).computed) == (N, again)
    more = model(prb.scalar(times), propagation=prb.Reweighted(N, random_seed=1, **kept))
    assert responses(more).computed == N + again  # other points
    data = Store(tmp_path, "y", version=version).to_dataset()
    assert data["response"].size == 2 * N
    np.testing.assert_allclose(data["response"], 2 * data["inputs"][:, 0])
    np.testing.assert_array_equal(data["inputs"][:, 1], 2.0)  # the constant


def test_an_optimum_tells_what_was_computed_and_what_it_rests_on(tmp_path: Path) -> None:
    first = prb.minimize(model(prb.scalar(times), store=tmp_path))
    again = prb.minimize(model(prb.scalar(times), store=tmp_path))
    assert first.search.n_computed == first.n_responses == again.n_responses >= N
    assert (again.search.n_computed, again.point) == (1, first.point)


def by_factor(factor: float, calls: list[Any] | None = None) -> Any:
    """Return a response whose variable is not among its inputs."""

    def response(x: Any, a: Any) -> Any:
        if calls is not None:
            calls.append(x)
        return factor * a * x

    return response


@pytest.mark.parametrize("wrapped", [prb.scalar, lambda f: f], ids=["scalar", "batch"])
def test_a_store_refuses_a_response_whose_variables_have_changed(
    wrapped: Callable[[Any], Any], tmp_path: Path
) -> None:
    model(wrapped(by_factor(1.0)), store=tmp_path)
    before = Store(tmp_path, "y").to_dataset()
    for changed, calls in ((1.001, []), (-1.0, [])):
        with pytest.raises(
            prb.response.StoreError,
            match=r"y: store: got a response that gives .* expected .* stored in .*have changed",
        ):
            model(wrapped(by_factor(changed, calls)), store=tmp_path)
        assert np.size(calls[0]) == len(calls) == 1
    # Also at points of which none is stored; and rounding is tolerated.
    with pytest.raises(prb.response.StoreError, match="have changed"):
        model(
            wrapped(by_factor(2.0)),
            propagation=prb.Reweighted(N, random_seed=1, store=tmp_path),
        )
    assert Store(tmp_path, "y").to_dataset().identical(before)
    model(wrapped(by_factor(1 + 1e-12)), store=tmp_path)


def test_a_response_that_raises_where_a_number_is_stored_is_another_one(tmp_path: Path) -> None:
    model(prb.scalar(times), store=tmp_path)

    def broken(x: Any, a: Any) -> Any:
        raise ArithmeticError("no license")

    with pytest.raises(prb.response.StoreError, match=r"gives nothing .*no license"):
        model(prb.scalar(broken), store=tmp_path)


@pytest.mark.exact
def test_responses_of_each_version_are_kept_apart(tmp_path: Path) -> None:
    for version, factor in (("1", 1.0), ("2", 3.0), (None, 5.0), ("1", 1.0)):
        found = model(prb.scalar(by_factor(factor)), store=tmp_path, version=version)
        np.testing.assert_array_equal(stored(found), factor * EXPECTED)
    assert responses(found).computed == 0
    with pytest.raises(TypeError, match="version: got int 2, expected a text"):
        model(times, store=tmp_path, version=2)
    with pytest.raises(prb.response.StoreError, match=r"version '3', expected one of \['y', ver"):
        Store(tmp_path, "y", version="3")


def test_a_clone_does_not_compute_a_stored_response_once_more(tmp_path: Path) -> None:
    model(prb.scalar(times), store=tmp_path)
    found = model(prb.scalar(times), store=tmp_path)
    prb.minimize(pm.do(found, {}), progressbar=False)
    assert responses(found).computed == 1


@pytest.mark.exact
def test_another_constant_is_another_input(tmp_path: Path) -> None:
    model(times, store=tmp_path)
    with pm.Model() as other:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        prb.Simulator(
            "y",
            times,
            x,
            3.0,
            metric=prb.AreaMetric(),
            observed=[1, 2.0],
            propagation=prb.Reweighted(N, store=tmp_path),
        )
    np.testing.assert_array_equal(stored(other), 1.5 * EXPECTED)
    assert responses(other).computed == N


def test_what_was_computed_before_a_failure_is_kept(tmp_path: Path) -> None:
    with pytest.raises(prb.response.ResponseError, match=r"\d+ responses are kept in"):
        model(prb.scalar(fails_above_two), store=tmp_path)
    kept = len(Store(tmp_path, "y", columns=2))
    found = model(prb.scalar(times), store=tmp_path)
    np.testing.assert_array_equal(stored(found), EXPECTED)
    assert responses(found).computed == N - kept + 1  # one of those that are kept
    assert kept == int(np.argmax(STEEP))  # all that came before the first steep point


def test_an_executor_that_does_not_tell_its_size_gets_work_for_many() -> None:
    class Cluster:
        """Begins once all has come, or a second later."""

        most = 0

        def __init__(self, pool: ThreadPoolExecutor) -> None:
            self.pool, self.under_way, self.lock, self.full = (
                pool,
                0,
                threading.Lock(),
                threading.Event(),
            )

        def submit(self, function: Any, *arguments: Any) -> Any:
            with self.lock:
                self.under_way += 1
                self.most = max(self.most, self.under_way)
                if self.under_way == N:
                    self.full.set()
            return self.pool.submit(self.work, function, *arguments)

        def work(self, function: Any, *arguments: Any) -> Any:
            self.full.wait(1.0)
            with self.lock:
                self.under_way -= 1
            return function(*arguments)

        map = None

    with ThreadPoolExecutor(N) as pool:
        cluster = Cluster(pool)
        calling = CallSettings("y", prb.scalar(lambda x: 2 * x), cluster)  # type: ignore[arg-type]
        found = respond(calling, Points([POINTS], [True]), Tally())
    np.testing.assert_array_equal(found, 2 * POINTS)
    assert cluster.most == N


@pytest.mark.parametrize("error", [ArithmeticError, BrokenExecutor])
def test_what_is_being_computed_when_one_fails_is_kept(
    error: type[Exception], tmp_path: Path
) -> None:
    """Four tasks are begun, the first fails: the others are waited for, and no more are begun."""

    def function(x: float) -> float:
        if x == 0:
            raise error("too steep")
        time.sleep(0.3)
        return 2 * x

    class Pool(ThreadPoolExecutor):
        """Loses a worker, rather than an answer, at a `BrokenExecutor`."""

        def submit(self, work: Any, /, *job: Any, **keywords: Any) -> Any:
            if error is BrokenExecutor and job[0].arguments[0][0] == 0:
                raise error("too steep")
            return super().submit(work, *job, **keywords)

    points = Points([np.arange(12.0)], [True])
    store = Store(tmp_path, "y", columns=1)
    with Pool(2) as pool, pytest.raises(prb.response.ResponseError, match="too steep"):
        respond(CallSettings("y", prb.scalar(function), pool, store), points, Tally())
    values, known = store.find(points.keys())
    np.testing.assert_array_equal(np.flatnonzero(known), [1, 2, 3])
    np.testing.assert_array_equal(values[known], [2.0, 4.0, 6.0])


@pytest.mark.exact
def test_stored_failures_are_replaced_as_the_policy_of_the_day_says(tmp_path: Path) -> None:
    model(prb.scalar(fails_above_two), store=tmp_path, on_failure=prb.response.Replace(np.inf))
    found = model(
        prb.scalar(fails_above_two), store=tmp_path, on_failure=prb.response.Replace(-1.0)
    )
    np.testing.assert_array_equal(stored(found), np.where(STEEP, -1.0, EXPECTED))
    assert responses(found).computed == 1


# -- failures are not results ----------------------------------------------------------------------


def fails_when_busy(busy: list[bool]) -> Any:
    def response(x: float, a: float) -> float:
        if busy[0] and x > 2:
            raise OSError("license server")
        return a * x

    return prb.scalar(response)


@pytest.mark.exact
@pytest.mark.parametrize(
    "first", [prb.response.Replace(np.inf), prb.response.Retry(2, then=prb.response.Replace())]
)
def test_a_failure_in_the_store_is_no_result_under_abort(tmp_path: Path, first: OnFailure) -> None:
    busy = [True]
    response = fails_when_busy(busy)
    model(response, store=tmp_path, on_failure=first)
    with pytest.raises(prb.response.ResponseError, match="license server"):
        model(response, store=tmp_path)
    busy[0] = False
    found = model(response, store=tmp_path)
    np.testing.assert_array_equal(stored(found), EXPECTED)
    # One to see whether the response is the same, and those that had failed.
    assert responses(found).computed == 1 + STEEP.sum()


@pytest.mark.exact
def test_failures_are_tried_again_when_asked_for(tmp_path: Path) -> None:
    busy, replace = [True], prb.response.Replace(-1.0)
    response = fails_when_busy(busy)
    model(response, store=tmp_path, on_failure=replace, version="1")
    busy[0] = False
    kept = model(response, store=tmp_path, on_failure=replace, version="1")
    np.testing.assert_array_equal(stored(kept), np.where(STEEP, -1.0, EXPECTED))
    assert responses(kept).computed == 0
    assert len(responses(kept).failed) == STEEP.sum()
    assert {f.reason for f in responses(kept).failed} == {"it raised OSError: license server"}
    other = model(response, store=tmp_path, on_failure=replace, version="2")
    np.testing.assert_array_equal(stored(other), EXPECTED)
    again = model(response, store=tmp_path, on_failure=replace, version="1", retry_failed=True)
    np.testing.assert_array_equal(stored(again), EXPECTED)
    assert responses(again).computed == STEEP.sum()
    assert not responses(again).failed
    # What was tried again is a result from then on.
    assert not responses(model(response, store=tmp_path, on_failure=replace, version="1")).failed


@pytest.mark.exact
@BATCHED
def test_failures_are_told_with_their_inputs(kind: str) -> None:
    found = failing(kind, fails_above_two, prb.response.Replace(np.inf))
    failed = responses(found).failed
    assert sorted(f.inputs[0] for f in failed) == sorted(POINTS[STEEP])
    assert {f.reason for f in failed} == {"it raised ArithmeticError: too steep"}


def test_a_copy_of_a_response_has_failures_of_its_own() -> None:
    found = responses(failing("scalar", fails_above_two, prb.response.Replace(np.inf)))
    other = found.copied()
    other([np.array([5.0])], [])
    assert len(other.failed) == len(found.failed) + 1


@BATCHED
def test_a_response_that_leaves_python_is_a_failure_like_another(kind: str) -> None:
    def leaves(x: float, a: float) -> float:
        if x > 2:
            raise SystemExit("bye")
        return a * x

    found = failing(kind, leaves, prb.response.Replace(np.inf))
    np.testing.assert_array_equal(stored(found), np.where(STEEP, np.inf, EXPECTED))
    with pytest.raises(prb.response.ResponseError, match="raised SystemExit: bye"):
        failing(kind, leaves)


class Slipping(Executor):
    """As Dask's, which takes a result for an exception where its worker leaves at that moment."""

    def __init__(self, slips: int) -> None:
        self.slips = slips

    def submit(self, work: Any, /, *job: Any, **keywords: Any) -> Future[Any]:
        future: Future[Any] = Future()
        result = work(*job, **keywords)
        if not self.slips:
            future.set_result(result)
            return future
        self.slips -= 1
        names: dict[str, Any] = {}
        text = "def cascade(result):\n    typ, exc, tb = result"
        exec(compile(text, "distributed/cfexecutor.py", "exec"), names)
        try:
            names["cascade"](result)
        except TypeError as error:
            future.set_exception(error)
        return future


@pytest.mark.parametrize("policy", [Abort(), Replace()], ids=["abort", "replace"])
def test_a_result_that_slipped_away_is_computed_again(policy: Any) -> None:
    found = model(prb.scalar(times), executor=Slipping(3), on_failure=policy)
    np.testing.assert_array_equal(stored(found), EXPECTED)


def test_a_type_error_of_another_is_no_slip() -> None:
    assert not has_slipped(TypeError("x"))
    assert not has_slipped(None)


def test_points_give_keys_of_all_numbers_in_the_order_of_the_arguments() -> None:
    x, z = np.arange(3.0), np.arange(6.0).reshape(3, 2)
    points = Points([z, 7.0, x, np.array([8.0, 9.0])], [True, False, True, False])
    assert len(points) == 3
    expected = [[0, 1, 7, 0, 8, 9], [2, 3, 7, 1, 8, 9], [4, 5, 7, 2, 8, 9]]
    np.testing.assert_array_equal(points.keys(), expected)
    np.testing.assert_array_equal(points.at(np.array([2, 0])).keys(), np.array(expected)[[2, 0]])
    first, constant, number, _ = points.at(1).arguments
    np.testing.assert_array_equal(first, [2.0, 3.0])
    assert (constant, number) == (7.0, 1.0)


@pytest.mark.parametrize(
    ("result", "message"),
    [
        (np.ones(3) + 1j, "complex numbers, expected an array of real numbers"),
        (None, "NoneType of dtype object"),
        (np.ones((3, 1)), r"shape \(3, 1\) for inputs of shapes \(3,\), \(\), expected \(3,\)"),
        (1.0, r"shape \(\) .* wrap a function of one specimen in prb.scalar"),
    ],
)
def test_what_is_no_response_is_refused(result: Any, message: str) -> None:
    with pytest.raises(prb.response.ResponseError, match=f"the response returned {message}"):
        checked(result, (3,), [np.zeros(3), 1.0])
    np.testing.assert_array_equal(checked([1, True, np.nan], (3,), [])[0], [1.0, 1.0, np.nan])


def test_a_scalar_needs_a_function() -> None:
    with pytest.raises(TypeError, match=r"scalar: got int, expected a function of one specimen's"):
        prb.scalar(3)  # type: ignore[arg-type]


def test_points_that_fail_are_found_by_halving() -> None:
    seen: list[int] = []

    def response(x: Any, a: Any) -> Any:
        seen.append(len(x))
        if np.isin(x, [3.0, 4.0]).any():
            raise ArithmeticError(f"at {x[0]:.0f}")
        return a * x

    chunk = compute(response, line(8), True)
    expected = [0.0, 2.0, 4.0, np.nan, np.nan, 10.0, 12.0, 14.0]
    np.testing.assert_array_equal(chunk.values, expected)
    text = "it raised ArithmeticError: at "
    assert chunk.raised == {3: text + "3", 4: text + "4"}
    assert seen == [8, 4, 2, 2, 1, 1, 4, 2, 1, 1, 2]
    # Not tolerated: no more calls.
    seen.clear()
    chunk = compute(response, line(8), False)
    assert seen == [8]
    assert np.isnan(chunk.values).all()
    assert list(chunk.raised) == [0]


def test_of_multivariate_inputs_a_call_by_hand_tells_what_to_call() -> None:
    response = prb.scalar(lambda x: x[0] + x[1])
    with pytest.raises(IndexError) as caught:
        response(np.ones((3, 2)))
    assert "response.function(...)" in caught.value.__notes__[0]
    assert response.function(np.array([1.0, 2.0])) == 3.0
