"""The likelihood given an estimate from refits, against posteriors in closed form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
from scipy import stats

import prbayes as prb
from prbayes._validate import Floats
from prbayes.inference.prior_continuation import ContinuedEvaluator, continuation_of
from prbayes.model.parameters import log_posterior
from prbayes.posterior.importance import importance_sample, laplace
from prbayes.posterior.refit_likelihood import (
    RefitLikelihood,
    RefitLikelihoodOptions,
    extended_log_density,
    refit_likelihood,
)

SD = 0.5
DRAWS = 2000
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


def likelihood_of(model: pm.Model, options: RefitLikelihoodOptions = OPTIONS) -> RefitLikelihood:
    """Return the likelihood given the optimum."""
    optimum = prb.minimize(model=model, progressbar=False)
    return refit_likelihood(optimum.evaluator, optimum, options)


def posterior(likelihood: RefitLikelihood) -> dict[str, Floats]:
    """Return draws by name."""
    evaluator = likelihood.evaluator

    def density(thetas: Floats) -> Floats:
        return log_posterior(evaluator.hyperparameters, thetas, likelihood.log_likelihood)

    modes = laplace(density, likelihood.starts, likelihood.scale)
    sample = importance_sample(density, modes, DRAWS, seed=0)
    assert sample.pareto_k < 0.7
    return likelihood.evaluator.hyperparameters.constrained(sample.draws)


def mean_model(prior: Callable[[], Any], y: Floats, metric: Any = MEAN) -> pm.Model:
    """Return y = x with a known standard deviation."""
    with pm.Model() as model:
        x = pm.Normal.dist(prior(), SD)
        prb.Simulator(
            "y", lambda x: x, x, observed=y, metric=metric, propagation=prb.Reweighted(512)
        )
    return model


@cache
def normal_likelihood(seed: int = 0) -> RefitLikelihood:
    """Return the likelihood of a mean with a normal prior."""
    model = mean_model(lambda: pm.Normal("mu", 1.3, 0.2), data(12))
    return likelihood_of(model, RefitLikelihoodOptions(seed=seed))


# -- closed forms --


def test_the_mean_of_a_normal_population() -> None:
    """Normal prior and normal mean; errors of 1024 data sets are below .1 standard deviations."""
    y = data(12)
    draws = posterior(normal_likelihood())["mu"]
    precision = 1 / 0.2**2 + len(y) / SD**2
    mean = (1.3 / 0.2**2 + y.sum() / SD**2) / precision
    assert abs(draws.mean() - mean) * np.sqrt(precision) < 0.15
    assert draws.std() * np.sqrt(precision) == pytest.approx(1, abs=0.1)


def test_the_slope_of_the_log_likelihood() -> None:
    y = data(12)
    grid = y.mean() + np.linspace(-3, 3, 13) * SD / np.sqrt(12)
    found = normal_likelihood().log_likelihood(grid[:, None])
    expected = -12 * (grid - y.mean()) ** 2 / (2 * SD**2)
    np.testing.assert_allclose(found - found[6], expected - expected[6], atol=0.35)


def test_mean_and_standard_deviation() -> None:
    """Both are sufficient: the posterior is that of the full data, here on a grid."""
    y = data(15)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0.8, 0.1), pm.LogNormal("sigma", np.log(0.7), 0.3))
        prb.Simulator(
            "y", lambda x: x, x, observed=y, metric=MOMENTS, propagation=prb.Reweighted(512)
        )
    draws = posterior(likelihood_of(model))
    mu = np.linspace(0.3, 1.6, 400)[:, None]
    log_sd = np.linspace(-1.6, 0.4, 400)[None]
    logs = -15 * log_sd - 15 * ((y.mean() - mu) ** 2 + y.var()) * np.exp(-2 * log_sd) / 2
    logs = logs + stats.norm.logpdf(mu, 0.8, 0.1) + stats.norm.logpdf(log_sd, np.log(0.7), 0.3)
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    for values, points in ((draws["mu"], mu), (np.log(draws["sigma"]), log_sd)):
        mean = (weights * points).sum()
        sd = np.sqrt((weights * (points - mean) ** 2).sum())
        assert abs(values.mean() - mean) < 0.15 * sd
        assert values.std() == pytest.approx(sd, rel=0.1)


@pytest.mark.parametrize("upper", [0.85, 1.2])
def test_a_uniform_prior_that_ends_near_the_estimate(upper: float) -> None:
    """The estimate is .97: the posterior is a normal distribution that is cut off."""
    y = data(12)
    model = mean_model(lambda: pm.Uniform("mu", 0, upper), y)
    draws = posterior(likelihood_of(model))["mu"]
    error = SD / np.sqrt(12)
    ends = (np.array([0, upper]) - y.mean()) / error
    exact = stats.truncnorm(*ends, y.mean(), error)
    assert abs(draws.mean() - exact.mean()) < 0.15 * exact.std()
    assert draws.std() == pytest.approx(exact.std(), rel=0.1)


def test_only_the_sum_is_identified() -> None:
    """The difference of two means keeps its prior."""
    y = data(15, mean=2.0)
    with pm.Model() as model:
        first = pm.Normal.dist(pm.Normal("a", 1, 0.5), 0.3)
        second = pm.Normal.dist(pm.Normal("b", 1, 0.5), 0.4)
        prb.Simulator(
            "y", lambda x, z: x + z, first, second, observed=y, metric=prb.AreaMetric(),
            propagation=prb.Reweighted(64),
        )  # fmt: skip
    draws = posterior(likelihood_of(model))
    difference, total = draws["a"] - draws["b"], draws["a"] + draws["b"]
    assert abs(difference.mean()) < 0.1
    assert difference.std() == pytest.approx(0.5 * np.sqrt(2), rel=0.1)
    precision = 1 / 0.5 + 15 / SD**2
    assert total.mean() == pytest.approx((2 / 0.5 + y.sum() / SD**2) / precision, abs=0.06)
    assert total.std() == pytest.approx(1 / np.sqrt(precision), rel=0.2)


def test_mirror_modes_have_the_weights_of_their_prior() -> None:
    y = (np.random.default_rng(3).normal(2, 0.3, 20) - 1) ** 2
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.3)
        prb.Simulator(
            "y", lambda x: (x - 1) ** 2, x, observed=y, metric=prb.AreaMetric(),
            propagation=prb.Reweighted(1024),
        )  # fmt: skip
    likelihood = likelihood_of(model)
    assert len(likelihood.centers) == 2
    share = (posterior(likelihood)["mu"] > 1).mean()
    assert share == pytest.approx(1 / (1 + np.exp(0.5)), abs=0.06)


# -- simulators, seeds --


def pair_model(names: tuple[str, str], y: dict[str, Floats]) -> pm.Model:
    """Return two simulators with a mean each, in an order."""
    with pm.Model() as model:
        means = {name: pm.Normal(f"mu_{name}", 1, 0.4) for name in names}
        for name in names:
            prb.Simulator(
                name, lambda x: x, pm.Normal.dist(means[name], SD), observed=y[name],
                metric=prb.AreaMetric(), propagation=prb.Reweighted(256),
            )  # fmt: skip
    return model


def test_the_order_of_simulators_does_not_matter() -> None:
    y = {"first": data(12, 0.6), "second": data(20, 1.5, seed=1)}
    results = []
    for names in (("first", "second"), ("second", "first")):
        draws = posterior(likelihood_of(pair_model(names, y)))
        results.append(np.array([draws["mu_first"], draws["mu_second"]]))
    first, second = results
    np.testing.assert_allclose(first.mean(axis=1), second.mean(axis=1), atol=0.025)
    np.testing.assert_allclose(first.std(axis=1), second.std(axis=1), rtol=0.15)
    assert first[0].std() > 1.1 * first[1].std()  # 12 specimens against 20


def test_specimens_that_simulators_share_count_once() -> None:
    y = data(12)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 2), SD)
        for name, factor in (("y", 1.0), ("z", 2.0)):
            prb.Simulator(
                name, lambda x, factor=factor: factor * x, x, observed=factor * y, metric=MEAN,
                propagation=prb.Reweighted(512), specimens=np.arange(12),
            )  # fmt: skip
    draws = posterior(likelihood_of(model))["mu"]
    assert draws.std() == pytest.approx(SD / np.sqrt(12), rel=0.1)
    assert abs(draws.mean() - y.mean()) < 0.15 * SD / np.sqrt(12)


def test_the_same_seed_gives_the_same_numbers() -> None:
    thetas = np.array([[0.9], [1.1]])
    found = normal_likelihood().log_likelihood(thetas)
    model = mean_model(lambda: pm.Normal("mu", 1.3, 0.2), data(12))
    np.testing.assert_array_equal(likelihood_of(model).log_likelihood(thetas), found)
    other = normal_likelihood(1).log_likelihood(thetas)
    assert not np.array_equal(other, found)
    np.testing.assert_allclose(np.diff(other), np.diff(found), atol=0.3)


def test_outputs_with_gaps() -> None:
    """Two outputs, one of which was not measured everywhere; the posterior is near the full one."""
    rng = np.random.default_rng(4)
    y = rng.normal([0.5, 1.5], SD, (20, 2))
    gaps = y.copy()
    gaps[15:, 1] = np.nan
    with pm.Model() as model:
        inputs = [pm.Normal.dist(pm.Normal(name, 1, 1), SD) for name in "ab"]
        prb.Simulator(
            "y", lambda a, b: np.stack([a, b], axis=-1), *inputs, observed=gaps,
            metric=prb.Joint(prb.AreaMetric()), propagation=prb.Reweighted(128),
        )  # fmt: skip
    draws = posterior(likelihood_of(model))
    for name, column in zip("ab", gaps.T, strict=True):
        measured = column[np.isfinite(column)]
        error = SD / np.sqrt(measured.size)
        assert abs(draws[name].mean() - measured.mean()) < error
        assert 0.9 < draws[name].std() / error < 1.5


# -- refusals --


def test_an_estimate_at_an_edge_is_refused() -> None:
    model = mean_model(lambda: pm.Normal("mu", 1.3, 0.2), data(12))
    optimum = prb.minimize(model=model, progressbar=False)
    with pytest.raises(ValueError, match="got mu at an edge"):
        refit_likelihood(
            optimum.evaluator, replace(optimum, search=replace(optimum.search, at_edge=("mu",)))
        )
    with pytest.raises(ValueError, match="estimates of synthetic data sets at an edge"):
        refit_likelihood(optimum.evaluator, optimum, RefitLikelihoodOptions(reach=0.5))


# -- parts --


def test_the_extended_density_of_normal_estimates() -> None:
    """Weighted normal estimates, also where none of them is near."""
    estimates = stats.norm.ppf((np.arange(4000) + 0.5) / 4000)[:, None] * 2.5
    means = np.array([0.0, 0.5, -2.0, 3.0])[:, None]
    logs = stats.norm.logpdf(estimates.T, means, 1) - stats.norm.logpdf(estimates.T, 0, 2.5)
    logs -= np.log(np.exp(logs).sum(axis=1, keepdims=True))
    found = extended_log_density(logs, estimates, means, OPTIONS)
    expected = stats.norm.logpdf(0, means[:, 0])
    np.testing.assert_allclose(found - found[0], expected - expected[0], atol=0.02)


def test_populations_go_on_beyond_the_ends_of_a_prior() -> None:
    with pm.Model() as model:
        mu, sigma = pm.Uniform("mu", 0, 2), pm.Uniform("sigma", 0, 1)
        prb.Simulator(
            "y", lambda x: x, pm.Normal.dist(mu, sigma), observed=data(12),
            metric=prb.AreaMetric(), propagation=prb.Reweighted(256),
        )  # fmt: skip
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
    mu_roots, sigma_roots = continued.roots(outside, 0)
    np.testing.assert_allclose(mu_roots, [-0.5, 2.5], rtol=1e-6)
    np.testing.assert_allclose(sigma_roots, [1.5, 0.5], rtol=1e-6)
