"""The density of a metric's score at its estimate, against exact densities and posteriors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from normal_posterior import (
    BOUNDED,
    SHARP,
    VAGUE,
    Prior,
    draws_of,
    exact_moments,
    moments_of,
    normal_model,
    require_close,
)
from scipy import stats
from scipy.optimize import brentq

import prbayes as prb
from prbayes._finding import from_json
from prbayes._validate import Floats
from prbayes.metrics.base import Metric
from prbayes.metrics.score import WeightSlopes, specimen_scores
from prbayes.model.evaluator import Evaluator
from prbayes.posterior.saddlepoint import (
    EstimateLikelihood,
    EstimateLikelihoodOptions,
    SaddlepointOptions,
    Scores,
    StoredScores,
    cumulants,
    estimate_likelihood,
    log_density,
    varying_combinations,
)
from prbayes.posterior.target import Target, prior_conflicts

KLD = prb.KullbackLeibler()
PR = prb.ProbabilityResidual()
QUIET: dict[str, Any] = {"progressbar": False, "random_seed": 1}


# -- cumulant functions --


def atoms(size: int = 400, d: int = 2) -> tuple[Floats, Floats]:
    """Return log weights (3, M) of three populations, and scores (M, d)."""
    rng = np.random.default_rng(0)
    values = rng.normal(size=(size, d))
    logs = -0.5 * ((values[:, 0] - np.array([[0.0], [0.3], [-0.8]])) ** 2)
    return logs - np.log(np.exp(logs).sum(axis=1, keepdims=True)), values


def test_derivatives_of_the_cumulant_function() -> None:
    logs, values = atoms()
    scores = [Scores(values, 7)]
    tilts = np.array([[0.1, -0.4], [1.0, 0.2], [-0.5, 0.0]])
    at = cumulants([logs], scores, tilts)
    expected = 7 * np.log((np.exp(logs) * np.exp(tilts @ values.T)).sum(axis=1))
    np.testing.assert_allclose(at.values, expected)
    for j, step in enumerate(1e-5 * np.eye(2)):
        up, down = (cumulants([logs], scores, tilts + sign * step) for sign in (1, -1))
        np.testing.assert_allclose((up.values - down.values) / 2e-5, at.gradients[:, j], rtol=1e-7)
        slope = (up.gradients - down.gradients) / 2e-5
        np.testing.assert_allclose(slope, at.hessians[:, j], rtol=1e-7)


def test_zero_outside_of_the_hull_has_no_density() -> None:
    logs, values = atoms()
    shifted = Scores(values + np.array([10.0, 0.0]), 7)
    assert np.isneginf(log_density([logs], [shifted])).all()
    unsupported = np.full_like(logs, np.nan)
    assert np.isneginf(log_density([unsupported], [Scores(values, 7)])).all()


def test_the_density_of_a_mean_of_exponential_variables() -> None:
    """The saddlepoint density of a gamma mean is exact up to a constant."""
    nodes = stats.expon.ppf((np.arange(20000) + 0.5) / 20000)
    rates = np.array([0.6, 1.0, 1.7])
    logs = np.log(rates)[:, None] + (1 - rates[:, None]) * nodes
    logs -= np.log(np.exp(logs).sum(axis=1, keepdims=True))
    found = log_density([logs], [Scores(nodes[:, None] - 1.0, 5)])
    expected = stats.gamma(5, scale=1 / (5 * rates)).logpdf(1.0)
    np.testing.assert_allclose(found - found[1], expected - expected[1], atol=5e-3)
    # At other means of one population: the variance at the saddlepoint is their square.
    means = np.array([0.7, 1.0, 1.3])  # above, the largest node is too small
    at_means = [log_density([logs[1:2]], [Scores(nodes[:, None] - mean, 5)])[0] for mean in means]
    expected = stats.gamma(5, scale=1 / 5).logpdf(means)
    np.testing.assert_allclose(at_means - at_means[1], expected - expected[1], atol=5e-3)


def test_combinations_without_variation_are_dropped() -> None:
    rng = np.random.default_rng(1)
    independent = rng.normal(size=(200, 2)) * [1.0, 100.0]
    scores = np.column_stack([independent, independent @ [2.0, 1.0], np.zeros(200)])
    covariance = np.cov(scores.T)
    combinations = varying_combinations(covariance, SaddlepointOptions())
    assert combinations.shape == (4, 2)
    np.testing.assert_allclose(
        combinations.T @ covariance @ combinations, np.eye(2), rtol=1e-6, atol=1e-9
    )
    assert varying_combinations(np.zeros((2, 2)), SaddlepointOptions()).shape == (2, 0)


# -- scores of specimens --


def normal_population(m: int) -> WeightSlopes:
    """Return standard normal responses (M, m), weights, and slopes for mean and log sd of the first."""
    rng = np.random.default_rng(2)
    values = rng.normal(size=(3000, m))
    weights = np.full(3000, 1 / 3000)
    scores = np.stack([values[:, 0], values[:, 0] ** 2])
    slopes = weights * (scores - scores.mean(axis=1, keepdims=True))
    return WeightSlopes(values if m > 1 else values[:, 0], weights, slopes)


@pytest.mark.parametrize("metric", [PR, KLD, prb.Joint(PR), prb.Joint(KLD)])
def test_the_mean_score_is_the_gradient(metric: Metric) -> None:
    m = 2 if metric.takes_outputs else 1
    rng = np.random.default_rng(3)
    observed = np.squeeze(0.2 + rng.normal(size=(12, m)))
    target = metric.against(observed)
    population = normal_population(m)
    found = specimen_scores(target, population, observed).mean(axis=0)
    steps = 1e-5 * population.slopes
    up, down = (target(population.responses, population.weights + s * steps) for s in (1, -1))
    np.testing.assert_allclose(found, (up - down) / 2e-5, rtol=1e-4)
    # At other optima the score is the difference of the discrepancy.
    others = np.random.default_rng(4).dirichlet(np.ones(3000), 2)
    pair = replace(population, optima=others)
    further = specimen_scores(target, pair, observed).mean(axis=0)[-2:]
    base = target(population.responses, population.weights)
    expected = np.array([target(population.responses, w) - base for w in others])
    # The score of a log-density is limited beyond the data.
    np.testing.assert_allclose(further, expected, rtol=1e-6)


def test_the_score_of_the_divergence_is_constant_beyond_the_data() -> None:
    observed = np.linspace(-1, 1, 10)
    target = KLD.against(observed)
    far = specimen_scores(target, normal_population(1), np.array([6.0, 8.0, np.inf]))
    np.testing.assert_allclose(far[0], far[1])
    assert np.isfinite(far).all()


def test_metrics_without_a_mean_score_are_refused() -> None:
    observed = np.linspace(-1, 1, 10)
    for metric in (prb.AreaMetric(), prb.KullbackLeibler(reverse=True)):
        with pytest.raises(TypeError, match="gradient is no mean"):
            specimen_scores(metric.against(observed), normal_population(1), observed)


def test_weights_are_those_of_responses_that_can_be_observed() -> None:
    evaluator = Evaluator.of(normal_model(KLD, Y, n=64))
    is_observable = np.arange(64) % 3 > 0
    values = np.arange(2.0 * is_observable.sum()).reshape(-1, 2)
    combinations = np.array([[2.0], [-1.0]])
    stored = StoredScores(0, is_observable, values, 20, combinations, rows=16)
    thetas = np.array([[0.0, 0.0], [1.0, -0.5]])
    log_weights, scores = stored.population(evaluator, thetas)
    _, weights = evaluator.populations(thetas, 0)
    expected = weights[:, is_observable] / weights[:, is_observable].sum(axis=1, keepdims=True)
    np.testing.assert_allclose(np.exp(log_weights), expected)
    np.testing.assert_allclose(scores.values[:, 0], 2 * values[:, 0] - values[:, 1])


def test_newton_steps_that_would_cycle_are_shortened() -> None:
    """A remote atom has 1e-4 of the mass; the tilted mean of one lies between it and the rest."""
    scores = np.append(stats.norm.ppf((np.arange(1000) + 0.5) / 1000), 30.0) - 1.0
    logs = np.log(np.append(np.full(1000, 0.9999 / 1000), 1e-4))[None]
    log_l = log_density([logs], [Scores(scores[:, None], 1)])

    def slope(tilt: float) -> float:
        weights = np.exp(logs[0] + tilt * scores)
        return float(weights @ scores / weights.sum())

    tilt = brentq(slope, 0, 1)
    weights = np.exp(logs[0] + tilt * scores)
    variance = weights @ scores**2 / weights.sum()
    assert log_l[0] == pytest.approx(np.log(weights.sum()) - np.log(variance) / 2, abs=1e-6)


# -- posteriors --

Y = np.random.default_rng(4).normal(1, 0.5, 20)


def optimum_of(model: pm.Model) -> prb.Optimum:
    return prb.minimize(model=model, starts=0, progressbar=False)


def likelihood_at(optimum: prb.Optimum) -> EstimateLikelihood:
    return estimate_likelihood(optimum.evaluator, optimum)


def posterior_of(likelihood: EstimateLikelihood) -> dict[str, Floats]:
    """Return draws of the posterior given the estimate, by name."""
    starts = likelihood.starts[:1]
    return draws_of(
        Target(likelihood.evaluator, likelihood.log_likelihood, starts, likelihood.scale)
    )


def require_exact(
    likelihood: EstimateLikelihood, y: Floats, prior: Prior = VAGUE, **limits: Any
) -> None:
    """Mean and standard deviation are sufficient, and the divergence's estimate is close to both."""
    exact = exact_moments(prior.log_density, y)
    require_close(moments_of(posterior_of(likelihood)), exact, **limits)


