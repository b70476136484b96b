"""Measured responses beside those of the calibrated population."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from prbayes._stats import INTERVAL
from prbayes._validate import Floats, flag, share
from prbayes.model.emulated import PopulationSimulator
from prbayes.model.locking import locked
from prbayes.optimize.optimum import Optimum
from prbayes.plots.canvas import (
    BLUE,
    DASHED,
    GREY,
    INK,
    VERMILION,
    Canvas,
    Limits,
    Panel,
    Ticks,
    named,
    refuse_labels,
    refuse_look,
)
from prbayes.plots.curves import (
    GRID_POINTS,
    axis_range,
    central_levels,
    central_range,
    distribution_functions,
    histogram,
    smooth_densities,
    staircase,
)
from prbayes.plots.ensemble import Calibrated, Ensemble, if_supported, read_before, read_result
from prbayes.response.outputs import Outputs


@locked
def plot_responses(
    result: Optimum | xr.DataTree,
    *,
    model: pm.Model | None = None,
    before: Mapping[str, Any] | bool | None = None,
    ecdf: bool = False,
    prob: float = INTERVAL,
    n_draws: int | None = None,
    labels: Mapping[str, str] | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the responses before and after a calibration against the measured ones.

    Measured responses are a histogram with a mark for each, or steps. The calibrated curve is the
    posterior predictive distribution, or the optimum's population. The band contains the share
    ``prob`` of the populations at each response: those of the posterior's draws, or of the
    optimum's sampling distribution if it is known.

    Each of several outputs has a panel. A curve, whose labels are numbers, and more than eight
    outputs have one panel: a line for each specimen, 89% of the calibrated population at each
    place, and its median in the band; dashed lines are the population before. More than eight
    outputs with names are in standard deviations of each.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`; or with a ``posterior`` group, from any sampler.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    before : dict or bool, optional
        Hyperparameters before the calibration, in the user's own units; False for none. By default
        the optimiser's first point, if it was given a start or did not screen for one, otherwise
        the prior's initial point; the legend names it.
    ecdf : bool
        Draw distribution functions, which need no bandwidth, instead of densities; without effect
        on lines.
    prob : float
    n_draws : int, optional
        Number of populations in the band; by default 200 where they cost no response
        (`Reweighted`), otherwise 40, each of which costs n responses per simulator.
    labels : mapping, optional
        Labels of simulators or outputs by name, with units: ``{"crack": "relative length"}``.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, and keywords of ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``measured``, ``rug`` (densities only), ``before``, ``band`` and
        ``after``; with lines, ``population``. The panel of an output has the name of an element of
        the simulator, ``"frame[first]"``.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, or the result lacks a free variable of the model, or is
        of other populations or data.
    DesignError
        If stored responses do not support the populations.

    Notes
    -----
    Densities of responses are Gaussian kernel densities with Silverman's bandwidth, wider where
    weights are uneven. The area under a curve is the share of specimens that have not failed.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
    ...     )
    >>> prb.plot_responses(prb.minimize(model)).viz["after"].name
    'after'
    """
    refuse_look(labels, pc_kwargs)
    flag(ecdf, "ecdf")
    share(prob, "prob")
    ensemble = read_result(result, model, "prb.plot_responses", n_draws)
    evaluator = ensemble.evaluator
    start, text = read_before(result, evaluator, before)
    start = if_supported(evaluator, start, f"plot_responses: before ({text})")
    by_simulator = panels_of(evaluator.simulators)
    names = [output.name for panels in by_simulator for output in panels]
    refuse_labels(labels, names, evaluator=evaluator)
    has_lines = any(in_one_panel(node.outputs) for node in evaluator.simulators)
    size = (7.2, 4.8) if has_lines else (5.4, 4.2)
    canvas = Canvas(names, size=size, pc_kwargs=pc_kwargs)
    picture = _Picture(ensemble, text, prob, labels, ecdf=ecdf)
    limits: dict[str, Limits] = {}  # by axis: panels of groups have one
    contents = []
    for k, panels in enumerate(by_simulator):
        populations = evaluator.populations(ensemble.every, k)
        earlier = evaluator.populations(start, k) if len(start) else None
        for output in panels:
            sample = _Sample.of(output, populations)
            first = None if earlier is None else _Sample.of(output, earlier)
            contents.append((output, sample, first))
            if sample.values.ndim == 2:
                low, high = _axis_limits(output, sample, first)
                least, most = limits.get(output.axis, (low, high))
                limits[output.axis] = min(low, least), max(high, most)
    for output, sample, first in contents:
        panel = canvas.panels[output.name]
        if sample.values.ndim == 2:
            picture.distribution(panel, output, sample, first, limits[output.axis])
        else:
            picture.lines(panel, output, sample, first)
    return canvas.finish()


