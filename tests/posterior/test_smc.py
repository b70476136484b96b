"""`sample_smc` and its kernel against exact posteriors and numerical grids."""

from functools import cache
from typing import Any

import arviz as az
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from scipy.stats import norm

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.model.random_variable import nodes

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 50)
N, MEAN = OBSERVED.size, float(OBSERVED.mean())
AREA, KL = prb.AreaMetric(), prb.KullbackLeibler()


def simulator(
    name: str, x: Any, metric: Any = AREA, response: Any = np.positive, **keywords: Any
) -> Any:
    keywords = {"observed": OBSERVED, "propagation": prb.Reweighted(128), **keywords}
    return prb.Simulator(name, response, x, metric=metric, **keywords)


def two_hyperparameters(**keywords: Any) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        simulator("y", x, **{"propagation": prb.Reweighted(256), **keywords})
    return model


def sample(model: pm.Model, draws: int = 500, **keywords: Any) -> xr.DataTree:
    # The pseudo-posterior; the posterior given the estimate is tested in test_target.py.
    keywords = {"chains": 4, "random_seed": 1, "progressbar": False, "adjustment": None} | keywords
    return prb.sample_smc(draws, model=model, **keywords)


@cache
def area_run() -> tuple[pm.Model, xr.DataTree]:
    model = two_hyperparameters(epsilon=0.02)
    return model, sample(model)


@cache
def area_grid() -> tuple[dict[str, tuple[float, float]], float]:
    """Return means and standard deviations, and the log marginal likelihood, by quadrature."""
    mu, log_sigma = np.linspace(0.6, 1.4, 81), np.linspace(np.log(0.12), np.log(1.2), 81)
    thetas = np.stack(np.meshgrid(mu, log_sigma, indexing="ij"), axis=-1).reshape(-1, 2)
    sigma = np.exp(thetas[:, 1])
    log_prior = norm.logpdf(thetas[:, 0], 0, 2) + np.log(2) + norm.logpdf(sigma) + thetas[:, 1]
    logs = log_prior - Evaluator.of(area_run()[0])(thetas).discrepancies[:, 0] / 0.02
    weights = np.exp(logs - logs.max())
    edges = weights.reshape(81, 81)
    assert max(edges[[0, -1]].max(), edges[:, [0, -1]].max()) < 1e-3  # the posterior is inside
    cell = (mu[1] - mu[0]) * (log_sigma[1] - log_sigma[0])
    evidence = float(np.log(weights.sum() * cell) + logs.max())
    weights /= weights.sum()
    moments = {}
    for name, values in (("mu", thetas[:, 0]), ("sigma", sigma)):
        mean = float(weights @ values)
        moments[name] = mean, float(np.sqrt(weights @ (values - mean) ** 2))
    return moments, evidence


def assert_moments(draws: xr.DataArray, mean: float, sd: float, rtol_sd: float = 0.08) -> None:
    """Require four standard errors sd / sqrt(ess) of the mean; of the sd 1.6% for 2000 draws."""
    n = float(min(az.ess(draws.values), draws.size))
    assert n > 0.5 * draws.size
    assert abs(float(draws.mean()) - mean) < 4 * sd / n**0.5
    np.testing.assert_allclose(float(draws.std()), sd, rtol=rtol_sd)


# -- exact posteriors


def test_conjugate_posterior_of_a_normal_mean() -> None:
    """N times the metric is the negative log-likelihood of a normal with variance sd^2 + h^2."""
    with pm.Model() as model:
        metric = prb.LogLikelihood(density=prb.GaussianKDE())
        simulator("y", pm.Normal.dist(pm.Normal("mu", 0, 2), 0.5), metric)
    (node,) = nodes(model).values()
    variance = 0.25 + node.target.cells.bandwidth**2
    idata = sample(model)
    precision = 1 / 4 + N / variance
    assert_moments(idata.posterior["mu"], N * MEAN / variance / precision, precision**-0.5)
    # The exact likelihood has no kernel.
    ratio = float(idata.posterior["mu"].std()) * (1 / 4 + N / 0.25) ** 0.5
    assert 0.93 < ratio < 1.1
    # The evidence has an sd of 0.1 between chains.
    covariance = variance * np.eye(N) + 4.0
    _, logdet = np.linalg.slogdet(2 * np.pi * covariance)
    exact = -0.5 * (logdet + OBSERVED @ np.linalg.solve(covariance, OBSERVED))
    logs = idata.sample_stats["log_marginal_likelihood"].values[:, -1]
    assert abs(logs.mean() - exact) < 4 * 0.1 / 2 + 0.05


