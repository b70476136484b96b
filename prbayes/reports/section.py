"""Sections of a report: data that every writer renders alike."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from prbayes._validate import Names, plain_text, wrong_type
from prbayes.reports.numbers import cells

# signs in front of the titles of verdicts, so that not only colour distinguishes them
SIGNS = {"": "", "good": "\u2713", "bad": "\u2717", "open": "?"}

# first bytes, ending and media type of files (PNG: ISO/IEC 15948, 5.2; JPEG: ITU T.81, B.1, SOI)
_BEGINNINGS = (
    (b"\x89PNG\r\n", "png", "image/png"),
    (b"\xff\xd8\xff", "jpg", "image/jpeg"),
)


@dataclass(frozen=True, eq=False, init=False)
class Section:
    """One section of a `Report`: paragraphs, a table and a picture, each optional.

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
    verdict : str
        "good", "bad" or "open" for a coloured box, with a sign in front of the title.

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

    title: str
    text: Names
    table: Any
    picture: bytes | None
    alt: str
    caption: str
    level: int
    verdict: str

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
        verdict: str = "",
    ) -> None:
        if not isinstance(title, str) or not title.strip():
            raise TypeError(f"Section: title: got {title!r:.60}, expected a text")
        paragraphs = (text,) if isinstance(text, str) else text
        if not isinstance(paragraphs, Sequence) or not all(isinstance(p, str) for p in paragraphs):
            raise TypeError(
                f"Section {title!r}: text: got {text!r:.60}, expected a text or several"
            )
        plain_text(alt, f"Section {title!r}: alt", empty=True)
        plain_text(caption, f"Section {title!r}: caption", empty=True)
        if level not in (2, 3):
            raise ValueError(
                f"Section: level: got {level!r}, expected 2, or 3 for a part of a section"
            )
        if verdict not in SIGNS:
            raise ValueError(
                f'Section: verdict: got {verdict!r}, expected "good", "bad", "open" or nothing'
            )
        if table is not None:
            cells(table)  # This raises errors of the table here, and not when it is written.
        if picture is not None:
            if not alt.strip():
                raise ValueError(
                    f"Section {title!r}: alt: got nothing, expected a sentence that describes the "
                    "picture"
                )
            picture = image(picture)
        vars(self).update(
            title=title,
            text=tuple(paragraph for paragraph in paragraphs if paragraph.strip()),
            table=table,
            picture=picture,
            alt=alt,
            caption=caption,
            level=level,
            verdict=verdict,
        )

    @property
    def heading(self) -> str:
        """The title, after the sign of a verdict."""
        return f"{SIGNS[self.verdict]} {self.title}".strip()

    @property
    def kind(self) -> str:
        """The ending of a file with the picture."""
        if self.picture is None:
            raise ValueError(f"Section {self.title!r}: got no picture, expected one")
        return kind_of(self.picture)[0]


# -- pictures --------------------------------------------------------------------------------


def image(picture: Any) -> bytes:
    """Return the bytes of a picture or figure, the same each time, or raise if it is neither."""
    if isinstance(picture, bytes):
        kind_of(picture)
        return picture
    if not hasattr(picture, "savefig"):
        raise wrong_type(picture, "picture", "bytes (SVG, PNG, JPEG) or a figure with savefig")
    from matplotlib import rc_context  # heavy, and only needed for pictures

    reproducible: Any = {"svg.hashsalt": "prbayes", "svg.fonttype": "path"}
    with tempfile.TemporaryDirectory() as folder, rc_context(reproducible):
        vector = Path(folder, "picture.svg")
        picture.savefig(vector, bbox_inches="tight", metadata={"Date": None})
        # The limit is five times the size of this package's pictures. A larger drawing, such as a
        # scatter of ten thousand points, is stored as pixels, which a browser opens at once.
        if vector.stat().st_size <= 500_000:
            return vector.read_bytes()
        pixels = Path(folder, "picture.png")
        picture.savefig(pixels, bbox_inches="tight", dpi=200)
        return pixels.read_bytes()


def is_broad(picture: bytes) -> bool:
    """Return whether a drawing has several panels: one is 400 points wide, two are 650."""
    width = re.search(rb'<svg[^>]*\swidth="([0-9.]+)(?:pt)?"', picture[:2000])
    return width is not None and float(width[1]) > 560


def kind_of(picture: bytes) -> tuple[str, str]:
    """Return the file ending and the media type of a picture, or raise a `ValueError`."""
    for beginning, ending, media_type in _BEGINNINGS:
        if picture.startswith(beginning):
            return ending, media_type
    # A declaration, a DOCTYPE and a comment may precede the tag.
    if b"<svg" in picture[:2000]:
        return "svg", "image/svg+xml"
    raise ValueError(
        f"picture: got bytes that begin with {picture[:8]!r}, expected SVG, PNG or JPEG"
    )
