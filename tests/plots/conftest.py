"""Results that all plots are tested with, made once for each worker."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from one_input import one_input, posterior_of
from scipy import stats

import prbayes as prb
from prbayes.propagation.base import Propagation


def same(x: Any) -> Any:
    """Return the input; of NumPy's own functions older versions do not tell what theirs is called."""
    return np.positive(x)


@pytest.fixture(scope="session")
def known() -> SimpleNamespace:
    """Draws of a posterior, shape (2, 150) each, and 30 measured values: quantiles of N(1, 0.5)."""
    rng = np.random.default_rng(4)
    mu = rng.normal(1.0, 0.1, (2, 150))
    sigma = rng.normal(0.5, 0.03, (2, 150))
    observed = 1 + 0.5 * stats.norm.ppf((np.arange(30) + 0.5) / 30)
    return SimpleNamespace(mu=mu, sigma=sigma, observed=observed)


@pytest.fixture(scope="session")
def build(known: SimpleNamespace) -> Callable[..., pm.Model]:
    """How to build a normal population of unknown mean and standard deviation."""

    def model_of(propagation: Propagation, response: Any = same) -> pm.Model:
        return one_input(known.observed, prb.AreaMetric(), propagation, response, sigma=2)

    return model_of


@pytest.fixture(scope="session")
def optimum(build: Callable[..., pm.Model]) -> prb.Optimum:
    return prb.minimize(build(prb.Reweighted(1024)), starts=0)


@pytest.fixture(scope="session")
def posterior(known: SimpleNamespace) -> xr.DataTree:
    """Draws that are known, with statistics: three stages of one chain, two of the other."""
    nan = np.nan
    stages = {
        "beta": [[1e-3, 0.1, 1.0], [2e-3, 1.0, nan]],
        "accept_rate": [[0.2, 0.3, 0.4], [0.5, 0.6, nan]],
        "log_marginal_likelihood": [[nan, nan, -3.0], [nan, -4.0, nan]],
    }
    draws = {"mu": (("chain", "draw"), known.mu), "sigma": (("chain", "draw"), known.sigma)}
    coords = {"chain": [0, 1], "draw": np.arange(150)}
    statistics = {name: (("chain", "stage"), np.array(rows)) for name, rows in stages.items()}
    return xr.DataTree.from_dict(
        {
            "posterior": xr.Dataset(draws, coords=coords),
            "sample_stats": xr.Dataset(statistics, coords={"chain": [0, 1]}),
        }
    )


@pytest.fixture(scope="session")
def pair() -> SimpleNamespace:
    """Two normal outputs with correlation .8, whose population is known; one picture of each kind.

    Of 25 specimens two lack the second output, and one has failed there.
    """
    calls = []

    def response(a: Any, b: Any) -> Any:
        calls.append(np.size(a))
        return np.stack([a, 0.8 * a + 0.6 * b + 5], axis=-1)

    rng = np.random.default_rng(3)
    observed = response(*rng.normal([[2.0], [0.0]], 1.0, (2, 25)))
    observed[:2, 1], observed[2, 1] = np.nan, np.inf
    coords, units = {"frequency": ["first", "second"]}, {"units": "Hz"}
    data = xr.DataArray(observed, dims=("specimen", "frequency"), coords=coords, attrs=units)
    with pm.Model() as model:
        mu = pm.Normal("mu", 1.9, 1.0)
        inputs = pm.Normal.dist(mu, 1.0), pm.Normal.dist(0.0, 1.0)
        given: Any = {"metric": prb.Joint(prb.ProbabilityResidual()), "observed": data}
        prb.Simulator("frame", response, *inputs, propagation=prb.Reweighted(4096), **given)
    tree = posterior_of(mu=rng.normal(2.0, 0.01, (2, 50)))

    @cache
    def drawn() -> Any:
        return prb.plots.plot_outputs(tree, model=model)

    return SimpleNamespace(
        model=model,
        posterior=tree,
        observed=observed,
        mean=np.array([2.0, 6.6]),
        covariance=np.array([[1.0, 0.8], [0.8, 1.0]]),
        drawn=drawn,
        calls=lambda: sum(calls),
    )


@pytest.fixture(scope="session")
def comparison(optimum: prb.Optimum, posterior: xr.DataTree) -> xr.Dataset:
    return prb.compare({"optimum": optimum, "draws": posterior}, model=optimum.model)


@pytest.fixture(scope="session")
def pictures(
    optimum: prb.Optimum, posterior: xr.DataTree, comparison: xr.Dataset, pair: SimpleNamespace
) -> dict[str, Callable[..., Any]]:
    """Return every plot with a legend or a panel for each result, by name."""
    model = optimum.model
    return {
        "responses": lambda **k: prb.plots.plot_responses(posterior, model=model, **k),
        "ecdf": lambda **k: prb.plots.plot_responses(optimum, ecdf=True, **k),
        "outputs": lambda **k: prb.plots.plot_outputs(pair.posterior, model=pair.model, **k),
        "population": lambda **k: prb.plots.plot_population(posterior, model=model, **k),
        "posterior": lambda **k: prb.plots.plot_posterior(
            posterior, optimum=optimum, model=model, **k
        ),
        "optimizer": lambda **k: prb.plots.plot_optimizer(optimum, **k),
        "landscape": lambda **k: prb.plots.plot_landscape(optimum, n_points=21, **k),
        "curve": lambda **k: prb.plots.plot_landscape(optimum, var_names="sigma", n_points=21, **k),
        "stages": lambda **k: prb.plots.plot_stages(posterior, **k),
        "comparison": lambda **k: prb.plots.plot_comparison(comparison, **k),
        "scores": lambda **k: prb.plots.plot_comparison(comparison, scores=True, **k),
    }


@pytest.fixture(scope="session")
def drawn(pictures: dict[str, Callable[..., Any]]) -> Callable[[str], Any]:
    """How to get a picture, drawn once; it must not be changed."""

    @cache
    def draw(picture: str) -> Any:
        return pictures[picture]()

    return draw