@dataclass(frozen=True, eq=False)
class _Sample:
    """Responses and weights of populations, shape (P, n) each; of outputs, values (P, n, m)."""

    values: Floats
    weights: Floats

    @classmethod
    def of(cls, output: Output, populations: tuple[Floats, Floats]) -> _Sample:
        values, weights = populations
        return cls(output.of(values), weights)

    def curves(self, grid: Floats, *, ecdf: bool) -> Floats:
        """Return distribution functions or densities on a grid, shape (P, g)."""
        function = distribution_functions if ecdf else smooth_densities
        return function(self.values, self.weights, grid)


def _axis_limits(output: Output, sample: _Sample, earlier: _Sample | None) -> Limits:
    """Return the range of the axis; more of the population before is beyond it."""
    widest = None if earlier is None else central_range(earlier.values, earlier.weights, tail=0.05)
    observed, _ = output.measured()
    return axis_range(observed, central_range(sample.values, sample.weights, tail=0.005), widest)


@dataclass(frozen=True, eq=False)
class _Picture:
    """Settings that all panels share."""

    ensemble: Ensemble
    start: str  # name of the population before
    prob: float
    labels: Mapping[str, str] | None
    ecdf: bool

    def distribution(
        self,
        panel: Panel,
        output: Output,
        sample: _Sample,
        earlier: _Sample | None,
        limits: Limits,
    ) -> None:
        """Draw the distribution of one output: data first, then the populations."""
        observed, weights = output.measured()
        grid = np.linspace(*limits, GRID_POINTS)
        curves = sample.curves(grid, ecdf=self.ecdf)
        calibrated = Calibrated.of(curves, self.ensemble, self.prob)
        if self.ecdf:
            x, y = staircase(observed, weights, *limits)
            panel.line("measured", x, y, INK, width=1.4, legend="measured")
        else:
            x, y = histogram(observed, weights)
            panel.line("measured", x, y, INK, width=0.9, legend="measured")
            finite = observed[np.isfinite(observed)]
            panel.points("rug", finite, 0.0, INK, marker="|", size=60)
        top = max(1.0 if self.ecdf else float(y.max()), calibrated.top)
        ylim = None
        if earlier is not None:
            (curve,) = earlier.curves(grid, ecdf=self.ecdf)
            text = f"before: {self.start}"
            panel.line("before", grid, curve, VERMILION, style=DASHED, legend=text)
            if curve.max() > 2 * top:  # a narrow peak before would dwarf all other curves
                ylim = (-0.05 * top, 2 * top)
        calibrated.draw(panel, grid, self.ensemble, self.prob)
        failed = np.count_nonzero(np.isinf(observed))
        panel.axes(
            x=output.text(self.labels),
            y="share of specimens" if self.ecdf else "density",
            title=f"{observed.size} measured values" + (f", {failed} failed" if failed else ""),
            xlim=limits,
            ylim=ylim,
        )

    def lines(self, panel: Panel, output: Output, sample: _Sample, earlier: _Sample | None) -> None:
        """Draw all outputs, a line for each specimen."""
        axis = Axis.of(output)
        start = None
        if earlier is not None:
            (start,) = quantiles(earlier.values, earlier.weights, LEVELS)
        lines = quantiles(sample.values, sample.weights, LEVELS)
        ylim = draw_lines(panel, axis, self.ensemble, lines, start, self.prob, self.start)
        observed = output.node.observed
        incomplete = np.count_nonzero(np.isnan(observed).any(axis=1))
        failed = np.count_nonzero(np.isinf(observed).any(axis=1))
        title = f"{len(observed)} measured specimens"
        title += f", {incomplete} incomplete" if incomplete else ""
        title += f", {failed} failed" if failed else ""
        x, y = axis.texts(self.labels)
        panel.axes(x=x, y=y, title=title, ylim=ylim, xticks=axis.ticks())


# -- outputs in panels of their own, or as lines in one panel --------------------------------


