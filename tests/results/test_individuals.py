"""Inputs of the measured specimens are those of the closed form of a normal population."""

from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from one_input import one_input, posterior_of

import prbayes as prb
from prbayes.response.compile import PLAIN

ERROR = 0.4
DRAWS = 4000


def double(x: Any) -> Any:
    return 2 * x


def normal_model(observed: Any, metric: Any = None) -> pm.Model:
    metric = prb.LogLikelihood(error=ERROR) if metric is None else metric
    return one_input(observed, metric, response=double, mu=(1, 0.5), sigma=0.5)


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


@cache
def with_gross_error(factor: float, error: float) -> tuple[prb.Optimum, Any]:
    """Return the optimum of 25 readings one of which has a factor, and the other readings."""
    y = 2 * np.random.default_rng(2).normal(1, 0.1, 25)
    rest = np.delete(y, 3)
    y[3] *= factor
    metric = prb.LogLikelihood(error=error, gross_errors=True)
    return prb.minimize(normal_model(y, metric), starts=0), rest


def test_a_gross_error_leaves_the_population() -> None:
    optimum, _ = with_gross_error(100.0, 0.1)
    draws = prb.individuals(optimum, n_draws=2000)["posterior"]
    probability = draws["gross_error"].mean(("chain", "draw")).values
    assert probability[3] > 0.999
    assert np.delete(probability, 3).mean() < 0.05
    x = draws["x"].isel(specimen=3)
    mu, sigma = optimum.point["mu"], optimum.point["sigma"]
    assert float(x.mean()) == pytest.approx(float(mu), abs=5 * sigma / np.sqrt(2000))


@pytest.mark.parametrize(("factor", "error"), [(10.0, 0.02), (100.0, 0.1)])
def test_the_population_of_data_with_a_gross_error_is_that_of_the_others(
    factor: float, error: float
) -> None:
    """Within and beyond reach of the priors."""
    optimum, rest = with_gross_error(factor, error)
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
        metric = prb.LogLikelihood(error=pm.HalfNormal("error", 0.5))
        response = lambda x: np.stack([2 * x] * 3, axis=-1)  # noqa: E731
        prb.Simulator("y", response, x, metric=metric, observed=rows)
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
    draws = posterior_of(mu=np.ones((1, 4)), sigma=np.ones((1, 4)))
    model = normal_model([1.0, 2.0, 3.0], prb.AreaMetric())
    with pytest.raises(TypeError, match="metrics compare distributions"):
        prb.individuals(draws, model=model)


def test_specimens_have_their_labels() -> None:
    observed, labels = [1.0, 3.0, 2.0, 2.5], ["c", "a", "d", "b"]
    model = one_input(observed, response=double, mu=(1, 1), specimens=labels)
    tree = prb.individuals(prb.minimize(model, starts=0), n_draws=20)
    for group in ("posterior", "posterior_predictive", "observed_data"):
        assert tree[group]["specimen"].values.tolist() == labels
    draws = tree["posterior"]["x"].sel(specimen="a")
    np.testing.assert_allclose(draws, 1.5, rtol=1e-4)
