"""The predictive check shows percentiles of readings and of replicates by bins."""

import figure_reader as read
import numpy as np
import pytest
import xarray as xr

from prbayes.plots import plot_predictive_check, plot_residuals

TIMES = np.array([0.0, 1.0, 1.1, 5.0])


def tree() -> xr.DataTree:
    """Return 400 replicates of 60 subjects with two doses; readings grow with the dose."""
    rng = np.random.default_rng(0)
    draws = ("chain", "draw", "specimen")
    dose = np.repeat([1.0, 10.0], 30)
    mean = dose[:, None] * np.array([0.0, 2.0, 2.0, 1.0])
    y = mean * np.exp(rng.normal(0, 0.2, (1, 400, 60, 4))) + rng.normal(0, 0.01, (1, 400, 60, 4))
    observed = y[0, 0].copy()
    observed[5, 2] = np.nan
    outputs = {"time": TIMES}
    return xr.DataTree.from_dict(
        {
            "posterior": xr.Dataset({"k": (draws, rng.normal(size=(1, 400, 60)))}),
            "posterior_predictive": xr.Dataset({"y": ((*draws, "time"), y)}, outputs),
            "observed_data": xr.Dataset({"y": (("specimen", "time"), observed)}, outputs),
            "constant_data": xr.Dataset({"dose": ("specimen", dose)}),
        }
    )


def test_percentiles_of_bins() -> None:
    data = tree()
    figure = plot_predictive_check(data, bins=3, prob=0.8)
    y = data["observed_data"]["y"].values
    x, median = read.xy(figure, "measured 0.5", "y")
    np.testing.assert_allclose(x, [0.0, 1.0, 5.0])
    together = y[:, 1:3][np.isfinite(y[:, 1:3])]
    np.testing.assert_allclose(
        median, [np.median(y[:, 0]), np.median(together), np.median(y[:, 3])]
    )
    replicates = data["posterior_predictive"]["y"].values[0, :, :, 3]
    high = np.quantile(replicates, 0.95, axis=1)
    band = read.artist(figure, "band 0.95", "y").get_paths()[0].vertices
    at_end = band[np.isclose(band[:, 0], 5.0), 1]
    np.testing.assert_allclose([at_end.min(), at_end.max()], np.quantile(high, [0.1, 0.9]))


def test_a_corrected_check_removes_the_dose() -> None:
    figure = plot_predictive_check(tree(), bins=3, corrected=True)
    axis = figure.axes[0]
    assert axis.get_title() == "60 of 239 readings without prediction left out"
    points = read.artist(figure, "observed", "y").get_offsets()
    late = points[points[:, 0] == 5.0, 1]
    # Each reading has the median dose, and the scatter of 20 % alone.
    assert np.std(np.log(late)) == pytest.approx(0.2, abs=0.08)
    plain = read.artist(plot_predictive_check(tree(), bins=3), "observed", "y").get_offsets()
    assert np.std(np.log(plain[plain[:, 0] == 5.0, 1])) > 1


def test_a_condition_is_the_horizontal_axis_of_one_reading() -> None:
    data = tree().isel(time=1)
    figure = plot_predictive_check(data, labels={"dose": "dose in mg"})
    assert figure.axes[0].get_xlabel() == "dose in mg"
    assert read.xy(figure, "measured 0.05", "y")[0].tolist() == [1.0, 10.0]
    one_dose = plot_predictive_check(tree(), coords={"specimen": np.arange(30, 60)})
    assert read.artist(one_dose, "observed", "y").get_offsets().shape == (4 * 30, 2)
    alone = xr.DataTree.from_dict(
        {k: v for k, v in data.to_dict().items() if k != "/constant_data"}
    )
    with pytest.raises(ValueError, match="horizontal axis"):
        plot_predictive_check(alone)


def test_residuals_have_a_panel_for_each_axis() -> None:
    shape = (60, 4)
    values = np.random.default_rng(1).normal(size=(5, *shape))
    names = ("DV", "PRED", "IPRED", "IWRES", "CWRES")
    arrays = {k: (("specimen", "time"), v) for k, v in zip(names, values, strict=True)}
    data = xr.DataTree.from_dict({"y": xr.Dataset(arrays, {"time": TIMES})})
    figure = plot_residuals(data, labels={"time": "time in h"})
    titles = [axis.get_label() for axis in figure.axes]
    assert titles == ["y", "y, CWRES against PRED", "y, CWRES against time"]
    points = read.artist(figure, "residuals", "y, CWRES against time").get_offsets()
    np.testing.assert_allclose(points, np.stack([np.tile(TIMES, 60), values[4].ravel()], 1))
    assert figure.axes[2].get_xlabel() == "time in h"
    with pytest.raises(KeyError, match="no such"):
        plot_residuals(data, labels={"no such": "x"})
    name = "y, CWRES against time"
    some = plot_residuals(data, var_names=[name], coords={"time": [1.1, 5.0]})
    places = read.artist(some, "residuals", name).get_offsets()[:, 0]
    assert sorted(set(places.tolist())) == [1.1, 5.0]
