"""Inner names of PyMC, PyTensor and ArviZ on which the package relies, tested directly.

`tests/test_house.py` compares the list of these names with the package's imports.
"""

from __future__ import annotations

import inspect
import pickle
import re
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import arviz as az
import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from arviz_plots.plot_collection import PlotCollection
from arviz_stats.ecdf_utils import ecdf_pit
from pymc.backends.base import MultiTrace
from pymc.backends.ndarray import NDArray
from pymc.distributions.censored import CensoredRV
from pymc.distributions.custom import CustomSymbolicDistRV
from pymc.distributions.distribution import SymbolicRandomVariable
from pymc.distributions.multivariate import MvNormal, MvStudentT
from pymc.distributions.shape_utils import change_dist_size
from pymc.distributions.transforms import _default_transform
from pymc.logprob.abstract import ValuedRV, _logprob
from pymc.logprob.utils import CheckParameterValue
from pymc.model.fgraph import clone_model
from pymc.printing import str_for_dist
from pymc.pytensorf import join_nonshared_inputs
from pymc.smc.kernels import SMC_KERNEL, systematic_resampling
from pytensor import shared
from pytensor.compile import function
from pytensor.compile.builders import OpFromGraph
from pytensor.compile.mode import Mode, optdb
from pytensor.compile.ops import ViewOp
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.gradient import NullTypeGradError, disconnected_grad, grad_not_implemented
from pytensor.graph.basic import Apply, Constant, Variable
from pytensor.graph.op import Op
from pytensor.graph.replace import _vectorize_node, clone_replace, graph_replace, vectorize_graph
from pytensor.graph.rewriting.basic import node_rewriter, out2in
from pytensor.graph.rewriting.utils import rewrite_graph
from pytensor.graph.traversal import ancestors, toposort, walk
from pytensor.graph.utils import MissingInputError
from pytensor.scalar.basic import Composite, add
from pytensor.tensor.blockwise import Blockwise
from pytensor.tensor.elemwise import Elemwise
from pytensor.tensor.random.basic import UniformRV
from pytensor.tensor.random.op import RandomVariable
from pytensor.tensor.random.type import RandomGeneratorType
from pytensor.tensor.shape import Shape
from pytensor.tensor.sharedvar import TensorSharedVariable
from pytensor.tensor.subtensor import Subtensor
from pytensor.tensor.variable import TensorConstant, TensorVariable
from pytensor.xtensor.basic import xtensor_from_tensor
from pytensor.xtensor.vectorization import XRV


def test_the_collection_of_arviz_is_that_of_its_plots() -> None:
    assert az.PlotCollection is PlotCollection
    assert {"viz", "add_legend", "savefig"} <= set(dir(PlotCollection))


PLAIN = Mode(linker="py", optimizer="fast_run")


def two_normals() -> pm.Model:
    with pm.Model() as model:
        mu = pm.Normal("mu", 0.0, 1.0)
        pm.HalfNormal("sigma", 2.0)
        pm.Normal("y", mu, 3.0, observed=[1.0, 2.0])
    return model


# Graphs.


def test_a_late_rewrite_sees_a_sum_as_one_operation() -> None:
    visited: list[tuple[bool, int]] = []

    @node_rewriter([Elemwise])
    def look(fgraph: object, node: Apply) -> bool:
        visited.append((node.op.scalar_op.associative, len(node.inputs)))
        return False

    xs = [pt.dvector() for _ in range(5)]
    function(xs, sum(xs[1:], start=xs[0]), mode=PLAIN.register((out2in(look), 1000)))
    assert (True, 5) in visited


def test_shapes_without_draws_in_every_mode() -> None:
    n = shared(np.array([3, 2]), shape=(2,))
    rv = pt.random.normal(pt.scalar("mu"), 1.0, size=n).owner
    _, shape = rv.op.infer_shape(rv, [None, None, *(x.shape for x in rv.inputs[2:])])
    assert [int(size.eval()) for size in shape] == [3, 2]
    assert isinstance(rv.outputs[1].shape.owner.op, Shape)
    bare = Mode(linker="py", optimizer=None)  # that of PyMC's pictures
    assert "minimum_compile" in bare.linker.required_rewrites
    assert "optimize_inner_graph" in {rewriter.name for rewriter in optdb.query("+minimum_compile")}


