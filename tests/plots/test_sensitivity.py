"""What moves a decision quantity: a row for each factor."""

import figure_reader as read
import numpy as np
import pytest
import xarray as xr

import prbayes as prb


@pytest.fixture(scope="module")
def table() -> xr.Dataset:
    factor = ["mu", "sigma", "x"]
    columns = {
        "first": [0.7, 0.2, 1.0],
        "first_error": [0.02, 0.01, np.nan],
        "total": [0.8, 0.3, np.nan],
        "total_error": [0.03, 0.01, np.nan],
    }
    kinds = ("factor", ["hyperparameter", "hyperparameter", "input"])
    data = {key: ("factor", values) for key, values in columns.items()}
    return xr.Dataset(data, coords={"factor": factor, "kind": kinds})


def test_a_factor_has_a_row_with_two_errors(table: xr.Dataset) -> None:
    pc = prb.plots.plot_sensitivity(table, labels={"mu": "mean"})
    np.testing.assert_allclose(read.xy(pc, "first", "hyperparameter"), [[0.7, 0.2], [1.12, 0.12]])
    segments = [read.artist(pc, f"{x}_error", "hyperparameter") for x in ("first", "total")]
    np.testing.assert_allclose(segments[0].get_segments()[0][:, 0], [0.66, 0.74])
    np.testing.assert_allclose(segments[1].get_segments()[1][:, 0], [0.28, 0.32])
    axis = read.panel(pc, "hyperparameter")
    assert [t.get_text() for t in axis.get_yticklabels()] == ["mean", "sigma"]
    (axis,) = prb.plots.plot_sensitivity(table, var_names="~x").axes
    assert axis.get_label() == "hyperparameter"
