"""The discrepancy as a landscape over one or two hyperparameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm

from prbayes._validate import Floats, called, positive_integer
from prbayes.model.description import labelled
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import Level
from prbayes.model.locking import locked
from prbayes.model.parameters import optimum_elements, single_elements, split_elements, variable_of
from prbayes.optimize.optimum import Optimum, require_of_model
from prbayes.plots.canvas import (
    BLUE,
    CROSS,
    DIAMOND,
    INK,
    VERMILION,
    Canvas,
    Panel,
    metric_label,
    named,
    refuse_labels,
    refuse_look,
)
from prbayes.plots.ensemble import supported


@locked
def plot_landscape(
    optimum: Optimum,
    *,
    model: pm.Model | None = None,
    pair: Sequence[str] | None = None,
    points: int | None = None,
    responses: int = 0,
    labels: Mapping[str, str] | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the objective around the optimum over one or two hyperparameters.

    Darker is lower. Contours are at even steps of the root of the objective above its minimum: they
    are dense at the optimum. A bar has the values. Over one hyperparameter it is a curve. The title
    names the hyperparameters that are fixed at the optimum. The picture is blank where stored
    responses do not support a population. The optimiser's path and other optima are projected.

    Parameters
    ----------
    optimum : Optimum
        From `minimize`.
    model : pymc.Model, optional
        That of the optimum by default; or another with the same hyperparameters, such as one with
        another metric.
    pair : sequence of str, optional
        One or two names, such as ``("mu", "sigma")`` or ``("mu[0]", "mu[1]")``; the first two by
        default.
    points : int, optional
        Along each axis; 41, or 161 for a curve.
    responses : int
        Largest number of responses that may be computed. With `Reweighted` none is; with
        `Resimulated` and `Fresh` every point of the picture costs n for each simulator.
    labels : mapping, optional
        Labels of hyperparameters by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, and keywords of ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``landscape`` (``landscape_lines``), ``path``, ``optimum`` and
        ``local_optima``.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, more responses would be computed than allowed, or the
        optimum is of other populations or data than the model.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
    ...     )
    >>> prb.plot_landscape(prb.minimize(model)).viz["optimum"].name
    'optimum'
    """
    refuse_look(labels, pc_kwargs)
    positive_integer(responses, "responses", minimum=0)
    check_optimum(optimum, "plot_landscape")
    evaluator = _evaluator_of(optimum, model)
    hyperparameters = free_names(optimum)
    names = _axis_names(pair, hyperparameters)
    refuse_labels(labels, hyperparameters, evaluator=evaluator)
    if points is None:
        points = 161 if len(names) == 1 else 41  # contours look smooth, in about a second
    else:
        points = positive_integer(points, "points", minimum=5)  # fewer show no bowl
    _check_cost(evaluator, points ** len(names), responses)

    surface = landscape(optimum, evaluator, names, points)
    if not np.isfinite(surface.heights).any():
        raise ValueError(
            "plot_landscape: got no finite objective, expected some around the optimum; look at "
            "its message"
        )
    fixed = [named(name, labels) for name in hyperparameters if name not in names]
    title = f"{', '.join(fixed)} fixed at the optimum" if fixed else ""
    objective = objective_label(optimum)
    canvas = Canvas(["landscape"], size=(6.4, 5.4), pc_kwargs=pc_kwargs)
    panel = canvas.panel("landscape")
    x = named(names[0], labels)
    xlim, *ylim = [(float(axis[0]), float(axis[-1])) for axis in surface.axes]
    if len(names) == 1:
        _draw_curve(panel, surface, alone=not fixed)
        panel.axes(x=x, y=objective, title=title, xlim=xlim)
    else:
        _draw_plane(panel, surface, objective)
        panel.axes(x=x, y=named(names[1], labels), title=title, xlim=xlim, ylim=ylim[0])
    return canvas.finish()