def test_an_operation_of_others_has_their_graph() -> None:
    x = pt.dvector()
    y = pt.logsumexp(x)
    assert isinstance(y.owner.op, OpFromGraph)
    inner = y.owner.op.fgraph
    (inlined,) = inner.bind(dict(zip(inner.inputs, [2 * x], strict=True)))
    assert not any(isinstance(v.owner.op, OpFromGraph) for v in ancestors([inlined]) if v.owner)
    value = inlined.eval({x: [0.0, 0.0]}, mode=PLAIN)
    assert value == pytest.approx(np.log(2))


def test_an_element_of_each_row_is_a_blockwise_operation() -> None:
    x, i = pt.dvector(), pt.lscalar()
    (element,) = vectorize_graph([x[i]], {x: pt.dmatrix(), i: pt.lvector()})
    op = element.owner.op
    assert isinstance(op, Blockwise)
    assert isinstance(op.core_op, Subtensor)
    assert len(op.core_op.idx_list) == 1
    assert not isinstance(op.core_op.idx_list[0], slice)
    assert op.batch_ndim(element.owner) == 1


def test_variables_of_models_and_of_their_clones() -> None:
    model = two_normals()
    mu, copy = model["mu"], clone_model(model)["mu"]
    assert isinstance(mu, TensorVariable)
    assert isinstance(mu, Variable)
    assert isinstance(mu.owner, Apply)
    assert isinstance(mu.owner.op, Op)
    assert isinstance(mu.owner.op, RandomVariable)
    assert copy.owner is not mu.owner
    assert copy.owner.op is mu.owner.op
    # The operation can be replaced.
    op = mu.owner.op
    loc, scale = op.dist_params(mu.owner)
    assert (loc.eval(mode=PLAIN), scale.eval(mode=PLAIN)) == (0.0, 1.0)
    assert set(RandomVariable.__props__) == {"name", "signature", "dtype", "inplace"}
    mu.owner.op = type(op)(**op._props_dict())
    assert mu.owner.op == op


def test_graphs_of_pymc_dims_are_lowered_to_tensors() -> None:
    import pymc.dims as pmd

    with pm.Model(coords={"part": ["u", "v"]}) as model:
        mu = pmd.Normal("mu", 0, 1, dims="part")
        double = pmd.Deterministic("double", 2 * mu)
    assert isinstance(double.owner.op, ViewOp)
    symbol = pt.dvector("mu")
    assert xtensor_from_tensor(symbol, dims=mu.type.dims).type.dims == ("part",)
    x = pmd.LogNormal.dist(mu.isel(part=0), 1)
    assert isinstance(x.owner.op, XRV)
    (drawn,) = rewrite_graph(clone_replace([x.values]), include=("lower_xtensor",))
    assert isinstance(drawn.owner.op, RandomVariable)
    assert isinstance(x.owner.op, XRV)
    assert not any(hasattr(v.type, "dims") for v in [drawn, *drawn.owner.inputs])
    assert model.rvs_to_values[model["mu"]].type.dims == ("part",)


def test_walk_and_ancestors() -> None:
    x = pt.scalar("x")
    top = pt.exp(x)
    bottom = top + top
    assert list(ancestors([bottom])).count(top) == 1
    visited = list(
        walk([bottom], lambda v: None if v is top or v.owner is None else v.owner.inputs)
    )
    assert top in visited
    assert x not in visited, "nothing is above where None is returned"


def test_order_of_applications_and_values_of_constants() -> None:
    def graph() -> tuple[TensorVariable, TensorVariable]:
        x = pt.dscalar("x")
        return x, pt.exp(x) * 2.0 + pt.log(x)

    found = [[node.op for node in toposort([y], blockers=[x])] for x, y in (graph(), graph())]
    assert found[0] == found[1]
    assert len(found[0]) == 4
    assert found[0][-1] == graph()[1].owner.op, "what is needed comes first"
    (number,) = (v for v in graph()[1].owner.inputs[0].owner.inputs if isinstance(v, Constant))
    assert number.data == 2.0


