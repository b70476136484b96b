"""The DataTree of a result: groups, attributes, storage, ArviZ, PyMC's keywords."""

from functools import cache
from pathlib import Path
from typing import Any

import arviz as az
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from scipy.stats import norm

import prbayes as prb
from prbayes.model.description import versions
from prbayes.model.evaluator import Evaluator
from prbayes.posterior import results
from prbayes.posterior.smc import _stage_statistics

DATA = np.random.default_rng(1).normal([1.0, 3.0], 0.5, (40, 2))


def same(x: Any) -> Any:
    return x


@cache
def model() -> pm.Model:
    """Two simulators, a vector hyperparameter with named elements, a scalar one, a deterministic, named specimens."""
    with pm.Model(
        coords={"lab": ["north", "south"], "specimen": [f"s{i}" for i in range(40)]}
    ) as m:
        mean = pm.Normal("mean", 0, [3.0, 3.0], dims="lab")
        sigma = pm.HalfNormal("sigma", 1)
        pm.Deterministic("variance", sigma**2)
        for i, name in enumerate(("first", "second")):
            x = pm.Normal.dist(mean[i], sigma)
            prb.Simulator(
                name, same, x, metric=prb.KullbackLeibler() if i else prb.AreaMetric(), observed=DATA[:, i],
                epsilon=None if i else 0.02, dims=None if i else "specimen", propagation=prb.Reweighted(256),
            )  # fmt: skip
    return m


@cache
def optimum() -> prb.Optimum:
    return prb.minimize(model(), method="Nelder-Mead")


@cache
def idata() -> xr.DataTree:
    return prb.sample_smc(200, chains=4, model=model(), random_seed=3, progressbar=False)


# -- trees
# -----------------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_tree_of_an_optimum() -> None:
    tree = optimum().to_datatree()
    assert set(tree.children) == {"optimum", "stderr", "trace", "calibration", "observed_data"}
    assert (
        set(tree["optimum"].data_vars)
        == set(tree["stderr"].data_vars)
        == {"mean", "sigma", "variance"}
    )
    assert tree["optimum"]["mean"].dims == ("lab",)
    assert float(tree["optimum"]["mean"].sel(lab="south")) == optimum().point["mean"][1]
    assert float(tree["stderr"]["sigma"]) == optimum().stderr["sigma"]
    calibration = tree["calibration"]
    assert calibration["covariance"].dims == ("element", "other_element")
    assert (
        calibration["covariance"].sel(element="mean[south]", other_element="sigma_log__")
        == optimum().covariance[1, 2]
    )
    assert (
        float(calibration["discrepancy"].sel(simulator="second"))
        == optimum().discrepancies["second"]
    )
    assert float(calibration["scale"].sel(simulator="first")) == 0.02
    assert tree["trace"].sizes["evaluation"] == optimum().search.n_evaluations
    assert {
        "discrepancy",
        "converged",
        "message",
        "n_evaluations",
        "n_responses",
        "n_screened",
        "seconds",
    } <= set(tree["optimum"].attrs)
    assert versions().items() <= tree["optimum"].attrs.items()


@pytest.mark.long
def test_observed_data_keep_their_labels() -> None:
    for tree in (optimum().to_datatree(), idata()):
        observed = tree["observed_data"]
        np.testing.assert_array_equal(observed["first"], DATA[:, 0])
        np.testing.assert_array_equal(observed["second"], DATA[:, 1])
        assert observed["first"].dims == ("specimen",)
        assert str(observed["specimen"].values[3]) == "s3"
        assert observed["second"].dims == ("second_dim_0",)


