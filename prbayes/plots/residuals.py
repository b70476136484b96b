"""Residuals of the readings against the prediction, and against time or another label."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from prbayes._validate import Labels, wrong_value
from prbayes.plots.canvas import (
    BLUE,
    GREY,
    check_options,
    finish,
    ink,
    named,
    panels,
    refuse_labels,
)
from prbayes.plots.selection import Coords, FilterVars, VarNames, select_variables, subset

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_residuals(
    residuals: xr.DataTree,
    *,
    var_names: VarNames | None = None,
    filter_vars: FilterVars | None = None,
    coords: Coords | None = None,
    labels: Labels | None = None,
    **pc_kwargs: Any,
) -> Figure:
    """Draw readings against predictions, and weighted residuals against prediction and time.

    Readings of a right model scatter around the diagonal, more closely with the specimen's own
    inputs (``IPRED``) than with those of the population (``PRED``). Residuals (``CWRES``) scatter
    around zero without a trend, 95 % of them between the lines at -1.96 and 1.96.

    Parameters
    ----------
    residuals : xarray.DataTree
        From `residuals`.
    var_names : str or sequence of str, optional
        Panels, in this order; all by default.
    filter_vars : {None, "like", "regex"}
        How ``var_names`` are read, as by ArviZ.
    coords : mapping, optional
        Labels of specimens and outputs by dimension, such as ``{"specimen": [0, 1, 2]}``.
    labels : mapping, optional
        Labels of simulators and dimensions by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, ``col_wrap`` panels in a row, and ``figure_kwargs`` for
        ``matplotlib.pyplot.figure``.

    Returns
    -------
    matplotlib.figure.Figure
        With the panels ``{name}``, ``{name}, CWRES against PRED`` and, for outputs with labels that
        are numbers, such as ``time``, ``{name}, CWRES against time``. Selected specimens have the
        first alone.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
    ...     data = [0.0, 1.0, 2.5, 4.0, 3.0, 1.5]
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, observed=data)
    >>> figure = prb.plots.plot_residuals(prb.residuals(prb.minimize(model)))
    >>> [axis.get_label() for axis in figure.axes]
    ['y', 'y, CWRES against PRED']
    """
    check_options(labels, pc_kwargs)
    trees = residuals.children if isinstance(residuals, xr.DataTree) else {}
    if not trees or not all("CWRES" in tree for tree in trees.values()):
        raise wrong_value(residuals, "residuals", "the DataTree that prb.residuals returns")
    datasets = {name: tree.to_dataset() for name, tree in trees.items()}
    dims = {dim for data in datasets.values() for dim in data.dims} - {"input"}
    datasets = {name: subset(data, coords, dims) for name, data in datasets.items()}
    plan: dict[str, tuple[str, str | None]] = {}
    for name, data in datasets.items():
        plan[name] = name, None
        if not np.isfinite(data["CWRES"]).any():
            continue
        plan[f"{name}, CWRES against PRED"] = name, "PRED"
        dim = str(data["DV"].dims[-1])
        if dim != "specimen" and data[dim].dtype.kind in "iuf":
            plan[f"{name}, CWRES against {dim}"] = name, dim
    refuse_labels(labels, [*datasets, *(x for _, x in plan.values() if x)])
    names = select_variables(list(plan), var_names, filter_vars)
    figure, axes = panels(names, size=(4.6, 3.9), pc_kwargs=pc_kwargs)
    for title, axis in axes.items():
        name, horizontal = plan[title]
        data = datasets[name]
        label = named(name, labels)
        if horizontal is None:
            for key, color, text in (("PRED", GREY, "population"), ("IPRED", BLUE, "specimen")):
                axis.scatter(data[key], data["DV"], 12, color=color, label=f"{text} ({key})")
            lowest = float(np.nanmin(data["DV"]))
            highest = float(np.nanmax(data["DV"]))
            limits = [lowest, highest]
            axis.plot(limits, limits, color=ink(), linewidth=1)
            axis.set(xlabel=f"predicted {label}", ylabel=f"measured {label}")
            continue
        x = data[horizontal].broadcast_like(data["CWRES"])
        axis.scatter(x, data["CWRES"], 12, color=BLUE, gid="residuals")
        axis.axhline(0.0, color=ink(), linewidth=1)
        for level in (-1.96, 1.96):
            axis.axhline(level, color=GREY, linewidth=1, linestyle="--")
        x_label = f"predicted {label}" if horizontal == "PRED" else named(horizontal, labels)
        axis.set(xlabel=x_label, ylabel="CWRES")
    return finish(figure)
