"""Synthetic data sets, bootstrap weights, shared specimens, and models of other data."""

from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
from four_metrics import METRICS, R256, same
from one_input import one_input
from scipy.stats import norm

import prbayes as prb
from prbayes._validate import Floats
from prbayes.inference.resampling import (
    DataSets,
    _are_countable,
    aligned,
    dependent,
    fresh_data,
    groups,
    one_set,
    reweighted_sets,
    sets_along,
    siblings,
    simulated_sets,
)
from prbayes.model.evaluator import Evaluator, compiled_objective
from prbayes.model.simulator_with_data import number_specimens
from prbayes.numerics.derivatives import differences
from prbayes.propagation.reweighted import designs_restored, same_points

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 40)
N = OBSERVED.size
KL, AREA = METRICS["kl"], METRICS["area"]
TRUTH = np.array([1.0])
LABELS = np.arange(N)
UNEQUAL = np.random.default_rng(8).dirichlet(np.full(N, 3.0))


def build(
    metric: prb.Metric = KL, observed: Floats = OBSERVED, sd: float | None = 0.5, **keywords: Any
) -> Evaluator:
    keywords = {"propagation": R256} | keywords
    return Evaluator.of(one_input(observed, metric, response=same, sd=sd, **keywords))


def pair(a: Any, b: Any, *, other_input: bool = False, seed: int = 0) -> Evaluator:
    """Two responses to one input, y and 2 y, with specimen labels; a third one, of another input, without."""
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 2)
        x, z = pm.Normal.dist(mu, 0.5), pm.Normal.dist(mu, 0.5)
        second: dict[str, Any] = {"metric": KL, "specimens": b, "observed": 2 * OBSERVED}
        second["propagation"] = prb.Reweighted(256, random_seed=seed) if seed else R256
        prb.Simulator("a", same, x, metric=KL, observed=OBSERVED, specimens=a, propagation=R256)
        prb.Simulator("b", lambda x: 2 * x, z if other_input else x, **second)
        third = pm.Normal.dist(mu, 1.0)
        prb.Simulator("c", same, third, metric=KL, observed=OBSERVED[:9], propagation=R256)
    return Evaluator.of(model)


@cache
def plain() -> Evaluator:
    """Return the model of independent specimens, which no test changes."""
    return build()


@cache
def repeated() -> Evaluator:
    """Return the model of specimens that were measured twice."""
    return build(specimens=LABELS // 2)


@cache
def apart() -> Evaluator:
    return pair(None, None)


@cache
def shared() -> Evaluator:
    """Return the model of specimens that two simulators share, in opposite order."""
    return pair(LABELS, LABELS[::-1])


def means(sets: DataSets) -> list[Floats]:
    return [w @ v for v, w in zip(sets.values, sets.weights, strict=True)]


# -- specimens -------------------------------------------------------------------------------------


def test_numbers_and_groups_of_specimens() -> None:
    nodes = apart().nodes
    assert not dependent(nodes)
    assert groups(nodes) == [[0], [1], [2]]
    nodes = shared().nodes
    numbers, total = number_specimens(nodes)
    assert total == N + 9
    np.testing.assert_array_equal(numbers[0], numbers[1][::-1])
    assert set(numbers[2]).isdisjoint(numbers[0])
    assert dependent(nodes)
    assert groups(nodes) == [[0, 1], [2]]
    assert siblings(nodes, {"b"}) == {"a", "b"}
    assert siblings(nodes, {"c"}) == {"c"}
    assert aligned(nodes[:2])
    assert not aligned(nodes)
    assert number_specimens(repeated().nodes)[1] == N // 2
    assert dependent(repeated().nodes)
    # a and c have no label in common, but both share with b: if one design moves, all three do.
    labels = {"a": range(10), "c": range(10, 20), "d": range(30, 40), "b": range(5, 15)}
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.5)
        for name, values in labels.items():
            given: dict[str, Any] = {"observed": OBSERVED[:10], "specimens": list(values)}
            prb.Simulator(name, same, x, metric=KL, propagation=R256, **given)
    nodes = Evaluator.of(model).nodes
    assert groups(nodes) == [[0, 1, 3], [2]]
    assert siblings(nodes, {"a"}) == {"a", "b", "c"}


