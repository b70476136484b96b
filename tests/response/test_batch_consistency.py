"""Functions of batches in which specimens are not by themselves."""

from typing import Any

import numpy as np
import pymc as pm
import pytest
from first_use import first_use

import prbayes as prb
from prbayes.response.inputs import read_inputs
from prbayes.response.response import Responses

OBSERVED = np.linspace(-1, 1, 20)


def simulate(
    response: Any, *, observed: Any = OBSERVED, metric: Any = None, **keywords: Any
) -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), 1)
        metric = metric or prb.AreaMetric()
        propagation = prb.Reweighted(64)
        prb.Simulator(
            "y", response, x, metric=metric, observed=observed, propagation=propagation, **keywords
        )
    first_use(model)


@pytest.mark.parametrize(
    "response",
    [
        lambda x: x[..., ::-1],
        lambda x: x - x.mean(),
        lambda x: np.sort(x)[..., ::-1],
        lambda x: np.cumsum(x, axis=-1)[..., ::-1],
        lambda x: x / np.abs(x).max(),
    ],
    ids=["flip", "mean", "sort", "sum", "maximum"],
)
def test_a_response_that_mixes_its_specimens_is_refused(response: Any) -> None:
    with pytest.raises(
        prb.response.ResponseError,
        match=r"y: the response of a specimen depends on .* by itself, and .* among 64, expected",
    ):
        simulate(response)


def test_of_several_outputs_one_is_enough() -> None:
    def two(x: Any) -> Any:
        return np.stack([x, x[..., ::-1]], axis=-1)

    with pytest.raises(prb.response.ResponseError, match="depends on those that it is computed"):
        simulate(
            two,
            observed=np.random.default_rng(0).normal(size=(20, 2)),
            metric=prb.Joint(prb.AreaMetric()),
        )


def test_a_first_batch_of_one_specimen_is_no_look() -> None:
    def two(x: Any) -> Any:
        return np.stack([x, x[..., ::-1]], axis=-1)

    with pm.Model() as model:
        inputs = read_inputs("y", [pm.Normal.dist(pm.Normal("mu", 0, 1), 1)], model)
    responses = Responses("y", two, inputs, outputs=None)
    responses([np.array([0.5])], [])
    with pytest.raises(prb.response.ResponseError, match="depends on those that it is computed"):
        responses([np.arange(4.0)], [])


def test_others_are_not_refused() -> None:
    rng = np.random.default_rng(0)
    simulate(np.exp)
    simulate(lambda x: np.where(x > 0, x, np.nan))
    simulate(lambda x: x + 1e-4 * x.mean())  # as much as a solver's steps differ
    simulate(lambda x: x + rng.normal(size=x.shape))  # scatter of its own
    simulate(lambda x: x * 0.0 + 2.0)

    def of_many(x: Any) -> Any:
        assert x.size > 1, "takes no single specimen"
        return x

    simulate(of_many)


def test_it_costs_one_run_that_is_not_counted() -> None:
    sizes = []

    def line(x: Any) -> Any:
        sizes.append(x.size)
        return x

    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), 1)
        prb.Simulator(
            "y",
            line,
            x,
            metric=prb.AreaMetric(),
            observed=OBSERVED,
            propagation=prb.Reweighted(64),
        )
        optimum = prb.minimize(progressbar=False)
    assert sizes.count(1) == 1
    assert optimum.n_responses == sum(sizes) - 1
