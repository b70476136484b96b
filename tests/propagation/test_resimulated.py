"""Responses computed for every theta: the same base points, or new draws."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from first_use import first_use
from scipy import stats

import prbayes as prb
from prbayes.propagation.base import Bound
from prbayes.response.compile import PLAIN

OBSERVED = [0.5, 1.0, 1.5, 2.5]


def simulated(response: Any, propagation: Any = None, metric: Any = None) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator(
            "y", response, x, metric=metric or prb.AreaMetric(), observed=OBSERVED, epsilon=0.5,
            propagation=propagation or prb.Resimulated(64),
        )  # fmt: skip
    return model


def bound(response: Any, propagation: Any = None, metric: Any = None) -> Bound:
    (node,) = first_use(simulated(response, propagation, metric)).values()
    return node.bound


def opaque(x: Any) -> Any:
    return np.asarray(x, dtype=float) ** 2


def test_responses_are_those_of_the_quantiles_of_the_base_points() -> None:
    found = bound(np.positive)
    (values,), (weights,) = found.populations([np.array([2.0]), np.array([3.0])])
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
    in_graph, called = bound(lambda x: x**2), bound(opaque)
    assert in_graph.symbolic
    assert not called.symbolic
    # Other numbers on tensors than on arrays.
    assert not bound(lambda x: x**2 if isinstance(x, np.ndarray) else x**3).symbolic
    params = [np.array([0.3, 1.0]), np.array([1.0, 0.5])]
    before = [b.responses.count for b in (in_graph, called)]
    values = [b.discrepancies(params, b.target) for b in (in_graph, called)]
    np.testing.assert_allclose(values[0], values[1], rtol=1e-12)
    spent = [b.responses.count - c for b, c in zip((in_graph, called), before, strict=True)]
    assert spent == [128, 128]


def test_too_few_responses_for_a_log_likelihood(caplog: pytest.LogCaptureFixture) -> None:
    likelihood = prb.LogLikelihood(density=prb.GaussianKDE())
    bound(np.positive, prb.Resimulated(1199), likelihood)
    assert "expected at least 1200, 300 for each observation" in caplog.text
    caplog.clear()
    bound(np.positive, prb.Resimulated(1200), likelihood)
    bound(np.positive, prb.Resimulated(64), prb.KullbackLeibler())
    assert not caplog.text


def fresh_bound(n: int = 40, random_seed: int = 0) -> Bound:
    return bound(np.square, prb.Fresh(n, random_seed=random_seed))


PARAMS = [np.array([0.5]), np.array([1.0])]


def test_every_evaluation_draws_other_specimens_that_seed_and_number_determine() -> None:
    fresh, same, seeded = fresh_bound(), fresh_bound(), fresh_bound(random_seed=1)
    count = fresh.responses.count
    first, second = (fresh.populations(PARAMS)[0] for _ in range(2))
    assert not np.isin(first, second).any()
    assert fresh.draws == 2
    assert fresh.responses.count - count == 80
    np.testing.assert_array_equal(same.populations(PARAMS)[0], first)
    assert not np.array_equal(seeded.populations(PARAMS)[0], first)
    fresh.draws = 0
    np.testing.assert_array_equal(fresh.populations(PARAMS)[0], first)
    # Chains in processes begin as copies; what they ask for differs. The same noise would be moved
    # by .01.
    moved = fresh_bound().populations([np.array([0.51]), np.array([1.0])])[0]
    assert np.abs(np.sqrt(np.sort(moved[0])) - np.sqrt(np.sort(first[0]))).max() > 0.05


def test_the_operation_takes_a_batch_and_has_no_gradient() -> None:
    mu, sigma = pt.dvector(), pt.dvector()
    graph = fresh_bound()._discrepancy([mu, sigma])
    function = pytensor.function([mu, sigma], graph, mode=PLAIN)
    values = function(np.zeros(3), np.array([1.0, -1.0, 2.0]))
    np.testing.assert_array_equal(np.isfinite(values), [True, False, True])
    with pytest.raises(TypeError, match="its log-density is random and has no gradient"):
        pt.grad(graph.sum(), mu)


def test_predictive_draws_follow_the_seed_and_are_new_specimens() -> None:
    found = fresh_bound(n=5)
    params = [np.array(0.5), np.array(1.0)]
    first, same, second = (found.draw(np.random.default_rng(s), 50, params) for s in (1, 1, 2))
    np.testing.assert_array_equal(first, same)
    assert not np.isin(first, second).any()
    assert np.unique(first).size == 50
    assert np.isnan(found.draw(np.random.default_rng(1), 3, [np.array(0.5), np.array(-1.0)])).all()


def test_a_sampler_s_seed_decides_the_draws_of_every_run() -> None:
    model = simulated(np.square, prb.Fresh(20))

    def run(seed: int) -> Any:
        keywords: dict[str, Any] = {"chains": 2, "adjustment": None, "progressbar": False}
        draws = prb.sample_smc(10, model=model, random_seed=seed, **keywords)
        return draws.calibration["discrepancy"].values

    first, again, other = map(run, (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.isin(first, other).any()


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda m, s: pm.SkewNormal.dist(mu=m, sigma=s, alpha=2.0), stats.skewnorm(2.0, 2.0, 0.5)),
        (lambda m, s: pm.Rice.dist(nu=m, sigma=s), stats.rice(4.0, scale=0.5)),
        (pm.Moyal.dist, stats.moyal(2.0, 0.5)),
        (lambda m, s: pm.TruncatedNormal.dist(m, s, lower=2.0), stats.halfnorm(2.0, 0.5)),
        (lambda m, s: pm.Truncated.dist(pm.Laplace.dist(m, s), lower=m), stats.expon(2.0, 0.5)),
    ],
    ids=["SkewNormal", "Rice", "Moyal", "TruncatedNormal", "Truncated"],
)
def test_inputs_that_pymc_draws_by_functions_of_its_own(make: Any, expected: Any) -> None:
    with pm.Model() as model:
        x = make(pm.Normal("mu", 2, 0.5), pm.HalfNormal("sigma", 1))
        prb.Simulator(
            "y", np.positive, x, metric=prb.AreaMetric(), observed=expected.ppf([0.2, 0.5, 0.8]),
            epsilon=0.5, propagation=prb.Fresh(400),
        )  # fmt: skip
    (node,) = first_use(model).values()
    found = node.bound
    given = {"mu": np.array([2.0]), "sigma": np.array([0.5])}
    values, weights = found.populations([given[str(r.name)] for r in found.inputs.parents])
    assert values.shape == weights.shape == (1, 400)
    # A fixed seed: far from the one in a thousand that another distribution would give.
    assert stats.kstest(values[0], expected.cdf).pvalue > 0.01
