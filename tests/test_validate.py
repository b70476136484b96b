"""Validation of arguments: what is taken, and what is refused with the name of the argument."""

import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from prbayes._validate import (
    called,
    executes,
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
        (1.0, 2.0),
        np.array([1, 2], dtype=np.uint64),
        np.array([1, 2], dtype=np.longdouble),
        np.array([Fraction(1), 2.0], dtype=object),
        xr.DataArray([1.0, 2.0], dims="specimen"),
        np.array([2.0, 1.0])[::-1],
    ],
    ids=lambda v: f"{type(v).__name__}-{getattr(v, 'dtype', '')}",
)
def test_every_kind_of_real_numbers_becomes_float64(values: Any) -> None:
    for check in (real_array, observed_sample, simulated_sample):
        array = check(values, "values")
        assert type(array) is np.ndarray
        assert array.dtype == np.float64
        np.testing.assert_array_equal(array, [1.0, 2.0])


def test_missing_numbers_of_pandas_are_nan() -> None:
    values = pd.Series([1.0, None]).convert_dtypes()
    for given in (values, list(values), values.astype(object)):
        np.testing.assert_array_equal(real_array(given, "load"), [1.0, NAN])
    table = pd.DataFrame({"a": values, "b": values})
    np.testing.assert_array_equal(real_array(table, "load"), [[1.0, 1.0], [NAN, NAN]])


@pytest.mark.parametrize(
    ("values", "match"),
    [
        ([True, False], "got an array of dtype bool, expected real numbers"),
        (np.array([True, "a"], dtype=object), "dtype object, expected real"),
        (np.array(["1.0", 2], dtype=object), "dtype object, expected real"),
        (np.array([1j, "a"], dtype=object), "dtype object, expected real numbers"),
        ([1 + 2j, 0], "got complex numbers, expected real ones"),
        (["1.0", "two"], "got an array of dtype <U3, expected real numbers"),
        ("strength", "got str 'strength', expected real numbers"),
        (b"12", "got bytes b'12', expected real numbers"),
        (np.array(["2024-01-01"], dtype="datetime64[D]"), r"dtype datetime64\[D\], expected real"),
        (np.array([1], dtype="timedelta64[s]"), r"dtype timedelta64\[s\], expected real"),
        ({"a": 1.0}, "got dict .*expected real numbers"),
        ([[1.0, 2.0], [3.0]], "got a ragged sequence, expected a regular array"),
    ],
)
def test_what_is_not_real_is_a_type_error_with_name(values: Any, match: str) -> None:
    for check in (real_array, observed_sample, simulated_sample):
        with pytest.raises(TypeError, match=f"^load: .*{match}"):
            check(values, "load")


OBSERVED: list[tuple[Any, str]] = [
    (3.0, r"shape \(\), expected one dimension, \(N,\)"),
    (np.ones((2, 3)), r"shape \(2, 3\), expected one dimension.*one Simulator each"),
    ([], "got no values, expected at least 2"),
    ([1.0], "got one value, expected at least 2"),
    ([1.0, None, 2.0], "got 1 NaN or infinite among 3 values.*leave out missing"),
    ([INF, -INF, 2.0, NAN], "got 3 NaN or infinite among 4 values.*leave out missing specimens"),
    (np.ma.masked_equal([1.0, -9.0, 2.0], -9.0), r"got 1 NaN .* \(NaN or masked\)"),
]
SIMULATED: list[tuple[Any, str]] = [
    (1.0, r"shape \(\), expected \(..., n\)"),
    (np.ones((3, 0)), r"shape \(3, 0\)"),
    ([[0.0, 1.0], [NAN, 1.0]], r"NaN or -inf.*\+inf is a specimen that failed"),
    ([0.0, -INF], "NaN or -inf.*leave out other points"),
]
WEIGHTS: list[tuple[Any, str]] = [
    (0.5, r"shape \(\), expected \(..., 3\)"),
    (np.ones((3, 2)), r"shape \(3, 2\), expected \(..., 3\), one weight per value"),
    ([1.0, -1e-9, 1.0], "negative or non-finite"),
    ([1.0, INF, 1.0], "negative or non-finite"),
    ([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], "sum to zero, expected a positive sum"),
]


@pytest.mark.parametrize(
    ("check", "values", "match"),
    [
        *((lambda v, name: observed_sample(v, name, minimum=2), *case) for case in OBSERVED),
        *((simulated_sample, *case) for case in SIMULATED),
        *((lambda v, name: sample_weights(v, 3, name), *case) for case in WEIGHTS),
    ],
)
def test_samples_and_weights_are_refused(
    check: Callable[[Any, str], Any], values: Any, match: str
) -> None:
    with pytest.raises(ValueError, match=f"^strain: .*{match}"):
        check(values, "strain")


@pytest.mark.parametrize("shape", [(1,), (4,), (2, 3, 4)])
def test_simulated_values_keep_their_batch_and_failed_specimens(shape: tuple[int, ...]) -> None:
    values = np.random.default_rng(1).normal(size=shape)
    values[..., -1] = INF
    np.testing.assert_array_equal(simulated_sample(values), values)


