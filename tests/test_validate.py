import re
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import xarray as xr

from prbayes._validate import (
    called,
    observed_sample,
    positive_integer,
    positive_number,
    real_array,
    refuse_single_precision,
    sample_weights,
    seed_number,
    share,
    simulated_sample,
)

NAN, INF = np.nan, np.inf


@pytest.mark.parametrize(
    "values",
    [
        [1, 2],
        (1.0, 2.0),
        np.array([1, 2], dtype=np.int8),
        np.array([1, 2], dtype=np.uint64),
        np.array([1, 2], dtype=np.float32),
        np.array([1, 2], dtype=np.longdouble),
        np.array([Fraction(1), 2.0], dtype=object),
        xr.DataArray([1.0, 2.0], dims="specimen"),
        np.array([2.0, 1.0])[::-1],
    ],
    ids=lambda v: f"{type(v).__name__}-{getattr(v, 'dtype', '')}",
)
@pytest.mark.parametrize("check", [real_array, observed_sample, simulated_sample])
def test_every_kind_of_real_numbers_becomes_float64(check: Callable[..., Any], values: Any) -> None:
    array = check(values, "values")
    assert type(array) is np.ndarray
    assert array.dtype == np.float64
    np.testing.assert_array_equal(array, [1.0, 2.0])


NOT_REAL = {
    "booleans": ([True, False], "got an array of dtype bool, expected real numbers"),
    "a boolean in objects": (np.array([True, "a"], dtype=object), "dtype object, expected real"),
    "texts of numbers": (np.array(["1.0", 2], dtype=object), "dtype object, expected real"),
    "complex": ([1 + 2j, 0], "got complex numbers, expected real ones"),
    "complex in objects": (
        np.array([1j, "a"], dtype=object),
        "array of dtype object, expected real numbers",
    ),
    "strings": (["1.0", "two"], "got an array of dtype <U3, expected real numbers"),
    "one string": ("strength", "got str 'strength', expected real numbers"),
    "bytes": (b"12", "got bytes b'12', expected real numbers"),
    "dates": (
        np.array(["2024-01-01"], dtype="datetime64[D]"),
        r"dtype datetime64\[D\], expected real",
    ),
    "durations": (np.array([1], dtype="timedelta64[s]"), r"dtype timedelta64\[s\], expected real"),
    "dictionary": ({"a": 1.0}, "got dict .*expected real numbers"),
    "ragged": ([[1.0, 2.0], [3.0]], "got a ragged sequence, expected a regular array"),
}


@pytest.mark.parametrize("case", sorted(NOT_REAL))
@pytest.mark.parametrize(
    "check",
    [real_array, observed_sample, simulated_sample, lambda v, name: sample_weights(v, 2, name)],
)
def test_what_is_not_real_is_a_type_error_with_name(check: Callable[..., Any], case: str) -> None:
    values, match = NOT_REAL[case]
    with pytest.raises(TypeError, match=f"^load: .*{match}"):
        check(values, "load")


def test_missing_values_in_a_list_are_not_taken_for_numbers() -> None:
    with pytest.raises(
        ValueError, match=r"observed: got 1 NaN or infinite among 3 values.*leave missing"
    ):
        observed_sample([1.0, None, 2.0])
    with pytest.raises(ValueError, match="simulated: got NaN or -inf"):
        simulated_sample([1.0, None])
    with pytest.raises(ValueError, match="observed: got masked values, expected none"):
        observed_sample(np.ma.masked_equal([1.0, -999.0, 2.0], -999.0))


@pytest.mark.parametrize(
    ("values", "match"),
    [
        (3.0, r"shape \(\), expected one dimension, \(N,\)"),
        (np.ones((2, 3)), r"shape \(2, 3\), expected one dimension.*one Simulator each"),
        ([], "got no values, expected at least 1"),
        (np.ones((0, 2)), r"shape \(0, 2\)"),
        ([1.0, NAN, 2.0], "got 1 NaN or infinite among 3 values"),
        (
            [INF, -INF, 2.0, NAN],
            "got 3 NaN or infinite among 4 values.*leave missing specimens out",
        ),
    ],
)
def test_observed_values_are_one_dimensional_and_finite(values: Any, match: str) -> None:
    with pytest.raises((TypeError, ValueError), match=f"^strain: .*{match}"):
        observed_sample(values, "strain")


@pytest.mark.parametrize(("n", "got"), [(0, "no values"), (1, "one value,")])
def test_observed_values_can_have_a_minimum_number(n: int, got: str) -> None:
    with pytest.raises(ValueError, match=f"observed: got {got}.*at least 2"):
        observed_sample(np.zeros(n), minimum=2)
    assert observed_sample([0.0, 1.0], minimum=2).size == 2


@pytest.mark.parametrize("shape", [(1,), (4,), (2, 3), (2, 3, 4)])
def test_simulated_values_keep_their_batch_and_failed_specimens(shape: tuple[int, ...]) -> None:
    values = np.random.default_rng(1).normal(size=shape)
    values[..., -1] = INF
    np.testing.assert_array_equal(simulated_sample(values), values)


@pytest.mark.parametrize(
    ("values", "match"),
    [
        (1.0, r"shape \(\), expected \(..., n\)"),
        ([], r"shape \(0,\)"),
        (np.ones((3, 0)), r"shape \(3, 0\)"),
        ([[0.0, 1.0], [NAN, 1.0]], r"NaN or -inf.*failed is \+inf"),
        ([0.0, -INF], "NaN or -inf.*left out with weight"),
    ],
)
def test_simulated_values_need_a_last_axis_without_nan(values: Any, match: str) -> None:
    with pytest.raises(ValueError, match=f"^simulated: .*{match}"):
        simulated_sample(values)