STANDARD = np.random.default_rng(6).normal(size=10)
# The spread of these data is half of what the sharp prior expects.
NARROW = 1 + 0.2 * (STANDARD - STANDARD.mean()) / STANDARD.std()


# The last estimate is beyond the end of its prior, where scores of an element would vanish.
@pytest.mark.parametrize(("prior", "y"), [(VAGUE, Y), (SHARP, NARROW), (BOUNDED, Y + 0.5)])
def test_the_posterior_of_a_normal_population(prior: Prior, y: Floats) -> None:
    likelihood = likelihood_at(optimum_of(normal_model(KLD, y, prior=prior)))
    assert likelihood.combinations.shape == (2, 2)
    require_exact(likelihood, y, prior)


# Responses that are computed at each theta are functions of it by common random numbers.
@pytest.mark.parametrize(
    "propagation",
    [prb.Reweighted(512), pytest.param(prb.Resimulated(256), marks=pytest.mark.long)],
)
def test_the_score_at_another_point_is_as_good_a_statistic(
    propagation: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its observed mean is subtracted there; with the wrong sign the posterior is elsewhere."""
    optimum = optimum_of(normal_model(KLD, Y, prior=SHARP, propagation=propagation))
    shifted = replace(optimum, theta=optimum.theta + optimum.evaluator.hyperparameters.prior_sd)
    likelihood = likelihood_at(shifted)
    np.testing.assert_allclose(likelihood.starts[0], shifted.theta)
    require_exact(likelihood, Y, SHARP)

    def wrong(target: Any, population: Any, specimens: Floats, **options: Any) -> Floats:
        sign = -1 if len(specimens) == len(Y) else 1
        return sign * specimen_scores(target, population, specimens, **options)

    monkeypatch.setattr("prbayes.posterior.saddlepoint.specimen_scores", wrong)
    with pytest.raises(AssertionError, match=r"\["):
        require_exact(likelihood_at(shifted), Y, SHARP)


def test_a_population_of_bounded_support() -> None:
    """The scores include the points that the ends pass; widths are about the standard errors."""
    y = np.random.default_rng(3).uniform(0.2, 1.8, 20)
    with pm.Model() as model:
        mu, sigma = VAGUE.variables()
        x = pm.Uniform.dist(mu - 1.73 * sigma, mu + 1.73 * sigma)
        prb.Simulator("y", lambda x: x, x, observed=y, metric=KLD)
    optimum = optimum_of(model)
    likelihood = likelihood_at(optimum)
    assert likelihood.combinations.shape == (2, 2)
    for name, values in posterior_of(likelihood).items():
        # The prior is vague, and a posterior of 20 specimens is wider than the standard error.
        assert 0.9 < values.std() / optimum.stderr[name] < 1.4, name


FEW = np.random.default_rng(701).normal(1, 0.5, (5, 4))


def test_few_specimens_in_each_of_several_simulators() -> None:
    likelihood = likelihood_at(optimum_of(normal_model(KLD, *FEW, n=256)))
    assert len(likelihood.groups) == len(FEW)
    require_exact(likelihood, FEW.ravel())


def test_specimens_in_two_simulators_add_their_scores() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(*VAGUE.variables())
        settings = {"propagation": prb.Reweighted(512), "specimens": np.arange(20), "metric": KLD}
        prb.Simulator("y", lambda x: x, x, observed=Y, **settings)
        prb.Simulator("z", lambda x: 3 * x, x, observed=3 * Y, **settings)
    likelihood = likelihood_at(optimum_of(model))
    assert len(likelihood.groups) == 1
    require_exact(likelihood, Y)


def test_the_posterior_of_an_unidentified_hyperparameter_is_its_prior() -> None:
    with normal_model(KLD, Y) as model:
        pm.Normal("unused", 3, 2)
    likelihood = likelihood_at(optimum_of(model))
    assert likelihood.combinations.shape == (3, 2)
    draws = posterior_of(likelihood)["unused"]
    # Four standard errors of 1000 independent draws.
    assert abs(draws.mean() - 3) < 4 * 2 / np.sqrt(1000)
    assert abs(draws.std() / 2 - 1) < 4 / np.sqrt(2000)


def test_an_estimate_at_an_edge_is_moved_inside() -> None:
    """Known scatter of .5 exceeds that of the data: the standard deviation of inputs is zero."""
    y = 1 + np.random.default_rng(5).normal(0, 0.3, 20)
    with pm.Model() as model:
        mu, sigma = VAGUE.variables()
        x = pm.Normal.dist(mu, pm.math.sqrt(sigma**2 + 0.25))
        prb.Simulator("y", lambda x: x, x, observed=y, metric=KLD)
    likelihood = likelihood_at(optimum_of(model))
    assert likelihood.combinations.shape[1] == 2
    draws = posterior_of(likelihood)
    grids = {"mu": np.linspace(0.2, 1.8, 401)[:, None], "sigma": np.linspace(1e-3, 1.5, 600)[None]}
    variance = grids["sigma"] ** 2 + 0.25
    logs = -10 * np.log(variance) - 10 * ((y.mean() - grids["mu"]) ** 2 + y.var()) / variance
    logs = logs + VAGUE.log_density(grids["mu"], grids["sigma"])
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    for name, grid in grids.items():
        mean = (weights * grid).sum()
        sd = np.sqrt((weights * (grid - mean) ** 2).sum())
        assert abs(draws[name].mean() - mean) < 0.2 * sd
        assert 0.9 < draws[name].std() / sd < 1.15


@pytest.mark.long
def test_two_outputs_by_a_joint_metric() -> None:
    """Two outputs determine the inputs, so that the likelihood is known.

    Independent inputs are fewer hyperparameters than the whitening has numbers. The whitening of 20
    specimens then makes the estimates of their spreads too small; that of the population does not.
    """
    rng = np.random.default_rng(21)
    x = np.array([1.0, -1.0]) + np.array([0.5, 0.8]) * rng.standard_normal((20, 2))
    # A correlation by chance is what the whitening removes.
    x[:, 1] += 0.9 * (x[:, 0] - x[:, 0].mean())
    with pm.Model() as model:
        a = pm.Normal.dist(*VAGUE.variables())
        b = pm.Normal.dist(pm.Normal("nu", 0, 2), pm.HalfNormal("tau", 1))
        observed = x @ np.array([[1.0, 1.0], [1.0, -1.0]])
        settings = {"metric": prb.Joint(PR), "propagation": prb.Reweighted(256)}
        response = lambda a, b: np.stack([a + b, a - b], axis=-1)  # noqa: E731
        prb.Simulator("y", response, a, b, observed=observed, **settings)
    optimum = optimum_of(model)
    draws = posterior_of(likelihood_at(optimum))
    for mean_name, sd_name, inputs in (("mu", "sigma", x[:, 0]), ("nu", "tau", x[:, 1])):
        exact = exact_moments(VAGUE.log_density, inputs)
        require_close(moments_of(draws, mean_name, sd_name), exact)
    by_data = EstimateLikelihoodOptions(rounds=0)
    narrow = posterior_of(estimate_likelihood(optimum.evaluator, optimum, by_data))
    assert (np.log(narrow["tau"]).mean() - exact.mean[1]) / exact.sd[1] < -0.2


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
        settings = {"metric": KLD, "propagation": prb.Reweighted(256)}
        prb.Simulator("y", lambda x: 1.0 * x, x, observed=observed, **settings)
    tree = prb.sample(500, chains=2, model=model, optimum=optimum_of(model), **QUIET)
    prior = 0.3**2 * np.eye(3) + 2.0**2
    gain = prior @ np.linalg.inv(prior + np.eye(3) * 0.5**2 / 6)
    mean = 1 + gain @ (y.mean(axis=1) - 1)
    sd = np.sqrt(np.diag(prior - gain @ prior))
    draws = tree.posterior["mu"].values.reshape(-1, 3)
    assert (np.abs(draws.mean(axis=0) - mean) < 0.2 * sd).all()
    assert (np.abs(draws.std(axis=0) / sd - 1) < 0.15).all()


def test_a_prior_away_from_the_estimate_is_reported() -> None:
    low = Prior(lambda: (pm.Normal("mu", 0, 0.2), pm.HalfNormal("sigma", 1)), VAGUE.log_density)
    model = normal_model(KLD, Y, prior=low, n=1024)
    optimum = optimum_of(model)
    assert prior_conflicts(optimum, optimum.evaluator, optimum.theta[None]) == ()
    tree = prb.sample(50, chains=1, model=model, optimum=optimum, **QUIET)
    findings = from_json(tree.posterior.attrs["findings"])
    (finding,) = [finding for finding in findings if finding.code == "prior-conflict"]
    assert "mu" in finding.text


def test_a_gradient_that_is_no_mean_is_refused() -> None:
    area = Evaluator.of(normal_model(prb.AreaMetric(), Y, n=64))
    optimum = optimum_of(normal_model(KLD, Y, n=64))
    with pytest.raises(ValueError, match=r"y0 has a AreaMetric.*expected a refit_likelihood"):
        estimate_likelihood(area, optimum)
