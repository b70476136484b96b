"""Numbers and tables as text."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from prbayes._display import View
from prbayes._validate import Names, wrong_type

NOTHING = "\u2013"  # an en dash, as printed tables have it where there is no number

# powers of ten between which numbers have no exponent: the lower end is that of Python's "g"; the
# upper end keeps loads in newtons and cycles to failure readable
_SMALLEST, _LARGEST = -4, 7


def number(value: Any, digits: int = 4) -> str:
    """Return the text of a value; that of a float has ``digits`` significant digits."""
    if value is None:
        return NOTHING
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if not isinstance(value, float | np.floating):
        return str(value)
    x = float(value)
    if math.isnan(x):
        return NOTHING
    if math.isinf(x):
        return "∞" if x > 0 else "-∞"
    if x == 0:
        return "0"
    magnitude = math.floor(math.log10(abs(x)))
    if not _SMALLEST <= magnitude < _LARGEST:
        return f"{x:.{digits - 1}e}"
    if x == round(x) and magnitude >= digits - 1:
        return f"{x:.0f}"
    return f"{x:.{max(0, digits - 1 - magnitude)}f}"


def places(sd: float, digits: int = 3) -> int | None:
    """Return the number of decimals that show ``digits`` digits of a spread.

    None if the spread is no positive number, or one that has an exponent.
    """
    if not (math.isfinite(sd) and sd > 0):
        return None
    # The spread is rounded first, because 0.0996 with two digits is 0.10, which has two decimals.
    magnitude = math.floor(math.log10(float(f"{sd:.{digits - 1}e}")))
    # A spread a hundred times smaller than its value is still written without an exponent.
    if not _SMALLEST - 2 <= magnitude < _LARGEST:
        return None
    return max(0, digits - 1 - magnitude)


def alike(values: Iterable[float], sd: float, digits: int = 3) -> list[str]:
    """Return numbers of one unit with the decimals that their spread warrants."""
    decimals = places(sd, digits)
    texts = []
    for value in map(float, values):
        if decimals is None or not math.isfinite(value) or abs(value) >= 10**_LARGEST:
            texts.append(number(value))
        else:
            texts.append(f"{value + 0.0:.{decimals}f}")  # The sum turns -0.0 into 0.0.
    return texts


def plus_minus(value: float, sd: float) -> str:
    """Return an estimate with its spread, such as '1.145 ± 0.046'."""
    if math.isnan(sd):
        return number(float(value))
    return " ± ".join(alike((value, sd), sd, 2))


def finite_sd(y: Any) -> float:
    """Return the standard deviation of finite values, or NaN if there are fewer than two."""
    finite = y[np.isfinite(y)]
    return float(finite.std(ddof=1)) if finite.size > 1 else math.nan


def in_percent(p: float, floor: float = 1e-5) -> str:
    """Return a probability with two digits, such as '0.47%'; near zero or one as such."""
    if 0 < p < floor:
        return f"under {100 * floor:g}%"
    digits = 4 if p > 0.99 else 2
    percent = float(f"{100 * p:.{digits}g}")
    return "over 99.99%" if p < 1 and percent == 100 else f"{percent:g}%"


def span(values: Any, form: str) -> str:
    """Return the smallest and the largest number as a range, or one if their texts are equal."""
    low = f"{values.min():{form}}"
    high = f"{values.max():{form}}"
    return low if low == high else f"{low} to {high}"


def enumerated(items: list[str]) -> str:
    """Return items with commas and 'and'."""
    *first, last = items
    return f"{', '.join(first)} and {last}" if first else last


def described(y: Any) -> dict[str, Any]:
    """Return counts, range, mean and spread of an output; NaN was not measured, +inf failed."""
    measured = y[~np.isnan(y)]
    finite = measured[np.isfinite(measured)]
    failed = measured.size - finite.size
    missing = y.size - measured.size
    sd = finite_sd(y)
    moments = [math.nan] * 3
    if finite.size:
        moments = [float(finite.min()), float(finite.max()), float(finite.mean())]
    low, high, mean, spread = alike((*moments, sd), sd)
    return {
        "N": measured.size,
        "failed": str(failed) if failed else "",
        "missing": str(missing) if missing else "",
        "smallest": low,
        "largest": high,
        "mean": mean,
        "sd": spread,
    }


def with_zeros(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows with a zero for no failures and no missing values, if another row has some."""
    for key in ("failed", "missing"):
        if any(row[key] for row in rows):
            rows = [row | {key: row[key] or "0"} for row in rows]
    return rows


