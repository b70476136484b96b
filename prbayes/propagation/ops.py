"""PyTensor operations: a response, a density of simulated values and a metric in a graph."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.gradient import grad_not_implemented
from pytensor.graph.basic import Apply
from pytensor.graph.op import Op
from pytensor.graph.replace import _vectorize_node

from prbayes.metrics.base import Basis, Discrepancy
from prbayes.metrics.density import BinnedBasis, DensityDiscrepancy
from prbayes.metrics.grid import Cells
from prbayes.response.inputs import broadcast_batch
from prbayes.response.response import Responses

# Calls of the user's functions cannot be compiled, so that Numba's warning would appear at every
# compilation without being of any use.
warnings.filterwarnings(
    "ignore",
    message="Numba will use object mode to run "
    "(prbayes_Simulator|FreshOp|ResponseOp|DensityOp|CotangentOp|OpaqueOp|abc_d)",
)


class OwnOp(Op):
    """An operation on arrays (..., *event); two are equal if ``__props__`` are the same objects."""

    __props__: tuple[str, ...] = ()
    # Number of axes of each input, such as a sample and its weights.
    event_ndims: Sequence[int] = (1, 1)
    event_shape: tuple[int | None, ...] = ()  # shape of the result without leading axes
    no_gradient: str = ""  # error text if the operation has no gradient: reason and remedy

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls.__str__ = OwnOp.__str__  # type: ignore[method-assign]  # PyTensor's shows all values

    def __str__(self) -> str:
        """Return the name, and what to do if a backend cannot compile the operation."""
        return (
            f"{type(self).__name__}, which is computed by NumPy: PyTensor's JAX mode and NumPyro "
            "take prb.Reweighted alone, with a smaller max_points for several outputs; use that, "
            "or nuts_sampler='nutpie' or 'pymc'"
        )

    def pullback(self, inputs: Any, outputs: Any, cotangents: Any) -> Any:
        """Refuse, unless a subclass has derivatives."""
        raise NotImplementedError(self.no_gradient)

    def make_node(self, *inputs: Any) -> Apply[Any, Any]:
        """Apply to arrays; the result has their leading axes before its own event."""
        tensors = [pt.as_tensor(x) for x in inputs]
        pairs = zip(tensors, self.event_ndims, strict=True)
        leading = max(t.type.ndim - event for t, event in pairs)
        result = pt.tensor(dtype="float64", shape=(None,) * leading + self.event_shape)
        return Apply(self, tensors, [result])


# These operations accept leading axes themselves, so that a batch of arrays is one call.
_vectorize_node.register(OwnOp, lambda op, _, *batched: op.make_node(*batched))


class ResponseOp(OwnOp):
    """The response, which has no gradient, in one call for a whole batch."""

    __props__ = ("responses",)
    event_shape: tuple[int, ...] = ()

    def __init__(self, responses: Responses) -> None:
        self.responses = responses
        if responses.outputs is not None:
            self.event_shape = responses.outputs.event
        self.event_ndims = responses.inputs.event_ndims
        # Stored responses have no inputs that are common to all specimens.
        stored = "" if responses.inputs.epistemic else "propagation=prb.Reweighted(), or "
        self.no_gradient = (
            f"{responses.name}: the response does not accept PyTensor variables, so it has no "
            f"gradient under prb.Resimulated; use {stored}prb.sample_smc, which needs none"
        )

    def perform(self, node: Any, inputs: Any, outputs: Any) -> None:
        """Call the response for populations that are valid.

        Others have an input that is finite at none of their specimens.
        """
        k = len(self.responses.inputs.aleatory)
        batch, full = broadcast_batch(inputs, self.event_ndims)
        valid = np.ones(batch[:-1], dtype=bool)
        for x in full[:k]:
            event_axes = tuple(range(len(batch), x.ndim))
            valid &= np.isfinite(x).all(axis=event_axes).any(axis=-1)
        if valid.all():
            outputs[0][0] = self.responses(inputs[:k], inputs[k:])
            return
        values = np.full(batch + self.event_shape, np.nan)
        if valid.any():
            rows = [x[valid] for x in full]
            values[valid] = self.responses(rows[:k], rows[k:])
        outputs[0][0] = values


class DensityOp(OwnOp):
    """The density of a weighted sample on cells, (..., n), (..., n) -> (..., m)."""

    __props__ = ("cells",)

    def __init__(self, cells: Cells) -> None:
        self.cells = cells
        self.event_shape = cells.widths.shape

    def perform(self, node: Any, inputs: Any, outputs: Any) -> None:
        """Bin and smooth."""
        sample, weights = np.broadcast_arrays(*inputs)
        outputs[0][0] = self.cells.density(sample, weights)

    def pullback(self, inputs: Any, outputs: Any, cotangents: Any) -> Any:
        """Return the derivatives by another operation; a histogram has none for its sample."""
        sample, weights = inputs
        value = CotangentOp(self.cells, for_sample=False)(sample, *cotangents)
        if not self.cells.smooth:
            reason = (
                "a Histogram has no gradient under prb.Resimulated: use GaussianKDE, or "
                "prb.Reweighted"
            )
            return [grad_not_implemented(self, 0, sample, reason), value]
        slope = CotangentOp(self.cells, for_sample=True)(sample, *cotangents)
        return [weights * slope, value]


class CotangentOp(OwnOp):
    """A cotangent of a density at its sample, or its derivative: (..., n), (..., m) -> (..., n)."""

    __props__ = ("cells", "for_sample")
    event_shape = (None,)
    no_gradient = "second derivatives of densities of simulated values are not implemented"

    def __init__(self, cells: Cells, for_sample: bool) -> None:
        self.cells = cells
        self.for_sample = for_sample

    def perform(self, node: Any, inputs: Any, outputs: Any) -> None:
        """Gather."""
        outputs[0][0] = self.cells.adjoint(*inputs, for_sample=self.for_sample)


class OpaqueOp(OwnOp):
    """A user's metric on weighted responses, (..., n), (..., n) -> (...); it has no gradient."""

    __props__ = ("target",)
    no_gradient = (
        "a FunctionMetric has no gradient; use prb.sample_smc, "
        "prb.minimize(method='Nelder-Mead') or pm.Slice"
    )

    def __init__(self, target: Discrepancy) -> None:
        self.target = target
        self.event_ndims = [1 + len(target.event), 1]

    def perform(self, node: Any, inputs: Any, outputs: Any) -> None:
        """Call the user's function."""
        sample, weights = inputs
        event = self.target.event
        shape = np.broadcast_shapes(sample.shape[: sample.ndim - len(event)], weights.shape)
        full = np.broadcast_to(sample, shape + event)
        outputs[0][0] = np.asarray(self.target.of(full, np.broadcast_to(weights, shape)))