def test_the_tree_of_a_sampler() -> None:
    tree = idata()
    assert tree["posterior"]["mean"].dims == ("chain", "draw", "lab")
    np.testing.assert_allclose(tree["posterior"]["variance"], tree["posterior"]["sigma"] ** 2)
    calibration = tree["calibration"]
    assert calibration["discrepancy"].dims == ("chain", "draw", "simulator")
    thetas = calibration["theta"].values.reshape(-1, 3)
    found = Evaluator.of(model())(thetas)
    np.testing.assert_allclose(
        calibration["discrepancy"].values.reshape(-1, 2), found.discrepancies, rtol=1e-9
    )
    support = Evaluator.of(model()).support(thetas)
    for name in ("first", "second"):
        one = calibration.to_dataset().sel(simulator=name)
        assert int(one["n_points"]) % 256 == 0
        np.testing.assert_allclose(
            one["weight_ess"].values.ravel(), support[name]["weight_ess"], rtol=1e-9
        )
        np.testing.assert_allclose(
            one["mean_weight"].values.ravel(), support[name]["mean_weight"], rtol=1e-9
        )
    np.testing.assert_allclose(calibration["epsilon"], [0.02, 1 / 40])
    assert tree["posterior"].attrs["inference_library"] == "prbayes"
    assert versions().items() <= tree["posterior"].attrs.items()


def test_metrics_are_described_the_same_in_every_session() -> None:
    expected = [
        "AreaMetric()",
        "KullbackLeibler(density=GaussianKDE(bandwidth=twice_silverman), reverse=False)",
    ]
    for tree in (optimum().to_datatree(), idata()):
        assert list(tree["calibration"]["metric"].values) == expected
    assert list(idata()["calibration"]["propagation"].values) == [repr(prb.Reweighted(256))] * 2


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


def test_propagations_without_a_design_have_no_support_to_report() -> None:
    with pm.Model() as m:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 0.5)
        prb.Simulator(
            "y",
            same,
            x,
            metric=prb.KullbackLeibler(),
            observed=DATA[:, 0],
            propagation=prb.Resimulated(64),
        )
    tree = prb.sample_smc(50, chains=1, model=m, random_seed=1, progressbar=False)
    for key in ("weight_ess", "mean_weight"):
        assert np.isnan(tree["calibration"][key]).all()
    assert (tree["calibration"]["lost_mass"] == 0).all()
    assert int(tree["calibration"]["n_points"][0]) == 64
    assert prb.diagnose(tree, model=m).ok
    assert prb.diagnose(tree, model=m).support.sizes["simulator"] == 0


def test_the_support_of_an_optimum_is_part_of_it() -> None:
    assert optimum().support
    tree = optimum().to_datatree()["calibration"]
    for name, support in optimum().support.items():
        for key, value in support.items():
            assert float(tree[key].sel(simulator=name)) == value
        assert support["weight_ess"] > 30
        assert 0.8 < support["mean_weight"] < 1.25
        assert support["lost_mass"] == 0


def test_an_optimum_shows_its_answer_in_a_few_lines() -> None:
    found = optimum()
    lines = repr(found).splitlines()
    assert lines[0].startswith(
        f"Optimum: discrepancy {found.discrepancy:.4g} after {found.search.n_evaluations} evaluations"
    )
    assert lines[0].endswith("converged")
    told = [line.strip().partition(" = ") for line in lines[1:] if " ± " in line]
    assert [name for name, _, _ in told] == ["mean[north]", "mean[south]", "sigma", "variance"]
    assert len(lines) == 1 + len(told) + len(found.findings)
    numbers = np.concatenate([np.ravel(found.point[name]) for name in found.point])
    errors = np.concatenate([np.ravel(found.stderr[name]) for name in found.point])
    for (_, _, text), number, error in zip(told, numbers, errors, strict=True):
        assert text == f"{number:.4g} ± {error:.4g}"


OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 40)
QUIET = {"progressbar": False, "random_seed": 1}


def known_sd(propagation: prb.propagation.Propagation | None = None) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 0.2), 0.5)
        prb.Simulator(
            "y", lambda x: x, x, metric=prb.AreaMetric(), observed=OBSERVED,
            propagation=propagation or prb.Reweighted(256),
        )  # fmt: skip
    return model


@cache
def sampled() -> tuple[pm.Model, prb.Optimum, xr.DataTree]:
    model = known_sd()
    optimum = prb.minimize(model, progressbar=False)
    return model, optimum, prb.sample_smc(500, chains=2, model=model, optimum=optimum, **QUIET)


