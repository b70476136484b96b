"""The calibrated population of each input."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pymc as pm
import xarray as xr

from prbayes._checks import positive_integer, share
from prbayes.estimate.optimum import Optimum
from prbayes.model.turns import in_turn
from prbayes.plots._canvas import Canvas, refuse_look
from prbayes.plots._ensemble import read_result
from prbayes.plots._margins import chosen, margin_densities, margins
from prbayes.plots._names import named, refuse_labels
from prbayes.plots._populations import calibrated, draw_calibrated


@in_turn
def plot_population(
    result: Optimum | xr.DataTree,
    *,
    model: pm.Model | None = None,
    inputs: Sequence[Any] | None = None,
    level: float = 0.89,
    draws: int | None = None,
    labels: Mapping[str, str] | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the calibrated population of each aleatory input, with its uncertainty.

    Of a multivariate input each margin has a panel.

    The curve is the posterior predictive density of the input, or its density at the optimum; the
    band holds the share ``level`` of the densities at each value. It computes no response.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`; or with a ``posterior`` group, from any sampler.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    inputs : sequence, optional
        Names, or ``.dist()`` objects; all by default. An input is called as the response's argument
        that takes it.
    level : float
    draws : int, optional
        Number of populations in the band; 200 by default.
    labels : mapping, optional
        What a reader calls an input, by its name, with units.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        ``figsize=(8, 5)``, in inches, of the whole picture; others go to
        ``arviz.PlotCollection.wrap``, such as ``col_wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``band`` and ``after``.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, there is no such input, or the result lacks a free
        variable, or is of other populations or data than the model.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y", lambda load: 2 * load, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
    ...     )
    >>> list(prb.plot_population(prb.minimize(model), backend="none").viz["after"])
    ['load']
    """
    refuse_look(labels, backend, pc_kwargs)
    if draws is not None:
        positive_integer(draws, "draws")
    share(level, "level")
    shown = read_result(result, model, "prb.plot_population", draws, free=True)
    wanted = chosen(margins(shown.evaluator), inputs)
    found = margin_densities(shown.evaluator, wanted, shown.every)
    names = [margin.name for margin in wanted]
    refuse_labels(labels, names, evaluator=shown.evaluator)
    canvas = Canvas(names, size=(4.6, 3.9), backend=backend, pc_kwargs=pc_kwargs)
    for margin in wanted:
        panel = canvas.panel(margin.name)
        grid, curves = found[margin.name]
        after = calibrated(curves, shown, level)
        draw_calibrated(panel, grid, after, shown, level)
        y = "probability" if margin.discrete else "density"
        panel.axes(x=named(margin.name, labels), y=y)
    return canvas.finish()
