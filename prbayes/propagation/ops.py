"""PyTensor operations: a response, a density of simulated values and a metric in a graph."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.basic import Apply, Variable
from pytensor.graph.op import Op
from pytensor.graph.replace import _vectorize_node
from pytensor.tensor.variable import TensorVariable

from prbayes.metrics.base import Discrepancy
from prbayes.metrics.cells import Cells
from prbayes.response.batches import batch_shape, broadcast_batch
from prbayes.response.response import Responses

# Calls of the user's functions have no compiled form; nothing is gained by saying so at every
# compilation.
warnings.filterwarnings(
    "ignore",
    message="Numba will use object mode to run "
    "(prbayes_Simulator|FreshOp|ResponseOp|DensityOp|CotangentOp|OpaqueOp|abc_d)",
)


class OwnOp(Op):
    """An operation that takes leading axes itself.

    It equals those of its class that hold the very same objects.
    """

    __props__ = ()

    @property
    def held(self) -> tuple[object, ...]:
        """The objects that make the operation what it is."""
        raise TypeError(f"{type(self).__name__}: got no list of what it holds")

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, OwnOp) or type(self) is not type(other):
            return False
        pairs = zip(self.held, other.held, strict=True)
        return all(mine is theirs for mine, theirs in pairs)

    def __hash__(self) -> int:
        return hash((type(self), *map(id, self.held)))


def _on_batches(op: Any, node: Apply[Any, Any], *batched: Variable) -> Any:
    """Operations that take leading axes themselves: a batch is one call."""
    return op.make_node(*batched)


_vectorize_node.register(OwnOp, _on_batches)


def float_output(ndim: int, *last: int) -> TensorVariable:
    """Return an output of so many axes, of which the last ones have known lengths."""
    shape = (None,) * (ndim - len(last)) + last
    return pt.tensor(dtype="float64", shape=shape)


class ResponseOp(OwnOp):
    """The response as an operation.

    It has no gradient and is computed in one call for a whole batch.
    """

    def __init__(self, responses: Responses) -> None:
        self.responses = responses
        inputs = responses.inputs
        common = [e.type.ndim for e in inputs.epistemic]
        self.event_ndims = [*inputs.event_ndims, *common]

    @property
    def held(self) -> tuple[object, ...]:
        """The user's response."""
        return (self.responses,)

    def make_node(self, *inputs: Any) -> Apply[Any, Any]:
        """Apply to values of shape (..., *event); the result has the leading axes."""
        tensors = [pt.as_tensor(x) for x in inputs]
        pairs = zip(tensors, self.event_ndims, strict=True)
        leading = [t.type.ndim - event for t, event in pairs]
        ndim = max(leading)
        return Apply(self, tensors, [float_output(ndim)])

    def perform(self, node: Any, inputs: Any, outputs: Any) -> None:
        """Call the response, but not for populations that are invalid.

        Their quantiles are not finite.
        """
        k = len(self.responses.inputs.aleatory)
        batch = batch_shape(inputs, self.event_ndims)
        full = broadcast_batch(inputs, self.event_ndims, batch)
        aleatory, epistemic = full[:k], full[k:]

        # A population is left out if one of its inputs is finite at none of its specimens.
        specimens = len(batch)
        valid = np.ones(batch[:-1], dtype=bool)
        for x in aleatory:
            event_axes = tuple(range(specimens, x.ndim))
            finite = np.isfinite(x).all(axis=event_axes)
            valid &= finite.any(axis=-1)
        if valid.all():
            outputs[0][0] = self.responses(inputs[:k], inputs[k:])
            return
        values = np.full(batch, np.nan)
        if valid.any():
            valid_aleatory = [x[valid] for x in aleatory]
            valid_epistemic = [x[valid] for x in epistemic]
            values[valid] = self.responses(valid_aleatory, valid_epistemic)
        outputs[0][0] = values

    def pullback(self, inputs: Any, outputs: Any, cotangents: Any) -> Any:
        """Refuse: the response is a black box."""
        raise NotImplementedError(
            f"{self.responses.name}: the response does not accept PyTensor variables, so it has no "
            "gradient under prb.Resimulated; use propagation=prb.Reweighted(), or prb.sample_smc, "
            "which needs none"
        )


