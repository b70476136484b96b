"""Compilation of graphs: in batches, where one invalid row leaves the others alone, and once."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from threading import Lock, RLock
from typing import Any

import numpy as np
import pytensor
import pytensor.tensor as pt
from pytensor.compile.mode import Mode
from pytensor.graph.basic import Apply, Constant, Variable
from pytensor.graph.op import Op
from pytensor.graph.replace import graph_replace, vectorize_graph
from pytensor.graph.rewriting.basic import node_rewriter, out2in
from pytensor.graph.traversal import ancestors, toposort
from pytensor.tensor.blockwise import Blockwise
from pytensor.tensor.elemwise import Elemwise
from pytensor.tensor.sharedvar import TensorSharedVariable
from pytensor.tensor.subtensor import Subtensor
from pytensor.tensor.variable import TensorVariable

# Operands of a sum: NumPy has 32 for one operation, the result among them, and PyTensor puts all
# terms of a sum into one.
_OPERANDS = 30


def _sums_of_sums(fgraph: Any, node: Any) -> Any:
    """Divide what has too many terms, or factors, into several of as many as there may be."""
    op = node.op
    terms = node.inputs
    if len(terms) <= _OPERANDS or not op.scalar_op.associative:
        return False
    parts = []
    for first in range(0, len(terms), _OPERANDS):
        part = terms[first : first + _OPERANDS]
        parts.append(op(*part) if len(part) > 1 else part[0])
    return [op(*parts)]


def _softplus_of_arrays(fgraph: Any, node: Any) -> Any:
    """Return log(1 + exp(x)) in steps that NumPy has: PyTensor's would loop over numbers."""
    if node.op.scalar_op != pt.softplus.scalar_op:
        return False
    (x,) = node.inputs
    return [pt.maximum(x, 0.0) + pt.log1p(pt.exp(-pt.abs(x)))]


def _elements_of_rows(fgraph: Any, node: Any) -> Any:
    """Take x[i] of each row at once, as of the groups' own hyperparameters, where both are batched.

    PyTensor's would loop over rows.
    """
    op = node.op.core_op
    is_element = isinstance(op, Subtensor) and len(op.idx_list) == 1 and len(node.inputs) == 2
    if not is_element or isinstance(op.idx_list[0], slice):
        return False
    x, index = node.inputs
    if index.ndim != 1 or node.op.batch_ndim(node) != 1:
        return False
    if x.type.broadcastable[0]:
        return [x[0][index]]
    if index.type.broadcastable[0]:
        return [x[:, index[0]]]
    return [x[pt.arange(x.shape[0]), index]]


class _Where(Op):
    """Choose between arrays, at no cost where the first is chosen throughout.

    Every density asks whether its values and parameters are in its support, and most often all are.
    """

    __props__ = ()
    view_map = {0: [1]}  # noqa: RUF012 - what PyTensor declares

    def make_node(self, condition: Any, first: Any, second: Any) -> Apply:
        """Take the three as they are."""
        return Apply(self, [condition, first, second], [pt.switch(condition, first, second).type()])

    def perform(self, node: Apply, inputs: Sequence[Any], output_storage: Any) -> None:
        """Return the first itself if it is the result."""
        condition, first, second = inputs
        dtype = node.outputs[0].dtype
        shape = np.broadcast_shapes(condition.shape, first.shape, second.shape)
        if first.shape == shape and first.dtype == dtype and condition.all():
            output_storage[0][0] = first
        else:
            output_storage[0][0] = np.asarray(np.where(condition, first, second), dtype=dtype)


_where = _Where()


def _choices_if_any(fgraph: Any, node: Any) -> Any:
    """Choose between arrays only where there is a choice."""
    if node.op.scalar_op != pt.switch.scalar_op:
        return False
    return [_where(*node.inputs)]


# Batched NumPy calls: nothing here runs often enough to repay a heavy compilation. Without fusion
# every elementwise operation is one NumPy ufunc; with it, the Python linker would loop over
# scalars. Sums and the like are divided last, lest they be put together again.
PLAIN = (
    Mode(linker="py", optimizer="fast_run")
    .excluding("fusion", "inplace", "BlasOpt", "c_blas", "symbolic_op_recognition")
    .register((out2in(node_rewriter([Elemwise])(_softplus_of_arrays)), 1000))
    .register((out2in(node_rewriter([Blockwise])(_elements_of_rows)), 1000))
    .register((out2in(node_rewriter([Elemwise])(_sums_of_sums)), 1001))
    .register((out2in(node_rewriter([Elemwise])(_choices_if_any)), 1001))
)

# Functions that are kept, the oldest of which goes: a model has about ten. What they hold beside
# their code are constants, 4 MB of them at the most.
_KEPT = 64
_LARGEST = 1 << 16  # bytes of constants

_known: OrderedDict[Hashable, Any] = OrderedDict()
_lock = Lock()
_flags = RLock()


