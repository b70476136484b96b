"""The discrepancy as a landscape over one or two hyperparameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pymc as pm

from prbayes._checks import Floats, positive_integer
from prbayes.estimate.optimum import Optimum
from prbayes.model.evaluator import Evaluator
from prbayes.plots._canvas import (
    BLUE,
    CROSS,
    DIAMOND,
    INK,
    VERMILION,
    Canvas,
    named,
)
from prbayes.plots._grid import Landscape, check_optimum, elements, landscape, objective_of, rooted


def plot_landscape(
    optimum: Optimum,
    *,
    model: pm.Model | None = None,
    pair: Sequence[str] | None = None,
    points: int | None = None,
    responses: int = 0,
    labels: Mapping[str, str] | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the objective over two hyperparameters around the optimum, with the optimiser's path and other optima.

    Darker is lower; contours are at even steps of the root of the objective over its lowest value, so that they crowd
    towards the optimum; the title has the values at the ends. With one hyperparameter, or one name, it is a curve. All
    other hyperparameters stand at the optimum, as the title says. Where stored responses do not support a population
    the picture is blank. Path and other optima are those of all hyperparameters, projected.

    Parameters
    ----------
    optimum : Optimum
        From `minimize`.
    model : pymc.Model, optional
        That of the optimum; another one with the same hyperparameters may be given, such as one with another metric.
    pair : sequence of str, optional
        One or two names, such as ``("mu", "sigma")`` or ``("mu[0]", "mu[1]")``; the first two by default.
    points : int, optional
        Along each axis; 41, or 161 for a curve.
    responses : int
        Largest number of responses that may be computed. With `Reweighted` none is; with `Resimulated` and `Fresh`
        every point of the picture costs n for each simulator.
    labels : mapping, optional
        What a reader calls a hyperparameter, by its name, with units.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        For ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``landscape`` (``landscape_lines``), ``path``, ``optimum`` and ``rivals``.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, or it would compute more responses than allowed.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0])
    >>> prb.plot_landscape(prb.minimize(model), backend="none").viz["optimum"].name
    'optimum'
    """
    check_optimum(optimum, "plot_landscape")
    evaluator = optimum.evaluator if model is None or model is optimum.model else Evaluator(model)
    if evaluator.names != optimum.names or [n.name for n in evaluator.nodes] != list(optimum.scales):
        got = f"{evaluator.names} and {[n.name for n in evaluator.nodes]}"
        raise ValueError(
            f"model: got hyperparameters and simulators {got}, expected {optimum.names} and {list(optimum.scales)}"
        )
    known = list(elements(optimum.evaluator, optimum.theta[None]))
    wanted = list(known[:2] if pair is None else [pair] if isinstance(pair, str) else pair)
    if not 1 <= len(wanted) <= 2 or len(set(wanted)) != len(wanted) or not set(wanted) <= set(known):
        raise KeyError(f"pair: got {pair}, expected one or two of {known}")
    points = (41 if len(wanted) == 2 else 161) if points is None else positive_integer(points, "points", minimum=5)
    cost = points ** len(wanted) * evaluator.responses_per_theta
    if cost > responses:
        raise ValueError(
            f"plot_landscape: got responses={responses}, expected at least {cost}: {points ** len(wanted)} points with "
            f"{evaluator.responses_per_theta} responses each; pass responses={cost}, fewer points, or use "
            "prb.Reweighted(), whose pictures cost none"
        )
    found = landscape(optimum, evaluator, wanted, points)
    if not np.isfinite(found.heights).any():
        raise ValueError(
            "plot_landscape: got no finite objective, expected some around the optimum; look at its message"
        )
    canvas = Canvas(["landscape"], size=(6.4, 5.4), backend=backend, pc_kwargs=pc_kwargs)
    rest = [named(n, labels) for n in known if n not in wanted]
    held = f"{', '.join(rest)} held at the optimum" if rest else ""
    limits = [(float(axis[0]), float(axis[-1])) for axis in found.axes]
    if len(wanted) == 1:
        _curve(canvas, found, alone=not rest)
        y = objective_of(optimum)
    else:
        roots, low, high = rooted(found.heights)
        canvas.heights("landscape", "landscape", (found.axes[0], found.axes[1]), roots, np.linspace(0, 1, 11))
        x, y = found.path.T
        canvas.line("landscape", "path", x, y, INK, width=1.0)
        canvas.points("landscape", "asked", x, y, INK, size=14, legend="path of the optimiser")
        _marks(canvas, found.optimum.T, found.rivals.T)
        y = named(wanted[1], labels)
        held = "\n".join([f"{objective_of(optimum)}: {low:.3g} dark, {high:.3g} light", *([held] if held else [])])
    canvas.axes(
        "landscape",
        x=named(wanted[0], labels),
        y=y,
        title=held,
        xlim=limits[0],
        ylim=limits[1] if len(wanted) == 2 else None,
    )
    return canvas.finish()


def _curve(canvas: Canvas, found: Landscape, *, alone: bool) -> None:
    """Draw the objective over one hyperparameter; what lies on the curve only if there are no others."""
    (x,), heights = found.axes, found.heights
    known = np.isfinite(heights)
    canvas.line("landscape", "landscape", x[known], heights[known], BLUE)

    def on_curve(places: Floats) -> tuple[Floats, Floats]:
        at = places[:, 0][(places[:, 0] >= x[known][0]) & (places[:, 0] <= x[known][-1])]
        return at, np.interp(at, x[known], heights[known])

    if alone:
        canvas.points("landscape", "asked", *on_curve(found.path), INK, size=14, legend="path of the optimiser")
    _marks(canvas, on_curve(found.optimum), on_curve(found.rivals if alone else found.rivals[:0]))


def _marks(canvas: Canvas, optimum: Any, rivals: Any) -> None:
    """Mark the optimum and its rivals, each as x and y."""
    canvas.points("landscape", "optimum", optimum[0], optimum[1], VERMILION, marker=DIAMOND, size=90, legend="optimum")
    if np.size(rivals[0]):
        canvas.points(
            "landscape", "rivals", rivals[0], rivals[1], VERMILION, marker=CROSS, size=70, legend="other optima"
        )
