"""Inputs of measured specimens, and their readings beside replicates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from prbayes._stats import INTERVAL
from prbayes._validate import Floats, called, share
from prbayes.model.parameters import element_name
from prbayes.plots.canvas import BLUE, GREY, INK, Canvas, Panel, named, refuse_labels, refuse_look


def plot_individuals(
    individuals: xr.DataTree,
    *,
    prob: float = INTERVAL,
    labels: Mapping[str, str] | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the inputs of each specimen, and its readings beside replicates of them.

    An input has an interval for each specimen, in ascending order of their means. A reading is a
    point, on an interval of replicates: other specimens under the same condition (a visual
    predictive check). Its horizontal axis is the first condition, else the specimen.

    Parameters
    ----------
    individuals : xarray.DataTree
        From `individuals`.
    prob : float
        Probability of the intervals.
    labels : mapping, optional
        Labels of inputs, conditions and simulators by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, and keywords of ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``interval`` and ``mean`` of inputs, and ``replicates``,
        ``median`` and ``observed`` of readings.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
    ...     data = [0.0, 1.0, 2.5, 4.0, 3.0, 1.5]
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, observed=data)
    >>> picture = prb.plots.plot_individuals(prb.individuals(prb.minimize(model)))
    >>> sorted(picture.viz["mean"])
    ['x']
    """
    refuse_look(labels, pc_kwargs)
    share(prob, "prob")
    groups = individuals.children if isinstance(individuals, xr.DataTree) else {}
    draws = groups["posterior"].to_dataset() if "posterior" in groups else xr.Dataset()
    has_specimens = any(str(dim).startswith("specimen") for dim in draws.dims)
    if not has_specimens or not {"posterior_predictive", "observed_data"} <= set(groups):
        raise TypeError(
            f"individuals: got {called(individuals)}, expected the DataTree that prb.individuals "
            "returns"
        )
    inputs = _elements(draws)
    observed = individuals["observed_data"].to_dataset()
    replicates = individuals["posterior_predictive"].to_dataset()
    curves = [str(name) for name, y in observed.data_vars.items() if y[0].size > 6]
    readings = _elements(observed.drop_vars(curves))
    replicated = _elements(replicates.drop_vars(curves))
    conditions = individuals["constant_data"].data_vars if "constant_data" in groups else {}
    refuse_labels(labels, [*inputs, *readings, *curves, *map(str, conditions), "specimen"])
    canvas = Canvas([*inputs, *readings, *curves], size=(4.6, 3.9), pc_kwargs=pc_kwargs)
    for name, values in inputs.items():
        panel = canvas.panels[name]
        mean = values.mean(axis=0)
        order = np.argsort(mean, kind="stable")
        places = np.arange(len(order))
        text = f"{prob:.0%} of the draws of a specimen"
        _intervals(panel, "interval", places, values[:, order], prob, text)
        panel.points("mean", (places, mean[order]), BLUE, size=14, legend="their mean")
        panel.axes(x="specimens in ascending order", y=named(name, labels))
    for name, y in readings.items():
        panel = canvas.panels[name]
        of_rows = {str(key): x.values for key, x in conditions.items() if x.size == y.size}
        x_name, x = next(iter(of_rows.items()), ("specimen", np.arange(y.size)))
        _intervals(panel, "replicates", x, replicated[name], prob, f"{prob:.0%} of replicates")
        median = np.nanmedian(replicated[name], axis=0)
        panel.points("median", (x, median), GREY, size=10, legend="their median")
        panel.points("observed", (x, y[0]), INK, size=18, legend="measured")
        panel.axes(x=named(x_name, labels), y=named(name, labels))
    for name in curves:
        _draw_curve(canvas.panels[name], observed[name], replicates[name], prob)
        dim = str(observed[name].dims[-1])
        canvas.panels[name].axes(x=named(dim, labels), y=named(name, labels))
    return canvas.finish()


def _draw_curve(panel: Panel, y: xr.DataArray, replicates: xr.DataArray, prob: float) -> None:
    """Draw the readings of all specimens over their outputs, and the range of replicates."""
    labels = y[y.dims[-1]].values
    x = labels.astype(float) if labels.dtype.kind in "iuf" else np.arange(labels.size, dtype=float)
    tail = (1 - prob) / 2
    values = replicates.values.reshape(-1, x.size)
    low, median, high = np.nanquantile(values, [tail, 0.5, 1 - tail], axis=0)
    panel.band("replicates", x, (low, high), GREY, legend=f"{prob:.0%} of replicates")
    panel.line("median", (x, median), GREY, legend="their median")
    places = np.broadcast_to(x, y.shape).ravel()
    panel.points("observed", (places, y.values.ravel()), INK, size=12, legend="measured")


def _elements(data: xr.Dataset) -> dict[str, Floats]:
    """Return values of each element by name, (P, n); P = 1 without draws."""
    elements = {}
    for name, array in data.items():
        values = array.values
        values = values.reshape(-1, *values.shape[2:]) if "chain" in array.dims else values[None]
        axes = [array[dim].values for dim in array.dims[array.ndim - values.ndim + 2 :]]
        for index in np.ndindex(values.shape[2:]):
            labels = [axis[i] for axis, i in zip(axes, index, strict=True)]
            elements[element_name(str(name), labels)] = values[:, :, *index]
    return elements


def _intervals(
    panel: Panel, visual: str, x: NDArray[Any], draws: Floats, prob: float, legend: str
) -> None:
    """Draw a vertical interval of draws, (P, n), at each place."""
    tail = (1 - prob) / 2
    low, high = np.nanquantile(draws, [tail, 1 - tail], axis=0)
    gap = np.full(len(low), np.nan)
    places = np.stack([x, x, gap], axis=1).ravel()
    ends = np.stack([low, high, gap], axis=1).ravel()
    panel.line(visual, (places, ends), GREY, width=1.5, legend=legend)
