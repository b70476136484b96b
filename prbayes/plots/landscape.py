"""The discrepancy as a landscape over one or two hyperparameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pymc as pm

from prbayes._validate import (
    Floats,
    Labels,
    NamedArrays,
    complete_rows,
    positive_integer,
    wrong_type,
)
from prbayes.model.description import labelled
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import Level
from prbayes.model.locking import locked
from prbayes.model.parameters import in_support, optimum_elements, single_elements, split_elements
from prbayes.optimize.optimum import Optimum, require_of_model
from prbayes.plots.canvas import (
    BLUE,
    GREY,
    VERMILION,
    check_options,
    finish,
    ink,
    metric_label,
    named,
    panels,
    refuse_labels,
)
from prbayes.plots.ensemble import supported
from prbayes.plots.selection import Coords, FilterVars, VarNames, elements_of, select
from prbayes.results.compare import thetas_at

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@locked
def plot_landscape(
    optimum: Optimum,
    *,
    model: pm.Model | None = None,
    var_names: VarNames | None = None,
    filter_vars: FilterVars | None = None,
    coords: Coords | None = None,
    n_points: int | None = None,
    max_responses: int = 0,
    labels: Labels | None = None,
    **pc_kwargs: Any,
) -> Figure:
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
    var_names : str or sequence of str, optional
        One or two hyperparameters, or elements of them, such as ``("mu", "sigma")`` or
        ``("mu[0]", "mu[1]")``: along the x axis, and the y axis. The first two by default.
    filter_vars : {None, "like", "regex"}
        How ``var_names`` are read, as by ArviZ.
    coords : mapping, optional
        Labels of the hyperparameters by dimension, such as ``{"supplier": "Adler"}``.
    n_points : int, optional
        Number along each axis; 41, or 161 for a curve.
    max_responses : int
        Largest number of responses that may be computed. With `Reweighted` none is; with
        `Resimulated` and `Fresh` every point of the picture costs n for each simulator.
    labels : mapping, optional
        Labels of hyperparameters by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, ``col_wrap`` panels in a row, and ``figure_kwargs`` for
        ``matplotlib.pyplot.figure``.

    Returns
    -------
    matplotlib.figure.Figure
        Its panel, and over two hyperparameters the bar.

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
    >>> figure = prb.plots.plot_landscape(prb.minimize(model))
    >>> figure.axes[0].get_ylabel()
    'discrepancy (area metric)'
    """
    check_options(labels, pc_kwargs)
    positive_integer(max_responses, "max_responses", minimum=0)
    check_optimum(optimum, "plot_landscape")
    evaluator = _evaluator_of(optimum, model)
    hyperparameters = select_free(optimum)
    names = select_free(optimum, var_names, filter_vars, coords)
    if var_names is not None and len(names) > 2:
        raise ValueError(f"plot_landscape: var_names: got {names}, expected one or two of them")
    names = names[:2]
    refuse_labels(labels, hyperparameters, evaluator=evaluator)
    if n_points is None:
        # Curve and contours look smooth, and take about a second.
        n_points = 161 if len(names) == 1 else 41
    else:
        # Fewer points would not show where the objective is lowest.
        n_points = positive_integer(n_points, "n_points", minimum=5)
    n_all = n_points ** len(names)
    cost = n_all * evaluator.responses_per_theta
    if cost > max_responses:
        raise ValueError(
            f"plot_landscape: got max_responses={max_responses}, expected at least {cost}: {n_all} "
            f"points with {evaluator.responses_per_theta} responses each; pass "
            f"max_responses={cost}, fewer points, or use prb.Reweighted(), whose pictures cost none"
        )

    surface = landscape(optimum, evaluator, names, n_points)
    if not np.isfinite(surface.heights).any():
        raise ValueError(
            "plot_landscape: got no finite objective, expected some around the optimum; look at "
            "its message"
        )
    fixed = [named(name, labels) for name in hyperparameters if name not in names]
    title = f"{', '.join(fixed)} fixed at the optimum" if fixed else ""
    figure, axes = panels(["landscape"], size=(6.4, 5.4), pc_kwargs=pc_kwargs)
    axis = axes["landscape"]
    texts = [*(named(name, labels) for name in names), objective_label(optimum)]
    if len(names) == 1:
        _draw_curve(axis, surface, alone=not fixed)
    else:
        _draw_plane(axis, surface, texts[-1])
        axis.set_ylim(surface.axes[1][0], surface.axes[1][-1])
    axis.set_xlim(surface.axes[0][0], surface.axes[0][-1])
    axis.set(xlabel=texts[0], ylabel=texts[1], title=title)
    return finish(figure)


