"""Arguments of a test in one form: conditions, specimens, what is refused."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

from prbayes.validation.conditions import read_case

DRAWS = np.arange(12.0).reshape(3, 4)


def test_one_condition_two_and_named_ones() -> None:
    one = read_case([1.0, 2.0], DRAWS)
    assert [c.name for c in one.conditions] == ["observed"]
    assert (one.size, one.n_specimens, one.draws) == (2, 2, 3)
    listed = read_case([[1.0, 2.0], [3.0]], [DRAWS, DRAWS])
    assert [c.name for c in listed.conditions] == ["0", "1"]
    assert (listed.size, listed.n_specimens, listed.shared) == (3, 3, False)
    # In the order of the predictions.
    named = read_case({"a": [1.0], "b": [2.0, 3.0]}, {"b": DRAWS, "a": DRAWS})
    assert [c.name for c in named.conditions] == ["b", "a"]
    assert named.conditions[0].observed.tolist() == [2.0, 3.0]


def test_specimens_are_counted_over_all_conditions() -> None:
    labels = {"a": [7, 8], "b": [8.0, 9.0]}
    case = read_case({"a": [1.0, 2.0], "b": [3.0, 4.0]}, {"a": DRAWS, "b": DRAWS}, labels)
    assert [c.numbers.tolist() for c in case.conditions] == [[0, 1], [1, 2]]
    assert (case.n_specimens, case.shared, case.dependent) == (3, True, True)
    assert case.conditions[1].specimens == ("8", "9")
    twice = read_case([1.0, 2.0], DRAWS, ["x", "x"])
    assert (twice.n_specimens, twice.shared, twice.dependent) == (1, False, True)
    assert read_case([1.0], DRAWS).conditions[0].specimens == ("observed, 0",)


def test_predictions_have_their_name_dims_and_notes() -> None:
    array = xr.DataArray(
        DRAWS.reshape(3, 1, 4),
        dims=("draw", "chain", "sample"),
        name="crack",
        attrs={"specimens_id": "x"},
    )
    condition = read_case([1.0], array).conditions[0]
    assert condition.name == "crack"
    assert condition.attributes["specimens_id"] == "x"
    np.testing.assert_array_equal(condition.predicted, DRAWS)
    # One population needs no axis of draws, several may have two.
    assert read_case([1.0], DRAWS[0]).draws == 1
    assert read_case([1.0], DRAWS.reshape(1, 3, 4)).draws == 3


def test_folded_values_are_the_distance_from_the_middle() -> None:
    u = np.array([0.0, 0.25, 0.5, 1.0])
    np.testing.assert_array_equal(read_case([1.0], DRAWS, folded=True).tested(u), [1, 0.5, 0, 1])
    np.testing.assert_array_equal(read_case([1.0], DRAWS).tested(u), u)


@pytest.mark.parametrize(
    ("observed", "predicted", "specimens", "match"),
    [
        ({"a": [1.0]}, {"a": DRAWS}, {"b": [1]}, r"specimens: got \['b'\], expected a mapping"),
        ({"a": [1.0]}, {"a": DRAWS}, [[1]], "specimens: got list, expected a mapping"),
        ([[1.0]], [DRAWS], [[1], [2]], "specimens: got 2 conditions, expected a list with the 1"),
        ([], [], None, "observed: got 0 conditions"),
        ([1.0, 2.0], DRAWS, [[1, 2]], r"specimens: got shape \(1, 2\), expected \(2,\)"),
        ([1.0, -np.inf], DRAWS, None, "got 1 NaN or -inf among 2 values"),
        ([1.0], np.array([-np.inf, 1.0]), None, "predicted: got -inf"),
        ([[1.0], [1.0]], [DRAWS, DRAWS[:2]], None, r"got \[3, 2\] draws for the conditions"),
    ],
)
def test_refusals(observed: Any, predicted: Any, specimens: Any, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        read_case(observed, predicted, specimens)