# -- tables ----------------------------------------------------------------------------------

_NUMBER = re.compile(r"-?\d*\.?\d+(e[-+]?\d+)?%?|-?∞")  # all that `number` and `alike` write


@dataclass(frozen=True)
class Cells:
    """A table as text."""

    header: Names
    rows: tuple[Names, ...]
    numeric: tuple[bool, ...]  # whether a column consists of numbers

    def aligned(self) -> tuple[Names, ...]:
        """Return the rows with spaces after numbers that align decimal points."""
        # A figure space is as wide as a digit, a punctuation space as a point (Unicode, 6.2).
        digit, point = "\u2007", "\u2008"
        columns = []
        for column, numeric in zip(zip(*self.rows, strict=True), self.numeric, strict=True):
            decimals = [len(cell.partition(".")[2]) for cell in column]
            if numeric and max(decimals) and not any("e" in cell for cell in column):
                padded = []
                for cell, n in zip(column, decimals, strict=True):
                    spaces = ("" if "." in cell else point) + digit * (max(decimals) - n)
                    padded.append(cell if cell == NOTHING else cell + spaces)
                column = tuple(padded)
            columns.append(column)
        return tuple(zip(*columns, strict=True))


def cells(table: Any) -> Cells:
    """Return a table of pandas or xarray as text, or raise a `TypeError` if it is none."""
    if isinstance(table, xr.DataArray):
        table = table.to_dataset(name=table.name or "value")
    if isinstance(table, xr.Dataset):
        if table.dims:
            table = table.to_dataframe()
        else:  # pandas makes no table of numbers without a dimension.
            table = table.expand_dims("row").to_dataframe().reset_index(drop=True)
    if not (hasattr(table, "reset_index") and hasattr(table, "columns")):
        expected = "a pandas.DataFrame, xarray.Dataset or xarray.DataArray"
        raise wrong_type(table, "table", expected)
    # An unnamed index of integers only counts the rows.
    is_named = any(name is not None for name in table.index.names)
    is_unnamed_text = not is_named and table.index.dtype.kind not in "iu"
    if is_named or is_unnamed_text:
        table = table.reset_index()
    header = tuple(map(str, table.columns))
    if is_unnamed_text:
        header = ("", *header[1:])
    rows = tuple(tuple(map(number, row)) for row in table.itertuples(index=False, name=None))
    numeric = []
    for column in zip(*rows, strict=True) if rows else [()] * len(header):
        parts = [part for cell in column if cell != NOTHING for part in cell.split(" ± ")]
        numeric.append(bool(parts) and all(_NUMBER.fullmatch(part) for part in parts))
    return Cells(header, rows, tuple(numeric))


def rows_table(rows: list[dict[str, Any]]) -> Any:
    """Return a table without columns that are empty in every row, or None; NaN is not empty."""
    if not rows:
        return None
    keys = dict.fromkeys(key for row in rows for key in row)
    columns = {key: [row.get(key) for row in rows] for key in keys}
    return pd.DataFrame(
        {
            key: column
            for key, column in columns.items()
            if any(value not in (None, "") for value in column)
        }
    )


def view_table(shown: View) -> Any:
    """Return the rows of what a reader sees of a result, as a table."""
    return pd.DataFrame(shown.rows, columns=shown.header)


def correlation_table(names: Sequence[str], r: Any, digits: int) -> Any:
    """Return a matrix of correlations, (m, m), as a table; None for a single variable."""
    rows = []
    for i, name in enumerate(names if len(names) > 1 else ()):
        texts = [NOTHING if math.isnan(x) else f"{x + 0.0:.{digits}f}" for x in r[i]]
        texts[i] = "1"
        rows.append({"": name} | dict(zip(names, texts, strict=True)))
    return rows_table(rows)
