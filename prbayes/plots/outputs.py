"""Pairs of the outputs of a simulator: measured specimens, and the calibrated population."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._stats import INTERVAL
from prbayes._validate import Floats, called
from prbayes.model.evaluator import Evaluator
from prbayes.model.locking import locked
from prbayes.optimize.optimum import Optimum
from prbayes.plots.canvas import (
    BLUE,
    DASHED,
    INK,
    SOLID,
    VERMILION,
    Canvas,
    Limits,
    Panel,
    refuse_labels,
    refuse_look,
    round_ticks,
)
from prbayes.plots.curves import axis_range, central_range, outlines
from prbayes.plots.ensemble import read_before, read_result
from prbayes.plots.responses import Output, displayed_outputs

# Most outputs of one picture: the pairs of more are too small to be read.
_MOST = 7


@locked
def plot_outputs(
    result: Optimum | xr.DataTree,
    *,
    model: pm.Model | None = None,
    simulator: str | None = None,
    outputs: Sequence[Any] | None = None,
    before: Mapping[str, Any] | bool | None = None,
    n_draws: int | None = None,
    labels: Mapping[str, str] | None = None,
    **pc_kwargs: Any,
) -> Any:
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
    simulator : str, optional
        Name of a simulator with several outputs; the first one by default.
    outputs : sequence, optional
        Two to seven outputs by label, such as ``["first", "third"]``, or by number without labels;
        by default all that vary, but of more than five four, from the first to the last.
    before : dict or bool, optional
        As in `plot_responses`.
    n_draws : int, optional
        Number of populations of a posterior; by default 200 where they cost no response
        (`Reweighted`), otherwise 40, each of which costs n responses.
    labels : mapping, optional
        Labels of outputs by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, and keywords of ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``measured``, ``before_50``, ``before_89``, ``after_50`` and
        ``after_89``, by pair: ``"second, first"`` has the first output along the x axis.

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
    >>> list(prb.plots.plot_outputs(prb.minimize(model)).viz["measured"])
    ['life, load']
    """
    refuse_look(labels, pc_kwargs)
    ensemble = read_result(result, model, "prb.plots.plot_outputs", n_draws)
    evaluator = ensemble.evaluator
    start, text = read_before(result, evaluator, before, "plot_outputs")
    k = _simulator_index(evaluator, simulator)
    columns = _shown_outputs(evaluator, k, outputs)
    refuse_labels(labels, evaluator.simulators[k].outputs.names, evaluator=evaluator)
    calibrated = _mixture(evaluator, ensemble.mixture, k)
    earlier = _mixture(evaluator, start, k) if len(start) else None
    limits = []
    for output in columns:
        # A normal population's region of 89% contains all but 1.8% of one output.
        widest = None if earlier is None else _range(output, earlier, tail=0.02)
        observed, _ = output.measured()
        range_ = axis_range(observed, _range(output, calibrated, tail=0.01), widest, margin=0.04)
        limits.append(range_)

    # A triangle of pairs: one column less than outputs, and one row
    size = len(columns) - 1
    names = {
        (i, j): ", ".join(columns[c].name.partition("[")[2][:-1] for c in (i + 1, j))
        for i in range(size)
        for j in range(size)
    }
    side = 5.4 if size == 1 else 3.4
    canvas = Canvas(
        list(names.values()), size=(side, side), pc_kwargs={"col_wrap": size, **pc_kwargs}
    )
    legend = f"calibrated: {ensemble.label}, 50% and {INTERVAL:.0%}"
    for (i, j), name in names.items():
        panel = canvas.panels[name]
        if j > i:
            panel.target.set_axis_off()
            continue
        x = columns[j]
        y = columns[i + 1]
        if earlier is not None:
            points = _finite_pairs(x, y, *earlier)
            _draw_regions(panel, "before", points, VERMILION, DASHED, f"before: {text}")
        points = _finite_pairs(x, y, *calibrated)
        _draw_regions(panel, "after", points, BLUE, SOLID, legend)
        measured = _finite_pairs(x, y, x.node.observed, x.node.weights)
        panel.points("measured", measured[0].T, INK, size=14, legend="measured")
        correlations = [_written(rank_correlation(*pairs)) for pairs in (measured, points)]
        # Names on the left and below all panels
        panel.axes(
            x=x.text(labels) if i == size - 1 else "",
            y=y.text(labels) if j == 0 else "",
            title="rank correlation\nmeasured {}, calibrated {}".format(*correlations),
            xlim=limits[j],
            ylim=limits[i + 1],
            xticks=round_ticks(*limits[j]),
            yticks=round_ticks(*limits[i + 1]),
        )
    return canvas.finish()


