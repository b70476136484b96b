"""Sensitivity indices of a decision quantity."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from prbayes._validate import Labels, wrong_type
from prbayes.plots.canvas import (
    BLUE,
    GREY,
    VERMILION,
    check_options,
    finish,
    named,
    panels,
    refuse_labels,
)
from prbayes.plots.selection import FilterVars, VarNames, select_variables

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_sensitivity(
    table: xr.Dataset,
    *,
    var_names: VarNames | None = None,
    filter_vars: FilterVars | None = None,
    labels: Labels | None = None,
    **pc_kwargs: Any,
) -> Figure:
    """Draw the sensitivity indices of hyperparameters and inputs, a row per factor.

    A dot is the share of the variance that a factor explains by itself, a diamond the share that is
    left when all other factors are known, each with two standard errors to either side.

    Parameters
    ----------
    table : xarray.Dataset
        From `sensitivity`.
    var_names : str or sequence of str, optional
        Hyperparameters and inputs, or elements of them, in this order; all by default.
    filter_vars : {None, "like", "regex"}
        How ``var_names`` are read, as by ArviZ.
    labels : mapping, optional
        Labels of factors by name.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, ``col_wrap`` panels in a row, and ``figure_kwargs`` for
        ``matplotlib.pyplot.figure``.

    Returns
    -------
    matplotlib.figure.Figure
        With the panels ``hyperparameter`` and ``input``.

    Raises
    ------
    TypeError, KeyError
        If it is no table of `sensitivity`, or an argument is not as described.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0, name="x")
    ...     y = prb.Simulator("y", lambda x: x, x, metric=prb.AreaMetric(), observed=[0, 2, 4])
    >>> table = prb.sensitivity(prb.minimize(model), prb.decision.Mean(np.square, x))
    >>> figure = prb.plots.plot_sensitivity(table)
    >>> [axis.get_label() for axis in figure.axes]
    ['hyperparameter', 'input']
    """
    check_options(labels, pc_kwargs)
    variables = {"first", "total", "first_error", "total_error", "factor", "kind"}
    if not isinstance(table, xr.Dataset) or not variables <= set(table.variables):
        raise wrong_type(table, "plot_sensitivity: table", "the Dataset of prb.sensitivity")
    names = select_variables(table.factor.values.tolist(), var_names, filter_vars)
    table = table.sel(factor=names)
    refuse_labels(labels, names)
    titles = {
        "hyperparameter": "share of the quantity's variance",
        "input": f"share of the variance of\n{table.attrs.get('of_inputs', 'the response')}",
    }
    by_kind = {kind: table.sel(factor=(table.kind == kind).values) for kind in titles}
    by_kind = {kind: factors for kind, factors in by_kind.items() if factors.sizes["factor"]}
    n = max(factors.sizes["factor"] for factors in by_kind.values())
    size = (4.8, 1.6 + 0.4 * n)
    figure, axes = panels(list(by_kind), size=size, pc_kwargs=pc_kwargs)
    for kind, axis in axes.items():
        factors = by_kind[kind]
        rows = n - 1.0 - np.arange(factors.sizes["factor"])
        for end in (0.0, 1.0):
            axis.axvline(end, color=GREY, linestyle=":", linewidth=1.0)
        for key, shift, color, marker, text in (
            ("first", 0.12, BLUE, "o", "by itself"),
            ("total", -0.12, VERMILION, "D", "with all others known"),
        ):
            indices = factors[key].values
            errors = 2 * factors[f"{key}_error"].values
            y = rows + shift
            axis.hlines(
                y, indices - errors, indices + errors, color=color, linewidth=2, gid=f"{key}_error"
            )
            axis.scatter(indices, y, 30, color=color, marker=marker, label=text, gid=key, zorder=3)
        axis.set(xlabel=titles[kind], ylim=(-0.6, n - 0.4))
        axis.set_yticks(rows, [named(str(factor), labels) for factor in factors.factor.values])
    return finish(figure)