@pytest.mark.parametrize("shape", [(5,), (2, 3, 5)])
@pytest.mark.parametrize("factor", [1e-200, 3, 1e200])
def test_weights_sum_to_one_along_the_last_axis_in_proportion(
    shape: tuple[int, ...], factor: float
) -> None:
    raw = np.random.default_rng(2).integers(0, 9, shape) + np.eye(5)[0]
    given = factor * raw
    weights = sample_weights(given, 5)
    np.testing.assert_allclose(weights, raw / raw.sum(axis=-1, keepdims=True), rtol=1e-14)
    np.testing.assert_array_equal(given, factor * raw)
    np.testing.assert_array_equal(sample_weights(None, 4), np.full(4, 0.25))


@pytest.mark.parametrize(
    ("check", "expected", "good", "wrong", "other"),
    [
        (
            positive_number,
            "a positive finite number",
            [1, 2.5, np.float32(0.5), np.int64(3), 5e-324],
            [0, 0.0, -1e-300, NAN, INF, np.float64(-2)],
            ["1", None, True, 1j, [1.0], np.ones(1), np.True_],
        ),
        (
            positive_integer,
            "an integer >= 1",
            [1, np.int32(7)],
            [0, -3],
            [2.0, "2", None, True, np.float64(2)],
        ),
        (
            share,
            "a number between 0 and 1",
            [np.float32(0.5), 1e-9],
            [0.0, 1, 1.5, -0.2, NAN, INF],
            [True, "0.5", None, [0.5]],
        ),
    ],
)
def test_numbers(
    check: Any, expected: str, good: list[Any], wrong: list[Any], other: list[Any]
) -> None:
    for value in good:
        assert check(value, "h") == value
        assert type(check(value, "h")) is (int if check is positive_integer else float)
    for error, values in ((ValueError, wrong), (TypeError, other)):
        for value in values:
            got = re.escape(repr(value)) if error is ValueError else type(value).__name__
            with pytest.raises(error, match=f"^h: got {got}.*, expected {expected}"):
                check(value, "h")


def test_an_integer_has_a_minimum() -> None:
    assert positive_integer(7, "bins", minimum=7) == 7
    with pytest.raises(ValueError, match=r"^bins: got 6, expected an integer >= 7"):
        positive_integer(6, "bins", minimum=7)


def test_every_seed_that_pymc_takes_becomes_an_integer() -> None:
    assert seed_number(3) == seed_number(np.int64(3)) == 3
    assert seed_number([1, 2]) == seed_number((1, 2)) == seed_number(np.array([1, 2]))
    assert seed_number([1, 2]) != seed_number([2, 1])
    assert seed_number([3]) == seed_number(np.array([3])) == 3  # as in NumPy
    a, b = np.random.default_rng(5), np.random.default_rng(5)
    first = seed_number(a)
    assert first == seed_number(b) != seed_number(a)
    assert seed_number(np.random.RandomState(1)) == seed_number(np.random.RandomState(1))
    assert seed_number(None) != seed_number(None)
    for value in (True, -1, 1.5, "1", [], [1, -2], [0.5], np.bool(True), object()):
        with pytest.raises(
            (TypeError, ValueError), match=r"seed: got .*, expected an integer >= 0"
        ):
            seed_number(value, "seed")


def test_single_precision_is_refused() -> None:
    refuse_single_precision("model", "float64")
    with pytest.raises(
        TypeError, match=r"got hyperparameters of float32, expected float64.*floatX"
    ):
        refuse_single_precision("model", "float32")


class _Lookalike:
    """An object with the methods of an executor, whose futures are of another kind."""

    def submit(self, *work: Any) -> Any:
        """Return no future."""

    def map(self, *work: Any) -> Any:
        """Return no results."""


class _DaskClient(_Lookalike):
    def get_executor(self) -> Any:
        """Return no executor."""


@pytest.mark.parametrize(
    ("value", "advice"),
    [
        (_DaskClient(), r"its get_executor\(pure=False\)"),
        (_Lookalike(), r"ProcessPoolExecutor\(4\)"),
        (ThreadPoolExecutor, r"ProcessPoolExecutor\(4\)"),
        (4, r"ProcessPoolExecutor\(4\)"),
    ],
    ids=["Dask client", "lookalike", "class", "number"],
)
def test_what_is_no_executor_is_refused(value: Any, advice: str) -> None:
    with pytest.raises(TypeError, match=f"executor: .*a concurrent.futures.Executor, .* {advice}"):
        executes(value)


def test_an_argument_is_told_on_one_line() -> None:
    text = called(xr.DataArray([1.0, 2.0], dims="specimen"))
    assert text.startswith("DataArray <xarray.DataArray (specimen: 2)>")
    assert "\n" not in text
    assert (called(2.5), called(float)) == ("float 2.5", "the class float")
