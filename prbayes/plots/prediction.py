"""Measured responses of new specimens beside their prediction."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from prbayes._stats import INTERVAL, distribution_function
from prbayes._validate import share
from prbayes.plots.canvas import BLUE, INK, Canvas, named, refuse_labels, refuse_look
from prbayes.plots.curves import (
    GRID_POINTS,
    axis_range,
    central_range,
    pointwise_band,
    staircase,
)
from prbayes.response.outputs import with_unit
from prbayes.validation.conditions import comparables


def plot_prediction(
    observed: Any,
    predicted: xr.DataArray | Mapping[str, xr.DataArray],
    *,
    prob: float = INTERVAL,
    labels: Mapping[str, str] | None = None,
    **pc_kwargs: Any,
) -> Any:
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
    prob : float
        Share of the populations in the band.
    labels : mapping, optional
        Labels of conditions or outputs by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, and keywords of ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        A panel for each condition and output; of more than eight outputs eight from the first to
        the last. Its ``viz`` has the artists ``band``, ``predicted`` and ``measured``.

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
    >>> list(prb.plots.plot_prediction([2.5, 3.0, 9.0], later).viz["measured"])
    ['later']
    """
    refuse_look(labels, pc_kwargs)
    prob = share(prob, "prob")
    pairs = comparables(observed, predicted, "plot_prediction")
    names = [pair.name for pair in pairs]
    refuse_labels(labels, names)
    canvas = Canvas(names, size=(5.0, 3.9), pc_kwargs=pc_kwargs)
    for pair in pairs:
        panel = canvas.panels[pair.name]
        measured = pair.measured
        weights = pair.weights
        limits = axis_range(measured, central_range(pair.predicted, weights, tail=0.005), None)
        grid = np.linspace(*limits, GRID_POINTS)
        curves = distribution_function(pair.predicted, weights, grid)
        if len(curves) > 1:
            text = f"{prob:.0%} of the populations"
            panel.band("band", grid, pointwise_band(curves, prob), BLUE, legend=text)
        panel.line("predicted", (grid, curves.mean(axis=0)), BLUE, width=2.2, legend="predicted")
        steps = staircase(measured, np.full(measured.size, 1 / measured.size), *limits)
        panel.line("measured", steps, INK, width=1.4, legend="measured")
        failed = np.count_nonzero(np.isinf(measured))
        title = f"{measured.size} measured values" + (f", {failed} failed" if failed else "")
        label = named(pair.name, labels)
        label = with_unit(label, pair.unit) if label == pair.name else label
        panel.axes(x=label, y="share of specimens", title=title)
    return canvas.finish()
