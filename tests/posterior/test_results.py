"""The DataTree of a result: groups, attributes, storage, ArviZ, PyMC's keywords."""

from functools import cache
from pathlib import Path
from typing import Any

import arviz as az
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from one_input import one_input
from scipy.stats import norm

import prbayes as prb
from prbayes.model.description import versions
from prbayes.model.evaluator import Evaluator
from prbayes.posterior import results
from prbayes.posterior.smc import _stage_statistics
from prbayes.response.compile import PLAIN

DATA = np.random.default_rng(1).normal([1.0, 3.0], 0.5, (40, 2))
QUIET: dict[str, Any] = {"progressbar": False, "random_seed": 1}
AREA = prb.AreaMetric()


@cache
def model() -> pm.Model:
    """Return a model of two simulators with a vector and a deterministic, and named specimens."""
    labels = [f"s{i}" for i in range(40)]
    with pm.Model(coords={"lab": ["north", "south"], "specimen": labels}) as m:
        mean = pm.Normal("mean", 0, [3.0, 3.0], dims="lab")
        sigma = pm.HalfNormal("sigma", 1)
        pm.Deterministic("variance", sigma**2)
        for i, name in enumerate(("first", "second")):
            prb.Simulator(
                name, np.positive, pm.Normal.dist(mean[i], sigma),
                metric=prb.KullbackLeibler() if i else AREA, observed=DATA[:, i],
                epsilon=None if i else 0.02, dims=None if i else "specimen",
                propagation=prb.Reweighted(256),
            )  # fmt: skip
    return m


@cache
def optimum() -> prb.Optimum:
    return prb.minimize(model(), method="Nelder-Mead", starts=0)


def sample(draws: int = 40, **keywords: Any) -> Any:
    settings = {"chains": 2, "adjustment": None, "refine": False, **QUIET, **keywords}
    return prb.sample_smc(draws, model=model(), **settings)


@cache
def idata() -> xr.DataTree:
    optimum()  # whose search may refine the designs of the model
    return sample()


# -- trees


@pytest.mark.long
def test_the_tree_of_an_optimum() -> None:
    tree, best = optimum().to_datatree(), optimum()
    assert set(tree.children) == {"optimum", "stderr", "trace", "calibration", "observed_data"}
    variables = {"mean", "sigma", "variance"}
    assert set(tree["optimum"].data_vars) == set(tree["stderr"].data_vars) == variables
    assert float(tree["optimum"]["mean"].sel(lab="south")) == best.point["mean"][1]
    assert float(tree["stderr"]["sigma"]) == best.stderr["sigma"]
    calibration = tree["calibration"]
    covariance = calibration["covariance"]
    assert covariance.dims == ("element", "other_element")
    place = {"element": "mean[south]", "other_element": "sigma_log__"}
    assert covariance.sel(place) == best.covariance[1, 2]
    second = calibration["discrepancy"].sel(simulator="second")
    assert float(second) == best.discrepancies["second"]
    assert float(calibration["scale"].sel(simulator="first")) == 0.02
    for name, support in best.search.support.items():
        for key, value in support.items():
            assert float(calibration[key].sel(simulator=name)) == value
    assert tree["trace"].sizes["evaluation"] == best.search.n_evaluations
    keys = {"discrepancy", "converged", "message", "n_evaluations", "n_responses", "seconds"}
    assert keys <= set(tree["optimum"].attrs)
    assert versions().items() <= tree["optimum"].attrs.items()


