"""The posterior after further specimens."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from one_input import one_input

import prbayes as prb
from prbayes.model.specimen_likelihood import specimen_likelihoods
from prbayes.model.specimen_preparation import prepared
from prbayes.propagation.base import DesignError
from prbayes.results.update import rare_specimens

RNG = np.random.default_rng(5)
STIFFNESS = RNG.normal(20, 1.5, 40)
TWO = np.stack([STIFFNESS + RNG.normal(0, 0.3, 40), 100 / STIFFNESS], axis=1)


def deflection(stiffness: Any) -> Any:
    return 200 / stiffness


def both(stiffness: Any) -> Any:
    return np.stack([stiffness, 100 / stiffness], axis=-1)


def springs(observed: Any, **options: Any) -> pm.Model:
    return one_input(observed, response=deflection, mu=(20, 2), sigma=2, **options)


def two_outputs(observed: Any) -> pm.Model:
    with pm.Model() as model:
        mu = pm.Normal("mu", 20, 2)
        sigma = pm.HalfNormal("sigma", 2)
        metric = prb.LogLikelihood(error=pm.HalfNormal("e", 0.5))
        prb.Simulator("y", both, pm.Normal.dist(mu, sigma), observed=observed, metric=metric)
    return model


def drawn(model: pm.Model) -> xr.DataTree:
    return prb.sample(model=model, random_seed=1, progressbar=False)


def assert_alike(first: xr.DataTree, second: xr.DataTree) -> None:
    """Means within four Monte Carlo errors of both, .09 sd, and widths within 7 %."""
    for name in first.posterior.data_vars:
        a, b = first.posterior[name], second.posterior[name]
        assert abs(float(a.mean() - b.mean())) < 0.09 * float(b.std()), name
        assert float(a.std()) == pytest.approx(float(b.std()), rel=0.07), name


@pytest.fixture(scope="module")
def first() -> tuple[pm.Model, xr.DataTree]:
    model = springs(deflection(STIFFNESS[:15]))
    return model, drawn(model)


@pytest.mark.long
def test_updates_are_the_posterior_of_all_specimens(first: tuple[pm.Model, xr.DataTree]) -> None:
    model, result = first
    (likelihood,) = specimen_likelihoods(model).values()
    n_runs = likelihood.measurements[0].responses.count
    for rows in (slice(15, 30), slice(30, 31), slice(31, 40)):
        result = prb.update(result, observed=deflection(STIFFNESS[rows]), model=model)
    assert likelihood.measurements[0].responses.count == n_runs
    np.testing.assert_array_equal(result.observed_data["y"], deflection(STIFFNESS))
    assert result.log_likelihood["y"].shape[2:] == (40,)
    together = springs(deflection(STIFFNESS))
    assert_alike(result, drawn(together))
    # It is a result of a model of all specimens.
    assert prb.diagnose(result, model=together).ok


def test_an_update_in_another_process_finds_the_points_again(
    first: tuple[pm.Model, xr.DataTree],
) -> None:
    model, result = first
    once = prb.update(result, observed=deflection(STIFFNESS[15:25]), model=model)
    (likelihood,) = specimen_likelihoods(model).values()
    del likelihood.cache["updated"]
    again = prb.update(once, observed=deflection(STIFFNESS[25:]), model=model)
    assert_alike(again, drawn(springs(deflection(STIFFNESS))))


@pytest.mark.long
def test_several_outputs_with_an_unknown_error() -> None:
    model = two_outputs(TWO[:10])
    result = prb.update(drawn(model), observed=TWO[10:20], model=model)
    assert_alike(result, drawn(two_outputs(TWO[:20])))


def test_a_specimen_that_contradicts_the_others_is_named(
    first: tuple[pm.Model, xr.DataTree], caplog: pytest.LogCaptureFixture
) -> None:
    model, result = first
    new = [*deflection(STIFFNESS[15:18]), deflection(20 + 12 * 1.5)]
    updated = prb.update(result, observed=new, model=model)
    assert_alike(updated, drawn(springs(np.append(deflection(STIFFNESS[:15]), new))))
    (finding,) = [f for f in prb.diagnose(updated).findings if f.code == "unlike-specimens"]
    assert "1 new specimen (row 18)" in finding.text
    assert "unlike-specimens" in prb.help("unlike-specimens")
    assert "row 18" in caplog.text


def test_populations_that_new_specimens_exclude_take_no_points() -> None:
    """Of the first six specimens one draw of 256 is a population that is far too narrow."""
    rng = np.random.default_rng(61)
    x = 2.0 * rng.weibull(3.0, 32)
    observed = x**2 + 0.3 * rng.normal(size=32)
    with pm.Model() as model:
        alpha, beta = pm.LogNormal("alpha", 1.0, 0.7), pm.LogNormal("beta", 0.5, 0.7)
        metric = prb.LogLikelihood(error=0.3)
        population = pm.Weibull.dist(alpha, beta)
        prb.Simulator("y", np.square, population, metric=metric, observed=observed[:6])
    prb.update(drawn(model), observed=observed[6:11], model=model)
    (likelihood,) = specimen_likelihoods(model).values()
    (updated,) = likelihood.cache["updated"].likelihoods
    assert prepared(updated).points.log_a.shape[1] <= 512  # 8192 with that draw


def test_a_specimen_is_rare_if_few_draws_have_the_weight() -> None:
    draws = np.random.default_rng(0).normal(size=1000)
    logs = np.stack([-0.45 * draws**2, 0.45 * draws**2, np.zeros(1000)], axis=1)
    assert rare_specimens(logs).tolist() == [1]


def test_errors_by_reading_are_refused() -> None:
    model = springs(deflection(STIFFNESS[:15]), metric=prb.LogLikelihood(error=np.full(15, 0.1)))
    with pytest.raises(TypeError, match=r"one for each reading; calibrate all specimens together"):
        prb.update(drawn(model), observed=deflection(STIFFNESS[15:20]), model=model)


def test_readings_out_of_reach_are_refused() -> None:
    observed = np.tanh(-2.5 + 0.15 * STIFFNESS)
    model = one_input(observed, response=np.tanh, mu=(0.5, 0.2), sigma=0.3)
    message = "no inputs in the range of the priors reproduce|outside the range of all runs"
    with pytest.raises(DesignError, match=message):
        prb.update(drawn(model), observed=[1.2], model=model)


def test_what_cannot_be_updated(first: tuple[pm.Model, xr.DataTree]) -> None:
    model, result = first
    with pytest.raises(ValueError, match=r"observed: got shape \(2, 2\), expected \('n',\)"):
        prb.update(result, observed=np.ones((2, 2)), model=model)
    with pytest.raises(ValueError, match="other specimens than the model's"):
        prb.update(result, observed=[10.0], model=springs(deflection(STIFFNESS[5:20])))
    weighted = springs(deflection(STIFFNESS[:15]), weights=np.arange(1.0, 16))
    with pytest.raises(TypeError, match="weights or conditions"):
        prb.update(drawn(weighted), observed=[10.0], model=weighted)
    by_metric = springs(deflection(STIFFNESS[:15]), metric=prb.ProbabilityResidual())
    with pytest.raises(TypeError, match="expected one without metric="):
        prb.update(result, observed=[10.0], model=by_metric)
