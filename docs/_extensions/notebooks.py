"""Downloads of executed pages as notebooks, with outputs, that run in an empty folder."""

import base64
import re
from contextlib import suppress
from pathlib import Path
from typing import Any

FOLDER = "notebooks"  # in the site
LINK = "This page as a notebook"
_EXECUTED = re.compile(r"\A---\n.*?^file_format: mystnb$.*?^---$", re.S | re.M)
_HEADING = re.compile(r"^# .+$", re.M)
_ROLE = re.compile(r"(?<!`)\{[\w:]+\}`(?:([^`<]*?) *<[^`>]*>|([^`]*))`")
_FENCE = re.compile(r"^(`{3,}|:{3,})\{(\w+)\}([^\n]*)\n(.*?)^\1$\n?", re.S | re.M)
_OPTION = re.compile(r"^:(\w+): *(.*)\n", re.M)
_PAGE = re.compile(r"(?<!!)\[([^]]*)\]\((?!\))(?:[\w./-]+\.md)?(?:#[\w.-]+)?\)")
_PICTURE = re.compile(r"!\[([^]]*)\]\((?!https?:|attachment:)([^)]+)\)")
_FILE = re.compile(r"([\"'])((?:\.\./)+[\w./]+)\1")
_PICTURES = {".png": "image/png", ".svg": "image/svg+xml", ".jpg": "image/jpeg"}
Cell = dict[str, Any]


def is_executed(text: str) -> bool:
    """Whether a page is a notebook in Markdown."""
    return _EXECUTED.match(text) is not None


def plain_directive(found: re.Match[str]) -> str:
    """Return a directive as ordinary Markdown."""
    _, name, title, body = found.groups()
    options = dict(_OPTION.findall(body))
    text = _OPTION.sub("", body)
    if name in ("raw", "toctree"):
        return ""
    if name in ("image", "figure"):
        return f"![{options.get('alt', '')}]({title.strip()})\n\n{text}"
    if name == "math":
        return f"$$\n{text}$$\n"
    heading = f"**{title.strip() or name.capitalize()}**\n\n" if name != "container" else ""
    return heading + plain(text)


def plain(text: str) -> str:
    """Return MyST Markdown as Markdown that Jupyter shows: no roles, directives or site links."""
    text = _FENCE.sub(plain_directive, text)
    text = re.sub(r"^\$\$ *\([\w-]+\)$", "$$", text, flags=re.M)
    text = re.sub(r"\{eq\}`([^`]*)`", r"the formula (\1)", text)
    text = _ROLE.sub(lambda found: f"`{found[1] or found[2]}`", text)
    return _PAGE.sub(r"\1", text)


def with_pictures(cell: Cell, folder: Path) -> None:
    """Attach the pictures that the Markdown of a cell shows."""
    attachments: dict[str, dict[str, str]] = {}

    def attach(found: re.Match[str]) -> str:
        path = folder / found[2]
        content = base64.b64encode(path.read_bytes()).decode()
        attachments[path.name] = {_PICTURES[path.suffix]: content}
        return f"![{found[1]}](attachment:{path.name})"

    cell["source"] = _PICTURE.sub(attach, cell["source"])
    if attachments:
        cell["attachments"] = attachments


def result_only(cell: Cell) -> Cell:
    """Return a Markdown cell with the result of a code cell that reads files of the repository."""
    texts = []
    for output in cell["outputs"]:
        data = output.get("data", {})
        kinds = (kind for kind in ("text/markdown", "text/html", "text/plain") if kind in data)
        texts += ["".join(data[kind]) for kind in kinds][:1]
    return {
        "cell_type": "markdown",
        "id": cell["id"],
        "metadata": {},
        "source": "\n\n".join(texts),
    }


def without_repository(cells: list[Cell], folder: Path) -> list[Cell]:
    """Return the cells that write the files that code cells read, and change their paths."""
    files: dict[str, str] = {}

    def moved(found: re.Match[str]) -> str:
        path = folder / found[2]
        if not path.exists():
            return found[0]
        read = sorted(path.glob("*.py")) if path.is_dir() else [path]
        files.update({each.name: each.read_text(encoding="utf-8") for each in read})
        return '"."' if path.is_dir() else f'"{path.name}"'

    for cell in cells:
        if cell["cell_type"] == "code":
            cell["source"] = _FILE.sub(moved, cell["source"])
    sources = [f"%%writefile {name}\n{text}" for name, text in files.items()]
    written = [{"id": f"file-{i}", "source": source} for i, source in enumerate(sources)]
    code = {"cell_type": "code", "metadata": {}, "outputs": [], "execution_count": None}
    return [code | cell for cell in written]


def portable(notebook: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the notebook of a page in this folder as one that stands alone."""
    cells: list[Cell] = []
    for cell in notebook["cells"]:
        cell["source"] = "".join(cell["source"])
        tags = cell["metadata"].pop("tags", [])
        if "result-only" in tags:
            cell = result_only(cell)
        elif cell["cell_type"] == "markdown":
            cell["source"] = plain(cell["source"])
            with_pictures(cell, folder)
        elif {"remove-cell", "remove-output"} & set(tags):
            cell["outputs"] = []
        elif "remove-stderr" in tags:
            cell["outputs"] = [o for o in cell["outputs"] if o.get("name") != "stderr"]
        if cell["source"].strip():
            cells.append(cell)
    cells[1:1] = without_repository(cells, folder)
    return notebook | {"cells": cells}


def with_link(app: Any, page: str, source: list[str]) -> None:
    """Add a link to the notebook of an executed page, below its heading."""
    text = source[0]
    if not is_executed(text):
        return
    up = "../" * page.count("/")
    link = f'<a class="notebook" href="{up}{FOLDER}/{page}.ipynb" download>{LINK}</a>'
    raw = f"\n\n```{{raw}} html\n<p>{link}</p>\n```\n"
    source[0] = _HEADING.sub(lambda found: found[0] + raw, text, count=1)


def write(app: Any, failed: Exception | None) -> None:
    """Write the notebooks of all executed pages into the site."""
    import nbformat
    from jupyter_cache import get_cache

    if failed is not None or app.builder.format != "html":
        return
    cache = get_cache(app.env.mystnb_config.execution_cache_path)
    for page in sorted(app.env.found_docs):
        path = Path(app.env.doc2path(page))
        text = path.read_text(encoding="utf-8") if path.suffix == ".md" else ""
        if not is_executed(text):
            continue
        # MyST-NB writes a page's cells to this folder, and keeps its outputs in the cache.
        cells = Path(app.env.mystnb_config.output_folder, f"{page}.ipynb")
        notebook = nbformat.read(cells, as_version=4)
        with suppress(KeyError):  # a page that was not executed
            _, notebook = cache.merge_match_into_notebook(notebook)
        target = Path(app.outdir, FOLDER, f"{page}.ipynb")
        target.parent.mkdir(parents=True, exist_ok=True)
        nbformat.write(nbformat.from_dict(portable(notebook, path.parent)), target)


def setup(app: Any) -> dict[str, bool]:
    """Connect both functions to the build."""
    app.connect("source-read", with_link)
    app.connect("build-finished", write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
