"""The population of an input is the closed form."""

from types import SimpleNamespace

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
import xarray as xr
from scipy import stats

import prbayes as prb


def test_the_population_is_the_closed_form(
    optimum: prb.Optimum, posterior: xr.DataTree, known: SimpleNamespace, read: SimpleNamespace
) -> None:
    pc = prb.plot_population(posterior, model=optimum.model, n_draws=300, prob=0.8)
    x, y = read.xy(pc, "after", "x")
    each = stats.norm.pdf(x, known.mu.reshape(-1, 1), known.sigma.reshape(-1, 1))
    np.testing.assert_allclose(y, each.mean(axis=0), atol=1e-9)
    some = slice(10, 240, 15)
    expected = np.quantile(each, [0.1, 0.9], axis=0)[:, some]
    np.testing.assert_allclose(read.sides(pc, "band", "x", x[some]), expected, atol=1e-6)
    x, y = read.xy(prb.plot_population(optimum), "after", "x")
    np.testing.assert_allclose(
        y, stats.norm.pdf(x, optimum.point["mu"], optimum.point["sigma"]), atol=1e-9
    )
    with pytest.raises(KeyError, match="got z, expected some of"):
        prb.plot_population(optimum, inputs=["z"])


def test_wrong_arguments_are_refused(optimum: prb.Optimum) -> None:
    with pytest.raises(TypeError, match="got int, expected an Optimum"):
        prb.plot_population(3, model=optimum.model)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"prob: got 1\.0"):
        prb.plot_population(optimum, prob=1.0)


def correlated() -> pm.Model:
    with pm.Model() as model:
        mean = pm.Normal("mean", [1.0, 2.0, 0.0], 1.0, shape=3)
        rho = pm.Uniform("rho", -1, 1)
        covariance = [[1.0, 2 * rho, 0.0], [2 * rho, 4.0, 0.0], [0.0, 0.0, 1.0]]
        x = pm.MvNormal.dist(mean, pt.stacklists(covariance))
        z = pm.Normal.dist(0, 1)
        prb.Simulator(
            "y",
            lambda loads, z: loads[..., 0] + loads[..., 1] + loads[..., 2] + z,
            x,
            z,
            metric=prb.AreaMetric(),
            observed=[1.0, 2.0, 3.0],
            propagation=prb.Reweighted(64, emulator=None),
        )
    return model


def test_a_multivariate_input_has_its_pairs(read: SimpleNamespace) -> None:
    draws = xr.Dataset(
        {
            "mean": (["chain", "draw", "mean_dim_0"], np.tile([1.0, 2.0, 0.0], (1, 4, 1))),
            "rho": (["chain", "draw"], np.full((1, 4), 0.6)),
        }
    )
    posterior = xr.DataTree.from_dict({"posterior": draws})
    pc = prb.plot_population(posterior, model=correlated(), prob=0.89)
    pairs = ["loads[1], loads[0]", "loads[2], loads[0]", "loads[2], loads[1]"]
    assert list(pc.viz["region"].data_vars) == list(pc.viz["half"].data_vars) == pairs
    # The ellipse of 89%: as far out as the root of a chi-square quantile, and as inclined.
    for name, share in (("region", 0.89), ("half", 0.5)):
        x, y = pc.viz[name][pairs[0]].item().get_data()
        reach = np.sqrt(stats.chi2.ppf(share, 2))
        np.testing.assert_allclose([np.nanmax(x) - 1, 1 - np.nanmin(x)], reach, rtol=0.06)
        np.testing.assert_allclose([np.nanmax(y) - 2, 2 - np.nanmin(y)], 2 * reach, rtol=0.06)
        top = x[np.nanargmax(y)] - 1
        assert top == pytest.approx(0.6 * reach, abs=0.3 * reach)
    titles = [axis.get_title() for axis in pc.viz["region"][pairs[0]].item().figure.axes]
    assert any("correlation 0.6" in title for title in titles)
    # One margin alone has no pair.
    alone = prb.plot_population(posterior, model=correlated(), inputs=["loads[0]"])
    assert "region" not in alone.viz
