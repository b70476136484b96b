"""How numbers are written."""

from typing import Any

import numpy as np
import pytest

from prbayes.reports.numbers import (
    alike,
    counted,
    number,
    percentage,
    places,
    plus_minus,
    shown,
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
    assert (counted(1, "draw"), counted(2, "draw"), counted(0, "draw")) == (
        "1 draw",
        "2 draws",
        "0 draws",
    )
    assert [shown(s) for s in (0.04, 9.94, 9.95, 123.4)] == ["0.0", "9.9", "10", "123"]
    assert span(np.array([3, 4, 3]), ".0f") == "3 to 4"
    assert span(np.array([3.01, 3.02]), ".1f") == "3.0"
    assert (percentage(0.05), percentage(0.001)) == ("5%", "0.1%")
