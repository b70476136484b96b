"""Compilation of PyTensor graphs, in batches and once for each structure."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import singledispatch
from threading import Lock, RLock
from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
from pymc.distributions.custom import CustomSymbolicDistRV
from pymc.distributions.distribution import SymbolicRandomVariable
from pymc.distributions.shape_utils import change_dist_size
from pytensor.compile.builders import OpFromGraph
from pytensor.compile.mode import Mode
from pytensor.graph.basic import Apply, Constant, Variable
from pytensor.graph.op import Op
from pytensor.graph.replace import (
    _vectorize_node,
    clone_replace,
    graph_replace,
    vectorize_graph,
)
from pytensor.graph.rewriting.basic import node_rewriter, out2in
from pytensor.graph.traversal import ancestors, toposort
from pytensor.scalar.basic import Composite
from pytensor.tensor.blockwise import Blockwise
from pytensor.tensor.elemwise import Elemwise
from pytensor.tensor.random.op import RandomVariable
from pytensor.tensor.sharedvar import TensorSharedVariable
from pytensor.tensor.subtensor import Subtensor
from pytensor.tensor.variable import TensorConstant, TensorVariable


def _numpy_elementwise(fgraph: Any, node: Any) -> Any:
    """Rewrite elementwise operations that NumPy would compute slowly, or not at all."""
    op = node.op
    terms = node.inputs
    if op.scalar_op == pt.softplus.scalar_op:  # PyTensor would loop over numbers in Python
        (x,) = terms
        return [pt.maximum(x, 0.0) + pt.log1p(pt.exp(-pt.abs(x)))]
    if isinstance(op.scalar_op, Composite):  # PyTensor would loop over numbers in Python
        graph = op.scalar_op.fgraph
        values = dict(zip(graph.inputs, terms, strict=True))
        for inner in graph.toposort():
            arguments = [values[x] if x in values else pt.constant(x.data) for x in inner.inputs]
            values[inner.outputs[0]] = Elemwise(inner.op)(*arguments)
        return [values[x] for x in graph.outputs]
    most = 30  # NumPy takes at most 32 operands, the result included
    if len(terms) <= most or not op.scalar_op.associative:
        return False
    parts = []
    for first in range(0, len(terms), most):
        part = terms[first : first + most]
        parts.append(op(*part) if len(part) > 1 else part[0])
    return [op(*parts)]


def _index_batches(fgraph: Any, node: Any) -> Any:
    """Rewrite x[i] in a batch, such as groups' hyperparameters: PyTensor would loop over rows."""
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


def copy_views(fgraph: Any, node: Any) -> Any:
    """Copy constants that are views of other arrays, which PyTensor may make read-only later."""
    # NumPy and SciPy raise for a writeable view of a read-only array.
    copies = [
        pt.constant(x.data.copy(), dtype=x.type.dtype)
        if isinstance(x, Constant) and getattr(x.data, "base", None) is not None
        else x
        for x in node.inputs
    ]
    return False if copies == node.inputs else node.clone_with_new_inputs(copies).outputs


# Batched NumPy calls: a heavy compilation does not pay. Without fusion every elementwise operation
# is one NumPy ufunc; with it, the Python linker would loop over scalars. Sums are split last,
# because other rewrites would merge them again.
PLAIN = (
    Mode(linker="py", optimizer="fast_run")
    .excluding("fusion", "inplace", "BlasOpt", "c_blas", "symbolic_op_recognition")
    .register((out2in(node_rewriter([Blockwise])(_index_batches)), 1000))
    .register((out2in(node_rewriter([Elemwise])(_numpy_elementwise)), 1001))
    .register((out2in(node_rewriter(None)(copy_views)), 1002))
)

_flags_lock = RLock()


@contextmanager
def interpreted() -> Iterator[None]:
    """Build and compile graphs in the block without a C++ compiler and traces of source lines.

    PyTensor compiles the inside of a loop whatever the mode: ten seconds for a prior of
    correlations, and a warning where there is no BLAS. Traces take a tenth of a short calibration.
    """
    # The flags are global, so that only one thread at a time may change them.
    with _flags_lock, pytensor.config.change_flags(traceback__limit=0, cxx=""):
        yield


# -- compiled functions by structure ---------------------------------------------------------------

# Compiled functions by the structure of their graphs, the most recently used last.
_cache: OrderedDict[Hashable, Any] = OrderedDict()
_cache_lock = Lock()


