"""HTML of results in a notebook: a heading, a table, sentences."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence


def view(
    heading: str,
    *,
    header: Sequence[str] = (),
    rows: Iterable[Sequence[str]] = (),
    sentences: Iterable[str] = (),
) -> str:
    """Return HTML without colours, which suits light and dark; all texts are escaped.

    The first cell of a row is its name; the others are aligned right, as numbers are.
    """
    cell = "padding: .2em .9em .2em 0"
    table = ""
    for name, *values in (map(html.escape, row) for row in rows):
        cells = "".join(f'<td style="{cell}; text-align: right">{value}</td>' for value in values)
        table += f'<tr><th scope="row" style="{cell}; text-align: left">{name}</th>{cells}</tr>'
    parts = [f"<p><b>{html.escape(heading)}</b></p>"]
    if table:
        names = "".join(f'<th scope="col" style="{cell}">{html.escape(n)}</th>' for n in header)
        parts.append(f"<table><thead><tr>{names}</tr></thead><tbody>{table}</tbody></table>")
    parts += [f"<p>{html.escape(sentence)}</p>" for sentence in sentences]
    return f'<div style="max-width: 60em">{"".join(parts)}</div>'
