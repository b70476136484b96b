"""Variables of `pymc.dims` as plain tensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytensor.tensor as pt
from pytensor.compile.ops import ViewOp
from pytensor.graph.basic import Constant, Variable
from pytensor.graph.replace import clone_replace, graph_replace
from pytensor.graph.rewriting.utils import rewrite_graph
from pytensor.graph.traversal import ancestors


def has_dims(variable: Variable) -> bool:
    """Return whether a variable has named dimensions, as those of `pymc.dims` have."""
    return hasattr(variable.type, "dims")


def without_dims(graphs: Any) -> list[Any]:
    """Return graphs as plain tensors of the same inputs; those without dimensions as they are.

    All are lowered at once, so that common parts stay common.
    """
    graphs = list(graphs)
    if not any(map(has_dims, ancestors(graphs))):
        return graphs
    # A rewrite changes a graph in place: that of the model must stay as it is.
    copies = clone_replace([tensor(g) for g in graphs])
    # A `pymc.dims.Deterministic` is a view, which no rewrite lowers.
    views = {v: v.owner.inputs[0] for v in ancestors(copies) if has_dims(v) and _is_view(v)}
    copies = graph_replace(copies, views)
    lowered: list[Any] = list(rewrite_graph(copies, include=("lower_xtensor",)))
    nodes = {v: v.owner.inputs[0] for v in ancestors(lowered) if v.owner and v.owner.inputs}
    constants = {
        v: pt.constant(x.data)
        for v, x in nodes.items()
        if has_dims(x) and isinstance(x, Constant)
    }
    lowered = graph_replace(lowered, constants, strict=False)
    for graph, variable in zip(lowered, graphs, strict=True):
        if graph.owner is not None:
            graph.name = variable.name
    return lowered


def _is_view(variable: Variable) -> bool:
    return variable.owner is not None and isinstance(variable.owner.op, ViewOp)


def tensor(variable: Any) -> Any:
    """Return a variable as a plain tensor, the same one at each call."""
    if not has_dims(variable):
        return variable
    values = getattr(variable.tag, "tensor", None)
    if values is None or values.owner.inputs[0] is not variable:  # a clone has the original's
        values = variable.tag.tensor = variable.values
        values.name = variable.name
    return values


def with_dims(graph: Any, variable: Variable) -> Any:
    """Return a plain tensor with the dimensions of a variable, if it has any."""
    if not has_dims(variable):
        return graph
    from pytensor.xtensor.basic import xtensor_from_tensor

    return xtensor_from_tensor(graph, dims=variable.type.dims)


def input_without_dims(x: Any, tensors: Mapping[Variable, Variable]) -> Any:
    """Return an input of a response as a plain tensor, the same one at each call.

    ``tensors`` has those of the model's variables, on which the result depends.
    """
    if x in tensors:
        return tensors[x]
    if not any(map(has_dims, ancestors([x], blockers=tensors))):
        return x
    if not hasattr(x.tag, "plain_input"):
        symbols = {v: t.type() for v, t in tensors.items()}
        named = {v: with_dims(s, v) for v, s in symbols.items()}
        graphs = without_dims(graph_replace([x], named, strict=False))
        values = {s: tensors[v] for v, s in symbols.items()}
        (x.tag.plain_input,) = graph_replace(graphs, values, strict=False)
        x.tag.plain_input.name = x.name
    return x.tag.plain_input


def foreign_variable(x: Any, own: set[Variable]) -> Variable | None:
    """Return a variable with dimensions that an input depends on and another model has, or None."""
    for v in ancestors([x], blockers=own):
        if v is not x and v.name and has_dims(v) and v not in own and v.owner is not None:
            from pytensor.xtensor.vectorization import XRV

            if any(isinstance(a.owner.op, XRV) for a in ancestors([v], own) if a.owner):
                return v
    return None
