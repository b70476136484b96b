"""Pictures as bytes, of a kind that every reader of a report shows."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import Any

# How files of these kinds begin (PNG: ISO/IEC 15948, 5.2; JPEG: ITU T.81, B.1, marker SOI).
_BEGINNINGS = (
    (b"\x89PNG\r\n", "png", "image/png"),
    (b"\xff\xd8\xff", "jpg", "image/jpeg"),
)


def image(picture: Any) -> bytes:
    """Return the bytes of a picture; those of a figure are the same each time.

    Raises
    ------
    TypeError, ValueError
        If it is neither bytes of a known kind nor a figure.
    """
    if isinstance(picture, bytes):
        kind_of(picture)  # raises what is wrong with it
        return picture
    if not hasattr(picture, "savefig"):
        raise TypeError(
            f"picture: got {type(picture).__name__}, expected bytes (SVG, PNG, JPEG) "
            "or a figure with savefig"
        )
    from matplotlib import rc_context  # heavy, and only needed for pictures

    reproducible: Any = {"svg.hashsalt": "prbayes", "svg.fonttype": "path"}
    with tempfile.TemporaryDirectory() as folder, rc_context(reproducible):
        vector = Path(folder, "picture.svg")
        picture.savefig(vector, bbox_inches="tight", metadata={"Date": None})
        # Five times as large as this package's pictures. What is larger, such as a scatter of ten
        # thousand points, is kept as pixels, so that a browser opens a report at once.
        if vector.stat().st_size <= 500_000:
            return vector.read_bytes()
        pixels = Path(folder, "picture.png")
        picture.savefig(pixels, bbox_inches="tight", dpi=200)
        return pixels.read_bytes()


# Width, in points, from which a picture's letters are too small on a phone: pictures of one panel
# are 400 wide, those of two 650.
_BROAD = 560
_SVG_WIDTH = re.compile(rb'<svg[^>]*\swidth="([0-9.]+)(?:pt)?"')


def is_broad(picture: bytes) -> bool:
    """Return whether a picture is so wide that a phone should not shrink it: of a drawing alone."""
    found = _SVG_WIDTH.search(picture[:2000])
    return found is not None and float(found[1]) > _BROAD


def kind_of(picture: bytes) -> tuple[str, str]:
    """Return a file's ending and the media type of a picture.

    Raises
    ------
    ValueError
        If the bytes are of no kind that a report can hold.
    """
    for beginning, ending, media_type in _BEGINNINGS:
        if picture.startswith(beginning):
            return ending, media_type
    # The tag begins after a declaration, a DOCTYPE and a comment.
    if b"<svg" in picture[:2000]:
        return "svg", "image/svg+xml"
    raise ValueError(
        f"picture: got bytes that begin with {picture[:8]!r}, expected SVG, PNG or JPEG"
    )
