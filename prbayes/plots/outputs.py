"""Pairs of the outputs of a simulator: measured specimens, and the calibrated population."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._finding import Finding, report
from prbayes._stats import INTERVAL
from prbayes._validate import Floats, called, positive_integer
from prbayes.model.emulated import PopulationSimulator
from prbayes.model.evaluator import Evaluator
from prbayes.model.locking import locked
from prbayes.optimize.optimum import Optimum
from prbayes.plots._canvas import BLUE, DASHED, INK, VERMILION, Canvas, Limits, Panel, refuse_look
from prbayes.plots._curves import central_range
from prbayes.plots._ensemble import read_before, read_result, supported
from prbayes.plots._names import refuse_labels
from prbayes.plots._panels import Output, outputs_of
from prbayes.plots._regions import outlines
from prbayes.plots._ticks import round_ticks

# Outputs of a picture unless others are asked for: ten pairs, by judgement; and of a curve, whose
# neighbours look alike.
_SHOWN, _OF_MANY = 5, 4
# More pairs than those of so many outputs are too small to be read.
_MOST = 7
# Shares of the population within the lines.
_SHARES = (0.5, INTERVAL)


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
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw pairs of outputs of a simulator: measured specimens in the calibrated population.

    Points are the specimens of which both outputs were measured. The solid lines hold 50% and 89%
    of the calibrated population, in the smallest regions that do: of the posterior predictive
    distribution, or the optimum's population. Dashed ones are those before the calibration. A
    title has the correlation of the points' ranks, and that of the calibrated population's.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`; or with a ``posterior`` group, from any sampler.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    simulator : str, optional
        Name of a simulator with several outputs; the first one by default.
    outputs : sequence, optional
        Two to seven outputs by label, such as ``["first", "third"]``, or by number if they have no
        names; by default all that vary, but of more than five four, from the first to the last.
    before : dict or bool, optional
        As in `plot_responses`.
    n_draws : int, optional
        Number of populations of a posterior; 200 where they cost no response (`Reweighted`), 40
        elsewhere, where each costs n responses.
    labels : mapping, optional
        What a reader calls an output, by its name, with units.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        ``figsize=(8, 5)``, in inches, of the whole picture; others go to
        ``arviz.PlotCollection.wrap``, such as ``col_wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``measured``, ``before_50``, ``before_89``, ``after_50`` and
        ``after_89``, by pair: ``"second, first"`` has the first output along the x axis.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, there is no such output, or the result lacks a free
        variable of the model, or is of other populations or data.
    DesignError
        If stored responses do not support the populations.

    Notes
    -----
    Densities are those of a Gaussian kernel along the population's principal axes, so that strong
    correlations stay what they are. Specimens that failed (+inf) in one of a pair are in neither.

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
    >>> list(prb.plot_outputs(prb.minimize(model), backend="none").viz["measured"])
    ['life, load']
    """
    refuse_look(labels, backend, pc_kwargs)
    if n_draws is not None:
        positive_integer(n_draws, "n_draws")
    shown = read_result(result, model, "prb.plot_outputs", n_draws)
    evaluator = shown.evaluator
    start, what = read_before(result, evaluator, before)
    k = _simulator(evaluator, simulator)
    chosen = _chosen(evaluator, k, outputs)
    refuse_labels(labels, evaluator.simulators[k].outputs.names, evaluator=evaluator)
    if len(start) and not supported(evaluator, start)[0]:
        report(
            Finding(
                "population-left-out",
                f"plot_outputs: before ({what}): left out, because stored responses do not reach "
                "there.",
            )
        )
        start = start[:0]
    thetas = shown.center if len(shown.center) else shown.thetas
    after = _Population.of(evaluator, thetas, k)
    earlier = _Population.of(evaluator, start, k) if len(start) else None
    limits = {output.name: _covered(output, after, earlier) for output in chosen}

    # One column less than outputs, and one row
    size = len(chosen) - 1
    pairs = {(i, j): _pair(chosen[i + 1], chosen[j]) for i in range(size) for j in range(size)}
    side = 5.4 if size == 1 else 3.4
    canvas = Canvas(
        list(pairs.values()),
        size=(side, side),
        backend=backend,
        pc_kwargs={"col_wrap": size, **pc_kwargs},
    )
    for (i, j), name in pairs.items():
        panel = canvas.panel(name)
        if j > i:
            panel.blank()
            continue
        x = chosen[j]
        y = chosen[i + 1]
        if earlier is not None:
            _draw_regions(panel, "before", earlier, (x, y), VERMILION, DASHED, f"before: {what}")
        text = f"calibrated: {shown.label}, {_SHARES[0]:.0%} and {_SHARES[1]:.0%}"
        calibrated = _draw_regions(panel, "after", after, (x, y), BLUE, "C0", text)
        measured = _draw_measured(panel, x, y)
        # Names on the left and below all panels
        across = limits[x.name]
        up = limits[y.name]
        panel.axes(
            x=x.text(labels) if i == size - 1 else "",
            y=y.text(labels) if j == 0 else "",
            title=_title(measured, calibrated),
            xlim=across,
            ylim=up,
            xticks=round_ticks(*across),
            yticks=round_ticks(*up),
        )
    return canvas.finish()