def compiled(
    inputs: Sequence[TensorVariable],
    outputs: Sequence[TensorVariable],
    *,
    allow_input_downcast: bool | None = None,
) -> Any:
    """Compile a graph, or copy the function of a graph of the same structure.

    A copy has its own storage, for another thread, and the shared variables of its graph.
    """
    shared = [
        v
        for v in ancestors(outputs)
        if isinstance(v, TensorSharedVariable) and v.default_update is None
    ]
    key = _structure([*inputs, *shared], outputs, allow_input_downcast)
    with _cache_lock:
        cached = None if key is None else _cache.get(key)
    if cached is None:
        empty = {}
        for variable in shared if key is not None else ():
            shape = variable.type.shape
            values = np.zeros([size or 0 for size in shape], dtype=variable.dtype)
            empty[variable] = pytensor.shared(values, shape=shape)
        graphs = graph_replace(list(outputs), empty, strict=False) if empty else list(outputs)
        with interpreted():
            function = pytensor.function(
                list(inputs),
                graphs,
                mode=PLAIN,
                on_unused_input="ignore",
                allow_input_downcast=allow_input_downcast,
            )
        if key is None:
            return function
        cached = function, list(empty.values())
    function, empty_shared = cached
    with _cache_lock:
        _cache[key] = cached
        _cache.move_to_end(key)
        while len(_cache) > 64:  # a model has about ten functions, with constants up to 4 MB
            _cache.popitem(last=False)
        return function.copy(swap=dict(zip(empty_shared, shared, strict=True)))


def _structure(
    inputs: Sequence[TensorVariable], outputs: Sequence[TensorVariable], *options: Hashable
) -> tuple[Hashable, ...] | None:
    """Return a key of a graph: options, operations, constants and connections, but no names.

    Graphs with random numbers, operations outside PyTensor or many constants have no key (None).
    """
    number: dict[Variable, int] = {}
    structure = [*options]
    n_bytes = 0  # size of all constants
    for variable in inputs:
        number.setdefault(variable, len(number))
        structure.append(variable.type)
    nodes = toposort(list(outputs), blockers=list(inputs))
    operations = [(node.op, node.inputs, node.outputs) for node in nodes]
    for op, arguments, results in [*operations, ("outputs", outputs, ())]:
        if isinstance(op, Op) and not _is_stateless(op):
            return None
        for variable in arguments:
            if variable in number:
                continue
            data = variable.data if isinstance(variable, Constant) else variable
            if isinstance(data, np.ndarray | np.generic):
                n_bytes += data.nbytes
                data = (data.shape, data.tobytes())
            elif isinstance(data, slice | int | float | None):
                data = repr(data)
            else:
                return None
            number[variable] = len(number)
            structure.append((variable.type, data))
        if n_bytes > 1 << 16:
            return None
        structure.append((op, *[number[variable] for variable in arguments]))
        for variable in results:
            number[variable] = len(number)
    return tuple(structure)


def _is_stateless(op: Op) -> bool:
    """Return whether an operation and those inside it are PyTensor's own, without state."""
    if not type(op).__module__.startswith("pytensor."):
        return False
    parts = [getattr(op, name, None) for name in getattr(op, "__props__", None) or ()]
    return all(map(_is_stateless, [part for part in parts if isinstance(part, Op)]))


def with_shared_arrays(graph: TensorVariable) -> TensorVariable:
    """Replace constant arrays by shared variables, so that other data give the same structure."""
    arrays = {}
    for variable in ancestors([graph]):
        if not isinstance(variable, TensorConstant):
            continue
        values = variable.data
        if values.dtype == np.float64 and values.ndim and values.size:
            shape = [n if n == 1 else None for n in values.shape]
            arrays[variable] = pytensor.shared(values, shape=shape, borrow=True)
    (result,) = clone_replace([graph], arrays, rebuild_strict=False)
    return result


# -- batches ---------------------------------------------------------------------------------------


def ninf_for_invalid(graphs: Sequence[TensorVariable]) -> list[TensorVariable]:
    """Replace PyMC's parameter checks by -inf, so that one invalid theta spoils no batch."""
    from pymc.logprob.utils import CheckParameterValue

    switches = {}
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
    # `pytensor.tensor.tensor` refuses names such as "half" and "double", which are types of NumPy.
    types = [pt.TensorType(s.dtype, shape=(None, *s.type.shape)) for s in symbols]
    return [type_(name=s.name) for type_, s in zip(types, symbols, strict=True)]


