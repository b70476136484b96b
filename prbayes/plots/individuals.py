"""Inputs of measured specimens, and their readings beside replicates."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from prbayes._display import percentage
from prbayes._stats import INTERVAL
from prbayes._validate import Floats, Labels, NamedArrays, share, wrong_value
from prbayes.model.parameters import split_elements, stacked_draws
from prbayes.plots.canvas import (
    BLUE,
    GREY,
    check_options,
    fill,
    finish,
    ink,
    named,
    panels,
    refuse_labels,
)
from prbayes.plots.selection import Coords, FilterVars, VarNames, select_variables, subset

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot_individuals(
    individuals: xr.DataTree,
    *,
    var_names: VarNames | None = None,
    filter_vars: FilterVars | None = None,
    coords: Coords | None = None,
    prob: float = INTERVAL,
    labels: Labels | None = None,
    **pc_kwargs: Any,
) -> Figure:
    """Draw the inputs of each specimen, and its readings beside replicates of them.

    An input has an interval for each specimen, in ascending order of their means. A reading is a
    point, on an interval of replicates: other specimens under the same condition (a visual
    predictive check). Its horizontal axis is the first condition, else the specimen.

    Parameters
    ----------
    individuals : xarray.DataTree
        From `individuals`.
    var_names : str or sequence of str, optional
        Inputs and simulators, or elements of them, in this order; all by default.
    filter_vars : {None, "like", "regex"}
        How ``var_names`` are read, as by ArviZ.
    coords : mapping, optional
        Labels of specimens and outputs by dimension, such as ``{"specimen": [0, 1, 2]}``.
    prob : float
        Probability of the intervals.
    labels : mapping, optional
        Labels of inputs, conditions and simulators by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, ``col_wrap`` panels in a row, and ``figure_kwargs`` for
        ``matplotlib.pyplot.figure``.

    Returns
    -------
    matplotlib.figure.Figure
        With a panel for each input and each output, whose label is its name.

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
    >>> figure = prb.plots.plot_individuals(prb.individuals(prb.minimize(model)))
    >>> [axis.get_label() for axis in figure.axes]
    ['x', 'y']
    """
    check_options(labels, pc_kwargs)
    share(prob, "prob")
    groups = specimen_groups(individuals, coords)
    observed, replicates = groups["observed_data"], groups["posterior_predictive"]
    conditions = groups.get("constant_data", xr.Dataset()).data_vars
    inputs = _elements(groups["posterior"])
    curves = [str(name) for name, y in observed.data_vars.items() if y[0].size > 6]
    readings = _elements(observed.drop_vars(curves))
    replicated = _elements(replicates.drop_vars(curves))
    names = select_variables([*inputs, *readings, *curves], var_names, filter_vars)
    refuse_labels(labels, [*names, *map(str, conditions), "specimen"])
    figure, axes = panels(names, size=(4.6, 3.9), pc_kwargs=pc_kwargs)
    for name, axis in axes.items():
        axis.set_ylabel(named(name, labels))
        if name in inputs:
            _draw_inputs(axis, inputs[name], prob)
        elif name in readings:
            y = readings[name]
            of_rows = {str(key): x.values for key, x in conditions.items() if x.size == y.size}
            x_name, x = next(iter(of_rows.items()), ("specimen", np.arange(y.size)))
            _draw_readings(axis, x, y[0], replicated[name], prob)
            axis.set_xlabel(named(x_name, labels))
        else:
            _draw_curve(axis, observed[name], replicates[name], prob)
            axis.set_xlabel(named(str(observed[name].dims[-1]), labels))
    return finish(figure)


def specimen_groups(individuals: object, coords: Coords | None) -> dict[str, xr.Dataset]:
    """Return the groups of the result of `individuals` at ``coords``, or raise if it is none."""
    trees = individuals.children if isinstance(individuals, xr.DataTree) else {}
    groups = {name: tree.to_dataset() for name, tree in trees.items()}
    draws = groups.get("posterior", xr.Dataset())
    has_specimens = any(str(dim).startswith("specimen") for dim in draws.dims)
    if not has_specimens or not {"posterior_predictive", "observed_data"} <= set(groups):
        raise wrong_value(individuals, "individuals", "the DataTree that prb.individuals returns")
    if "product" in draws.dims:
        raise ValueError(
            f"individuals: got the specimens of {draws.sizes['product']} products, expected those "
            "of one: prb.individuals(fleet.sel(product=...))"
        )
    dims = {dim for group in groups.values() for dim in group.dims} - {"chain", "draw"}
    return {name: subset(group, coords, dims) for name, group in groups.items()}


def _draw_inputs(axis: Axes, draws: Floats, prob: float) -> None:
    """Draw an interval of the draws of each specimen, (P, n), in ascending order of their means."""
    mean = draws.mean(axis=0)
    order = np.argsort(mean, kind="stable")
    places = np.arange(len(order))
    text = f"{percentage(prob)} of the draws of a specimen"
    _draw_intervals(axis, places, draws[:, order], prob, label=text, gid="interval")
    axis.scatter(places, mean[order], 14, color=BLUE, label="their mean", gid="mean", zorder=3)
    axis.set_xlabel("specimens in ascending order")
    axis.locator_params("x", integer=True)


def _draw_readings(axis: Axes, x: Any, y: Floats, replicates: Floats, prob: float) -> None:
    """Draw the reading of each specimen, (n,), on an interval of replicates, (P, n)."""
    text = f"{percentage(prob)} of replicates"
    _draw_intervals(axis, x, replicates, prob, label=text, gid="replicates")
    median = np.nanmedian(replicates, axis=0)
    axis.scatter(x, median, 10, color=GREY, label="their median", gid="median", zorder=3)
    axis.scatter(x, y, 18, color=ink(), label="measured", gid="observed", zorder=3)


def _draw_curve(axis: Axes, y: xr.DataArray, replicates: xr.DataArray, prob: float) -> None:
    """Draw the readings of all specimens over their outputs, and the range of replicates."""
    labels = y[y.dims[-1]].values
    x = labels.astype(float) if labels.dtype.kind in "iuf" else np.arange(labels.size, dtype=float)
    tail = (1 - prob) / 2
    values = replicates.values.reshape(-1, x.size)
    low, median, high = np.nanquantile(values, [tail, 0.5, 1 - tail], axis=0)
    text = f"{percentage(prob)} of replicates"
    fill(axis, x, low, high, color=GREY, label=text, gid="replicates")
    axis.plot(x, median, color=GREY, label="their median", gid="median")
    places = np.broadcast_to(x, y.shape)
    axis.scatter(places, y, 12, color=ink(), label="measured", gid="observed", zorder=3)


def _elements(data: xr.Dataset) -> NamedArrays:
    """Return values by the names of elements, (P, n): P draws, or one of data, of n specimens."""
    draws = data if "chain" in data.dims else data.expand_dims(("chain", "draw"))
    elements: NamedArrays = {}
    for name, values in stacked_draws(draws).items():
        n_draws, n = values.shape[:2]
        columns = values.values.reshape(n_draws, n, -1)
        names = split_elements({name: values[0]})
        elements |= zip(names, np.moveaxis(columns, -1, 0), strict=True)
    return elements


def _draw_intervals(axis: Axes, x: Any, draws: Floats, prob: float, **texts: Any) -> None:
    """Draw a vertical interval of draws, (P, n), at each place."""
    tail = (1 - prob) / 2
    low, high = np.nanquantile(draws, [tail, 1 - tail], axis=0)
    axis.vlines(x, low, high, color=GREY, linewidth=1.5, **texts)
