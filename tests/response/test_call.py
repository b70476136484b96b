"""Calls of the response at points: executors, chunks, failures, storage, and killed runs."""

from __future__ import annotations

import logging
import math
import re
import sqlite3
import time
from collections.abc import Callable
from concurrent.futures import (
    BrokenExecutor,
    Executor,
    Future,
    ThreadPoolExecutor,
)
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pymc as pm
import pytest
import xarray as xr
from first_use import first_use

import prbayes as prb
from prbayes.model.random_variable import nodes
from prbayes.response.call import (
    CallSettings,
    Points,
    Tally,
    checked,
    chunk_size,
    compute,
    respond,
)
from prbayes.response.executors import has_slipped
from prbayes.response.failures import Abort, Replace, ResponseError, Retry
from prbayes.response.outputs import Outputs, read_observed
from prbayes.response.store import Store, StoreError

N = 64


def model(response: Any, propagation: Any = None, **settings: Any) -> pm.Model:
    """Return a model whose first responses are computed."""
    with pm.Model() as found:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        data = {"metric": prb.AreaMetric(), "observed": [1, 2, 3, 5.0]}
        propagation = propagation or prb.Reweighted(N, **settings)
        prb.Simulator("y", response, x, 2.0, **data, propagation=propagation)
    first_use(found)
    return found


def stored(found: pm.Model) -> Any:
    """Return the design's responses."""
    return next(iter(nodes(found).values())).bound.design.sample.values


def responses(found: pm.Model) -> Any:
    return next(iter(nodes(found).values())).bound.responses


def times(x: Any, a: Any) -> Any:
    return a * x


def fails_above_two(x: float, a: float) -> float:
    if x > 2:
        raise ArithmeticError("too steep")
    return a * x


def leaves_above_two(x: float, a: float) -> float:
    if x > 2:
        raise SystemExit("bye")
    return a * x


def nan_above_two(x: float, a: float) -> float:
    return np.nan if x > 2 else a * x


def line(n: int) -> Points:
    """The numbers 0 to n - 1, and a constant."""
    return Points([np.arange(float(n)), 2.0], [True, False])


X = np.random.default_rng(1).normal(1.0, 1.4, N)
STEEP = X > 2
KINDS = pytest.mark.parametrize("kind", ["scalar", "batched", "threads"])


def run(
    function: Any, kind: str = "scalar", points: Points | None = None, **settings: Any
) -> tuple[Any, Tally]:
    """Return responses at N points, or at those given, and what was counted."""
    tally = Tally()
    with ThreadPoolExecutor(2) if kind == "threads" else nullcontext() as pool:
        response = prb.scalar(function)
        if kind == "batched":
            response = lambda x, a: np.array([function(v, a) for v in x])  # noqa: E731
        calling = CallSettings("y", response, pool, **settings)
        points = Points([X, 2.0], [True, False]) if points is None else points
        return respond(calling, points, tally), tally


# -- the same numbers, wherever they are computed --------------------------------------------------


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
        (0.0, 10, 1, 1, 3),  # never all at once
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


@KINDS
@pytest.mark.parametrize(
    ("function", "reason", "strict"),
    [
        (fails_above_two, "it raised ArithmeticError: too steep", Abort()),
        (leaves_above_two, "it raised SystemExit: bye", Abort()),
        (nan_above_two, "it is NaN", Abort(on_nan=True)),
    ],
)
def test_a_failure_is_replaced_or_ends_the_run(
    kind: str, function: Any, reason: str, strict: Abort, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "prbayes"):
        values, tally = run(function, kind, on_failure=Replace(np.inf))
    np.testing.assert_array_equal(values, np.where(STEEP, np.inf, 2 * X))
    assert tally.failures == STEEP.sum()
    assert f"y: {STEEP.sum()} of {N} responses failed, replaced by inf" in caplog.text
    assert sorted(f.inputs[0] for f in tally.failed.values()) == sorted(X[STEEP])
    assert {f.reason for f in tally.failed.values()} == {reason}
    with pytest.raises(ResponseError, match=f"y: .*{reason}"):
        run(function, kind, on_failure=strict)
    if function is nan_above_two:
        np.testing.assert_array_equal(np.isnan(run(function, kind)[0]), STEEP)


