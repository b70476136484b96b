"""Batched compilation of graphs, so that one invalid row leaves the others alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytensor
import pytensor.tensor as pt
from pytensor.compile.mode import Mode
from pytensor.graph.basic import Variable
from pytensor.graph.replace import graph_replace, vectorize_graph
from pytensor.graph.traversal import ancestors
from pytensor.tensor.variable import TensorVariable

# Batched NumPy calls: nothing here runs often enough to repay a heavy compilation. Without fusion
# every elementwise operation is one NumPy ufunc; with it, the Python linker would loop over
# scalars.
PLAIN = Mode(linker="py", optimizer="fast_run").excluding(
    "fusion", "inplace", "BlasOpt", "c_blas", "symbolic_op_recognition"
)


def ninf_for_invalid(graphs: Sequence[TensorVariable]) -> list[TensorVariable]:
    """Replace PyMC's parameter checks by -inf: an invalid theta leaves its batch alone."""
    from pymc.logprob.utils import CheckParameterValue

    switches: dict[Variable, Variable] = {}
    for v in ancestors(graphs):
        if v.owner is not None and isinstance(v.owner.op, CheckParameterValue):
            value, *conditions = v.owner.inputs
            valid = pt.all([pt.all(c) for c in conditions])
            switches[v] = pt.switch(valid, value, -np.inf)
    if not switches:
        return list(graphs)
    return list(graph_replace(list(graphs), switches, strict=False))


def with_leading_axis(symbols: Sequence[TensorVariable]) -> list[TensorVariable]:
    """Return symbols for batches of others, of the same names."""
    return [pt.tensor(name=s.name, dtype=s.dtype, shape=(None, *s.type.shape)) for s in symbols]


def compile_batched(
    core_inputs: Sequence[TensorVariable],
    core_outputs: Sequence[TensorVariable],
    extra: Sequence[TensorVariable] = (),
) -> Any:
    """Compile a graph for a batch: core inputs get a leading axis, ``extra`` ones do not."""
    outputs = ninf_for_invalid(core_outputs)
    batched = with_leading_axis(core_inputs)
    vectorized = vectorize_graph(outputs, dict(zip(core_inputs, batched, strict=True)))
    return pytensor.function(
        [*batched, *extra],
        vectorized,
        mode=PLAIN,
        on_unused_input="ignore",
        allow_input_downcast=True,
    )
