"""Calling the response: executors, chunks, failure policies, the store, and runs that are killed."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes.model.node import nodes
from prbayes.response.calling import Caller
from prbayes.response.failures import Abort, OnFailure
from prbayes.response.store import Store

N = 64


def model(response: Any, propagation: Any = None, **keywords: Any) -> pm.Model:
    propagation = prb.Reweighted(N, **keywords) if propagation is None else propagation
    with pm.Model() as found:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        prb.Simulator("y", response, x, 2.0, metric=prb.AreaMetric(), observed=[1, 2, 3, 5.0], propagation=propagation)
    return found


def stored(found: pm.Model) -> Any:
    """Return the design's responses."""
    return next(iter(nodes(found).values())).bound.values


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


# -- the same numbers, wherever they are computed --------------------------------------------------------


@pytest.fixture(scope="module")
def processes() -> Iterator[Executor]:
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        yield pool


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
                20, chains=1, model=model(response, propagation), epsilon=1.0, random_seed=1, progressbar=False
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
            "y", prb.scalar(length), x, metric=prb.AreaMetric(), observed=[1, 2.0], propagation=prb.Reweighted(N)
        )
    assert shapes == {(2,)}
    assert (stored(found) > 0).all()


def test_chunks_follow_the_measured_cost() -> None:
    sizes: list[int] = []

    def response(x: Any, a: Any) -> Any:
        sizes.append(len(x))
        time.sleep(0.01 * len(x))
        return a * x

    caller = Caller("y", response, None, Abort(), None)
    x = np.arange(100.0)
    np.testing.assert_array_equal(caller([x, 2.0], [True, False], x[:, None]), 2 * x)
    assert sizes[0] == 16
    # 10 ms each: at most 20 of them make up the 200 ms of a chunk; a slow machine makes them fewer.
    assert all(5 <= s <= 20 for s in sizes[1:-1])


def test_a_scalar_function_that_is_slow_is_a_task_of_its_own() -> None:
    caller = Caller("y", prb.scalar(lambda x: time.sleep(0.02) or x), None, Abort(), None)
    x = np.arange(5.0)
    taken = [rows.size for rows, _, _ in caller._computed([x], [True], np.arange(5), False)]
    assert taken == [1] * 5


# -- failures --------------------------------------------------------------------------------------------

STEEP = POINTS > 2
BATCHED = pytest.mark.parametrize("kind", ["scalar", "batched", "threads"])


def failing(kind: str, function: Any, on_failure: OnFailure | None = None, **keywords: Any) -> pm.Model:
    keywords |= {} if on_failure is None else {"on_failure": on_failure}
    if kind == "batched":
        return model(lambda x, a: np.array([function(v, a) for v in x]), **keywords)
    if kind == "threads":
        with ThreadPoolExecutor(2) as pool:
            return model(prb.scalar(function), executor=pool, **keywords)
    return model(prb.scalar(function), **keywords)


@BATCHED
def test_an_exception_aborts_by_default(kind: str) -> None:
    with pytest.raises(prb.ResponseError, match=r"y: .*raised ArithmeticError: too steep"):
        failing(kind, fails_above_two)


@BATCHED
@pytest.mark.parametrize("function", [fails_above_two, nan_above_two])
def test_replaced(kind: str, function: Any, caplog: pytest.LogCaptureFixture) -> None:
    assert 3 < STEEP.sum() < N - 3
    with caplog.at_level(logging.WARNING, "prbayes"):
        found = failing(kind, function, prb.Replace(np.inf))
    np.testing.assert_array_equal(stored(found), np.where(STEEP, np.inf, EXPECTED))
    assert responses(found).failures == STEEP.sum()
    assert f"y: {STEEP.sum()} of {N} responses failed, replaced by inf" in caplog.text
    if function is fails_above_two:
        assert "too steep" in caplog.text


@BATCHED
def test_nan_is_a_result_by_default_and_a_failure_if_asked_for(kind: str) -> None:
    np.testing.assert_array_equal(np.isnan(stored(failing(kind, nan_above_two))), STEEP)
    with pytest.raises(prb.ResponseError, match="it is NaN"):
        failing(kind, nan_above_two, prb.Abort(on_nan=True))