def _evaluator_of(optimum: Optimum, model: pm.Model | None) -> Evaluator:
    """Return the optimum's evaluator, or that of another model with the same hyperparameters."""
    if model is None or model is optimum.model:
        return optimum.evaluator
    require_of_model(optimum, model, "plot_landscape", Level.POPULATIONS)
    evaluator = Evaluator.of(model)
    simulators = [node.name for node in evaluator.nodes or evaluator.measurements]
    expected = list(optimum.scales)
    if (
        evaluator.hyperparameters.names != optimum.evaluator.hyperparameters.names
        or simulators != expected
    ):
        raise ValueError(
            f"model: got hyperparameters and simulators {evaluator.hyperparameters.names} and "
            f"{simulators}, expected {optimum.evaluator.hyperparameters.names} and {expected}"
        )
    return evaluator


def _axis_names(pair: Sequence[str] | None, hyperparameters: list[str]) -> list[str]:
    """Return the one or two hyperparameters along the axes."""
    if pair is None:
        return hyperparameters[:2]
    if not isinstance(pair, str | Sequence):
        raise TypeError(f"pair: got {called(pair)}, expected one or two of {hyperparameters}")
    names = [pair] if isinstance(pair, str) else list(pair)
    are_different = len(set(names)) == len(names)
    if len(names) not in (1, 2) or not are_different or not set(names) <= set(hyperparameters):
        raise KeyError(f"pair: got {pair}, expected one or two of {hyperparameters}")
    return names


def _check_cost(evaluator: Evaluator, n_points: int, responses: int) -> None:
    """Raise if the picture would compute more responses than allowed."""
    cost = n_points * evaluator.responses_per_theta
    if cost > responses:
        raise ValueError(
            f"plot_landscape: got responses={responses}, expected at least {cost}: {n_points} "
            f"points with {evaluator.responses_per_theta} responses each; pass responses={cost}, "
            "fewer points, or use prb.Reweighted(), whose pictures cost none"
        )


def _draw_plane(panel: Panel, surface: Landscape, objective: str) -> None:
    """Draw the objective over two hyperparameters, with the path and a colour bar."""
    roots, low, high = rooted(surface.heights)
    first, second = surface.axes
    levels = np.linspace(0, 1, 11)
    places = levels[::2]
    ticks = (places.tolist(), distinct_texts(low + places**2 * (high - low)))
    panel.heights("landscape", (first, second), roots, levels, ticks, objective)
    x, y = surface.path.T
    panel.line("path", x, y, INK, width=1.0)
    _draw_marks(panel, (x, y), surface.optimum.T, surface.local_optima.T)


def distinct_texts(values: Floats) -> list[str]:
    """Return numbers with three digits, or up to eight until they differ."""
    for digits in range(3, 9):
        texts = [f"{value:.{digits}g}" for value in values]
        if len(set(texts)) == len(texts):
            break
    return texts


def _draw_curve(panel: Panel, surface: Landscape, *, alone: bool) -> None:
    """Draw the objective over one hyperparameter.

    Path and other optima lie on the curve only if there are no other hyperparameters.
    """
    finite = np.isfinite(surface.heights)
    x = surface.axes[0][finite]
    heights = surface.heights[finite]

    def on_curve(places: Floats) -> Floats:
        """Return the places, (m, 1), that the curve covers, with its heights: (2, m)."""
        at = places[:, 0]
        at = at[(at >= x[0]) & (at <= x[-1])]
        return np.stack([at, np.interp(at, x, heights)])

    panel.line("landscape", x, heights, BLUE)
    path = on_curve(surface.path) if alone else None
    local_optima = surface.local_optima if alone else surface.local_optima[:0]
    _draw_marks(panel, path, on_curve(surface.optimum), on_curve(local_optima))


def _draw_marks(panel: Panel, path: Any, optimum: Floats, local_optima: Floats) -> None:
    """Mark points of the path, the optimum and other optima, shape (2, m) each."""
    if path is not None:
        x, y = path
        panel.points("asked", x, y, INK, size=14, legend="path of the optimiser")
    x, y = optimum
    panel.points("optimum", x, y, VERMILION, marker=DIAMOND, size=90, legend="optimum")
    if local_optima.size:
        x, y = local_optima
        panel.points("local_optima", x, y, VERMILION, marker=CROSS, size=70, legend="other optima")