@contextmanager
def interpreted() -> Iterator[None]:
    """Compile what is inside without a C++ compiler, loops of PyTensor's too.

    It calls one for the inside of a loop, whatever the mode: ten seconds for a prior of
    correlations, and a warning where there is no BLAS to link to.
    """
    with untraced(), pytensor.config.change_flags(cxx=""):
        yield


@contextmanager
def untraced() -> Iterator[None]:
    """Build the graphs inside without a note in each node of the lines that made it.

    PyTensor reads those lines from files: about a tenth of a short calibration.
    """
    # The flags are the same for all threads: each has to find them as they were.
    with _flags, pytensor.config.change_flags(traceback__limit=0):
        yield


class _NotKeptError(Exception):
    """A graph holds something of a user's, which is not to be kept alive."""


def compiled(
    inputs: Sequence[TensorVariable],
    outputs: Sequence[TensorVariable],
    *,
    allow_input_downcast: bool | None = None,
) -> Any:
    """Compile a graph, unless the same graph was compiled before in this process.

    The second evaluator of a model, and of a model that was built again, asks for what the first
    one did. It gets a copy of that function, with a memory of its own: two threads may call both.
    Shared variables are those of the one who asks; what is kept has others, of no values.
    """
    shared = _shared(outputs)
    try:
        key = (allow_input_downcast, _structure([*inputs, *shared], outputs))
    except _NotKeptError:
        return _function(inputs, outputs, allow_input_downcast)
    with _lock:
        known = _known.get(key)
        if known is not None:
            _known.move_to_end(key)
    if known is None:
        empty = {variable: _empty(variable) for variable in shared}
        graphs = graph_replace(list(outputs), empty, strict=False) if empty else outputs
        known = _function(inputs, graphs, allow_input_downcast), list(empty.values())
    function, of_nothing = known
    with _lock:
        _known[key] = known
        while len(_known) > _KEPT:
            _known.popitem(last=False)
        return function.copy(swap=dict(zip(of_nothing, shared, strict=True)))


def _shared(outputs: Sequence[TensorVariable]) -> list[Any]:
    """Return the shared variables of a graph, but not generators of random numbers."""
    found = ancestors(outputs)
    return [v for v in found if isinstance(v, TensorSharedVariable) and v.default_update is None]


def _empty(variable: Any) -> Any:
    """Return a shared variable of the same type that holds next to nothing."""
    shape = variable.type.shape
    nothing = np.zeros([size or 0 for size in shape], dtype=variable.dtype)
    return pytensor.shared(nothing, shape=shape)


def _function(
    inputs: Sequence[TensorVariable],
    outputs: Sequence[TensorVariable],
    allow_input_downcast: bool | None,
) -> Any:
    with interpreted():
        return pytensor.function(
            list(inputs),
            list(outputs),
            mode=PLAIN,
            on_unused_input="ignore",
            allow_input_downcast=allow_input_downcast,
        )


def _structure(
    inputs: Sequence[TensorVariable], outputs: Sequence[TensorVariable]
) -> tuple[Hashable, ...]:
    """Return what makes a graph that graph: its operations, constants and how they hang together.

    Names do not.

    Raises
    ------
    _NotKeptError
        If the graph has random numbers, operations of a user's or of ours, or many constants.
    """
    number: dict[Variable, int] = {}
    said: list[Hashable] = []
    size = 0
    for variable in inputs:
        number.setdefault(variable, len(number))
        said.append(variable.type)

    def numbered(variable: Variable) -> int:
        nonlocal size
        if variable in number:
            return number[variable]
        if not isinstance(variable, Constant):
            raise _NotKeptError
        if isinstance(variable.data, np.ndarray | np.generic):
            size += variable.data.nbytes
            data: Hashable = (variable.data.shape, variable.data.tobytes())
        elif isinstance(variable.data, slice | int | float | None):
            data = repr(variable.data)
        else:
            raise _NotKeptError
        if size > _LARGEST:
            raise _NotKeptError
        number[variable] = len(number)
        said.append((variable.type, data))
        return number[variable]

    for node in toposort(list(outputs), blockers=list(inputs)):
        if not _foreign(node.op):
            raise _NotKeptError
        said.append((node.op, *map(numbered, node.inputs)))
        for variable in node.outputs:
            number[variable] = len(number)
    said.append(tuple(map(numbered, outputs)))
    return tuple(said)


def _foreign(op: Op) -> bool:
    """Return whether an operation, with those inside it, is PyTensor's own, and without state."""
    names = getattr(op, "__props__", None) or ()
    within = [getattr(op, name, None) for name in names]
    own = type(op).__module__.startswith("pytensor.")
    return own and all(_foreign(inner) for inner in within if isinstance(inner, Op))


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
    with untraced():
        outputs = ninf_for_invalid(core_outputs)
        batched = with_leading_axis(core_inputs)
        vectorized = vectorize_graph(outputs, dict(zip(core_inputs, batched, strict=True)))
        return compiled([*batched, *extra], vectorized, allow_input_downcast=True)
