"""The picture of specimens shows the draws and readings."""

import figure_reader as read
import numpy as np
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


def test_specimens_and_readings() -> None:
    data = tree(2)
    pc = plot_individuals(data, prob=0.8)
    offsets = read.artist(pc, "mean", "k").get_offsets()
    mean = data["posterior"]["k"].mean(("chain", "draw")).values
    np.testing.assert_allclose(offsets[:, 1], np.sort(mean))
    y = np.array(read.artist(pc, "interval", "k").get_segments())[..., 1]
    sides = data["posterior"]["k"].quantile([0.1, 0.9], ("chain", "draw")).values
    np.testing.assert_allclose(y.T, sides[:, np.argsort(mean)])
    assert read.panels(pc, "observed") == ["y[0.0]", "y[0.5]"]
    places = read.artist(pc, "observed", "y[0.5]").get_offsets()
    np.testing.assert_allclose(places[:, 0], [5.0, 7.0, 6.0])
    np.testing.assert_allclose(places[:, 1], data["observed_data"]["y"][:, 1])


def test_a_curve_has_one_panel() -> None:
    data = tree(8)
    pc = plot_individuals(data, prob=0.8)
    assert read.panels(pc, "observed") == ["y"]
    x, y = read.xy(pc, "median", "y")
    np.testing.assert_allclose(x, np.arange(8) / 2)
    expected = data["posterior_predictive"]["y"].median(("chain", "draw", "specimen"))
    np.testing.assert_allclose(y, expected)


def test_some_specimens_and_outputs() -> None:
    coords = {"specimen": [0, 2], "time": 0.5}
    figure = plot_individuals(tree(2), coords=coords, var_names="y")
    assert [axis.get_label() for axis in figure.axes] == ["y[0.5]"]
    assert read.xy(figure, "observed", "y[0.5]")[0].tolist() == [5.0, 6.0]
