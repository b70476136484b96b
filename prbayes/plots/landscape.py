"""The discrepancy as a landscape over one or two hyperparameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pymc as pm

from prbayes._validate import Floats, called, positive_integer
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import Level
from prbayes.model.locking import locked
from prbayes.optimize.optimum import Optimum, require_of_model
from prbayes.plots._canvas import BLUE, CROSS, DIAMOND, INK, VERMILION, Canvas, Panel, refuse_look
from prbayes.plots._colours import ColourScale
from prbayes.plots._grid import Landscape, landscape, rooted
from prbayes.plots._names import named, refuse_labels
from prbayes.plots._objective import check_optimum, free_names, objective_label

# Points along each axis, by the number of hyperparameters: contours of 41 look smooth, and as many
# evaluations are drawn in about a second; a curve can have more. By judgement.
_ALONG_AXIS = {1: 161, 2: 41}
_PATH = "path of the optimiser"


@locked
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
    """Draw the objective around the optimum over two hyperparameters, with the optimiser's path.

    Darker is lower; contours are at even steps of the root of the objective over its lowest value,
    so that they crowd towards the optimum; a bar has the values. With one
    hyperparameter, or one name, it is a curve. All other hyperparameters stand at the optimum, as
    the title says. Where stored responses do not support a population the picture is blank. Path
    and other optima are those of all hyperparameters, projected.

    Parameters
    ----------
    optimum : Optimum
        From `minimize`.
    model : pymc.Model, optional
        That of the optimum; another one with the same hyperparameters may be given, such as one
        with another metric.
    pair : sequence of str, optional
        One or two names, such as ``("mu", "sigma")`` or ``("mu[0]", "mu[1]")``; the first two by
        default.
    points : int, optional
        Along each axis; 41, or 161 for a curve.
    responses : int
        Largest number of responses that may be computed. With `Reweighted` none is; with
        `Resimulated` and `Fresh` every point of the picture costs n for each simulator.
    labels : mapping, optional
        What a reader calls a hyperparameter, by its name, with units.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        ``figsize=(8, 5)``, in inches, of the whole picture; others go to
        ``arviz.PlotCollection.wrap``, such as ``col_wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``landscape`` (``landscape_lines``), ``path``, ``optimum`` and
        ``rivals``.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, it would compute more responses than allowed, or the
        optimum is of other populations or data than the model.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
    ...     )
    >>> prb.plot_landscape(prb.minimize(model), backend="none").viz["optimum"].name
    'optimum'
    """
    refuse_look(labels, backend, pc_kwargs)
    positive_integer(responses, "responses", minimum=0)
    check_optimum(optimum, "plot_landscape")
    evaluator = _evaluator_of(optimum, model)
    known = free_names(optimum)
    names = _chosen(pair, known)
    refuse_labels(labels, known, evaluator=evaluator)
    if points is None:
        points = _ALONG_AXIS[len(names)]
    else:
        points = positive_integer(points, "points", minimum=5)  # fewer show no bowl
    _check_cost(evaluator, points ** len(names), responses)

    found = landscape(optimum, evaluator, names, points)
    if not np.isfinite(found.heights).any():
        raise ValueError(
            "plot_landscape: got no finite objective, expected some around the optimum; look at "
            "its message"
        )
    others = [name for name in known if name not in names]
    listed = ", ".join(named(name, labels) for name in others)
    held = f"{listed} held at the optimum" if others else ""

    canvas = Canvas(["landscape"], size=(6.4, 5.4), backend=backend, pc_kwargs=pc_kwargs)
    panel = canvas.panel("landscape")
    height = objective_label(optimum)
    x = named(names[0], labels)
    if len(names) == 1:
        _draw_curve(panel, found, alone=not others)
        panel.axes(x=x, y=height, title=held, xlim=_ends(found.axes[0]))
    else:
        _draw_plane(panel, found, height)
        panel.axes(
            x=x,
            y=named(names[1], labels),
            title=held,
            xlim=_ends(found.axes[0]),
            ylim=_ends(found.axes[1]),
        )
    return canvas.finish()


def _evaluator_of(optimum: Optimum, model: pm.Model | None) -> Evaluator:
    """Return the optimum's own evaluator, or one of another model with the same hyperparameters."""
    if model is None or model is optimum.model:
        return optimum.evaluator
    require_of_model(optimum, model, "plot_landscape", Level.POPULATIONS)
    evaluator = Evaluator.of(model)
    simulators = [node.name for node in evaluator.nodes or evaluator.measurements]
    expected = list(optimum.scales)
    if evaluator.hyperparameters.names != optimum.names or simulators != expected:
        raise ValueError(
            f"model: got hyperparameters and simulators {evaluator.hyperparameters.names} and "
            f"{simulators}, expected {optimum.names} and {expected}"
        )
    return evaluator


