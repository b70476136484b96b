"""What all pictures are drawn on: panels of an ArviZ `PlotCollection`, alike on each of its backends.

Plotting libraries are imported when a canvas is made.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

import numpy as np
import xarray as xr

from prbayes._checks import Floats

# Okabe and Ito's colours, which colour-blind readers tell apart; line styles tell them apart in grey.
BLUE, ORANGE, GREEN, VERMILION, PURPLE = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7"
INK, GREY = "B1", "B2"  # against the background, whatever it is
CYCLE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE)
SOLID, DASHED, DOTTED, DASHDOT = "C0", "C1", "C2", "C3"
CIRCLE, CROSS, DIAMOND = "C0", "C3", "C4"

Ticks = tuple[Sequence[float], Sequence[str]]  # positions and labels


def named(name: str, labels: Mapping[str, str] | None) -> str:
    """Return what a reader calls a variable: its label, that of the variable it is an element of, or its name."""
    given = labels or {}
    stem, bracket, rest = name.partition("[")
    return given.get(name) or (f"{given[stem]}{bracket}{rest}" if stem in given else name)


def grid_settings(
    panels: int, size: tuple[float, float], backend: str | None, pc_kwargs: dict[str, Any]
) -> dict[str, Any]:
    """Return keywords of `PlotCollection.wrap` for so many panels of a size in inches, one for each variable."""
    arviz: Any = import_module("arviz")
    settings: dict[str, Any] = {"cols": ["__variable__"], "col_wrap": 2 if panels == 4 else 3} | pc_kwargs
    backend = backend or arviz.rcParams["plot.backend"]
    columns = min(panels, settings["col_wrap"])
    rows = -(-panels // columns)
    width, height = size[0] * columns, size[1] * rows
    if backend == "matplotlib":
        figure: dict[str, Any] = {"figsize": (width, height), "figsize_units": "inches", "layout": "constrained"}
    else:
        room = 70 * rows if backend == "bokeh" else 60  # for the legend, which bokeh has below each panel
        figure = {"figsize": (100 * width, 100 * height + room), "figsize_units": "dots"}
    return settings | {"backend": backend, "figure_kwargs": figure | dict(settings.get("figure_kwargs", {}))}


class Canvas:
    """Collects what is to be drawn, by visual and panel, and draws it in `finish`.

    Parameters
    ----------
    panels : sequence of str
        Names, in order.
    size : (float, float)
        Of a panel, in inches.
    backend : str or None
    pc_kwargs : dict
        For `PlotCollection.wrap`.
    """

    def __init__(
        self, panels: Sequence[str], *, size: tuple[float, float], backend: str | None, pc_kwargs: dict[str, Any]
    ) -> None:
        arviz: Any = import_module("arviz")
        self._settings = grid_settings(len(panels), size, backend, pc_kwargs)
        self.backend = str(self._settings["backend"])
        self._library: Any = import_module(f"arviz_plots.backend.{self.backend}")
        data = xr.Dataset({name: (f"{name} point", np.zeros(2)) for name in panels})
        self._collection: Any = arviz.PlotCollection.wrap(data, **self._settings)
        self._drawn: dict[str, dict[str, tuple[str, tuple[Any, ...], dict[str, Any]]]] = {}
        self._legend: dict[str, None] = {}

    def _add(self, visual: str, panel: str, function: str, *data: Any, legend: str = "", **how: Any) -> None:
        self._drawn.setdefault(visual, {})[panel] = (function, data, how | self._legend_entry(legend))

    def _legend_entry(self, text: str) -> dict[str, Any]:
        if not text or self.backend == "none":
            return {}
        first = text not in self._legend
        self._legend[text] = None
        if self.backend == "plotly":
            return {"name": text, "legendgroup": text, "showlegend": first}
        return {"label": text} if self.backend == "matplotlib" else {"legend_label": text}

    def line(
        self,
        panel: str,
        visual: str,
        x: Any,
        y: Any,
        color: str,
        *,
        style: str = SOLID,
        width: float = 1.8,
        legend: str = "",
    ) -> None:
        """Draw a line."""
        how = {"color": color, "linestyle": style, "width": width}
        self._add(visual, panel, "line", np.asarray(x), np.asarray(y), legend=legend, **how)

    def band(
        self, panel: str, visual: str, x: Floats, sides: tuple[Floats, Floats], color: str, *, legend: str = ""
    ) -> None:
        """Shade what is between two curves."""
        self._add(visual, panel, "fill_between_y", x, *sides, color=color, alpha=0.25, legend=legend)

    def points(
        self,
        panel: str,
        visual: str,
        x: Any,
        y: Any,
        color: str,
        *,
        marker: str = CIRCLE,
        size: float = 30,
        legend: str = "",
    ) -> None:
        """Draw markers."""
        x, y = np.broadcast_arrays(np.atleast_1d(x), np.atleast_1d(y))
        size = size**0.5 if self.backend == "bokeh" else size  # a diameter there, an area elsewhere
        self._add(visual, panel, "scatter", x, y, color=color, marker=marker, size=size, legend=legend)

    def heights(self, panel: str, visual: str, axes: tuple[Floats, Floats], z: Floats, levels: Floats) -> None:
        """Draw heights over a plane, z of shape (x, y): pale colours from dark to light, and contours; even levels."""
        how: dict[str, Any] = {"levels": levels, "cmap": "cividis", "alpha": 0.45}
        if self.backend == "plotly":  # would choose levels of its own
            how["contours"] = {"start": levels[0], "end": levels[-1], "size": levels[1] - levels[0]}
        self._add(visual, panel, "contourf", *axes, np.minimum(z, levels[-1]), **how)
        self._add(f"{visual}_lines", panel, "contour", *axes, z, levels=levels[1:-1], color=GREY, alpha=0.6)

    def axes(
        self,
        panel: str,
        *,
        x: str = "",
        y: str = "",
        title: str = "",
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        xticks: Ticks | None = None,
        yticks: Ticks | None = None,
    ) -> None:
        """Name the axes of a panel, and say what they cover."""
        for function, text in (("title", title), ("xlabel", x), ("ylabel", y)):
            if text:
                self._add(function, panel, function, text)
        for function, limits in (("xlim", xlim), ("ylim", ylim)):
            if limits is not None:
                self._add(function, panel, function, limits)
        for function, ticks in (("xticks", xticks), ("yticks", yticks)):
            if ticks is not None:
                self._add(function, panel, function, *map(list, ticks))

    def finish(self) -> Any:
        """Draw everything, with a legend below the panels, and return the `PlotCollection`."""
        for visual, panels in self._drawn.items():

            def one(da: Any, target: Any, var_name: str, sel: Any, isel: Any, panels: Any = panels) -> Any:
                function, data, how = panels[var_name]
                drawn = getattr(self._library, function)(*data, target, **how)
                return None if isinstance(drawn, list) else drawn  # plotly's contours, one for each level

            kept = visual not in {"title", "xlabel", "ylabel", "xlim", "ylim", "xticks", "yticks"}
            names = list(panels)
            self._collection.map(one, visual, data=self._collection.data[names], subset_info=True, store_artist=kept)
        if self._legend:
            getattr(self, f"_legend_{self.backend}", lambda: None)()
        return self._collection

    def _targets(self) -> list[Any]:
        return [self._collection.get_target(name, {}) for name in self._collection.data.data_vars]

    def _legend_matplotlib(self) -> None:
        handles: dict[str, Any] = {}
        for axis in self._targets():
            for handle, text in zip(*axis.get_legend_handles_labels(), strict=True):
                handles.setdefault(text, handle)
        figure = self._collection.viz["figure"].item()
        characters = sum(len(text) + 8 for text in handles)
        columns = max(1, min(len(handles), int(len(handles) * 11.5 * figure.get_figwidth() / characters)))
        columns = -(-len(handles) // -(-len(handles) // columns))  # rows of equal length
        figure.legend(handles.values(), handles, loc="outside lower center", ncols=columns, frameon=False)

    def _legend_plotly(self) -> None:
        figure = self._collection.viz["figure"].item()
        below = {"orientation": "h", "xanchor": "center", "x": 0.5, "yanchor": "bottom", "yref": "container", "y": 0.02}
        figure.update_layout(legend=below, margin={"l": 70, "r": 20, "t": 70, "b": 110})

    def _legend_bokeh(self) -> None:
        for target in self._targets():
            if target.legend:
                legend = target.legend[0]
                widths = sorted(7 * len(i.label.value) + 40 for i in legend.items)
                legend.ncols = 2 if sum(widths[-2:]) < target.width - 60 else 1
                target.add_layout(legend, "below")
