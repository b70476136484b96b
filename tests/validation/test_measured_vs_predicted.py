"""Measured and predicted values, one output and condition at a time."""

import numpy as np
import xarray as xr

from prbayes.validation.measured_vs_predicted import comparables


def test_outputs_and_what_was_not_measured() -> None:
    predicted = xr.DataArray(
        np.arange(24.0).reshape(1, 2, 4, 3), dims=("chain", "draw", "sample", "place")
    )
    measured = np.array([[1.0, np.nan, 3.0], [4.0, 5.0, np.inf]])
    found = comparables({"a/b": measured}, {"a/b": predicted}, "test")
    assert [one.name for one in found] == ["a∕b[0]", "a∕b[1]", "a∕b[2]"]  # noqa: RUF001
    assert [one.measured.tolist() for one in found] == [[1.0, 4.0], [5.0], [3.0, np.inf]]
    np.testing.assert_array_equal(found[1].predicted, predicted.values[0, :, :, 1])


def test_weights_leave_out_what_is_not_known() -> None:
    values = np.array([[1.0, np.nan, 2.0, np.inf], [1.0, 2.0, 3.0, 4.0]])
    predicted = xr.DataArray(values[None], dims=("chain", "draw", "sample"), name="y")
    (one,) = comparables([1.0], predicted, "test")
    np.testing.assert_allclose(one.weights, [[1 / 3, 0, 1 / 3, 1 / 3], [0.25] * 4])


def test_of_many_outputs_some_are_shown() -> None:
    predicted = xr.DataArray(
        np.zeros((1, 1, 4, 30)), dims=("chain", "draw", "sample", "t"), name="curve"
    )
    found = comparables(np.zeros((2, 30)), predicted, "test")
    assert [one.name for one in found][:2] == ["curve[0]", "curve[4]"]
    assert len(found) == 8
    assert found[-1].name == "curve[29]"
