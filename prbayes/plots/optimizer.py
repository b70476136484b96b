"""The path of the optimiser."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from prbayes.estimate.optimum import Optimum
from prbayes.plots._canvas import (
    BLUE,
    DASHED,
    GREY,
    VERMILION,
    Canvas,
    named,
)
from prbayes.plots._curves import log_ticks, spans_decades
from prbayes.plots._grid import check_optimum, elements, objective_of


def plot_optimizer(
    optimum: Optimum,
    *,
    labels: Mapping[str, str] | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the objective and the hyperparameters that an optimiser asked for, against the number of evaluations.

    The first panel has the objective, the sum of d_k / s_k, of each point and the lowest so far, with logarithmic
    ticks where it falls over more than a decade; a panel for each hyperparameter follows, in the user's own units,
    with the optimum as a dashed line. With `Reweighted` the objective is that of the final design and scales,
    evaluated anew without a response; elsewhere it is what the optimiser saw, and with several simulators, whose
    scales may have changed on the way, nothing says which was lowest.

    Parameters
    ----------
    optimum : Optimum
        From `minimize`.
    labels : mapping, optional
        What a reader calls a hyperparameter, by its name, with units.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        For ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``asked`` and ``path``, ``best`` (first panel) and ``optimum`` (the others).

    Raises
    ------
    TypeError, ValueError
        If it is no optimum, or one without a trace.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0])
    >>> list(prb.plot_optimizer(prb.minimize(model), backend="none").viz["asked"])
    ['discrepancy', 'mu']
    """
    check_optimum(optimum, "plot_optimizer")
    evaluator, x = optimum.evaluator, optimum.trace["evaluations"].astype(np.float64)
    scales = np.array([optimum.scales[n.name] for n in evaluator.nodes])
    free = not evaluator.responses_per_theta
    values = evaluator.total(optimum.trace["theta"], scales) if free else optimum.trace["discrepancy"]
    path = elements(optimum.evaluator, optimum.trace["theta"])
    canvas = Canvas(["discrepancy", *path], size=(4.6, 3.4), backend=backend, pc_kwargs=pc_kwargs)
    shown = np.where(np.isfinite(values), values, np.nan)
    best = np.fmin.accumulate(shown)
    ticks = log_ticks(shown) if spans_decades(shown) else None
    if ticks is not None:
        shown, best = np.log10(shown), np.log10(best)
    known = np.isfinite(shown)
    canvas.points("discrepancy", "asked", x[known], shown[known], GREY, size=16, legend="evaluated")
    if free or len(scales) == 1:
        canvas.line("discrepancy", "best", x[known], best[known], BLUE, legend="lowest so far")
    canvas.axes("discrepancy", x="evaluations", y=objective_of(optimum), yticks=ticks)
    ends = np.array([x[0], x[-1]])
    for name, at in path.items():
        canvas.line(name, "path", x, at, GREY, width=0.8)
        canvas.points(name, "asked", x, at, GREY, size=16, legend="evaluated")
        final = float(elements(optimum.evaluator, optimum.theta[None])[name][0])
        canvas.line(name, "optimum", ends, np.full(2, final), VERMILION, style=DASHED, legend="optimum")
        canvas.axes(name, x="evaluations", y=named(name, labels))
    return canvas.finish()
