"""Tables of pandas and xarray as text, with decimal points in line."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import xarray as xr

from prbayes.reports.numbers import NOTHING, number

_NUMBER = re.compile(r"-?\d*\.?\d+(e[-+]?\d+)?%?|-?∞")  # all that `number` and `alike` write
# A figure space is as wide as a digit, a punctuation space as a point (Unicode, chapter 6.2).
_DIGIT_WIDE, _POINT_WIDE = "\u2007", "\u2008"


@dataclass(frozen=True)
class Cells:
    """A table as text."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: tuple[bool, ...]  # which columns hold numbers

    def aligned(self) -> tuple[tuple[str, ...], ...]:
        """Return the rows with spaces after numbers, so that decimal points stand in line."""
        columns = []
        for column, numeric in zip(zip(*self.rows, strict=True), self.numeric, strict=True):
            columns.append(_padded(column) if numeric else column)
        return tuple(zip(*columns, strict=True))


def cells(table: Any) -> Cells:
    """Return a table of pandas or xarray as text.

    Raises
    ------
    TypeError
        If it is no table.
    """
    frame = _frame(table)
    # An index of plain numbers that nobody named only counts the rows.
    named = any(name is not None for name in frame.index.names)
    shows_index = named or frame.index.dtype.kind not in "iu"
    unnamed = shows_index and frame.index.names == [None]
    if shows_index:
        frame = frame.reset_index()
    header = tuple(map(str, frame.columns))
    if unnamed:
        header = ("", *header[1:])
    rows = tuple(
        tuple(number(value) for value in row) for row in frame.itertuples(index=False, name=None)
    )
    columns = list(zip(*rows, strict=True)) if rows else [()] * len(header)
    numeric = tuple(_is_numeric(column) for column in columns)
    return Cells(header, rows, numeric)


def rows_table(rows: list[dict[str, Any]]) -> Any:
    """Return a table without the columns in which no row has anything; NaN is something."""
    pandas: Any = import_module("pandas")
    columns = {}
    for key in rows[0]:
        column = [row[key] for row in rows]
        if any(value not in (None, "") for value in column):
            columns[key] = column
    return pandas.DataFrame(columns)


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
    known = [cell for cell in column if cell != NOTHING]
    parts = [part for cell in known for part in cell.split(" ± ")]
    return bool(parts) and all(_NUMBER.fullmatch(part) for part in parts)


def _padded(column: Sequence[str]) -> Sequence[str]:
    """Return numbers with spaces after them, as wide as the decimals that others have more."""
    if any("e" in cell for cell in column):
        return column
    decimals = [len(cell.partition(".")[2]) for cell in column]
    most = max(decimals)
    if not any("." in cell for cell in column):
        return column
    padded = []
    for cell, own in zip(column, decimals, strict=True):
        point = "" if "." in cell else _POINT_WIDE
        padded.append(cell if cell == NOTHING else cell + point + _DIGIT_WIDE * (most - own))
    return padded
