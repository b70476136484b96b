"""`bootstrap` against theory."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from four_metrics import METRICS, R256, same
from one_input import one_input
from scipy.stats import norm

import prbayes as prb
from prbayes.inference.refits import refit
from prbayes.inference.resampling import observed_set, one_set, reweighted_sets, simulated_sets

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 50)
N, SD = OBSERVED.size, float(OBSERVED.std())


def build(metric: prb.Metric, propagation: Any = R256) -> pm.Model:
    return one_input(OBSERVED, metric, response=same, propagation=propagation, mu=(0, 1), sd=0.5)


@cache
def fit(name: str, propagation: Any = R256) -> prb.Optimum:
    return prb.minimize(
        build(METRICS[name], propagation=propagation), method="Nelder-Mead", starts=0
    )


@pytest.mark.parametrize("parametric", [False, True])
def test_standard_deviations_of_a_normal_mean(parametric: bool) -> None:
    """The Dirichlet weighted variance is s^2 / (N + 1), the sampling variance 0.5^2 / N."""
    result = prb.bootstrap(fit("kl"), 1000, parametric=parametric)
    draws = result.posterior["mu"]
    assert draws.shape == (1, 1000)
    # 1000 draws: 2.2%; the mean is not quite the minimiser, nor these data normal: 6%.
    expected = 0.5 / N**0.5 if parametric else SD / (N + 1) ** 0.5
    np.testing.assert_allclose(float(draws.std()), expected, rtol=4 * 0.022 + 0.06)
    assert abs(0.5 / SD - 1) > 0.1  # the two are different
    offset = abs(float(draws.mean()) - fit("kl").point["mu"])
    assert offset < (4 / 1000**0.5 + 0.05) * expected
    assert result.posterior.attrs["converged"] == 1.0
    kind = "parametric" if parametric else "loss-likelihood"
    assert result.posterior.attrs["sampler"] == f"{kind} bootstrap"
    np.testing.assert_array_equal(result.observed_data["y"], OBSERVED)


def test_few_specimens_are_a_finding_of_the_draws() -> None:
    model = one_input(
        OBSERVED[:20], METRICS["kl"], response=same, propagation=R256, mu=(0, 1), sd=0.5
    )
    optimum = prb.minimize(model, starts=0, progressbar=False)
    findings = prb.diagnose(prb.bootstrap(optimum, 100, progressbar=False), model=model).findings
    assert [finding.code for finding in findings] == ["few-for-bootstrap"]
    assert prb.bootstrap(fit("kl"), 10).posterior.attrs["findings"] == "[]"


def breaking(x: Any) -> Any:
    """Return the load at which a specimen was measured; the strong ones break the machine."""
    return np.where(x > 1.6, np.inf, x)


@pytest.mark.parametrize("name", ["area", "ll"])
def test_where_specimens_fail_the_refits_are_around_the_optimum(name: str) -> None:
    specimens = breaking(1 + 0.5 * norm.ppf((np.arange(40) + 0.5) / 40))
    assert np.isinf(specimens).sum() == 5
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 0, 5), 0.5)
        prb.Simulator("y", breaking, x, metric=METRICS[name], observed=specimens, propagation=R256)
        optimum = prb.minimize(starts=0, progressbar=False)
    assert optimum.point["mu"] == pytest.approx(1, abs=0.06)
    # Were failures left out of the data sets, these would be a standard error farther down.
    draws = prb.bootstrap(optimum, parametric=True).posterior["mu"]
    sd = float(draws.std())
    assert abs(float(draws.mean()) - optimum.point["mu"]) < 0.2 * sd
    assert sd == pytest.approx(optimum.stderr["mu"], rel=0.2)


@pytest.mark.long
@pytest.mark.parametrize("parametric", [False, True])
def test_several_outputs_are_looked_at_as_the_metric_is_prepared_for_them(parametric: bool) -> None:
    optimum = of_two_outputs()
    found = prb.bootstrap(optimum, 20, parametric=parametric, random_seed=3)
    evaluator, sampling = optimum.evaluator, optimum.sampling()
    if parametric:
        sets = simulated_sets(evaluator, optimum.theta, 20, 3)
    else:
        sets = reweighted_sets(evaluator, 20, 3)
    shared, _ = refit(sampling, sets)
    draws = np.column_stack([found.posterior[name][0] for name in ("mu", "tau")])
    for i in (0, 9):
        data, weights = one_set(evaluator, sets, i)
        other = evaluator.observing(data, weights=weights)
        own, _ = refit(replace(sampling, evaluator=other), observed_set(other))
        (expected,) = own_values(evaluator, sampling.thetas(own))
        np.testing.assert_allclose(draws[i], expected, rtol=0.02)
    as_measured = own_values(evaluator, sampling.thetas(shared))
    assert np.abs(draws / as_measured - 1).max() > 0.04
    assert found.posterior.attrs["converged"] > 0.8


def own_values(evaluator: Any, thetas: Any) -> Any:
    values = evaluator.hyperparameters.constrained(thetas)
    return np.column_stack([values[name] for name in ("mu", "tau")])


@cache
def of_two_outputs() -> prb.Optimum:
    rng = np.random.default_rng(2)
    a, b = rng.normal(1, 0.5, 12), rng.normal(0, 0.3, 12)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.5)
        z = pm.Normal.dist(0, pm.HalfNormal("tau", 1))
        prb.Simulator(
            "y",
            lambda x, z: np.stack([x, x + z], axis=-1),
            x,
            z,
            metric=prb.Joint(METRICS["kl"]),
            observed=np.column_stack([a, a + b]),
            propagation=prb.Reweighted(1024, emulator=None),
        )
    return prb.minimize(model, starts=0, progressbar=False)


def test_no_response_is_computed_and_nothing_is_random() -> None:
    optimum = fit("kl")
    before = optimum.evaluator.n_responses
    one, two, other = (prb.bootstrap(optimum, 20, random_seed=seed).posterior for seed in (1, 1, 2))
    assert optimum.evaluator.n_responses == before
    xr.testing.assert_equal(one.to_dataset(), two.to_dataset())
    assert (one["mu"].values != other["mu"].values).any()


def test_bootstrap_without_a_design_is_of_first_order() -> None:
    draws = prb.bootstrap(fit("kl", prb.Resimulated(256)), 500).posterior["mu"]
    np.testing.assert_allclose(float(draws.std()), SD / (N + 1) ** 0.5, rtol=4 * 0.032 + 0.06)


def test_what_cannot_be_bootstrapped_is_refused() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), 0.5)
        pm.Normal("idle", 3, 2)
        prb.Simulator("y", same, x, metric=METRICS["kl"], observed=OBSERVED, propagation=R256)
    optimum = prb.minimize(model, starts=0)
    for parametric in (False, True):
        with pytest.raises(
            ValueError, match="bootstrap: the data are less informative than the prior about idle"
        ):
            prb.bootstrap(optimum, 10, parametric=parametric)
    model = build(METRICS["kl"], prb.Fresh(64))
    with pytest.raises(ValueError, match=r"bootstrap: y has prb\.Fresh"):
        prb.bootstrap(prb.minimize(model, method="Nelder-Mead", max_evaluations=5), 10)
