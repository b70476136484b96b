"""The path of the optimiser."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from prbayes._validate import Floats
from prbayes.optimize.optimum import Optimum
from prbayes.plots._canvas import (
    BLUE,
    DASHED,
    GREY,
    VERMILION,
    Canvas,
    Panel,
    log_ticks,
    refuse_look,
    spans_decades,
)
from prbayes.plots._labels import named, refuse_labels
from prbayes.plots._landscape_data import (
    check_optimum,
    free_elements,
    free_names,
    objective,
    objective_label,
)


def plot_optimizer(
    optimum: Optimum,
    *,
    labels: Mapping[str, str] | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the objective and the hyperparameters of an optimiser's evaluations.

    The first panel has the objective, the sum of d_k / s_k, of each point and the lowest so far,
    with logarithmic ticks if it falls over more than a decade. A panel for each hyperparameter
    follows, in the user's own units, with the optimum as a dashed line. With `Reweighted` the
    objective is recomputed with the final design and scales, without a response. Otherwise it is
    the one that the optimiser used; with several simulators, whose scales may have changed, the
    lowest is not shown.

    Parameters
    ----------
    optimum : Optimum
        From `minimize`.
    labels : mapping, optional
        Labels of hyperparameters by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, and keywords of ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``asked`` and ``path``, ``best`` (first panel) and ``optimum``
        (other panels).

    Raises
    ------
    TypeError, ValueError
        If it is no optimum, or one without a trace.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
    ...     )
    >>> list(prb.plot_optimizer(prb.minimize(model)).viz["asked"])
    ['discrepancy', 'mu']
    """
    refuse_look(labels, pc_kwargs)
    check_optimum(optimum, "plot_optimizer")
    path = free_elements(optimum.evaluator, optimum.search.trace["theta"])
    final = free_elements(optimum.evaluator, optimum.theta[None])
    hyperparameters = free_names(optimum)
    refuse_labels(labels, hyperparameters, evaluator=optimum.evaluator)
    canvas = Canvas(["discrepancy", *hyperparameters], size=(4.6, 3.4), pc_kwargs=pc_kwargs)
    evaluations = optimum.search.trace["evaluations"].astype(np.float64)
    _draw_objective(canvas.panel("discrepancy"), optimum, evaluations)
    ends = evaluations[[0, -1]]
    for name in hyperparameters:
        panel = canvas.panel(name)
        panel.line("path", evaluations, path[name], GREY, width=0.8)
        panel.points("asked", evaluations, path[name], GREY, size=16, legend="evaluated")
        level = np.repeat(final[name], 2)
        panel.line("optimum", ends, level, VERMILION, style=DASHED, legend="optimum")
        panel.axes(x="evaluations", y=named(name, labels))
    return canvas.finish()


def _draw_objective(panel: Panel, optimum: Optimum, evaluations: Floats) -> None:
    """Draw the objective of each point, and the lowest so far."""
    # Recomputed with the final design and scales, where that costs no response
    is_free = not optimum.evaluator.responses_per_theta
    values = optimum.search.trace["discrepancy"]
    if is_free:
        values = objective(optimum, optimum.evaluator, optimum.search.trace["theta"])
    values = np.where(np.isfinite(values), values, np.nan)
    best = np.fmin.accumulate(values)
    ticks = None
    if spans_decades(values):
        ticks = log_ticks(values)
        values = np.log10(values)
        best = np.log10(best)
    finite = np.isfinite(values)
    x = evaluations[finite]
    panel.points("asked", x, values[finite], GREY, size=16, legend="evaluated")
    # Values of different scales cannot be compared
    if is_free or len(optimum.scales) == 1:
        panel.line("best", x, best[finite], BLUE, legend="lowest so far")
    panel.axes(x="evaluations", y=objective_label(optimum), yticks=ticks)