def expanded(graphs: list[TensorVariable]) -> list[TensorVariable]:
    """Replace operations that PyTensor makes of others, as logsumexp, by these others.

    PyTensor would loop over the rows of a batch of such an operation.
    """
    parts = {}
    for v in ancestors(graphs):
        if v.owner is None or not isinstance(v.owner.op, OpFromGraph):
            continue
        if isinstance(v.owner.op, SymbolicRandomVariable):
            continue
        inner = v.owner.op.fgraph
        inlined = inner.bind(dict(zip(inner.inputs, v.owner.inputs, strict=True)))
        parts[v] = inlined[v.owner.outputs.index(v)]
    if not parts:
        return graphs
    return expanded(list(graph_replace(graphs, parts, strict=False)))


def compile_batched(
    core_inputs: Sequence[TensorVariable],
    core_outputs: Sequence[TensorVariable],
    extra: Sequence[TensorVariable] = (),
) -> Any:
    """Compile a graph for a batch: core inputs get a leading axis, ``extra`` ones do not."""
    with interpreted():
        outputs = expanded(ninf_for_invalid(core_outputs))
        batched = with_leading_axis(core_inputs)
        vectorized = vectorize_graph(outputs, dict(zip(core_inputs, batched, strict=True)))
        return compiled([*batched, *extra], vectorized, allow_input_downcast=True)


# PyTensor's rules by type of operation, and those below.
_vectorized = singledispatch(lambda op, node, *batched: _vectorize_node(op, node, *batched))


def vectorize_distributions(
    outputs: Sequence[TensorVariable], replace: Mapping[Any, Variable]
) -> list[Any]:
    """Vectorize a graph as PyTensor does, also distributions that PyMC makes of others."""
    vectors = dict(replace)
    for node in toposort(outputs, blockers=list(replace)):
        batched = [vectors.get(v, v) for v in node.inputs]
        if all(old is new for old, new in zip(node.inputs, batched, strict=True)):
            continue
        try:
            result = _vectorized(node.op, node, *batched)
        except NotImplementedError:
            raise TypeError(
                f"inputs: got {str(node.op).partition('{')[0]} with parameters that differ between "
                "specimens, which PyMC cannot make for several specimens at once, expected another "
                "distribution; pass the one from which it is computed, and compute the rest in the "
                "response, or write a pm.CustomDist with logp= and random="
            ) from None
        results = result.outputs if isinstance(result, Apply) else result
        for old, new in zip(node.outputs, results, strict=True):
            vectors.setdefault(old, new)
    return [vectors.get(v, v) for v in outputs]


@_vectorized.register(RandomVariable)
@_vectorized.register(SymbolicRandomVariable)
def _vectorized_distribution(op: Any, node: Any, *batched: Any) -> Any:
    """Return the outputs of a distribution, which PyMC makes with a new size.

    PyTensor cannot add axes to the generators of a distribution that is made of others, and of one
    with a size it reads the first parameter alone.
    """
    if isinstance(op, RandomVariable) and not isinstance(batched[1], TensorVariable):
        return _vectorize_node(op, node, *batched)  # it has no size
    dist = node.default_output()
    n_axes = dist.type.ndim - op.ndim_supp  # axes of an array of independent elements
    core = dict(zip(op.dist_params(node), op.ndims_params, strict=True))
    inputs, batch = [], []
    for old, new in zip(node.inputs, batched, strict=True):
        extra = new.type.ndim - old.type.ndim if old in core else 0
        batch.append(tuple(new.shape[i] for i in range(extra)))
        missing = n_axes - (old.type.ndim - core[old]) if extra else 0
        inputs.append(pt.expand_dims(new, range(extra, extra + missing)) if missing else new)
    shape = (*pt.broadcast_shape(*batch, arrays_are_shapes=True), *dist.type.shape[:n_axes])
    unsized = Apply(op, inputs, [v.type() for v in node.outputs])
    vectorized = change_dist_size(unsized.default_output(), shape)
    return [vectorized if v is dist else v for v in node.outputs]


@_vectorized.register(pm.Truncated.rv_type)
def _vectorized_truncated(op: Any, node: Any, *batched: Any) -> Any:
    *parameters, lower, upper = batched
    base = op.base_rv_op.make_node(*node.inputs[:-2])
    results = _vectorized(base.op, base, *parameters)
    outputs = results.outputs if isinstance(results, Apply) else results
    untruncated = outputs[base.outputs.index(base.default_output())]
    truncated = pm.Truncated.dist(untruncated, lower, upper, max_n_steps=op.max_n_steps)
    return [truncated, *node.outputs[1:]]


# PyMC makes the former with its first parameters, and puts the steps of the latter in front.
@_vectorized.register(CustomSymbolicDistRV)
@_vectorized.register(pm.RandomWalk.rv_type)
@_vectorized.register(pm.LKJCorr.rv_type)
def _refuse(op: Any, *_: Any) -> Any:
    raise NotImplementedError(op)
