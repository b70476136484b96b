"""The cost of a model is the number of runs that it then computes; what is kept after a budget."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
from first_use import first_use
from line_problem import build

import prbayes as prb
from prbayes.model.cost import designs_as_before, explained, kept
from prbayes.model.evaluator import Evaluator
from prbayes.propagation.base import Propagation
from prbayes.response import BudgetError
from prbayes.response.budget import Cost, RunCost, SimulatorCost, duration

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
    assert (cost.runs, cost.runs_each) == (first, each)
    model = build()
    assert str(prb.cost(model)) == str(cost)
    assert response.calls == 0
    first_use(model)
    assert response.calls == first
    again = prb.cost(model)
    assert (again.runs, again.simulators[0].needed.first, again.runs_each) == (0, first, each)
    with model:
        assert prb.cost().simulators == again.simulators
    assert response.calls == first


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

    model = build()
    cost = prb.cost(model)
    first, second = cost.simulators
    assert (first.needed.first, second.needed.first, cost.runs) == (16, 0, 16)
    assert second.propagation.endswith("with the runs of y")
    first_use(model)
    assert response.function.calls == 16
    assert prb.cost(model).runs == 0


def test_what_is_no_model_is_refused() -> None:
    with pytest.raises(
        TypeError, match=r"cost: model: got a function that returns NoneType None, expected a"
    ):
        prb.cost(lambda: None)  # type: ignore[arg-type, return-value]
    with pytest.raises(ZeroDivisionError):
        prb.cost(lambda: 1 / 0)  # type: ignore[arg-type, return-value]
    with pytest.raises(TypeError, match=r"prb.cost\(\): got no model on the context"):
        prb.cost()


FIRST = SimulatorCost("y", "Reweighted(64)", RunCost(64, 0, 2048, "up to 2048"), 10, 8)
SECOND = SimulatorCost("z", "Fresh(50)", RunCost(16, 50, None, "as asked"), 0, 1)


def test_simulators_add_up_and_read_as_sentences() -> None:
    cost = Cost((FIRST, SECOND))
    assert (cost.runs, cost.runs_each) == (70, 50)
    assert repr(cost) == (
        "y: Reweighted(64)\n"
        "  at first: 64 runs, 10 of them computed, 8 at a time\n"
        "  for each value of the hyperparameters: no run\n"
        "  more: up to 2048\n"
        "z: Fresh(50)\n"
        "  at first: 16 runs, 0 of them computed, one at a time\n"
        "  for each value of the hyperparameters: 50 runs\n"
        "  more: as asked"
    )


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0123, "0.012 s"),
        (9.4, "9.4 s"),
        (119.0, "119 s"),
        (120.0, "2.0 min"),
        (7199.0, "120.0 min"),
        (7200.0, "2.0 h"),
        (2e6, "23.1 days"),
    ],
)
def test_durations_have_their_unit(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_propagations_state_their_runs() -> None:
    class Custom(Propagation):
        bind = None  # type: ignore[assignment]

    cost = prb.Reweighted(64, max_points=96).cost
    assert (cost.first, cost.per_theta, cost.most) == (64, 0, 96)
    assert cost.growth.startswith("up to 96 in all, ")
    assert prb.Reweighted(64).cost.most == 2048
    assert (prb.Resimulated(50).cost.per_theta, prb.Fresh(7).cost.per_theta) == (50, 7)
    assert Custom().cost == RunCost(0, 0, None, "as Custom asks for them")


@pytest.mark.parametrize(
    ("stops", "points"), [(BudgetError, 16), (KeyboardInterrupt, 16), (ValueError, 32)]
)
def test_a_design_is_what_it_was_where_work_is_interrupted(stops: Any, points: int) -> None:
    model, node = build(prb.Reweighted(16))
    bound = node.reweighted
    assert bound is not None
    at = [np.array([2.5]), np.array([0.7])]

    def work() -> None:
        with designs_as_before(Evaluator.of(model)):
            bound.add(at)
            values.append(bound.design.sample.values[16:])
            raise stops

    values: list[Any] = []
    with pytest.raises(stops):
        work()
    assert bound.n_points == points
    if points == 16:
        # The same batch again is the same, and was counted once as computed.
        bound.add(at)
        assert np.array_equal(bound.design.sample.values[16:], values[0])
        assert (bound.responses.count, bound.responses.computed) == (48, 32)


def test_what_is_kept_is_told(tmp_path: Path) -> None:
    def told(propagation: Any, *also: str) -> str:
        return kept(build(propagation)[0], *also)

    assert told(prb.Resimulated(16)) == "nothing is kept: give the propagation a store="
    assert told(prb.Reweighted(16)) == "kept: the responses of the model's designs"
    both = told(prb.Fresh(16, store=tmp_path), "all stages (run.nc)")
    assert both == f"kept: all stages (run.nc) and all responses ({tmp_path})"


def test_only_budgets_are_explained() -> None:
    model, _ = build(prb.Fresh(16))
    with (
        pytest.raises(BudgetError, match=r"^prb\.x: spent before there was a result; nothing is"),
        explained(model, "prb.x"),
    ):
        raise BudgetError("spent")
    with pytest.raises(ValueError, match=r"^other$"), explained(model, "prb.x"):
        raise ValueError("other")
