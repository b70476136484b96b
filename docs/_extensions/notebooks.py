"""Every executed page is offered as a notebook: made when the pages are, from the same text."""

import re
from pathlib import Path

import nbformat
from myst_nb.core.read import read_myst_markdown_notebook
from sphinx.application import Sphinx

FOLDER = "notebooks"  # in the site
_EXECUTED = re.compile(r"\A---\n.*?^file_format: mystnb$.*?^---$", re.S | re.M)
_HEADING = re.compile(r"^# .+$", re.M)


def is_executed(text: str) -> bool:
    """Whether a page is a notebook in Markdown."""
    return _EXECUTED.match(text) is not None


def with_link(app: Sphinx, page: str, source: list[str]) -> None:
    """Add a link to the notebook of an executed page, below its heading."""
    text = source[0]
    if not is_executed(text):
        return
    up = "../" * page.count("/")
    link = (
        f'<a class="notebook" href="{up}{FOLDER}/{page}.ipynb" download>This page as a notebook</a>'
    )
    raw = f"\n\n```{{raw}} html\n<p>{link}</p>\n```\n"
    source[0] = _HEADING.sub(lambda found: found[0] + raw, text, count=1)


def write(app: Sphinx, failed: Exception | None) -> None:
    """Write the notebooks of all executed pages into the site."""
    if failed is not None or app.builder.format != "html":
        return
    for page in sorted(app.env.found_docs):
        path = Path(app.env.doc2path(page))
        text = path.read_text(encoding="utf-8") if path.suffix == ".md" else ""
        if not is_executed(text):
            continue
        notebook = read_myst_markdown_notebook(text)
        target = Path(app.outdir, FOLDER, f"{page}.ipynb")
        target.parent.mkdir(parents=True, exist_ok=True)
        nbformat.write(notebook, target)


def setup(app: Sphinx) -> dict[str, bool]:
    """Attach both."""
    app.connect("source-read", with_link)
    app.connect("build-finished", write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