def _evaluator_of(optimum: Optimum, model: pm.Model | None) -> Evaluator:
    """Return the optimum's evaluator, or that of another model with the same hyperparameters."""
    if model is None or model is optimum.model:
        return optimum.evaluator
    require_of_model(optimum, model, "plot_landscape", Level.POPULATIONS)
    evaluator = Evaluator.of(model)
    simulators = [node.name for node in evaluator.nodes or evaluator.measurements]
    expected = list(optimum.scales)
    names, expected_names = (e.hyperparameters.names for e in (evaluator, optimum.evaluator))
    if names != expected_names or simulators != expected:
        raise ValueError(
            f"model: got hyperparameters and simulators {names} and "
            f"{simulators}, expected {expected_names} and {expected}"
        )
    return evaluator


def _draw_plane(axis: Axes, surface: Landscape, objective: str) -> None:
    """Draw the objective over two hyperparameters, with the path and a colour bar."""
    # Around an optimum the objective is a parabola. Even steps of its root give contours at even
    # distances.
    finite = surface.heights[np.isfinite(surface.heights)]
    low = float(finite.min())
    high = float(np.quantile(finite, 0.9))
    roots = np.sqrt(np.maximum(surface.heights - low, 0.0) / max(high - low, 1e-300)).T
    levels = np.linspace(0, 1, 11)
    filled = axis.contourf(
        *surface.axes, np.minimum(roots, levels[-1]), levels, cmap="cividis", alpha=0.45
    )
    filled.set_gid("landscape")
    axis.contour(*surface.axes, roots, levels[1:-1], colors=GREY, alpha=0.6)
    places = levels[::2]
    bar = axis.figure.colorbar(filled, ax=axis, label=objective)
    bar.set_ticks(places.tolist(), labels=distinct_texts(low + places**2 * (high - low)))
    axis.plot(*surface.path.T, color=ink(), linewidth=1.0, gid="path")
    _draw_marks(axis, surface.path.T, surface.optimum.T, surface.local_optima.T)


def distinct_texts(values: Floats) -> list[str]:
    """Return numbers with three digits, or up to eight until they differ."""
    for digits in range(3, 9):
        texts = [f"{value:.{digits}g}" for value in values]
        if len(set(texts)) == len(texts):
            break
    return texts


def _draw_curve(axis: Axes, surface: Landscape, *, alone: bool) -> None:
    """Draw the objective over one hyperparameter.

    The path and other optima are points of the curve only if there is no other hyperparameter.
    """
    finite = np.isfinite(surface.heights)
    x = surface.axes[0][finite]
    heights = surface.heights[finite]

    def on_curve(places: Floats) -> Floats:
        """Return the places, (m, 1), that the curve covers, and its heights there, (2, m)."""
        at = places[:, 0]
        at = at[(at >= x[0]) & (at <= x[-1])]
        return np.stack([at, np.interp(at, x, heights)])

    axis.plot(x, heights, color=BLUE, gid="landscape")
    path = on_curve(surface.path) if alone else None
    local_optima = surface.local_optima if alone else surface.local_optima[:0]
    _draw_marks(axis, path, on_curve(surface.optimum), on_curve(local_optima))


def _draw_marks(axis: Axes, path: Any, optimum: Floats, local_optima: Floats) -> None:
    """Mark points of the path, the optimum and other optima, shape (2, m) each."""
    if path is not None:
        text = "path of the optimiser"
        axis.scatter(path[0], path[1], 14, color=ink(), label=text, gid="evaluated", zorder=2)
    look: dict[str, Any] = {"color": VERMILION, "zorder": 3}
    axis.scatter(optimum[0], optimum[1], 90, marker="D", label="optimum", gid="optimum", **look)
    if local_optima.size:
        text = "other optima"
        x, y = local_optima
        axis.scatter(x, y, 70, marker="x", label=text, gid="local_optima", **look)


# -- the objective and its values on a grid --------------------------------------------------


def check_optimum(optimum: Any, caller: str) -> None:
    """Raise if it is no optimum, or one without a trace."""
    if not isinstance(optimum, Optimum):
        raise wrong_type(optimum, caller, "an Optimum; call prb.minimize() first")
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