@pytest.mark.parametrize("shape", [(5,), (2, 5), (2, 3, 5)])
@pytest.mark.parametrize("factor", [1e-200, 1.0, 3, 1e200])
def test_weights_sum_to_one_along_the_last_axis_in_proportion(
    shape: tuple[int, ...], factor: float
) -> None:
    raw = np.random.default_rng(2).integers(0, 9, shape) + np.eye(5)[0]
    weights = sample_weights(factor * raw, 5)
    np.testing.assert_allclose(weights.sum(axis=-1), 1.0, rtol=1e-14)
    np.testing.assert_allclose(weights, raw / raw.sum(axis=-1, keepdims=True), rtol=1e-14)


def test_no_weights_are_equal_weights_and_the_input_is_left_alone() -> None:
    np.testing.assert_array_equal(sample_weights(None, 4), np.full(4, 0.25))
    raw = np.array([1.0, 3.0])
    np.testing.assert_array_equal(sample_weights(raw, 2), [0.25, 0.75])
    np.testing.assert_array_equal(raw, [1.0, 3.0])


@pytest.mark.parametrize(
    ("weights", "match"),
    [
        (0.5, r"shape \(\), expected \(..., 3\)"),
        ([1.0, 1.0], r"shape \(2,\), expected \(..., 3\), one weight per value"),
        (np.ones((3, 2)), r"shape \(3, 2\), expected \(..., 3\)"),
        ([1.0, -1e-9, 1.0], "negative or non-finite"),
        ([1.0, NAN, 1.0], "negative or non-finite"),
        ([1.0, INF, 1.0], "negative or non-finite"),
        ([0.0, 0.0, 0.0], "sum to zero, expected a positive sum"),
        ([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], "sum to zero"),
    ],
)
def test_wrong_weights(weights: Any, match: str) -> None:
    with pytest.raises(ValueError, match=f"^weights: .*{match}"):
        sample_weights(weights, 3)


@pytest.mark.parametrize("value", [1, 2.5, np.float32(0.5), np.int64(3), 5e-324])
def test_positive_number_gives_a_float(value: Any) -> None:
    result = positive_number(value, "h")
    assert type(result) is float
    assert result == value


@pytest.mark.parametrize("value", [0, 0.0, -1, -1e-300, NAN, INF, np.float64(-2)])
def test_positive_number_refuses(value: Any) -> None:
    with pytest.raises(
        ValueError, match=f"^h: got {re.escape(repr(value))}, expected a positive finite"
    ):
        positive_number(value, "h")


@pytest.mark.parametrize("value", ["1", None, True, 1j, [1.0], np.ones(1), np.True_])
def test_positive_number_refuses_other_types(value: Any) -> None:
    with pytest.raises(
        TypeError, match=f"^h: got {type(value).__name__} .*expected a positive finite number"
    ):
        positive_number(value, "h")


def test_positive_integer_has_a_minimum() -> None:
    assert positive_integer(1, "bins") == 1
    assert type(positive_integer(np.int32(7), "bins", minimum=7)) is int
    for value, minimum in ((0, 1), (-3, 1), (6, 7)):
        with pytest.raises(
            ValueError, match=f"^bins: got {value}, expected an integer >= {minimum}"
        ):
            positive_integer(value, "bins", minimum=minimum)


@pytest.mark.parametrize("value", [2.0, "2", None, True, np.float64(2)])
def test_positive_integer_refuses_other_types(value: Any) -> None:
    with pytest.raises(
        TypeError, match=f"^bins: got {type(value).__name__} .*expected an integer >= 1"
    ):
        positive_integer(value, "bins")


def test_a_share_is_between_zero_and_one() -> None:
    assert share(np.float32(0.5), "level") == 0.5
    for value in (0.0, 1, 1.5, -0.2, np.nan, np.inf):
        with pytest.raises(ValueError, match=r"level: got .*, expected a number between 0 and 1"):
            share(value, "level")
    for other in (True, "0.5", None, [0.5]):
        with pytest.raises(TypeError, match=r"level: got .*, expected a number between 0 and 1"):
            share(other, "level")


def test_every_seed_that_pymc_takes_becomes_an_integer() -> None:
    assert seed_number(3) == seed_number(np.int64(3)) == 3
    assert (
        seed_number([1, 2])
        == seed_number((1, 2))
        == seed_number(np.array([1, 2]))
        != seed_number([2, 1])
    )
    a, b = np.random.default_rng(5), np.random.default_rng(5)
    first = seed_number(a)
    assert first == seed_number(b)
    assert seed_number(a) != first
    assert seed_number(np.random.RandomState(1)) == seed_number(np.random.RandomState(1))
    assert seed_number(None) != seed_number(None)


@pytest.mark.parametrize("value", [True, -1, 1.5, "1", [], [1, -2], [0.5], np.bool(True), object()])
def test_what_is_no_seed_is_refused(value: Any) -> None:
    with pytest.raises(
        (TypeError, ValueError), match=r"run: random_seed: got .*, expected an integer >= 0"
    ):
        seed_number(value, "run: random_seed")


def test_single_precision_is_refused() -> None:
    refuse_single_precision("model", "float64")
    with pytest.raises(
        TypeError, match=r"model: got hyperparameters of float32, expected float64.*floatX"
    ):
        refuse_single_precision("model", "float32")


def test_an_argument_is_told_on_one_line() -> None:
    told = called(xr.DataArray([1.0, 2.0], dims="specimen"))
    assert told.startswith("DataArray <xarray.DataArray (specimen: 2)>")
    assert "\n" not in told
    assert called(2.5) == "float 2.5"
    assert called(float) == "the class float"
