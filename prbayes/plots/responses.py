"""Measured responses beside those of the calibrated population."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._checks import Floats
from prbayes.estimate.optimum import Optimum
from prbayes.model.node import Node
from prbayes.plots._canvas import DASHED, INK, VERMILION, Canvas, named
from prbayes.plots._curves import (
    central_range,
    densities,
    distribution_functions,
    histogram,
    staircase,
    typical_bandwidth,
)
from prbayes.plots._ensemble import read_before, read_result, supported
from prbayes.plots._populations import calibrated, check_level, middle_and_band

_log = logging.getLogger("prbayes")
_GRID, _SOME = 257, 40  # points of a curve; populations that set the bandwidth


def plot_responses(
    result: Optimum | xr.DataTree,
    *,
    model: pm.Model | None = None,
    before: Mapping[str, Any] | bool | None = None,
    ecdf: bool = False,
    level: float = 0.89,
    draws: int | None = None,
    labels: Mapping[str, str] | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the responses before and after a calibration against the measured ones, one panel per simulator.

    Measured responses are a histogram, in outline, with a mark for each, or steps. The calibrated curve is the
    posterior predictive distribution, or the optimum's population. The band holds the share ``level`` of the
    populations at each response: those of the posterior's draws, or of the optimum's sampling distribution where it
    is known.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`; or with a ``posterior`` group, from any sampler.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    before : dict or bool, optional
        Hyperparameters before the calibration, in the user's own units; False for none. By default the
        optimiser's first point, if it was given a start or did not look for one, and else the prior's initial point;
        the legend says which.
    ecdf : bool
        Draw distribution functions, which need no bandwidth, in place of densities.
    level : float
    draws : int, optional
        Number of populations in the band; 200 where they cost no response (`Reweighted`), 40 elsewhere, where each
        costs n responses per simulator.
    labels : mapping, optional
        What a reader calls a simulator, by its name, with units: ``{"crack": "relative crack length"}``.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        For ``arviz.PlotCollection.wrap``, such as ``figure_kwargs`` or ``col_wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``measured``, ``rug`` (densities only), ``before``, ``band`` and ``after``.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, or the result lacks a free variable of the model.
    DesignError
        If stored responses do not support the populations.

    Notes
    -----
    Densities of responses are Gaussian kernel densities with Silverman's bandwidth, widened where weights are
    uneven. Specimens that failed (+inf) are missing from the area under a curve.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0])
    >>> prb.plot_responses(prb.minimize(model), backend="none").viz["after"].name
    'after'
    """
    check_level(level)
    shown = read_result(result, model, "prb.plot_responses", draws)
    theta, what = read_before(result, shown.evaluator, before)
    if len(theta) and not supported(shown.evaluator, theta)[0]:
        _log.warning("plot_responses: before (%s): left out, because stored responses do not reach there", what)
        theta = theta[:0]
    center = shown.thetas[:0] if shown.center is None else shown.center
    nodes = shown.evaluator.nodes
    canvas = Canvas([n.name for n in nodes], size=(5.4, 4.2), backend=backend, pc_kwargs=pc_kwargs)
    for k, node in enumerate(nodes):
        earlier = shown.evaluator.populations(theta, k) if len(theta) else None
        values, weights = shown.evaluator.populations(np.vstack([center, shown.thetas]), k)
        low, high = _reach(node, values, weights, earlier)
        grid = np.linspace(low, high, _GRID)
        curves = distribution_functions(values, weights, grid) if ecdf else _density(values, weights, grid)
        after, band = middle_and_band(curves, len(center), level)
        top = _measured(canvas, node, low, high, ecdf=ecdf)
        top = max(top, after.max(), 0.0 if band is None else band[1].max())
        ylim = None
        if earlier is not None:
            y = distribution_functions(*earlier, grid) if ecdf else _density(*earlier, grid)
            canvas.line(node.name, "before", grid, y[0], VERMILION, style=DASHED, legend=f"before: {what}")
            if y.max() > 2 * top:  # a narrow peak is cut off, not the rest flattened
                ylim = (-0.05 * top, 2 * top)
        calibrated(canvas, node.name, grid, after, band, shown, level)
        count = f"{node.target.observed.size} measured values"
        y_axis = "share of specimens" if ecdf else "density"
        canvas.axes(node.name, x=named(node.name, labels), y=y_axis, title=count, xlim=(low, high), ylim=ylim)
    return canvas.finish()


def _reach(node: Node, values: Floats, weights: Floats, earlier: tuple[Floats, Floats] | None) -> tuple[float, float]:
    """Return what the axis covers: the data, the calibrated populations, and the earlier one unless it is far off."""
    finite = node.target.observed[np.isfinite(node.target.observed)]
    low, high = central_range(values, weights, 0.005)
    low, high = min(low, finite.min()), max(high, finite.max())
    if earlier is not None:
        first, last = central_range(*earlier, 0.05)
        room = (high - low) / 2
        low, high = max(min(first, low), low - room), min(max(last, high), high + room)
    margin = 0.03 * (high - low)
    return float(low - margin), float(high + margin)


def _density(values: Floats, weights: Floats, grid: Floats) -> Floats:
    return densities(values, weights, grid, typical_bandwidth(values[:_SOME], weights[:_SOME]))


def _measured(canvas: Canvas, node: Node, low: float, high: float, *, ecdf: bool) -> float:
    """Draw the data; return how high they reach."""
    observed, weights = node.target.observed, node.target.weights
    if ecdf:
        canvas.line(node.name, "measured", *staircase(observed, weights, low, high), INK, width=1.4, legend="measured")
        return 1.0
    x, y = histogram(observed, weights)
    canvas.line(node.name, "measured", x, y, INK, width=0.9, legend="measured")
    canvas.points(node.name, "rug", observed[np.isfinite(observed)], 0.0, INK, marker="|", size=60)
    return float(y.max())
