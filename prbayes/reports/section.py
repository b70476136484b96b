"""Sections of a report: data that every writer renders alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from prbayes._validate import plain_text
from prbayes.reports.images import image, is_broad, kind_of
from prbayes.reports.tables import cells


@dataclass(frozen=True, eq=False)
class _Content:
    """What a section holds, in the one form that writers take."""

    title: str
    text: tuple[str, ...]
    table: Any
    picture: bytes | None
    alt: str
    caption: str
    level: int


class Section(_Content):
    """One section of a `Report`: paragraphs, a table and a picture, each where given.

    Parameters
    ----------
    title : str
    text : str or sequence of str
        Paragraphs, as plain text.
    table : pandas.DataFrame, xarray.Dataset or xarray.DataArray, optional
        Numbers are written with four significant digits, text as it is; named indices become
        columns.
    picture : bytes or object with ``savefig``, optional
        SVG, PNG or JPEG; or a matplotlib figure or ArviZ ``PlotCollection``, which is saved at
        once, and left open.
    alt : str
        What the picture shows, for those who do not see it; needed with a picture.
    caption : str
        Below the picture.
    level : int
        2 for a section, 3 for a part of the section before it.

    Attributes
    ----------
    text : tuple of str
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
    >>> batches = pd.DataFrame({"batch": ["A", "B"], "specimens": [11, 10]})
    >>> prb.reports.Section("Material", "Steel, as delivered.", batches).text
    ('Steel, as delivered.',)
    """

    def __init__(
        self,
        title: str,
        text: str | Sequence[str] = (),
        table: Any = None,
        *,
        picture: Any = None,
        alt: str = "",
        caption: str = "",
        level: int = 2,
    ) -> None:
        if not isinstance(title, str) or not title.strip():
            raise TypeError(f"Section: title: got {title!r:.60}, expected a text")
        plain_text(alt, f"Section {title!r}: alt", empty=True)
        plain_text(caption, f"Section {title!r}: caption", empty=True)
        if level not in (2, 3):
            raise ValueError(
                f"Section: level: got {level!r}, expected 2, or 3 for a part of a section"
            )
        if table is not None:
            cells(table)  # raises what is wrong with it now
        if picture is not None:
            if not alt.strip():
                raise ValueError(
                    f"Section {title!r}: alt: got nothing, expected a sentence on what is seen"
                )
            picture = image(picture)
        super().__init__(title, _paragraphs(title, text), table, picture, alt, caption, level)

    @property
    def kind(self) -> str:
        """The ending of a file with the picture."""
        return kind_of(self._drawn)[0]

    @property
    def media_type(self) -> str:
        """The type of the picture for a data URI."""
        return kind_of(self._drawn)[1]

    @property
    def broad(self) -> bool:
        """Whether the picture scrolls on a narrow screen, where it would be too small to read."""
        return is_broad(self._drawn)

    @property
    def _drawn(self) -> bytes:
        if self.picture is None:
            raise ValueError(f"Section {self.title!r}: got no picture, expected one")
        return self.picture


def _paragraphs(title: str, text: str | Sequence[str]) -> tuple[str, ...]:
    given = (text,) if isinstance(text, str) else text
    if not isinstance(given, Sequence) or not all(
        isinstance(paragraph, str) for paragraph in given
    ):
        raise TypeError(f"Section {title!r}: text: got {text!r:.60}, expected a text or several")
    return tuple(paragraph for paragraph in given if paragraph.strip())
