"""Arguments in a wrong order: messages name the order of the function that was called."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
import pytest
from one_input import one_input

import prbayes as prb
from prbayes.model.random_variable import simulators

X = pm.Normal.dist()
CALLS: dict[str, tuple[Callable[[], Any], str]] = {
    "limit first": (
        lambda: prb.exceedance(None, 1.0, np.square, X),  # type: ignore[arg-type]
        r"prb.exceedance: response: got float 1.0.*exceedance\(result, response, limit, \*inputs",
    ),
    "input first": (
        lambda: prb.exceedance(None, np.square, X, 1.0),  # type: ignore[arg-type]
        r"prb.exceedance: limit: got TensorVariable.*exceedance\(result, response, limit, \*inputs",
    ),
    "predict": (
        lambda: prb.predict(None, X, np.square),  # type: ignore[arg-type]
        r"the order is predict\(result, response, \*inputs\)",
    ),
    "p_box": (
        lambda: prb.decision.p_box(None, X, np.square),  # type: ignore[arg-type]
        r"the order is p_box\(result, response, \*inputs\)",
    ),
    "quantity": (
        lambda: prb.decision.Mean(X, np.square),  # type: ignore[arg-type]
        r"the order is Mean\(response, \*inputs, ...\)",
    ),
    "condition": (
        lambda: prb.decision.Condition(X, np.square),  # type: ignore[arg-type]
        r"the order is Condition\(response, \*inputs\)",
    ),
}


@pytest.mark.parametrize("name", CALLS)
def test_messages_name_the_order_of_the_function(name: str) -> None:
    call, text = CALLS[name]
    with pytest.raises(TypeError, match=text):
        call()


def test_a_text_is_the_unit_of_one_output() -> None:
    (simulator,) = simulators(one_input([1.0, 2.0], prb.AreaMetric(), units="mm")).values()
    assert simulator.outputs.units == ("mm",)
    several = {"a": [1.0, 2.0], "b": [1.0, 2.0]}
    with pytest.raises(TypeError, match="units: got 'mm' for 2 outputs, expected a mapping"):
        one_input(several, units="mm")