# -- data sets drawn from the model ----------------------------------------------------------------


def test_simulated_sets_are_samples_of_the_population() -> None:
    sets = simulated_sets(plain(), TRUTH, 2000)
    (weights,) = sets.weights
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    np.testing.assert_allclose(weights * N, np.round(weights * N), atol=1e-9)  # N draws each
    # 2000 sets: standard errors 0.5 / sqrt(N 2000) of the mean, 1.6% of the sd.
    (mean,) = means(sets)
    assert abs(mean.mean() - 1) < 4 * 0.5 / (N * 2000) ** 0.5
    np.testing.assert_allclose(mean.std(), 0.5 / N**0.5, rtol=4 * 0.016)
    np.testing.assert_array_equal(simulated_sets(plain(), TRUTH, 2000).weights[0], weights)
    assert (simulated_sets(plain(), TRUTH, 2000, seed=1).weights[0] != weights).any()
    # Two measurements are one draw, and unequal weights go with the draws.
    for evaluator, scatter in (
        (repeated(), (N / 2) ** -0.5),
        (build(weights=UNEQUAL), (UNEQUAL**2).sum() ** 0.5),
    ):
        (mean,) = means(simulated_sets(evaluator, TRUTH, 2000))
        np.testing.assert_allclose(mean.std(), 0.5 * scatter, rtol=4 * 0.016)