@pytest.mark.long
def test_the_tree_of_a_sampler() -> None:
    tree = idata()
    sampler = {"posterior", "sample_stats", "calibration", "observed_data"}
    of_arviz = {"prior", "log_prior", "log_likelihood", "posterior_predictive", "prior_predictive"}
    assert set(tree.children) == sampler | of_arviz  # no group of failures
    posterior, calibration = tree["posterior"], tree["calibration"]
    assert posterior["mean"].dims == ("chain", "draw", "lab")
    np.testing.assert_allclose(posterior["variance"], posterior["sigma"] ** 2)
    elements = ["mean[north]", "mean[south]", "sigma_log__"]
    assert list(calibration["element"].values) == elements
    theta = calibration["theta"].sel(element="sigma_log__")
    np.testing.assert_allclose(theta, np.log(posterior["sigma"]))
    evaluator = Evaluator.of(model())
    thetas = calibration["theta"].values.reshape(-1, 3)
    expected = evaluator(thetas).discrepancies.reshape(2, 40, 2)
    np.testing.assert_allclose(calibration["discrepancy"], expected, rtol=1e-9)
    for name, support in evaluator.support(thetas).items():
        for key in ("weight_ess", "mean_weight", "lost_mass"):
            values = calibration[key].sel(simulator=name).values.ravel()
            np.testing.assert_allclose(values, support[key], rtol=1e-9)
    np.testing.assert_allclose(calibration["epsilon"], [0.02, 1 / 40])
    divergence = "KullbackLeibler(density=GaussianKDE(bandwidth=twice_silverman), reverse=False)"
    assert list(calibration["metric"].values) == ["AreaMetric()", divergence]
    assert list(calibration["propagation"].values) == [repr(prb.Reweighted(256))] * 2
    expected_attrs = {"inference_library": "prbayes", "random_seed": "1", **versions()}
    assert expected_attrs.items() <= posterior.attrs.items()
    assert posterior.attrs["n_responses"] == calibration["n_points"].sum()
    observed = tree["observed_data"]
    np.testing.assert_array_equal(observed["first"].sel(specimen="s3"), DATA[3, 0])
    assert observed["second"].dims == ("second_dim_0",)


def test_chains_with_different_numbers_of_stages() -> None:
    first = {"beta": [0.2, 1.0], "log_marginal_likelihood": [np.nan, 4.0]}
    second = {"beta": [1.0], "log_marginal_likelihood": [2.0]}
    stats, evidence = _stage_statistics([first, second])
    np.testing.assert_array_equal(stats["beta"], [[0.2, 1.0], [1.0, np.nan]])
    mean = np.log((np.exp(4) + np.exp(2)) / 2)
    assert evidence["log_marginal_likelihood"] == pytest.approx(mean)
    assert evidence["log_marginal_likelihood_sd"] == pytest.approx(np.sqrt(2))


@pytest.mark.parametrize("make", [idata, lambda: optimum().to_datatree()])
def test_trees_survive_storage(make: Any, tmp_path: Path) -> None:
    tree = make()
    tree.to_netcdf(tmp_path / "tree.nc")
    loaded = az.from_netcdf(tmp_path / "tree.nc")
    try:
        assert set(loaded.children) == set(tree.children)
        for group in tree.children:
            xr.testing.assert_equal(loaded[group].to_dataset().load(), tree[group].to_dataset())
            assert {k: loaded[group].attrs[k] for k in tree[group].attrs} == dict(tree[group].attrs)
            assert all(v.dtype != object for v in tree[group].data_vars.values())
    finally:
        loaded.close()


# -- groups for ArviZ


def known_sd(propagation: prb.propagation.Propagation) -> pm.Model:
    observed = DATA[:, 0]
    return one_input(observed, AREA, propagation=propagation, mu=(0, 0.2), sd=0.5)


@cache
def sampled() -> tuple[pm.Model, prb.Optimum, xr.DataTree]:
    model = known_sd(prb.Reweighted(256))
    optimum = prb.minimize(model, starts=0, progressbar=False)
    return model, optimum, prb.sample(500, chains=2, model=model, optimum=optimum, **QUIET)


def test_priors_are_in_the_units_of_the_user() -> None:
    tree = sampled()[2]
    assert {"created_at", "creation_library", "sampling_time"} <= set(tree.posterior.attrs)
    assert tree.prior["mu"].sizes == {"chain": 1, "draw": 500}
    np.testing.assert_allclose(tree.prior["mu"].std(), 0.2, rtol=0.15)  # four standard errors
    draws = tree.posterior["mu"].values
    np.testing.assert_allclose(tree.log_prior["mu"], norm.logpdf(draws, 0, 0.2), rtol=1e-9)


