"""What a calibration has not seen, beside what it predicts."""

import figure_reader as read
import numpy as np
import pytest
import xarray as xr

import prbayes as prb

RNG = np.random.default_rng(5)
PREDICTED = xr.DataArray(
    RNG.normal(RNG.normal(0, 0.3, (2, 50, 1)), 1.0, (2, 50, 400)),
    dims=("chain", "draw", "sample"),
    name="later",
)
MEASURED = np.array([-1.0, 0.2, 0.4, 1.5])


def test_steps_and_curve_are_distribution_functions() -> None:
    pc = prb.plots.plot_prediction(MEASURED, PREDICTED)
    x, y = read.xy(pc, "measured", "later")
    for value, below, above in zip(
        MEASURED, (0, 0.25, 0.5, 0.75), (0.25, 0.5, 0.75, 1), strict=True
    ):
        assert set(y[x == value]) == {below, above}
    x, y = read.xy(pc, "predicted", "later")
    pooled = np.sort(PREDICTED.values.ravel())
    expected = np.searchsorted(pooled, x, side="right") / pooled.size
    np.testing.assert_allclose(y, expected, atol=1e-9)


def test_the_band_holds_its_share_of_the_populations() -> None:
    pc = prb.plots.plot_prediction(MEASURED, PREDICTED, prob=0.5)
    x, _ = read.xy(pc, "predicted", "later")
    at = x[[100, 128, 150]]
    low, high = read.sides(pc, "band", "later", at)
    shares = (PREDICTED.values.reshape(100, -1)[:, :, None] <= at).mean(axis=1)
    np.testing.assert_allclose(low, np.quantile(shares, 0.25, axis=0))
    np.testing.assert_allclose(high, np.quantile(shares, 0.75, axis=0))


def test_what_failed_and_what_is_missing() -> None:
    predicted = PREDICTED.copy()
    predicted[:, :, :40] = np.inf  # a tenth fails
    predicted[:, :, 40:80] = np.nan
    measured = np.append(MEASURED, [np.inf, np.nan])
    pc = prb.plots.plot_prediction(measured, predicted)
    assert read.xy(pc, "measured", "later")[1].max() == pytest.approx(0.8)
    assert read.xy(pc, "predicted", "later")[1].max() <= 1 - 40 / 360 + 1e-9
    title = read.panel(pc, "later").get_title()
    assert title == "5 measured values, 1 failed"


def test_conditions_and_outputs_have_panels() -> None:
    both = xr.concat([PREDICTED, 2 * PREDICTED], "part").transpose("chain", "draw", "sample", ...)
    both = both.assign_coords(part=["shaft", "disk"])
    measured = np.column_stack([MEASURED, 2 * MEASURED])
    data = {"cold": MEASURED, "hot": measured}, {"cold": PREDICTED, "hot": both}
    pc = prb.plots.plot_prediction(*data)
    assert read.panels(pc, "measured") == ["cold", "hot[shaft]", "hot[disk]"]
    disk = prb.plots.plot_prediction(*data, coords={"part": "disk"})
    assert read.panels(disk, "measured") == ["cold", "hot[disk]"]
    hot = prb.plots.plot_prediction(
        *data, var_names="o", filter_vars="like", coords={"part": ["shaft"]}
    )
    assert read.panels(hot, "measured") == ["cold", "hot[shaft]"]


def test_what_does_not_belong_together_is_refused() -> None:
    with pytest.raises(ValueError, match=r"got shape \(4, 2\), expected \(n\)"):
        prb.plots.plot_prediction(np.ones((4, 2)), PREDICTED)
    with pytest.raises(ValueError, match="expected a mapping with the conditions of predicted"):
        prb.plots.plot_prediction({"hot": MEASURED}, {"cold": PREDICTED})