# Quantiles of a population that lines show: the ends of its central interval, and the median.
LEVELS = np.array([*central_levels(INTERVAL), 0.5])[[0, 2, 1]]


@dataclass(frozen=True, eq=False)
class Output:
    """One output of a simulator, or the only one, or all of a curve."""

    node: PopulationSimulator
    column: int | None  # of several outputs; None where there is one, or all are meant
    alone: bool  # whether the model has no other simulator

    @property
    def name(self) -> str:
        """The simulator's name, with the output's as the index of an element."""
        if self.column is None:
            return self.node.name
        # Names of panels are paths in a tree, with slashes between levels.
        output = self.node.outputs.names[self.column].replace("/", "\u2215")
        return f"{self.node.name}[{output}]"

    @property
    def axis(self) -> str:
        """The name without its group: panels of groups have one range."""
        return self.name.replace(f"[{self.node.group}]", "", 1) if self.node.group else self.name

    def text(self, labels: Mapping[str, str] | None) -> str:
        """Return a label that was given, or the name with the unit."""
        labels = labels or {}
        outputs = self.node.outputs
        if self.column is None:
            units = set(outputs.units)
            unit = f" ({units.pop()})" if len(units) == 1 else ""
            return labels.get(self.node.name, self.node.name + unit)
        output = outputs.names[self.column]
        for name in (self.name, output):
            if name in labels:
                return labels[name]
        unit = f" ({outputs.units[self.column]})" if outputs.units else ""
        simulator = named(self.node.name, labels)
        if is_curve(outputs):
            return f"{simulator} at {outputs.dim} {output}{unit}"
        if not isinstance(outputs.labels[self.column], str):
            output = f"{outputs.dim} {output}"
        if self.alone and self.node.name not in labels:
            return output + unit
        return f"{simulator}: {output}{unit}"

    def of(self, values: Floats) -> Floats:
        """Return its values among those of all outputs, (..., m) -> (...)."""
        return values if self.column is None else values[..., self.column]

    def measured(self) -> tuple[Floats, Floats]:
        """Return the measured values of one output, without NaN, and weights that sum to one."""
        values = self.of(self.node.observed)
        weights = self.node.weights
        is_measured = ~np.isnan(values)
        if is_measured.all():
            return values, weights
        return values[is_measured], weights[is_measured] / weights[is_measured].sum()


def panels_of(nodes: Sequence[PopulationSimulator]) -> list[list[Output]]:
    """Return the panels of each simulator: its outputs, or one for a curve or many outputs."""
    alone = len(nodes) == 1
    return [
        [Output(node, None, alone)]
        if not node.outputs.event or in_one_panel(node.outputs)
        else outputs_of(node, alone=alone)
        for node in nodes
    ]


def outputs_of(node: PopulationSimulator, *, alone: bool) -> list[Output]:
    """Return all of several outputs of a simulator."""
    return [Output(node, j, alone) for j in range(len(node.outputs.labels))]


def in_one_panel(outputs: Outputs) -> bool:
    """Return whether outputs are drawn as lines over their labels: a curve, or more than eight."""
    return len(outputs.labels) > 8 or is_curve(outputs)


def is_curve(outputs: Outputs) -> bool:
    """Return whether outputs are a curve: their labels are different numbers that a user gave."""
    labels = outputs.labels
    m = len(labels)
    are_numbers = all(isinstance(x, int | float) and not isinstance(x, bool) for x in labels)
    are_counted = labels == tuple(range(m)) and outputs.dim == Outputs.dim
    return m > 2 and are_numbers and len(set(labels)) == m and not are_counted


