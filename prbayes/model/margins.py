"""Margins: the numbers of a model that vary from specimen to specimen, by name."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from pytensor.tensor.variable import TensorVariable

from prbayes._validate import wrong_value
from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import element_name, variable_of
from prbayes.response.condition import is_condition
from prbayes.response.inputs import aleatory_names, unit_of


@dataclass(frozen=True, eq=False)
class Margin:
    """One number that varies from specimen to specimen."""

    # Name of the distribution or of the response's argument, with the index of the element.
    name: str
    dist: TensorVariable  # distribution of the input, made by ``.dist()``
    node: int  # index of the simulator
    position: int  # index among the simulator's aleatory inputs
    index: tuple[int, ...]  # index of the element in a multivariate input
    group: str = ""  # name of the group whose population it is, empty without groups

    @property
    def axis(self) -> Hashable:
        """A key of margins with the same range of the axis: those of groups."""
        return (self.dist, self.index) if self.group else self.name

    @property
    def discrete(self) -> bool:
        """Whether it takes whole numbers only."""
        return not self.dist.dtype.startswith("float")

    @property
    def unit(self) -> str:
        """The unit that the simulator was given, or an empty text."""
        return unit_of(self.dist, self.index)


def margins(evaluator: Evaluator) -> list[Margin]:
    """Return the margins of all aleatory inputs; an input of several simulators counts once."""
    out: list[Margin] = []
    taken = {str(variable.name) for variable in evaluator.model.basic_RVs}
    for k, node in enumerate(evaluator.simulators):
        inputs = node.inputs
        names = aleatory_names(inputs, node.responses.function)
        group = [node.group] if node.group else []
        # The noise of a random response is no input that varies between specimens.
        noise = inputs.aleatory[-1] if node.responses.repeats > 1 else None
        for position, (name, dist) in enumerate(zip(names, inputs.aleatory, strict=True)):
            is_listed = any(m.dist is dist and m.group == node.group for m in out)
            is_population = not is_condition(dist) and dist is not noise
            if is_listed or not is_population:
                continue
            if element_name(name, group) in taken:
                name = f"{name} of {node.name}"
            taken.add(element_name(name, group))
            for index in np.ndindex(inputs.event_shapes[position]):
                element = element_name(name, [*group, *index])
                out.append(Margin(element, dist, k, position, index, node.group))
    return out


def select_margins(available: list[Margin], inputs: Iterable[Any] | None) -> list[Margin]:
    """Return margins by name, with or without index, or by ``.dist()``; all by default."""
    if inputs is None:
        return available
    if isinstance(inputs, str | TensorVariable):
        inputs = [inputs]
    names = [margin.name for margin in available]
    if not isinstance(inputs, list | tuple) or not inputs:
        raise wrong_value(
            inputs, "inputs", f"a list of names or .dist() objects, such as {names[:2]}"
        )
    selected = []
    for x in inputs:
        if isinstance(x, str):
            matches = [m for m in available if x in (m.name, variable_of(m.name))]
        else:
            matches = [m for m in available if m.dist is x]
        if not matches:
            raise KeyError(f"inputs: got {x}, expected some of {names}, or their .dist() objects")
        selected += [margin for margin in matches if margin not in selected]
    return selected
