"""What all pictures are drawn on: panels of an ArviZ `PlotCollection`, alike on each backend.

Plotting libraries are imported when a canvas is made.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
import xarray as xr

from prbayes._validate import Floats, texts
from prbayes.plots._colours import ColourScale, draw_colour_bar
from prbayes.plots._legends import draw_legend, legend_entry
from prbayes.plots._ticks import Ticks

# Colours that colour-blind readers tell apart (Okabe and Ito, Color Universal Design, 2008); line
# styles tell curves apart in grey.
BLUE, ORANGE, GREEN = "#0072B2", "#E69F00", "#009E73"
VERMILION, PURPLE = "#D55E00", "#CC79A7"
CYCLE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE)
# ArviZ's codes, which each backend translates: against the background, styles, markers.
INK, GREY, PALE = "B1", "B2", "B3"
SOLID, DASHED, DOTTED, DASHDOT = "C0", "C1", "C2", "C3"
CIRCLE, CROSS, DIAMOND = "C0", "C3", "C4"


# What has no artist of its own to keep.
_OF_AXES = frozenset({"title", "xlabel", "ylabel", "xlim", "ylim", "xticks", "yticks"})

# Those of ArviZ.
_BACKENDS = ("matplotlib", "bokeh", "plotly", "none")

Limits = tuple[float, float]


def grid_settings(
    panels: int, size: tuple[float, float], backend: str | None, pc_kwargs: dict[str, Any]
) -> dict[str, Any]:
    """Return keywords of `PlotCollection.wrap` for so many panels of a size in inches."""
    arviz: Any = import_module("arviz")
    backend = backend or arviz.rcParams["plot.backend"]

    # Three panels a row; four make a square
    settings = {"cols": ["__variable__"], "col_wrap": 2 if panels == 4 else 3, **pc_kwargs}
    whole = figure_size(settings.pop("figsize", None))
    columns = min(panels, settings["col_wrap"])
    rows = -(-panels // columns)

    width, height = size
    across, down = whole or (width * columns, height * rows)
    figure = _figure_settings(backend, across, down, rows)
    figure |= settings.get("figure_kwargs", {})
    return settings | {"backend": backend, "figure_kwargs": figure}


def figure_size(given: Any) -> tuple[float, float] | None:
    """Return width and height in inches, as given, or raise.

    Raises
    ------
    ValueError
        If they are not two positive numbers.
    """
    if given is None:
        return None
    try:
        width, height = map(float, given)
    except (TypeError, ValueError):
        width = height = math.nan
    if not (0 < width < math.inf and 0 < height < math.inf):
        raise ValueError(
            f"figsize: got {given!r:.60}, expected width and height of the picture in inches, such "
            "as (8, 5)"
        )
    return width, height


def _figure_settings(backend: str, width: float, height: float, rows: int) -> dict[str, Any]:
    """Return the keywords of a figure of so many inches."""
    if backend == "matplotlib":
        # Its layout makes room for the legend
        size = (width, height)
        return {"figsize": size, "figsize_units": "inches", "layout": "constrained"}
    # By judgement: 100 pixels an inch, and two or three rows of text below the panels for the
    # legend; bokeh has one below each panel.
    legend = 70 * rows if backend == "bokeh" else 60
    across = 100 * width
    down = 100 * height + legend
    return {"figsize": (across, down), "figsize_units": "dots"}


def refuse_look(labels: object, backend: object, pc_kwargs: Mapping[str, Any]) -> None:
    """Raise if labels are no texts by name, a size is none, or there is no such backend.

    Before anything is done.

    Raises
    ------
    TypeError, ValueError
        With what was expected.
    """
    if labels is not None:
        texts(labels, "labels")
    figure_size(pc_kwargs.get("figsize"))
    if backend is not None and backend not in _BACKENDS:
        raise ValueError(f"backend: got {backend!r:.60}, expected one of {', '.join(_BACKENDS)}")


@dataclass(frozen=True, eq=False)
class _Call:
    """A call of a backend's function, without the panel that it is for."""

    function: str
    data: tuple[Any, ...]
    keywords: dict[str, Any]

    def on(self, target: Any, library: Any) -> Any:
        """Make the call on a panel of the backend; return the artist, if there is one to keep."""
        function = getattr(library, self.function)
        artist = function(*self.data, target, **self.keywords)
        if isinstance(artist, list):
            return None  # plotly's contours, one for each level
        return artist


