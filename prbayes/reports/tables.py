"""Tables of pandas and xarray as text, with aligned decimal points."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import xarray as xr

from prbayes.reports.numbers import NOTHING, number

_NUMBER = re.compile(r"-?\d*\.?\d+(e[-+]?\d+)?%?|-?∞")  # all that `number` and `alike` write


@dataclass(frozen=True)
class Cells:
    """A table as text."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: tuple[bool, ...]  # which columns hold numbers

    def aligned(self) -> tuple[tuple[str, ...], ...]:
        """Return the rows with spaces after numbers that align decimal points."""
        columns = []
        for column, numeric in zip(zip(*self.rows, strict=True), self.numeric, strict=True):
            columns.append(_padded(column) if numeric else column)
        return tuple(zip(*columns, strict=True))


def cells(table: Any) -> Cells:
    """Return a table of pandas or xarray as text, or raise a `TypeError` if it is none."""
    frame = _frame(table)
    # An unnamed index of integers only counts the rows.
    is_named = any(name is not None for name in frame.index.names)
    is_unnamed_text = not is_named and frame.index.dtype.kind not in "iu"
    if is_named or is_unnamed_text:
        frame = frame.reset_index()
    header = tuple(map(str, frame.columns))
    if is_unnamed_text:
        header = ("", *header[1:])
    rows = tuple(tuple(map(number, row)) for row in frame.itertuples(index=False, name=None))
    columns = zip(*rows, strict=True) if rows else [()] * len(header)
    return Cells(header, rows, tuple(map(_is_numeric, columns)))


def rows_table(rows: list[dict[str, Any]]) -> Any:
    """Return a table without columns that are empty in every row; NaN is not empty."""
    pandas: Any = import_module("pandas")
    columns = {key: [row[key] for row in rows] for key in rows[0]}
    return pandas.DataFrame(
        {
            key: column
            for key, column in columns.items()
            if any(value not in (None, "") for value in column)
        }
    )


def _frame(table: Any) -> Any:
    """Return a table of any kind as one of pandas."""
    if isinstance(table, xr.DataArray):
        table = table.to_dataset(name=table.name or "value")
    if isinstance(table, xr.Dataset):
        if table.dims:
            return table.to_dataframe()
        single = table.expand_dims("row")  # pandas makes no table of numbers without a dimension
        return single.to_dataframe().reset_index(drop=True)
    if hasattr(table, "reset_index") and hasattr(table, "columns"):
        return table
    raise TypeError(
        f"table: got {type(table).__name__}, "
        "expected a pandas.DataFrame, xarray.Dataset or xarray.DataArray"
    )


def _is_numeric(column: Sequence[str]) -> bool:
    parts = [part for cell in column if cell != NOTHING for part in cell.split(" ± ")]
    return bool(parts) and all(_NUMBER.fullmatch(part) for part in parts)


def _padded(column: Sequence[str]) -> Sequence[str]:
    """Return numbers with spaces in the place of decimals that only longer ones have."""
    if any("e" in cell for cell in column) or not any("." in cell for cell in column):
        return column
    # A figure space is as wide as a digit, a punctuation space as a point (Unicode, chapter 6.2).
    digit, point = "\u2007", "\u2008"
    decimals = [len(cell.partition(".")[2]) for cell in column]
    padded = []
    for cell, n in zip(column, decimals, strict=True):
        space = ("" if "." in cell else point) + digit * (max(decimals) - n)
        padded.append(cell if cell == NOTHING else cell + space)
    return padded
