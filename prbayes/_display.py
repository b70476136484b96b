"""Results as sentences, tables of a notebook and data frames."""

from __future__ import annotations

import html
import inspect
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import xarray as xr

from prbayes._validate import Names


def view(
    heading: str,
    *,
    header: Sequence[str] = (),
    rows: Iterable[Sequence[str]] = (),
    sentences: Iterable[str] = (),
    align: str = "right",
) -> str:
    """Return HTML without colours, which suits light and dark; all texts are escaped.

    The first cell of a row is its name; the others are aligned right, as numbers are, or left.
    """
    cell = "padding: .2em .9em .2em 0"
    table = ""
    for name, *values in (map(html.escape, row) for row in rows):
        cells = "".join(f'<td style="{cell}; text-align: {align}">{value}</td>' for value in values)
        table += f'<tr><th scope="row" style="{cell}; text-align: left">{name}</th>{cells}</tr>'
    parts = [f"<p><b>{html.escape(heading)}</b></p>"]
    if table:
        names = "".join(f'<th scope="col" style="{cell}">{html.escape(n)}</th>' for n in header)
        head = f"<thead><tr>{names}</tr></thead>" if header else ""
        parts.append(f"<table>{head}<tbody>{table}</tbody></table>")
    parts += [f"<p>{html.escape(sentence)}</p>" for sentence in sentences]
    return f'<div style="max-width: 60em">{"".join(parts)}</div>'


@dataclass(frozen=True)
class View:
    """What a reader of a result sees: a sentence, a table and further sentences."""

    heading: str
    header: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    sentences: Sequence[str] = ()

    @property
    def first_page(self) -> View:
        """The first 40 rows, and how many more there are."""
        more = len(self.rows) - 40
        if more <= 0:
            return self
        text = f"{more} more rows are in .to_dataframe()."
        return replace(self, rows=self.rows[:40], sentences=(text, *self.sentences))

    def __str__(self) -> str:
        page = self.first_page
        table = [row for row in (page.header, *page.rows) if row]
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        lines = [
            "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]).rstrip()
            for row in table
        ]
        return "\n  ".join([page.heading, *lines, *page.sentences])


def percentage(share: float) -> str:
    """Return a share with all its digits as a percentage, such as '99.5%'."""
    return f"{100 * share:g}%"


def p_digits(p: float, alpha: float) -> int:
    """Return how many digits of a p-value, at least two, show on which side of alpha it is."""
    digits = (n for n in range(2, 17) if (float(f"{p:.{n}g}") <= alpha) == (p <= alpha))
    return next(digits, 17)


class Shown:
    """A result that prints as sentences, and that a notebook shows as a table."""

    __slots__ = ()

    def to_view(self) -> View:
        """Return what a reader sees."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return str(self.to_view())

    def _repr_html_(self) -> str:
        shown = self.to_view().first_page
        return view(shown.heading, header=shown.header, rows=shown.rows, sentences=shown.sentences)


class ShownArray(Shown):
    """An xarray object that prints as sentences; an incomplete selection prints as in xarray."""

    __slots__ = ()
    # Names of dimensions, variables, groups and attributes that a complete result has.
    _parts: ClassVar[Names] = ()

    # The method of xarray has no annotations, so that type checkers would refuse each subclass.
    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)

    @property
    def _is_whole(self) -> bool:
        """Whether the result is complete, not a selection."""
        array: Any = self
        names = {*array.dims, *array.attrs, *getattr(array, "data_vars", ())}
        return set(self._parts) <= names | set(getattr(array, "children", ()))

    def __repr__(self) -> str:
        """Return sentences, or for a selection the text of xarray."""
        return super().__repr__() if self._is_whole else super(Shown, self).__repr__()

    def __str__(self) -> str:
        return repr(self)

    def _repr_html_(self) -> str:
        """Return a table as HTML, or for a selection that of xarray."""
        if self._is_whole:
            return super()._repr_html_()
        return str(super(Shown, self)._repr_html_())  # type: ignore[misc]


class Tree(ShownArray, xr.DataTree):  # type: ignore[misc]  # xarray gives __repr__ a level
    """A DataTree with sentences."""

    __slots__ = ()

    def to_dataframe(self) -> Any:
        """Return the variables of a group or a selection as a data frame, as `Dataset` does."""
        return self.to_dataset().to_dataframe()


class Table(ShownArray, xr.Dataset):
    """A dataset with sentences."""

    __slots__ = ()
    # Names of the variables that become columns of the data frame.
    _columns: ClassVar[Names] = ()

    def to_dataframe(self, dim_order: Sequence[Any] | None = None) -> Any:
        """Return the main variables as a data frame; for a selection all, as in xarray."""
        if not self._is_whole:
            return super().to_dataframe(dim_order)
        table = self[[name for name in self._columns if name in self]]
        if table.dims:
            return super(Table, table).to_dataframe(dim_order)
        return super(Table, table.expand_dims("row")).to_dataframe().reset_index(drop=True)


def without_constructor[T: type](cls: T) -> T:
    """Hide the arguments of a constructor that users do not call, in `help` and on the site."""
    initialise = vars(cls)["__init__"]
    parameter = inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY)
    initialise.__signature__ = inspect.Signature([parameter])
    return cls