class Canvas:
    """Collects what is to be drawn, by visual and panel, and draws it in `finish`.

    Parameters
    ----------
    panels : sequence of str
        Names, in order.
    size : (float, float)
        Of a panel, in inches.
    backend : str or None
        That of ArviZ's settings by default.
    pc_kwargs : dict
        For `PlotCollection.wrap`.
    """

    def __init__(
        self,
        panels: Sequence[str],
        *,
        size: tuple[float, float],
        backend: str | None,
        pc_kwargs: dict[str, Any],
    ) -> None:
        arviz: Any = import_module("arviz")
        settings = grid_settings(len(panels), size, backend, pc_kwargs)
        self.backend = str(settings["backend"])
        self._library: Any = import_module(f"arviz_plots.backend.{self.backend}")
        # One variable for each panel, of a dimension of its own
        data = xr.Dataset()
        for name in panels:
            data[name] = (f"{name} point", np.zeros(2))
        self._collection: Any = arviz.PlotCollection.wrap(data, **settings)
        self._calls: dict[str, dict[str, _Call]] = {}
        self._legend: set[str] = set()
        self._empty: list[str] = []
        self._scales: dict[tuple[str, str], ColourScale] = {}  # by visual and panel

    def panel(self, name: str) -> Panel:
        """Return the panel of a name, to draw on."""
        return Panel(self, name)

    def add(
        self,
        panel: str,
        visual: str,
        function: str,
        *data: Any,
        legend: str = "",
        **keywords: Any,
    ) -> None:
        """Plan a call of the backend's function, which will be ``visual`` of the panel."""
        if legend:
            first = legend not in self._legend
            self._legend.add(legend)
            keywords |= legend_entry(self.backend, legend, first=first)
        by_panel = self._calls.setdefault(visual, {})
        by_panel[panel] = _Call(function, data, keywords)

    def leave_empty(self, panel: str) -> None:
        """Plan to show nothing of a panel, not even its axes."""
        self._empty.append(panel)

    def tell_colours(self, panel: str, visual: str, scale: ColourScale) -> None:
        """Plan a bar that says what the colours of ``visual`` mean."""
        self._scales[visual, panel] = scale

    def finish(self) -> Any:
        """Draw everything, with a legend below the panels, and return the `PlotCollection`."""
        for visual, by_panel in self._calls.items():
            self._draw(visual, by_panel)
        for (visual, name), scale in self._scales.items():
            figure = self._collection.viz["figure"].item()
            target = self._collection.get_target(name, {})
            artist = self._collection.viz[visual][name].item()
            draw_colour_bar(self.backend, figure, target, artist, scale)
        for name in self._empty:
            _hide(self.backend, self._collection.get_target(name, {}))
        if self._legend and self.backend != "none":
            variables = self._collection.data.data_vars
            targets = [self._collection.get_target(name, {}) for name in variables]
            figure = self._collection.viz["figure"].item()
            draw_legend(self.backend, figure, targets)
        return self._collection

    def _draw(self, visual: str, by_panel: dict[str, _Call]) -> None:
        """Draw a visual on the panels that have it."""

        def one(da: Any, target: Any, var_name: str, sel: Any, isel: Any) -> Any:
            return by_panel[var_name].on(target, self._library)

        self._collection.map(
            one,
            visual,
            data=self._collection.data[list(by_panel)],
            subset_info=True,
            store_artist=visual not in _OF_AXES,
        )


