"""Several outputs of a simulator in pictures: a panel for each, or one panel for a curve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from prbayes._validate import Floats
from prbayes.model.emulated import PopulationSimulator
from prbayes.plots._names import named
from prbayes.response.outputs import Outputs

# Outputs of a simulator with a panel each: three rows of panels, by judgement.
_MOST_PANELS = 8


@dataclass(frozen=True, eq=False)
class Output:
    """One output of a simulator, or the only one, or all of a curve."""

    node: PopulationSimulator
    column: int | None  # of several outputs; None where there is one, or all are meant
    alone: bool  # whether the model has no other simulator

    @property
    def name(self) -> str:
        """That of the simulator, with the output's like the index of an element."""
        if self.column is None:
            return self.node.name
        # Names of panels are places in a tree, whose levels a slash parts
        own = self.node.outputs.names[self.column].replace("/", "\u2215")
        return f"{self.node.name}[{own}]"

    @property
    def axis(self) -> str:
        """What the panels have in common that are drawn over the same values: those of groups."""
        return self.name.replace(f"[{self.node.group}]", "", 1) if self.node.group else self.name

    def text(self, labels: Mapping[str, str] | None) -> str:
        """Return what a reader calls it: a label that was given, or its own name with the unit."""
        given = labels or {}
        outputs = self.node.outputs
        if self.column is None:
            units = set(outputs.units)
            unit = f" ({units.pop()})" if len(units) == 1 else ""
            return given.get(self.node.name, self.node.name + unit)
        own = outputs.names[self.column]
        for name in (self.name, own):
            if name in given:
                return given[name]
        unit = f" ({outputs.units[self.column]})" if outputs.units else ""
        whose = named(self.node.name, labels)
        if is_curve(outputs):
            return f"{whose} at {outputs.dim} {own}{unit}"
        if not isinstance(outputs.labels[self.column], str):
            own = f"{outputs.dim} {own}"
        if self.alone and self.node.name not in given:
            return own + unit
        return f"{whose}: {own}{unit}"

    def of(self, values: Floats) -> Floats:
        """Return its values among those of all outputs, (..., m) -> (...)."""
        return values if self.column is None else values[..., self.column]

    def measured(self) -> tuple[Floats, Floats]:
        """Return what was measured of one output, without NaN, and weights that sum to one."""
        values = self.of(self.node.observed)
        weights = self.node.weights
        known = ~np.isnan(values)
        if known.all():
            return values, weights
        return values[known], weights[known] / weights[known].sum()


def panels_of(nodes: Sequence[PopulationSimulator]) -> list[list[Output]]:
    """Return by simulator what has a panel: each output; a curve, or many outputs, as one."""
    alone = len(nodes) == 1
    found = []
    for node in nodes:
        if not node.outputs.event or in_one_panel(node.outputs):
            found.append([Output(node, None, alone)])
        else:
            found.append(outputs_of(node, alone=alone))
    return found


def outputs_of(node: PopulationSimulator, *, alone: bool) -> list[Output]:
    """Return all of several outputs of a simulator."""
    return [Output(node, j, alone) for j in range(len(node.outputs.labels))]


def in_one_panel(outputs: Outputs) -> bool:
    """Whether outputs are drawn as lines over their labels, a line for each specimen."""
    return len(outputs.labels) > _MOST_PANELS or is_curve(outputs)


def is_curve(outputs: Outputs) -> bool:
    """Whether outputs are a curve: their labels are different numbers that somebody gave."""
    labels = outputs.labels
    m = len(labels)
    numbers = all(isinstance(x, int | float) and not isinstance(x, bool) for x in labels)
    counted = labels == tuple(range(m)) and outputs.dim == Outputs.dim
    different = len(set(labels)) == m
    return m > 2 and numbers and different and not counted
