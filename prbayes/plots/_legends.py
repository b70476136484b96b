"""One legend below the panels of a picture, on each backend."""

from __future__ import annotations

from typing import Any


def legend_entry(backend: str, text: str, *, first: bool) -> dict[str, Any]:
    """Return keywords that give an artist an entry; ``first``: no other has the text yet."""
    if backend == "matplotlib":
        return {"label": text}
    if backend == "bokeh":
        return {"legend_label": text}
    if backend == "plotly":
        return {"name": text, "legendgroup": text, "showlegend": first}
    return {}


def draw_legend(backend: str, figure: Any, targets: list[Any]) -> None:
    """Draw one legend of all entries of the panels, ``targets``."""
    if backend == "matplotlib":
        _below_matplotlib(figure, targets)
    elif backend == "plotly":
        _below_plotly(figure)
    elif backend == "bokeh":
        _below_bokeh(targets)


def _below_matplotlib(figure: Any, targets: list[Any]) -> None:
    # The first artist of each text stands for all
    handles: dict[str, Any] = {}
    for axis in targets:
        for handle, text in zip(*axis.get_legend_handles_labels(), strict=True):
            handles.setdefault(text, handle)

    # As many columns as fit, then rows of equal length
    count = len(handles)
    # By judgement, of the default font: 11.5 characters an inch, a mark with its gaps takes eight
    characters = sum(len(text) + 8 for text in handles)
    available = 11.5 * figure.get_figwidth()
    fitting = int(count * available / characters)
    fitting = max(1, min(count, fitting))
    rows = -(-count // fitting)
    columns = -(-count // rows)
    figure.legend(
        handles.values(), handles, loc="outside lower center", ncols=columns, frameon=False
    )


def _below_plotly(figure: Any) -> None:
    below = {
        "orientation": "h",
        "xanchor": "center",
        "x": 0.5,
        "yanchor": "bottom",
        "yref": "container",
        "y": 0.02,
    }
    margin = {"l": 70, "r": 20, "t": 70, "b": 110}  # pixels; the legend's rows are at the bottom
    figure.update_layout(legend=below, margin=margin)


def _below_bokeh(targets: list[Any]) -> None:
    """Move the legend of each panel, which bokeh has for each, below it."""
    for target in targets:
        if not target.legend:
            continue
        legend = target.legend[0]
        texts = [item.label.value for item in legend.items]
        # Pixels of a character, of the mark before a text, and of the axis beside the legend
        widths = sorted(7 * len(text) + 40 for text in texts)
        two_fit = sum(widths[-2:]) < target.width - 60
        legend.ncols = 2 if two_fit else 1
        target.add_layout(legend, "below")
