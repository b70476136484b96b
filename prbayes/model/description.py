"""What a model is, in words that go into a file: variables with their distributions, simulators with their inputs."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pymc as pm
from pymc.printing import str_for_dist
from pytensor.graph.basic import Variable
from pytensor.graph.traversal import walk

from prbayes.model.node import Node, nodes

_LONGEST = 60_000  # characters that an attribute of an HDF5 file can hold
_LABELS = 40


def describe(model: pm.Model) -> dict[str, Any]:
    """Return the model in words and numbers that JSON takes.

    Returns
    -------
    dict
        ``variables``: name, role and distribution of each; ``simulators``: name, response, inputs, metric, propagation,
        the number of its points, and specimens.
    """
    known = {*model.basic_RVs, *model.deterministics}
    variables = [
        {"name": str(rv.name), "role": "hyperparameter", "distribution": _distribution(rv, known)}
        for rv in model.free_RVs
    ]
    variables += [
        {"name": str(v.name), "role": "deterministic", "distribution": f"computed from {_above(v, known)}"}
        for v in model.deterministics
    ]
    simulators = nodes(model)
    variables += [
        {"name": str(rv.name), "role": "observed", "distribution": _distribution(rv, known)}
        for rv in model.observed_RVs
        if rv not in simulators
    ]
    return {"variables": variables, "simulators": [_simulator(node, known) for node in simulators.values()]}


def without_addresses(configuration: object) -> str:
    """Return the representation of a metric or propagation, the same in every session; functions by their names."""
    text = re.sub(r" at 0x[0-9a-fA-F]+", "", repr(configuration))
    return re.sub(r"<function ((?:[\w.]|<locals>|<lambda>)+)>", r"\1", text)


def as_attribute(model: pm.Model) -> dict[str, str]:
    """Return the description as an attribute of a file; none where it is too long for one."""
    text = json.dumps(describe(model))
    return {"model": text} if len(text) <= _LONGEST else {}


def from_attributes(attrs: Any) -> dict[str, Any] | None:
    """Return the description that a file has, or None."""
    try:
        found = json.loads(attrs["model"])
        variables = [{k: str(v[k]) for k in ("name", "role", "distribution")} for v in found["variables"]]
        keys = ("name", "response", "inputs", "metric", "propagation", "n_points", "specimens")
        return {"variables": variables, "simulators": [{k: str(s[k]) for k in keys} for s in found["simulators"]]}
    except (KeyError, TypeError, ValueError):
        return None


def _simulator(node: Node, known: set[Any]) -> dict[str, str]:
    inputs = node.bound.inputs
    return {
        "name": node.name,
        "response": _called(node.bound.responses.function),
        "inputs": ", ".join(_input(a, inputs.aleatory, known) for a in inputs.arguments),
        "metric": without_addresses(node.metric),
        "propagation": without_addresses(node.propagation),
        "n_points": str(node.bound.n_points),
        "specimens": _labels(node),
    }


def _called(function: Any) -> str:
    inner = getattr(function, "function", function)
    return str(getattr(inner, "__name__", type(inner).__name__))


def _input(argument: Any, aleatory: tuple[Any, ...], known: set[Any]) -> str:
    if isinstance(argument, int):
        return _distribution(aleatory[argument], known)
    if isinstance(argument, Variable):
        return str(argument.name or f"an expression of {_above(argument, known)}")
    value = np.asarray(argument)
    return f"{value.item():.6g}" if value.size == 1 else f"an array of shape {value.shape}"


def _distribution(rv: Any, known: set[Any]) -> str:
    text: str = str_for_dist(rv, named_vars=known)
    return text.removeprefix(f"{rv.name} ~ ")


def _above(variable: Any, known: set[Any]) -> str:
    """Return the names of the model's variables next above one."""
    inputs = [] if variable.owner is None else variable.owner.inputs
    above = walk(inputs, lambda v: None if v in known or v.owner is None else v.owner.inputs)
    return ", ".join(str(v.name) for v in above if v in known) or "constants"


def _labels(node: Node) -> str:
    if node.specimens is None:
        return ""
    labels = list(dict.fromkeys(map(str, node.specimens.tolist())))
    rest = f", and {len(labels) - _LABELS} more" if len(labels) > _LABELS else ""
    return f"{len(labels)} specimens: {', '.join(labels[:_LABELS])}{rest}"
