"""What the outputs of a run are called, and how they are put together."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from prbayes.response.outputs import (
    SINGLE_OUTPUT,
    Outputs,
    in_order_of,
    is_missing,
    outputs_of_result,
    read_observed,
    relabelled,
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
    # Texts of numbers are no groups.
    for text in ("<247", "3,09", "> 3.4", "-1,5"):
        with pytest.raises(TypeError, match=rf"the text '{text}'.*to_numeric.*censored=") as caught:
            read_observed("y", pd.DataFrame({"life": [text, "1"]}))
        assert "group" not in str(caught.value)
    # Numbers may be objects.
    values, outputs = read_observed("y", table[["life"]].astype(object))
    assert values.tolist() == [1.0, 2.0]
    assert (outputs.event, outputs.keys) == ((), (("life", None),))


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


def test_values_of_specimens_are_matched_by_their_index():
    observed = pd.Series([10.0, 20.0, 30.0], index=["a", "b", "c"])
    other = pd.Series([3.0, 1.0, 2.0], index=["c", "a", "b"])
    assert in_order_of(other, observed, "w").tolist() == [1.0, 2.0, 3.0]
    array = xr.DataArray([3.0, 1.0, 2.0], dims="i", coords={"i": ["c", "a", "b"]})
    assert in_order_of(array, observed, "w").tolist() == [1.0, 2.0, 3.0]
    for plain in ([3.0, 1.0, 2.0], pd.Series([3.0, 1.0, 2.0]), None):  # without labels
        assert in_order_of(plain, observed, "w") is plain
    moved = pd.Series([10.0, 20.0, 30.0], index=[1, 2, 0])
    assert in_order_of(pd.Series([0.0, 1.0, 2.0]), moved, "w").tolist() == [1.0, 2.0, 0.0]
    with pytest.raises(ValueError, match=r"w: got .* \['x', .*expected .* \['a', .*to_numpy\(\)"):
        in_order_of(pd.Series([1.0, 2.0, 3.0], index=["x", "b", "c"]), observed, "w")
    mapping = {"p": observed, "q": other}
    assert in_order_of(other, mapping, "w").tolist() == [1.0, 2.0, 3.0]
    for outputs in (mapping, xr.Dataset({k: x.rename_axis("i") for k, x in mapping.items()})):
        assert in_order_of(other, outputs, "w").tolist() == [1.0, 2.0, 3.0]
        values, labels = read_observed("y", outputs)
        assert values.tolist() == [[10.0, 1.0], [20.0, 2.0], [30.0, 3.0]]
        assert labels.names == ("p", "q")


@pytest.mark.parametrize(
    ("observed", "match"),
    [
        (
            ["9.1", "9,81", "8.3"],
            "dtype <U4, expected real numbers; the value at index 1 is .*'9,81'",
        ),
        (pd.Series([9.1, "n/a"]), "the value at index 1 is the text 'n/a'"),
        (["9.1", "8.3"], "the value at index 0 is the text '9.1'"),
        (pd.DataFrame({"f": ["9.1", "9,81"]}), r"columns \['f'\] .*index 1 is the text '9,81'"),
        (
            {"f": np.array(["1", "?"])},
            r"observed\['f'\]: got .* the value at index 1 is the text '\?'",
        ),
    ],
)
def test_the_first_text_that_is_no_number_is_named(observed, match):
    with pytest.raises(TypeError, match=match):
        read_observed("y", observed)


def test_labels_are_kept_where_values_change():
    series = pd.Series([1.0, 2.0], index=["q", "p"])
    assert relabelled(np.array([3.0, 4.0]), series).to_dict() == {"q": 3.0, "p": 4.0}
    frame = pd.DataFrame(TABLE, columns=["q", "p"])
    assert relabelled(2 * TABLE, frame).equals(2 * frame)
    array = xr.DataArray([1.0, 2.0], dims="out", coords={"out": ["q", "p"]})
    assert relabelled(np.array([3.0, 4.0]), array).sel(out="p") == 4.0
    # Of another shape, and without labels.
    assert relabelled(TABLE, array) is TABLE
    assert relabelled(TABLE, TABLE + 1) is TABLE
