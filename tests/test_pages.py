"""Figures in the README and in the pages are those that the benchmarks found."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path

import numpy as np
import pytest

import prbayes
from benchmarks import pages, record
from benchmarks.figures import STUDIES
from benchmarks.sentences import with_figures

PACKAGE = Path(prbayes.__file__).parent
ROOT = Path(__file__).parents[1]

README = (ROOT / "README.md").read_text(encoding="utf-8")
# The site shows 90 characters of code in a line on a desktop; a reader's font or half a screen shows
# fewer. 79 is what Python's own style guide holds code to, for such readers.
CODE_WIDTH = 79
BLOCK = re.compile(r"^```(?:python|bash|text|\{code-cell\} ipython3)\n(.*?)^```$", re.S | re.M)
UNSEEN = re.compile(r"\A:tags: \[.*remove-(?:cell|input)")


README_AND_PAGES = [ROOT / "README.md", *pages.PAGES]


def test_figures_are_those_of_the_benchmarks() -> None:
    files = [pages.CHANGELOG, *README_AND_PAGES]
    outdated = [
        path.stem for path in files if pages.rewritten(path) != path.read_text(encoding="utf-8")
    ]
    assert not outdated, "run python -m benchmarks.pages"
    assert pages.SCOREBOARD.read_text(encoding="utf-8") == pages.scoreboard_file()


def test_a_wrong_figure_in_a_sentence_is_found() -> None:
    path = ROOT / "docs" / "peers.md"
    page = path.read_text(encoding="utf-8")
    wrong = re.sub(r"prbayes takes \d+", "prbayes takes 1", page)
    assert wrong != page == with_figures(path, wrong)
    with pytest.raises(ValueError, match="got 0 places"):
        with_figures(path, page.replace("prbayes takes", "It takes"))


def test_all_studies_with_results_are_run_by_the_command() -> None:
    results = {path.stem for path in record.RESULTS.glob("*.json")}
    # Of the scoreboard other programs have environments of their own.
    assert results - {*STUDIES} == {
        "reach_before", "reach_references", "scoreboard", "thermal_challenge"
    }  # fmt: skip


def test_files_that_pages_name_exist() -> None:
    name = re.compile(r"\b(?:tests|benchmarks|examples|prbayes)/[\w/]+\.(?:py|json|csv)\b")
    names = {n for path in README_AND_PAGES for n in name.findall(path.read_text(encoding="utf-8"))}
    assert not [name for name in names if not (ROOT / name).exists()]


def test_tests_that_pages_name_exist() -> None:
    for path in pages.PAGES:
        for file, test in re.findall(
            r"(tests/[\w/]+\.py)::(test_\w+)", path.read_text(encoding="utf-8")
        ):
            assert f"\ndef {test}(" in (ROOT / file).read_text(encoding="utf-8"), test


def wide_lines(page: str) -> list[str]:
    """Return the lines of code that a reader sees and has to scroll for."""
    seen = [block for block in BLOCK.findall(page) if not UNSEEN.match(block)]
    return [line for block in seen for line in block.splitlines() if len(line) > CODE_WIDTH]


def test_code_fits_on_the_page() -> None:
    wide = {path.stem: wide_lines(path.read_text(encoding="utf-8")) for path in README_AND_PAGES}
    assert not {name: lines for name, lines in wide.items() if lines}


def test_a_wide_line_of_code_is_found() -> None:
    wide = "x" * (CODE_WIDTH + 1)
    assert wide_lines(f"```python\n{wide}\n```\n") == [wide]
    assert wide_lines(f"```{{code-cell}} ipython3\n:tags: [hide-input]\n{wide}\n```\n") == [wide]
    assert not wide_lines(f"```python\n{wide[1:]}\n```\n{wide}\n")
    assert not wide_lines(f"```{{code-cell}} ipython3\n:tags: [remove-cell]\n{wide}\n```\n")


def test_executed_pages_are_notebooks() -> None:
    """Without a name to show, the format of notebooks has no kernel, and jupytext refuses a page."""
    kernel = "kernelspec:\n  name: python3\n  display_name: Python 3\n"
    written = [path.read_text(encoding="utf-8") for path in pages.PAGES]
    executed = [page.split("---\n")[1] for page in written if "{code-cell}" in page]
    assert len(executed) > 20
    for header in executed:
        assert "file_format: mystnb\n" in header
        assert kernel in header


def test_fractions_in_formulas_have_braces() -> None:
    """The writer of MathML takes 13 for one number in TeX's short form of a third."""
    written = [*pages.PAGES, *PACKAGE.rglob("*.py")]
    bare = re.compile(r"\\[dt]?frac(?!\{)")
    assert bare.search(r"\frac13 - \frac{x}{L}")
    assert not [path.name for path in written if bare.search(path.read_text(encoding="utf-8"))]