def test_a_copy_of_a_function_has_its_own_memory_and_shared_variables() -> None:
    x = pt.dvector("x")
    first = function([x], [pt.cumsum(x)], mode=PLAIN)
    second = first.copy()
    (kept,) = first(np.ones(2))
    np.testing.assert_array_equal(second(np.zeros(2))[0], [0, 0])
    np.testing.assert_array_equal(kept, [1, 2])
    empty, mine = shared(np.zeros(0), shape=(None,)), shared(np.arange(3.0), shape=(None,))
    assert all(isinstance(v, TensorSharedVariable) for v in (empty, mine))
    assert mine.default_update is None
    total = function([], [empty.sum()], mode=PLAIN)
    copied = total.copy(swap={empty: mine})
    assert (total()[0], copied()[0]) == (0, 3)
    mine.set_value(np.ones(5))  # another length
    assert copied()[0] == 5


def test_replacement_without_strictness_ignores_absent_variables() -> None:
    x, y, z = pt.dscalar("x"), pt.dscalar("y"), pt.dscalar("z")
    (found,) = graph_replace([x + 1.0], {x: z, y: 2 * z}, strict=False)
    assert found.eval({z: 2.0}, mode=PLAIN) == 3.0


class Batched(Op):
    __props__ = ()

    def make_node(self, x: Any) -> Any:
        return Apply(self, [x], [x.type()])

    def perform(self, node: Any, inputs: Any, outputs: Any) -> None:
        outputs[0][0] = 2 * inputs[0]

    def pullback(self, inputs: Any, outputs: Any, cotangents: Any) -> Any:
        return [grad_not_implemented(self, 0, inputs[0], "none")]


_vectorize_node.register(Batched, lambda op, node, *batched: op.make_node(*batched))


def test_operations_define_their_batches_and_may_have_no_gradient() -> None:
    x, batch = pt.vector("x"), pt.matrix("batch")
    found = vectorize_graph(Batched()(x), {x: batch})
    assert isinstance(found.owner.op, Batched), "one call for the batch, no loop"
    rows = np.arange(6.0).reshape(2, 3)
    total = vectorize_graph(x.sum(), {x: batch})
    np.testing.assert_array_equal(total.eval({batch: rows}, mode=PLAIN), [3, 12])
    with pytest.raises(NullTypeGradError):
        pt.grad(Batched()(x).sum(), x)


def test_distributions_of_others_are_resized_from_their_inputs_and_operation() -> None:
    assert isinstance(pm.LogitNormal.dist(0.0, 1.0).owner.op, CustomSymbolicDistRV)
    node = pm.Weibull.dist(2.0, pt.dscalar()).owner
    assert isinstance(node.op, SymbolicRandomVariable)
    scales = pt.constant([1.0, 1e9])
    inputs = [*node.inputs[:-1], scales]
    unsized = Apply(node.op, inputs, [v.type() for v in node.outputs])
    resized = change_dist_size(unsized.default_output(), (5, 2))
    draws = pm.draw(resized, random_seed=1, mode=PLAIN)
    assert (draws[:, 0] < draws[:, 1]).all()
    assert len(np.unique(draws)) == 10


def test_disconnected_and_missing_inputs() -> None:
    x = pt.dscalar("x")
    slope = pt.grad(x * disconnected_grad(x), x)
    assert slope.eval({x: 3.0}, mode=PLAIN) == 3.0
    with pytest.raises(MissingInputError):
        function([], pt.exp(x), mode=PLAIN)


def test_modes_leave_rewrites_out() -> None:
    x = pt.dvector("x")
    compiled = function([x], pt.exp(x + 1.0), mode=PLAIN.excluding("fusion"))
    assert len(compiled.maker.fgraph.toposort()) >= 2


# Densities.


def test_densities_are_dispatched_on_the_class_of_the_operation() -> None:
    class Flat(RandomVariable):
        name, signature, dtype = "flat", "()->()", "float64"

    @_logprob.register(Flat)
    def density(op: Any, values: Any, rng: Any, size: Any, *params: Any, **kwargs: Any) -> Any:
        (value,) = values
        return value + params[0]

    generator = pt.random.shared_rng(seed=None)
    _, variable = Flat()(2.0, rng=generator, return_next_rng=True)
    assert pm.logp(variable, 5.0).eval(mode=PLAIN) == 7.0


