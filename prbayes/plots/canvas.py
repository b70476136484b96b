"""Figures with named panels and one legend below them; colours, ticks and labels.

Plotting libraries are imported when a figure is made.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from prbayes._validate import (
    Floats,
    Labels,
    NamedValues,
    positive_integer,
    texts,
    wrong_value,
)
from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import variable_of
from prbayes.response.inputs import aleatory_names
from prbayes.response.outputs import with_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Colours that colour-blind readers distinguish (Okabe and Ito, Color Universal Design, 2008); line
# styles distinguish curves in grey.
BLUE, ORANGE, GREEN = "#0072B2", "#E69F00", "#009E73"
VERMILION, PURPLE = "#D55E00", "#CC79A7"
CYCLE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE)
# Grey is legible on a light and on a dark background.
GREY, PALE = "#707070", "#949494"

Limits = tuple[float, float]


def check_options(labels: object, pc_kwargs: NamedValues, *, by_arviz: bool = False) -> None:
    """Raise if labels are not texts by name, or an option of the figure is wrong."""
    if labels is not None:
        texts(labels, "labels")
    unknown = set(pc_kwargs) - {"figsize", "col_wrap", "figure_kwargs"}
    if unknown and not by_arviz:
        raise wrong_value(
            pc_kwargs[min(unknown)],
            min(unknown),
            "figsize, col_wrap or figure_kwargs: Matplotlib draws this picture",
        )
    if "col_wrap" in pc_kwargs:
        positive_integer(pc_kwargs["col_wrap"], "col_wrap")
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


def layout(n: int, size: tuple[float, float], pc_kwargs: NamedValues) -> tuple[int, dict[str, Any]]:
    """Return the number of columns of n panels of a size, and the options of their figure."""
    # A row has three panels, but four panels make a square.
    columns = min(n, pc_kwargs.get("col_wrap", 2 if n == 4 else 3))
    figsize = pc_kwargs.get("figsize") or (size[0] * columns, size[1] * -(-n // columns))
    # The constrained layout makes room for the legend.
    options = {"figsize": figsize, "layout": "constrained"}
    return columns, options | pc_kwargs.get("figure_kwargs", {})


def panels(
    names: Sequence[str], *, size: tuple[float, float], pc_kwargs: NamedValues
) -> tuple[Figure, dict[str, Axes]]:
    """Return a figure of pyplot, and its panels by name; a panel has the name as its label."""
    from matplotlib import pyplot as plt  # heavy, and only needed for pictures

    columns, options = layout(len(names), size, pc_kwargs)
    figure = plt.figure(**options)
    vars(figure)["_ipython_display_"] = partial(shown_once, figure)
    rows = -(-len(names) // columns)
    axes = {
        name: figure.add_subplot(rows, columns, i + 1, label=name) for i, name in enumerate(names)
    }
    return figure, axes


def shown_once(figure: Figure) -> None:
    """Close a figure that a notebook displays, so that pyplot does not display it again.

    A notebook displays the last value of a cell, and then pyplot its open figures. By a
    NotImplementedError IPython displays the figure in its usual way.
    """
    import matplotlib as mpl
    from matplotlib import pyplot as plt

    if "inline" in mpl.get_backend():
        plt.close(figure)
    raise NotImplementedError


def ink() -> str:
    """Return the colour of text, which is strong on any background."""
    import matplotlib as mpl

    return str(mpl.rcParams["text.color"])


def fill(
    axis: Axes,
    x: Any,
    low: Any,
    high: Any = 0.0,
    *,
    color: str = BLUE,
    alpha: float = 0.25,
    **texts: Any,
) -> None:
    """Fill the area between two curves, in pale blue by default."""
    axis.fill_between(x, low, high, color=color, alpha=alpha, linewidth=0, **texts)


def finish(figure: Figure) -> Figure:
    """Draw one legend below all panels, with as many columns as fit and rows of equal length."""
    handles: dict[str, Any] = {}
    for axis in figure.axes:
        for handle, text in zip(*axis.get_legend_handles_labels(), strict=True):
            handles.setdefault(text, handle)
    n = len(handles)
    if not n:
        return figure
    # An inch takes 11.5 characters of the default font; a mark with its gaps is as wide as eight.
    characters = sum(len(text) + 8 for text in handles)
    fitting = max(1, min(n, int(n * 11.5 * figure.get_figwidth() / characters)))
    rows = -(-n // fitting)
    columns = -(-n // rows)
    figure.legend(
        handles.values(), handles, loc="outside lower center", ncols=columns, frameon=False
    )
    return figure


# -- ticks -----------------------------------------------------------------------------------


def round_ticks(low: float, high: float) -> tuple[list[float], list[str]]:
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

    # The axis has at most seven powers of ten, so that the labels do not overlap. Within two
    # decades it has ticks at 1, 2 and 5.
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
# labels of metrics; a metric that is not listed has the name of its class
METRIC_LABELS = {
    "AreaMetric": "area metric",
    "KullbackLeibler": "Kullback-Leibler divergence",
    "LogLikelihood": "log-likelihood",
    "ProbabilityResidual": "probability residual",
}


def metric_label(representation: str) -> str:
    """Return the label of a metric by its representation, such as 'Joint(AreaMetric())'."""
    joint = re.match(r"Joint\((?:metric=)?(\w+)\(", representation)
    if joint:
        return f"joint {METRIC_LABELS.get(joint[1], joint[1])}"
    name = representation.partition("(")[0]
    return METRIC_LABELS.get(name, name)


def counted_title(n: int, noun: str, **counts: Any) -> str:
    """Return a title such as '25 measured values, 1 failed', without counts of zero."""
    return f"{n} {noun}" + "".join(f", {m} {name}" for name, m in counts.items() if m)


def named(name: str, labels: Labels | None) -> str:
    """Return an element's label, or its variable's with the index, or else its name."""
    labels = labels or {}
    if name in labels:
        return labels[name]
    variable = variable_of(name)
    return labels.get(variable, variable) + name.removeprefix(variable)


def with_label(name: str, unit: str, labels: Labels | None) -> str:
    """Return the label that the user gave, or else the name with its unit."""
    label = named(name, labels)
    return with_unit(label, unit) if label == name else label


def refuse_labels(
    labels: Labels | None, shown: Iterable[str], *, evaluator: Evaluator | None = None
) -> None:
    """Raise if a label has an unknown name; without an evaluator only if no label is shown."""
    if not labels:
        return
    names = list(dict.fromkeys(shown))
    inputs = set()
    allowed = {*names, *map(variable_of, names), *STATISTIC_LABELS, *METRIC_LABELS}
    if evaluator is not None:
        allowed |= set(map(str, evaluator.model.named_vars))
        for node in evaluator.simulators:
            allowed |= {node.name, node.outputs.dim, *map(str, node.outputs.names)}
            own = set(map(variable_of, aleatory_names(node.inputs, node.responses.function)))
            allowed |= own | {f"{name} of {node.name}" for name in own}
            inputs |= own
    unknown = [name for name in labels if not {name, variable_of(name)} & allowed]
    if unknown and (evaluator is not None or len(unknown) == len(labels)):
        names += sorted(inputs - set(map(variable_of, names)))
        more = ", ..." if len(names) > 12 else ""
        raise KeyError(
            f"labels: got {unknown[0]!r:.60}, expected names that the picture shows, some of "
            f"{', '.join(names[:12])}{more}"
        )
