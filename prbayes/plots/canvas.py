"""Panels of an ArviZ `PlotCollection`, drawn by Matplotlib, with one legend below them; labels.

Plotting libraries are imported when a canvas is made.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np
import xarray as xr

from prbayes._validate import Floats, called, texts
from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import variable_of
from prbayes.response.inputs import aleatory_names

# Colours that colour-blind readers distinguish (Okabe and Ito, Color Universal Design, 2008); line
# styles distinguish curves in grey.
BLUE, ORANGE, GREEN = "#0072B2", "#E69F00", "#009E73"
VERMILION, PURPLE = "#D55E00", "#CC79A7"
CYCLE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE)
# Codes of ArviZ for colours against the background, line styles and markers.
INK, GREY, PALE = "B1", "B2", "B3"
SOLID, DASHED, DOTTED, DASHDOT = "C0", "C1", "C2", "C3"
CIRCLE, CROSS, DIAMOND = "C0", "C3", "C4"

Limits = tuple[float, float]
Ticks = tuple[list[float], list[str]]  # positions and labels


def refuse_look(labels: object, pc_kwargs: Mapping[str, Any]) -> None:
    """Raise if labels are not texts by name, or the size is wrong, before anything is computed."""
    if labels is not None:
        texts(labels, "labels")
    if "backend" in pc_kwargs:
        raise TypeError(
            f"backend: got {called(pc_kwargs['backend'])}, expected none: pictures are drawn by "
            "Matplotlib"
        )
    figsize = pc_kwargs.get("figsize")
    try:
        width, height = (1.0, 1.0) if figsize is None else map(float, figsize)
    except (TypeError, ValueError):
        width = height = np.nan
    if not (0 < width < np.inf and 0 < height < np.inf):
        raise ValueError(
            f"figsize: got {figsize!r:.60}, expected width and height of the picture in inches, "
            "such as (8, 5)"
        )


class Canvas:
    """A figure with named panels, in order, of a size in inches each."""

    def __init__(
        self, names: Sequence[str], *, size: tuple[float, float], pc_kwargs: dict[str, Any]
    ) -> None:
        # Three panels a row; four make a square.
        n = len(names)
        settings = {"cols": ["__variable__"], "col_wrap": 2 if n == 4 else 3, **pc_kwargs}
        columns = min(n, settings["col_wrap"])
        rows = -(-n // columns)
        figure = {
            "figsize": settings.pop("figsize", None) or (size[0] * columns, size[1] * rows),
            "figsize_units": "inches",
            "layout": "constrained",  # makes room for the legend
        }
        settings["figure_kwargs"] = figure | settings.get("figure_kwargs", {})
        arviz: Any = import_module("arviz")
        data = xr.Dataset({name: (f"{name} point", np.zeros(2)) for name in names})
        self._collection = arviz.PlotCollection.wrap(data, backend="matplotlib", **settings)
        library = import_module("arviz_plots.backend.matplotlib")
        targets = {name: self._collection.get_target(name, {}) for name in names}
        self.panels = {name: Panel(library, target) for name, target in targets.items()}

    def finish(self) -> Any:
        """Return the `PlotCollection`, with a legend, and the artists by visual and panel."""
        by_visual: dict[str, dict[str, Any]] = {}
        for name, panel in self.panels.items():
            for visual, artist in panel.artists.items():
                by_visual.setdefault(visual, {})[name] = ((), np.array(artist, dtype=object))
        for visual, artists in by_visual.items():
            self._collection.viz[visual] = xr.DataTree(xr.Dataset(artists))
        figure = self._collection.viz["figure"].item()
        draw_legend(figure, [panel.target for panel in self.panels.values()])
        return self._collection


def draw_legend(figure: Any, targets: list[Any]) -> None:
    """Draw one legend below all panels, with as many columns as fit and rows of equal length."""
    handles: dict[str, Any] = {}
    for target in targets:
        for handle, text in zip(*target.get_legend_handles_labels(), strict=True):
            handles.setdefault(text, handle)
    n = len(handles)
    if not n:
        return
    # An inch takes 11.5 characters of the default font; a mark with its gaps is as wide as eight.
    characters = sum(len(text) + 8 for text in handles)
    fitting = max(1, min(n, int(n * 11.5 * figure.get_figwidth() / characters)))
    rows = -(-n // fitting)
    columns = -(-n // rows)
    figure.legend(
        handles.values(), handles, loc="outside lower center", ncols=columns, frameon=False
    )


@dataclass(frozen=True, eq=False)
class Panel:
    """One panel of a canvas; each visual is drawn once on it."""

    library: Any  # ArviZ's drawing functions
    target: Any  # axes of Matplotlib
    artists: dict[str, Any] = field(default_factory=dict)  # by visual

    def line(
        self,
        visual: str,
        xy: Any,
        color: str,
        *,
        style: str = SOLID,
        width: float | None = 1.8,
        legend: str = "",
    ) -> None:
        """Draw a line through places x and y; without a width, that of Matplotlib's settings."""
        look: dict[str, Any] = {"color": color, "linestyle": style, "label": legend}
        if width is not None:
            look["width"] = width
        self.artists[visual] = self.library.line(*map(np.asarray, xy), self.target, **look)

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
        """Shade the area between two curves, the lower one first."""
        self.artists[visual] = self.library.fill_between_y(
            x, *sides, self.target, color=color, alpha=alpha, label=legend
        )

    def points(
        self,
        visual: str,
        xy: Any,
        color: str,
        *,
        marker: str = CIRCLE,
        size: float = 30,
        legend: str = "",
    ) -> None:
        """Draw markers of an area, in square points, at places x and y."""
        places = np.broadcast_arrays(*map(np.atleast_1d, xy))
        self.artists[visual] = self.library.scatter(
            *places, self.target, color=color, marker=marker, size=size, label=legend
        )

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
        """Set labels, limits and ticks of the axes; the rest is left to Matplotlib."""
        settings = {"title": title, "xlabel": x, "ylabel": y, "xlim": xlim, "ylim": ylim}
        self.target.set(**{key: value for key, value in settings.items() if value})
        if xticks is not None:
            self.target.set_xticks(*xticks)
        if yticks is not None:
            self.target.set_yticks(*yticks)


