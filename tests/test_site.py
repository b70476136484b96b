"""What the documentation's extensions make of pages."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import pytest

DOCS = Path(__file__).parents[1] / "docs"
sys.path.insert(0, str(DOCS / "_extensions"))

import notebooks  # noqa: E402


@pytest.mark.parametrize(
    ("myst", "markdown"),
    [
        ("{func}`prb.minimize <prbayes.minimize>` runs", "`prb.minimize` runs"),
        ("a {class}`prbayes.Joint`", "a `prbayes.Joint`"),
        ("see [validity](validity.md#limits)", "see validity"),
        ("see [failures](#failures)", "see failures"),
        ("[CalculiX](https://www.calculix.de)", "[CalculiX](https://www.calculix.de)"),
        ("$$\nx\n$$ (likelihood)\n", "$$\nx\n$$\n"),
        ("of {eq}`likelihood`", "of the formula (likelihood)"),
        ("```{raw} html\n<p></p>\n```\nafter", "after"),
        ("```{image} a.png\n:alt: A picture\n```\n", "![A picture](a.png)\n\n"),
        (":::{note}\nA {func}`f`.\n:::\n", "**Note**\n\nA `f`.\n"),
        ("```python\nx[0](y)\n```\n", "```python\nx[0](y)\n```\n"),
    ],
)
def test_roles_directives_and_links_are_plain_in_a_notebook(myst: str, markdown: str) -> None:
    assert notebooks.plain(myst) == markdown


def cell(source: str, *outputs: dict[str, Any], tags: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return a code cell."""
    metadata = {"tags": list(tags)}
    return {
        "cell_type": "code",
        "id": "a",
        "metadata": metadata,
        "source": source,
        "outputs": [*outputs],
    }


def test_a_notebook_writes_the_files_that_it_reads(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text("print(1)\n", encoding="utf-8")
    (tmp_path / "docs").mkdir()
    first = {"cell_type": "markdown", "id": "b", "metadata": {}, "source": "# Title"}
    cells = [first, cell('Path("../program.py").read_text()')]
    found = notebooks.portable({"cells": cells}, tmp_path / "docs")["cells"]
    sources = [each["source"] for each in found]
    assert sources == [
        "# Title",
        "%%writefile program.py\nprint(1)\n",
        'Path("program.py").read_text()',
    ]


def test_a_result_of_the_repository_is_kept_without_its_code(tmp_path: Path) -> None:
    table = {"output_type": "execute_result", "data": {"text/html": "<table>", "text/plain": "t"}}
    cells = [cell("read()", table, tags=("result-only",)), cell("2", tags=("remove-cell",))]
    found = notebooks.portable({"cells": cells}, tmp_path)["cells"]
    assert [each["cell_type"] for each in found] == ["markdown", "code"]
    assert found[0]["source"] == "<table>"


def test_pictures_are_attached(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"png")
    found = {"source": "![A](a.png)"}
    notebooks.with_pictures(found, tmp_path)
    assert found["source"] == "![A](attachment:a.png)"
    assert json.loads(json.dumps(found))["attachments"] == {"a.png": {"image/png": "cG5n"}}


def test_results_of_benchmarks_are_marked_as_the_repository_s() -> None:
    """Such cells would fail in a downloaded notebook."""
    for page in [*DOCS.glob("*.md"), *DOCS.glob("*/*.md")]:
        text = page.read_text(encoding="utf-8")
        for block in re.findall(r"^```\{code-cell\} ipython3\n(.*?)^```$", text, re.S | re.M):
            if "benchmarks/results" in block:
                assert "result-only" in block, page.name


def test_words_of_the_search_have_pages() -> None:
    text = (DOCS / "_extensions" / "search_words.py").read_text(encoding="utf-8")
    places = re.findall(r'^    "([\w#-]+)": \[', text, re.M)
    assert len(places) > 15
    for page, _, anchor in (place.partition("#") for place in places):
        headings = re.findall(r"^## (.+)$", (DOCS / f"{page}.md").read_text(encoding="utf-8"), re.M)
        anchors = [re.sub(r"[^\w -]", "", each).lower().replace(" ", "-") for each in headings]
        assert anchor in ["", *anchors]


def test_every_page_is_in_the_sidebar() -> None:
    paths = [*DOCS.glob("*.md"), *DOCS.glob("appendix/*.md")]
    listed = {"index", "404"}
    for path in paths:
        for block in re.findall(
            r"```\{toctree\}\n(.*?)```", path.read_text(encoding="utf-8"), re.S
        ):
            names = [line for line in block.splitlines() if line and not line.startswith(":")]
            listed |= {str((path.parent / name).relative_to(DOCS)) for name in names}
    assert {str(path.relative_to(DOCS).with_suffix("")) for path in paths} == listed