class DensityOp(OwnOp):
    """The density of a weighted sample on cells, (..., n), (..., n) -> (..., m)."""

    def __init__(self, cells: Cells) -> None:
        self.cells = cells

    @property
    def held(self) -> tuple[object, ...]:
        """The cells."""
        return (self.cells,)

    def make_node(self, sample: Any, weights: Any) -> Apply[Any, Any]:
        """Apply to a sample and its weights."""
        tensors = [pt.as_tensor(sample), pt.as_tensor(weights)]
        ndim = max(t.type.ndim for t in tensors)
        return Apply(self, tensors, [float_output(ndim, self.cells.widths.size)])

    def perform(self, node: Any, inputs: Any, outputs: Any) -> None:
        """Bin and smooth."""
        sample, weights = np.broadcast_arrays(*inputs)
        outputs[0][0] = self.cells.density(sample, weights)

    def pullback(self, inputs: Any, outputs: Any, cotangents: Any) -> Any:
        """Return the derivatives by another operation."""
        if not self.cells.smooth:
            raise NotImplementedError(
                "a Histogram has no gradient under prb.Resimulated: "
                "use GaussianKDE, or prb.Reweighted"
            )
        sample, weights = inputs
        (cotangent,) = cotangents
        slope = CotangentOp(self.cells, 1)(sample, cotangent)
        value = CotangentOp(self.cells, 0)(sample, cotangent)
        return [weights * slope, value]


class CotangentOp(OwnOp):
    """A cotangent of a density on cells at the sample, (..., n), (..., m) -> (..., n).

    Itself or its derivative.
    """

    def __init__(self, cells: Cells, order: int) -> None:
        self.cells = cells
        self.order = order

    @property
    def held(self) -> tuple[object, ...]:
        """The cells, and which derivative."""
        return (self.cells, self.order)

    def make_node(self, sample: Any, cotangent: Any) -> Apply[Any, Any]:
        """Apply to a sample and the cotangent of the density."""
        tensors = [pt.as_tensor(sample), pt.as_tensor(cotangent)]
        ndim = max(t.type.ndim for t in tensors)
        return Apply(self, tensors, [float_output(ndim)])

    def perform(self, node: Any, inputs: Any, outputs: Any) -> None:
        """Gather."""
        gather = self.cells.slope if self.order else self.cells.value
        outputs[0][0] = gather(*inputs)

    def pullback(self, inputs: Any, outputs: Any, cotangents: Any) -> Any:
        """Refuse second derivatives."""
        raise NotImplementedError(
            "second derivatives of a density of simulated values are not implemented as a graph"
        )


class OpaqueOp(OwnOp):
    """A user's metric on weighted responses, (..., n), (..., n) -> (...); it has no gradient."""

    def __init__(self, target: Discrepancy) -> None:
        self.target = target

    @property
    def held(self) -> tuple[object, ...]:
        """The metric with its observed side."""
        return (self.target,)

    def make_node(self, sample: Any, weights: Any) -> Apply[Any, Any]:
        """Apply to a sample and its weights."""
        tensors = [pt.as_tensor(sample), pt.as_tensor(weights)]
        ndim = max(t.type.ndim for t in tensors)
        return Apply(self, tensors, [float_output(ndim - 1)])

    def perform(self, node: Any, inputs: Any, outputs: Any) -> None:
        """Call the user's function."""
        sample, weights = np.broadcast_arrays(*inputs)
        outputs[0][0] = np.asarray(self.target.of(sample, weights))

    def pullback(self, inputs: Any, outputs: Any, cotangents: Any) -> Any:
        """Refuse: nothing is known about the function."""
        raise NotImplementedError(
            "a FunctionMetric has no gradient; use prb.sample_smc, "
            "prb.minimize(method='Nelder-Mead') or pm.Slice"
        )


def symbolic_discrepancy(target: Discrepancy, sample: Any, weights: Any) -> Any:
    """Return the graph of a discrepancy for a sample that depends on theta: (n,), (n,) -> ()."""
    if not target.symbolic:
        return OpaqueOp(target)(sample, weights)
    if target.density_cells is not None:
        density = DensityOp(target.density_cells)(sample, weights)
        return target.outer(density, xp=pt)
    features = target.features(sample, weights, pt)
    return target.outer(*features, xp=pt)
