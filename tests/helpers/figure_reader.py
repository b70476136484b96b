"""How to read a figure: its artists, their places, the sides of a band, the legend's texts."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

Array = np.ndarray[Any, Any]


def panel(figure: Figure, name: str) -> Any:
    (axis,) = (axis for axis in figure.axes if axis.get_label() == name)
    return axis


def panels(figure: Figure, gid: str) -> list[str]:
    """Return the names of the panels that have an artist."""
    axes = [axis for axis in figure.axes if axis.findobj(lambda x: x.get_gid() == gid)]
    return [str(axis.get_label()) for axis in axes]


def artist(figure: Figure, gid: str, name: str) -> Any:
    (drawn,) = panel(figure, name).findobj(lambda x: x.get_gid() == gid)
    return drawn


def xy(figure: Figure, gid: str, name: str) -> Array:
    """Return the places of a line or of markers, shape (2, n)."""
    drawn = artist(figure, gid, name)
    if hasattr(drawn, "get_offsets"):
        return np.array(drawn.get_offsets().T, dtype=float)
    return np.array(drawn.get_data(), dtype=float)


def sides(figure: Figure, gid: str, name: str, at: Array) -> Array:
    """Return the lower and the upper side of a band at some places, shape (2, n)."""
    x, y = np.asarray(artist(figure, gid, name).get_paths()[0].vertices).T
    there = [y[np.isclose(x, place, atol=1e-9)] for place in at]
    return np.array([[v.min() for v in there], [v.max() for v in there]])


def texts(figure: Figure) -> list[str]:
    (legend,) = figure.legends
    return [text.get_text() for text in legend.get_texts()]
