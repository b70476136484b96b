"""How results show themselves in a notebook: a heading, a table, sentences."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence

_CELL = "padding: .2em .9em .2em 0"


def view(
    heading: str,
    *,
    header: Sequence[str] = (),
    rows: Iterable[Sequence[str]] = (),
    sentences: Iterable[str] = (),
) -> str:
    """Return HTML of a result, without a colour of its own: it suits light and dark.

    The first cell of a row is its name; the others stand to the right, as numbers do. All texts are
    escaped.
    """
    parts = [f"<p><b>{html.escape(heading)}</b></p>"]
    body = [_row(row) for row in rows]
    if body:
        names = "".join(f'<th scope="col" style="{_CELL}">{html.escape(n)}</th>' for n in header)
        parts.append(
            f"<table><thead><tr>{names}</tr></thead><tbody>{''.join(body)}</tbody></table>"
        )
    parts += [f"<p>{html.escape(sentence)}</p>" for sentence in sentences]
    return f'<div style="max-width: 60em">{"".join(parts)}</div>'


def _row(row: Sequence[str]) -> str:
    """Return one row of a table."""
    name, *values = map(html.escape, row)
    right = f"{_CELL}; text-align: right"
    cells = "".join(f'<td style="{right}">{value}</td>' for value in values)
    return f'<tr><th scope="row" style="{_CELL}; text-align: left">{name}</th>{cells}</tr>'