def _chosen(pair: Sequence[str] | None, known: list[str]) -> list[str]:
    """Return the one or two hyperparameters that are asked for, of those known."""
    if pair is None:
        return known[:2]
    if not isinstance(pair, str | Sequence):
        raise TypeError(f"pair: got {called(pair)}, expected one or two of {known}")
    names = [pair] if isinstance(pair, str) else list(pair)
    different = set(names)
    allowed = different <= set(known) and len(different) == len(names)
    if not allowed or len(names) not in _ALONG_AXIS:
        raise KeyError(f"pair: got {pair}, expected one or two of {known}")
    return names


def _check_cost(evaluator: Evaluator, points: int, responses: int) -> None:
    """Refuse to compute more responses than allowed."""
    each = evaluator.responses_per_theta
    cost = points * each
    if cost > responses:
        raise ValueError(
            f"plot_landscape: got responses={responses}, expected at least {cost}: {points} points "
            f"with {each} responses each; pass responses={cost}, fewer points, or use "
            "prb.Reweighted(), whose pictures cost none"
        )


def _ends(axis: Floats) -> tuple[float, float]:
    return float(axis[0]), float(axis[-1])


def told_apart(values: Floats) -> tuple[str, ...]:
    """Return numbers with three digits, or as many more, up to eight, as tell them apart."""
    for digits in range(3, 9):
        texts = tuple(f"{value:.{digits}g}" for value in values)
        if len(set(texts)) == len(texts):
            break
    return texts


def _draw_plane(panel: Panel, found: Landscape, height: str) -> None:
    """Draw the objective over two hyperparameters, with a bar of its values by its name."""
    roots, low, high = rooted(found.heights)
    first, second = found.axes
    levels = np.linspace(0, 1, 11)
    told = levels[::2]
    values = low + told**2 * (high - low)
    texts = told_apart(values)
    scale = ColourScale(tuple(told.tolist()), texts, height)
    panel.heights("landscape", (first, second), roots, levels, scale)
    x, y = found.path.T
    panel.line("path", x, y, INK, width=1.0)
    panel.points("asked", x, y, INK, size=14, legend=_PATH)
    _draw_optima(panel, found.optimum.T, found.rivals.T)


def _draw_curve(panel: Panel, found: Landscape, *, alone: bool) -> None:
    """Draw the objective over one hyperparameter.

    Path and other optima lie on the curve only if there are no other hyperparameters.
    """
    known = np.isfinite(found.heights)
    (axis,) = found.axes
    curve = (axis[known], found.heights[known])
    panel.line("landscape", *curve, BLUE)
    rivals = found.rivals[:0]
    if alone:
        rivals = found.rivals
        x, y = _on_curve(found.path, *curve)
        panel.points("asked", x, y, INK, size=14, legend=_PATH)
    _draw_optima(panel, _on_curve(found.optimum, *curve), _on_curve(rivals, *curve))


def _on_curve(places: Floats, x: Floats, heights: Floats) -> Floats:
    """Return those places, shape (m, 1), that a curve covers, with its heights: shape (2, m)."""
    at = places[:, 0]
    covered = (at >= x[0]) & (at <= x[-1])
    at = at[covered]
    return np.stack([at, np.interp(at, x, heights)])


def _draw_optima(panel: Panel, optimum: Floats, rivals: Floats) -> None:
    """Mark the optimum and its rivals, shape (2, m) each."""
    x, y = optimum
    panel.points("optimum", x, y, VERMILION, marker=DIAMOND, size=90, legend="optimum")
    if rivals.size:
        x, y = rivals
        panel.points("rivals", x, y, VERMILION, marker=CROSS, size=70, legend="other optima")
