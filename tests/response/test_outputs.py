"""What the outputs of a run are called, and how they are put together."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from prbayes.response.outputs import (
    SINGLE_OUTPUT,
    Outputs,
    is_missing,
    outputs_of_result,
    read_observed,
)

TABLE = np.arange(6.0).reshape(3, 2)


def test_outputs_without_names_are_one_or_numbered():
    values, outputs = read_observed("y", [1.0, 2.0])
    assert values.tolist() == [1.0, 2.0]
    assert outputs == SINGLE_OUTPUT
    assert outputs.event == ()
    values, outputs = read_observed("y", np.ma.masked_array(TABLE, TABLE == 3.0))
    np.testing.assert_array_equal(np.isnan(values), TABLE == 3.0)
    assert outputs.names == ("0", "1")
    assert outputs.event == (2,)
    assert not outputs.keys


@pytest.mark.parametrize(
    "names", [["A", "B"], pd.Categorical(["A", "B"]), pd.to_datetime(["2020-01-01", "2020-01-02"])]
)
def test_a_column_of_no_numbers_is_named(names):
    table = pd.DataFrame({"supplier": names, "life": [1.0, 2.0]})
    with pytest.raises(TypeError, match=r"y: .*columns \['supplier'\] are no numbers.*group\('sup"):
        read_observed("y", table)
    # Numbers may be objects.
    values, outputs = read_observed("y", table[["life"]].astype(object))
    assert values.tolist() == [[1.0], [2.0]]
    assert outputs.labels == ("life",)


def test_a_data_array_tells_labels_and_units():
    array = xr.DataArray(
        TABLE,
        dims=("specimen", "quantity"),
        coords={"quantity": ["f", "a"], "units": ("quantity", ["Hz", "m"])},
    )
    _, outputs = read_observed("y", array)
    assert outputs == Outputs(("f", "a"), "quantity", (("f", None), ("a", None)), ("Hz", "m"))


def test_groups_of_a_mapping_are_numbered():
    values, outputs = read_observed("y", {"mode": TABLE, "mass": TABLE[:, 0]})
    assert outputs.names == ("mode[0]", "mode[1]", "mass")
    np.testing.assert_array_equal(values, np.column_stack([TABLE, TABLE[:, 0]]))
    result = {"mass": TABLE[:, 0], "mode": TABLE}
    np.testing.assert_array_equal(outputs.assembled(result), values)
    assert outputs_of_result(result, 1).names == ("mass", "mode[0]", "mode[1]")


@pytest.mark.parametrize(
    ("observed", "expected"),
    [
        ({1: [1.0, 2.0]}, "key 1, expected names"),
        ({"a": TABLE[None]}, r"\['a'\]: got shape \(1, 3, 2\)"),
        ({"a": [1.0, 2.0], "b": [1.0]}, r"\[2, 1\] values"),
        ({"a": ["x", "y"]}, r"\['a'\]: got .*dtype"),
    ],
)
def test_mappings_of_something_else_are_refused(observed, expected):
    with pytest.raises((TypeError, ValueError), match=expected):
        read_observed("y", observed)


def test_a_point_lacks_a_response_where_one_output_is_missing():
    assert is_missing(np.array([1.0, np.nan])).tolist() == [False, True]
    assert is_missing(np.array([[1.0, np.inf], [np.nan, 2.0]])).tolist() == [False, True]
