"""Sensitivity indices of a decision quantity."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from prbayes.plots.canvas import (
    BLUE,
    CIRCLE,
    DIAMOND,
    DOTTED,
    GREY,
    VERMILION,
    Canvas,
    named,
    refuse_labels,
    refuse_look,
)


def plot_sensitivity(
    table: xr.Dataset,
    *,
    labels: Mapping[str, str] | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the sensitivity indices of hyperparameters and inputs, a row per factor.

    A dot is the share of the variance that a factor explains by itself, a diamond the share that is
    left when all other factors are known, each with two standard errors to either side.

    Parameters
    ----------
    table : xarray.Dataset
        From `sensitivity`.
    labels : mapping, optional
        Labels of factors by name.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, and keywords of ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        With the panels ``hyperparameter`` and ``input``; its ``viz`` has the artists ``first`` and
        ``total``, and the errors ``first_0``, ``total_0`` and so on by factor.

    Raises
    ------
    TypeError
        If it is no table of `sensitivity`.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0, name="x")
    ...     y = prb.Simulator("y", lambda x: x, x, metric=prb.AreaMetric(), observed=[0, 2, 4])
    >>> table = prb.sensitivity(prb.minimize(model), prb.decision.Mean(np.square, x))
    >>> sorted(prb.plots.plot_sensitivity(table).viz["first"])
    ['hyperparameter', 'input']
    """
    refuse_look(labels, pc_kwargs)
    variables = {"first", "total", "first_error", "total_error", "factor", "kind"}
    if not isinstance(table, xr.Dataset) or not variables <= set(table.variables):
        got = type(table).__name__
        raise TypeError(
            f"plot_sensitivity: table: got {got}, expected the Dataset of prb.sensitivity"
        )
    refuse_labels(labels, map(str, table.factor.values))
    titles = {
        "hyperparameter": "share of the quantity's variance",
        "input": f"share of the variance of\n{table.attrs.get('of_inputs', 'the response')}",
    }
    by_kind = {kind: table.sel(factor=(table.kind == kind).values) for kind in titles}
    n = max(factors.sizes["factor"] for factors in by_kind.values())
    limits = (-0.6, n - 0.4)
    canvas = Canvas(list(titles), size=(4.8, 1.6 + 0.4 * n), pc_kwargs=pc_kwargs)
    for kind, title in titles.items():
        factors = by_kind[kind]
        rows = n - 1.0 - np.arange(factors.sizes["factor"])
        panel = canvas.panels[kind]
        for end in (0.0, 1.0):
            panel.line(f"end_{end:.0f}", ([end, end], limits), GREY, style=DOTTED, width=1.0)
        for key, shift, color, marker, text in (
            ("first", 0.12, BLUE, CIRCLE, "by itself"),
            ("total", -0.12, VERMILION, DIAMOND, "with all others known"),
        ):
            indices = factors[key].values
            errors = 2 * factors[f"{key}_error"].values
            y = rows + shift
            for i in np.flatnonzero(np.isfinite(indices)):
                ends = [indices[i] - errors[i], indices[i] + errors[i]]
                panel.line(f"{key}_{i}", (ends, [y[i], y[i]]), color, width=2)
            panel.points(key, (indices, y), color, marker=marker, legend=text)
        names = [named(str(factor), labels) for factor in factors.factor.values]
        panel.axes(x=title, ylim=limits, yticks=(rows.tolist(), names))
    return canvas.finish()
