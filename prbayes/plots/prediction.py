"""Measured responses of new specimens beside their prediction."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from prbayes._display import percentage
from prbayes._stats import INTERVAL, distribution_function
from prbayes._validate import Labels, share
from prbayes.plots.canvas import (
    BLUE,
    check_options,
    counted_title,
    fill,
    finish,
    ink,
    panels,
    refuse_labels,
    with_label,
)
from prbayes.plots.curves import (
    GRID_POINTS,
    axis_range,
    central_range,
    pointwise_band,
    staircase,
)
from prbayes.plots.selection import Coords, FilterVars, VarNames, select
from prbayes.validation.pit import comparables

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_prediction(
    observed: Any,
    predicted: xr.DataArray | Mapping[str, xr.DataArray],
    *,
    var_names: VarNames | None = None,
    filter_vars: FilterVars | None = None,
    coords: Coords | None = None,
    prob: float = INTERVAL,
    labels: Labels | None = None,
    **pc_kwargs: Any,
) -> Figure:
    """Draw the distribution functions of measured responses and of their prediction.

    The steps are the measured values, the curve is the predicted distribution of all populations
    together, and the band contains the share ``prob`` of the populations at each response. Steps
    outside the band over a long stretch are tested by `area_test`. Because of specimens that failed
    (+inf) the steps end below one.

    Parameters
    ----------
    observed : array_like, shape (n,) or (n, m), or a mapping of such
        Of specimens that were not used in the calibration; by condition, if by name.
    predicted : xarray.DataArray, or a mapping of such
        From `predict`: dims (chain, draw, sample), and one of outputs; by the same names.
    var_names : str or sequence of str, optional
        Conditions, in this order; all by default.
    filter_vars : {None, "like", "regex"}
        How ``var_names`` are read, as by ArviZ.
    coords : mapping, optional
        Labels of outputs by dimension, such as ``{"output": ["load"]}``.
    prob : float
        Share of the populations in the band.
    labels : mapping, optional
        Labels of conditions or outputs by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, ``col_wrap`` panels in a row, and ``figure_kwargs`` for
        ``matplotlib.pyplot.figure``.

    Returns
    -------
    matplotlib.figure.Figure
        With a panel for each condition and output, whose label is its name; of more than eight
        outputs eight from the first to the last.

    Raises
    ------
    TypeError, ValueError, KeyError
        If an argument is not as described, or measured and predicted are of different conditions or
        outputs.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", np.exp, x, metric=prb.AreaMetric(), observed=[1.0, 2.0, 4.0])
    >>> later = prb.predict(prb.minimize(model), lambda x: 2 * np.exp(x), x, name="later")
    >>> prb.plots.plot_prediction([2.5, 3.0, 9.0], later).axes[0].get_label()
    'later'
    """
    check_options(labels, pc_kwargs)
    prob = share(prob, "prob")
    pairs = {pair.name: pair for pair in comparables(observed, predicted, "plot_prediction")}
    elements = {name: (pair.condition, pair.coords) for name, pair in pairs.items()}
    names = select(elements, var_names, filter_vars, coords)
    refuse_labels(labels, names)
    figure, axes = panels(names, size=(5.0, 3.9), pc_kwargs=pc_kwargs)
    for name, axis in axes.items():
        pair = pairs[name]
        measured = pair.measured
        weights = pair.weights
        limits = axis_range(measured, central_range(pair.predicted, weights, tail=0.005), None)
        grid = np.linspace(*limits, GRID_POINTS)
        curves = distribution_function(pair.predicted, weights, grid)
        if len(curves) > 1:
            sides = pointwise_band(curves, prob)
            text = f"{percentage(prob)} of the populations"
            fill(axis, grid, *sides, label=text, gid="band")
        middle = curves.mean(axis=0)
        axis.plot(grid, middle, color=BLUE, linewidth=2.2, label="predicted", gid="predicted")
        steps = staircase(measured, np.full(measured.size, 1 / measured.size), *limits)
        axis.plot(*steps, color=ink(), linewidth=1.4, label="measured", gid="measured")
        title = counted_title(measured.size, "measured values", failed=np.isinf(measured).sum())
        label = with_label(name, pair.unit, labels)
        axis.set(xlabel=label, ylabel="share of specimens", title=title)
    return finish(figure)