@pytest.mark.long
def test_groups_and_attributes_are_those_of_arviz() -> None:
    tree = sampled()[2]
    for group in ("posterior_predictive", "prior", "prior_predictive", "log_prior"):
        assert tree[group].attrs["inference_library"] == "prbayes"
    assert {"created_at", "creation_library", "sampling_time"} <= set(tree.posterior.attrs)
    assert tree.prior["mu"].sizes == {"chain": 1, "draw": 500}
    np.testing.assert_allclose(tree.prior["mu"].std(), 0.2, rtol=0.15)  # four standard errors


@pytest.mark.long
def test_the_log_prior_is_that_of_the_user_s_own_units() -> None:
    model, _, tree = sampled()
    draws = tree.posterior["mu"].values
    np.testing.assert_allclose(tree.log_prior["mu"], norm.logpdf(draws, 0, 0.2), rtol=1e-9)
    theirs = pm.stats.compute_log_prior(
        tree.copy(), model=model, progressbar=False, extend_inferencedata=False
    )
    np.testing.assert_allclose(tree.log_prior["mu"].values, theirs["mu"].values, rtol=1e-9)


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
    # About the estimate, as wide as it scatters; both are uncertain where the prior is five of its
    # standard deviations away.
    np.testing.assert_allclose(sd, optimum.stderr["mu"], rtol=0.3)
    assert abs(centre - optimum.point["mu"]) < sd


def test_leaving_one_out_of_one_number_is_refused() -> None:
    tree = sampled()[2]
    with pytest.raises(TypeError, match="one_number_for_all_specimens"):
        az.loo(tree)
    assert "power-scaling" in tree.log_likelihood.attrs["note"]


def labelled_and_two() -> pm.Model:
    """Labelled specimens of two outputs, and another simulator with specimens of its own."""
    coords = {"plate": [f"S{i}" for i in range(20)], "out": ["a", "b"]}
    with pm.Model(coords=coords) as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 0.2), 0.5)
        both = np.column_stack([OBSERVED[:20], OBSERVED[:20] ** 2])
        prb.Simulator(
            "two", lambda x: np.stack([x, x**2], axis=-1), x,
            metric=prb.Joint(prb.AreaMetric()), observed=both, dims=("plate", "out"), epsilon=0.1,
        )  # fmt: skip
        prb.Simulator("y", lambda x: x, x, metric=prb.AreaMetric(), observed=OBSERVED, epsilon=0.1)
    return model


def test_one_number_is_not_taken_for_that_of_each_specimen() -> None:
    """It has one place along the specimens, which ArviZ does not align with all of them."""
    for tree, names in (
        (sampled()[2], ["y"]),
        (prb.sample_smc(20, chains=2, model=labelled_and_two(), **QUIET), ["two", "y"]),
    ):
        for group in tree.log_likelihood.data_vars.values():
            assert group.sizes == {"chain": 2, "draw": tree.posterior.sizes["draw"]} | {
                tree.observed_data[name].dims[0]: 1 for name in names
            }
        for name in names:
            for given in (None, "one_number_for_all_specimens"):
                with pytest.raises(ValueError, match="conflicting dimension sizes"):
                    az.loo_expectations(tree, var_name=name, log_likelihood_var_name=given)
            with pytest.raises(ValueError, match="conflicting dimension sizes"):
                az.loo_metrics(tree, var_name=name)
        for refuses in (az.loo_expectations, az.loo_metrics, az.loo_influence):
            with pytest.raises((TypeError, ValueError)):
                refuses(tree)


def test_power_scaling_sees_a_prior_that_holds_the_answer_back() -> None:
    tree = sampled()[2]
    table = az.psense_summary(tree)
    # The prior is about as wide as twice the standard error, with a mean five of them away.
    assert table.loc["mu", "prior"] > 0.05
    assert table.loc["mu", "likelihood"] > 0.05