def _simulator(evaluator: Evaluator, wanted: str | None) -> int:
    """Return which simulator is drawn: the one of a name, or the first with several outputs."""
    names = [node.name for node in evaluator.simulators]
    several = [node.name for node in evaluator.simulators if len(node.outputs.labels) > 1]
    if not several:
        raise ValueError(
            f"plot_outputs: got simulators {names} of one output, expected one with several; draw "
            "them by prb.plot_responses"
        )
    if wanted is None:
        return names.index(several[0])
    if not isinstance(wanted, str):
        raise TypeError(f"simulator: got {called(wanted)}, expected a name, one of {several}")
    if wanted not in several:
        raise KeyError(f"simulator: got {wanted!r:.60}, expected one of {several}")
    return names.index(wanted)


def _chosen(evaluator: Evaluator, k: int, wanted: Sequence[Any] | None) -> list[Output]:
    """Return the outputs that are drawn."""
    node = evaluator.simulators[k]
    every = outputs_of(node, alone=len(evaluator.simulators) == 1)
    if wanted is None:
        varying = [output for output in every if _varies(output)]
        every = varying if len(varying) > 1 else every
        if len(every) <= _SHOWN:
            return every
        places = np.linspace(0, len(every) - 1, _OF_MANY)
        return [every[round(place)] for place in places]
    if isinstance(wanted, str) or not isinstance(wanted, Sequence):
        raise TypeError(
            f"outputs: got {called(wanted)}, expected a list of two to {_MOST} of {_listed(node)}"
        )
    if not 2 <= len(wanted) <= _MOST:
        raise ValueError(
            f"outputs: got {len(wanted)} outputs, expected two to {_MOST} of {_listed(node)}"
        )
    found = [every[_place(node, label)] for label in wanted]
    if len({output.column for output in found}) < len(found):
        raise ValueError(f"outputs: got {list(wanted)!r:.200}, expected different ones")
    return found


def _varies(output: Output) -> bool:
    """Whether specimens differ in an output, by more than rounding."""
    observed, _ = output.measured()
    finite = observed[np.isfinite(observed)]
    return bool(np.ptp(finite) > 1e-9 * np.abs(finite).max())


def _place(node: PopulationSimulator, label: Any) -> int:
    """Return which output has a label."""
    outputs = node.outputs
    for known in (outputs.labels, outputs.names):
        if label in known and not isinstance(label, bool):
            return known.index(label)
    raise KeyError(f"outputs: got {label!r:.60}, expected some of {_listed(node)}")


def _listed(node: PopulationSimulator) -> str:
    """Return the labels of a simulator's outputs, not all of many."""
    labels = list(node.outputs.labels)
    many = len(labels) > 2 * _MOST
    return f"{str(labels[:_MOST])[:-1]}, ...]" if many else str(labels)


def _pair(y: Output, x: Output) -> str:
    """Return the name of the panel of two outputs."""
    return ", ".join(output.name.partition("[")[2][:-1] for output in (y, x))