def test_parameters_with_a_value_are_marked_in_densities() -> None:
    class Sum(RandomVariable):
        name, signature, dtype = "sum", "(n)->()", "float64"

    marks = []

    @_logprob.register(Sum)
    def density(op: Any, values: Any, rng: Any, size: Any, *params: Any, **kwargs: Any) -> Any:
        marks.extend(v for v in ancestors(params) if v.owner and isinstance(v.owner.op, ValuedRV))
        return params[0].sum() + values[0]

    with pm.Model() as model:
        parent = pm.Normal("parent", observed=[1.0, 2.0])
        generator = pt.random.shared_rng(seed=None)
        _, child = Sum()(parent, rng=generator, return_next_rng=True)
        model.register_rv(child, "child", observed=4.0)
    assert model.compile_logp(vars=[child], mode=PLAIN)({}) == 7.0
    (mark,) = set(marks)
    assert mark.owner.inputs[0].eval(mode=PLAIN).tolist() == [1.0, 2.0]


def test_parameter_checks_have_the_value_and_then_the_conditions() -> None:
    x = pt.dscalar("x")
    checked = CheckParameterValue("x is positive")(x, pt.gt(x, 0.0))
    value, condition = checked.owner.inputs
    assert value is x
    assert condition.dtype == "bool"
    with pytest.raises(Exception, match="x is positive"):
        checked.eval({x: -1.0}, mode=PLAIN)
    graph = pm.logp(pm.Normal.dist(0.0, x), 1.0)
    applied = [v.owner.op for v in ancestors([graph]) if v.owner is not None]
    assert sum(isinstance(op, CheckParameterValue) for op in applied) == 1


def test_value_variables_and_transforms() -> None:
    model = two_normals()
    assert [value.name for value in model.value_vars] == ["mu", "sigma_log__"]
    mu, log_sigma = model.value_vars
    point = model.initial_point(random_seed=0)
    (found,), theta = join_nonshared_inputs(point, [mu - log_sigma], [mu, log_sigma])
    assert found.eval({theta: [5.0, 2.0]}, mode=PLAIN) == 3.0
    sigma = model.values_to_rvs[log_sigma]
    assert sigma is model["sigma"]
    transform = model.rvs_to_transforms[sigma]
    assert transform.forward(sigma, *sigma.owner.inputs).owner is not None
    assert model.rvs_to_transforms[model["mu"]] is None


def test_default_transforms_have_a_name_and_ends() -> None:
    def transform(x: Any) -> Any:
        return _default_transform(x.owner.op, x)

    between = pm.Truncated.dist(pm.Gamma.dist(2.0, 1.0), 0.2, 3.0)
    low, high = transform(between).args_fn(*between.owner.inputs)
    assert (float(low.data), float(high.data)) == (0.2, 3.0)
    names = {pm.LogNormal: "log", pm.HalfNormal: "log", pm.Beta: "logodds", pm.Uniform: "interval"}
    for distribution, name in names.items():
        parameters = () if distribution is pm.LogNormal else (1.0, 2.0)
        x = distribution.dist(*parameters[: 1 if name == "log" else 2])
        assert transform(x).name == name
    assert transform(pm.Normal.dist()) is None


# Distributions.


def test_random_variables_draw_from_parameters_and_then_the_size() -> None:
    class Recorded(RandomVariable):
        name, signature, dtype = "recorded", "(),()->()", "float64"

        def rng_fn(self, rng: Any, *arguments: Any) -> Any:
            a, b, size = arguments
            assert isinstance(rng, np.random.Generator)
            assert a.shape == b.shape == (1,), "parameters get leading axes of length one"
            return np.full(size, a + b)

    generator = pt.random.shared_rng(seed=None)
    _, variable = Recorded()(1.0, 2.0, size=(4,), rng=generator, return_next_rng=True)
    np.testing.assert_array_equal(variable.eval(mode=PLAIN), np.full(4, 3.0))


def test_a_subclass_of_the_uniform_distribution_has_its_density_and_draws() -> None:
    class ConditionRV(UniformRV):  # type: ignore[misc]
        __props__ = (*UniformRV.__props__, "label")

        def __init__(self, label: str, **keywords: Any) -> None:
            super().__init__(**keywords)
            self.label = label

    _, variable = ConditionRV("load")(
        1.0, 3.0, rng=pt.random.shared_rng(seed=0), return_next_rng=True
    )
    assert pm.logp(variable, 2.0).eval(mode=PLAIN) == pytest.approx(-np.log(2))
    draws = pm.draw(variable, 100, random_seed=1, mode=PLAIN)
    assert ((draws > 1) & (draws < 3)).all()
    assert ConditionRV("load") != ConditionRV("dose")