def test_predictive_draws_are_those_of_pymc_s_own_function() -> None:
    model, _, tree = sampled()
    ours = tree.posterior_predictive["y"]
    assert ours.sizes == {"chain": 2, "draw": 500, "y_dim_0": 40}
    theirs = pm.sample_posterior_predictive(tree, model=model, **QUIET).posterior_predictive["y"]
    # 40 000 values of 1000 populations: standard errors of .003 and .002.
    assert abs(float(ours.mean() - theirs.mean())) < 0.02
    np.testing.assert_allclose(ours.std(), theirs.std(), rtol=0.03)
    # Each row is of its own draw.
    row = ours.mean("y_dim_0").values.ravel()
    assert np.corrcoef(row, tree.posterior["mu"].values.ravel())[0, 1] > 0.4
    assert float(tree.prior_predictive["y"].std()) == pytest.approx(np.hypot(0.2, 0.5), rel=0.1)


def test_many_numbers_are_thinned(monkeypatch: pytest.MonkeyPatch) -> None:
    _, optimum, tree = sampled()
    monkeypatch.setattr(results, "AT_ONCE", 2 * 500 * 40 // 4)
    rng = np.random.default_rng(1)
    thetas = tree.calibration["theta"].values
    found = results._stored_responses(optimum.evaluator, thetas, rng)
    assert found["y"].sizes["draw"] == 125
    assert found.coords["draw"].values[:3].tolist() == [0, 4, 8]


def test_points_without_a_response_are_never_drawn() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), 1.0)
        prb.Simulator(
            "y", lambda x: np.where(x > 2.5, np.nan, x), x, metric=prb.AreaMetric(),
            observed=[-1.0, 0.0, 1.0, 0.5], epsilon=0.1,
            propagation=prb.Reweighted(256, max_lost=0.5),
        )  # fmt: skip
    tree = prb.sample_smc(20, chains=1, model=model, **QUIET)
    assert np.isfinite(tree.prior_predictive["y"]).all()
    assert float(tree.prior_predictive["y"].max()) <= 2.5


def test_responses_that_cost_are_not_computed_for_it() -> None:
    model = known_sd(prb.Resimulated(32))
    tree = prb.sample_smc(20, chains=1, model=model, epsilon=0.1, adjustment=None, **QUIET)
    assert "posterior_predictive" not in tree
    assert {"prior", "log_prior", "log_likelihood"} <= set(tree.children)


READINGS = np.random.default_rng(1).normal(1.5, 0.6, 20)
SETTINGS = {"progressbar": False, "random_seed": 1}


@cache
def two_parameters() -> pm.Model:
    with pm.Model(coords={"steel": ["S235", "S355"]}) as made:
        mu, sigma = pm.Normal("mu", 1, 1, dims="steel"), pm.HalfNormal("sigma", 1)
        pm.Deterministic("ratio", sigma / mu[0])
        for i, name in enumerate("yz"):
            prb.Simulator(
                name, np.positive, pm.Normal.dist(mu[i], sigma), metric=prb.AreaMetric(),
                observed=READINGS + i, epsilon=0.02, propagation=prb.Reweighted(256),
            )  # fmt: skip
    return made


def sample(draws: int = 40, **keywords: Any) -> Any:
    settings: dict[str, Any] = {"chains": 2, "adjustment": None, "refine": False, **SETTINGS}
    return prb.sample_smc(draws, model=two_parameters(), **settings, **keywords)


@cache
def plain() -> xr.DataTree:
    return sample()


@pytest.mark.long
def test_a_multitrace_has_the_same_draws() -> None:
    trace = sample(return_inferencedata=False)
    assert isinstance(trace, pm.backends.base.MultiTrace)
    assert (trace.nchains, len(trace)) == (2, 40)
    for name in ("mu", "sigma", "ratio"):
        for chain, found in enumerate(trace.get_values(name, combine=False)):
            expected = plain().posterior[name].values[chain]
            np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert trace["sigma_log__"].shape == (80,)


