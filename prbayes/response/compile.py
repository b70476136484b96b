"""Compilation of PyTensor graphs, in batches and once for each structure."""

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


def _split_long_sums(fgraph: Any, node: Any) -> Any:
    """Split a sum or product of many terms, which PyTensor makes one operation.

    NumPy takes 32 operands, the result among them.
    """
    op = node.op
    terms = node.inputs
    most = 30
    if len(terms) <= most or not op.scalar_op.associative:
        return False
    parts = []
    for first in range(0, len(terms), most):
        part = terms[first : first + most]
        parts.append(op(*part) if len(part) > 1 else part[0])
    return [op(*parts)]


def _softplus_by_ufuncs(fgraph: Any, node: Any) -> Any:
    """Return log(1 + exp(x)) by NumPy's functions: PyTensor's would loop over numbers."""
    if node.op.scalar_op != pt.softplus.scalar_op:
        return False
    (x,) = node.inputs
    return [pt.maximum(x, 0.0) + pt.log1p(pt.exp(-pt.abs(x)))]


def _index_batches(fgraph: Any, node: Any) -> Any:
    """Take x[i] in all rows at once, as of hyperparameters of groups: PyTensor would loop."""
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

    Every density checks whether its values and parameters are in its support; most often all are.
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


def _switch_to_where(fgraph: Any, node: Any) -> Any:
    if node.op.scalar_op != pt.switch.scalar_op:
        return False
    return [_where(*node.inputs)]


# Batched NumPy calls: a heavy compilation does not pay. Without fusion every elementwise operation
# is one NumPy ufunc; with it, the Python linker would loop over scalars. Sums are split last, as
# other rewrites would merge them.
PLAIN = (
    Mode(linker="py", optimizer="fast_run")
    .excluding("fusion", "inplace", "BlasOpt", "c_blas", "symbolic_op_recognition")
    .register((out2in(node_rewriter([Elemwise])(_softplus_by_ufuncs)), 1000))
    .register((out2in(node_rewriter([Blockwise])(_index_batches)), 1000))
    .register((out2in(node_rewriter([Elemwise])(_split_long_sums)), 1001))
    .register((out2in(node_rewriter([Elemwise])(_switch_to_where)), 1001))
)

_flags_lock = RLock()


@contextmanager
def interpreted() -> Iterator[None]:
    """Compile in the block without a C++ compiler, loops of PyTensor's too.

    PyTensor compiles the inside of a loop whatever the mode: ten seconds for a prior of
    correlations, and a warning where there is no BLAS.
    """
    with untraced(), pytensor.config.change_flags(cxx=""):
        yield


@contextmanager
def untraced() -> Iterator[None]:
    """Build graphs in the block without traces of source lines, a tenth of a short calibration."""
    # The flags are global: one thread at a time may change them.
    with _flags_lock, pytensor.config.change_flags(traceback__limit=0):
        yield


# -- compiled functions by structure ---------------------------------------------------------------

# Compiled functions by the structure of their graphs, the latest last.
_cache: OrderedDict[Hashable, Any] = OrderedDict()
_cache_lock = Lock()


class _NotCacheableError(Exception):
    """A graph has something of a user's, which must not be kept alive."""


def compiled(
    inputs: Sequence[TensorVariable],
    outputs: Sequence[TensorVariable],
    *,
    allow_input_downcast: bool | None = None,
) -> Any:
    """Compile a graph, unless a graph of the same structure was compiled in this process.

    Another evaluator of the same model gets a copy with its own storage, so two threads may call
    both. Shared variables are those of the graph; the cached function has empty ones.
    """
    shared = [
        v
        for v in ancestors(outputs)
        if isinstance(v, TensorSharedVariable) and v.default_update is None
    ]
    try:
        key = (allow_input_downcast, _structure([*inputs, *shared], outputs))
    except _NotCacheableError:
        return _function(inputs, outputs, allow_input_downcast)
    with _cache_lock:
        cached = _cache.get(key)
        if cached is not None:
            _cache.move_to_end(key)
    if cached is None:
        empty: dict[Any, Any] = {}
        for variable in shared:
            shape = variable.type.shape
            values = np.zeros([size or 0 for size in shape], dtype=variable.dtype)
            empty[variable] = pytensor.shared(values, shape=shape)
        graphs = graph_replace(list(outputs), empty, strict=False) if empty else outputs
        cached = _function(inputs, graphs, allow_input_downcast), list(empty.values())
    function, empty_shared = cached
    with _cache_lock:
        _cache[key] = cached
        while len(_cache) > 64:  # a model has about ten functions, with 4 MB of constants at most
            _cache.popitem(last=False)
        return function.copy(swap=dict(zip(empty_shared, shared, strict=True)))


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
    """Return the operations, constants and connections of a graph, without names.

    Graphs with random numbers, operations outside PyTensor or many constants are not cacheable.
    """
    number: dict[Variable, int] = {}
    structure: list[Hashable] = []
    size = 0
    for variable in inputs:
        number.setdefault(variable, len(number))
        structure.append(variable.type)

    def numbered(variable: Variable) -> int:
        nonlocal size
        if variable in number:
            return number[variable]
        if not isinstance(variable, Constant):
            raise _NotCacheableError
        if isinstance(variable.data, np.ndarray | np.generic):
            size += variable.data.nbytes
            data: Hashable = (variable.data.shape, variable.data.tobytes())
        elif isinstance(variable.data, slice | int | float | None):
            data = repr(variable.data)
        else:
            raise _NotCacheableError
        if size > 1 << 16:  # bytes of constants
            raise _NotCacheableError
        number[variable] = len(number)
        structure.append((variable.type, data))
        return number[variable]

    for node in toposort(list(outputs), blockers=list(inputs)):
        if not _is_stateless(node.op):
            raise _NotCacheableError
        structure.append((node.op, *map(numbered, node.inputs)))
        for variable in node.outputs:
            number[variable] = len(number)
    structure.append(tuple(map(numbered, outputs)))
    return tuple(structure)


def _is_stateless(op: Op) -> bool:
    """Return whether an operation, with those inside it, is one of PyTensor's, without state."""
    names = getattr(op, "__props__", None) or ()
    inner = [getattr(op, name, None) for name in names]
    is_pytensor = type(op).__module__.startswith("pytensor.")
    return is_pytensor and all(_is_stateless(part) for part in inner if isinstance(part, Op))


# -- batches ---------------------------------------------------------------------------------------


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
    """Return symbols of the same names with a leading axis for batches."""
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
