"""Measured responses beside those of the calibrated population."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._stats import INTERVAL, distribution_function, positive_scale
from prbayes._validate import ArrayPair, Floats, Labels, finite_or_nan, flag, share
from prbayes.model.emulated import PopulationSimulator
from prbayes.model.locking import locked
from prbayes.model.parameters import variable_of
from prbayes.optimize.optimum import Optimum
from prbayes.plots.canvas import (
    GREY,
    VERMILION,
    Limits,
    check_options,
    counted_title,
    fill,
    finish,
    ink,
    named,
    panels,
    refuse_labels,
)
from prbayes.plots.curves import (
    GRID_POINTS,
    axis_range,
    central_levels,
    central_range,
    measured_density,
    smooth_densities,
    staircase,
    with_gaps,
)
from prbayes.plots.ensemble import (
    Ensemble,
    draw_calibrated,
    middle_of,
    read_before,
    read_result,
)
from prbayes.plots.selection import Coords, Elements, FilterVars, VarNames, select
from prbayes.response.outputs import Outputs, with_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@locked
def plot_responses(
    result: Optimum | xr.DataTree,
    *,
    model: pm.Model | None = None,
    var_names: VarNames | None = None,
    filter_vars: FilterVars | None = None,
    coords: Coords | None = None,
    before: Mapping[str, Any] | bool | None = None,
    ecdf: bool = False,
    prob: float = INTERVAL,
    n_draws: int | None = None,
    labels: Labels | None = None,
    **pc_kwargs: Any,
) -> Figure:
    """Draw the responses before and after a calibration against the measured ones.

    Measured responses are a mark for each and a smooth density, or steps. The calibrated curve is
    the posterior predictive distribution, or the optimum's population. The band contains the share
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
    var_names : str or sequence of str, optional
        Simulators, or outputs as elements of them, in this order; all by default.
    filter_vars : {None, "like", "regex"}
        How ``var_names`` are read, as by ArviZ.
    coords : mapping, optional
        Labels by dimension: of outputs, such as ``{"output": ["load"]}``, or of groups. Places of a
        curve that are chosen here have a panel of their own.
    before : dict or bool, optional
        Hyperparameters before the calibration, in the user's own units; False for none. By default
        the optimiser's first point, if it was given a start or did not screen for one, otherwise
        the prior's initial point; the legend names it.
    ecdf : bool
        Draw distribution functions, which need no bandwidth, instead of densities; without effect
        on lines.
    prob : float
        Share of the populations in the band.
    n_draws : int, optional
        Number of populations in the band; by default 200 where they cost no response
        (`Reweighted`), otherwise 40, each of which costs n responses per simulator.
    labels : mapping, optional
        Labels of simulators or outputs by name, with units: ``{"crack": "relative length"}``.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, ``col_wrap`` panels in a row, and ``figure_kwargs`` for
        ``matplotlib.pyplot.figure``.

    Returns
    -------
    matplotlib.figure.Figure
        With a panel for each simulator or output, whose label is the name of an element of the
        simulator, ``"frame[first]"``.

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
    >>> prb.plots.plot_responses(prb.minimize(model)).axes[0].get_label()
    'y'
    """
    check_options(labels, pc_kwargs)
    flag(ecdf, "ecdf")
    share(prob, "prob")
    ensemble = read_result(result, model, "prb.plots.plot_responses", n_draws)
    evaluator = ensemble.evaluator
    start, text = read_before(result, evaluator, before, "plot_responses")
    shown = panels_of(evaluator.simulators, var_names, filter_vars, coords)
    names = [output.name for output in shown]
    refuse_labels(labels, names, evaluator=evaluator)
    has_lines = any(output.is_in_lines for output in shown)
    size = (7.2, 4.8) if has_lines else (5.4, 4.2)
    figure, axes = panels(names, size=size, pc_kwargs=pc_kwargs)
    limits: dict[str, Limits] = {}  # ranges of axes by name; panels of groups share an axis
    contents = []
    for k, node in enumerate(evaluator.simulators):
        columns = [output for output in shown if output.node is node]
        if not columns:
            continue
        values, weights = evaluator.populations(ensemble.every, k)
        earlier = evaluator.populations(start, k) if len(start) else None
        for output in columns:
            sample = output.of(values), weights
            first = None if earlier is None else (output.of(earlier[0]), earlier[1])
            contents.append((output, sample, first))
            if sample[0].ndim == 2:
                # The population before the calibration may be far away. More of it is left out.
                widest = None if first is None else central_range(*first, tail=0.05)
                observed, _ = output.measured()
                low, high = axis_range(observed, central_range(*sample, tail=0.005), widest)
                least, most = limits.get(output.axis, (low, high))
                limits[output.axis] = min(low, least), max(high, most)
    for output, sample, first in contents:
        draw = _Drawing(axes[output.name], ensemble, text, prob, output.text(labels), labels)
        if sample[0].ndim == 2:
            draw.distribution(output, sample, first, limits[output.axis], ecdf=ecdf)
        else:
            draw.lines(output, sample, first)
    return finish(figure)


@dataclass(frozen=True, eq=False)
class _Drawing:
    """Measured responses and populations in a panel.

    Populations are responses and weights, shape (P, n) each; of outputs, responses (P, n, m).
    """

    axis: Axes
    ensemble: Ensemble
    start: str  # name of the population before the calibration
    prob: float
    text: str  # label of the responses
    labels: Labels | None

    def distribution(
        self,
        output: Output,
        population: ArrayPair,
        earlier: ArrayPair | None,
        limits: Limits,
        *,
        ecdf: bool,
    ) -> None:
        """Draw the distribution of one output: data first, then the populations."""
        axis = self.axis
        observed, weights = output.measured()
        # The statistics of a data sheet are no sample, and have no distribution.
        is_sheet = output.node.metric.exact_likelihood
        grid = np.linspace(*limits, GRID_POINTS)
        curves_of = distribution_function if ecdf else smooth_densities
        marks: dict[str, Any] = {"marker": "|", "color": ink(), "gid": "rug", "zorder": 3}
        top = 1.0 if ecdf else 0.0
        if is_sheet:
            top = 0.0
            axis.scatter(observed, 0 * observed, 60, label="data sheet", **marks)
        elif ecdf:
            stairs = staircase(observed, weights, *limits)
            axis.plot(*stairs, color=ink(), linewidth=1.4, label="measured", gid="measured")
        else:
            density = measured_density(observed, weights, grid)
            top = float(density.max())
            text = "measured, smoothed"
            fill(axis, grid, density, color=GREY, alpha=0.3, label=text, gid="measured")
            finite = observed[np.isfinite(observed)]
            axis.scatter(finite, 0 * finite, 60, label="measured", **marks)
        initial = np.zeros(1)
        if earlier is not None:
            (initial,) = curves_of(*earlier, grid)
            text = f"before: {self.start}"
            axis.plot(grid, initial, "--", color=VERMILION, label=text, gid="before")
        curves = curves_of(*population, grid)
        top = max(top, draw_calibrated(axis, grid, curves, self.ensemble, self.prob))
        if initial.max() > 2 * top:
            # A narrow peak before the calibration would flatten all other curves.
            axis.set_ylim(-0.05 * top, 2 * top)
        noun = "statistics" if is_sheet else "measured values"
        title = counted_title(observed.size, noun, failed=np.isinf(observed).sum())
        y = "share of specimens" if ecdf else "density"
        axis.set(xlabel=self.text, ylabel=y, title=title, xlim=limits)

    def lines(
        self,
        output: Output,
        population: ArrayPair,
        earlier: ArrayPair | None,
    ) -> None:
        """Draw a line over all outputs for each specimen; median and most of the population."""
        axis = self.axis
        outputs = output.node.outputs
        observed = output.node.observed
        y = self.text
        if is_curve(outputs):
            places = np.array(outputs.labels, dtype=np.float64)
            center, unit = np.zeros(places.size), np.ones(places.size)
        else:  # Outputs with names have different units: each is divided by its spread.
            places = np.arange(len(outputs.labels), dtype=np.float64)
            finite = finite_or_nan(observed)
            spread = np.nanstd(finite, axis=0)
            center, unit = np.nanmean(finite, axis=0), positive_scale(spread)
            _name_ticks(axis, places, outputs.names)
            y += ", standard deviations from the mean"
        order = np.argsort(places)
        x = places[order]
        measured = ((observed - center) / unit)[:, order]
        lines = ((quantiles(*population, LEVELS) - center) / unit)[..., order]
        initial = np.empty((0, x.size))
        if earlier is not None:
            initial = ((quantiles(*earlier, LEVELS)[0] - center) / unit)[:, order]

        widest = None if earlier is None else _finite_range(initial)
        low, high = axis_range(measured, _finite_range(np.median(lines, axis=0)), widest)
        # Failures are +inf. Clipped lines leave the picture there.
        room = high - low
        lines = np.clip(lines, low - room, high + room)
        lower, upper = (middle_of(lines[:, i], self.ensemble) for i in (0, 2))
        text = f"{INTERVAL:.0%} of the calibrated population"
        fill(axis, x, lower, upper, label=text, gid="population")
        line = _joined(x, measured)
        axis.plot(*line, color=GREY, linewidth=0.5, label="measured", gid="measured")
        if earlier is not None:
            text = f"before: {self.start}"
            line = _joined(x, np.clip(initial, low - room, high + room))
            axis.plot(*line, "--", color=VERMILION, label=text, gid="before")
        median: Any = {"name": "median, calibrated", "alpha": 0.55}
        draw_calibrated(axis, x, lines[:, 1], self.ensemble, self.prob, **median)

        title = counted_title(
            len(observed),
            "measured specimens",
            incomplete=np.isnan(observed).any(axis=1).sum(),
            failed=np.isinf(observed).any(axis=1).sum(),
        )
        axis.set(xlabel=named(outputs.dim, self.labels), ylabel=y, title=title, ylim=(low, high))


def _name_ticks(axis: Axes, places: Floats, names: Sequence[str]) -> None:
    """Give the ticks of the x axis names, which are turned if they are long."""
    axis.set_xticks(places, list(names))
    # An inch takes twelve characters of the default font.
    inches = axis.bbox.width / axis.figure.dpi
    if max(map(len, names)) + 1 > 12 * inches / places.size:
        axis.tick_params(axis="x", labelrotation=90)


def _finite_range(values: Floats) -> Limits:
    finite = values[np.isfinite(values)]
    return float(finite.min(initial=np.inf)), float(finite.max(initial=-np.inf))


def _joined(x: Floats, rows: Floats) -> Floats:
    """Join rows, (n, m), into one line with gaps between rows, but not at missing values."""
    points = [np.column_stack([x, row]) for row in rows]
    return with_gaps([line[np.isfinite(line[:, 1])] for line in points])


# -- outputs in panels of their own, or as lines in one panel --------------------------------


# levels of the quantiles that lines show: ends of the central interval, and the median between
LEVELS = np.array([*central_levels(INTERVAL), 0.5])[[0, 2, 1]]


@dataclass(frozen=True, eq=False)
class Output:
    """What a panel shows of a simulator: one of several outputs, its only output, or a curve."""

    node: PopulationSimulator
    column: int | None  # column among several outputs; None for a single output, or for all
    alone: bool  # whether the model has no other simulator

    @property
    def name(self) -> str:
        """The simulator's name, with the output's as the index of an element."""
        if self.column is None:
            return self.node.name
        return f"{self.node.name}[{self.node.outputs.names[self.column]}]"

    @property
    def is_in_lines(self) -> bool:
        """Whether the panel shows all outputs, as lines over their labels."""
        return self.column is None and bool(self.node.outputs.event)

    @property
    def coordinates(self) -> dict[str, Any]:
        """The labels of output and group by dimension."""
        outputs, groups = self.node.outputs, self.node.inputs.groups
        labels = {} if self.column is None else {outputs.dim: outputs.labels[self.column]}
        if groups is not None and self.node.group:
            labels[groups.dim] = groups.labels[groups.names.index(self.node.group)]
        return labels

    @property
    def axis(self) -> str:
        """The name without the group, because panels of groups share the range of their axis."""
        return self.name.replace(f"[{self.node.group}]", "", 1) if self.node.group else self.name

    def text(self, labels: Labels | None) -> str:
        """Return a label that was given, or the name with the unit."""
        labels = labels or {}
        outputs = self.node.outputs
        if self.column is None:
            units = set(outputs.units)
            unit = units.pop() if len(units) == 1 else ""
            return labels.get(self.node.name, with_unit(self.node.name, unit))
        output = outputs.names[self.column]
        for name in (self.name, output):
            if name in labels:
                return labels[name]
        unit = outputs.units[self.column] if outputs.units else ""
        simulator = named(self.node.name, labels)
        if is_curve(outputs):
            return with_unit(f"{simulator} at {outputs.dim} {output}", unit)
        if not isinstance(outputs.labels[self.column], str):
            output = f"{outputs.dim} {output}"
        if self.alone and self.node.name not in labels:
            return with_unit(output, unit)
        return with_unit(f"{simulator}: {output}", unit)

    def of(self, values: Floats) -> Floats:
        """Return the values of this output among those of all, (..., m) -> (...)."""
        return values if self.column is None else values[..., self.column]

    def measured(self) -> ArrayPair:
        """Return the measured values of one output, without NaN, and weights that sum to one."""
        values = self.of(self.node.observed)
        weights = self.node.weights
        is_measured = ~np.isnan(values)
        if is_measured.all():
            return values, weights
        return values[is_measured], weights[is_measured] / weights[is_measured].sum()


def output_elements(outputs: Iterable[Output]) -> Elements:
    """Return outputs as elements of simulators, by name."""
    return {x.name: (variable_of(x.name), x.coordinates) for x in outputs}


def panels_of(
    nodes: Sequence[PopulationSimulator],
    var_names: VarNames | None = None,
    filter_vars: FilterVars | None = None,
    coords: Coords | None = None,
) -> list[Output]:
    """Return the panels of simulators: their outputs, or one for a curve or many outputs."""
    alone = len(nodes) == 1
    by_node = {node.name: displayed_outputs(node, alone=alone) for node in nodes}
    available = {x.name: x for outputs in by_node.values() for x in outputs}
    shown = {}
    names = select(output_elements(available.values()), var_names, filter_vars, coords)
    for name in names:
        output = available[name]
        outputs = by_node[output.node.name]
        if in_one_panel(output.node.outputs) and {x.name for x in outputs} <= set(names):
            output = Output(output.node, None, alone)
        shown[output.name] = output
    if coords is not None and sum(x.column is not None for x in shown.values()) > 24:
        raise ValueError(f"coords: got {len(shown)} outputs, expected all, or at most 24 in panels")
    return list(shown.values())


def displayed_outputs(node: PopulationSimulator, *, alone: bool) -> list[Output]:
    """Return all outputs of a simulator, or its only one."""
    columns = range(len(node.outputs.labels)) if node.outputs.event else [None]
    return [Output(node, column, alone) for column in columns]


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


def quantiles(values: Floats, weights: Floats, levels: Floats) -> Floats:
    """Return quantiles of outputs, (P, n, m), (P, n), (L,) -> (P, L, m), without NaN."""
    populations, _, m = values.shape
    out = np.empty((populations, len(levels), m))
    is_shared = values.strides[0] == 0  # All populations have the same values, sorted once.
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
