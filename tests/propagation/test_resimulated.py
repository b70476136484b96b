"""Responses computed for every theta: the same base points, or new draws."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
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


def fresh_bound(n: int = 40, random_seed: int = 0) -> Bound:
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
    found = fresh_bound()
    count = found.responses.count
    first, second = (found.populations(PARAMS)[0] for _ in range(2))
    assert not np.isin(first, second).any()
    assert found.draws == 2
    assert found.responses.count - count == 80


def test_seed_and_number_of_draws_determine_the_next_ones() -> None:
    one, two, other = fresh_bound(), fresh_bound(), fresh_bound(random_seed=1)
    values = [b.populations(PARAMS)[0] for b in (one, two, other)]
    np.testing.assert_array_equal(values[0], values[1])
    assert not np.array_equal(values[0], values[2])
    one.draws = 0
    np.testing.assert_array_equal(one.populations(PARAMS)[0], values[0])


def test_the_operation_takes_a_batch_and_has_no_gradient() -> None:
    found = fresh_bound()
    mu, sigma = pt.dvector(), pt.dvector()
    graph = found._discrepancy([mu, sigma])
    values = pytensor.function([mu, sigma], graph)(np.zeros(3), np.array([1.0, -1.0, 2.0]))
    assert values.shape == (3,)
    np.testing.assert_array_equal(np.isfinite(values), [True, False, True])
    with pytest.raises(TypeError, match="its log-density is random and has no gradient"):
        pt.grad(graph.sum(), mu)


def test_chains_in_processes_of_their_own_draw_different_specimens() -> None:
    """Processes begin as copies, with the same seeds and counts; what they ask for differs."""
    here, there = fresh_bound(), fresh_bound()
    a = here.populations([np.array([0.5]), np.array([1.0])])[0]
    b = there.populations([np.array([0.51]), np.array([1.0])])[0]
    # The same noise would be moved by .01.
    assert np.abs(np.sqrt(np.sort(b[0])) - np.sqrt(np.sort(a[0]))).max() > 0.05


def test_predictive_draws_follow_the_seed_and_are_new_specimens() -> None:
    found = fresh_bound(n=5)
    params = [np.array(0.5), np.array(1.0)]
    one, same, other = (found.draw(np.random.default_rng(s), 50, params) for s in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.isin(one, other).any()
    assert np.unique(one).size == 50
    assert np.isnan(found.draw(np.random.default_rng(1), 3, [np.array(0.5), np.array(-1.0)])).all()


def model() -> pm.Model:
    with pm.Model() as found:
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), 1.0)
        prb.Simulator(
            "y", np.square, x, metric=prb.AreaMetric(), observed=[0.5, 1.0, 1.5], epsilon=0.5,
            propagation=prb.Fresh(20),
        )  # fmt: skip
    return found


def test_a_sampler_s_seed_decides_the_draws_of_every_run() -> None:
    one = model()
    runs = [
        prb.sample_smc(
            30, chains=2, model=one, adjustment=None, random_seed=seed, progressbar=False
        )
        for seed in (1, 1, 2)
    ]
    first, again, other = (run.calibration["discrepancy"].values for run in runs)
    np.testing.assert_array_equal(first, again)
    assert not np.isin(first, other).any()


@pytest.mark.long
def test_prior_predictive_sampling_follows_its_seed() -> None:
    drawn = [
        pm.sample_prior_predictive(3, model=model(), random_seed=seed).prior_predictive["y"].values
        for seed in (1, 1, 2)
    ]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert not np.isin(drawn[0], drawn[2]).any()


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (
            lambda mu, sigma: pm.SkewNormal.dist(mu=mu, sigma=sigma, alpha=2.0),
            stats.skewnorm(2.0, 2.0, 0.5),
        ),
        (lambda mu, sigma: pm.Rice.dist(nu=mu, sigma=sigma), stats.rice(4.0, scale=0.5)),
        (lambda mu, sigma: pm.Moyal.dist(mu, sigma), stats.moyal(2.0, 0.5)),
        (
            lambda mu, sigma: pm.TruncatedNormal.dist(mu, sigma, lower=2.0),
            stats.halfnorm(2.0, 0.5),
        ),
        (
            lambda mu, sigma: pm.Truncated.dist(pm.Laplace.dist(mu, sigma), lower=mu),
            stats.expon(2.0, 0.5),
        ),
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
    found = next(iter(nodes(model).values())).bound
    given = {"mu": np.array([2.0]), "sigma": np.array([0.5])}
    values, weights = found.populations([given[str(r.name)] for r in found.inputs.roots])
    assert values.shape == weights.shape == (1, 400)
    # A fixed seed: far from the one in a thousand that another distribution would give.
    assert stats.kstest(values[0], expected.cdf).pvalue > 0.01
    assert np.isfinite(
        prb.sample_smc(20, chains=2, model=model, adjustment=None).posterior["mu"]
    ).all()
