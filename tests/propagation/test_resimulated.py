"""Common points through inverse distribution functions, for each theta anew."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pymc as pm
import pytest
from scipy import stats

import prbayes as prb
from prbayes.model.random_variable import nodes
from prbayes.propagation.base import Bound

OBSERVED = [0.5, 1.0, 1.5, 2.5]


def bound(response: Any, n: int = 64, metric: Any = None) -> Bound:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator(
            "y",
            response,
            x,
            metric=metric or prb.AreaMetric(),
            observed=OBSERVED,
            propagation=prb.Resimulated(n),
        )
    return next(iter(nodes(model).values())).bound


def opaque(x: Any) -> Any:
    return np.asarray(x, dtype=float) ** 2


def test_responses_are_those_of_the_quantiles_of_the_base_points() -> None:
    found = bound(np.positive)
    params = [np.array([2.0]), np.array([3.0])]
    (values,), (weights,) = found.populations(params)
    u = stats.norm.cdf((values - 2.0) / 3.0)
    # One scrambled Sobol point in each of 64 equal intervals.
    np.testing.assert_array_equal(np.sort((u * 64).astype(int)), np.arange(64))
    np.testing.assert_array_equal(weights, 1 / 64)


@pytest.mark.exact
def test_the_same_points_for_every_theta() -> None:
    found = bound(np.positive)
    values, _ = found.populations([np.array([0.0, 5.0]), np.array([1.0, 2.0])])
    np.testing.assert_allclose(values[1], 5.0 + 2.0 * values[0], rtol=1e-12)


def test_a_response_that_accepts_tensors_becomes_part_of_the_graph() -> None:
    assert bound(lambda x: x**2).symbolic
    assert not bound(opaque).symbolic


def test_a_response_that_gives_other_numbers_on_tensors_is_called_with_arrays() -> None:
    def two_faced(x: Any) -> Any:
        return x**2 if isinstance(x, np.ndarray) else x**3

    assert not bound(two_faced).symbolic


def test_both_ways_give_the_same_discrepancy_and_count_alike() -> None:
    params = [np.array([0.3, 1.0]), np.array([1.0, 0.5])]
    in_graph, called = bound(lambda x: x**2), bound(opaque)
    before = [b.responses.count for b in (in_graph, called)]
    values = [b.discrepancies(params, b.target) for b in (in_graph, called)]
    np.testing.assert_allclose(values[0], values[1], rtol=1e-12)
    spent = [b.responses.count - c for b, c in zip((in_graph, called), before, strict=True)]
    assert spent == [128, 128]


def test_too_few_responses_for_a_log_likelihood_are_said(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, logger="prbayes"):
        bound(np.positive, 1199, prb.LogLikelihood(density=prb.GaussianKDE()))
    assert "expected at least 1200 responses, 300 for each observation" in caplog.text
    caplog.clear()
    with caplog.at_level(logging.WARNING, logger="prbayes"):
        bound(np.positive, 1200, prb.LogLikelihood(density=prb.GaussianKDE()))
        bound(np.positive, 64, prb.KullbackLeibler())
    assert not caplog.text


def test_discrete_inputs_are_refused() -> None:
    with pm.Model():
        x = pm.Poisson.dist(pm.Exponential("rate", 1.0))
        with pytest.raises(
            TypeError,
            match=r"is discrete, expected a continuous one; use propagation=prb.Reweighted\(\)",
        ):
            prb.Simulator(
                "y",
                np.square,
                x,
                metric=prb.AreaMetric(),
                observed=OBSERVED,
                propagation=prb.Resimulated(64),
            )