def _simulator_index(evaluator: Evaluator, simulator: str | None) -> int:
    """Return the index of a simulator by name, or of the first with several outputs."""
    names = [node.name for node in evaluator.simulators]
    several = [node.name for node in evaluator.simulators if len(node.outputs.labels) > 1]
    if not several:
        raise ValueError(
            f"plot_outputs: got simulators {names} of one output, expected one with several; draw "
            "them by prb.plots.plot_responses"
        )
    if simulator is None:
        return names.index(several[0])
    if not isinstance(simulator, str):
        raise TypeError(f"simulator: got {called(simulator)}, expected a name, one of {several}")
    if simulator not in several:
        raise KeyError(f"simulator: got {simulator!r:.60}, expected one of {several}")
    return names.index(simulator)


def _shown_outputs(evaluator: Evaluator, k: int, labels: Sequence[Any] | None) -> list[Output]:
    """Return the outputs of the picture, by their labels or by default."""
    node = evaluator.simulators[k]
    columns = displayed_outputs(node, alone=len(evaluator.simulators) == 1)
    if labels is None:
        varying = []  # by more than rounding
        for output in columns:
            observed, _ = output.measured()
            finite = observed[np.isfinite(observed)]
            if np.ptp(finite) > 1e-9 * np.abs(finite).max():
                varying.append(output)
        columns = varying if len(varying) > 1 else columns
        if len(columns) <= 5:
            return columns
        # Of many outputs, such as a curve, four from the first to the last
        return [columns[round(place)] for place in np.linspace(0, len(columns) - 1, 4)]
    available = list(node.outputs.labels)
    listed = str(available)
    if len(available) > 2 * _MOST:
        listed = f"{str(available[:_MOST])[:-1]}, ...]"
    if isinstance(labels, str) or not isinstance(labels, Sequence):
        raise TypeError(
            f"outputs: got {called(labels)}, expected a list of two to {_MOST} of {listed}"
        )
    if not 2 <= len(labels) <= _MOST:
        raise ValueError(f"outputs: got {len(labels)} outputs, expected two to {_MOST} of {listed}")
    indices = []
    for label in labels:
        names = [x for x in (available, list(node.outputs.names)) if label in x]
        if not names or isinstance(label, bool):
            raise KeyError(f"outputs: got {label!r:.60}, expected some of {listed}")
        indices.append(names[0].index(label))
    if len(set(indices)) < len(indices):
        raise ValueError(f"outputs: got {list(labels)!r:.200}, expected different ones")
    return [columns[i] for i in indices]


def _mixture(evaluator: Evaluator, thetas: Floats, k: int) -> tuple[Floats, Floats]:
    """Return specimens of the k-th simulator's mixture of populations: (n, m), weights (n,)."""
    values, weights = evaluator.populations(thetas, k)
    if evaluator.simulators[k].reweighted is not None:  # all populations have the same points
        values = values[0]
        weights = weights.mean(axis=0)
    else:
        values = values.reshape(-1, values.shape[-1])
        weights = weights.ravel() / len(thetas)
    has_response = (weights > 0) & ~np.isnan(values).any(axis=-1)
    return values[has_response], weights[has_response]


def _range(output: Output, population: tuple[Floats, Floats], tail: float) -> Limits:
    """Return the range of all but the outermost values of an output."""
    values, weights = population
    return central_range(output.of(values)[None], weights[None], tail=tail)


def _finite_pairs(x: Output, y: Output, values: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return the points, (n, 2), that have two outputs, and their weights."""
    points = np.column_stack([x.of(values), y.of(values)])
    finite = np.isfinite(points).all(axis=1)
    return points[finite], weights[finite]


def _draw_regions(
    panel: Panel, visual: str, sample: tuple[Floats, Floats], color: str, style: str, text: str
) -> None:
    """Draw the outlines of regions of a weighted sample of points."""
    if len(sample[0]) < 2:
        return
    probs = (0.5, INTERVAL)
    for prob, line in zip(probs, outlines(*sample, probs), strict=True):
        name = f"{visual}_{100 * prob:.0f}"
        panel.line(name, line, color, style=style, width=1.5, legend=text)


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
        # The weight below each value, and half of that of equal ones
        _, place = np.unique(column, return_inverse=True)
        mass = np.bincount(place, weights)
        ranks.append((np.cumsum(mass) - mass / 2)[place])
    (first, product), (_, second) = np.cov(ranks, aweights=weights, ddof=0)
    scale = np.sqrt(first * second)
    return float(product / scale) if scale > 0 else np.nan
