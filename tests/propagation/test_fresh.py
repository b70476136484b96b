"""New draws at every evaluation."""

from __future__ import annotations

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest

import prbayes as prb
from prbayes.model.simulator import nodes
from prbayes.propagation.base import Bound


def bound(n: int = 40, random_seed: int = 0) -> Bound:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator(
            "y",
            np.square,
            x,
            metric=prb.AreaMetric(),
            observed=[0.5, 1.0, 1.5],
            epsilon=0.1,
            propagation=prb.Fresh(n, random_seed=random_seed),
        )
    return next(iter(nodes(model).values())).bound


PARAMS = [np.array([0.5]), np.array([1.0])]


def test_every_evaluation_draws_anew_and_counts() -> None:
    found = bound()
    count = found.responses.count
    first, second = (found.populations(PARAMS)[0] for _ in range(2))
    assert not np.isin(first, second).any()
    assert found.draws == 2
    assert found.responses.count - count == 80


def test_seed_and_number_of_draws_determine_the_next_ones() -> None:
    one, two, other = bound(), bound(), bound(random_seed=1)
    values = [b.populations(PARAMS)[0] for b in (one, two, other)]
    np.testing.assert_array_equal(values[0], values[1])
    assert not np.array_equal(values[0], values[2])
    one.draws = 0
    np.testing.assert_array_equal(one.populations(PARAMS)[0], values[0])


def test_the_operation_takes_a_batch_and_has_no_gradient() -> None:
    found = bound()
    mu, sigma = pt.dvector(), pt.dvector()
    graph = found._discrepancy([mu, sigma])
    values = pytensor.function([mu, sigma], graph)(np.zeros(3), np.array([1.0, -1.0, 2.0]))
    assert values.shape == (3,)
    np.testing.assert_array_equal(np.isfinite(values), [True, False, True])
    with pytest.raises(TypeError, match="its log-density is random and has no gradient"):
        pt.grad(graph.sum(), mu)
