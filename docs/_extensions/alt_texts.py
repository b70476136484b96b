"""Pictures that a page computes are described by the words before them, for who cannot see them."""

from docutils import nodes
from sphinx.application import Sphinx

LONGEST = 250  # characters: a screen reader reads all of it


def shortened(text: str) -> str:
    """Return a text on one line, of whole words."""
    words = text.split()
    found = " ".join(words)
    if len(found) <= LONGEST:
        return found
    return found[:LONGEST].rpartition(" ")[0] + " ..."


def describe(app: Sphinx, doctree: nodes.document) -> None:
    """Give each picture without a description the paragraph or heading before its cell."""
    before = ""
    for node in doctree.findall():
        if isinstance(node, nodes.paragraph | nodes.title) and node.astext():
            before = node.astext()
        elif isinstance(node, nodes.image) and not node.get("alt"):
            node["alt"] = shortened(f"Picture: {before}")


def setup(app: Sphinx) -> dict[str, bool]:
    """Do it when a page was read."""
    app.connect("doctree-read", describe)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