def test_policies_and_their_defaults() -> None:
    assert [policy.tries for policy in (Abort(), Replace(), Retry(), Retry(2))] == [1, 1, 2, 3]
    last = Replace(np.inf)
    assert (last.final, Retry(2, then=last).final) == (last, last)
    assert Abort() == Abort(on_nan=False) == Retry(then=Abort()).final
    assert repr(Retry().then) == "Replace(value=nan)"


def test_retried_once_and_then_it_works() -> None:
    calls: dict[float, int] = {}

    def moody(x: float, a: float) -> float:
        calls[x] = calls.get(x, 0) + 1
        if x > 2 and calls[x] == 1:
            raise OSError("license server")
        return a * x

    values, tally = run(moody, on_failure=Retry(1, then=Abort()))
    np.testing.assert_array_equal(values, 2 * X)
    assert tally.computed == N + STEEP.sum()


@KINDS
def test_retried_in_vain(kind: str, tmp_path: Path) -> None:
    policy, store = Retry(2, then=Replace(-1.0)), Store(tmp_path, "y", columns=2)
    values, tally = run(fails_above_two, kind, on_failure=policy, store=store)
    np.testing.assert_array_equal(values, np.where(STEEP, -1.0, 2 * X))
    if kind == "scalar":
        assert tally.computed == N + 2 * STEEP.sum()
    # The store has the points that failed, and why.
    with sqlite3.connect(tmp_path / "responses.sqlite") as connection:
        query = "SELECT key, reason FROM run WHERE state = 'failed'"
        failed = dict(connection.execute(query).fetchall())
    connection.close()
    keys = [np.array([x, 2.0]).tobytes() for x in X[STEEP]]
    assert failed == dict.fromkeys(keys, "it raised ArithmeticError: too steep")
    with pytest.raises(ResponseError, match="too steep"):
        run(fails_above_two, kind, on_failure=Retry(2, then=Abort()))


def test_minus_infinity_is_refused_with_a_change_of_sign() -> None:
    with pytest.raises(ValueError, match=r"got -inf, .*; for specimens that fail at the low end"):
        Replace(-np.inf)


def test_a_failure_says_where() -> None:
    def root(x: float, y: float) -> float:
        return math.sqrt(x) + y

    points = Points([-X, X], [True, True])
    with pytest.raises(
        ResponseError,
        match=r"failed at 1 point, the first with inputs \(-[\d.]+, -?[\d.]+\): it raised "
        r"ValueError.*; repair it, keep priors and inputs where it has a response, or pass",
    ) as raised:
        run(root, points=points)
    x, y = map(float, re.findall(r"inputs \((.*?), (.*?)\)", str(raised.value))[0])
    with pytest.raises(ValueError, match="math domain"):
        root(x, y)


def test_a_function_that_never_gives_what_is_observed_ends_the_run_whatever_the_policy() -> None:
    _, outputs = read_observed("y", {"a": [1.0, 2.0], "b": [1.0, 2.0]})
    settings: dict[str, Any] = {"on_failure": Retry(1, then=Replace()), "outputs": outputs}
    calls, good = 0, 0

    def response(x: float, y: float) -> dict[str, float]:
        nonlocal calls
        calls += 1
        return {"a": x, "c": y} if calls > good else {"a": x, "b": y}

    wrong = (
        r"keys \['a', 'c'\], expected \['a', 'b'\].*; repair it; if .* failed returns, return NaN"
    )
    with pytest.raises(ResponseError, match=wrong):
        run(response, **settings)
    assert calls < 5
    # Later on it is what some runs return that failed.
    calls, good = 0, 60
    values, tally = run(response, **settings)
    np.testing.assert_array_equal(np.isnan(values).all(axis=1), np.arange(N) >= 60)
    assert tally.failures == N - 60