def _hide(backend: str, target: Any) -> None:
    """Take the axes of a panel away; its place stays empty."""
    if backend == "matplotlib":
        target.set_axis_off()
    elif backend == "bokeh":
        target.visible = False
    elif backend == "plotly":
        axes = target.figure.get_subplot(target.row, target.col)
        for axis in (axes.xaxis, axes.yaxis):
            target.figure.layout[axis.plotly_name] = None


@dataclass(frozen=True, eq=False)
class Panel:
    """One panel of a canvas; each visual is drawn once on it."""

    canvas: Canvas
    name: str

    def line(
        self,
        visual: str,
        x: Any,
        y: Any,
        color: str,
        *,
        style: str = SOLID,
        width: float | None = 1.8,
        legend: str = "",
    ) -> None:
        """Draw a line; without a width, of the backend's."""
        how: dict[str, Any] = {"color": color, "linestyle": style}
        if width is not None:
            how["width"] = width
        data = (np.asarray(x), np.asarray(y))
        self.canvas.add(self.name, visual, "line", *data, legend=legend, **how)

    def band(
        self,
        visual: str,
        x: Floats,
        sides: tuple[Floats, Floats],
        color: str,
        *,
        alpha: float = 0.25,
        legend: str = "",
    ) -> None:
        """Shade what is between two curves, the lower one first."""
        self.canvas.add(
            self.name,
            visual,
            "fill_between_y",
            x,
            *sides,
            legend=legend,
            color=color,
            alpha=alpha,
        )

    def points(
        self,
        visual: str,
        x: Any,
        y: Any,
        color: str,
        *,
        marker: str = CIRCLE,
        size: float = 30,
        legend: str = "",
    ) -> None:
        """Draw markers of an area, in square points."""
        if self.canvas.backend == "bokeh":
            size = size**0.5  # a diameter there
        self.canvas.add(
            self.name,
            visual,
            "scatter",
            *np.broadcast_arrays(np.atleast_1d(x), np.atleast_1d(y)),
            legend=legend,
            color=color,
            marker=marker,
            size=size,
        )

    def heights(
        self,
        visual: str,
        axes: tuple[Floats, Floats],
        z: Floats,
        levels: Floats,
        scale: ColourScale,
    ) -> None:
        """Draw heights over a plane, z of shape (x, y): colours from dark to light, and contours.

        The levels are even; what is above the last has the colour of the last. A bar says what the
        colours mean.
        """
        self.canvas.tell_colours(self.name, visual, scale)
        how: dict[str, Any] = {"levels": levels, "cmap": "cividis", "alpha": 0.45}
        if self.canvas.backend == "plotly":  # would choose levels of its own
            how["contours"] = {
                "start": levels[0],
                "end": levels[-1],
                "size": levels[1] - levels[0],
            }
        below = np.minimum(z, levels[-1])
        self.canvas.add(self.name, visual, "contourf", *axes, below, **how)
        self.canvas.add(
            self.name,
            f"{visual}_lines",
            "contour",
            *axes,
            z,
            levels=levels[1:-1],
            color=GREY,
            alpha=0.6,
        )

    def blank(self) -> None:
        """Leave the panel empty, without axes: a place that holds the others apart."""
        self.canvas.leave_empty(self.name)

    def axes(
        self,
        *,
        x: str = "",
        y: str = "",
        title: str = "",
        xlim: Limits | None = None,
        ylim: Limits | None = None,
        xticks: Ticks | None = None,
        yticks: Ticks | None = None,
    ) -> None:
        """Name the axes, and say what they cover; what is not given is left to the backend."""
        given: dict[str, tuple[Any, ...]] = {}
        for what, text in (("title", title), ("xlabel", x), ("ylabel", y)):
            if text:
                given[what] = (text,)
        for what, limits in (("xlim", xlim), ("ylim", ylim)):
            if limits is not None:
                given[what] = (limits,)
        for what, ticks in (("xticks", xticks), ("yticks", yticks)):
            if ticks is not None:
                given[what] = ticks
        for what, data in given.items():
            self.canvas.add(self.name, what, what, *data)
