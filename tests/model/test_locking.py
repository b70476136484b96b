"""Threads take turns on a model: what each gets is what it would have got alone."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pymc as pm
import pytest
from line_problem import build

import prbayes as prb
from prbayes.model.locking import locked

QUIET: dict[str, Any] = {"progressbar": False}
at_work: list[str] = []
seen: list[int] = []


def black_box(x: Any) -> Any:
    return 0.75 * np.asarray(x, dtype=np.float64)


@locked
def work(what: Any = None, **others: Any) -> None:
    """Note how many are at work at a time."""
    at_work.append("")
    for _ in range(50):
        seen.append(len(at_work))
        threading.Event().wait(1e-4)
    at_work.pop()


def at_once(*calls: Callable[[], Any]) -> list[Any]:
    """Return what calls give that are begun at the same time, each in a thread."""
    barrier = threading.Barrier(len(calls))

    def begin(call: Callable[[], Any]) -> Any:
        barrier.wait()
        return call()

    with ThreadPoolExecutor(len(calls)) as threads:
        return list(threads.map(begin, calls))


@pytest.fixture(autouse=True)
def nobody_at_work() -> Iterator[None]:
    at_work.clear()
    seen.clear()
    # Threads change places a thousand times as often as they do otherwise.
    before = sys.getswitchinterval()
    sys.setswitchinterval(5e-6)
    yield
    sys.setswitchinterval(before)


class Made:
    """What was made from a model, or from an optimum of one."""

    def __init__(self, **given: Any) -> None:
        vars(self).update(given)


def test_one_thread_at_a_time_is_inside_on_one_model() -> None:
    model, _ = build(prb.Reweighted(16))

    def on_the_context() -> None:
        with model:
            work()

    of_optimum = Made(optimum=Made(model=model))
    at_once(
        lambda: work(model),
        lambda: work(what=Made(model=model)),
        lambda: work([], null=of_optimum),
        lambda: work({"a": Made(model=model)}),
        on_the_context,
    )
    assert set(seen) == {1}


def test_models_do_not_wait_for_each_other() -> None:
    inside = threading.Barrier(2, timeout=60)

    @locked
    def meet(model: pm.Model) -> int:
        # Broken after the time limit, where one waits outside for the other.
        return inside.wait()

    one, other = pm.Model(), pm.Model()
    assert set(at_once(lambda: meet(one), lambda: meet(other))) == {0, 1}


def test_two_models_in_any_order_are_no_deadlock_and_calls_may_be_nested() -> None:
    one, other = pm.Model(), pm.Model()

    @locked
    def outer(*models: pm.Model) -> None:
        work(models[0])

    at_once(lambda: outer(one, other), lambda: outer(other, one))
    assert set(seen) == {1}


def test_a_failure_ends_the_turn() -> None:
    model = pm.Model()

    @locked
    def fails(model: pm.Model) -> None:
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        fails(model)
    at_once(lambda: work(model))
    assert set(seen) == {1}


@pytest.mark.long
@pytest.mark.parametrize(
    "propagation",
    [
        prb.Fresh(16),
        pytest.param(prb.Reweighted(64), marks=pytest.mark.slow),
        pytest.param(prb.Resimulated(16), marks=pytest.mark.slow),
    ],
    ids=lambda p: type(p).__name__,
)
def test_two_threads_on_one_model_get_what_they_would_have_got_alone(propagation: Any) -> None:
    def sampled(model: pm.Model) -> Any:
        found = prb.sample_smc(
            20, chains=1, model=model, adjustment=None, random_seed=1, refine=False, **QUIET
        )
        return found["posterior"]["mu"].values

    def minimised(model: pm.Model) -> Any:
        method = "Nelder-Mead" if isinstance(propagation, prb.Fresh) else None
        return prb.minimize(model, method=method, max_evaluations=40, refine=False, **QUIET).theta

    shared = build(propagation, black_box)[0]
    for pair in ((sampled, sampled), (sampled, minimised)):
        alone = [one(build(propagation, black_box)[0]) for one in pair]
        together = at_once(*[lambda one=one: one(shared) for one in pair])  # type: ignore[misc]
        for a, b in zip(alone, together, strict=True):
            np.testing.assert_array_equal(a, b)