# -- what is stored --------------------------------------------------------------------------------


@pytest.mark.parametrize("version", [None, "1"])
def test_nothing_is_computed_twice_but_three_runs_without_a_version(
    version: str | None, tmp_path: Path
) -> None:
    again = 3 * (version is None)
    kept: dict[str, Any] = {"store": tmp_path, "version": version}
    first, second = (model(prb.scalar(times), **kept) for _ in range(2))
    np.testing.assert_array_equal(stored(second), stored(first))
    assert (responses(first).computed, responses(second).computed) == (N, again)
    optimum = prb.minimize(pm.do(second, {}), starts=0, progressbar=False)  # nor by a clone
    assert optimum.search.n_computed == responses(second).computed == again
    assert optimum.n_responses >= N
    more = model(prb.scalar(times), prb.Reweighted(N, random_seed=1, **kept))
    assert responses(more).computed == N + again  # other points
    data = Store(tmp_path, "y", version=version).to_dataset()
    assert data["response"].size == 2 * N
    np.testing.assert_allclose(data["response"], 2 * data["inputs"][:, 0])
    np.testing.assert_array_equal(data["inputs"][:, 1], 2.0)  # the constant


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
    def at(x: Any, response: Any) -> Any:
        points = Points([x, 2.0], [True, False])
        store = Store(tmp_path, "y", columns=2)
        return respond(CallSettings("y", wrapped(response), store=store), points, Tally())

    at(X, by_factor(1.0))
    before = Store(tmp_path, "y").to_dataset()
    for changed, calls in ((1.001, []), (-1.0, [])):
        with pytest.raises(
            StoreError,
            match=r"y: store: got a response that gives .* expected .* stored in .*have changed",
        ):
            at(X, by_factor(changed, calls))
        assert sum(map(np.size, calls)) == 3
    # Also at points of which none is stored; and rounding is tolerated.
    with pytest.raises(StoreError, match="have changed"):
        at(X + 1, by_factor(2.0))
    with pytest.raises(StoreError, match=r"gives nothing .*ZeroDivisionError"):
        at(X, lambda x, a: 1 // 0)
    assert Store(tmp_path, "y").to_dataset().identical(before)
    at(X, by_factor(1 + 1e-12))


def test_responses_of_each_version_and_constant_are_kept_apart(tmp_path: Path) -> None:
    for version, factor, computed in (("1", 1.0, N), ("2", 3.0, N), (None, 5.0, N), ("1", 1.0, 0)):
        store = Store(tmp_path, "y", columns=2, version=version)
        values, tally = run(by_factor(factor), store=store)
        np.testing.assert_array_equal(values, factor * 2 * X)
        assert tally.computed == computed
    with pytest.raises(StoreError, match=r"version '3', expected one of \['y', ver"):
        Store(tmp_path, "y", version="3")
    other = Points([X, 3.0], [True, False])
    values, tally = run(times, points=other, store=Store(tmp_path, "y", columns=2, version="1"))
    np.testing.assert_array_equal(values, 3 * X)
    assert tally.computed == N


def test_what_is_being_computed_when_one_fails_is_kept(tmp_path: Path) -> None:
    """Four tasks are begun, the first fails: the others are waited for, and no more are begun."""

    def function(x: float) -> float:
        if x == 0:
            raise ArithmeticError("too steep")
        time.sleep(0.3)
        return 2 * x

    points = Points([np.arange(12.0)], [True])
    store = Store(tmp_path, "y", columns=1)
    kept = r"too steep.*; 3 responses are kept in"
    with ThreadPoolExecutor(2) as pool, pytest.raises(ResponseError, match=kept):
        respond(CallSettings("y", prb.scalar(function), pool, store), points, Tally())
    values, known = store.find(points.keys())
    np.testing.assert_array_equal(np.flatnonzero(known), [1, 2, 3])
    np.testing.assert_array_equal(values[known], [2.0, 4.0, 6.0])


class Broken(Executor):
    """Loses its workers."""

    def submit(self, work: Any, /, *job: Any, **keywords: Any) -> Any:
        raise BrokenExecutor("killed")


def test_an_executor_without_workers_ends_the_run_with_a_remedy() -> None:
    calling = CallSettings("y", prb.scalar(times), Broken())
    match = r"y: a worker was lost \(BrokenExecutor: killed\); if a response ends its .*run again"
    with pytest.raises(ResponseError, match=match):
        respond(calling, line(4), Tally())


# -- failures are not results ----------------------------------------------------------------------


def fails_when_busy(busy: list[bool]) -> Any:
    def response(x: float, a: float) -> float:
        if busy[0] and x > 2:
            raise OSError("license server")
        return a * x

    return response


def test_a_failure_in_the_store_is_no_result_under_abort(tmp_path: Path) -> None:
    busy = [True]
    response, store = fails_when_busy(busy), Store(tmp_path, "y", columns=2, version="1")
    run(response, store=store, on_failure=Retry(2, then=Replace()))
    with pytest.raises(ResponseError, match="license server"):
        run(response, store=store)
    busy[0] = False
    values, tally = run(response, store=store)
    np.testing.assert_array_equal(values, 2 * X)
    assert tally.computed == STEEP.sum()


def test_stored_failures_are_replaced_by_the_present_value_or_tried_again(tmp_path: Path) -> None:
    busy = [True]
    response = fails_when_busy(busy)
    settings: dict[str, Any] = {"store": Store(tmp_path, "y", columns=2, version="1")}
    run(response, on_failure=Replace(np.inf), **settings)
    busy[0], settings["on_failure"] = False, Replace(-1.0)
    values, tally = run(response, **settings)
    np.testing.assert_array_equal(values, np.where(STEEP, -1.0, 2 * X))
    assert tally.computed == 0
    assert len(tally.failed) == STEEP.sum()
    assert {f.reason for f in tally.failed.values()} == {"it raised OSError: license server"}
    values, tally = run(response, retry_failed=True, **settings)
    np.testing.assert_array_equal(values, 2 * X)
    assert (tally.computed, len(tally.failed)) == (STEEP.sum(), 0)
    # What was tried again is a result from then on.
    assert not run(response, **settings)[1].failed


def test_a_copy_of_a_response_has_failures_of_its_own() -> None:
    settings = {"on_failure": Replace(np.inf), "max_lost": 0.9}
    found = responses(model(prb.scalar(fails_above_two), **settings))
    other = found.copied()
    other([np.array([5.0])], [])
    assert len(other.failed) == len(found.failed) + 1


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


@pytest.mark.parametrize("policy", [Abort(), Replace()], ids=repr)
def test_a_result_that_slipped_away_is_computed_again(policy: Any) -> None:
    calling = CallSettings("y", prb.scalar(times), Slipping(3), on_failure=policy)
    np.testing.assert_array_equal(respond(calling, line(9), Tally()), 2 * np.arange(9.0))
    assert not has_slipped(TypeError("x"))  # of another


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
    again, have_same_constants = points.read_keys(np.array([expected[1], [2, 3, 6, 1, 8, 9]]))
    np.testing.assert_array_equal(again.at(np.array([0])).keys(), [expected[1]])
    assert have_same_constants.tolist() == [True, False]


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
    with pytest.raises(ResponseError, match=f"the response returned {message}"):
        checked(result, (3,), [np.zeros(3), 1.0])
    np.testing.assert_array_equal(checked([1, True, np.nan], (3,), [])[0], [1.0, 1.0, np.nan])


def test_a_batch_has_the_time_of_all_of_its_points(monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[float | None] = []

    def time_limit(seconds: float | None) -> Any:
        limits.append(seconds)
        return nullcontext()

    monkeypatch.setattr("prbayes.response.call.time_limit", time_limit)
    for function in (times, prb.scalar(times)):
        compute(function, line(3), False, 2.0)
    compute(times, line(3), False)
    assert limits == [6.0, 2.0, 2.0, 2.0, None]


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


NAMED = Outputs(("p", "q"), keys=(("p", None), ("q", None)))
PAIRS = np.array([[1.0, 10.0], [2.0, 20.0], [3.0, 30.0]])
BEHIND = np.array([1.0, 9.97e36, 3.0])
MASKED = np.ma.masked_array(BEHIND, [0, 1, 0])


@pytest.mark.parametrize(
    "result",
    [
        MASKED,
        np.ma.masked_array([1, 2, 3], [0, 1, 0]),
        list(MASKED),  # with np.ma.masked among numbers
    ],
)
def test_a_masked_number_is_no_response(result: Any) -> None:
    values, _ = checked(result, (3,), ())
    np.testing.assert_array_equal(values, [1.0, np.nan, 3.0])


def test_masks_of_one_output_and_of_one_specimen() -> None:
    expected = PAIRS.copy()
    expected[1] = np.nan
    for result in (
        {"q": PAIRS[:, 1], "p": np.ma.masked_array(PAIRS[:, 0], [0, 1, 0])},
        np.ma.masked_array(PAIRS, [[0, 0], [1, 0], [0, 0]]),
    ):
        np.testing.assert_array_equal(checked(result, (3,), (), NAMED)[0], expected)
    rows = [np.ma.masked_array(row, [row[0] == 2.0, False]) for row in PAIRS]
    np.testing.assert_array_equal(checked(rows, (3,), (), NAMED)[0], expected)
    response = prb.scalar(lambda x: np.ma.masked_array(x, mask=x > 2))
    np.testing.assert_array_equal(response(np.array([1.0, 3.0])), [1.0, np.nan])
    response = prb.scalar(lambda x: [x, np.ma.masked] if x > 2 else [x, x])
    np.testing.assert_array_equal(response(np.array([1.0, 3.0]))[:, 0], [1.0, np.nan])
    whole = np.ma.masked_array([1.0, 2.0, 3.0])  # as netCDF4 returns arrays without a mask
    np.testing.assert_array_equal(checked(whole, (3,), ())[0], [1.0, 2.0, 3.0])


def test_minus_infinity_is_refused_in_all_kinds_of_responses() -> None:
    match = "response returned -inf 1 times in . values, expected numbers, NaN .*logarithm of 0"
    low = np.array([0.0, -np.inf, np.inf])
    for result, outputs in (
        (low, Outputs()),
        ({"p": low, "q": np.ones(3)}, NAMED),
        (pd.DataFrame({"p": low, "q": np.ones(3)}), NAMED),
    ):
        with pytest.raises(ResponseError, match=match):
            checked(result, (3,), (), outputs)
    with pytest.raises(ResponseError, match="y: the response returned -inf"):
        model(lambda x, a: np.where(x < 1, -np.inf, x))
    with pytest.raises(ResponseError, match=r"inputs \(x = .*, a = 2\): it returned -inf, exp"):
        model(prb.scalar(lambda x, a: -math.inf if x < 1 else x))
    # NaN in another output: there is no response.
    rows = checked([[np.nan, -np.inf], [1.0, 2.0]], (2,), (), NAMED)[0]
    np.testing.assert_array_equal(rows, [[np.nan, np.nan], [1.0, 2.0]])


@pytest.mark.parametrize(
    "result",
    [
        xr.DataArray(PAIRS[:, ::-1], dims=["n", "out"], coords={"out": ["q", "p"]}),
        xr.DataArray(PAIRS.T, dims=["output", "n"], coords={"output": ["p", "q"]}),
        pd.DataFrame({"q": PAIRS[:, 1], "p": PAIRS[:, 0]}),
        xr.Dataset({"q": ("n", PAIRS[:, 1]), "p": ("n", PAIRS[:, 0])}),
        pd.DataFrame(PAIRS),  # without labels
    ],
)
def test_outputs_are_matched_by_their_labels(result: Any) -> None:
    np.testing.assert_array_equal(checked(result, (3,), (), NAMED)[0], PAIRS)


def test_labels_of_one_specimen_of_curves_and_of_predictions() -> None:
    for function in (
        lambda x: pd.Series({"q": 10 * x, "p": x}),
        lambda x: Reversed(q=10 * x, p=x),
        lambda x: xr.DataArray([10 * x, x], dims="out", coords={"out": ["q", "p"]}),
    ):
        points = Points([PAIRS[:, 0]], [True])
        chunk = compute(prb.scalar(function), points, True, outputs=NAMED)
        np.testing.assert_array_equal(chunk.values, PAIRS)
        # Without observed outputs the labels are those of the response.
        chunk = compute(prb.scalar(function), points, True, outputs=None)
        assert chunk.named is not None
        assert chunk.named.labels == ("q", "p")
        np.testing.assert_array_equal(chunk.values, PAIRS[:, ::-1])
    curve = Outputs((0.1, 0.3), "time")
    result = xr.DataArray(PAIRS, dims=["n", "time"], coords={"time": [0.1 * 3, 0.1]})
    np.testing.assert_array_equal(checked(result, (3,), (), curve)[0], PAIRS[:, ::-1])
    _, named = checked(result, (3,), (), None)
    assert named == Outputs((0.1 * 3, 0.1), "time")
    again = named.by_key(PAIRS)
    np.testing.assert_array_equal(checked(again, (3,), (), curve)[0], PAIRS[:, ::-1])


class Reversed(NamedTuple):
    q: float
    p: float


@pytest.mark.parametrize(
    ("result", "match"),
    [
        (pd.DataFrame(PAIRS, columns=["p", "r"]), r"outputs \['p', 'r'\], expected \['p', 'q'\]"),
        (pd.DataFrame(PAIRS, columns=["p", "p"]), r"outputs \['p', 'p'\], expected"),
        (
            xr.DataArray(PAIRS, dims=["n", "out"], coords={"out": ["a", "b"]}),
            r"outputs \['a', 'b'\], expected \['p', 'q'\], each once, in any order",
        ),
        (pd.DataFrame(PAIRS, columns=["p", "q"], index=[2, 0, 1]), "in another order than the in"),
        (
            xr.DataArray(PAIRS, dims=["n", "out"], coords={"n": [1, 0, 2]}),
            "specimens in another order than the inputs, .*sort the response by its index",
        ),
    ],
)
def test_other_labels_than_the_observed_ones_are_refused(result: Any, match: str) -> None:
    with pytest.raises(ResponseError, match=f"the response returned .*{match}"):
        checked(result, (3,), (), NAMED)


def test_a_series_of_specimens_is_in_their_order() -> None:
    sorted_values = pd.Series([3.0, 1.0, 2.0]).sort_values()
    with pytest.raises(ResponseError, match="in another order than the inputs"):
        checked(sorted_values, (3,), ())
    dates = pd.Series([3.0, 1.0, 2.0], index=pd.date_range("2020-01-01", periods=3))
    assert checked(dates, (3,), ())[0].tolist() == [3.0, 1.0, 2.0]


def test_one_column_is_one_output() -> None:
    observed, outputs = read_observed("y", pd.DataFrame({"f": [1.0, 2.0, 3.0]}))
    assert observed.tolist() == [1.0, 2.0, 3.0]
    for result in (
        {"f": observed},
        pd.DataFrame({"f": observed}),
        pd.DataFrame(observed),
        observed,
    ):
        assert checked(result, (3,), (), outputs)[0].tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(ResponseError, match=r"the keys \['g'\], expected \['f'\]"):
        checked(pd.DataFrame({"g": observed}), (3,), (), outputs)
