"""The sampler of any model: importance sampling, and the samplers that take over."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
import pytest
from scipy.stats import norm

import prbayes as prb
from prbayes._validate import Floats

X = np.random.default_rng(0).normal(10, 1, 20)


def linear_model(x: Floats = X) -> pm.Model:
    with pm.Model() as model:
        mu = pm.Normal("mu", 9, 3)
        sigma = pm.HalfNormal("sigma", 2)
        inputs = pm.Normal.dist(mu, sigma)
        prb.Simulator("y", lambda x: 2 * x + 1, inputs, observed=2 * x + 1)
    return model


def exact_moments(x: Floats) -> dict[str, tuple[float, float]]:
    """Return posterior means and standard deviations of `linear_model` by quadrature."""
    mu, sigma = (a.ravel() for a in np.meshgrid(np.linspace(7, 13, 400), np.linspace(0.3, 4, 400)))
    logs = norm.logpdf(x[:, None], mu, sigma).sum(axis=0)
    logs += norm.logpdf(mu, 9, 3) + norm.logpdf(sigma, 0, 2)
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    moments = {}
    for name, values in {"mu": mu, "sigma": sigma}.items():
        mean = float(weights @ values)
        moments[name] = mean, float(np.sqrt(weights @ (values - mean) ** 2))
    return moments


def test_the_posterior_is_exact() -> None:
    result = prb.sample(2000, chains=2, model=linear_model(), random_seed=1, progressbar=False)
    attrs = result.posterior.attrs
    assert attrs["sampler"] == "importance sampling"
    assert attrs["pareto_k"] < 0.7
    assert attrs["efficiency"] > 0.5
    for name, (mean, sd) in exact_moments(X).items():
        draws = result.posterior[name]
        # Five standard errors of 4000 independent draws.
        assert abs(float(draws.mean()) - mean) < 5 * sd / np.sqrt(4000)
        assert abs(float(draws.std()) / sd - 1) < 5 * np.sqrt(1 / 8000) * 1.5
    assert prb.diagnose(result, model=linear_model()).ok


def test_the_groups_are_those_of_other_samplers() -> None:
    model = linear_model()
    result = prb.sample(100, chains=3, model=model, random_seed=1, progressbar=False)
    assert result.posterior["mu"].shape == (3, 100)
    assert result.log_likelihood["y"].shape == (3, 100, len(X))
    assert result.posterior_predictive["y"].shape == (3, 100, len(X))
    assert set(result.sample_stats.data_vars) == {"lp"}
    with model:
        sigma = result.posterior["sigma"].values[0, :5]
        point = {"mu": 0.0, "sigma_log__": 0.0}
        logp = model.compile_logp()
        expected = [
            float(logp({**point, "mu": m, "sigma_log__": np.log(s)}))
            for m, s in zip(result.posterior["mu"].values[0, :5], sigma, strict=True)
        ]
    np.testing.assert_allclose(result.sample_stats["lp"].values[0, :5], expected, rtol=1e-6)


def test_draws_depend_on_the_seed_alone() -> None:
    model = linear_model()
    first, again, other = (
        prb.sample(50, model=model, random_seed=seed, progressbar=False).posterior["mu"].values
        for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_moving_ends_are_sampled_by_smc() -> None:
    x = np.random.default_rng(1).uniform(2, 5, 20)
    with pm.Model() as model:
        low, width = pm.Normal("low", 2, 2), pm.HalfNormal("width", 4)
        inputs = pm.Uniform.dist(low, low + width)
        prb.Simulator("y", lambda x: 2 * x + 1, inputs, observed=2 * x + 1)
    result = prb.sample(200, chains=2, model=model, progressbar=False)
    assert result.posterior.attrs["sampler"] == "SMC"
    assert float((result.posterior["low"]).max()) <= x.min()


def test_few_specimens_are_sampled_by_nuts(monkeypatch: pytest.MonkeyPatch) -> None:
    from prbayes.posterior import sample as module

    options = module.ImportanceOptions(effective=100.0)
    monkeypatch.setattr(module, "ImportanceOptions", lambda: options)
    result = prb.sample(500, chains=2, model=linear_model(), progressbar=False)
    assert result.posterior.attrs["sampler"] == "NUTS"
    for name, (mean, sd) in exact_moments(X).items():
        assert abs(float(result.posterior[name].mean()) - mean) < 0.3 * sd


def metric_model(metric: prb.Metric, x: Floats, mu: Callable[[], Any] | None = None) -> pm.Model:
    with pm.Model() as model:
        center = pm.Normal("mu", 9, 3) if mu is None else mu()
        inputs = pm.Normal.dist(center, pm.HalfNormal("sigma", 2))
        prb.Simulator("y", lambda x: 2 * x + 1, inputs, metric=metric, observed=2 * x + 1)
    return model


def test_the_posterior_given_the_estimate_of_the_divergence_is_nearly_the_exact_one() -> None:
    model = metric_model(prb.KullbackLeibler(), X)
    result = prb.sample(1000, model=model, progressbar=False)
    assert result.posterior.attrs["sampler"] == "importance sampling"
    assert result.posterior.attrs["adjustment"] == "estimate"
    for name, (mean, sd) in exact_moments(X).items():
        draws = result.posterior[name]
        assert abs(float(draws.mean()) - mean) < 0.2 * sd
        assert 0.9 < float(draws.std()) / sd < 1.15
    # Of the draws' own density, up to a constant, for power-scaling.
    log_density = result.sample_stats["lp"]
    log_prior = sum(result.log_prior[name] for name in ("mu", "sigma"))
    jacobian = np.log(result.posterior["sigma"])
    parts = result.log_likelihood.to_dataset()
    log_likelihood = sum(parts[name].squeeze("y_dim_0", drop=True) for name in parts.data_vars)
    np.testing.assert_allclose(log_density, log_prior + jacobian + log_likelihood, atol=1e-8)
    assert prb.diagnose(result, model=model).ok


def test_the_end_of_a_prior_cuts_the_posterior_given_the_estimate() -> None:
    """The estimate is near the end; its density does not depend on the prior."""
    metric = prb.ProbabilityResidual()
    free = prb.sample(2000, model=metric_model(metric, X), progressbar=False).posterior
    end = float(free["mu"].mean())
    cut = prb.sample(
        1000,
        model=metric_model(metric, X, lambda: pm.Uniform("mu", 0.0, end)),
        progressbar=False,
    ).posterior
    assert cut.attrs["sampler"] == "importance sampling"
    below = free["mu"].to_numpy().ravel()
    # The normal prior of the first is flat over its posterior: .01 standard deviations.
    expected = below[below < end]
    sd = expected.std()
    assert abs(float(cut["mu"].mean()) - expected.mean()) < 0.15 * sd
    assert 0.9 < float(cut["mu"].std()) / sd < 1.1


@pytest.mark.long
def test_a_prior_that_is_far_wider_than_the_population() -> None:
    model = metric_model(prb.KullbackLeibler(), X, lambda: pm.Normal("mu", 0.0, 300.0))
    result = prb.sample(500, model=model, progressbar=False)
    mean, sd = exact_moments(X)["mu"]
    assert abs(float(result.posterior["mu"].mean()) - mean) < 0.3 * sd


def test_two_simulators_add_what_they_know() -> None:
    with pm.Model() as model:
        mu = pm.Normal("mu", 9, 3)
        sigma = pm.HalfNormal("sigma", 2)
        for name, part in (("first", X[:10]), ("second", X[10:])):
            inputs = pm.Normal.dist(mu, sigma)
            prb.Simulator(
                name, lambda x: 2 * x + 1, inputs, metric=prb.KullbackLeibler(),
                observed=2 * part + 1,
            )  # fmt: skip
    result = prb.sample(1000, model=model, progressbar=False)
    assert result.posterior.attrs["sampler"] == "importance sampling"
    for name, (mean, sd) in exact_moments(X).items():
        draws = result.posterior[name]
        assert abs(float(draws.mean()) - mean) < 0.3 * sd
        assert 0.85 < float(draws.std()) / sd < 1.2


def test_where_importance_sampling_is_not_reliable_a_metric_is_sampled_by_smc(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from prbayes.posterior import sample as module

    options = module.ImportanceOptions(effective=100.0)
    monkeypatch.setattr(module, "ImportanceOptions", lambda: options)
    model = metric_model(prb.ProbabilityResidual(), X)
    result = prb.sample(50, chains=1, model=model, progressbar=False)
    assert result.posterior.attrs["sampler"] == "SMC"
    assert result.posterior.attrs["adjustment"] == "estimate"


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"draws": 5}, ValueError, "draws"),
        ({"chains": 0}, ValueError, "chains"),
        ({"optimum": 3}, TypeError, "expected an Optimum"),
        ({"var_names": ["nu"]}, KeyError, "var_names"),
    ],
)
def test_bad_arguments(arguments: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        prb.sample(model=linear_model(), **arguments)
