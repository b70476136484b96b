"""Many data sets at once against each by itself."""

from functools import cache

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes._validate import Floats
from prbayes.inference.batched_objective import BatchObjective
from prbayes.inference.resampling import DataSets, reweighted_sets
from prbayes.model.evaluator import Evaluator

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 30)
THETAS = np.array([[0.8], [1.1], [1.5]])
SCALES = np.array([2.0, 0.5])
METRICS = {"kl": prb.KullbackLeibler(), "pr": prb.ProbabilityResidual(), "area": prb.AreaMetric()}


@cache
def two(name: str) -> tuple[Evaluator, DataSets]:
    """Return a model of two simulators, and three data sets."""
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 2)
        for k, factor in enumerate((1.0, 3.0)):
            prb.Simulator(
                f"y{k}",
                lambda x, factor=factor: factor * x,
                pm.Normal.dist(mu, 0.5),
                metric=METRICS[name],
                observed=factor * OBSERVED,
                propagation=prb.Reweighted(128),
            )
    evaluator = Evaluator.of(model)
    return evaluator, reweighted_sets(evaluator, 3)


def by_itself(evaluator: Evaluator, sets: DataSets, b: int, k: int) -> Floats:
    """Return the discrepancies of the k-th simulator from the b-th data set at all thetas."""
    target = evaluator.nodes[k].target.with_observed(sets.values[k], sets.weights[k][b])
    return np.asarray(target.of(*evaluator.populations(THETAS, k)))


@pytest.mark.parametrize("name", list(METRICS))
def test_it_is_the_sum_of_the_simulators_over_their_scales(name: str) -> None:
    evaluator, sets = two(name)
    objective = BatchObjective.of(evaluator, SCALES, sets)
    assert objective.n_sets == 3
    found = objective(np.broadcast_to(THETAS, (3, 3, 1)), np.arange(3))
    for b in range(3):
        expected = sum(by_itself(evaluator, sets, b, k) / SCALES[k] for k in range(2))
        np.testing.assert_allclose(found[b], expected, rtol=1e-10)


@pytest.mark.parametrize("name", list(METRICS))
def test_rows_are_data_sets_and_a_single_row_of_thetas_is_for_all(name: str) -> None:
    objective = BatchObjective.of(two(name)[0], SCALES, two(name)[1])
    whole = objective(THETAS[None], slice(None))
    assert whole.shape == (3, 3)
    some = objective(np.array([THETAS, THETAS]), np.array([2, 0]))
    np.testing.assert_allclose(some, whole[[2, 0]], rtol=1e-12)
    # At a theta of its own each.
    own = objective(THETAS[:, None], np.arange(3))
    np.testing.assert_allclose(own[:, 0], np.diag(whole), rtol=1e-12)


def test_of_some_simulators_only_those_count() -> None:
    evaluator, sets = two("area")
    objective = BatchObjective.of(evaluator, SCALES, sets, simulators=[1])
    found = objective(THETAS[None], slice(None))[0]
    np.testing.assert_allclose(found, by_itself(evaluator, sets, 0, 1) / 0.5, rtol=1e-10)


def test_a_data_set_sees_its_own_block_alone() -> None:
    evaluator, sets = two("area")
    alike = DataSets(sets.values, [w[[0, 0]] for w in sets.weights])
    blocks = [np.arange(128) % 2] * 2
    objective = BatchObjective.of(evaluator, SCALES, alike, blocks=blocks)
    found = objective(THETAS[None], slice(None))
    for b in (0, 1):
        expected = 0.0
        for k in (0, 1):
            values, weights = evaluator.populations(THETAS, k)
            half = weights * (blocks[k] == b)
            half = half / half.sum(axis=1, keepdims=True)
            target = evaluator.nodes[k].target.with_observed(sets.values[k], sets.weights[k][0])
            expected = expected + target.of(values, half) / SCALES[k]
        np.testing.assert_allclose(found[b], expected, rtol=1e-10)
    assert (found[0] != found[1]).all()


def test_where_no_point_of_the_design_is_left_it_is_infinite() -> None:
    evaluator, sets = two("area")
    # All points in the first block: the second data set has none.
    blocks = [np.where(np.arange(128) == 0, 2, 0)] * 2
    objective = BatchObjective.of(evaluator, SCALES, sets, blocks=blocks)
    found = objective(THETAS[None], slice(None))
    assert np.isfinite(found[0]).all()
    assert np.isposinf(found[1]).all()


def test_no_response_is_computed() -> None:
    evaluator, sets = two("pr")
    before = evaluator.n_responses
    BatchObjective.of(evaluator, SCALES, sets)(THETAS[None], slice(None))
    assert evaluator.n_responses == before