def test_every_table_is_on_a_page() -> None:
    told = "".join(path.read_text(encoding="utf-8") for path in README_AND_PAGES)
    assert set(re.findall(r"<!-- table: (.+) -->", told)) == set(pages.TABLES)


def test_the_thermal_page_tells_the_correlation_of_the_coupons() -> None:
    path = ROOT / "examples" / "thermal" / "material.csv"
    columns = np.genfromtxt(path, delimiter=",", names=True, usecols=(1, 2, 3))
    temperature, *measured = (columns[name] for name in columns.dtype.names)
    lines = [np.polynomial.Polynomial.fit(temperature, values, 1) for values in measured]
    residuals = [v - line(temperature) for v, line in zip(measured, lines, strict=True)]
    found = float(np.corrcoef(residuals)[0, 1])
    error = np.sqrt((1 - found**2) / (len(temperature) - 2))
    told = f"a correlation of {found:.2f}, with a standard error of {error:.2f}".replace("0.", ".")
    assert told in (ROOT / "docs" / "thermal_challenge.md").read_text(encoding="utf-8")


def test_sentences_of_the_readme_are_short() -> None:
    """Of 40 words at most: a reader has a minute."""
    prose = re.sub(r"```.*?```", "", README, flags=re.DOTALL)
    parts = [part for part in prose.split("\n\n") if not part.startswith(("|", "#", "!"))]
    sentences = re.split(r"(?<=[.:])\s|\n- ", "\n\n".join(parts))
    long = [sentence for sentence in sentences if len(sentence.split()) > 40]
    assert not long


def test_the_readme_links_to_files() -> None:
    links = re.findall(r"\]\(((?!http)[^)#]+)", README)
    assert links
    assert not [link for link in links if not (ROOT / link).exists()]


@pytest.mark.parametrize("path", sorted((ROOT / "examples" / "notebooks").glob("*.ipynb")))
def test_notebooks_are_kept_without_results(path: Path) -> None:
    """They are executed by .ci/notebooks; results of some machine would be noise in their history.

    One is written for PyMC's gallery, which shows notebooks as they are.
    """
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert code
    has_results = path.stem == "which_input_distribution"
    assert any(cell["outputs"] for cell in code) == has_results
    assert has_results or not any(cell["execution_count"] for cell in code)
    for cell in code:
        compile("".join(cell["source"]), str(path), "exec")


def pages_of_messages() -> list[str]:
    """Return all pages that findings name, each with a heading: constants such as `a.md#b`."""
    paths = PACKAGE.rglob("*.py")
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in paths]
    constants = [n.value for t in trees for n in ast.walk(t) if isinstance(n, ast.Constant)]
    return sorted({c for c in constants if re.fullmatch(r"[\w-]+\.md#[\w-]+", str(c))})


@pytest.mark.parametrize("named", pages_of_messages())
def test_what_a_message_names_is_there(named: str) -> None:
    name, _, anchor = named.partition("#")
    page = (pages.DOCS / name).read_text(encoding="utf-8")
    headings = re.findall(r"^##+ (.+)$", page, re.MULTILINE)
    # As GitHub and the site make them of headings
    anchors = [re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in headings]
    assert anchor in anchors
    # `prb.help` shows the section
    assert f"({named})" in (pages.DOCS / "findings.md").read_text(encoding="utf-8")
