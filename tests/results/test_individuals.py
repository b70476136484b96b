"""Inputs of the measured specimens are those of the closed form of a normal population."""

from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes.response.compile import PLAIN

ERROR = 0.4
DRAWS = 4000


def double(x: Any) -> Any:
    return 2 * x


def normal_model(observed: Any, metric: Any = None, **keywords: Any) -> pm.Model:
    metric = prb.LogLikelihood(error=ERROR) if metric is None else metric
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 0.5), pm.HalfNormal("sigma", 0.5))
        prb.Simulator("y", double, x, metric=metric, observed=observed, **keywords)
    return model


@pytest.fixture(scope="module")
def optimum() -> prb.Optimum:
    rng = np.random.default_rng(1)
    y = 2 * rng.normal(1, 0.5, 12) + rng.normal(0, ERROR, 12)
    return prb.minimize(normal_model(y), starts=0)


@pytest.fixture(scope="module")
def tree(optimum: prb.Optimum) -> xr.DataTree:
    return prb.individuals(optimum, n_draws=DRAWS)


def posterior_of_specimens(optimum: prb.Optimum) -> tuple[Any, float]:
    """Return means and the standard deviation of the inputs given y = 2 x + e, by conjugacy."""
    y = observed_values(optimum)
    mu, sigma = float(optimum.point["mu"]), float(optimum.point["sigma"])
    variance = 1 / (1 / sigma**2 + 4 / ERROR**2)
    return variance * (mu / sigma**2 + 2 * y / ERROR**2), np.sqrt(variance)


def observed_values(optimum: prb.Optimum) -> Any:
    (rv,) = optimum.model.observed_RVs
    return optimum.model.rvs_to_values[rv].eval(mode=PLAIN)


def test_draws_have_the_conjugate_posterior(optimum: prb.Optimum, tree: xr.DataTree) -> None:
    mean, sd = posterior_of_specimens(optimum)
    x = tree["posterior"]["x"]
    assert x.dims == ("chain", "draw", "specimen")
    error = 5 * sd / np.sqrt(DRAWS)
    np.testing.assert_allclose(x.mean(("chain", "draw")), mean, atol=error)
    np.testing.assert_allclose(x.std(("chain", "draw")), sd, rtol=5 / np.sqrt(2 * DRAWS))


def test_shrinkage_is_that_of_the_means(optimum: prb.Optimum, tree: xr.DataTree) -> None:
    mean, _ = posterior_of_specimens(optimum)
    expected = 1 - mean.std() / float(optimum.point["sigma"])
    # Both standard deviations are those of draws.
    assert tree["posterior"]["x"].attrs["shrinkage"] == pytest.approx(expected, abs=0.01)


def test_replicates_are_other_specimens(optimum: prb.Optimum, tree: xr.DataTree) -> None:
    replicates = tree["posterior_predictive"]["y"].values.ravel()
    sd = np.hypot(2 * float(optimum.point["sigma"]), ERROR)
    assert replicates.std() == pytest.approx(sd, rel=5 / np.sqrt(2 * replicates.size))
    np.testing.assert_array_equal(tree["observed_data"]["y"], observed_values(optimum))


def test_a_gross_error_leaves_the_population() -> None:
    y = np.append(2 * np.random.default_rng(2).normal(1, 0.3, 30), 9.0)
    metric = prb.LogLikelihood(error=0.1, gross_errors=0.1)
    optimum = prb.minimize(normal_model(y, metric), starts=0)
    draws = prb.individuals(optimum, n_draws=2000)["posterior"]
    probability = draws["gross_error"].mean(("chain", "draw")).values
    assert probability[-1] > 0.999
    assert probability[:-1].mean() < 0.05
    x = draws["x"].isel(specimen=-1)
    mu, sigma = optimum.point["mu"], optimum.point["sigma"]
    assert float(x.mean()) == pytest.approx(float(mu), abs=5 * sigma / np.sqrt(2000))


@pytest.mark.parametrize("error", [0.02, 0.1])
@pytest.mark.parametrize("factor", [10.0, 100.0])  # within and beyond reach of the priors
def test_the_population_of_data_with_a_gross_error_is_that_of_the_others(
    factor: float, error: float
) -> None:
    y = 2 * np.random.default_rng(2).normal(1, 0.1, 25)
    rest = np.delete(y, 3)
    y[3] *= factor
    metric = prb.LogLikelihood(error=error, gross_errors=True)
    optimum = prb.minimize(normal_model(y, metric), starts=0)
    assert optimum.converged
    assert not optimum.findings
    sigma = np.sqrt(rest.var() - error**2) / 2
    assert optimum.point["mu"] == pytest.approx(rest.mean() / 2, abs=0.002)
    assert optimum.point["sigma"] == pytest.approx(sigma, rel=0.02)
    assert optimum.point["y_gross_errors"] == pytest.approx(1 / 25, rel=0.05)


@pytest.mark.long
def test_an_unknown_error_of_the_readings() -> None:
    """With the error fixed at its estimate, draws are those of the conjugate posterior."""
    rng = np.random.default_rng(3)
    rows = 2 * rng.normal(1, 0.5, (20, 1)) + rng.normal(0, 0.2, (20, 3))
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 0.5), pm.HalfNormal("sigma", 0.5))
        error = pm.HalfNormal("error", 0.5)
        metric = prb.LogLikelihood(error=error)
        prb.Simulator(
            "y", lambda x: np.stack([2 * x] * 3, axis=-1), x, metric=metric, observed=rows
        )
    optimum = prb.minimize(model, starts=0)
    draws = prb.individuals(optimum, n_draws=1000)["posterior"]["x"]
    mu, sigma, sd = (float(optimum.point[name]) for name in ("mu", "sigma", "error"))
    variance = 1 / (1 / sigma**2 + 12 / sd**2)
    mean = variance * (mu / sigma**2 + 2 * rows.sum(axis=1) / sd**2)
    error_of_mean = 5 * np.sqrt(variance / 1000)
    np.testing.assert_allclose(draws.mean(("chain", "draw")), mean, atol=error_of_mean)
    np.testing.assert_allclose(draws.std(("chain", "draw")), np.sqrt(variance), rtol=0.12)


def test_a_posterior_keeps_its_chains(optimum: prb.Optimum) -> None:
    posterior = prb.sample(model=optimum.model, optimum=optimum, random_seed=1)
    draws = prb.individuals(posterior, model=optimum.model, n_draws=40)["posterior"]["x"]
    assert draws.sizes["chain"] == posterior["posterior"].sizes["chain"]
    assert draws.sizes["chain"] * draws.sizes["draw"] == 40


def test_a_metric_has_no_record_of_specimens() -> None:
    optimum = prb.minimize(normal_model([1.0, 2.0, 3.0], prb.AreaMetric()), starts=0)
    with pytest.raises(TypeError, match="metrics compare distributions"):
        prb.individuals(optimum)


def test_specimens_have_their_labels() -> None:
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1), name="x")
        observed, labels = [1.0, 3.0, 2.0, 2.5], ["c", "a", "d", "b"]
        prb.Simulator("y", lambda x: 2 * x, x, observed=observed, specimens=labels)
        tree = prb.individuals(prb.minimize(starts=0), n_draws=20)
    for group in ("posterior", "posterior_predictive", "observed_data"):
        assert tree[group]["specimen"].values.tolist() == labels
    draws = tree["posterior"]["x"].sel(specimen="a")
    np.testing.assert_allclose(draws, 1.5, rtol=1e-4)
