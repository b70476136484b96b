"""The posterior of each hyperparameter stands against optimum and prior."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import xarray as xr
from one_input import posterior_of
from scipy import stats

import prbayes as prb


def artist(pc: Any, visual: str, name: str, distribution: str) -> Any:
    return pc.viz[visual][name].sel(distribution=distribution).item()


def test_the_posterior_stands_against_the_optimum(
    optimum: prb.Optimum, posterior: xr.DataTree, known: SimpleNamespace
) -> None:
    pc = prb.plots.plot_posterior(posterior, optimum=optimum, model=optimum.model, prob=0.8)
    for name, draws in (("mu", known.mu), ("sigma", known.sigma)):
        x, y = artist(pc, "dist", name, "posterior").get_data()
        expected = stats.norm.pdf(x, draws.mean(), draws.std())
        np.testing.assert_allclose(y, expected, atol=0.25 * expected.max())
        assert np.trapezoid(y, x) == pytest.approx(1, abs=0.02)
        center, error = optimum.point[name], optimum.stderr[name]
        x, y = artist(pc, "dist", name, "optimum").get_data()
        np.testing.assert_allclose(y, stats.norm.pdf(x, center, error))
        intervals = {
            "posterior": (np.quantile(draws, [0.1, 0.9]), draws.mean()),
            "optimum": (center + error * np.array([-1.2816, 1.2816]), center),
        }
        rows = []
        for distribution, (ends, point) in intervals.items():
            x, y = artist(pc, "credible_interval", name, distribution).get_data()
            np.testing.assert_allclose(x, ends, rtol=1e-4)
            ((at, row),) = artist(pc, "point_estimate", name, distribution).get_offsets()
            assert at == pytest.approx(point)
            assert (y == row).all()
            rows.append(row)
        assert 0 > rows[0] > rows[1]
        assert artist(pc, "credible_interval", name, "prior") is None
    x, y = artist(pc, "dist", "sigma", "prior").get_data()
    np.testing.assert_allclose(y, stats.halfnorm.pdf(x, scale=2), atol=0.06)
    (legend,) = pc.viz["figure"].item().legends
    assert [text.get_text() for text in legend.get_texts()] == ["posterior", "optimum", "prior"]
    assert legend.get_title().get_text().startswith("80% intervals")


def test_a_posterior_alone(optimum: prb.Optimum, posterior: xr.DataTree) -> None:
    pc = prb.plots.plot_posterior(posterior)
    assert pc.data.distribution.values.tolist() == ["posterior"]
    blind = replace(optimum, stderr={"mu": np.inf, "sigma": np.nan})
    pc = prb.plots.plot_posterior(posterior, optimum=blind)
    assert artist(pc, "point_estimate", "mu", "optimum") is not None
    assert artist(pc, "dist", "mu", "optimum") is None


@pytest.mark.parametrize("backend", ["none", "plotly", "bokeh"])
def test_every_library_of_arviz_draws(
    backend: str, optimum: prb.Optimum, posterior: xr.DataTree
) -> None:
    if backend != "none":
        pytest.importorskip(backend)
    pc = prb.plots.plot_posterior(posterior, optimum=optimum, backend=backend, figsize=(8, 3))
    assert pc.backend == backend
    assert set(pc.viz["dist"]) == {"mu", "sigma"}


def test_some_of_the_variables(posterior: xr.DataTree) -> None:
    draws = np.random.default_rng(0).normal(size=(1, 50, 2))
    many = posterior.posterior.to_dataset().isel(chain=[0], draw=slice(50))
    many["rate"] = (["chain", "draw", "supplier"], draws)
    many = many.assign_coords(supplier=["Adler", "Busch"])
    tree = xr.DataTree.from_dict({"posterior": many})

    def drawn(var_names: Any) -> list[str]:
        return list(prb.plots.plot_posterior(tree, var_names=var_names).viz["dist"])

    assert drawn(["rate"]) == ["rate[Adler]", "rate[Busch]"]
    assert drawn("mu") == ["mu"]
    assert drawn(["rate[Busch]", "mu"]) == ["rate[Busch]", "mu"]
    adler = prb.plots.plot_posterior(tree, coords={"supplier": "Adler"}, labels={"mu": "MEAN"})
    assert list(adler.viz["dist"]) == ["mu", "sigma", "rate[Adler]"]
    assert adler.viz["plot"]["mu"].item().get_title() == "MEAN"


def test_a_packed_factor_is_drawn_where_it_is_asked_for() -> None:
    rng = np.random.default_rng(0)
    sizes = {"chol": 3, "chol_stds": 2, "chol_corr": 1}
    tree = posterior_of(**{name: rng.normal(size=(1, 50, size)) for name, size in sizes.items()})
    drawn = list(prb.plots.plot_posterior(tree).viz["dist"])
    assert drawn == ["chol_stds[0]", "chol_stds[1]", "chol_corr[0]"]
    drawn = list(prb.plots.plot_posterior(tree, var_names="chol").viz["dist"])
    assert drawn == ["chol[0]", "chol[1]", "chol[2]"]


def test_a_constant_posterior_is_refused(posterior: xr.DataTree) -> None:
    constant = xr.DataTree.from_dict({"posterior": posterior["posterior"].to_dataset() * 0})
    with pytest.raises(ValueError, match=r"got a posterior of \['mu', 'sigma'\]"):
        prb.plots.plot_posterior(constant)
