"""What a model costs is what it then computes."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
from first_use import first_use

import prbayes as prb
from prbayes.model.cost import listening
from prbayes.model.random_variable import nodes

OBSERVED = np.array([1.0, 2.0, 2.5, 4.0])


class Counted:
    """A response that counts its calls."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, x: float, *others: float) -> float:
        self.calls += 1
        return 2 * x


def builder(function: Any, propagation: Any, **dists: Any) -> Callable[[], pm.Model]:
    """Return a function that makes a model of one simulator."""
    response = function if dists.pop("batched", False) else prb.scalar(function)

    def build() -> pm.Model:
        with pm.Model() as model:
            mu = pm.Normal("mu", 1, 1)
            x = dists["x"](mu) if "x" in dists else pm.Normal.dist(mu, 1.0)
            prb.Simulator(
                "y", response, x, metric=prb.AreaMetric(), observed=OBSERVED,
                propagation=propagation, progressbar=False,
            )  # fmt: skip
        return model

    return build


@pytest.mark.parametrize(
    ("propagation", "first", "each"),
    [(prb.Reweighted(32), 32, 0), (prb.Resimulated(8), 16, 8), (prb.Fresh(8), 16, 8)],
)
def test_nothing_is_computed_and_as_much_is_needed_then(
    propagation: Any, first: int, each: int
) -> None:
    response = Counted()
    build = builder(response, propagation)
    cost = prb.cost(build)
    assert response.calls == 0
    assert (cost.runs, cost.runs_each, np.isnan(cost.seconds)) == (first, each, True)
    model = build()
    assert str(prb.cost(model)) == str(cost)
    assert response.calls == 0
    first_use(model)
    assert response.calls == first
    again = prb.cost(model)
    assert (again.runs, again.simulators[0].first, again.runs_each) == (0, first, each)
    with model:
        assert prb.cost().simulators == again.simulators
    assert response.calls == first
    assert listening() is None


def test_specimens_that_come_again_are_counted_once() -> None:
    response = Counted()
    build = builder(response, prb.Reweighted(64), x=lambda mu: pm.Poisson.dist(pm.math.exp(mu)))
    cost = prb.cost(build)
    assert cost.runs < 64
    first_use(build())
    assert response.calls == cost.runs


def test_a_dry_run_is_one_of_those_that_are_needed_and_goes_on_the_executor(
    tmp_path: Path,
) -> None:
    response = Counted()
    with ThreadPoolExecutor(3) as threads:
        settings = {"executor": threads, "store": tmp_path, "version": "1"}
        build = builder(response, prb.Reweighted(32, **settings))
        cost = prb.cost(build, dry_run=True)
        (only,) = cost.simulators
        assert response.calls == 1
        assert (only.first, only.known, only.missing, only.workers) == (32, 1, 31, 3)
        tried = only.dry_run
        assert tried is not None
        assert tried.outputs == {"y": 2 * tried.inputs[0]}
        assert cost.seconds == 11 * tried.seconds
        model = build()
        (node,) = nodes(model).values()
    assert response.calls == 32
    (points,) = node.bound.known_points
    rank = int((points < tried.inputs[0]).sum())
    assert rank in (15, 16), "in the middle of 32"


def test_a_dry_run_of_a_response_of_arrays_and_of_several_outputs() -> None:
    def both(x: Any) -> dict[str, Any]:
        return {"b": x + 1, "a": 2 * x}

    def build() -> None:
        with pm.Model():
            x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
            a = np.random.default_rng(0).normal(size=9)
            prb.Simulator(
                "y", both, x, metric=prb.Joint(prb.AreaMetric()), observed={"a": a, "b": a**2},
                propagation=prb.Reweighted(16),
            )  # fmt: skip

    (only,) = prb.cost(build, dry_run=True).simulators
    assert only.dry_run is not None
    (x,) = only.dry_run.inputs
    assert only.dry_run.outputs == {"a": 2 * x, "b": x + 1}


def test_simulators_that_share_runs_need_them_once() -> None:
    response = prb.scalar(Counted())

    def build() -> pm.Model:
        with pm.Model() as model:
            x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
            how = prb.Reweighted(16)
            for name in ("y", "z"):
                prb.Simulator(
                    name, response, x, metric=prb.AreaMetric(), observed=OBSERVED, propagation=how
                )
        return model

    cost = prb.cost(build, dry_run=True)
    first, second = cost.simulators
    assert (first.first, second.first, cost.runs) == (16, 0, 16)
    assert second.propagation.endswith("with the runs of y")
    assert response.function.calls == 1
    model = build()
    assert [one.first for one in prb.cost(model).simulators] == [16, 0]
    first_use(model)
    assert response.function.calls == 17


def test_what_is_no_model_is_refused_and_leaves_nothing_behind() -> None:
    with pytest.raises(ValueError, match=r"cost: model: got function .*made no prb.Simulator, ex"):
        prb.cost(lambda: None)
    with pytest.raises(ZeroDivisionError):
        prb.cost(lambda: 1 / 0)
    assert listening() is None
    with pytest.raises(TypeError, match=r"prb.cost\(\): got no model on the context"):
        prb.cost()
