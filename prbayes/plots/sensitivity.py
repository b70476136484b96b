"""What moves a decision quantity."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from prbayes.plots._canvas import (
    BLUE,
    CIRCLE,
    DIAMOND,
    DOTTED,
    GREY,
    VERMILION,
    Canvas,
    Panel,
    refuse_look,
)
from prbayes.plots._names import named, refuse_labels

_PANELS = ("hyperparameter", "input")
_MARKERS = {"first": CIRCLE, "total": DIAMOND}


def plot_sensitivity(
    table: xr.Dataset,
    *,
    labels: Mapping[str, str] | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the shares of hyperparameters and inputs, a row per factor.

    A dot is the share that a factor explains by itself, a diamond the one that is left when all
    others are known, each with two standard errors to either side.

    Parameters
    ----------
    table : xarray.Dataset
        From `sensitivity`.
    labels : mapping, optional
        What a reader calls a factor, by its name.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        ``figsize=(8, 5)``, in inches, of the whole picture; others go to
        ``arviz.PlotCollection.wrap``, such as ``col_wrap``.

    Returns
    -------
    arviz.PlotCollection
        With the panels ``hyperparameter`` and ``input``; its ``viz`` has the artists ``first`` and
        ``total``, and the errors ``first_0``, ``total_0`` and so on by factor.

    Raises
    ------
    TypeError
        If it is no table of shares.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0, name="x")
    ...     y = prb.Simulator("y", lambda x: x, x, metric=prb.AreaMetric(), observed=[0, 2, 4])
    >>> table = prb.sensitivity(prb.minimize(model), prb.decision.Mean(np.square, x))
    >>> sorted(prb.plots.plot_sensitivity(table, backend="none").viz["first"])
    ['hyperparameter', 'input']
    """
    refuse_look(labels, backend, pc_kwargs)
    needed = {"first", "total", "first_error", "total_error", "factor", "kind"}
    if not isinstance(table, xr.Dataset) or not needed <= set(table.variables):
        got = type(table).__name__
        raise TypeError(
            f"plot_sensitivity: table: got {got}, expected the Dataset of prb.sensitivity"
        )
    by_panel = {kind: table.sel(factor=(table.kind == kind).values) for kind in _PANELS}
    refuse_labels(labels, map(str, table.factor.values))
    count = max(own.sizes["factor"] for own in by_panel.values())
    top = count - 1.0
    limits = (-0.6, top + 0.6)
    size = (4.8, 1.6 + 0.4 * count)
    canvas = Canvas(list(_PANELS), size=size, backend=backend, pc_kwargs=pc_kwargs)
    titles = {
        "hyperparameter": "share of the quantity's variance",
        "input": f"share of the variance of\n{table.attrs.get('of_inputs', 'the response')}",
    }
    for kind, title in titles.items():
        own = by_panel[kind]
        rows = top - np.arange(own.sizes["factor"])
        panel = canvas.panel(kind)
        for end in (0.0, 1.0):
            panel.line(f"end_{end:.0f}", [end, end], limits, GREY, style=DOTTED, width=1.0)
        _draw(panel, own, "first", rows + 0.12, BLUE, "by itself")
        _draw(panel, own, "total", rows - 0.12, VERMILION, "with all others known")
        names = [named(str(factor), labels) for factor in own.factor.values]
        panel.axes(x=title, ylim=limits, yticks=(rows.tolist(), names))
    return canvas.finish()


def _draw(panel: Panel, own: xr.Dataset, key: str, rows: Any, color: str, text: str) -> None:
    """Draw shares with two standard errors."""
    shares = own[key].values
    errors = own[f"{key}_error"].values
    low = shares - 2 * errors
    high = shares + 2 * errors
    for i in np.flatnonzero(np.isfinite(shares)):
        row = rows[i]
        panel.line(f"{key}_{i}", [low[i], high[i]], [row, row], color, width=2)
    panel.points(key, shares, rows, color, marker=_MARKERS[key], legend=text)