# -- ticks -----------------------------------------------------------------------------------


def round_ticks(low: float, high: float) -> Ticks:
    """Return up to five round numbers within a range, and their labels."""
    from matplotlib.ticker import MaxNLocator  # heavy, and only needed for pictures

    places = np.asarray(MaxNLocator(5, steps=[1.0, 2.0, 2.5, 5.0, 10.0]).tick_values(low, high))
    step = places[1] - places[0]
    rounding = 1e-9 * step
    places = places[(places >= low - rounding) & (places <= high + rounding)]
    return places.tolist(), ["0" if abs(x) < step / 2 else f"{x:.12g}" for x in places]


def scale_by_decades(target: Any, values: Floats) -> None:
    """Make the y axis logarithmic if all values are positive and the largest is 20 times more."""
    finite = values[np.isfinite(values)]
    if not finite.size or finite.min() <= 0 or finite.max() <= 20 * finite.min():
        return
    from matplotlib.ticker import LogLocator, NullLocator

    # At most seven powers of ten; 1, 2, 5 within two decades.
    factors = (1.0, 2.0, 5.0) if finite.max() < 100 * finite.min() else (1.0,)
    target.set_yscale("log")
    target.yaxis.set_major_locator(LogLocator(subs=factors, numticks=6))
    target.yaxis.set_major_formatter("{x:g}")
    target.yaxis.set_minor_locator(NullLocator())


# -- labels of variables, statistics and metrics ---------------------------------------------


STATISTIC_LABELS = {
    "beta": "beta (1: posterior)",
    "accept_rate": "acceptance rate",
    "n_steps": "steps per stage",
    "log_marginal_likelihood": "log marginal likelihood",
}
# Any other metric is called by its class.
METRIC_LABELS = {
    "AreaMetric": "area metric",
    "KullbackLeibler": "Kullback-Leibler divergence",
    "LogLikelihood": "log-likelihood",
    "ProbabilityResidual": "probability residual",
}
# Metrics of several outputs that are made of a metric of one.
_LIFTED_LABELS = {
    "Joint": "joint {}",
    "MarginalCorrelation": "{} of marginals, with correlations",
}


def metric_label(representation: str) -> str:
    """Return the label of a metric by its representation, such as 'Joint(AreaMetric())'."""
    lifted = re.match(r"(\w+)\((?:metric=)?(\w+)\(", representation)
    if lifted and lifted[1] in _LIFTED_LABELS:
        return _LIFTED_LABELS[lifted[1]].format(METRIC_LABELS.get(lifted[2], lifted[2]))
    name = representation.partition("(")[0]
    return METRIC_LABELS.get(name, name)


def named(name: str, labels: Mapping[str, str] | None) -> str:
    """Return an element's label, or its variable's with the index, or else its name."""
    labels = labels or {}
    if name in labels:
        return labels[name]
    variable = variable_of(name)
    return labels.get(variable, variable) + name.removeprefix(variable)


def refuse_labels(
    labels: Mapping[str, str] | None, shown: Iterable[str], *, evaluator: Evaluator | None = None
) -> None:
    """Raise for labels of unknown names; without an evaluator only if no label is shown."""
    if not labels:
        return
    names = list(dict.fromkeys(shown))
    allowed = {*names, *map(variable_of, names), *STATISTIC_LABELS, *METRIC_LABELS}
    if evaluator is not None:
        allowed |= set(map(str, evaluator.model.named_vars))
        for node in evaluator.simulators:
            allowed |= {node.name, node.outputs.dim, *map(str, node.outputs.names)}
            inputs = set(map(variable_of, aleatory_names(node.inputs, node.responses.function)))
            allowed |= inputs | {f"{name} of {node.name}" for name in inputs}
    unknown = [name for name in labels if not {name, variable_of(name)} & allowed]
    if unknown and (evaluator is not None or len(unknown) == len(labels)):
        more = ", ..." if len(names) > 12 else ""
        raise KeyError(
            f"labels: got {unknown[0]!r:.60}, which is no name of what is shown; expected some of "
            f"{', '.join(names[:12])}{more}"
        )
