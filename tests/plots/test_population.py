"""The population of an input is the closed form."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from scipy import stats

import prbayes as prb


def test_the_population_is_the_closed_form(
    optimum: prb.Optimum, posterior: xr.DataTree, known: SimpleNamespace, read: SimpleNamespace
) -> None:
    pc = prb.plot_population(
        posterior, model=optimum.model, draws=300, level=0.8, backend="matplotlib"
    )
    x, y = read.xy(pc, "after", "x")
    each = stats.norm.pdf(x, known.mu.reshape(-1, 1), known.sigma.reshape(-1, 1))
    np.testing.assert_allclose(y, each.mean(axis=0), atol=1e-9)
    some = slice(10, 240, 15)
    expected = np.quantile(each, [0.1, 0.9], axis=0)[:, some]
    np.testing.assert_allclose(read.sides(pc, "band", "x", x[some]), expected, atol=1e-6)
    x, y = read.xy(prb.plot_population(optimum, backend="matplotlib"), "after", "x")
    np.testing.assert_allclose(
        y, stats.norm.pdf(x, optimum.point["mu"], optimum.point["sigma"]), atol=1e-9
    )
    with pytest.raises(KeyError, match="got z, expected some of"):
        prb.plot_population(optimum, inputs=["z"])


def test_wrong_arguments_are_refused(optimum: prb.Optimum) -> None:
    with pytest.raises(TypeError, match="got int, expected an Optimum"):
        prb.plot_population(3, model=optimum.model)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"level: got 1\.0"):
        prb.plot_population(optimum, level=1.0)