# -- lines -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Axis:
    """Places and units of outputs along an axis: with names, each output in its own spread."""

    output: Output
    places: Floats  # (m,)
    order: NDArray[np.intp]  # (m,): of the places
    center: Floats  # (m,)
    unit: Floats  # (m,)

    @classmethod
    def of(cls, output: Output) -> Axis:
        """Return the axis of all outputs of a simulator."""
        outputs = output.node.outputs
        m = len(outputs.labels)
        if is_curve(outputs):
            places = np.array(outputs.labels, dtype=np.float64)
            return cls(output, places, np.argsort(places), np.zeros(m), np.ones(m))
        observed = output.node.observed
        finite = np.where(np.isfinite(observed), observed, np.nan)
        spread = np.nanstd(finite, axis=0)
        unit = np.where(spread > 0, spread, 1.0)
        places = np.arange(m, dtype=np.float64)
        return cls(output, places, np.arange(m), np.nanmean(finite, axis=0), unit)

    def scaled(self, values: Floats) -> Floats:
        """Return values, (..., m), in the units of the picture, from left to right."""
        return np.asarray(((values - self.center) / self.unit)[..., self.order])

    def texts(self, labels: Mapping[str, str] | None) -> tuple[str, str]:
        """Return the labels of the two axes."""
        outputs = self.output.node.outputs
        unit = "" if is_curve(outputs) else ", standard deviations from the mean"
        return outputs.dim, self.output.text(labels) + unit

    def ticks(self) -> Ticks | None:
        """Return the names of outputs that are not numbers."""
        outputs = self.output.node.outputs
        return None if is_curve(outputs) else (self.places.tolist(), list(outputs.names))


def quantiles(values: Floats, weights: Floats, levels: Floats) -> Floats:
    """Return quantiles of outputs of populations, (P, n, m), (P, n), (L,) -> (P, L, m).

    A specimen without a response is left out; one that failed is above all others.
    """
    populations, _, m = values.shape
    out = np.empty((populations, len(levels), m))
    is_shared = values.strides[0] == 0  # the same values for all populations, sorted once
    for j in range(m):
        for i in range(populations):
            if not (is_shared and i):
                column = values[i, :, j]
                order = np.argsort(column, kind="stable")
                order = order[: np.count_nonzero(~np.isnan(column))]
                ascending = column[order]
            w = weights[i, order]
            middles = np.cumsum(w) - w / 2
            at = np.searchsorted(middles, levels * w.sum())
            out[i, :, j] = ascending[np.minimum(at, ascending.size - 1)]
    return out


def draw_lines(
    panel: Panel,
    axis: Axis,
    ensemble: Ensemble,
    lines: Floats,
    earlier: Floats | None,
    prob: float,
    start: str,
) -> Limits:
    """Draw measured lines, and the median and most of the population; return the axis' range.

    ``lines``, (P, 3, m), are quantiles at `LEVELS` of the populations of ``ensemble.every``,
    ``earlier``, (3, m), those of the population called ``start``; the band of the median contains
    the share ``prob`` of the populations.
    """
    x = axis.places[axis.order]
    measured = axis.scaled(axis.output.node.observed)
    lines = axis.scaled(lines)
    earlier = None if earlier is None else axis.scaled(earlier)
    typical = _finite_range(np.median(lines, axis=0))
    limits = axis_range(measured, typical, None if earlier is None else _finite_range(earlier))
    # Lines leave the picture where the specimens have failed.
    low, high = limits
    room = high - low
    lines = np.clip(lines, low - room, high + room)
    lower, median, upper = (Calibrated.of(lines[:, i], ensemble, prob) for i in range(3))
    text = f"{INTERVAL:.0%} of the calibrated population"
    panel.band("population", x, (lower.middle, upper.middle), BLUE, alpha=0.25, legend=text)
    panel.line("measured", *_joined(x, measured), GREY, width=0.5, legend="measured")
    if earlier is not None:
        line = _joined(x, np.clip(earlier, low - room, high + room))
        panel.line("before", *line, VERMILION, style=DASHED, legend=f"before: {start}")
    if median.band is not None:
        text = f"{prob:.0%} band of the {ensemble.spread}"
        panel.band("band", x, median.band, BLUE, alpha=0.55, legend=text)
    text = f"median, calibrated: {ensemble.label}"
    panel.line("after", x, median.middle, BLUE, width=2.2, legend=text)
    return limits


def _finite_range(values: Floats) -> Limits:
    finite = values[np.isfinite(values)]
    return float(finite.min(initial=np.inf)), float(finite.max(initial=-np.inf))


def _joined(x: Floats, rows: Floats) -> tuple[Floats, Floats]:
    """Return several lines, (n, m), as one with gaps between them; only finite values are drawn.

    A line continues after a value that was not measured, and ends where the specimen has failed.
    """
    finite = [np.isfinite(row) for row in rows]
    at = [np.append(x[ok], np.nan) for ok in finite]
    y = [np.append(row[ok], np.nan) for row, ok in zip(rows, finite, strict=True)]
    return np.concatenate(at)[:-1], np.concatenate(y)[:-1]