def test_the_likelihood_of_the_draws_times_the_prior_is_their_density() -> None:
    """Here a normal one, with a prior that counts."""
    _, optimum, tree = sampled()
    mu = tree.posterior["mu"].values.ravel()
    assert set(tree.log_likelihood.data_vars) == {"one_number_for_all_specimens", "other_terms"}
    log = tree.log_likelihood["one_number_for_all_specimens"].values.ravel()
    assert np.ptp(tree.log_likelihood["other_terms"].values) == 0
    inner = np.abs(mu - np.median(mu)) < 2 * mu.std()
    curvature, slope, _ = np.polyfit(mu[inner], log[inner], 2)
    sd, centre = (-2 * curvature) ** -0.5, -slope / (2 * curvature)
    precision = sd**-2 + 0.2**-2
    # Of 1000 draws a standard deviation has an error of 2%; the tails are not quite normal.
    np.testing.assert_allclose(mu.std(), precision**-0.5, rtol=0.1)
    np.testing.assert_allclose(mu.mean(), centre * sd**-2 / precision, atol=0.2 * sd)
    # Both are uncertain where the prior is five of its standard deviations away.
    np.testing.assert_allclose(sd, optimum.stderr["mu"], rtol=0.3)
    assert abs(centre - optimum.point["mu"]) < sd


def test_one_number_is_not_taken_for_that_of_each_specimen() -> None:
    """It has one place along the specimens, which ArviZ does not align with all of them."""
    tree = sampled()[2]
    places = {tree.observed_data["y"].dims[0]: 1}
    for group in tree.log_likelihood.data_vars.values():
        assert group.sizes == {"chain": 2, "draw": tree.posterior.sizes["draw"]} | places
    with pytest.raises(ValueError, match="conflicting dimension sizes"):
        az.loo_expectations(tree, var_name="y")
    for function in (az.loo, az.loo_metrics, az.loo_influence):
        with pytest.raises((TypeError, ValueError)):
            function(tree)
    assert "power-scaling" in tree.log_likelihood.attrs["note"]


def test_power_scaling_detects_a_prior_that_counts() -> None:
    table = az.psense_summary(sampled()[2])
    # The prior is about as wide as twice the standard error, with a mean five of them away.
    assert table.loc["mu", "prior"] > 0.05
    assert table.loc["mu", "likelihood"] > 0.05


def test_predictive_draws_are_those_of_pymc_s_own_function() -> None:
    model, _, tree = sampled()
    ours = tree.posterior_predictive["y"]
    assert ours.sizes == {"chain": 2, "draw": 500, "y_dim_0": 40}
    settings = {"model": model, "compile_kwargs": {"mode": PLAIN}, **QUIET}
    theirs = pm.sample_posterior_predictive(tree, **settings).posterior_predictive["y"]
    # 40 000 values of 1000 populations: standard errors of .003 and .002.
    assert abs(float(ours.mean() - theirs.mean())) < 0.02
    np.testing.assert_allclose(ours.std(), theirs.std(), rtol=0.03)
    # Each row is of its own draw.
    row = ours.mean("y_dim_0").values.ravel()
    assert np.corrcoef(row, tree.posterior["mu"].values.ravel())[0, 1] > 0.4
    assert float(tree.prior_predictive["y"].std()) == pytest.approx(np.hypot(0.2, 0.5), rel=0.1)