def test_area_posterior_and_evidence_against_a_grid() -> None:
    idata = area_run()[1]
    moments, evidence = area_grid()
    for name, pair in moments.items():
        assert_moments(idata.posterior[name], *pair)
    logs = idata.sample_stats["log_marginal_likelihood"].values
    assert np.isnan(logs[:, :-1]).all()  # before beta = 1
    last = np.array([row[~np.isnan(row)][-1] for row in logs])
    # 500 particles leave an sd of 0.15 between chains; log of a mean: bias -0.01.
    assert np.ptp(last) < 6 * 0.15
    assert abs(last.mean() - evidence) < 4 * 0.15 / 4**0.5


def test_the_kernel_draws_the_same_posterior_under_pymc() -> None:
    keywords = {"chains": 2, "cores": 1, "progressbar": False, "compute_convergence_checks": False}
    kernel = prb.posterior.BatchedKernel
    idata = pm.sample_smc(500, kernel=kernel, model=area_run()[0], random_seed=1, **keywords)
    moments, evidence = area_grid()
    for name, pair in moments.items():
        assert_moments(idata.posterior[name], *pair, 0.12)  # 1000 draws: five times 2.2%
    chains = idata.sample_stats["log_marginal_likelihood"].values
    last = [np.asarray(row, dtype=float)[-1] for row in chains]
    assert abs(np.mean(last) - evidence) < 4 * 0.15 / 2**0.5


def test_several_simulators_and_an_ordinary_likelihood() -> None:
    """All are quadratic in mu: divergences, a normal likelihood and a potential."""
    rng = np.random.default_rng(2)
    other, extra = rng.normal(1.4, 0.5, 20), rng.normal(1.2, 0.5, 30)
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 2)
        x = pm.Normal.dist(mu, 0.5)
        simulator("a", x, KL)
        simulator("b", x, KL, np.negative, observed=-other)
        pm.Normal("z", mu, 0.5, observed=extra)
        pm.Potential("pull", -5.0 * (mu - 3.0) ** 2)
    h = np.array([n.target.cells.bandwidth for n in nodes(model).values()])
    precision = np.array([1 / 4, *([N, 20] / (0.25 + h**2)), 30 / 0.25, 10])
    centers = np.array([0.0, MEAN, other.mean(), extra.mean(), 3.0])
    idata = sample(model)
    mean, sd = precision @ centers / precision.sum(), precision.sum() ** -0.5
    assert_moments(idata.posterior["mu"], mean, sd)
    assert idata.posterior.attrs["n_responses"] == int(idata.calibration["n_points"].sum())
    np.testing.assert_allclose(idata.calibration["epsilon"], [1 / N, 1 / 20])
    assert list(idata.calibration["simulator"].values) == ["a", "b"]


# -- epsilon


def epsilons(model: pm.Model) -> list[float]:
    return [node.epsilon_value for node in nodes(model).values()]


def test_an_epsilon_is_for_one_run() -> None:
    model = area_run()[0]
    for epsilon in (0.5, {"y": 0.5}):
        idata = sample(model, 50, chains=1, epsilon=epsilon)
        np.testing.assert_allclose(idata.calibration["epsilon"], [0.5])
        assert epsilons(model) == [0.02]
    assert float(idata.posterior["mu"].std()) > 2 * float(area_run()[1].posterior["mu"].std())


def test_epsilon_is_restored_after_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise RuntimeError("stop")

    model, _ = area_run()
    monkeypatch.setattr(prb.posterior.BatchedKernel, "mutate", fail)
    with pytest.raises(RuntimeError, match="stop"):
        sample(model, 50, chains=1, epsilon=0.7)
    assert epsilons(model) == [0.02]


@pytest.mark.long
def test_an_unset_epsilon_is_calibrated_for_the_run() -> None:
    model = two_hyperparameters()
    optimum = prb.minimize(model, method="Nelder-Mead")
    expected = prb.calibrate_epsilon(optimum)["y"]
    # Without an optimum it is searched for.
    for keywords in ({"optimum": optimum}, {}):
        idata = sample(model, 100, chains=1, **keywords)
        np.testing.assert_allclose(idata.calibration["epsilon"], [expected], rtol=0.05)
        assert np.isnan(epsilons(model)).all()


def test_one_epsilon_for_two_simulators_is_refused() -> None:
    with pm.Model() as two:
        x = pm.Normal.dist(pm.Normal("mu"), 1.0)
        for name in "ab":
            simulator(name, x, propagation=prb.Reweighted(16))
    with pytest.raises(ValueError, match=r"one number for 2 simulators.* by name: \['a', 'b'\]"):
        sample(two, 50, epsilon=0.1)


def test_no_finite_discrepancy_among_the_prior_draws() -> None:
    metric = prb.FunctionMetric(lambda z, observed: np.full(np.shape(z)[:-1], np.nan))
    model = two_hyperparameters(metric=metric, epsilon=1.0, propagation=prb.Resimulated(16))
    with pytest.raises(ValueError, match="no finite discrepancy among 50 draws"):
        sample(model, 50, chains=1)
