"""PyTensor operations: a response, a density of simulated values, a user's metric as nodes of a graph."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.basic import Apply, Variable
from pytensor.graph.op import Op
from pytensor.graph.replace import _vectorize_node

from prbayes.metrics.base import Discrepancy
from prbayes.metrics.cells import Cells
from prbayes.response.response import Responses

# Calls of the user's functions have no compiled form; nothing is gained by saying so at every compilation.
warnings.filterwarnings(
    "ignore", message="Numba will use object mode to run (prbayes_Simulator|FreshOp|ResponseOp|Density|OpaqueOp|abc_d)"
)


class ResponseOp(Op):
    """The response as an operation; it has no gradient and is computed in one call for a whole batch."""

    __props__ = ()

    def __init__(self, responses: Responses) -> None:
        self.responses = responses
        inputs = responses.inputs
        self.event_ndims = [*inputs.event_ndims, *(e.type.ndim for e in inputs.epistemic)]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ResponseOp) and self.responses is other.responses

    def __hash__(self) -> int:
        return hash((type(self), id(self.responses)))

    def make_node(self, *inputs: Any) -> Apply[Any, Any]:
        """Apply to values of shape (..., *event); the result has the leading axes."""
        tensors = [pt.as_tensor(x) for x in inputs]
        ndim = max(t.type.ndim - e for t, e in zip(tensors, self.event_ndims, strict=True))
        return Apply(self, tensors, [pt.tensor(dtype="float64", shape=(None,) * ndim)])

    def perform(self, node: Any, inputs: Any, outputs: Any) -> None:
        """Call the response, but not for populations that are invalid: their quantiles are not finite."""
        k = len(self.responses.inputs.aleatory)
        ndims = list(zip(inputs, self.event_ndims, strict=True))
        batch = np.broadcast_shapes(*(x.shape[: x.ndim - e] for x, e in ndims))
        full = [np.broadcast_to(x, batch + x.shape[x.ndim - e :]) for x, e in ndims]
        finite = [np.isfinite(x).all(axis=tuple(range(len(batch), x.ndim))) for x in full[:k]]
        valid = np.all([f.any(axis=-1) for f in finite], axis=0)
        if valid.all():
            outputs[0][0] = self.responses(inputs[:k], inputs[k:])
            return
        values = np.full(batch, np.nan)
        if valid.any():
            values[valid] = self.responses([x[valid] for x in full[:k]], [x[valid] for x in full[k:]])
        outputs[0][0] = values

    def pullback(self, inputs: Any, outputs: Any, cotangents: Any) -> Any:
        """Refuse: the response is a black box."""
        raise NotImplementedError(
            f"{self.responses.name}: the response does not accept PyTensor variables, so it has no gradient under "
            "prb.Resimulated; use propagation=prb.Reweighted(), or prb.sample_smc, which needs none"
        )


class DensityOp(Op):
    """The density of a weighted sample on cells, (..., n), (..., n) -> (..., m)."""

    def __init__(self, cells: Cells) -> None:
        self.cells = cells

    def __eq__(self, other: object) -> bool:
        return isinstance(other, DensityOp) and self.cells is other.cells

    def __hash__(self) -> int:
        return hash((type(self), id(self.cells)))

    def make_node(self, sample: Any, weights: Any) -> Apply[Any, Any]:
        """Apply to a sample and its weights."""
        sample, weights = pt.as_tensor(sample), pt.as_tensor(weights)
        ndim = max(sample.type.ndim, weights.type.ndim)
        shape = (None,) * (ndim - 1) + (self.cells.widths.size,)
        return Apply(self, [sample, weights], [pt.tensor(dtype="float64", shape=shape)])

    def perform(self, node: Any, inputs: Any, outputs: Any) -> None:
        """Bin and smooth."""
        sample, weights = np.broadcast_arrays(*inputs)
        outputs[0][0] = self.cells.density(sample, weights)

    def pullback(self, inputs: Any, outputs: Any, cotangents: Any) -> Any:
        """Return the derivatives by another operation."""
        if not self.cells.smooth:
            raise NotImplementedError(
                "a Histogram has no gradient under prb.Resimulated: use GaussianKDE, or prb.Reweighted"
            )
        (sample, weights), (cotangent,) = inputs, cotangents
        slope, value = (CotangentOp(self.cells, order)(sample, cotangent) for order in (1, 0))
        return [weights * slope, value]


class CotangentOp(Op):
    """A cotangent of a density on cells at the sample, (..., n), (..., m) -> (..., n): itself or its derivative."""

    def __init__(self, cells: Cells, order: int) -> None:
        self.cells, self.order = cells, order

    def __eq__(self, other: object) -> bool:
        return isinstance(other, CotangentOp) and self.cells is other.cells and self.order == other.order

    def __hash__(self) -> int:
        return hash((type(self), id(self.cells), self.order))

    def make_node(self, sample: Any, cotangent: Any) -> Apply[Any, Any]:
        """Apply to a sample and the cotangent of the density."""
        tensors = [pt.as_tensor(x) for x in (sample, cotangent)]
        ndim = max(t.type.ndim for t in tensors)
        return Apply(self, tensors, [pt.tensor(dtype="float64", shape=(None,) * ndim)])

    def perform(self, node: Any, inputs: Any, outputs: Any) -> None:
        """Gather."""
        outputs[0][0] = (self.cells.slope if self.order else self.cells.value)(*inputs)

    def pullback(self, inputs: Any, outputs: Any, cotangents: Any) -> Any:
        """Refuse second derivatives."""
        raise NotImplementedError("second derivatives of a density of simulated values are not implemented as a graph")


class OpaqueOp(Op):
    """A user's metric on weighted responses, (..., n), (..., n) -> (...); it has no gradient."""

    __props__ = ()

    def __init__(self, target: Discrepancy) -> None:
        self.target = target

    def __eq__(self, other: object) -> bool:
        return isinstance(other, OpaqueOp) and self.target is other.target

    def __hash__(self) -> int:
        return hash((type(self), id(self.target)))

    def make_node(self, sample: Any, weights: Any) -> Apply[Any, Any]:
        """Apply to a sample and its weights."""
        sample, weights = pt.as_tensor(sample), pt.as_tensor(weights)
        ndim = max(sample.type.ndim, weights.type.ndim)
        return Apply(self, [sample, weights], [pt.tensor(dtype="float64", shape=(None,) * (ndim - 1))])

    def perform(self, node: Any, inputs: Any, outputs: Any) -> None:
        """Call the user's function."""
        sample, weights = np.broadcast_arrays(*inputs)
        outputs[0][0] = np.asarray(self.target.of(sample, weights))

    def pullback(self, inputs: Any, outputs: Any, cotangents: Any) -> Any:
        """Refuse: nothing is known about the function."""
        raise NotImplementedError(
            "a FunctionMetric has no gradient; use prb.sample_smc, prb.minimize(method='Nelder-Mead') or pm.Slice"
        )


def _on_batches(op: Any, node: Apply[Any, Any], *batched: Variable) -> Any:
    """Operations that take leading axes themselves: a batch is one call."""
    return op.make_node(*batched)


for _op in (ResponseOp, DensityOp, CotangentOp, OpaqueOp):
    _vectorize_node.register(_op, _on_batches)


def symbolic_discrepancy(target: Discrepancy, sample: Any, weights: Any) -> Any:
    """Return the graph of a discrepancy for a sample that depends on theta, shapes (n,), (n,) -> ()."""
    if target.density_cells is not None:
        return target.outer(DensityOp(target.density_cells)(sample, weights), xp=pt)
    if not target.symbolic:
        return OpaqueOp(target)(sample, weights)
    return target.outer(*target.features(sample, weights, pt), xp=pt)