# -- the objective and its values on a grid --------------------------------------------------


# Half-width of an axis in standard errors: the normal approximation has a probability of 6e-5
# beyond.
_STANDARD_ERRORS = 4.0


def check_optimum(optimum: Any, caller: str) -> None:
    """Raise if it is no optimum, or one without a trace."""
    if not isinstance(optimum, Optimum):
        raise TypeError(
            f"{caller}: got {type(optimum).__name__}, expected an Optimum; call prb.minimize() "
            "first"
        )
    if not len(optimum.search.trace.get("theta", ())):
        raise ValueError(
            f"{caller}: got an optimum without a trace, expected one as prb.minimize returns it"
        )


def objective_label(optimum: Optimum) -> str:
    """Return the label of the objective."""
    if not optimum.evaluator.nodes:
        return "minus log-posterior" if optimum.search.prior else "minus log-likelihood"
    if len(optimum.scales) > 1:
        return "sum of scaled discrepancies"
    metric = optimum.evaluator.nodes[0].metric
    name = repr(metric) if metric.takes_outputs else type(metric).__name__
    return f"discrepancy ({metric_label(name)})"


def objective(optimum: Optimum, evaluator: Evaluator, thetas: Floats) -> Floats:
    """Return the sum of d_k / s_k with the optimum's scales, shape (P,)."""
    scales = [optimum.scales[node.name] for node in evaluator.nodes]
    return evaluator.total(thetas, np.array(scales))


def free_elements(evaluator: Evaluator, thetas: Floats) -> dict[str, Floats]:
    """Return the free variables' elements in the user's own units, shape (P,), by element name."""
    values = evaluator.hyperparameters.constrained(thetas)
    free = {str(rv.name): values[str(rv.name)] for rv in evaluator.model.free_RVs}
    return split_elements(labelled(evaluator, free, {"draw": len(thetas)}).data_vars)


def free_names(optimum: Optimum) -> list[str]:
    """Return the names of these elements, without constants such as zeros of a factor."""
    point = {str(rv.name): optimum.point[str(rv.name)] for rv in optimum.model.free_RVs}
    return optimum_elements(labelled(optimum.evaluator, point, {}).data_vars, optimum.stderr)


@dataclass(frozen=True, eq=False)
class Landscape:
    """The objective over a grid in the user's own units."""

    axes: list[Floats]  # (n,): one for each hyperparameter
    # (n,) or (n, n): the first hyperparameter along the first axis; NaN where stored responses do
    # not support a population or the priors exclude it.
    heights: Floats
    path: Floats  # (m, 1 or 2): points of the optimiser
    local_optima: Floats  # (m, 1 or 2)
    optimum: Floats  # (1, 1 or 2)


@dataclass(frozen=True, eq=False)
class _Plane:
    """The plane along one or two hyperparameters through an optimum."""

    evaluator: Evaluator
    names: list[str]  # of the hyperparameters along the axes
    center: dict[str, Floats]  # (1,): the optimum, by element name
    shapes: dict[str, tuple[int, ...]]  # of the free variables

    @classmethod
    def of(cls, optimum: Optimum, evaluator: Evaluator, names: list[str]) -> _Plane:
        center = optimum.theta[None]
        values = evaluator.hyperparameters.constrained(center)
        shapes = {str(rv.name): values[str(rv.name)].shape[1:] for rv in evaluator.model.free_RVs}
        return cls(evaluator, names, free_elements(evaluator, center), shapes)

    def thetas(self, places: Floats) -> Floats:
        """Return thetas of places, shape (P, 1 or 2); NaN outside the priors' support."""
        n = len(places)
        columns: dict[str, list[Floats]] = {}
        for name, value in self.center.items():
            is_axis = name in self.names
            column = places[:, self.names.index(name)] if is_axis else np.repeat(value, n)
            columns.setdefault(variable_of(name), []).append(column)
        values = [
            np.column_stack(columns[variable]).reshape(n, *shape)
            for variable, shape in self.shapes.items()
        ]
        with np.errstate(all="ignore"):
            return self.evaluator.hyperparameters.thetas_of(values)

    def within_support(self, name: str, end: float) -> float:
        """Return how far an axis can go from the optimum towards an end within the support."""
        # The axis ends short of the support's end by less than a 32nd.
        steps = np.linspace(self.center[name][0], end, 33)
        places = np.tile(_columns(self.center, self.names), (steps.size, 1))
        places[:, self.names.index(name)] = steps
        thetas = self.thetas(places)
        ok = np.isfinite(thetas).all(axis=1)
        ok[ok] = self.evaluator.hyperparameters.in_support(thetas[ok])
        outside = np.flatnonzero(~ok)
        last = max(outside[0] - 1, 0) if outside.size else -1
        return float(steps[last])


