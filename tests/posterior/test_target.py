"""The posterior given a metric's estimate, and that of exp(-discrepancy / epsilon); by refits too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
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
from prbayes.inference.prior_continuation import ContinuedEvaluator, continuation_of
from prbayes.metrics.base import Metric
from prbayes.model.parameters import log_posterior
from prbayes.model.random_variable import nodes
from prbayes.posterior.importance import importance_sample, laplace
from prbayes.posterior.target import (
    RefitLikelihood,
    RefitLikelihoodOptions,
    estimate_target,
    extended_log_density,
    prior_conflicts,
    refit_likelihood,
)

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
    thetas = np.array([[1.0, np.log(0.5)]])
    assert prior_conflicts(fitted(KLD), fitted(KLD).evaluator, thetas) == ()
    model = normal_model(KLD, DATA, mu=lambda: pm.Normal("mu", 0.0, 0.2))
    tree = prb.sample(50, chains=1, model=model, **QUIET)
    findings = from_json(tree.posterior.attrs["findings"])
    (finding,) = [finding for finding in findings if finding.code == "prior-conflict"]
    assert "mu" in finding.text


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


@pytest.mark.parametrize("spread", [0.25, 0.85])
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


# -- the likelihood by refits --

SD = 0.5
OPTIONS = RefitLikelihoodOptions()


def mean_difference(simulated: Any, observed: Any, weights: Any) -> Any:
    """Return a distance whose minimiser has the mean of the data."""
    return ((weights * simulated).sum(axis=-1) - observed.mean()) ** 2


def moment_difference(simulated: Any, observed: Any, weights: Any) -> Any:
    """Return a distance whose minimiser has the mean and standard deviation of the data."""
    mean = (weights * simulated).sum(axis=-1)
    variance = (weights * simulated**2).sum(axis=-1) - mean**2
    spread = np.sqrt(np.maximum(variance, 1e-12)) - observed.std()
    return (mean - observed.mean()) ** 2 + spread**2


MEAN = prb.FunctionMetric(mean_difference, weighted=True)
MOMENTS = prb.FunctionMetric(moment_difference, weighted=True)


def data(size: int, mean: float = 1.0, seed: int = 0) -> Floats:
    """Return specimens of a normal population."""
    return np.random.default_rng(seed).normal(mean, SD, size)


Y12 = data(12)


def likelihood_of(model: pm.Model, options: RefitLikelihoodOptions = OPTIONS) -> RefitLikelihood:
    """Return the likelihood given the optimum."""
    optimum = prb.minimize(model=model, progressbar=False)
    return refit_likelihood(optimum.evaluator, optimum, options)


def posterior(likelihood: RefitLikelihood) -> dict[str, Floats]:
    """Return draws by name."""
    hyperparameters = likelihood.evaluator.hyperparameters

    def density(thetas: Floats) -> Floats:
        return log_posterior(hyperparameters, thetas, likelihood.log_likelihood)

    modes = laplace(density, likelihood.starts, likelihood.scale)
    sample = importance_sample(density, modes, 2000, seed=0)
    assert sample.pareto_k < 0.7
    return hyperparameters.constrained(sample.draws)


def require_normal(draws: Floats, mean: float, sd: float, rtol: float = 0.1) -> None:
    """Errors of 1024 data sets are below .1 standard deviations."""
    assert abs(draws.mean() - mean) < 0.15 * sd
    assert draws.std() == pytest.approx(sd, rel=rtol)


def simulate(*inputs: Any, name: str = "y", response: Any = np.positive, **keywords: Any) -> None:
    settings = {"metric": AREA, "propagation": prb.Reweighted(512), **keywords}
    prb.Simulator(name, response, *inputs, **settings)


def mean_model(prior: Callable[[], Any]) -> pm.Model:
    """Return y = x with a known standard deviation."""
    with pm.Model() as model:
        simulate(pm.Normal.dist(prior(), SD), observed=Y12, metric=MEAN)
    return model


@cache
def normal_likelihood(seed: int = 0) -> RefitLikelihood:
    """Return the likelihood of a mean with a normal prior."""
    model = mean_model(lambda: pm.Normal("mu", 1.3, 0.2))
    return likelihood_of(model, RefitLikelihoodOptions(seed=seed))


def test_the_mean_of_a_normal_population() -> None:
    precision = 1 / 0.2**2 + 12 / SD**2
    mean = (1.3 / 0.2**2 + Y12.sum() / SD**2) / precision
    require_normal(posterior(normal_likelihood())["mu"], mean, precision**-0.5)
    grid = Y12.mean() + np.linspace(-3, 3, 13) * SD / np.sqrt(12)
    logs = normal_likelihood().log_likelihood(grid[:, None])
    expected = -12 * (grid - Y12.mean()) ** 2 / (2 * SD**2)
    np.testing.assert_allclose(logs - logs[6], expected - expected[6], atol=0.35)


def test_the_seed_determines_the_numbers() -> None:
    thetas = np.array([[0.9], [1.1]])
    logs, other = (normal_likelihood(seed).log_likelihood(thetas) for seed in (0, 1))
    model = mean_model(lambda: pm.Normal("mu", 1.3, 0.2))
    np.testing.assert_array_equal(likelihood_of(model).log_likelihood(thetas), logs)
    assert not np.array_equal(other, logs)
    np.testing.assert_allclose(np.diff(other), np.diff(logs), atol=0.3)


def test_mean_and_standard_deviation() -> None:
    """Both are sufficient: the posterior is that of the full data."""
    y = data(15)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0.8, 0.1), pm.LogNormal("sigma", np.log(0.7), 0.3))
        simulate(x, observed=y, metric=MOMENTS)
    draws = posterior(likelihood_of(model))

    def log_prior(mu: Floats, sigma: Floats) -> Floats:
        log_normal = stats.lognorm(0.3, scale=0.7)
        return np.asarray(stats.norm.logpdf(mu, 0.8, 0.1) + log_normal.logpdf(sigma))

    exact = exact_moments(log_prior, y)
    require_normal(draws["mu"], exact.mean[0], exact.sd[0])
    require_normal(np.log(draws["sigma"]), exact.mean[1], exact.sd[1])


@pytest.mark.parametrize("upper", [0.85, 1.2])
def test_a_uniform_prior_that_ends_near_the_estimate(upper: float) -> None:
    """The estimate is .97: the posterior is a normal distribution that is cut off."""
    draws = posterior(likelihood_of(mean_model(lambda: pm.Uniform("mu", 0, upper))))["mu"]
    error = SD / np.sqrt(12)
    ends = (np.array([0, upper]) - Y12.mean()) / error
    exact = stats.truncnorm(*ends, Y12.mean(), error)
    require_normal(draws, exact.mean(), exact.std())


def test_only_the_sum_is_identified() -> None:
    """The difference of two means keeps its prior."""
    y = data(15, mean=2.0)
    with pm.Model() as model:
        sds = {"a": 0.3, "b": 0.4}
        inputs = [pm.Normal.dist(pm.Normal(name, 1, 0.5), sd) for name, sd in sds.items()]
        simulate(*inputs, response=np.add, observed=y, propagation=prb.Reweighted(64))
    draws = posterior(likelihood_of(model))
    require_normal(draws["a"] - draws["b"], 0.0, 0.5 * np.sqrt(2))
    precision = 1 / 0.5 + 15 / SD**2
    total = draws["a"] + draws["b"]
    assert total.mean() == pytest.approx((2 / 0.5 + y.sum() / SD**2) / precision, abs=0.06)
    assert total.std() == pytest.approx(precision**-0.5, rel=0.2)


def test_mirror_modes_have_the_weights_of_their_prior() -> None:
    y = (np.random.default_rng(3).normal(2, 0.3, 20) - 1) ** 2
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.3)
        propagation = prb.Reweighted(1024)
        simulate(x, response=lambda x: (x - 1) ** 2, observed=y, propagation=propagation)
    likelihood = likelihood_of(model)
    assert len(likelihood.centers) == 2
    share = (posterior(likelihood)["mu"] > 1).mean()
    assert share == pytest.approx(1 / (1 + np.exp(0.5)), abs=0.06)


def test_the_order_of_simulators_does_not_matter() -> None:
    observed = {"first": data(12, 0.6), "second": data(20, 1.5, seed=1)}
    results = []
    for names in (("first", "second"), ("second", "first")):
        with pm.Model() as model:
            means = {name: pm.Normal(f"mu_{name}", 1, 0.4) for name in names}
            for name in names:
                x = pm.Normal.dist(means[name], SD)
                simulate(x, name=name, observed=observed[name], propagation=prb.Reweighted(256))
        draws = posterior(likelihood_of(model))
        results.append(np.array([draws["mu_first"], draws["mu_second"]]))
    first, second = results
    np.testing.assert_allclose(first.mean(axis=1), second.mean(axis=1), atol=0.025)
    np.testing.assert_allclose(first.std(axis=1), second.std(axis=1), rtol=0.15)
    assert first[0].std() > 1.1 * first[1].std()  # 12 specimens against 20


def test_specimens_that_simulators_share_count_once() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 2), SD)
        settings = {"metric": MEAN, "specimens": np.arange(12)}
        simulate(x, observed=Y12, **settings)
        simulate(x, name="z", response=lambda x: 2 * x, observed=2 * Y12, **settings)
    require_normal(posterior(likelihood_of(model))["mu"], Y12.mean(), SD / np.sqrt(12))


def test_outputs_with_gaps() -> None:
    """Two outputs, one of which was not measured everywhere; the posterior is near the full one."""
    y = np.random.default_rng(4).normal([0.5, 1.5], SD, (20, 2))
    y[15:, 1] = np.nan
    with pm.Model() as model:
        inputs = [pm.Normal.dist(pm.Normal(name, 1, 1), SD) for name in "ab"]
        response = lambda a, b: np.stack([a, b], axis=-1)  # noqa: E731
        settings = {"metric": prb.Joint(AREA), "propagation": prb.Reweighted(128)}
        simulate(*inputs, response=response, observed=y, **settings)
    draws = posterior(likelihood_of(model))
    for name, column in zip("ab", y.T, strict=True):
        measured = column[np.isfinite(column)]
        error = SD / np.sqrt(measured.size)
        assert abs(draws[name].mean() - measured.mean()) < error
        assert 0.9 < draws[name].std() / error < 1.5


def test_an_estimate_at_an_edge_is_refused() -> None:
    model = mean_model(lambda: pm.Normal("mu", 1.3, 0.2))
    optimum = prb.minimize(model=model, progressbar=False)
    edge = replace(optimum, search=replace(optimum.search, at_edge=("mu",)))
    with pytest.raises(ValueError, match="got mu at an edge"):
        refit_likelihood(optimum.evaluator, edge)
    with pytest.raises(ValueError, match="estimates of synthetic data sets at an edge"):
        refit_likelihood(optimum.evaluator, optimum, RefitLikelihoodOptions(reach=0.5))


def test_the_extended_density_of_normal_estimates() -> None:
    """Weighted normal estimates, also where none of them is near."""
    estimates = stats.norm.ppf((np.arange(4000) + 0.5) / 4000)[:, None] * 2.5
    means = np.array([0.0, 0.5, -2.0, 3.0])[:, None]
    logs = stats.norm.logpdf(estimates.T, means, 1) - stats.norm.logpdf(estimates.T, 0, 2.5)
    logs -= np.log(np.exp(logs).sum(axis=1, keepdims=True))
    density = extended_log_density(logs, estimates, means, OPTIONS)
    expected = stats.norm.logpdf(0, means[:, 0])
    np.testing.assert_allclose(density - density[0], expected - expected[0], atol=0.02)


def test_populations_continue_beyond_the_ends_of_a_prior() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Uniform("mu", 0, 2), pm.Uniform("sigma", 0, 1))
        simulate(x, observed=Y12, propagation=prb.Reweighted(256))
    evaluator = prb.minimize(model=model, progressbar=False).evaluator
    thetas = evaluator.hyperparameters.prior_thetas(20, 0)
    continuation = continuation_of(evaluator, thetas[:1])
    assert continuation.below.tolist() == [True, False]  # no negative standard deviation
    assert continuation.above.tolist() == [True, True]
    coordinates = continuation.coordinates(thetas)
    values = evaluator.hyperparameters.constrained(thetas)
    np.testing.assert_allclose(coordinates[:, 0], values["mu"])
    np.testing.assert_allclose(coordinates[:, 1], np.log(values["sigma"]))
    np.testing.assert_allclose(continuation.within(coordinates), thetas, atol=1e-6)
    continued = ContinuedEvaluator.continuing(evaluator, continuation)
    outside = np.array([[-0.5, np.log(1.5)], [2.5, np.log(0.5)]])
    mu_roots, sigma_roots = continued.parents(outside, 0)
    np.testing.assert_allclose(mu_roots, [-0.5, 2.5], rtol=1e-6)
    np.testing.assert_allclose(sigma_roots, [1.5, 0.5], rtol=1e-6)
