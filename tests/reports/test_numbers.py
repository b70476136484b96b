"""Numbers and tables as text."""

from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from prbayes._display import p_digits, percentage
from prbayes._finding import counted
from prbayes.reports.numbers import (
    alike,
    cells,
    in_percent,
    number,
    places,
    plus_minus,
    rows_table,
    span,
)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.0, "1.000"),
        (0.0196512, "0.01965"),
        (-123456.7, "-123457"),
        (1024.0, "1024"),
        (3, "3"),
        (np.int64(12345678), "12345678"),
        (True, "yes"),
        (np.False_, "no"),
        (np.float32(0.5), "0.5000"),
        (1.23456e-9, "1.235e-09"),
        (1e-4, "0.0001000"),
        (4.2e9, "4.200e+09"),
        (np.nan, "\u2013"),
        (0.0, "0"),
        (-np.inf, "-∞"),
        ("a", "a"),
        (None, "\u2013"),
        (9.99996, "10.000"),
    ],
)
def test_numbers(value: Any, text: str) -> None:
    assert number(value) == text


@pytest.mark.parametrize(
    ("value", "sd", "text"),
    [
        (1.1494, 0.0532, "1.149 ± 0.053"),
        (210_345.0, 1234.0, "210345 ± 1234"),
        (0.5, 0.0996, "0.50 ± 0.10"),
        (2.0, np.nan, "2.000"),
        (1.0, np.inf, "1.000 ± ∞"),
        (-0.0001, 0.1, "-0.00 ± 0.10"),
    ],
)
def test_estimates_have_the_decimals_of_their_spread(value: float, sd: float, text: str) -> None:
    assert plus_minus(value, sd) == text


def test_decimals_of_a_spread() -> None:
    assert [places(sd) for sd in (123.0, 12.3, 1.23, 0.0123)] == [0, 1, 2, 4]
    assert places(0.0996, 2) == 2, "rounded it is 0.10"
    assert [places(sd) for sd in (0.0, -1.0, np.nan, np.inf, 1e8, 1e-8)] == [None] * 6


def test_numbers_alike() -> None:
    assert alike((1.23456, 0.1, -2.0), 0.0123) == ["1.2346", "0.1000", "-2.0000"]
    assert alike((np.nan, np.inf, 3e7), 0.5) == ["\u2013", "∞", "3.000e+07"]
    assert alike((1.23456,), np.nan) == ["1.235"]
    assert alike((-0.0,), 1.0) == ["0.00"], "no sign before nothing"


def test_words_around_numbers() -> None:
    assert [counted(n, "draw") for n in (1, 2, 0)] == ["1 draw", "2 draws", "0 draws"]
    assert span(np.array([3, 4, 3]), ".0f") == "3 to 4"
    assert span(np.array([3.01, 3.02]), ".1f") == "3.0"
    assert (percentage(0.05), percentage(0.001), percentage(0.995)) == ("5%", "0.1%", "99.5%")
    assert [in_percent(p) for p in (0.99996, 1.0, 1e-6)] == ["over 99.99%", "100%", "under 0.001%"]
    digits = [p_digits(p, 0.05) for p in (0.0496, 0.05, 0.0504, 0.05001, 0.3, 1e-9)]
    assert digits == [2, 2, 3, 4, 2, 2], "one that rounds to alpha and is larger shows it"


def test_decimal_points_stand_in_line() -> None:
    table = cells(pd.DataFrame({"x": ["1.5", "10.25", "3", "\u2013"], "s": ["a", "b", "c", "d"]}))
    assert table.numeric == (True, False)
    padded = [r[0] for r in table.aligned()]
    assert padded == ["1.5\u2007", "10.25", "3\u2008\u2007\u2007", "\u2013"]
    table = cells(pd.DataFrame({"x": [1e-9, 2.5]}))
    assert [r[0] for r in table.aligned()] == ["1.000e-09", "2.500"]


def test_named_indices_become_columns() -> None:
    frame = pd.DataFrame({"x": [1, 2]}, index=pd.Index(["a", "b"], name="who"))
    assert cells(frame).header == ("who", "x")
    assert cells(frame.rename_axis(None)).header == ("", "x")
    assert cells(frame.reset_index(drop=True)).header == ("x",)
    assert cells(pd.DataFrame({"x": []})).rows == ()


def test_tables_of_xarray() -> None:
    data = xr.Dataset({"E": ("batch", [70.1, 71.25])}, {"batch": ["A", "B"]})
    assert cells(data).header == ("batch", "E")
    assert cells(data).rows == (("A", "70.10"), ("B", "71.25"))
    assert cells(data["E"]).rows == cells(data).rows
    assert cells(data["E"].rename(None)).header == ("batch", "value")
    assert cells(data.mean()).rows == (("70.67",),)


def test_columns_in_which_no_row_has_anything_are_left_out() -> None:
    rows = [{"a": 1, "b": None, "c": "", "d": np.nan}, {"a": None, "b": None, "c": "", "d": np.nan}]
    assert list(rows_table(rows).columns) == ["a", "d"]
    (_, row) = cells(rows_table([{"a": "1", "89%": "2"}, {"a": "3", "99%": "4"}])).rows
    assert row == ("3", "\u2013", "4"), "rows of several kinds"
    assert list(rows_table([{"zero": 0, "empty": ""}]).columns) == ["zero"]
    assert cells(rows_table([{"n": 3, "s": None}, {"n": None, "s": "x"}])).rows[1][1] == "x"


def test_estimates_and_percentages_count_as_numbers() -> None:
    texts = {"e": ["1.2 ± 0.3", "2.0 ± ∞"], "p": ["5%", "\u2013"], "n": ["\u2013", "\u2013"]}
    assert cells(pd.DataFrame(texts)).numeric == (True, True, False)