@dataclass(frozen=True, eq=False)
class _Population:
    """Specimens of one population, or of the mixture of several: (n, m), with weights (n,)."""

    values: Floats
    weights: Floats

    @classmethod
    def of(cls, evaluator: Evaluator, thetas: Floats, k: int) -> _Population:
        """Return the k-th simulator's population at thetas, one for all of them."""
        values, weights = evaluator.populations(thetas, k)
        if evaluator.simulators[k].design is not None:  # whose points are all populations'
            values = values[0]
            weights = weights.mean(axis=0)
        else:
            values = values.reshape(-1, values.shape[-1])
            weights = weights.ravel() / len(thetas)
        kept = (weights > 0) & ~np.isnan(values).any(axis=-1)
        return cls(values[kept], weights[kept])

    def range_of(self, output: Output, tail: float) -> tuple[float, float]:
        """Return the range of all but the outermost values of an output."""
        return central_range(output.of(self.values)[None], self.weights[None], tail=tail)

    def of_pair(self, x: Output, y: Output) -> tuple[Floats, Floats]:
        """Return the points of two outputs, (n, 2), that are finite, and their weights."""
        points = np.column_stack([x.of(self.values), y.of(self.values)])
        known = np.isfinite(points).all(axis=1)
        return points[known], self.weights[known]


def _covered(output: Output, after: _Population, earlier: _Population | None) -> Limits:
    """Return what an axis covers: data and population, and the one before unless it is far off."""
    observed, _ = output.measured()
    finite = observed[np.isfinite(observed)]
    # A normal population's region of 89% reaches as far as all but 1.8% of one output
    low, high = after.range_of(output, tail=0.01)
    low = min(low, float(finite.min()))
    high = max(high, float(finite.max()))
    if earlier is not None:
        # It widens the axis by at most half on each side
        first, last = earlier.range_of(output, tail=0.02)
        room = 0.5 * (high - low)
        first = max(first, low - room)
        last = min(last, high + room)
        low = min(low, first)
        high = max(high, last)
    margin = 0.04 * (high - low) or 0.01 * max(abs(low), 1.0)
    return low - margin, high + margin


def _draw_measured(panel: Panel, x: Output, y: Output) -> float:
    """Draw the specimens that have both outputs; return their correlation."""
    observed = x.node.observed
    weights = x.node.weights
    points = np.column_stack([x.of(observed), y.of(observed)])
    known = np.isfinite(points).all(axis=1)
    points = points[known]
    panel.points("measured", points[:, 0], points[:, 1], INK, size=14, legend="measured")
    return _of_ranks(points, weights[known])


def _draw_regions(
    panel: Panel,
    visual: str,
    population: _Population,
    pair: tuple[Output, Output],
    color: str,
    style: str,
    text: str,
) -> float:
    """Draw the outlines of regions of a population; return the correlation of its outputs."""
    points, weights = population.of_pair(*pair)
    if len(points) < 2:
        return np.nan
    for share, line in zip(_SHARES, outlines(points, weights, _SHARES), strict=True):
        name = f"{visual}_{100 * share:.0f}"
        x, y = line
        panel.line(name, x, y, color, style=style, width=1.5, legend=text)
    return _of_ranks(points, weights)


def _of_ranks(points: Floats, weights: Floats) -> float:
    """Return the correlation of the ranks of weighted points: a few far out do not decide it."""
    return correlation(np.column_stack([_ranks(column, weights) for column in points.T]), weights)


def _ranks(values: Floats, weights: Floats) -> Floats:
    """Return the weight below each value, and half of that of equal ones."""
    _, place = np.unique(values, return_inverse=True)
    mass = np.bincount(place, weights)
    return (np.cumsum(mass) - mass / 2)[place]


def _title(measured: float, calibrated: float) -> str:
    both = f"measured {_written(measured)}, calibrated {_written(calibrated)}"
    return f"rank correlation\n{both}"


def _written(r: float) -> str:
    """Return a correlation with two decimals, or three near one."""
    if np.isnan(r):
        return "unknown"
    digits = 2 if abs(r) < 0.95 else 3
    return f"{round(r, digits) + 0.0:.{digits}f}"


def correlation(points: Floats, weights: Floats) -> float:
    """Return the correlation of weighted points, (n, 2), NaN where one of both does not vary."""
    if not weights.size:
        return np.nan
    w = weights / weights.sum()
    deviations = points - w @ points
    (first, both), (_, second) = deviations.T @ (w[:, None] * deviations)
    product = np.sqrt(first * second)
    return float(both / product) if product > 0 else np.nan
