"""Several outputs of a simulator: a panel for each, or one panel with a line for each specimen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prbayes._stats import INTERVAL
from prbayes._validate import Floats
from prbayes.model.emulated import PopulationSimulator
from prbayes.plots._canvas import BLUE, DASHED, GREY, VERMILION, Limits, Panel, Ticks
from prbayes.plots._curves import axis_range, central_levels
from prbayes.plots._ensemble import Calibrated, Ensemble
from prbayes.plots._labels import named
from prbayes.response.outputs import Outputs

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
