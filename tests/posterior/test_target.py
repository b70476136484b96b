"""The posterior given a metric's estimate, and that of exp(-discrepancy / epsilon)."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from normal_posterior import Moments, exact_moments, grid_moments, require_close
from scipy import stats

import prbayes as prb
from prbayes._finding import from_json
from prbayes._validate import Floats
from prbayes.metrics.base import Metric
from prbayes.model.random_variable import nodes
from prbayes.posterior.target import estimate_target

KLD = prb.KullbackLeibler()
PR = prb.ProbabilityResidual()
AREA = prb.AreaMetric()
QUIET = {"progressbar": False, "random_seed": 1}
DATA = np.random.default_rng(4).normal(1, 0.5, 20)


def normal_model(
    metric: Metric,
    *parts: Floats,
    mu: Callable[[], Any] = lambda: pm.Normal("mu", 1, 2),
    sigma: Callable[[], Any] = lambda: pm.HalfNormal("sigma", 1),
    **keywords: Any,
) -> pm.Model:
    """Return a model of a normal population, with a simulator y = x for each part of the data."""
    with pm.Model() as model:
        x = pm.Normal.dist(mu(), sigma())
        for k, part in enumerate(parts):
            prb.Simulator(f"y{k}", lambda x: 1.0 * x, x, metric=metric, observed=part, **keywords)
    return model


def moments_of(tree: xr.DataTree) -> Moments:
    pair = np.stack([tree.posterior["mu"].values, np.log(tree.posterior["sigma"].values)])
    flat = pair.reshape(2, -1)
    return Moments(flat.mean(axis=1), flat.std(axis=1))


def target_moments(model: pm.Model, y: Floats) -> Moments:
    """Return moments of the posterior given the estimate on a grid, where theta = mu, log sigma."""
    optimum = prb.minimize(model, starts=0, progressbar=False)
    target = estimate_target(optimum.evaluator, optimum)
    error = y.std() / np.sqrt(len(y))
    mu = y.mean() + np.linspace(-6, 6, 41) * error
    log_sd = np.log(y.std()) + np.linspace(-1.2, 1.6, 41)
    thetas = np.stack(np.meshgrid(mu, log_sd, indexing="ij"), axis=-1).reshape(-1, 2)
    assert target.evaluator.hyperparameters.names == ["mu", "sigma_log__"]
    return grid_moments(mu, log_sd, target.log_posterior(thetas).reshape(41, 41))


# -- all samplers draw one posterior --


@cache
def fitted(metric: Metric) -> prb.Optimum:
    model = normal_model(metric, DATA, propagation=prb.Reweighted(256))
    return prb.minimize(model, starts=0, progressbar=False)


@pytest.mark.parametrize("metric", [PR, KLD, pytest.param(AREA, marks=pytest.mark.long)])
def test_both_samplers_draw_the_posterior_given_the_estimate(metric: Metric) -> None:
    optimum = fitted(metric)
    settings = {"model": optimum.model, "optimum": optimum, **QUIET}
    by_importance = prb.sample(500, chains=2, **settings)
    by_smc = prb.sample_smc(500, chains=2, **settings)
    samplers = [tree.posterior.attrs["sampler"] for tree in (by_importance, by_smc)]
    assert samplers == ["importance sampling", "SMC"]
    for tree in (by_importance, by_smc):
        assert "unadjusted" not in tree
        assert tree.posterior.attrs["adjustment"] == "estimate"
        assert set(tree.log_likelihood) == {"one_number_for_all_specimens", "other_terms"}
    # Four standard errors of a difference of means, and of a ratio of widths, of 1000 draws.
    found, expected = moments_of(by_smc), moments_of(by_importance)
    require_close(found, expected, offset=0.18, widths=(0.87, 1.15))


@pytest.mark.long
def test_all_samplers_draw_the_posterior_of_the_likelihood() -> None:
    model = normal_model(prb.LogLikelihood(), DATA)
    exact = exact_moments(_vague, DATA)
    trees = [
        prb.sample(500, chains=2, model=model, **QUIET),
        prb.sample_smc(500, chains=2, model=model, **QUIET),
        pm.sample(500, chains=2, cores=1, model=model, **QUIET),
    ]
    for tree in trees:
        require_close(moments_of(tree), exact, offset=0.15, widths=(0.85, 1.15))


def _vague(mu: Floats, sigma: Floats) -> Floats:
    return np.asarray(stats.norm(1, 2).logpdf(mu) + stats.halfnorm.logpdf(sigma))


def test_a_prior_away_from_the_estimate_is_reported() -> None:
    model = normal_model(KLD, DATA, mu=lambda: pm.Normal("mu", 0.0, 0.2))
    tree = prb.sample(50, chains=1, model=model, **QUIET)
    findings = from_json(tree.posterior.attrs["findings"])
    (finding,) = [finding for finding in findings if finding.code == "prior-conflict"]
    assert "mu" in finding.text
    agreeing = prb.sample(50, chains=1, model=fitted(KLD).model, optimum=fitted(KLD), **QUIET)
    assert from_json(agreeing.posterior.attrs["findings"]) == ()


# -- priors that end near the data, or are sharper than these --

NEAR = np.random.default_rng(41).normal(1, 0.5, 20)
ENDS = {"below": (NEAR.mean() - 0.07, 5.0), "above": (0.0, NEAR.mean() + 0.04)}


@pytest.mark.parametrize("end", ENDS)
def test_the_end_of_a_prior_within_a_standard_error(end: str) -> None:
    """Mean and standard deviation are sufficient, so that the exact posterior is the same."""
    lower, upper = ENDS[end]
    model = normal_model(KLD, NEAR, mu=lambda: pm.Uniform("mu", lower, upper))
    tree = prb.sample(1000, chains=2, model=model, **QUIET)

    def log_prior(mu: Floats, sigma: Floats) -> Floats:
        uniform = stats.uniform(lower, upper - lower)
        return np.asarray(uniform.logpdf(mu) + stats.halfnorm.logpdf(sigma))

    require_close(moments_of(tree), exact_moments(log_prior, NEAR))


@pytest.mark.parametrize("spread", [0.25, 0.5, 0.85])
def test_a_prior_that_is_sharper_than_the_data(spread: float) -> None:
    z = np.random.default_rng(6).normal(size=10)
    y = 1 + spread * (z - z.mean()) / z.std()

    def log_prior(mu: Floats, sigma: Floats) -> Floats:
        sharp = stats.lognorm(0.1, scale=0.5)
        return np.asarray(stats.norm(0, 2).logpdf(mu) + sharp.logpdf(sigma))

    model = normal_model(
        KLD, y, mu=lambda: pm.Normal("mu", 0, 2),
        sigma=lambda: pm.LogNormal("sigma", np.log(0.5), 0.1),
    )  # fmt: skip
    require_close(target_moments(model, y), exact_moments(log_prior, y))


# -- several simulators --


FEW = np.random.default_rng(701).normal(1, 0.5, (5, 4))


WIDE = pytest.param(prb.ProbabilityResidual(prb.GaussianKDE(0.5)), marks=pytest.mark.long)


@pytest.mark.parametrize("metric", [KLD, WIDE])
def test_few_specimens_in_each_of_several_simulators_count_as_all_in_one(metric: Metric) -> None:
    """With the bandwidth of four specimens the residual would have another estimator."""
    together = target_moments(normal_model(metric, FEW.ravel()), FEW.ravel())
    apart = target_moments(normal_model(metric, *FEW), FEW.ravel())
    require_close(apart, together, offset=0.1, widths=(0.93, 1.07))


@pytest.mark.long
def test_the_residual_of_few_specimens_in_each_of_several_simulators() -> None:
    """With the wide bandwidth of four specimens mean and spread of all decide."""
    apart = target_moments(normal_model(PR, *FEW), FEW.ravel())
    require_close(apart, exact_moments(_vague, FEW.ravel()))


@pytest.mark.long
def test_groups_with_a_common_prior_are_pooled() -> None:
    """With a known standard deviation the exact posterior is normal; estimates are the means."""
    names = ["a", "b", "c"]
    centers = np.array([0.6, 1.0, 1.5])
    y = np.random.default_rng(8).normal(centers[:, None], 0.5, (3, 6))
    labels = ("specimen", np.repeat(names, 6))
    observed = xr.DataArray(y.ravel(), {"supplier": labels}, "specimen")
    with pm.Model(coords={"supplier": names}) as model:
        mu = pm.Normal("mu", pm.Normal("common", 1, 2), 0.3, dims="supplier")
        x = pm.Normal.dist(mu[prb.response.group("supplier")], 0.5)
        propagation = prb.Reweighted(256)
        prb.Simulator(
            "y", lambda x: 1.0 * x, x, metric=KLD, observed=observed, propagation=propagation
        )
    optimum = prb.minimize(model, starts=0, progressbar=False)
    tree = prb.sample(500, chains=2, model=model, optimum=optimum, **QUIET)
    prior = 0.3**2 * np.eye(3) + 2.0**2
    gain = prior @ np.linalg.inv(prior + np.eye(3) * 0.5**2 / 6)
    mean = 1 + gain @ (y.mean(axis=1) - 1)
    sd = np.sqrt(np.diag(prior - gain @ prior))
    draws = tree.posterior["mu"].values.reshape(-1, 3)
    assert (np.abs(draws.mean(axis=0) - mean) < 0.2 * sd).all()
    assert (np.abs(draws.std(axis=0) / sd - 1) < 0.15).all()


# -- draws of exp(-discrepancy / epsilon) --

EPSILON = 0.08


@pytest.mark.parametrize(
    "sampler", ["prb.sample_smc", pytest.param("pm.sample", marks=pytest.mark.long)]
)
def test_epsilon_sets_the_width_without_an_adjustment(sampler: str) -> None:
    """The divergence is half a squared distance of means, in standard deviations, and a constant."""
    model = normal_model(
        KLD, DATA, sigma=lambda: 0.5, epsilon=EPSILON, propagation=prb.Reweighted(256)
    )
    (node,) = nodes(model).values()
    variance = EPSILON * (0.25 + node.target.cells.bandwidth**2)
    precision = 1 / 4 + 1 / variance
    mean, sd = (1 / 4 + DATA.mean() / variance) / precision, precision**-0.5
    if sampler == "pm.sample":
        tree = pm.sample(500, chains=2, cores=1, model=model, **QUIET)
    else:
        tree = prb.sample_smc(500, chains=2, model=model, adjustment=None, **QUIET)
        assert tree.posterior.attrs["adjustment"] == "none"
        assert tree.calibration["epsilon"].item() == EPSILON
    draws = tree.posterior["mu"].values
    # Four standard errors of 400 independent draws; 1000 of NUTS are worth no less.
    assert abs(draws.mean() - mean) < 4 * sd / 20
    assert abs(draws.std() / sd - 1) < 4 / np.sqrt(800)
    notes = [note for note in prb.diagnose(tree, model=model).notes if "epsilon" in note]
    assert len(notes) == 1
    assert "as wide as epsilon makes them" in notes[0]


# -- what has no known distribution --


@pytest.mark.parametrize("sample", [prb.sample, prb.sample_smc])
def test_random_responses_are_refused_before_the_search(sample: Callable[..., Any]) -> None:
    model = normal_model(KLD, DATA, propagation=prb.Fresh(64))
    with pytest.raises(ValueError, match=r"y0: propagation: got Fresh, .*adjustment=None"):
        sample(50, model=model, max_runs=10_000, **QUIET)


def test_responses_that_are_not_stored_are_refused_by_metrics_that_need_refits() -> None:
    model = normal_model(AREA, DATA, propagation=prb.Resimulated(64))
    refused = r"y0: propagation: got Resimulated, .*gradient is no mean.*expected prb.Reweighted"
    with pytest.raises(ValueError, match=refused):
        prb.sample_smc(50, chains=1, model=model, **QUIET)