def stored_discrepancy(target: Discrepancy, basis: Basis, weights: Any) -> Any:
    """Return the graph of a discrepancy for stored responses with weights (n,) of theta."""
    if not target.metric.symbolic:
        return OpaqueOp(target)(*basis.arrays, weights)
    if isinstance(basis, BinnedBasis):
        (projections,) = basis.arrays
        densities = [
            DensityOp(cells)(projections[:, k], weights)
            for k, cells in enumerate(basis.densities.cells)
        ]
        return target.outer(pt.concatenate(densities, axis=-1), xp=pt)
    return target.outer(*basis.features(weights, pt), xp=pt)


def symbolic_discrepancy(target: Discrepancy, sample: Any, weights: Any) -> Any:
    """Return the graph of a discrepancy for a sample (n,) or (n, m) that depends on theta."""
    if not target.metric.symbolic:
        return OpaqueOp(target)(sample, weights)
    parts = target.parts
    if parts[0].target is not target:
        return sum(
            part.share * symbolic_discrepancy(part.target, part.of(sample, pt), weights)
            for part in parts
        )
    if isinstance(target, DensityDiscrepancy):
        density = DensityOp(target.cells)(sample, weights)
        return target.outer(density, xp=pt)
    features = target.features(sample, weights, pt)
    return target.outer(*features, xp=pt)
