"""Pairs of the outputs of a simulator: measured specimens, and the calibrated population."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._stats import INTERVAL
from prbayes._validate import ArrayPair, Floats, Labels, complete_rows
from prbayes.model.evaluator import Evaluator
from prbayes.model.locking import locked
from prbayes.optimize.optimum import Optimum
from prbayes.plots.canvas import (
    BLUE,
    VERMILION,
    Limits,
    check_options,
    finish,
    ink,
    panels,
    refuse_labels,
    round_ticks,
)
from prbayes.plots.curves import axis_range, central_range, outlines
from prbayes.plots.ensemble import read_before, read_result
from prbayes.plots.responses import Output, displayed_outputs, output_elements
from prbayes.plots.selection import Coords, FilterVars, VarNames, select

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# largest number of outputs in a picture, because panels of more pairs are too small to be read
_MOST = 7


@locked
def plot_outputs(
    result: Optimum | xr.DataTree,
    *,
    model: pm.Model | None = None,
    var_names: VarNames | None = None,
    filter_vars: FilterVars | None = None,
    coords: Coords | None = None,
    before: Mapping[str, Any] | bool | None = None,
    n_draws: int | None = None,
    labels: Labels | None = None,
    **pc_kwargs: Any,
) -> Figure:
    """Draw pairs of outputs of a simulator: measured specimens in the calibrated population.

    Points are the specimens with both outputs. Solid lines are the smallest regions with 50% and
    89% of the calibrated population: the posterior predictive distribution, or the optimum's
    population. Dashed lines are those before the calibration. The title has the rank correlations
    of the points and of the calibrated population.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`; or with a ``posterior`` group, from any sampler.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    var_names : str or sequence of str, optional
        A simulator with several outputs, the first one by default; or outputs as elements of it,
        such as ``["frame[first]", "frame[third]"]``.
    filter_vars : {None, "like", "regex"}
        How ``var_names`` are read, as by ArviZ.
    coords : mapping, optional
        Two to seven outputs by dimension, such as ``{"output": ["first", "third"]}``. By default
        all that vary, but of more than five four, from the first to the last.
    before : dict or bool, optional
        As in `plot_responses`.
    n_draws : int, optional
        Number of populations of a posterior; by default 200 where they cost no response
        (`Reweighted`), otherwise 40, each of which costs n responses.
    labels : mapping, optional
        Labels of outputs by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, ``col_wrap`` panels in a row, and ``figure_kwargs`` for
        ``matplotlib.pyplot.figure``.

    Returns
    -------
    matplotlib.figure.Figure
        With a panel for each pair, whose label is ``"second, first"`` where the first output is
        along the x axis.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, an output is unknown, or the result lacks a free
        variable of the model, or is of other populations or data.
    DesignError
        If stored responses do not support the populations.

    Notes
    -----
    Densities are those of a Gaussian kernel along the population's principal axes, which preserves
    strong correlations. Specimens that failed (+inf) in one output of a pair are left out.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> def response(a, b):
    ...     return {"load": a + b, "life": a * b}
    >>> rng = np.random.default_rng(1)
    >>> data = response(*rng.normal([[2.0], [3.0]], 0.2, (2, 20)))
    >>> with pm.Model() as model:
    ...     a = pm.Normal.dist(pm.Normal("mu", 2.0, 0.5), 0.2)
    ...     b = pm.Normal.dist(3.0, 0.2)
    ...     metric = prb.Joint(prb.ProbabilityResidual())
    ...     cheap = prb.Resimulated(256)
    ...     y = prb.Simulator(
    ...         "y", response, a, b, metric=metric, observed=data, propagation=cheap
    ...     )
    >>> prb.plots.plot_outputs(prb.minimize(model)).axes[0].get_label()
    'life, load'
    """
    check_options(labels, pc_kwargs)
    ensemble = read_result(result, model, "prb.plots.plot_outputs", n_draws)
    evaluator = ensemble.evaluator
    start, text = read_before(result, evaluator, before, "plot_outputs")
    k, columns = _shown_outputs(evaluator, var_names, filter_vars, coords)
    refuse_labels(labels, evaluator.simulators[k].outputs.names, evaluator=evaluator)
    calibrated = _mixture(evaluator, ensemble.mixture, k)
    earlier = _mixture(evaluator, start, k) if len(start) else None
    limits = []
    for output in columns:
        # The 89% region of a normal population in the plane contains all but 1.8% of each output.
        widest = None if earlier is None else _range(output, earlier, tail=0.02)
        observed, _ = output.measured()
        range_ = axis_range(observed, _range(output, calibrated, tail=0.01), widest, margin=0.04)
        limits.append(range_)

    # The pairs make a triangle with one row and one column less than there are outputs.
    size = len(columns) - 1
    texts = [column.node.outputs.names[column.column or 0] for column in columns]
    names = {
        f"{texts[i + 1]}, {texts[j]}": (i, j) if j <= i else None
        for i in range(size)
        for j in range(size)
    }
    side = 5.4 if size == 1 else 3.7
    options = {"col_wrap": size} | pc_kwargs
    figure, axes = panels(list(names), size=(side, side), pc_kwargs=options)
    populations = {f"calibrated: {ensemble.label}, 50% and {INTERVAL:.0%}": calibrated}
    if earlier is not None:
        populations = {f"before: {text}": earlier} | populations
    for name, axis in axes.items():
        place = names[name]
        if place is None:
            axis.remove()
            continue
        i, j = place
        x = columns[j]
        y = columns[i + 1]
        _draw_outputs(axis, x, y, populations)
        axis.set(xlim=limits[j], ylim=limits[i + 1])
        axis.set_xticks(*round_ticks(*limits[j]))
        axis.set_yticks(*round_ticks(*limits[i + 1]))
        if i == size - 1:  # Names stand below the last row and beside the first column alone.
            axis.set_xlabel(x.text(labels))
        if j == 0:
            axis.set_ylabel(y.text(labels))
    return finish(figure)


def _shown_outputs(
    evaluator: Evaluator,
    var_names: VarNames | None,
    filter_vars: FilterVars | None,
    coords: Coords | None,
) -> tuple[int, list[Output]]:
    """Return the index of the simulator that the picture shows, and the outputs it shows."""
    nodes = evaluator.simulators
    alone = len(nodes) == 1
    several = {
        k: {output.name: output for output in displayed_outputs(node, alone=alone)}
        for k, node in enumerate(nodes)
        if len(node.outputs.labels) > 1
    }
    if not several:
        raise ValueError(
            f"plot_outputs: got simulators {[node.name for node in nodes]} of one output, expected "
            "one with several; draw them by prb.plots.plot_responses"
        )
    elements = output_elements(
        output for outputs in several.values() for output in outputs.values()
    )
    names = select(elements, var_names, filter_vars, coords)
    selected = {k: sum(name in outputs for name in names) for k, outputs in several.items()}
    # Take the first simulator of which only some outputs are selected, because its outputs were
    # asked for, or else the first one.
    first = [k for k, n in selected.items() if 0 < n < len(several[k])]
    k = (first or [k for k, n in selected.items() if n])[0]
    rest = [name for name in names if name not in several[k]]
    if rest and var_names is not None:
        raise ValueError(
            f"plot_outputs: var_names: got outputs of several simulators, {names[0]} and "
            f"{rest[0]}, expected those of one"
        )
    columns = [several[k][name] for name in names if name in several[k]]
    if len(columns) == len(several[k]):
        varying = []  # outputs whose measured values differ by more than rounding
        for output in columns:
            observed, _ = output.measured()
            finite = observed[np.isfinite(observed)]
            if np.ptp(finite) > 1e-9 * np.abs(finite).max():
                varying.append(output)
        columns = varying if len(varying) > 1 else columns
        if len(columns) > 5:  # Pairs of four outputs, from the first to the last, are legible.
            columns = [columns[round(place)] for place in np.linspace(0, len(columns) - 1, 4)]
    if not 2 <= len(columns) <= _MOST:
        raise ValueError(
            f"plot_outputs: coords: got {len(columns)} outputs, expected two to {_MOST} of "
            f"{list(several[k])!s:.200}"
        )
    return k, columns


def _mixture(evaluator: Evaluator, thetas: Floats, k: int) -> ArrayPair:
    """Return specimens of the k-th simulator's mixture of populations: (n, m), weights (n,)."""
    values, weights = evaluator.populations(thetas, k)
    if evaluator.simulators[k].reweighted is not None:
        values = values[0]  # All populations have the same points.
        weights = weights.mean(axis=0)
    else:
        values = values.reshape(-1, values.shape[-1])
        weights = weights.ravel() / len(thetas)
    has_response = (weights > 0) & ~np.isnan(values).any(axis=-1)
    return values[has_response], weights[has_response]


def _range(output: Output, population: ArrayPair, tail: float) -> Limits:
    """Return the range of all but the outermost values of an output."""
    values, weights = population
    return central_range(output.of(values)[None], weights[None], tail=tail)


def _finite_pairs(x: Output, y: Output, values: Floats, weights: Floats) -> ArrayPair:
    """Return the points, (n, 2), that have two outputs, and their weights."""
    points = np.column_stack([x.of(values), y.of(values)])
    finite = complete_rows(points)
    return points[finite], weights[finite]


def _draw_outputs(axis: Axes, x: Output, y: Output, populations: Mapping[str, ArrayPair]) -> None:
    """Draw measured specimens, and outlines of regions of populations; the last is calibrated."""
    *_, calibrated = populations
    probs = (0.5, INTERVAL)
    for text, population in populations.items():
        points = _finite_pairs(x, y, *population)
        name, color, style = "after", BLUE, "-"
        if text != calibrated:
            name, color, style = "before", VERMILION, "--"
        lines = outlines(*points, probs) if len(points[0]) > 1 else []
        for prob, line in zip(probs, lines, strict=False):
            look: dict[str, Any] = {"color": color, "linestyle": style, "label": text}
            axis.plot(*line, linewidth=1.5, gid=f"{name}_{100 * prob:.0f}", **look)
    measured = _finite_pairs(x, y, x.node.observed, x.node.weights)
    first, second = measured[0].T
    axis.scatter(first, second, 14, color=ink(), label="measured", gid="measured", zorder=3)
    correlations = [_written(rank_correlation(*pairs)) for pairs in (measured, points)]
    axis.set_title("rank correlation\nmeasured {}, calibrated {}".format(*correlations))


def _written(r: float) -> str:
    """Return a correlation with two decimals, or three near one."""
    if np.isnan(r):
        return "unknown"
    digits = 2 if abs(r) < 0.95 else 3
    return f"{round(r, digits) + 0.0:.{digits}f}"


def rank_correlation(points: Floats, weights: Floats) -> float:
    """Return the correlation of the ranks of weighted points, (n, 2); NaN if it is unknown."""
    if len(points) < 2:
        return np.nan
    ranks = []
    for column in points.T:
        # The rank of a value is the weight below it, and half the weight of equal values.
        _, place = np.unique(column, return_inverse=True)
        mass = np.bincount(place, weights)
        ranks.append((np.cumsum(mass) - mass / 2)[place])
    (first, product), (_, second) = np.cov(ranks, aweights=weights, ddof=0)
    scale = np.sqrt(first * second)
    return float(product / scale) if scale > 0 else np.nan
