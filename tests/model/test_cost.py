"""The cost of a model is the number of runs that it computes; what is kept after a budget."""

from __future__ import annotations

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


class Counted:
    """A response that counts its calls."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, x: float) -> float:
        self.calls += 1
        return 2 * x


def model_of(response: Any, propagation: Any, *names: str) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        given = {"metric": prb.AreaMetric(), "observed": [1.0, 2.0, 2.5, 4.0]}
        for name in names:
            prb.Simulator(name, response, x, propagation=propagation, **given)
    return model


@pytest.mark.parametrize(
    ("propagation", "first", "per_theta"),
    [(prb.Reweighted(32), 32, 0), (prb.Resimulated(8), 16, 8), (prb.Fresh(8), 16, 8)],
)
def test_the_cost_is_the_number_of_runs(propagation: Any, first: int, per_theta: int) -> None:
    again = 0 if propagation.is_random else 3  # are computed again, and not counted
    response = Counted()
    function = prb.scalar(response)
    cost = prb.cost(model_of(function, propagation, "y"))
    model = model_of(function, propagation, "y")
    assert str(prb.cost(model)) == str(cost)
    assert (cost.runs, cost.runs_each, response.calls) == (first, per_theta, 0)
    first_use(model)
    assert response.calls == first + again
    later = prb.cost(model)
    assert (later.runs, later.simulators[0].needed.first, later.runs_each) == (0, first, per_theta)
    with model:
        assert prb.cost().simulators == later.simulators
    assert response.calls == first + again


def test_shared_runs_count_once() -> None:
    response = prb.scalar(Counted())
    model = model_of(response, prb.Reweighted(16), "y", "z")
    cost = prb.cost(model)
    assert [simulator.needed.first for simulator in cost.simulators] == [16, 0]
    assert cost.runs == 16
    assert cost.simulators[1].propagation.endswith("with the runs of y")
    first_use(model)
    assert response.function.calls == 16 + 2 * 3  # three again for each simulator
    assert prb.cost(model).runs == 0


def test_other_objects_than_models_are_refused() -> None:
    with pytest.raises(TypeError, match=r"prb.cost\(\): got function, expected a pm.Model"):
        prb.cost(lambda: None)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"prb.cost\(\): got no model on the context"):
        prb.cost()


def test_simulators_add_up_and_print_as_sentences() -> None:
    first = SimulatorCost("y", "Reweighted(64)", RunCost(64, 0, 2048, "up to 2048"), 10, 8)
    second = SimulatorCost("z", "Fresh(50)", RunCost(16, 50, None, "as asked"), 0, 1)
    cost = Cost((first, second))
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


def test_durations_have_their_unit() -> None:
    seconds = [0.0123, 9.4, 119.0, 120.0, 7199.0, 7200.0, 2e6]
    expected = ["0.012 s", "9.4 s", "119 s", "2.0 min", "120.0 min", "2.0 h", "23.1 days"]
    assert list(map(duration, seconds)) == expected


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
    ("error", "points"), [(BudgetError, 16), (KeyboardInterrupt, 16), (ValueError, 32)]
)
def test_an_interruption_restores_the_design(error: Any, points: int) -> None:
    model, node = build(prb.Reweighted(16))
    bound = node.reweighted
    assert bound is not None
    at = [np.array([2.5]), np.array([0.7])]
    values: list[Any] = []

    def work() -> None:
        with designs_as_before(Evaluator.of(model)):
            bound.add(at)
            values.append(bound.design.sample.values[16:])
            raise error

    with pytest.raises(error):
        work()
    assert bound.n_points == points
    if points == 16:
        # The same batch again is the same, and was counted once as computed.
        bound.add(at)
        assert np.array_equal(bound.design.sample.values[16:], values[0])
        assert (bound.responses.count, bound.responses.computed) == (48, 32)


def test_texts_of_what_is_kept(tmp_path: Path) -> None:
    def text(propagation: Any, *also: str) -> str:
        return kept(build(propagation)[0], *also)

    assert text(prb.Resimulated(16)) == "nothing is kept: give the propagation a store="
    assert text(prb.Reweighted(16)) == "kept: the responses of the model's designs"
    both = text(prb.Fresh(16, store=tmp_path), "all stages (run.nc)")
    assert both == f"kept: all stages (run.nc) and all responses ({tmp_path})"
    model, _ = build(prb.Fresh(16))
    message = r"^prb\.x: spent before there was a result; nothing is"
    with pytest.raises(BudgetError, match=message), explained(model, "prb.x"):
        raise BudgetError("spent")
    with pytest.raises(ValueError, match=r"^other$"), explained(model, "prb.x"):
        raise ValueError("other")
