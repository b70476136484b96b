"""Results side by side."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from prbayes._display import percentage
from prbayes._validate import Labels, flag, wrong_type
from prbayes.plots.canvas import (
    BLUE,
    GREY,
    METRIC_LABELS,
    check_options,
    finish,
    ink,
    named,
    panels,
    refuse_labels,
    round_ticks,
)
from prbayes.plots.selection import Coords, FilterVars, VarNames, select_variables, subset
from prbayes.results.compare import scores_in

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_comparison(
    comparison: xr.Dataset,
    *,
    scores: bool = False,
    var_names: VarNames | None = None,
    filter_vars: FilterVars | None = None,
    coords: Coords | None = None,
    labels: Labels | None = None,
    **pc_kwargs: Any,
) -> Figure:
    """Draw the estimate and interval of each result, a row per result, a panel per hyperparameter.

    Parameters
    ----------
    comparison : xarray.Dataset
        From `compare`.
    scores : bool
        Draw instead the discrepancy of each result's population under each metric, a panel per
        metric; smaller is better, each metric in its own units.
    var_names : str or sequence of str, optional
        Hyperparameters, or elements of them; or metrics. All by default, otherwise in this order.
    filter_vars : {None, "like", "regex"}
        How ``var_names`` are read, as by ArviZ.
    coords : mapping, optional
        Such as ``{"result": ["optimum", "posterior"]}``.
    labels : mapping, optional
        Labels of hyperparameters, results or scores by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, ``col_wrap`` panels in a row, and ``figure_kwargs`` for
        ``matplotlib.pyplot.figure``.

    Returns
    -------
    matplotlib.figure.Figure
        Its panels have the labels of the hyperparameters or metrics.

    Raises
    ------
    TypeError, KeyError, ValueError
        If it is no comparison, has no scores, or an argument is not as described.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
    ...     )
    >>> table = prb.compare({"optimum": prb.minimize(model)}, model=model)
    >>> figure = prb.plots.plot_comparison(table)
    >>> [axis.get_label() for axis in figure.axes]
    ['mu']
    """
    check_options(labels, pc_kwargs)
    flag(scores, "scores")
    variables = {"estimate", "lower", "upper"}
    if not isinstance(comparison, xr.Dataset) or not variables <= set(comparison.data_vars):
        raise wrong_type(comparison, "plot_comparison", "the Dataset of prb.compare")
    comparison = subset(comparison, coords)
    names = list(map(str, comparison.hyperparameter.values))
    if scores:
        names = [str(name) for name in scores_in(comparison)]
        if not names:
            raise ValueError(
                "plot_comparison: got no scores, expected those of prb.compare(results, "
                "model=model)"
            )
    names = select_variables(names, var_names, filter_vars)
    results = list(map(str, comparison.result.values))
    refuse_labels(labels, [*names, *results])
    texts = [named(result, labels) for result in results]
    n = len(results)
    rows = np.arange(n - 1.0, -1.0, -1.0)  # heights of the rows; the first result is on top

    figure, axes = panels(names, size=(4.8, 1.6 + 0.34 * n), pc_kwargs=pc_kwargs)
    for name, axis in axes.items():
        if scores:
            values = comparison[name].values
            finite = np.isfinite(values)
            axis.scatter(values[finite], rows[finite], 45, color=BLUE, gid="score")
        else:
            row = comparison.sel(hyperparameter=name)
            lower, upper, estimate = row.lower.values, row.upper.values, row.estimate.values
            values = np.concatenate([lower, upper, estimate])
            if n > 1:  # The line shows how far the other estimates are from the first.
                axis.axvline(
                    estimate[0],
                    color=GREY,
                    linestyle=":",
                    label=f"estimate of {texts[0]}",
                    gid="first",
                )
            text = f"{percentage(comparison.attrs.get('interval', 0.89))} interval"
            has_ends = np.isfinite(lower) & np.isfinite(upper)
            ends = rows[has_ends], lower[has_ends], upper[has_ends]
            axis.hlines(*ends, color=BLUE, linewidth=3, label=text, gid="interval")
            axis.scatter(
                estimate, rows, 45, color=ink(), label="estimate", gid="estimate", zorder=3
            )
        finite = values[np.isfinite(values)]
        low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
        margin = 0.06 * (high - low) or 0.01 * max(abs(low), 1.0)  # room for markers
        xlim = float(low - margin), float(high + margin)
        axis.set(
            xlabel=named(name, METRIC_LABELS | dict(labels or {})), xlim=xlim, ylim=(-0.6, n - 0.4)
        )
        axis.set_xticks(*round_ticks(*xlim))
        axis.set_yticks(rows, texts)
    return finish(figure)
