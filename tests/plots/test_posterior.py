"""The posterior of each hyperparameter stands against optimum and prior."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy import stats

import prbayes as prb


def test_the_posterior_stands_against_the_optimum(
    optimum: prb.Optimum, posterior: xr.DataTree, known: SimpleNamespace, read: SimpleNamespace
) -> None:
    pc = prb.plots.plot_posterior(posterior, optimum=optimum, model=optimum.model, prob=0.8)
    for name, draws in (("mu", known.mu), ("sigma", known.sigma)):
        x, y = read.xy(pc, "posterior", name)
        expected = stats.norm.pdf(x, draws.mean(), draws.std())
        np.testing.assert_allclose(y, expected, atol=0.25 * expected.max())
        assert np.trapezoid(y, x) == pytest.approx(1, abs=0.02)
        np.testing.assert_allclose(read.xy(pc, "interval", name)[0], np.quantile(draws, [0.1, 0.9]))
        np.testing.assert_allclose(read.xy(pc, "mean", name)[0], draws.mean())
        center, error = optimum.point[name], optimum.stderr[name]
        np.testing.assert_allclose(read.xy(pc, "optimum", name)[0], center)
        np.testing.assert_allclose(
            read.xy(pc, "stderr", name)[0], center + error * np.array([-1.2816, 1.2816]), rtol=1e-4
        )
        x, y = read.xy(pc, "normal", name)
        np.testing.assert_allclose(y, stats.norm.pdf(x, center, error))
        visuals = ("interval", "mean", "stderr", "optimum")
        rows = {visual: float(read.xy(pc, visual, name)[1, 0]) for visual in visuals}
        assert 0 > rows["interval"] == rows["mean"] > rows["stderr"] == rows["optimum"]
        assert min(pc.viz["plot"][name].item().get_yticks()) == 0
    x, y = read.xy(pc, "prior", "sigma")
    np.testing.assert_allclose(y, stats.halfnorm.pdf(x, scale=2), atol=0.06)


def test_a_posterior_alone(optimum: prb.Optimum, posterior: xr.DataTree) -> None:
    pc = prb.plots.plot_posterior(posterior)
    assert not {"optimum", "normal", "prior"} & set(pc.viz.children)
    blind = replace(optimum, stderr={"mu": np.inf, "sigma": np.nan})
    pc = prb.plots.plot_posterior(posterior, optimum=blind)
    assert "optimum" in pc.viz
    assert "normal" not in pc.viz


def test_some_of_the_variables(posterior: xr.DataTree) -> None:
    draws = np.random.default_rng(0).normal(size=(1, 50, 2))
    many = posterior.posterior.to_dataset().isel(chain=[0], draw=slice(50))
    many["rate"] = (["chain", "draw", "supplier"], draws)
    many = many.assign_coords(supplier=["Adler", "Busch"])
    tree = xr.DataTree.from_dict({"posterior": many})

    def drawn(var_names: Any) -> list[str]:
        return list(prb.plots.plot_posterior(tree, var_names=var_names).viz["posterior"])

    assert drawn(["rate"]) == ["rate[Adler]", "rate[Busch]"]
    assert drawn("mu") == ["mu"]
    assert drawn(["rate[Busch]", "mu"]) == ["mu", "rate[Busch]"]
    with pytest.raises(KeyError, match=r"var_names: got \['nu'\], expected some of \['mu'"):
        drawn(["mu", "nu"])
    with pytest.raises(KeyError, match="var_names: got none"):
        drawn([])


def test_a_packed_factor_is_drawn_where_it_is_asked_for() -> None:
    rng = np.random.default_rng(0)
    sizes = {"chol": 3, "chol_stds": 2, "chol_corr": 1}
    draws = {
        name: (["chain", "draw", f"{name}_dim"], rng.normal(size=(1, 50, size)))
        for name, size in sizes.items()
    }
    tree = xr.DataTree.from_dict({"posterior": xr.Dataset(draws)})
    drawn = list(prb.plots.plot_posterior(tree).viz["posterior"])
    assert drawn == ["chol_stds[0]", "chol_stds[1]", "chol_corr[0]"]
    drawn = list(prb.plots.plot_posterior(tree, var_names="chol").viz["posterior"])
    assert drawn == ["chol[0]", "chol[1]", "chol[2]"]


def test_a_constant_posterior_is_refused(posterior: xr.DataTree) -> None:
    constant = xr.DataTree.from_dict({"posterior": posterior["posterior"].to_dataset() * 0})
    with pytest.raises(ValueError, match=r"got a posterior of \['mu', 'sigma'\]"):
        prb.plots.plot_posterior(constant)