def free_elements(evaluator: Evaluator, thetas: Floats) -> NamedArrays:
    """Return the free variables' elements in the user's own units, shape (P,), by element name."""
    values = evaluator.hyperparameters.constrained(thetas)
    free = {str(rv.name): values[str(rv.name)] for rv in evaluator.model.free_RVs}
    return split_elements(labelled(evaluator, free, {"draw": len(thetas)}).data_vars)


def select_free(
    optimum: Optimum,
    var_names: VarNames | None = None,
    filter_vars: FilterVars | None = None,
    coords: Coords | None = None,
) -> list[str]:
    """Return the names of free elements, all by default, without constant zeros of a factor."""
    point = {str(rv.name): optimum.point[str(rv.name)] for rv in optimum.model.free_RVs}
    values = labelled(optimum.evaluator, point, {}).data_vars
    elements = elements_of({name: value.expand_dims("row") for name, value in values.items()})
    shown = {name: elements[name] for name in optimum_elements(values, optimum.stderr)}
    return select(shown, var_names, filter_vars, coords)


@dataclass(frozen=True, eq=False)
class Landscape:
    """The objective over a grid in the user's own units."""

    axes: list[Floats]  # grid of each hyperparameter, (n,)
    # objective on the grid, (n,) or (n, n), with the first hyperparameter along the first axis; NaN
    # where stored responses do not support a population or the priors exclude it
    heights: Floats
    path: Floats  # points of the optimiser, (m, 1 or 2)
    local_optima: Floats  # (m, 1 or 2)
    optimum: Floats  # (1, 1 or 2)


def landscape(optimum: Optimum, evaluator: Evaluator, names: list[str], points: int) -> Landscape:
    """Evaluate the objective on a grid of ``points`` along each of one or two hyperparameters."""
    center = free_elements(evaluator, optimum.theta[None])
    path = free_elements(evaluator, optimum.search.trace["theta"])
    local_optima = np.array([mode["theta"] for mode in optimum.local_optima])
    modes = free_elements(evaluator, local_optima.reshape(-1, optimum.theta.size))
    prior_thetas = evaluator.hyperparameters.prior_thetas(1000, 0)
    prior = free_elements(evaluator, prior_thetas)
    stderr = labelled(optimum.evaluator, optimum.stderr, {})
    errors = single_elements(stderr.data_vars)

    axes = []
    for name in names:
        # The optimiser may have started far out. Its path widens the axis to the central 98% of the
        # prior at most.
        bulk = np.quantile(prior[name], (0.01, 0.99))
        limited = np.clip(path[name], *bulk)
        marked = np.append(limited, modes[name])
        lowest, highest = marked.min(), marked.max()
        # Beyond four standard errors the normal approximation has a probability of 6e-5. If the
        # error is unknown, the axis is as wide as the prior.
        reach = 4 * errors[name]
        if not 0 < reach < np.inf:
            reach = float(bulk[1] - bulk[0]) / 2
        middle = center[name][0]
        first = middle - reach
        last = middle + reach
        # All marked points are inside the axis, with room for their markers.
        margin = 0.04 * (max(last, highest) - min(first, lowest))
        ends = []
        for end in (min(first, lowest - margin), max(last, highest + margin)):
            # The objective exists within the support of the priors alone. The axis ends at the last
            # of 32 steps that is inside.
            steps = np.linspace(middle, end, 33)
            thetas = _thetas_at(evaluator, center | {name: steps})
            ok = complete_rows(thetas)
            ok[ok] = in_support(evaluator.hyperparameters, thetas[ok])
            if ok.all():
                ends.append(end)
                continue
            last_inside = max(int(np.argmin(ok)) - 1, 0)
            ends.append(float(steps[last_inside]))
        axes.append(np.linspace(ends[0], ends[1], points))

    coordinates = np.meshgrid(*axes, indexing="ij")
    on_grid = {name: x.ravel() for name, x in zip(names, coordinates, strict=True)}
    thetas = _thetas_at(evaluator, center | on_grid)
    ok = supported(evaluator, thetas)
    heights = np.full(len(thetas), np.nan)
    heights[ok] = objective(optimum, evaluator, thetas[ok])
    heights[~np.isfinite(heights)] = np.nan
    marks = [np.stack([x[name] for name in names], axis=-1) for x in (path, modes, center)]
    return Landscape(axes, heights.reshape(coordinates[0].shape), *marks)


def _thetas_at(evaluator: Evaluator, elements: NamedArrays) -> Floats:
    """Return thetas of elements by name, (n,) or (1,) each; NaN outside the priors' support."""
    with np.errstate(all="ignore"):
        return thetas_at(evaluator, elements)
