"""Sections of a report: data that every writer renders alike, and how numbers are written in them."""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

DIGITS = 4
_LARGEST_SVG = 500_000  # bytes; a picture with more elements is kept as pixels
_NUMBER = re.compile(r"-?\d*\.?\d+(e[-+]?\d+)?%?|-?∞")
NOTHING = "\u2013"  # a dash
_KINDS = ((b"\x89PNG\r\n", "png", "image/png"), (b"\xff\xd8\xff", "jpg", "image/jpeg"))


@dataclass(frozen=True, eq=False)
class Section:
    """One section of a `Report`: paragraphs, a table and a picture, each where given.

    Parameters
    ----------
    title : str
    text : str or sequence of str
        Paragraphs, as plain text.
    table : pandas.DataFrame, xarray.Dataset or xarray.DataArray, optional
        Numbers are written with four significant digits, text as it is; named indices become columns.
    picture : bytes or object with ``savefig``, optional
        SVG, PNG or JPEG; or a matplotlib figure or ArviZ ``PlotCollection``, which is saved at once, and left open.
    alt : str
        What the picture shows, for those who do not see it; needed with a picture.
    caption : str
        Below the picture.
    level : int
        2 for a section, 3 for a part of the section before it.

    Attributes
    ----------
    picture : bytes or None
    kind : str
        The ending of a file with the picture: "svg", "png" or "jpg".

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described.

    Examples
    --------
    >>> import pandas as pd, prbayes as prb
    >>> prb.Section("Material", "Steel, as delivered.", pd.DataFrame({"batch": ["A", "B"], "specimens": [11, 10]})).text
    ('Steel, as delivered.',)
    """

    title: str
    text: str | Sequence[str] = ()
    table: Any = None
    picture: Any = None
    alt: str = ""
    caption: str = ""
    level: int = 2

    def __post_init__(self) -> None:
        """Bring what was given into its one form."""
        if not isinstance(self.title, str) or not self.title.strip():
            raise TypeError(f"Section: title: got {self.title!r:.60}, expected a text")
        if self.level not in (2, 3):
            raise ValueError(f"Section: level: got {self.level!r}, expected 2, or 3 for a part of a section")
        paragraphs = (self.text,) if isinstance(self.text, str) else tuple(self.text)
        if not all(isinstance(p, str) for p in paragraphs):
            raise TypeError(f"Section {self.title!r}: text: got {self.text!r:.60}, expected a text or several")
        object.__setattr__(self, "text", tuple(p for p in paragraphs if p.strip()))
        if self.table is not None:
            cells(self.table)  # raises what is wrong with it now
        if self.picture is not None:
            if not self.alt.strip():
                raise ValueError(f"Section {self.title!r}: alt: got nothing, expected a sentence on what is seen")
            object.__setattr__(self, "picture", image(self.picture))

    @property
    def kind(self) -> str:
        """The ending of a file with the picture."""
        return _kind(self.picture)[0]

    @property
    def media_type(self) -> str:
        """The type of the picture for a data URI."""
        return _kind(self.picture)[1]


@dataclass(frozen=True)
class Cells:
    """A table as text.

    Attributes
    ----------
    header : tuple of str
    rows : tuple of tuple of str
    numeric : tuple of bool
        Which columns hold numbers.
    """

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: tuple[bool, ...]

    def aligned(self) -> tuple[tuple[str, ...], ...]:
        """Return the rows with spaces of a digit's width after numbers, so that decimal points stand in line."""
        columns = [
            _padded(column) if numeric else column
            for column, numeric in zip(zip(*self.rows, strict=True), self.numeric, strict=True)
        ]
        return tuple(zip(*columns, strict=True))


def cells(table: Any) -> Cells:
    """Return a table of pandas or xarray as text.

    Raises
    ------
    TypeError
        If it is no table.
    """
    if isinstance(table, xr.Dataset | xr.DataArray):
        named = table.to_dataset(name=table.name or "value") if isinstance(table, xr.DataArray) else table
        table = named.to_dataframe() if named.dims else named.expand_dims("row").to_dataframe().reset_index(drop=True)
    if not (hasattr(table, "reset_index") and hasattr(table, "columns")):
        got = type(table).__name__
        raise TypeError(f"table: got {got}, expected a pandas.DataFrame, xarray.Dataset or xarray.DataArray")
    named_index = any(name is not None for name in table.index.names) or table.index.dtype.kind not in "iu"
    frame = table.reset_index() if named_index else table
    unnamed = named_index and table.index.names == [None]
    header = tuple(map(str, frame.columns))
    header = ("", *header[1:]) if unnamed else header
    rows = tuple(tuple(number(value) for value in row) for row in frame.itertuples(index=False, name=None))
    columns = list(zip(*rows, strict=True)) if rows else [()] * len(header)
    return Cells(header, rows, tuple(_is_numeric(column) for column in columns))


