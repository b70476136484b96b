"""Threads lock models: each gets the result that it would have got alone."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest
from line_problem import build

import prbayes as prb
from prbayes.model.locking import locked

QUIET: dict[str, Any] = {"progressbar": False}
inside: list[str] = []
counts: list[int] = []


@locked
def work(what: Any = None, **others: Any) -> None:
    """Note how many threads are inside at a time."""
    inside.append("")
    for _ in range(50):
        counts.append(len(inside))
        threading.Event().wait(1e-4)
    inside.pop()


def at_once(*calls: Callable[[], Any]) -> list[Any]:
    """Return the results of calls that begin at the same time, each in a thread."""
    barrier = threading.Barrier(len(calls))

    def begin(call: Callable[[], Any]) -> Any:
        barrier.wait()
        return call()

    with ThreadPoolExecutor(len(calls)) as threads:
        return list(threads.map(begin, calls))


@pytest.fixture(autouse=True)
def frequent_switches() -> Iterator[None]:
    inside.clear()
    counts.clear()
    before = sys.getswitchinterval()
    sys.setswitchinterval(5e-6)
    yield
    sys.setswitchinterval(before)


def test_one_thread_at_a_time_works_on_a_model() -> None:
    model, _ = build(prb.Reweighted(16))
    result = SimpleNamespace(model=model)

    def on_the_context() -> None:
        with model:
            work()

    at_once(
        lambda: work(model),
        lambda: work(what=result),
        lambda: work([], null=SimpleNamespace(optimum=result)),
        lambda: work({"a": result}),
        on_the_context,
    )
    assert set(counts) == {1}


def test_models_do_not_wait_for_each_other() -> None:
    barrier = threading.Barrier(2, timeout=60)

    @locked
    def meet(model: pm.Model) -> int:
        return barrier.wait()  # broken after the time limit if one thread waits outside

    first, second = pm.Model(), pm.Model()
    assert set(at_once(lambda: meet(first), lambda: meet(second))) == {0, 1}


def test_nested_calls_and_models_in_any_order_are_no_deadlock() -> None:
    first, second = pm.Model(), pm.Model()

    @locked
    def outer(*models: pm.Model) -> None:
        work(models[0])

    at_once(lambda: outer(first, second), lambda: outer(second, first))
    assert set(counts) == {1}


def test_a_failure_releases_the_lock() -> None:
    model = pm.Model()

    @locked
    def fails(model: pm.Model) -> None:
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        fails(model)
    at_once(lambda: work(model))
    assert set(counts) == {1}


@pytest.mark.long
def test_two_threads_on_one_model_get_the_results_of_one() -> None:
    def black_box(x: Any) -> Any:
        return 0.75 * np.asarray(x, dtype=np.float64)

    def sampled(model: pm.Model) -> Any:
        settings = {"chains": 1, "adjustment": None, "random_seed": 1, "refine": False, **QUIET}
        return prb.sample_smc(20, model=model, **settings)["posterior"]["mu"].values

    def minimised(model: pm.Model) -> Any:
        settings = {"method": "Nelder-Mead", "max_evaluations": 40, "refine": False, **QUIET}
        return prb.minimize(model, **settings).theta

    propagation = prb.Fresh(16)
    shared = build(propagation, black_box)[0]
    for pair in ((sampled, sampled), (sampled, minimised)):
        alone = [use(build(propagation, black_box)[0]) for use in pair]
        together = at_once(*[lambda use=use: use(shared) for use in pair])  # type: ignore[misc]
        for a, b in zip(alone, together, strict=True):
            np.testing.assert_array_equal(a, b)
