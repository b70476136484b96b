"""Results side by side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from prbayes._validate import flag
from prbayes.plots.canvas import (
    BLUE,
    DOTTED,
    GREY,
    INK,
    METRIC_LABELS,
    Canvas,
    named,
    refuse_labels,
    refuse_look,
    round_ticks,
)
from prbayes.results.compare import COSTS


def plot_comparison(
    comparison: xr.Dataset,
    *,
    scores: bool = False,
    labels: Mapping[str, str] | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the estimate and interval of each result, a row per result, a panel per hyperparameter.

    Parameters
    ----------
    comparison : xarray.Dataset
        From `compare`.
    scores : bool
        Draw instead the discrepancy of each result's population under each metric, a panel per
        metric; smaller is better, each metric in its own units.
    labels : mapping, optional
        Labels of hyperparameters, results or scores by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, and keywords of ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``estimate`` and ``interval_0``, ``interval_1`` and so on by
        result; or ``score``.

    Raises
    ------
    TypeError, ValueError
        If it is no comparison, or has no scores.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
    ...     )
    >>> table = prb.compare({"optimum": prb.minimize(model)}, model=model)
    >>> list(prb.plots.plot_comparison(table).viz["estimate"])
    ['mu']
    """
    refuse_look(labels, pc_kwargs)
    flag(scores, "scores")
    variables = {"estimate", "lower", "upper"}
    if not isinstance(comparison, xr.Dataset) or not variables <= set(comparison.data_vars):
        got = type(comparison).__name__
        raise TypeError(f"plot_comparison: got {got}, expected the Dataset of prb.compare")
    if scores:
        names = [
            str(name)
            for name, values in comparison.data_vars.items()
            if values.dims == ("result",) and name not in COSTS
        ]
        if not names:
            raise ValueError(
                "plot_comparison: got no scores, expected those of prb.compare(results, "
                "model=model)"
            )
    else:
        names = list(map(str, comparison.hyperparameter.values))
    results = list(map(str, comparison.result.values))
    refuse_labels(labels, [*names, *results])
    texts = [named(result, labels) for result in results]
    n = len(results)
    rows = np.arange(n - 1.0, -1.0, -1.0)  # the first on top
    limits = (-0.6, n - 0.4)
    interval = f"{comparison.attrs.get('interval', 0.89):.0%} interval"

    canvas = Canvas(names, size=(4.8, 1.6 + 0.34 * n), pc_kwargs=pc_kwargs)
    for name in names:
        panel = canvas.panels[name]
        if scores:
            values = comparison[name].values
            finite = np.isfinite(values)
            panel.points("score", (values[finite], rows[finite]), BLUE, size=45)
        else:
            row = comparison.sel(hyperparameter=name)
            values = np.concatenate([row.lower, row.upper, row.estimate])
            if n > 1:  # a line through the first result, for comparison
                first = np.repeat(row.estimate.values[:1], 2)
                text = f"estimate of {texts[0]}"
                panel.line("first", (first, limits), GREY, style=DOTTED, width=1.2, legend=text)
            for i, ends in enumerate(np.column_stack([row.lower, row.upper])):
                if np.isfinite(ends).all():
                    y = np.repeat(rows[i], 2)
                    panel.line(f"interval_{i}", (ends, y), BLUE, width=3, legend=interval)
            panel.points("estimate", (row.estimate.values, rows), INK, size=45, legend="estimate")
        finite = values[np.isfinite(values)]
        low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
        margin = 0.06 * (high - low) or 0.01 * max(abs(low), 1.0)  # for markers
        xlim = float(low - margin), float(high + margin)
        panel.axes(
            x=named(name, METRIC_LABELS | dict(labels or {})),
            xlim=xlim,
            ylim=limits,
            xticks=round_ticks(*xlim),
            yticks=(rows.tolist(), texts),
        )
    return canvas.finish()
