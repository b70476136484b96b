"""What ArviZ looks for beside the posterior, against closed forms and PyMC's own functions."""

from functools import cache

import arviz as az
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from scipy.stats import norm

import prbayes as prb
from prbayes.posterior import arviz_groups as groups

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
    monkeypatch.setattr(groups, "AT_ONCE", 2 * 500 * 40 // 4)
    rng = np.random.default_rng(1)
    thetas = tree.calibration["theta"].values
    found = groups._predictive(optimum.evaluator, thetas, rng)
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
