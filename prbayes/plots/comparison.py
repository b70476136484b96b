"""Results side by side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from prbayes.plots._canvas import BLUE, DOTTED, GREY, INK, Canvas, named
from prbayes.plots._curves import round_ticks

_TOLD = ("n_responses", "seconds")


def plot_comparison(
    comparison: xr.Dataset,
    *,
    scores: bool = False,
    labels: Mapping[str, str] | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the estimate and the interval of each result, one row per result and one panel per hyperparameter.

    Parameters
    ----------
    comparison : xarray.Dataset
        From `compare`.
    scores : bool
        Draw in their place the discrepancy of each result's population under each metric, one panel per metric; the
        smaller the better, each metric in its own units.
    labels : mapping, optional
        What a reader calls a hyperparameter, by its name, with units; also a result or a score.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        For ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``estimate`` and ``interval_0``, ``interval_1`` and so on by result; or ``score``.

    Raises
    ------
    TypeError, ValueError
        If it is no comparison, or has no scores.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0])
    >>> table = prb.compare({"optimum": prb.minimize(model)}, model=model)
    >>> list(prb.plot_comparison(table, backend="none").viz["estimate"])
    ['mu']
    """
    if not isinstance(comparison, xr.Dataset) or not {"estimate", "lower", "upper"} <= set(comparison.data_vars):
        raise TypeError(f"plot_comparison: got {type(comparison).__name__}, expected the Dataset of prb.compare")
    results = [str(r) for r in comparison.result.values]
    rows = np.arange(len(results), dtype=np.float64)[::-1]
    panels = [str(h) for h in comparison.hyperparameter.values]
    if scores:
        panels = [str(n) for n, v in comparison.data_vars.items() if v.dims == ("result",) and n not in _TOLD]
        if not panels:
            raise ValueError("plot_comparison: got no scores, expected those of prb.compare(results, model=model)")
    interval = f"{comparison.attrs.get('interval', 0.89):.0%} interval"
    height = 1.6 + 0.34 * len(results)
    canvas = Canvas(panels, size=(4.8, height), backend=backend, pc_kwargs=pc_kwargs)
    for name in panels:
        if scores:
            at = comparison[name].values
            known = np.isfinite(at)
            canvas.points(name, "score", at[known], rows[known], BLUE, size=45)
        else:
            row = comparison.sel(hyperparameter=name)
            first = row.estimate.values[:1]
            if len(results) > 1:
                text = f"estimate of {named(results[0], labels)}"
                canvas.line(
                    name,
                    "first",
                    np.repeat(first, 2),
                    [-0.6, len(results) - 0.4],
                    GREY,
                    style=DOTTED,
                    width=1.2,
                    legend=text,
                )
            for i, (low, high) in enumerate(zip(row.lower.values, row.upper.values, strict=True)):
                if np.isfinite([low, high]).all():
                    canvas.line(name, f"interval_{i}", [low, high], [rows[i]] * 2, BLUE, width=3, legend=interval)
            canvas.points(name, "estimate", row.estimate.values, rows, INK, size=45, legend="estimate")
        known = comparison[name].values if scores else np.concatenate([row.lower, row.upper, row.estimate])
        known = known[np.isfinite(known)]
        low, high = (known.min(), known.max()) if known.size else (0.0, 1.0)
        room = 0.06 * (high - low) or 0.01 * max(abs(low), 1.0)
        limits = (float(low - room), float(high + room))
        ticks = (rows.tolist(), [named(r, labels) for r in results])
        canvas.axes(
            name,
            x=named(name, labels),
            xlim=limits,
            xticks=round_ticks(*limits),
            yticks=ticks,
            ylim=(-0.6, len(results) - 0.4),
        )
    return canvas.finish()
