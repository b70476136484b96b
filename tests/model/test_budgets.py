"""What is kept of work that stops before its end, and what a design is then."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from line_problem import build

import prbayes as prb
from prbayes.model.budgets import designs_as_before, explained, kept
from prbayes.model.evaluator import Evaluator
from prbayes.response import BudgetError


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
