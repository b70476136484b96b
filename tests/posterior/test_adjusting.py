"""`adjust`: draws of other samplers come out as those of `sample_smc` do."""

import logging
from typing import Any

import arviz as az
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from four_metrics import METRICS, same
from scipy.stats import norm

import prbayes as prb
from prbayes._checks import Floats

TWENTY = np.random.default_rng(1).normal(1, 0.5, 20)


def build(metric: str = "area", data: Floats = TWENTY, **keywords: Any) -> pm.Model:
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1)
        pm.Deterministic("variance", sigma**2)
        x = pm.Normal.dist(mu, sigma)
        prb.Simulator("y", same, x, metric=METRICS[metric], observed=data, **keywords)
    return model


def smc(model: pm.Model, adjust: Any, **keywords: Any) -> xr.DataTree:
    return prb.sample_smc(
        300, chains=2, model=model, adjust=adjust, progressbar=False, random_seed=1, **keywords
    )


def moments(result: xr.DataTree) -> Floats:
    found = []
    for name in ("mu", "sigma"):
        found += [float(result.posterior[name].mean()), float(result.posterior[name].std())]
    return np.array(found)


@pytest.mark.long
@pytest.mark.parametrize(
    "by",
    [
        prb.posterior.Affine(n_sets=50),
        pytest.param(prb.posterior.GivenEstimate(n_fits=300), marks=pytest.mark.slow),
    ],
)
def test_draws_of_the_package_s_own_sampler_come_out_as_it_gives_them(by: Any) -> None:
    model = build()
    optimum = prb.minimize(model, progressbar=False)
    at_once = smc(model, by, optimum=optimum)
    later = prb.adjust(smc(model, False, optimum=optimum), model=model, optimum=optimum, by=by)
    for group in ("posterior", "unadjusted"):
        for name in ("mu", "sigma", "variance"):
            np.testing.assert_allclose(later[group][name], at_once[group][name], rtol=1e-12)
    for name in ("adjustment", "fit_probability"):
        assert later.posterior.attrs[name] == at_once.posterior.attrs[name]
    # The draws were in the users' own units in between, and are rounded.
    error = at_once.posterior.attrs["adjustment_center_error"]
    assert later.posterior.attrs["adjustment_center_error"] == pytest.approx(error, rel=1e-9)
    np.testing.assert_allclose(
        later.calibration["discrepancy"], at_once.calibration["discrepancy"], rtol=1e-9
    )
    # What the sampler told stays.
    xr.testing.assert_identical(later.sample_stats.to_dataset(), at_once.sample_stats.to_dataset())


@pytest.mark.long
def test_draws_of_nuts_get_the_width_that_the_data_warrant(
    caplog: pytest.LogCaptureFixture,
) -> None:
    model = build()
    expected = moments(smc(model, True))
    with caplog.at_level(logging.INFO, "prbayes"):
        prb.set_epsilon(model, {"y": 0.08})
    assert "prb.adjust" in caplog.text
    with model:
        idata = pm.sample(
            400,
            tune=300,
            chains=2,
            cores=1,
            random_seed=1,
            progressbar=False,
            compute_convergence_checks=False,
        )
    # Every second draw, and predictions of those before.
    idata = idata.isel(draw=slice(1, None, 2))
    idata["posterior_predictive"] = xr.Dataset({"y": ("draw", np.zeros(200))})
    adjusted = prb.adjust(idata, model=model)
    before, after = moments(idata), moments(adjusted)
    assert before[1] > 1.25 * expected[1]
    widths = expected[[1, 1, 3, 3]]
    np.testing.assert_allclose((after - expected) / widths, 0, atol=0.25)
    np.testing.assert_array_equal(adjusted.posterior["draw"], np.arange(1, 400, 2))
    np.testing.assert_allclose(adjusted.unadjusted["mu"], idata.posterior["mu"])
    np.testing.assert_allclose(adjusted.posterior["variance"], adjusted.posterior["sigma"] ** 2)
    assert "diverging" in adjusted.sample_stats
    # What ArviZ looks for is that of the adjusted draws.
    predictive = adjusted.posterior_predictive["y"]
    np.testing.assert_array_equal(predictive["draw"], adjusted.posterior["draw"])
    assert float(predictive.std()) > 0.1
    np.testing.assert_allclose(
        adjusted.log_prior["mu"], norm.logpdf(adjusted.posterior["mu"], 0, 2), rtol=1e-8
    )
    assert "diagnosis" in az.psense_summary(adjusted, var_names=["mu", "sigma"])
    assert set(adjusted.prior.data_vars) == {"mu", "sigma", "variance"}
    assert "y" in adjusted.prior_predictive
    # A prior that is there is not joined by predictions of other draws.
    idata["prior"] = xr.Dataset({"mu": ("draw", np.zeros(3))})
    kept = prb.adjust(idata, model=model)
    assert kept.prior.sizes["draw"] == 3
    assert "prior_predictive" not in kept.children
    assert adjusted.posterior.attrs["inference_library"] == "pymc"
    # Diagnoses tell both apart, the second without the model.
    assert "prb.adjust" in "".join(prb.diagnose(idata, model=model).notes)
    assert "prb.adjust" not in "".join(prb.diagnose(adjusted).notes)