def test_names_dimensions_and_groups_are_those_asked_for() -> None:
    found = sample(
        var_names=["mu", "ratio"],
        idata_kwargs={
            "log_prior": False,
            "dims": {"y": ["specimen"]},
            "coords": {"specimen": range(20)},
        },
    )
    assert set(found.posterior.data_vars) == set(found.prior.data_vars) == {"mu", "ratio"}
    assert found.posterior.attrs["identity"] == plain().posterior.attrs["identity"]
    assert found.posterior["mu"].coords["steel"].values.tolist() == ["S235", "S355"]
    assert "log_prior" not in found
    assert "log_likelihood" in found
    for group in ("observed_data", "posterior_predictive"):
        assert found[group]["y"].dims[-1] == "specimen"
        assert found[group]["z"].dims[-1] == "z_dim_0"
        assert found[group].coords["specimen"].size == 20
    with pytest.raises(KeyError, match=r"got a result without \['sigma'\]"):
        prb.predict(
            found,
            np.positive,
            pm.Normal.dist(two_parameters()["mu"][0], 1.0),
            model=two_parameters(),
        )


def test_starts_are_where_chains_begin() -> None:
    rng = np.random.default_rng(3)
    prior = {"mu": rng.normal(1, 1, (40, 2)), "sigma": np.abs(rng.normal(size=40))}
    transformed = {"mu": prior["mu"], "sigma_log__": np.log(prior["sigma"])}
    one = sample(start=prior, cores=1)
    other = sample(start=[transformed, prior])
    np.testing.assert_allclose(one.posterior["mu"], other.posterior["mu"], rtol=1e-9)
    assert not np.allclose(one.posterior["mu"], plain().posterior["mu"])
    with pytest.raises(ValueError, match="start: got 1 dicts, expected one, or 2"):
        sample(start=[prior])
    # All particles at one place stay there: nothing but the start says where they are.
    there = {"mu": np.full((40, 2), [1.5, 2.5]), "sigma": np.full(40, 0.6)}
    stuck = sample(start=there)
    np.testing.assert_allclose(stuck.posterior["mu"].mean(["chain", "draw"]), [1.5, 2.5], atol=1e-3)


def test_pymc_s_own_sampler_gives_the_kernel_its_start() -> None:
    there = {"mu": np.full((20, 2), [1.5, 2.5]), "sigma_log__": np.log(np.full(20, 0.6))}
    kernel = prb.posterior.BatchedKernel(20, start=None, model=two_parameters(), random_seed=1)
    kernel.initialize(there, np.random.default_rng(1))
    np.testing.assert_allclose(kernel.tempered_posterior, [[1.5, 2.5, np.log(0.6)]] * 20)


@pytest.mark.long
def test_another_start_is_another_run_of_a_checkpoint(tmp_path: Any) -> None:
    rng = np.random.default_rng(3)
    prior = {"mu": rng.normal(1, 1, (40, 2)), "sigma": np.abs(rng.normal(size=40))}
    file = tmp_path / "run.nc"
    sample(start=prior, checkpoint=file)
    with pytest.raises(prb.response.StoreError):
        sample(start={**prior, "mu": prior["mu"] + 1}, checkpoint=file)
    with pytest.raises(prb.response.StoreError):
        sample(checkpoint=file)


@pytest.mark.parametrize(
    ("keywords", "error", "message"),
    [
        ({"var_names": ["nu"]}, KeyError, r"var_names: got \['nu'\], expected some of \['mu'"),
        ({"var_names": []}, KeyError, "var_names: got none"),
        ({"var_names": 3}, TypeError, "var_names: got int 3"),
        ({"idata_kwargs": 3}, TypeError, "idata_kwargs: got int 3, expected a dict"),
        ({"idata_kwargs": {"save_warmup": True}}, TypeError, r"got \['save_warmup'\]"),
        ({"idata_kwargs": {"log_prior": 1}}, TypeError, "log_prior: got int 1, expected True"),
        ({"idata_kwargs": {"dims": 1}}, TypeError, "dims: got int 1, expected a dict"),
        ({"idata_kwargs": {"dims": {"y": []}}}, ValueError, r"y: got \[\], expected 1 names"),
        ({"cores": 0}, ValueError, "cores: got 0, expected an integer >= 1"),
        ({"return_inferencedata": None}, TypeError, "expected True or False"),
    ],
)
def test_what_is_none_of_these_is_refused(
    keywords: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        sample(10, **keywords)