def test_retried_once_and_then_it_works() -> None:
    calls: dict[float, int] = {}

    def moody(x: float, a: float) -> float:
        calls[x] = calls.get(x, 0) + 1
        if x > 2 and calls[x] == 1:
            raise OSError("license server")
        return a * x

    found = failing("scalar", moody, prb.Retry(1, then=prb.Abort()))
    np.testing.assert_array_equal(stored(found), EXPECTED)
    # The simulator tries 16 points of the prior only where it has to; here every design point, the steep ones twice.
    assert sorted(set(calls.values())) == [1, 2]
    assert responses(found).computed == N + STEEP.sum()


def test_retried_in_vain() -> None:
    found = failing("scalar", fails_above_two, prb.Retry(2, then=prb.Replace(-1.0)))
    np.testing.assert_array_equal(stored(found), np.where(STEEP, -1.0, EXPECTED))
    assert responses(found).computed == N + 2 * STEEP.sum()
    with pytest.raises(prb.ResponseError, match="too steep"):
        failing("scalar", fails_above_two, prb.Retry(2, then=prb.Abort()))


def test_a_wrong_shape_is_a_mistake_and_no_failure() -> None:
    with pytest.raises(prb.ResponseError, match=r"y: the response returned shape \(2,\)"):
        model(lambda x, a: (a * x)[:2], on_failure=prb.Replace())


