"""A section is data in one form, or refused."""

from __future__ import annotations

import dataclasses
from typing import Any

import pandas as pd
import pytest

import prbayes as prb


def test_text_becomes_paragraphs() -> None:
    assert prb.reports.Section("x", "one").text == ("one",)
    assert prb.reports.Section("x", ["one", " ", "two"]).text == ("one", "two")
    assert prb.reports.Section("x").text == ()
    assert prb.reports.Section("x").picture is None


def test_a_picture_is_kept_as_bytes_of_its_kind(picture_bytes: bytes) -> None:
    made = prb.reports.Section("x", picture=picture_bytes, alt="A line.")
    assert (made.kind, made.media_type) == ("svg", "image/svg+xml")
    pixels = prb.reports.Section("x", picture=b"\x89PNG\r\n\x1a\n", alt="A line.")
    assert (pixels.kind, pixels.media_type) == ("png", "image/png")
    with pytest.raises(ValueError, match="got no picture"):
        _ = prb.reports.Section("x").kind


def test_a_section_is_immutable_and_replaced_as_a_whole(picture_bytes: bytes) -> None:
    table = pd.DataFrame({"a": [1.0]})
    made = prb.reports.Section(
        "x", "one", table, picture=picture_bytes, alt="A line.", caption="c", level=3
    )
    with pytest.raises(dataclasses.FrozenInstanceError):
        made.title = "y"  # type: ignore[misc]
    other = dataclasses.replace(made, title="y")
    assert isinstance(other, prb.reports.Section)
    assert (other.title, other.text, other.level) == ("y", ("one",), 3)
    assert other.table is table
    assert (other.picture, other.alt, other.caption) == (picture_bytes, "A line.", "c")
    with pytest.raises(ValueError, match="expected 2, or 3"):
        dataclasses.replace(made, level=4)


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"table": [1, 2]}, r"expected a pandas\.DataFrame"),
        ({"picture": b"GIF89a", "alt": "x"}, "expected SVG, PNG or JPEG"),
        ({"picture": 3, "alt": "x"}, "savefig"),
        ({"picture": b"\x89PNG\r\n"}, "alt: got nothing"),
        ({"picture": b"\x89PNG\r\n", "alt": " "}, "alt: got nothing"),
        ({"text": (3,)}, "expected a text"),
        ({"level": 1}, "expected 2, or 3"),
    ],
)
def test_refusals(keywords: dict[str, Any], words: str) -> None:
    with pytest.raises((TypeError, ValueError), match=words):
        prb.reports.Section("x", **keywords)


@pytest.mark.parametrize("title", ["", " ", None])
def test_a_section_has_a_title(title: Any) -> None:
    with pytest.raises(TypeError, match="title: got"):
        prb.reports.Section(title)