def test_distributions_have_operations_with_parameters() -> None:
    censored = pm.Censored.dist(pm.Normal.dist(), lower=0.0, upper=None).owner.op
    assert isinstance(censored, CensoredRV)
    assert isinstance(censored, SymbolicRandomVariable)
    assert not isinstance(censored, RandomVariable)
    normal = pm.MvNormal.dist(np.zeros(2), np.eye(2)).owner
    assert isinstance(normal.op, type(MvNormal.rv_op))
    assert [parameter.type.ndim for parameter in normal.op.dist_params(normal)] == [1, 2]
    student = pm.MvStudentT.dist(nu=5.0, mu=np.zeros(2), scale=np.eye(2)).owner
    assert isinstance(student.op, MvStudentT.rv_type)
    assert [parameter.type.ndim for parameter in student.op.dist_params(student)] == [0, 1, 2]


def test_distributions_are_resized_by_leading_axes() -> None:
    many = change_dist_size(pm.Normal.dist(0.0, 1.0, shape=2), (5,), expand=True)
    assert pm.draw(many, random_seed=0, mode=PLAIN).shape == (5, 2)


def test_generators_are_shared_variables_of_a_compiled_function() -> None:
    compiled = pm.compile([], pm.Normal.dist(), mode=PLAIN)
    generators = [v for v in compiled.get_shared() if isinstance(v.type, RandomGeneratorType)]
    assert len(generators) == 1
    draws = []
    for _ in range(2):
        generators[0].set_value(np.random.default_rng(3), borrow=True)
        draws.append(float(compiled()))
    assert draws[0] == draws[1]


def test_distributions_are_printed_with_names_of_parents() -> None:
    model = two_normals()
    text = str_for_dist(model["y"], named_vars={model["mu"]})
    assert re.fullmatch(r"y ~ Normal\(mu, 3\)", text)


# Samplers and statistics.


def test_smc_kernels_have_these_steps() -> None:
    steps = "_initialize_kernel resample mutate sample_stats sample_settings set_rng step"
    for name in [*steps.split(), "update_beta_and_weights", "initialize", "_reset_state"]:
        assert callable(getattr(SMC_KERNEL, name)), name
    assert list(inspect.signature(SMC_KERNEL.initialize).parameters) == ["self", "start", "rng"]


def test_systematic_resampling_keeps_expected_counts() -> None:
    weights = np.array([0.5, 0.25, 0.25, 0.0])
    index = systematic_resampling(weights, np.random.default_rng(0))
    np.testing.assert_array_equal(np.bincount(index, minlength=4), [2, 1, 1, 0])


def test_the_envelope_of_ranks_is_around_the_diagonal() -> None:
    uniform = (np.arange(50) + 0.5) / 50
    x, ecdf, lower, upper = ecdf_pit(uniform, 0.95, n_simulations=200, rng=np.random.default_rng(0))
    assert ((lower <= ecdf) & (ecdf <= upper)).all()
    assert len(x) == len(lower) == len(upper)


def test_pymc_models_have_no_plain_pickle() -> None:
    # PyMC binds a `functools.partial` to models and variables as a method, of which there is none
    # in the class, and which has no name. Should it ever cease to, the Optimum can travel without
    # cloudpickle. Without these two, nothing else stands in the way.
    with pytest.raises(AttributeError, match=r"partial.* has no attribute '__name__'"):
        pickle.dumps(pm.Model())
    with pm.Model() as model:
        a = pm.Normal("a")
        pm.Normal("b", a, observed=[1.0])
    for thing in (model, *model.basic_RVs):
        for name in ("str_repr", "_repr_latex_"):
            vars(thing).pop(name, None)
    back = pickle.loads(pickle.dumps(model))
    densities = [m.compile_logp(mode=PLAIN)({"a": 0.5}) for m in (back, model)]
    assert densities[0] == densities[1]


