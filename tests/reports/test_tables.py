"""Tables as text."""

from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from prbayes.reports.tables import cells, rows_table


def test_decimal_points_stand_in_line() -> None:
    table = cells(pd.DataFrame({"x": ["1.5", "10.25", "3", "\u2013"], "s": ["a", "b", "c", "d"]}))
    assert table.numeric == (True, False)
    padded = [r[0] for r in table.aligned()]
    assert padded == ["1.5\u2007", "10.25", "3\u2008\u2007\u2007", "\u2013"]


def test_numbers_with_an_exponent_are_not_padded() -> None:
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


@pytest.mark.parametrize("table", [[1, 2], np.ones(3), "text", {"a": [1]}])
def test_what_is_no_table_is_refused(table: Any) -> None:
    with pytest.raises(TypeError, match=r"expected a pandas\.DataFrame"):
        cells(table)


def test_columns_in_which_no_row_has_anything_are_left_out() -> None:
    rows = [{"a": 1, "b": None, "c": "", "d": np.nan}, {"a": None, "b": None, "c": "", "d": np.nan}]
    assert list(rows_table(rows).columns) == ["a", "d"]
    assert list(rows_table([{"zero": 0, "empty": ""}]).columns) == ["zero"]
    assert cells(rows_table([{"n": 3, "s": None}, {"n": None, "s": "x"}])).rows[1][1] == "x"


def test_estimates_and_percentages_count_as_numbers() -> None:
    texts = {"e": ["1.2 ± 0.3", "2.0 ± ∞"], "p": ["5%", "\u2013"], "n": ["\u2013", "\u2013"]}
    assert cells(pd.DataFrame(texts)).numeric == (True, True, False)