def test_many_predictive_draws_are_thinned(monkeypatch: pytest.MonkeyPatch) -> None:
    _, optimum, tree = sampled()
    monkeypatch.setattr(results, "AT_ONCE", 2 * 500 * 40 // 4)
    thetas = tree.calibration["theta"].values
    responses = results._stored_responses(optimum.evaluator, thetas, np.random.default_rng(1))
    assert responses["y"].sizes["draw"] == 125
    assert responses.coords["draw"].values[:3].tolist() == [0, 4, 8]


@pytest.mark.long
def test_log_likelihoods_of_many_specimens_are_thinned(monkeypatch: pytest.MonkeyPatch) -> None:
    data = np.random.default_rng(1).normal(1.0, 0.5, 20)
    model = one_input(2 * data, response=lambda x: 2 * x)
    whole = prb.sample(1000, chains=2, model=model, **QUIET)
    monkeypatch.setattr(results, "AT_ONCE", 2 * 1000 * 20 // 8)
    thinned = prb.sample(1000, chains=2, model=model, **QUIET)
    assert thinned.log_likelihood.coords["draw"].values[:3].tolist() == [0, 4, 8]
    np.testing.assert_array_equal(
        thinned.log_likelihood["y"], whole.log_likelihood["y"].sel(draw=slice(None, None, 4))
    )
    # The sum over all specimens is that of every draw.
    sums = -whole.log_likelihood["y"].sum("y_dim_0").values
    for tree in (whole, thinned):
        values = tree.calibration["discrepancy"].values[..., 0]
        np.testing.assert_allclose(values, sums, rtol=1e-12)
    assert prb.diagnose(thinned, model=model).findings == ()
    assert az.loo(thinned).elpd == pytest.approx(az.loo(whole).elpd, abs=0.5)


def test_points_without_a_response_are_never_drawn() -> None:
    model = one_input(
        [-1.0, 0.0, 1.0, 0.5],
        AREA,
        response=lambda x: np.where(x > 2.5, np.nan, x),
        epsilon=0.1,
        propagation=prb.Reweighted(256, max_lost=0.5),
        mu=(0, 1),
        sd=1.0,
    )
    tree = prb.sample_smc(20, chains=1, model=model, adjustment=None, **QUIET)
    assert np.isfinite(tree.prior_predictive["y"]).all()
    assert float(tree.prior_predictive["y"].max()) <= 2.5


def test_responses_that_cost_runs_are_not_computed_for_groups() -> None:
    model = known_sd(prb.Resimulated(64))
    tree = prb.sample_smc(20, chains=1, model=model, epsilon=0.1, adjustment=None, **QUIET)
    assert "posterior_predictive" not in tree
    assert {"prior", "log_prior", "log_likelihood"} <= set(tree.children)
    # Nor is there a design whose support is reported.
    for key in ("weight_ess", "mean_weight"):
        assert np.isnan(tree["calibration"][key]).all()
    assert (tree["calibration"]["lost_mass"] == 0).all()
    assert prb.diagnose(tree, model=model).support.sizes["simulator"] == 0


# -- selections


@pytest.mark.long
def test_a_multitrace_has_the_same_draws() -> None:
    trace = sample(return_inferencedata=False)
    assert isinstance(trace, pm.backends.base.MultiTrace)
    assert (trace.nchains, len(trace)) == (2, 40)
    for name in ("mean", "sigma", "variance"):
        for chain, values in enumerate(trace.get_values(name, combine=False)):
            expected = idata().posterior[name].values[chain]
            np.testing.assert_allclose(values, expected, rtol=1e-12)
    assert trace["sigma_log__"].shape == (80,)


def test_selected_variables_dimensions_and_groups() -> None:
    identity = idata().posterior.attrs["identity"]  # after its run the designs have all points
    names = {"dims": {"second": ["plate"]}, "coords": {"plate": range(40)}}
    tree = sample(var_names=["mean", "variance"], idata_kwargs={"log_prior": False, **names})
    assert set(tree.posterior.data_vars) == set(tree.prior.data_vars) == {"mean", "variance"}
    assert tree.posterior.attrs["identity"] == identity
    assert "log_prior" not in tree
    assert "log_likelihood" in tree
    for group in ("observed_data", "posterior_predictive"):
        assert tree[group]["second"].dims[-1] == "plate"
        assert tree[group]["first"].dims[-1] == "specimen"
        assert tree[group].coords["plate"].size == 40
    with pytest.raises(ValueError, match=r"got \[\], expected 1 names"):
        results.selected(tree, None, {"dims": {"second": []}})


@pytest.mark.parametrize(
    ("keywords", "error", "message"),
    [
        ({"var_names": ["nu"]}, KeyError, r"var_names: got \['nu'\], expected some of \['mean'"),
        ({"idata_kwargs": {"save_warmup": True}}, TypeError, r"got \['save_warmup'\]"),
        ({"idata_kwargs": {"log_prior": 1}}, TypeError, "log_prior: got int 1, expected True"),
    ],
)
def test_invalid_selections(keywords: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        sample(10, **keywords)
