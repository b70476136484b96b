"""The picture of specimens shows the draws and readings."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from prbayes.plots import plot_individuals


def tree(width: int) -> xr.DataTree:
    """Return 200 draws of three specimens, and readings of some outputs."""
    rng = np.random.default_rng(0)
    draws = ("chain", "draw", "specimen")
    x = rng.normal([3.0, 1.0, 2.0], 0.1, (2, 100, 3))
    y = rng.normal(0, 1, (2, 100, 3, width))
    outputs = {"time": np.arange(width) / 2}
    return xr.DataTree.from_dict(
        {
            "posterior": xr.Dataset({"k": (draws, x)}),
            "posterior_predictive": xr.Dataset({"y": ((*draws, "time"), y)}, outputs),
            "observed_data": xr.Dataset({"y": (("specimen", "time"), y[0, 0])}, outputs),
            "constant_data": xr.Dataset({"load": ("specimen", [5.0, 7.0, 6.0])}),
        }
    )


def test_specimens_and_readings(read: SimpleNamespace) -> None:
    data = tree(2)
    pc = plot_individuals(data, prob=0.8)
    offsets = pc.viz["mean"]["k"].item().get_offsets()
    mean = data["posterior"]["k"].mean(("chain", "draw")).values
    np.testing.assert_allclose(offsets[:, 1], np.sort(mean))
    _, y = pc.viz["interval"]["k"].item().get_data()
    low, high = data["posterior"]["k"].quantile([0.1, 0.9], ("chain", "draw")).values
    np.testing.assert_allclose(y[0::3], low[np.argsort(mean)])
    np.testing.assert_allclose(y[1::3], high[np.argsort(mean)])
    assert sorted(pc.viz["observed"].data_vars) == ["y[0.0]", "y[0.5]"]
    places = pc.viz["observed"]["y[0.5]"].item().get_offsets()
    np.testing.assert_allclose(places[:, 0], [5.0, 7.0, 6.0])
    np.testing.assert_allclose(places[:, 1], data["observed_data"]["y"][:, 1])


def test_a_curve_has_one_panel() -> None:
    data = tree(8)
    pc = plot_individuals(data, prob=0.8)
    assert list(pc.viz["observed"].data_vars) == ["y"]
    x, y = pc.viz["median"]["y"].item().get_data()
    np.testing.assert_allclose(x, np.arange(8) / 2)
    expected = data["posterior_predictive"]["y"].median(("chain", "draw", "specimen"))
    np.testing.assert_allclose(y, expected)


def test_another_tree_is_refused() -> None:
    with pytest.raises(TypeError, match="expected the DataTree"):
        plot_individuals(xr.DataTree())
