"""The population of an input is the closed form."""

from types import SimpleNamespace
from typing import Any

import figure_reader as read
import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
import xarray as xr
from one_input import posterior_of
from scipy import stats

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.model.margins import margins
from prbayes.model.parameters import unconstrained
from prbayes.plots.population import margin_densities


def test_the_population_is_the_closed_form(
    optimum: prb.Optimum, posterior: xr.DataTree, known: SimpleNamespace
) -> None:
    pc = prb.plots.plot_population(posterior, model=optimum.model, n_draws=300, prob=0.8)
    x, y = read.xy(pc, "after", "x")
    each = stats.norm.pdf(x, known.mu.reshape(-1, 1), known.sigma.reshape(-1, 1))
    np.testing.assert_allclose(y, each.mean(axis=0), atol=1e-9)
    some = slice(10, 240, 15)
    expected = np.quantile(each, [0.1, 0.9], axis=0)[:, some]
    np.testing.assert_allclose(read.sides(pc, "band", "x", x[some]), expected, atol=1e-6)
    x, y = read.xy(prb.plots.plot_population(optimum), "after", "x")
    np.testing.assert_allclose(
        y, stats.norm.pdf(x, optimum.point["mu"], optimum.point["sigma"]), atol=1e-9
    )


def correlated() -> pm.Model:
    def total(loads: Any, z: Any) -> Any:
        return loads.sum(axis=-1) + z

    with pm.Model() as model:
        mean = pm.Normal("mean", [1.0, 2.0, 0.0], 1.0, shape=3)
        rho = pm.Uniform("rho", -1, 1)
        covariance = [[1.0, 2 * rho, 0.0], [2 * rho, 4.0, 0.0], [0.0, 0.0, 1.0]]
        inputs = pm.MvNormal.dist(mean, pt.stacklists(covariance)), pm.Normal.dist(0, 1)
        given: Any = {"metric": prb.AreaMetric(), "observed": [1.0, 2.0, 3.0]}
        few = prb.Reweighted(64, emulator=None)
        prb.Simulator("y", total, *inputs, propagation=few, **given)
    return model


@pytest.mark.long
def test_a_multivariate_input_has_its_pairs() -> None:
    mean = np.tile([1.0, 2.0, 0.0], (1, 4, 1))
    posterior, model = posterior_of(mean=mean, rho=np.full((1, 4), 0.6)), correlated()
    pc = prb.plots.plot_population(posterior, model=model, prob=0.89)
    pairs = ["loads[1], loads[0]", "loads[2], loads[0]", "loads[2], loads[1]"]
    assert read.panels(pc, "region") == read.panels(pc, "half") == pairs
    # The ellipse of 89%: as far out as the root of a chi-square quantile, and as inclined.
    for name, share in (("region", 0.89), ("half", 0.5)):
        x, y = read.xy(pc, name, pairs[0])
        reach = np.sqrt(stats.chi2.ppf(share, 2))
        np.testing.assert_allclose([np.nanmax(x) - 1, 1 - np.nanmin(x)], reach, rtol=0.06)
        np.testing.assert_allclose([np.nanmax(y) - 2, 2 - np.nanmin(y)], 2 * reach, rtol=0.06)
        top = x[np.nanargmax(y)] - 1
        assert top == pytest.approx(0.6 * reach, abs=0.3 * reach)
    assert "correlation 0.6" in read.panel(pc, pairs[0]).get_title()
    coords = {"loads_dim_0": [0, 2]}
    some = prb.plots.plot_population(posterior, model=model, coords=coords)
    labels = [axis.get_label() for axis in some.axes]
    assert labels == ["loads[0]", "loads[2]", "z", "loads[2], loads[0]"]


def test_margins_without_a_density_of_their_own_are_drawn() -> None:
    with pm.Model() as model:
        mu = pm.HalfNormal("mu", 5.0)
        mean = pm.Normal.dist(mu, 0.6)
        x = pm.Normal.dist(mean, 0.8)
        n = pm.Poisson.dist(mu)
        given: Any = {"metric": prb.AreaMetric(), "observed": np.arange(9.0)}
        prb.Simulator("y", lambda x, n: x + n, x, n, propagation=prb.Fresh(50), **given)
    evaluator = Evaluator.of(model)
    found = margin_densities(
        evaluator, margins(evaluator), unconstrained(evaluator.hyperparameters, {"mu": 3.0})[None]
    )
    grid, y = found["x"]
    np.testing.assert_allclose(y[0], stats.norm.pdf(grid, 3, 1), atol=0.06)
    grid, y = found["n"]
    np.testing.assert_array_equal(grid, np.round(grid))
    np.testing.assert_allclose(y[0], stats.poisson.pmf(grid, 3), atol=0.04)