@pytest.mark.long
def test_draws_of_a_stock_simulator_by_a_model_with_the_same_hyperparameters() -> None:
    rng = np.random.default_rng(2)
    wide = {
        "mu": rng.normal(1, 0.3, (2, 200)),
        "sigma": rng.gamma(5, 0.12, (2, 200)),
    }
    given = xr.DataTree.from_dict(
        {"posterior": xr.Dataset({k: (["chain", "draw"], v) for k, v in wide.items()})}
    )
    model = build("pr")
    adjusted = moments(prb.adjust(given, model=model))
    expected = moments(smc(model, True))
    widths = expected[[1, 1, 3, 3]]
    np.testing.assert_allclose((adjusted - expected) / widths, 0, atol=0.3)
    assert np.isnan(model_epsilon(model))


def model_epsilon(model: pm.Model) -> float:
    from prbayes.model.evaluator import Evaluator

    return float(Evaluator(model).epsilon[0])


@pytest.mark.long
def test_what_cannot_be_adjusted_is_refused_before_any_work() -> None:
    model = build()
    plain = smc(model, False)
    adjusted = prb.adjust(plain, model=model, by=prb.posterior.Affine(n_sets=20))
    with pytest.raises(ValueError, match="adjusted before"):
        prb.adjust(adjusted, model=model)
    with pytest.raises(TypeError, match="expected a DataTree with a posterior group"):
        prb.adjust(plain["posterior"], model=model)
    without = plain.copy()
    without["posterior"] = plain["posterior"].to_dataset().drop_vars("sigma")
    with pytest.raises(KeyError, match=r"got no \['sigma'\]"):
        prb.adjust(without, model=model)
    with pytest.raises(ValueError, match="another problem"):
        prb.adjust(plain, model=build("kl"))
    outside = plain.copy()
    outside["posterior"] = plain["posterior"].to_dataset() * 0.0
    with pytest.raises(ValueError, match="600 draws at or beyond a bound"):
        prb.adjust(outside, model=model)
    fresh = build(propagation=prb.Fresh(100))
    stripped = xr.DataTree.from_dict({"posterior": plain["posterior"].to_dataset().drop_attrs()})
    with pytest.raises(ValueError, match="the draws cannot be adjusted: "):
        prb.adjust(stripped, model=fresh)


@pytest.mark.long
def test_draws_of_a_likelihood_stay_and_nothing_says_that_they_were_adjusted() -> None:
    model = build("ll")
    plain = smc(model, False)
    same_draws = prb.adjust(plain, model=model)
    np.testing.assert_allclose(same_draws.posterior["mu"], plain.posterior["mu"], rtol=1e-12)
    assert "unadjusted" not in same_draws.children
    assert same_draws.posterior.attrs["adjustment"].startswith("none needed")
    text = prb.Report("A", posterior=same_draws, pictures=False)._repr_html_()
    assert "as they were sampled" in text
    # What is as it was can be adjusted by choice.
    by = prb.posterior.Affine(n_sets=20)
    assert "unadjusted" in prb.adjust(same_draws, model=model, by=by).children


@pytest.mark.long
def test_draws_given_other_data_are_refused() -> None:
    model = build()
    draws = smc(model, False)
    stock = xr.DataTree.from_dict(
        {
            "posterior": draws.posterior.to_dataset().drop_attrs(),
            "observed_data": xr.Dataset({"stock": ("n", TWENTY + 0.1)}),
        }
    )
    with pytest.raises(ValueError, match=r"other data \(stock\) than y observes"):
        prb.adjust(stock, model=model)
    stock["observed_data"] = xr.Dataset({"stock": ("n", TWENTY)})
    by = prb.posterior.Affine(n_sets=20)
    assert "unadjusted" in prb.adjust(stock, model=model, by=by).children