def test_more_specimens_than_points_are_counted() -> None:
    n = 1000
    evaluator = build(AREA, np.random.default_rng(2).normal(1.0, 0.5, n))
    sets = simulated_sets(evaluator, TRUTH, 2000)
    values, (mass,) = evaluator.populations(TRUTH[None], 0)
    np.testing.assert_array_equal(sets.values[0], values[0])
    counts = sets.weights[0] * n
    np.testing.assert_allclose(counts.sum(axis=1), n)
    np.testing.assert_allclose(counts, counts.round(), atol=1e-9)
    # Mean and variance of a multinomial count; five standard errors of 2000 sets, of 256 points.
    error = (n * mass * (1 - mass) / 2000) ** 0.5
    assert (np.abs(counts.mean(axis=0) - n * mass) <= 5 * error + 1e-12).all()
    likely = n * mass > 3
    variance = (n * mass * (1 - mass))[likely]
    np.testing.assert_allclose(counts.var(axis=0)[likely], variance, rtol=5 * (2.5 / 2000) ** 0.5)
    again = simulated_sets(evaluator, TRUTH, 2000, seed=1)
    assert (again.weights[0] != sets.weights[0]).any()
    # Weights, labels, and outputs that are not measured need the single specimens.
    for keywords in ({"weights": np.arange(1.0, n + 1)}, {"specimens": np.arange(n) // 2}):
        other = build(AREA, evaluator.nodes[0].observed, **keywords)
        assert not _are_countable(other, list(values))
    along, counted = sets_along(
        evaluator, np.repeat(TRUTH[None], 2000, 0), np.random.default_rng(3)
    )
    np.testing.assert_allclose(along.weights[0] * n, counted[0].toarray())
    assert (np.abs(counted[0].mean(axis=0) - n * mass) <= 5 * error + 1e-12).all()


def test_shared_specimens_are_drawn_together() -> None:
    labels = [f"s{i}" for i in range(N)]
    evaluator = pair(labels, labels)
    a, b, c = means(simulated_sets(evaluator, TRUTH, 500))
    np.testing.assert_allclose(b, 2 * a, rtol=1e-12)
    assert abs(np.corrcoef(a, c)[0, 1]) < 4 / 500**0.5
    a, b, _ = means(simulated_sets(apart(), TRUTH, 500))
    assert abs(np.corrcoef(a, b)[0, 1]) < 4 / 500**0.5
    # Half of the labels in common: half of the covariance.
    a, b, _ = means(simulated_sets(pair(LABELS, LABELS + N // 2), TRUTH, 2000))
    assert abs(np.corrcoef(a, b)[0, 1] - 0.5) < 4 * 0.75 / 2000**0.5
    thetas, rng = np.linspace(0, 2, 12)[:, None], np.random.default_rng(2)
    a, b, c = means(sets_along(evaluator, thetas, rng)[0])
    np.testing.assert_allclose(b, 2 * a)
    assert not np.allclose(c, a)


def test_each_theta_has_a_data_set_from_its_own_population() -> None:
    evaluator = build(observed=np.arange(20.0) / 10, sd=None)
    ends = np.array([[0.5, np.log(0.3)], [1.4, np.log(0.6)]])
    sets, _ = sets_along(evaluator, np.repeat(ends, 300, axis=0), np.random.default_rng(1))
    (values,), (weights,) = sets.values, sets.weights
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    np.testing.assert_allclose(weights * 20, np.round(weights * 20), atol=1e-9)
    mean = (weights @ values).reshape(2, 300)
    spread = np.sqrt((weights @ values**2).reshape(2, 300) - mean**2)
    for k, (mu, log_sigma) in enumerate(ends):
        sigma = np.exp(log_sigma)
        assert abs(mean[k].mean() - mu) < 4 * sigma / np.sqrt(20 * 300)
        assert 0.85 < mean[k].std() / (sigma / np.sqrt(20)) < 1.15
        assert 0.93 < spread[k].mean() / sigma < 1.0


@pytest.mark.parametrize("keywords", [{"other_input": True}, {"seed": 1}])
def test_shared_labels_of_different_inputs_or_designs_are_refused(keywords: dict[str, Any]) -> None:
    evaluator = pair(LABELS, LABELS, **keywords)
    message = r"same labels in a, b with different inputs or designs.*same .dist\(\)"
    with pytest.raises(ValueError, match=message):
        simulated_sets(evaluator, TRUTH, 5)
    with pytest.raises(ValueError, match=message):
        fresh_data(evaluator, TRUTH, np.random.default_rng(0))
    # Without labels the model has nothing to define.
    assert len(simulated_sets(pair(None, None, **keywords), TRUTH, 5).values) == 3


def weighted_mean(simulated: Any, observed: Any, weights: Any) -> Any:
    is_finite = np.isfinite(simulated)
    return abs((np.where(is_finite, simulated, 0) * weights).sum(axis=-1) - observed.mean())


def test_specimens_without_a_response_cannot_be_observed_and_failures_only_if_they_count() -> None:
    def of_failing(metric: Any) -> Evaluator:
        """Return a model of specimens of which half are lost, and a few fail."""
        failing = lambda x: np.where(x > 1.2, np.inf, np.where(x < 0, np.nan, x))  # noqa: E731
        given: dict[str, Any] = {"observed": OBSERVED[OBSERVED < 1]}
        given["propagation"] = prb.Reweighted(256, max_lost=0.9)
        model = one_input(metric=metric, response=failing, mu=(0, 1), sd=0.5, **given)
        return Evaluator.of(model)

    rng = np.random.default_rng(0)
    evaluator = of_failing(prb.FunctionMetric(weighted_mean, weighted=True))
    sets = simulated_sets(evaluator, TRUTH, 50)
    assert np.isfinite(sets.values[0]).all()
    np.testing.assert_allclose(sets.weights[0].sum(axis=1), 1)
    fresh = fresh_data(evaluator, TRUTH, rng)["y"]
    assert ((fresh > 0) & (fresh < 1.2)).all()
    with pytest.raises(ValueError, match="y: got 0 responses that can be observed of"):
        fresh_data(evaluator, np.array([9.0]), rng)
    evaluator = of_failing(AREA)
    expected = norm.sf(1.2, *TRUTH, 0.5) / norm.sf(0, *TRUTH, 0.5)
    sets = simulated_sets(evaluator, TRUTH, 2000)
    assert not np.isnan(sets.values[0]).any()
    share = sets.weights[0][:, np.isinf(sets.values[0])].sum(axis=1)
    error = share.std() / np.sqrt(2000)
    np.testing.assert_allclose(share.mean(), expected, atol=4 * error + 1 / 256)
    fresh = np.array([fresh_data(evaluator, TRUTH, rng)["y"] for _ in range(20)])
    error = np.sqrt(expected / fresh.size)
    np.testing.assert_allclose(np.isinf(fresh).mean(), expected, atol=4 * error)


def test_fresh_data_call_the_response() -> None:
    evaluator, rng = build(propagation=prb.Resimulated(64)), np.random.default_rng(4)
    draws = np.array([fresh_data(evaluator, TRUTH, rng)["y"] for _ in range(20)])
    assert draws.shape == (20, N)
    # Continuous, unlike stored responses: no value twice, in a data set or between them.
    assert np.unique(draws).size == draws.size
    assert abs(draws.mean() - 1) < 4 * 0.5 / draws.size**0.5
    np.testing.assert_allclose(draws.std(), 0.5, rtol=4 / (2 * draws.size) ** 0.5)
    data = fresh_data(shared(), TRUTH, rng)
    np.testing.assert_allclose(data["b"], 2 * data["a"][::-1])
    assert data["c"].shape == (9,)
    assert not np.isin(data["c"], data["a"]).any()
    data = fresh_data(apart(), TRUTH, rng)
    assert abs(np.corrcoef(data["a"], data["b"])[0, 1]) < 4 / N**0.5
    twice = fresh_data(repeated(), TRUTH, rng)["y"]
    np.testing.assert_array_equal(twice[::2], twice[1::2])
    assert np.unique(twice).size == N // 2


# -- weights on the observed specimens -------------------------------------------------------------


def test_dirichlet_weights() -> None:
    (weights,) = reweighted_sets(plain(), 4000).weights
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    np.testing.assert_allclose(weights.mean(axis=0), 1 / N, rtol=4 / 4000**0.5)
    # Var of an element of Dirichlet(1, ..., 1); the variance of 4000 squares of nearly exponential
    # numbers: 5%.
    np.testing.assert_allclose(weights.var(axis=0).mean(), (N - 1) / (N**2 * (N + 1)), rtol=0.03)
    (weighted,) = reweighted_sets(build(weights=UNEQUAL), 4000).weights
    expected = weights * UNEQUAL / (weights * UNEQUAL).sum(axis=1, keepdims=True)
    np.testing.assert_allclose(weighted, expected, rtol=1e-10)
    # Shared and repeated specimens have one weight.
    a, b, _ = reweighted_sets(shared(), 5).weights
    np.testing.assert_allclose(a, b[:, ::-1])
    a, b, _ = reweighted_sets(apart(), 5).weights
    assert (a != b).all()
    (twice,) = reweighted_sets(repeated(), 5).weights
    np.testing.assert_allclose(twice[:, ::2], twice[:, 1::2])


@pytest.mark.parametrize("weights", [None, UNEQUAL], ids=["equal", "unequal"])
def test_one_data_set_as_it_would_be_measured(weights: Any) -> None:
    evaluator = build(weights=weights)
    simulated = simulated_sets(evaluator, TRUTH, 5, seed=3)
    bootstrap = reweighted_sets(evaluator, 3, 1)
    for sets in (simulated, bootstrap):
        data, own = one_set(evaluator, sets, 2)
        np.testing.assert_allclose(own["y"].sum(), 1)
        np.testing.assert_allclose(data["y"] @ own["y"], sets.weights[0][2] @ sets.values[0])
        other = evaluator.observing(data, weights=own)
        np.testing.assert_allclose(other.nodes[0].target.weights, own["y"])
    # Bootstrap weights belong to the observed specimens.
    np.testing.assert_array_equal(data["y"], OBSERVED)
    np.testing.assert_allclose(own["y"], bootstrap.weights[0][2])
    if weights is None:
        # Specimens of equal weights have a row each, although some points are drawn twice.
        data, own = one_set(evaluator, simulated, 2)
        assert data["y"].shape == (N,)
        np.testing.assert_allclose(own["y"], 1 / N)
        assert len(np.unique(data["y"])) < N


# -- one model, other data -------------------------------------------------------------------------


def test_observing_is_the_model_of_other_data() -> None:
    data = np.random.default_rng(7).normal(0.5, 0.7, N)
    evaluator = build(KL, sd=None, weights=UNEQUAL)
    built = build(KL, data, sd=None, weights=UNEQUAL)
    thetas = evaluator.hyperparameters.prior_thetas(20, 1)
    before = evaluator(thetas).discrepancies
    other = evaluator.observing({"y": data})
    for size in (1, 20):
        actual, expected = other(thetas[:size]), built(thetas[:size])
        np.testing.assert_allclose(actual.discrepancies, expected.discrepancies, rtol=1e-10)
        np.testing.assert_array_equal(actual.log_prior, expected.log_prior)
    # Neither is the first one changed, nor any response computed.
    np.testing.assert_array_equal(evaluator(thetas).discrepancies, before)
    assert other.n_responses == evaluator.n_responses == 256
    scales = np.array([0.3])
    value, gradient, _ = differences(lambda t: other.total(t, scales), np.full(2, 1e-4))(thetas[0])
    exact, slope = compiled_objective(built, prior=False, gradient=True)(thetas[0], scales)
    values = [value, *compiled_objective(other, prior=False, gradient=False)(thetas[0], scales)]
    np.testing.assert_allclose(values, exact)
    np.testing.assert_allclose(gradient, slope, rtol=1e-3, atol=1e-3 * np.abs(slope).max())
    for prior, slopes in ((True, False), (False, True)):
        with pytest.raises(NotImplementedError):
            compiled_objective(other, prior=prior, gradient=slopes)
    # Another number of observations drops the weights.
    fewer = evaluator.observing({"y": OBSERVED[:10]})
    np.testing.assert_allclose(fewer.nodes[0].target.weights, 0.1)


# -- designs ---------------------------------------------------------------------------------------


def test_batches_added_inside_are_undone() -> None:
    evaluator = build(KL, sd=None)
    (bound,) = evaluator.reweighted.values()
    thetas = evaluator.hyperparameters.prior_thetas(30, 1)
    before, support = evaluator(thetas).discrepancies, evaluator.support(thetas)["y"]
    inside = []
    for at in (thetas[:3], thetas[3:6]):
        with designs_restored([bound]):
            bound.add(evaluator.parents(at, 0))
            assert (bound.n_points, len(bound.design.batch_sizes)) == (512, 2)
            inside.append(evaluator(thetas).discrepancies)
        assert (bound.n_points, len(bound.design.batch_sizes)) == (256, 1)
    np.testing.assert_array_equal(evaluator(thetas).discrepancies, before)
    for key, value in evaluator.support(thetas)["y"].items():
        np.testing.assert_array_equal(value, support[key])
    # So is the graph that PyMC's samplers evaluate.
    graph = compiled_objective(evaluator, prior=False, gradient=False)(thetas[0], np.ones(1))[0]
    np.testing.assert_allclose(graph, before[0, 0], rtol=1e-10)
    # Two designs of equal size are two designs: nothing of the first remains in the second.
    fresh = build(KL, sd=None)
    fresh.nodes[0].bound.add(fresh.parents(thetas[3:6], 0))
    np.testing.assert_allclose(inside[1], fresh(thetas).discrepancies, rtol=1e-10)
    assert not np.allclose(inside[0], inside[1], rtol=1e-6)


def test_a_failure_inside_is_undone_and_points_are_compared() -> None:
    a, b, c = pair(None, None).reweighted.values()
    assert same_points(a, b)
    assert not same_points(a, c)

    def fail() -> None:
        with designs_restored([b]):
            b.add([np.zeros(3)])
            assert not same_points(a, b)
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert same_points(a, b)
    assert not same_points(a, build(propagation=prb.Resimulated(256)).nodes[0].bound)