def test_a_lost_worker_is_named() -> None:
    with (
        ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool,
        pytest.raises(prb.ResponseError, match=r"y: a worker was lost .*store="),
    ):
        model(prb.scalar(lambda x, a: os._exit(3)), executor=pool)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: prb.Replace("a"), TypeError, "Replace: value: got str"),
        (lambda: prb.Retry(0), ValueError, "Retry: times: got 0"),
        (lambda: prb.Retry(1, then=prb.Retry()), TypeError, "Retry: then: got Retry"),
        (lambda: prb.scalar(3), TypeError, "scalar: got int"),
        (lambda: prb.Reweighted(N, executor=3), TypeError, "executor: got int"),
        (lambda: prb.Reweighted(N, store=3), TypeError, "store: got int"),
        (lambda: prb.Resimulated(N, on_failure="abort"), TypeError, "on_failure: got str 'abort'"),
    ],
)
def test_bad_settings(make: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        make()


# -- the store -------------------------------------------------------------------------------------------


def test_nothing_is_computed_twice(tmp_path: Path) -> None:
    first = model(prb.scalar(times), store=tmp_path)
    second = model(prb.scalar(times), store=tmp_path)
    np.testing.assert_array_equal(stored(second), EXPECTED)
    assert (responses(first).computed, responses(second).computed) == (N, 0)
    more = model(prb.scalar(times), propagation=prb.Reweighted(N, random_seed=1, store=tmp_path))
    assert responses(more).computed == N  # other points
    assert {p.suffix for p in tmp_path.iterdir()} == {".nc"}
    with xr.open_dataset(tmp_path / "y.nc") as data:
        assert data["response"].size == 2 * N
        np.testing.assert_allclose(data["response"], 2 * data["inputs"][:, 0])  # the constant is the second column
        np.testing.assert_array_equal(data["inputs"][:, 1], 2.0)


def test_an_optimum_tells_what_was_computed_and_what_it_rests_on(tmp_path: Path) -> None:
    first = prb.minimize(model(prb.scalar(times), store=tmp_path))
    again = prb.minimize(model(prb.scalar(times), store=tmp_path))
    assert first.n_computed == first.n_responses == again.n_responses >= N
    assert (again.n_computed, again.point) == (0, first.point)


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
    with pytest.raises(prb.ResponseError, match=r"\d+ responses are kept in"):
        model(prb.scalar(fails_above_two), store=tmp_path)
    kept = len(Store(tmp_path, "y", 2))
    found = model(prb.scalar(times), store=tmp_path)
    np.testing.assert_array_equal(stored(found), EXPECTED)
    assert responses(found).computed == N - kept
    assert kept == int(np.argmax(STEEP))  # all that came before the first steep point


def test_an_executor_that_does_not_tell_its_size_gets_work_for_many() -> None:
    class Cluster:
        """Begins once all has come, or a second later."""

        most = 0

        def __init__(self, pool: ThreadPoolExecutor) -> None:
            self.pool, self.under_way, self.lock, self.full = pool, 0, threading.Lock(), threading.Event()

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
        caller = Caller("y", prb.scalar(lambda x: 2 * x), cluster, Abort(), None)  # type: ignore[arg-type]
        np.testing.assert_array_equal(caller([POINTS], [True], POINTS[:, None]), 2 * POINTS)
    assert cluster.most == N


@pytest.mark.parametrize("error", [ArithmeticError, BrokenExecutor])
def test_what_is_being_computed_when_one_fails_is_kept(error: type[Exception], tmp_path: Path) -> None:
    """The first of four tasks that are begun fails at once; the others are waited for, and nothing more is begun."""

    def function(x: float) -> float:
        if x == 0:
            raise error("too steep")
        time.sleep(0.3)
        return 2 * x

    class Pool(ThreadPoolExecutor):
        """Loses a worker, rather than an answer, at a `BrokenExecutor`."""

        def submit(self, work: Any, /, *job: Any, **keywords: Any) -> Any:
            if error is BrokenExecutor and job[0][0][0] == 0:
                raise error("too steep")
            return super().submit(work, *job, **keywords)

    keys = np.arange(12.0)[:, None]
    store = Store(tmp_path, "y", 1)
    with Pool(2) as pool, pytest.raises(prb.ResponseError, match="too steep"):
        Caller("y", prb.scalar(function), pool, Abort(), store)([keys[:, 0]], [True], keys)
    values, known = store.find(keys)
    np.testing.assert_array_equal(np.flatnonzero(known), [1, 2, 3])
    np.testing.assert_array_equal(values[known], [2.0, 4.0, 6.0])


def test_stored_failures_are_replaced_as_the_policy_of_the_day_says(tmp_path: Path) -> None:
    model(prb.scalar(fails_above_two), store=tmp_path, on_failure=prb.Replace(np.inf))
    found = model(prb.scalar(fails_above_two), store=tmp_path, on_failure=prb.Replace(-1.0))
    np.testing.assert_array_equal(stored(found), np.where(STEEP, -1.0, EXPECTED))
    assert responses(found).computed == 0


def filled(folder: Path) -> Store:
    store = Store(folder, "y", 1)
    for i in range(3):
        store.add(np.array([[float(i)], [i + 0.5]]), np.array([10.0 * i, np.nan]))
    return store


def test_the_journal_survives_a_cut_at_any_byte(tmp_path: Path) -> None:
    store = filled(tmp_path)
    whole = store.journal.read_bytes()
    for size in range(len(whole) + 1):
        store.journal.write_bytes(whole[:size])
        again = Store(tmp_path, "y", 1)
        # Only the record that was cut is lost; and appending goes on from there.
        assert len(again) == 2 * max(0, (size - 8) // ((len(whole) - 8) // 3))
        again.add(np.array([[7.0]]), np.array([70.0]))
        values, known = Store(tmp_path, "y", 1).find(np.array([[7.0]]))
        assert known.all()
        assert values[0] == 70.0


def test_damage_is_named_and_left_alone(tmp_path: Path) -> None:
    store = filled(tmp_path)
    text = bytearray(store.journal.read_bytes())
    text[30] ^= 255
    store.journal.write_bytes(text)
    with pytest.raises(prb.StoreError, match=r"y: store: .* damaged in the middle; nothing was changed: move it"):
        Store(tmp_path, "y", 1)
    assert store.journal.read_bytes() == text
    store.journal.unlink()
    store = filled(tmp_path)
    store.merge(always=True)
    assert not store.journal.exists()
    assert len(Store(tmp_path, "y", 1)) == 6
    sound = store.path.read_bytes()
    for damaged in (sound[:100], b"", sound[: len(sound) // 2], b"not a file of ours"):
        store.path.write_bytes(damaged)
        with pytest.raises(prb.StoreError, match=r"y: store: .*cannot be read"):
            Store(tmp_path, "y", 1)
        assert store.path.read_bytes() == damaged
    store.path.write_bytes(sound)
    with xr.open_dataset(store.path) as data:
        data.load()
    data["response"][0] = 99.0
    store.path.unlink()
    data.to_netcdf(store.path, engine="h5netcdf")
    with pytest.raises(prb.StoreError, match="do not match their digest"):
        Store(tmp_path, "y", 1)


def test_a_store_of_other_inputs_or_another_simulator_is_refused(tmp_path: Path) -> None:
    filled(tmp_path).merge(always=True)
    with pytest.raises(prb.StoreError, match=r"holds inputs of 1 values for simulator 'y', expected 2 values for 'y'"):
        Store(tmp_path, "y", 2)
    (tmp_path / "y.nc").rename(tmp_path / "z.nc")
    with pytest.raises(prb.StoreError, match="for simulator 'y', expected 1 values for 'z'"):
        Store(tmp_path, "z", 1)
    with pytest.raises(prb.StoreError, match="which is a file, expected a folder"):
        Store(tmp_path / "z.nc", "z", 1)


# -- killed ----------------------------------------------------------------------------------------------

SCRIPT = """
import sys, time
import numpy as np, pymc as pm, prbayes as prb

folder, kind = sys.argv[1:]

def response(x):
    time.sleep(0.012)
    with open(folder + "/calls", "a") as file:
        file.write(f"{x!r}\\n")
    return 2 * x

with pm.Model() as model:
    mu = pm.Normal("mu", 1, 1)
    if kind == "reweighted":
        propagation = prb.Reweighted(100, store=folder + "/store")
    else:
        propagation = prb.Resimulated(4, store=folder + "/store")
    prb.Simulator("y", prb.scalar(response), pm.Normal.dist(mu, 1.0), metric=prb.AreaMetric(), observed=[1.0, 2.0, 4.0],
                  epsilon=2.0, propagation=propagation)
    idata = prb.sample_smc(10, chains=2, random_seed=1, checkpoint=folder + "/run.nc", progressbar=False)
print(repr(float(idata.posterior["mu"].sum())))
"""


def undisturbed(folder: Path, kind: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    """Run the script in this process."""
    folder.mkdir()
    monkeypatch.setattr(sys, "argv", ["script", str(folder), kind])
    capsys.readouterr()
    exec(compile(SCRIPT, "script", "exec"), {})
    return capsys.readouterr().out


def run(folder: Path, kind: str, *, kill_at: int | None = None) -> str:
    """Run the script; kill it, hard, as soon as so many responses were computed."""
    folder.mkdir(exist_ok=True)
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(folder), kind], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    calls = folder / "calls"
    while kill_at is not None and process.poll() is None:
        if calls.exists() and len(calls.read_text().splitlines()) >= kill_at:
            process.send_signal(signal.SIGKILL)
        time.sleep(0.002)
    out, error = process.communicate()
    assert kill_at is not None or process.returncode == 0, error
    return out


@pytest.mark.parametrize(("kind", "kills"), [("reweighted", [40]), ("resimulated", [200])])
def test_a_killed_run_computes_nothing_again_and_gives_the_same(
    kind: str, kills: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    once = undisturbed(tmp_path / "a", kind, monkeypatch, capsys)
    for at in kills:
        assert run(tmp_path / "b", kind, kill_at=at) == ""
    assert run(tmp_path / "b", kind) == once
    expected = (tmp_path / "a" / "calls").read_text().splitlines()
    calls = (tmp_path / "b" / "calls").read_text().splitlines()
    assert len(expected) == len(set(expected))
    # A kill may fall between the end of a response and its record: then that one response is computed again.
    assert len(calls) - len(set(calls)) <= len(kills)
    assert set(calls) == set(expected)
