"""Pictures as bytes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pytest
from matplotlib.figure import Figure

from prbayes.reports.images import image, is_broad, kind_of


class Drawing:
    """Saves so many bytes as SVG."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.resolution: int | None = None

    def savefig(self, path: Path, *, dpi: int | None = None, **_: Any) -> None:
        self.resolution = dpi
        path.write_bytes(b"<svg>".ljust(self.size) if path.suffix == ".svg" else b"\x89PNG\r\n")


@pytest.mark.parametrize(
    ("beginning", "kind"),
    [
        (b"\x89PNG\r\n\x1a\n", ("png", "image/png")),
        (b"\xff\xd8\xff\xe0", ("jpg", "image/jpeg")),
        (b"<svg/>", ("svg", "image/svg+xml")),
        (b'<?xml version="1.0"?>\n<!-- by hand -->\n<svg/>', ("svg", "image/svg+xml")),
    ],
)
def test_kinds(beginning: bytes, kind: tuple[str, str]) -> None:
    assert kind_of(beginning) == kind
    assert image(beginning) == beginning


@pytest.mark.parametrize("wrong", [b"", b"GIF89a", b"text".ljust(3000) + b"<svg/>"])
def test_other_bytes_are_refused(wrong: bytes) -> None:
    with pytest.raises(ValueError, match="expected SVG, PNG or JPEG"):
        image(wrong)


def test_a_large_drawing_is_kept_as_pixels() -> None:
    small, large = Drawing(400_000), Drawing(600_000)
    assert kind_of(image(small))[0] == "svg"
    assert kind_of(image(large))[0] == "png"
    assert (small.resolution, large.resolution) == (None, 200)


def test_a_figure_gives_the_same_bytes_each_time_and_its_words_are_drawn() -> None:
    figure, axis = plt.subplots()
    axis.set_xlabel("length")
    first, second = image(figure), image(figure)
    plt.close(figure)
    assert first == second
    assert b"<text" not in first, "letters are paths, which need no font"


@pytest.mark.parametrize(("inches", "broad"), [(5.0, False), (12.0, True)])
def test_a_picture_of_several_panels_is_broad(inches: float, broad: bool) -> None:
    figure = Figure(figsize=(inches, 3.0))
    figure.add_subplot().plot([0, 1], [0, 1])
    assert is_broad(image(figure)) == broad
    assert not is_broad(b"\x89PNG\r\n and so on")
