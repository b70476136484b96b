"""Results side by side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from prbayes._validate import Floats, flag
from prbayes.plots._canvas import BLUE, DOTTED, GREY, INK, Canvas, Panel, refuse_look
from prbayes.plots._names import named, refuse_labels
from prbayes.plots._objective import METRIC_LABELS
from prbayes.plots._ticks import round_ticks
from prbayes.results.compare import COSTS


def plot_comparison(
    comparison: xr.Dataset,
    *,
    scores: bool = False,
    labels: Mapping[str, str] | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the estimate and interval of each result, a row per result, a panel per hyperparameter.

    Parameters
    ----------
    comparison : xarray.Dataset
        From `compare`.
    scores : bool
        Draw in their place the discrepancy of each result's population under each metric, one panel
        per metric; the smaller the better, each metric in its own units.
    labels : mapping, optional
        What a reader calls a hyperparameter, by its name, with units; also a result or a score.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        ``figsize=(8, 5)``, in inches, of the whole picture; others go to
        ``arviz.PlotCollection.wrap``, such as ``col_wrap``.

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
    >>> list(prb.plot_comparison(table, backend="none").viz["estimate"])
    ['mu']
    """
    refuse_look(labels, backend, pc_kwargs)
    flag(scores, "scores")
    if not _is_comparison(comparison):
        got = type(comparison).__name__
        raise TypeError(f"plot_comparison: got {got}, expected the Dataset of prb.compare")
    if scores:
        names = _scores(comparison)
    else:
        names = [str(name) for name in comparison.hyperparameter.values]
    row_names = [named(str(result), labels) for result in comparison.result.values]
    refuse_labels(labels, [*names, *map(str, comparison.result.values)])
    count = len(row_names)
    rows = np.arange(count - 1.0, -1.0, -1.0)  # the first on top
    limits = (-0.6, count - 0.4)

    height = 1.6 + 0.34 * count
    canvas = Canvas(names, size=(4.8, height), backend=backend, pc_kwargs=pc_kwargs)
    for name in names:
        panel = canvas.panel(name)
        if scores:
            shown = comparison[name].values
            _draw_scores(panel, shown, rows)
        else:
            row = comparison.sel(hyperparameter=name)
            shown = np.concatenate([row.lower, row.upper, row.estimate])
            if count > 1:
                _draw_first(panel, row, limits, row_names[0])
            _draw_intervals(panel, row, rows, _interval_text(comparison))
        covered = _covered(shown)
        panel.axes(
            x=named(name, METRIC_LABELS | dict(labels or {})),
            xlim=covered,
            ylim=limits,
            xticks=round_ticks(*covered),
            yticks=(rows.tolist(), row_names),
        )
    return canvas.finish()


def _is_comparison(comparison: Any) -> bool:
    if not isinstance(comparison, xr.Dataset):
        return False
    return {"estimate", "lower", "upper"} <= set(comparison.data_vars)


def _scores(comparison: xr.Dataset) -> list[str]:
    """Return the names of the scores."""
    found = []
    for name, values in comparison.data_vars.items():
        if values.dims == ("result",) and name not in COSTS:
            found.append(str(name))
    if not found:
        raise ValueError(
            "plot_comparison: got no scores, expected those of prb.compare(results, model=model)"
        )
    return found


def _interval_text(comparison: xr.Dataset) -> str:
    return f"{comparison.attrs.get('interval', 0.89):.0%} interval"


def _draw_scores(panel: Panel, scores: Floats, rows: Floats) -> None:
    known = np.isfinite(scores)
    x = scores[known]
    y = rows[known]
    panel.points("score", x, y, BLUE, size=45)


def _draw_first(panel: Panel, row: xr.Dataset, limits: tuple[float, float], name: str) -> None:
    """Draw a line through the estimate of the first result, which the others are compared with."""
    first = np.repeat(row.estimate.values[:1], 2)
    text = f"estimate of {name}"
    panel.line("first", first, limits, GREY, style=DOTTED, width=1.2, legend=text)


def _draw_intervals(panel: Panel, row: xr.Dataset, rows: Floats, text: str) -> None:
    """Draw the interval and the estimate of each result."""
    ends = np.column_stack([row.lower, row.upper])
    for i, interval in enumerate(ends):
        if np.isfinite(interval).all():
            visual = f"interval_{i}"
            y = np.repeat(rows[i], 2)
            panel.line(visual, interval, y, BLUE, width=3, legend=text)
    panel.points("estimate", row.estimate.values, rows, INK, size=45, legend="estimate")


def _covered(shown: Floats) -> tuple[float, float]:
    """Return what the axis covers: all finite values, and a margin."""
    known = shown[np.isfinite(shown)]
    low, high = 0.0, 1.0
    if known.size:
        low = known.min()
        high = known.max()
    margin = 0.06 * (high - low)  # markers at the ends are whole
    if not margin:
        margin = 0.01 * max(abs(low), 1.0)
    return float(low - margin), float(high + margin)
