"""Random variables, and those of `pymc.dims` as plain tensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytensor.tensor as pt
from pymc.distributions.distribution import SymbolicRandomVariable
from pytensor.compile.ops import ViewOp
from pytensor.graph.basic import Constant, Variable
from pytensor.graph.replace import clone_replace, graph_replace
from pytensor.graph.rewriting.utils import rewrite_graph
from pytensor.graph.traversal import ancestors
from pytensor.tensor.random.op import RandomVariable
from pytensor.xtensor.basic import xtensor_from_tensor
from pytensor.xtensor.vectorization import XRV


def has_dims(variable: Variable) -> bool:
    """Return whether a variable has named dimensions, as those of `pymc.dims` have."""
    return hasattr(variable.type, "dims")


def without_dims(graphs: Any) -> list[Any]:
    """Return graphs as plain tensors of the same inputs; graphs without dimensions unchanged.

    All graphs are converted in one call, so that parts that they share stay shared.
    """
    if not any(map(has_dims, ancestors(graphs))):
        return list(graphs)
    # A rewrite changes a graph in place, and the graph of the model must stay as it is.
    copies = clone_replace([g.values if has_dims(g) else g for g in graphs])
    # A `pymc.dims.Deterministic` is a view operation, for which there is no rewrite.
    while views := [v for v in ancestors(copies) if v.owner and isinstance(v.owner.op, ViewOp)]:
        copies = graph_replace(copies, {v: v.owner.inputs[0] for v in views})
    lowered: list[Any] = list(rewrite_graph(copies, include=("lower_xtensor",)))
    nodes = {v: v.owner.inputs[0] for v in ancestors(lowered) if v.owner and v.owner.inputs}
    constants = {
        v: pt.constant(x.data) for v, x in nodes.items() if has_dims(x) and isinstance(x, Constant)
    }
    lowered = list(graph_replace(lowered, constants, strict=False))
    for graph, variable in zip(lowered, graphs, strict=True):
        if graph.owner is not None:
            graph.name = variable.name
    return lowered


def values_of(variable: Any) -> Any:
    """Return a variable as a plain tensor, the same one at each call."""
    if not has_dims(variable):
        return variable
    values = getattr(variable.tag, "tensor", None)
    if (
        values is None or values.owner.inputs[0] is not variable
    ):  # a clone has the tensor of its original
        values = variable.tag.tensor = variable.values
        values.name = variable.name
    return values


def with_dims(graph: Any, variable: Variable) -> Any:
    """Return a plain tensor with the dimensions of a variable, if it has any."""
    return xtensor_from_tensor(graph, dims=variable.type.dims) if has_dims(variable) else graph


def input_without_dims(x: Any, tensors: Mapping[Variable, Variable]) -> Any:
    """Return an input of a response as a plain tensor, the same one at each call.

    ``tensors`` maps the model's variables to their plain tensors, on which the result depends.
    Random variables that several inputs share stay shared.
    """
    if x in tensors:
        return tensors[x]
    ancestry = list(ancestors([x], blockers=tensors))
    if not any(map(has_dims, ancestry)):
        return x
    if not hasattr(x.tag, "plain_input"):
        shared = [v for v in ancestry if v is not x and is_random(v)]
        tensors = {**tensors, **{v: input_without_dims(v, tensors) for v in shared}}
        symbols = {v: t.type() for v, t in tensors.items()}
        named = {v: with_dims(s, v) for v, s in symbols.items()}
        graphs = without_dims(graph_replace([x], named, strict=False))
        values = {s: tensors[v] for v, s in symbols.items()}
        (x.tag.plain_input,) = graph_replace(graphs, values, strict=False)
        x.tag.plain_input.name = x.name
    return x.tag.plain_input


def is_random(variable: Variable) -> bool:
    """Return whether a variable of a graph is drawn by a distribution, not computed."""
    if variable.owner is None:
        return False
    op = variable.owner.op
    if isinstance(op, XRV):
        return has_dims(variable)
    return (
        isinstance(op, RandomVariable | SymbolicRandomVariable)
        and variable is variable.owner.outputs[op.default_output or 0]
    )


def foreign_variable(x: Any, model_variables: set[Variable]) -> Variable | None:
    """Return a variable of another model, with dimensions, that an input depends on; else None."""
    for v in ancestors([x], blockers=model_variables):
        is_named = v is not x and v not in model_variables and v.name and has_dims(v)
        if is_named and any(map(is_random, ancestors([v], blockers=model_variables))):
            return v
    return None
