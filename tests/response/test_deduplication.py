"""Points that are the same share one response, unless it has scatter of its own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.model.random_variable import nodes
from prbayes.response.deduplication import Known, once_each
from prbayes.response.inputs import read_inputs
from prbayes.response.response import Responses


class Counted:
    """A response that keeps what it was asked for; a specimen by itself is no run."""

    def __init__(self, function: Any) -> None:
        self.function = function
        self.asked: list[int] = []

    def __call__(self, *inputs: Any) -> Any:
        if np.size(inputs[0]) > 1:
            self.asked.append(int(np.size(inputs[0])))
        return self.function(*inputs)


def responses_of(function: Any, n_inputs: int = 1) -> Responses:
    with pm.Model() as model:
        rate = pm.HalfNormal("rate", 3)
        inputs = [pm.Poisson.dist(rate) for _ in range(n_inputs)]
        return Responses("y", function, read_inputs("y", inputs, model))


@pytest.mark.exact
def test_each_different_point_is_computed_once_and_four_of_them_twice_at_first() -> None:
    response = Counted(lambda a, b: 10 * a + b)
    responses = responses_of(response, 2)
    rng = np.random.default_rng(0)
    points = [rng.integers(0, 3, 500), rng.integers(0, 4, 500)]
    found = once_each(responses, points, None)
    np.testing.assert_array_equal(found, 10 * points[0] + points[1])
    assert response.asked == [12 + 4]
    # Known ones are not computed, and none is again.
    more = [rng.integers(0, 4, 300), rng.integers(0, 4, 300)]
    found = once_each(responses, more, Known(points, found))
    np.testing.assert_array_equal(found, 10 * more[0] + more[1])
    assert response.asked == [16, 4]
    assert responses.count == 800
    assert responses.computed == 20
    assert once_each(responses, more, Known(more, found)) == pytest.approx(found)
    assert response.asked == [16, 4]


@pytest.mark.exact
def test_different_points_are_one_call_with_all_of_them() -> None:
    response = Counted(np.exp)
    points = [np.random.default_rng(1).normal(size=100)]
    found = once_each(responses_of(response), points, None)
    np.testing.assert_array_equal(found, np.exp(points[0]))
    assert response.asked == [100]


def test_a_response_with_scatter_of_its_own_is_computed_everywhere() -> None:
    rng = np.random.default_rng(2)
    response = Counted(lambda x: x + rng.normal(size=np.shape(x)))
    responses = responses_of(response)
    x = np.repeat([0.0, 1.0], 200)
    found = once_each(responses, [x], None)
    assert sum(response.asked) == 400
    assert np.unique(found).size == 400
    assert np.std(found - x) == pytest.approx(1, abs=0.2)
    once_each(responses, [x], Known([x], found))
    assert response.asked[-1] == 400


@pytest.mark.exact
def test_failed_points_fail_again() -> None:
    responses = responses_of(lambda x: np.where(x > 1, np.nan, x))
    found = once_each(responses, [np.array([0, 2, 2, 1, 0])], None)
    np.testing.assert_array_equal(found, [0, np.nan, np.nan, 1, 0])
    assert responses.scatters is False


@pytest.mark.exact
def test_a_design_of_a_discrete_input_computes_a_value_once_also_after_refinement() -> None:
    response = Counted(lambda x: 2.0 * x)
    with pm.Model() as model:
        x = pm.Binomial.dist(16, pm.Beta("p", 2, 2))
        propagation = prb.Reweighted(256)
        prb.Simulator(
            "y",
            response,
            x,
            metric=prb.AreaMetric(),
            observed=[8.0, 10.0, 12.0],
            propagation=propagation,
        )
    (node,) = nodes(model).values()
    assert sum(response.asked) <= 17 + 4
    prb.refine(model, thetas=np.full((1, 1), 2.0))
    node.design.add([np.array([0.9, 0.95])])
    assert sum(response.asked) <= 17 + 4
    np.testing.assert_array_equal(node.design.values, 2.0 * node.design.batches.points[0])
    optimum = prb.minimize(model, progressbar=False)
    assert optimum.n_computed <= 17 + 4
    assert optimum.n_responses == node.design.n_points