def landscape(optimum: Optimum, evaluator: Evaluator, names: list[str], points: int) -> Landscape:
    """Evaluate the objective on a grid of ``points`` along each of one or two hyperparameters."""
    plane = _Plane.of(optimum, evaluator, names)
    path = free_elements(evaluator, optimum.search.trace["theta"])
    local_optima = np.array([mode["theta"] for mode in optimum.local_optima])
    modes = free_elements(evaluator, local_optima.reshape(-1, optimum.theta.size))
    prior = free_elements(evaluator, evaluator.hyperparameters.prior_thetas(1000, 0))
    errors = single_elements(labelled(optimum.evaluator, optimum.stderr, {}).data_vars)

    axes = []
    for name in names:
        # The path beyond the prior's bulk, ten draws at each end, does not widen the axis.
        bulk = np.quantile(prior[name], (0.01, 0.99))
        marked = np.append(np.clip(path[name], *bulk), modes[name])
        error = errors[name]
        if not (np.isfinite(error) and error > 0):  # unknown: an axis as wide as the prior
            error = float((bulk[1] - bulk[0]) / (2 * _STANDARD_ERRORS))
        low, high = _ends(plane.center[name], error, marked)
        low = plane.within_support(name, low)
        high = plane.within_support(name, high)
        axes.append(np.linspace(low, high, points))

    coordinates = np.meshgrid(*axes, indexing="ij")
    thetas = plane.thetas(np.column_stack([c.ravel() for c in coordinates]))
    ok = supported(evaluator, thetas)
    heights = np.full(len(thetas), np.nan)
    heights[ok] = objective(optimum, evaluator, thetas[ok])
    heights[~np.isfinite(heights)] = np.nan
    return Landscape(
        axes,
        heights.reshape(coordinates[0].shape),
        path=_columns(path, names),
        local_optima=_columns(modes, names),
        optimum=_columns(plane.center, names),
    )


def _ends(center: Floats, error: float, marked: Floats) -> tuple[float, float]:
    """Return the ends of an axis: beyond some standard errors, and beyond all marked points."""
    reach = _STANDARD_ERRORS * error
    first = center[0] - reach
    last = center[0] + reach
    lowest = marked.min()
    highest = marked.max()
    # About the size of a marker.
    margin = 0.04 * (max(last, highest) - min(first, lowest))
    return min(first, lowest - margin), max(last, highest + margin)


def _columns(elements: dict[str, Floats], names: list[str]) -> Floats:
    """Return the elements of some names side by side, shape (m, names)."""
    return np.stack([elements[name] for name in names], axis=-1)


def rooted(heights: Floats) -> tuple[Floats, float, float]:
    """Return roots of heights above the lowest, 1 at their .9 quantile; lowest and quantile.

    Even levels of the root are evenly spaced around an optimum where heights are a parabola.
    """
    finite = heights[np.isfinite(heights)]
    low = float(finite.min())
    high = float(np.quantile(finite, 0.9))
    above = np.maximum(heights - low, 0.0)
    return np.sqrt(above / max(high - low, 1e-300)), low, high