def rows_table(rows: list[dict[str, Any]]) -> Any:
    """Return a table without the columns in which no row has anything; NaN is something."""
    pandas: Any = import_module("pandas")
    kept = [key for key in rows[0] if any(row[key] is not None and row[key] != "" for row in rows)]
    return pandas.DataFrame([{key: row[key] for key in kept} for row in rows])


def _is_numeric(column: Sequence[str]) -> bool:
    known = [c for c in column if c != NOTHING]
    return bool(known) and all(all(_NUMBER.fullmatch(part) for part in c.split(" ± ")) for c in known)


def _padded(column: Sequence[str]) -> list[str]:
    places = [len(cell.rpartition(".")[2]) if "." in cell else -1 for cell in column]
    most = max(places)
    if most < 0 or any("e" in cell for cell in column):
        return list(column)
    # A figure space is as wide as a digit, a punctuation space as a point.
    return [
        cell if cell == NOTHING else cell + ("\u2008" if p < 0 else "") + "\u2007" * (most - max(p, 0))
        for cell, p in zip(column, places, strict=True)
    ]


def number(value: Any, digits: int = DIGITS) -> str:
    """Return a number with so many significant digits, and anything else as its text."""
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return str(value)
    if not isinstance(value, float | np.floating):
        return NOTHING if value is None else str(value)
    x = float(value)
    if math.isnan(x):
        return NOTHING
    if math.isinf(x):
        return "∞" if x > 0 else "-∞"
    if x == 0:
        return "0"
    size = math.floor(math.log10(abs(x)))
    if not -4 <= size < 7:
        return f"{x:.{digits - 1}e}"
    if x == round(x) and size >= digits - 1:
        return f"{x:.0f}"
    return f"{x:.{max(0, digits - 1 - size)}f}"


def places(sd: float, digits: int = 3) -> int | None:
    """Return how many decimals show so many significant digits of a spread; None where fixed decimals do not suit."""
    if not (math.isfinite(sd) and sd > 0):
        return None
    size = math.floor(math.log10(float(f"{sd:.{digits - 1}e}")))
    return max(0, digits - 1 - size) if -6 <= size < 7 else None


def alike(values: Iterable[float], sd: float, digits: int = 3) -> list[str]:
    """Return numbers of one unit with the decimals that their spread warrants."""
    decimals = places(sd, digits)
    return [
        number(v) if decimals is None or not math.isfinite(v) or abs(v) >= 1e7 else f"{v + 0.0:.{decimals}f}"
        for v in map(float, values)
    ]


def plus_minus(value: float, sd: float) -> str:
    """Return an estimate with its spread, such as '1.145 ± 0.046'."""
    if math.isnan(sd):
        return number(float(value))
    return " ± ".join(alike((value, sd), sd, 2))


def image(picture: Any) -> bytes:
    """Return the bytes of a picture; those of a figure are the same each time.

    Raises
    ------
    TypeError, ValueError
        If it is neither bytes of a known kind nor a figure.
    """
    if isinstance(picture, bytes):
        _kind(picture)
        return picture
    if not hasattr(picture, "savefig"):
        raise TypeError(
            f"picture: got {type(picture).__name__}, expected bytes (SVG, PNG, JPEG) or a figure with savefig"
        )
    from matplotlib import rc_context  # heavy, and only needed for pictures

    with tempfile.TemporaryDirectory() as folder, rc_context({"svg.hashsalt": "prbayes", "svg.fonttype": "path"}):
        vector, pixels = Path(folder, "picture.svg"), Path(folder, "picture.png")
        picture.savefig(vector, bbox_inches="tight", metadata={"Date": None})
        if vector.stat().st_size <= _LARGEST_SVG:
            return vector.read_bytes()
        picture.savefig(pixels, bbox_inches="tight", dpi=200)
        return pixels.read_bytes()


def _kind(picture: bytes) -> tuple[str, str]:
    for start, ending, media_type in _KINDS:
        if picture.startswith(start):
            return ending, media_type
    if b"<svg" in picture[:2000]:
        return "svg", "image/svg+xml"
    raise ValueError(f"picture: got bytes that begin with {picture[:8]!r}, expected SVG, PNG or JPEG")