def test_observed_values_are_constants_or_shared_variables() -> None:
    with pm.Model() as model:
        pm.Normal("y", pm.Normal("a"), observed=[1.0, 2.0])
        data = pm.Data("data", [1.0, 2.0])
        pm.Normal("z", 0, 1, observed=data)
    for copy in (model, clone_model(model), pm.observe(model, {"y": [1.0, 2.0]})):
        value = copy.rvs_to_values[copy["y"]]
        assert isinstance(value, Constant)
        np.testing.assert_array_equal(value.data, [1.0, 2.0])
    assert isinstance(data, SharedVariable)
    assert isinstance(model.rvs_to_values[model["z"]], SharedVariable)
    assert data.get_value().tolist() == [1.0, 2.0]


# Executors.


def test_pools_of_processes_have_their_arguments() -> None:
    context = get_context("spawn")
    with ProcessPoolExecutor(3, context, divmod, (7, 2)) as pool:
        assert {"max_workers", "mp_context", "initializer", "initargs"} <= set(
            inspect.signature(ProcessPoolExecutor).parameters
        )
        assert vars(pool)["_max_workers"] == 3
        assert vars(pool)["_mp_context"] is context
        assert vars(pool)["_initializer"] is divmod
        assert vars(pool)["_initargs"] == (7, 2)
    with ThreadPoolExecutor(2) as threads:
        assert vars(threads)["_max_workers"] == 2


def test_pools_of_loky_have_their_arguments() -> None:
    loky = pytest.importorskip("joblib.externals.loky")
    pool = loky.ProcessPoolExecutor(3, initializer=divmod, initargs=(7, 2))
    (kind, *_) = (k for k in type(pool).__mro__ if k.__name__ == "ProcessPoolExecutor")
    assert issubclass(loky.reusable_executor._ReusablePoolExecutor, kind)
    known = set(inspect.signature(kind).parameters)
    assert {"max_workers", "context", "initializer", "initargs"} <= known
    assert vars(pool)["_max_workers"] == 3
    assert vars(pool)["_initializer"] is divmod
    assert vars(pool)["_initargs"] == (7, 2)
    assert vars(pool)["_context"] is not None
    assert issubclass(loky.BrokenProcessPool, BrokenExecutor)
    pool.shutdown()


@pytest.mark.filterwarnings("ignore::DeprecationWarning:(distributed|dask|tornado).*")
def test_dask_has_threads_by_address_and_a_class_of_losses() -> None:
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address="127.0.0.1:0"
    )
    with cluster, distributed.Client(cluster) as client:
        executor = client.get_executor(pure=False)
        assert vars(executor)["_client"] is client
        ((address, threads),) = client.nthreads().items()
        assert address.startswith("inproc:")
        assert threads == 2
    assert distributed.KilledWorker.__name__ == "KilledWorker"
    assert Path(distributed.cfexecutor.__file__).parts[-2:] == ("distributed", "cfexecutor.py")
    assert not issubclass(distributed.KilledWorker, BrokenExecutor)


def test_mpi_has_a_number_of_workers() -> None:
    futures = pytest.importorskip("mpi4py.futures")
    assert hasattr(futures.MPIPoolExecutor, "num_workers")


def test_traces_of_pymc_take_points_of_value_variables() -> None:
    with pm.Model() as model:
        pm.HalfNormal("sigma")
    trace = NDArray(model=model)
    trace.setup(1, 0)
    trace.record({"sigma_log__": np.asarray(0.0)}, in_warmup=False)
    assert MultiTrace([trace])["sigma"].tolist() == [1.0]


def test_constants_have_subclasses_that_are_evaluated() -> None:
    class Times(TensorConstant):
        pass

    times = Times(pt.dvector().type, np.array([1.0, 2.0]), name="times")
    assert times.name == "times"
    assert (2 * times).eval(mode=Mode(linker="py", optimizer=None)).tolist() == [2.0, 4.0]
    assert times.data.tolist() == times.eval(mode=Mode(linker="py", optimizer=None)).tolist()


def test_composite_operations_have_a_graph() -> None:
    x, y = (pt.dscalar().type.to_scalar_type()() for _ in range(2))
    graph = Composite([x, y], [add(x, y)]).fgraph
    assert [node.op for node in graph.toposort()] == [add]
    assert len(graph.inputs) == 2
