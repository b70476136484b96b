"""The observed variable of a simulator with a metric of distributions, as PyMC evaluates it.

Its operation carries a `Specification`, and from the first use on a `Node`, whose first responses
are computed. The operation is an instance of one class, whose log-density is registered once: a
model that is pickled, cloned, conditioned or sent to another process needs this module alone.
"""

from __future__ import annotations

import logging
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from functools import partial
from inspect import signature
from math import ceil
from traceback import walk_stack
from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
from numpy.typing import NDArray
from pymc.logprob.abstract import _logprob
from pymc.logprob.utils import CheckParameterValue
from pytensor.compile.mode import optdb
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Apply, Constant
from pytensor.graph.op import Op
from pytensor.graph.rewriting.basic import node_rewriter, out2in
from pytensor.graph.traversal import ancestors
from pytensor.tensor.random.op import RandomVariable
from pytensor.tensor.shape import Shape
from pytensor.tensor.variable import TensorVariable

from prbayes._finding import Finding, report
from prbayes._progress import shown
from prbayes._validate import Floats, wrong_value
from prbayes.metrics.area import with_unbiased_areas
from prbayes.metrics.base import Discrepancy, Metric, is_likelihood
from prbayes.metrics.density import with_common_bandwidths
from prbayes.model.data_checks import (
    check_constant,
    check_failing_region,
    duplicate_findings,
    outlier_findings,
    warn_out_of_range,
)
from prbayes.model.locking import lock
from prbayes.model.simulator_with_data import new_observed
from prbayes.numerics.mixtures import effective_sample_size
from prbayes.propagation.base import Bound, Propagation
from prbayes.propagation.reweighted import ReweightedBound, reweighted_of
from prbayes.response.budget import RunCost, duration
from prbayes.response.compile import PLAIN
from prbayes.response.inputs import Inputs, broadcast_batch
from prbayes.response.outputs import SINGLE_OUTPUT, Outputs
from prbayes.response.response import Responses

_log = logging.getLogger("prbayes")


@dataclass(frozen=True, eq=False)
class Node:
    """One simulator of a model, with its first responses."""

    name: str
    target: Discrepancy  # the metric, prepared against the observed responses
    bound: Bound  # the propagation, prepared for this simulator
    propagation: Propagation  # configuration of the propagation
    epsilon: Any  # epsilon as a shared scalar; NaN while it is not set
    specimens: NDArray[Any] | None  # (N,): labels of the specimens
    outputs: Outputs = SINGLE_OUTPUT  # outputs of the response: names, units and shape
    group: str = ""  # name of the group of specimens, empty without groups

    # Attributes that are copied from the target and from the bound.
    metric: Metric = field(init=False)
    observed: Floats = field(init=False)  # measured responses, (N,) or (N, m)
    weights: Floats = field(init=False)  # (N,): weights of the specimens, of sum one
    inputs: Inputs = field(init=False)
    responses: Responses = field(init=False)  # the response, and how it is called
    # Whether responses of a population's specimens are available without further runs.
    has_specimens: bool = field(init=False)
    max_lost: float = field(init=False)  # largest accepted share of a population without response
    # The bound, if it has a design with stored runs.
    reweighted: ReweightedBound | None = field(init=False)

    def __post_init__(self) -> None:
        """Copy the attributes of the target and of the bound."""
        vars(self).update(
            metric=self.target.metric,
            observed=self.target.observed,
            weights=self.target.weights,
            inputs=self.bound.inputs,
            responses=self.bound.responses,
            has_specimens=self.bound.stored,
            max_lost=self.bound.max_lost,
            reweighted=reweighted_of(self.bound),
        )

    def populations(self, parents: Sequence[Floats]) -> tuple[Floats, Floats]:
        """Return responses and weights of populations, (k, n) or (k, n, m) and (k, n)."""
        return self.bound.populations(list(parents))

    def discrepancies(self, parents: Sequence[Floats], target: Discrepancy) -> Floats:
        """Return the discrepancies of populations from a prepared metric, (k,)."""
        return self.bound.discrepancies(parents, target)

    @property
    def epsilon_value(self) -> float:
        """The value of epsilon, NaN while it is not set."""
        return float(self.epsilon.get_value())

    @property
    def n_specimens(self) -> float:
        """Effective number of specimens: repeated observations of a specimen count once."""
        return effective_specimens(self.target, self.specimens)


def with_observed(node: Node, data: Any) -> Node:
    """Return the same simulator with other observed responses; it computes no response.

    It is the same object where the values are the same. Raise TypeError or ValueError if the metric
    does not take the values, or weights or labels belong to another number of them.
    """
    target = node.target
    data = np.asarray(data)
    if np.array_equal(data, target.observed.astype(data.dtype), equal_nan=True):
        return node
    is_aligned = node.specimens is not None or bool(np.ptp(target.weights) > 0)
    values = new_observed(node, data, "specimens= or weights=", is_aligned=is_aligned)
    is_same_size = len(values) == len(target.weights)
    try:
        target = node.metric.against(values, target.weights if is_same_size else None)
    except (TypeError, ValueError) as error:
        raise type(error)(f"{node.name}: {error}") from None
    changed = with_target(node, target.metric.for_inputs(target, node.inputs.dimensions))
    if has_default_epsilon(node):
        changed.epsilon.set_value(np.asarray(1 / changed.n_specimens))
    return changed


def with_target(node: Node, target: Discrepancy) -> Node:
    """Return the same simulator with another prepared metric."""
    bound = node.bound.copied()
    bound.target = target
    return replace(node, target=target, bound=bound)


@dataclass(frozen=True, eq=False)
class Specification:
    """One simulator of a model, before its first use; no response is computed for it."""

    name: str
    target: Discrepancy  # the metric, prepared against the observed responses
    responses: Responses
    propagation: Propagation
    epsilon: Any  # shared scalar; NaN while it is not set
    specimens: NDArray[Any] | None  # (N,): labels of the specimens
    outputs: Outputs = SINGLE_OUTPUT
    group: str = ""
    progressbar: bool = True
    # Simulator that this clone was copied from, and whose runs it takes.
    original: Specification | None = None
    # Simulator with its first responses, set at the first use.
    node: Node | None = field(default=None, init=False)

    @property
    def metric(self) -> Metric:
        """The metric of the target."""
        return self.target.metric

    @property
    def observed(self) -> Floats:
        """Measured responses, (N,) or (N, m)."""
        return self.target.observed


type AnySimulator = Specification | Node


def copied(simulator: AnySimulator) -> AnySimulator:
    """Return the same simulator with its own design, count and epsilon, for a clone of a model."""
    epsilon = shared_epsilon(simulator.name, float(simulator.epsilon.get_value()))
    if isinstance(simulator, Node):
        return replace(simulator, bound=simulator.bound.copied(), epsilon=epsilon)
    return replace(simulator, epsilon=epsilon, original=simulator.original or simulator)


def computed(simulator: AnySimulator) -> Node:
    """Return a simulator with its first responses, which the first call computes.

    After an error, or an interruption, the next call tries again.
    """
    if isinstance(simulator, Node):
        return simulator
    with lock(simulator):
        if simulator.node is not None:
            return simulator.node
        if simulator.original is not None:
            node = computed(simulator.original)
            node = replace(node, bound=node.bound.copied(), epsilon=simulator.epsilon)
        else:
            propagation, target = simulator.propagation, simulator.target
            # The copy counts calls and collects notes. Both are dropped with the copy if an attempt
            # fails.
            responses = simulator.responses.copied()
            responses.runs = simulator.responses.runs
            setting = type(propagation).__name__
            if hasattr(propagation, "n"):
                setting += f"(n={propagation.n})"
            responses.on_start = partial(log_first_runs, propagation.cost, setting, responses)
            outputs = simulator.outputs
            with shown(simulator.progressbar):
                bound = propagation.bind(simulator.name, responses.inputs, target, responses)
                constant = check_constant(
                    simulator.name, bound.first_responses, outputs.names, bound.stored
                )
                bound.target = target.metric.for_inputs(target, bound.inputs.dimensions)
            responses.on_start = None
            warn_out_of_range(simulator.name, target.observed, bound.first_responses, outputs.names)
            findings = check_failing_region(
                simulator.name,
                target.observed,
                bound.first_points,
                bound.first_responses,
                bound.max_lost,
                remedy=simulator.responses.remedy,
            )
            outliers = outlier_findings(
                simulator.name,
                target.observed,
                bound.first_responses,
                outputs.names,
                remedy="use metric=prb.LogLikelihood(gross_errors=True) with the default "
                "propagation",
            )
            bound.findings = report(*constant, *findings, *outliers)
            # Duplicates with labels were reported when the simulator was defined.
            if simulator.specimens is None:
                bound.findings += duplicate_findings(simulator.name, target.observed)
            node = Node(
                simulator.name,
                bound.target,
                bound,
                propagation,
                simulator.epsilon,
                simulator.specimens,
                outputs,
                simulator.group,
            )
        vars(simulator)["node"] = node
        return node


def computed_node(simulator: AnySimulator) -> Node | None:
    """Return a simulator with its first responses; None if they are not computed yet."""
    if isinstance(simulator, Specification) and (simulator.original or simulator).node is None:
        return None
    return computed(simulator)


def log_first_runs(
    cost: RunCost, setting: str, responses: Responses, runs: int, seconds: float
) -> None:
    """Log how many runs there are, and how long they take, from the time of one run, or NaN."""
    if cost.per_theta and np.isnan(seconds):
        return  # the cost is logged after the first call, when its time is known
    responses.on_start = None

    counts = []
    for number in (runs, cost.per_theta):
        total = ceil(number / responses.workers) * seconds
        time = f", about {duration(total)}" if total >= 1 else ", less than 1 s"
        counts.append(f"{number}{time}" if number and not np.isnan(total) else str(number))
    _log.info(
        "%s: runs at first: %s; for each value of the hyperparameters: %s; to change this, pass "
        "another number in propagation=%s; more: %s",
        responses.name,
        *counts,
        setting,
        cost.growth,
    )


# Epsilon, the scale of a discrepancy in the log-density.


def has_default_epsilon(simulator: AnySimulator) -> bool:
    """Return whether epsilon is the default, the 1/N of a metric on a likelihood's scale."""
    target = simulator.target
    epsilon = float(simulator.epsilon.get_value())
    # Normalising the weights a second time changes them by rounding.
    is_default = abs(epsilon * effective_specimens(target, simulator.specimens) - 1) < 1e-12
    return is_likelihood(target) and is_default


def effective_specimens(target: Discrepancy, labels: NDArray[Any] | None) -> float:
    """Return 1 / sum of squared weights of the specimens; without labels, of the observations."""
    if labels is None:
        return target.n_effective
    _, number = np.unique(labels.astype(str), return_inverse=True)
    weights = np.bincount(number.ravel(), target.weights)
    # If all labels differ, the number is the same to the last digit.
    if weights.size == target.weights.size:
        return target.n_effective
    return float(effective_sample_size(weights))


def shared_epsilon(name: str, value: float) -> Any:
    """Return the shared scalar of a simulator's epsilon."""
    return pytensor.shared(np.asarray(value, dtype=np.float64), name=f"{name}_epsilon")


def log_kernel(discrepancy: Any, epsilon: Any) -> Any:
    """Return the log-density of an observed node; the sign of a discrepancy changes only here."""
    return -discrepancy / epsilon


# The operation of an observed variable.


class ObservedRV(RandomVariable):
    """The operation of a simulator's observed variable: draws data sets, and refers to a record.

    Two operations are equal if they refer to the same record: no rewrite of a graph merges others.

    PyTensor's rewriters keep every operation that they have met. The record, with all stored
    responses, is therefore referenced by applications of the operation, which live as long as a
    model or a compiled function, and weakly by the operation itself.
    """

    __props__ = ("name", "signature", "dtype", "inplace", "reference", "simulators")

    def __init__(
        self,
        name: str | None = None,
        signature: str | None = None,
        dtype: str = "floatX",
        inplace: bool = False,
        *,
        reference: weakref.ref[Any],
        simulators: tuple[str, ...],
    ) -> None:
        self.reference = reference
        # Names of the simulators with the same specimens; this simulator is the last one.
        self.simulators = simulators
        label = "Simulator of {} by {}".format(*self._response_and_metric)
        super().__init__(name=name or label, signature=signature, dtype=dtype, inplace=inplace)

    @property
    def record(self) -> Any:
        """The record that applications of the operation reference."""
        record = self.reference()
        if record is None:
            raise RuntimeError(
                f"{self}: got an operation of a model that was deleted, expected one with its "
                "model; build the model again"
            )
        return record

    @property
    def simulator(self) -> Any:
        """The simulator of the observed variable."""
        return self.record

    @property
    def _response_and_metric(self) -> tuple[str, str]:
        """Names of the response and of the metric's class."""
        simulator = self.simulator
        return response_name(simulator.responses.function), type(simulator.metric).__name__

    @property
    def _print_name(self) -> tuple[str, str]:
        """The name that PyMC prints for a distribution, as text and as LaTeX."""
        text = ", ".join(self._response_and_metric)
        latex = text.replace("_", "\\_")
        return f"Simulator[{text}]", f"\\operatorname{{Simulator}}[\\text{{{latex}}}]"

    def make_node(self, *inputs: Any, **keywords: Any) -> Apply[Any, Any]:
        """Apply the operation; the application, and its copies, reference the record."""
        apply = super().make_node(*inputs, **keywords)
        apply.tag.record = self.record
        return apply

    def assign(self, apply: Apply[Any, Any], record: Any) -> None:
        """Give an application in a model an operation of its own, which refers to a record."""
        apply.op = type(self)(**{**self._props_dict(), "reference": weakref.ref(record)})
        apply.tag.record = record

    def __str__(self) -> str:
        """Show the name and the signature, without the simulator."""
        return f'prbayes_Simulator_rv{{"{self.signature}"}}'

    def __getstate__(self) -> dict[str, Any]:
        """Replace the weak reference by the record, since weak references have no pickle."""
        return {**self.__dict__, "reference": self.record}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the weak reference; the application keeps the record alive."""
        self.__dict__.update(state)
        self.reference = weakref.ref(state["reference"])

    def _supp_shape_from_params(self, dist_params: Any, param_shapes: Any = None) -> Any:
        """Return the shape of one draw: the number of outputs of a specimen."""
        return [pt.constant(n, dtype="int64") for n in self.simulator.outputs.event]


class SimulatorRV(ObservedRV):
    """The operation of a simulator with a metric of distributions; its record is the simulator.

    The simulator is a `Specification` until `nodes` computes its first responses.
    """

    # Application of this operation in the model, as a weak reference.
    owner: weakref.ref[Any] | None = None
    _warned = False

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the owner, because a copy that is unpickled belongs to another model."""
        return {**super().__getstate__(), "owner": None}

    def assign(self, apply: Apply[Any, Any], record: Any) -> None:
        """Give an application in a model an operation of its own, which refers to a record."""
        super().assign(apply, record)
        apply.op.owner = weakref.ref(apply)

    def rng_fn(self, rng: np.random.Generator, *arguments: Any) -> Floats:
        """Draw responses of specimens; their shape is the last of the arguments."""
        *matched, name = self.simulators
        if matched and not self._warned:
            self._warned = True
            report(
                Finding(
                    "independent-draws",
                    f"{name} and {', '.join(matched)} have the inputs of the same specimens, but "
                    "PyMC's predictive sampling draws each variable independently: use "
                    "prb.predict for responses of the same specimens.",
                )
            )
        *params, size = arguments
        bound = computed(self.simulator).bound
        target = bound.target
        event = target.event
        ndims = [parent.type.ndim for parent in bound.inputs.parents]
        batch, params = broadcast_batch(params, ndims)
        values = np.empty((*(batch if size is None else size), *event))
        # Each element of a batch is a population. Its specimens are along axes of length one.
        for index in np.ndindex(batch):
            places = tuple(slice(None) if n == 1 else i for i, n in zip(index, batch, strict=True))
            shape = values[places].shape
            size_of_one = len(target.observed) * int(np.prod(event, dtype=int))
            n_specimens = int(np.prod(shape, dtype=int)) * target.n_drawn // size_of_one
            parents = [param[index] for param in params]
            drawn = bound.draw(rng, n_specimens, parents)
            if target.metric.exact_likelihood:
                drawn = target.replicate(drawn.reshape(-1, target.n_drawn, *event))
            values[places] = drawn.reshape(shape)
        return values


def response_name(function: Any, output: Any = None) -> str:
    """Return the name of a response, or the arguments of a lambda function; of one output."""
    if output is not None:
        name = response_name(function)
        return f"{name}[{output}]"
    inner = getattr(function, "function", function)  # unwrap a function that `scalar` has wrapped
    name = str(getattr(inner, "__name__", type(inner).__name__))
    if name != "<lambda>":
        return name
    return f"lambda({', '.join(signature(inner).parameters)})"


# The log-density.

# Terms for which densities are built. PyMC builds the densities of all variables even if only a
# part of the terms is asked for.
TERMS: ContextVar[str] = ContextVar("terms that are built", default="all")


@contextmanager
def building(terms: str) -> Iterator[None]:
    """Build densities of some terms: of the "priors" alone likelihoods by specimen are left out."""
    token = TERMS.set(terms)
    try:
        yield
    finally:
        TERMS.reset(token)


@_logprob.register(SimulatorRV)  # type: ignore[untyped-decorator]
def _metric_log_density(
    op: SimulatorRV, values: Any, rng: Any, size: Any, *params: Any, **kwargs: Any
) -> TensorVariable:
    """Return the log-density of the observed data, a graph of the parents and of epsilon.

    The graph is empty for `pymc.compute_log_likelihood`, because the log-density is not a sum over
    specimens.
    """
    if pm.compute_log_likelihood.__code__ in [frame.f_code for frame, _ in walk_stack(None)]:
        text = (
            f"{op.simulator.name}: its log-likelihood is empty, as a metric has one number for all "
            "specimens and az.loo needs one for each; use "
            "prb.cross_validate, prb.rank, or a simulator without metric=."
        )
        report(Finding("no-log-likelihood", text, "pymc_and_arviz.md#arviz"))
        return pt.zeros(0)
    (value,) = values
    data = known_value(value)
    node = computed(op.simulator)
    if data is not None:
        node = with_observed(node, data)
    if node.reweighted is not None and node.responses.may_differ:
        node.reweighted.values_of(node.responses)  # raises after a change
    unset = Finding(
        "epsilon-unset",
        f"{node.name}: epsilon is not set; call prb.set_epsilon(model, "
        "prb.calibrate_epsilon(prb.minimize(model))), pass epsilon= to prb.Simulator, or use "
        "prb.sample_smc, which calibrates it.",
        "choose.md#epsilon-and-the-width-of-the-posterior",
    )
    if np.isnan(node.epsilon_value):
        report(unset, level=logging.DEBUG)
        # Raise at once for nutpie, which would show only the number of a later error. Other
        # samplers show the message themselves.
        modules = [str(frame.f_globals.get("__name__")) for frame, _ in walk_stack(None)]
        if any(module.partition(".")[0] == "nutpie" for module in modules):
            raise ValueError(str(unset))
    epsilon = CheckParameterValue(str(unset))(node.epsilon, pt.gt(node.epsilon, 0.0))
    density = log_kernel(node.bound.discrepancy(node.bound.inputs.core(params)), epsilon)
    if isinstance(value, Constant):
        return density
    return require_data(
        node.name,
        "against which its metric is prepared",
        density,
        equal_data(value, node.target.observed),
    )


def equal_data(value: Any, observed: Floats) -> Any:
    """Return the graph of whether values are the observed ones."""
    data = observed.astype(value.dtype)
    first = value[: len(data)]
    equal = pt.eq(first, data)
    if np.isnan(data).any():
        equal = equal | (pt.isnan(first) & np.isnan(data))
    return pt.eq(value.shape[0], len(data)) & pt.all(equal)


def require_data(name: str, use: str, density: Any, condition: Any) -> TensorVariable:
    """Return a density that raises where the data are not those that it was prepared for."""
    return CheckParameterValue(
        f"{name}: got other observed values than when this was compiled, expected "
        f"the same ones, {use}; compile it again, as pm.sample, prb.minimize "
        "and prb.sample_smc do"
    )(density, condition)


def known_value(value: Any) -> Any:
    """Return the numbers of observed values that a model holds, as `pymc.Data`; else None."""
    if isinstance(value, Constant):
        return value.data
    if isinstance(value, SharedVariable):
        return value.get_value()
    leaves = [v for v in ancestors([value]) if v.owner is None]
    if all(isinstance(leaf, Constant | SharedVariable) for leaf in leaves):
        return value.eval(mode=PLAIN)  # such as whole numbers after a cast to floats
    return None


@node_rewriter([Shape])  # type: ignore[untyped-decorator]
def shape_without_draw(fgraph: Any, apply: Apply[Any, Any]) -> list[Any] | None:
    """Return the shape of a simulator's variable without a draw, which would compute responses."""
    rv = apply.inputs[0].owner
    if rv is None or not isinstance(rv.op, SimulatorRV):
        return None
    parameters = [variable.shape for variable in rv.inputs[2:]]
    _, shape = rv.op.infer_shape(rv, [None, None, *parameters])
    return [pt.stack([pt.cast(size, "int64") for size in shape])]


# The rewrite is part of all modes, because pictures of a model compile shapes without any other
# rewrite.
optdb.register("prbayes_shape", out2in(shape_without_draw), "minimum_compile", position=0)


class SimulatorDistribution(pm.Distribution):
    """The distribution that PyMC makes the observed variable from."""

    rv_type = ObservedRV

    @classmethod
    def rv_op(
        cls, *params: Any, operation: ObservedRV, size: Any = None, rng: Any = None
    ) -> TensorVariable:
        """Return a random variable of an operation."""
        generator = pt.random.shared_rng(seed=None) if rng is None else rng
        _, rv = operation(*params, size=size, rng=generator, return_next_rng=True)
        return rv

    @classmethod
    def dist(cls, *params: Any, **kwargs: Any) -> TensorVariable:
        """Return a random variable outside a model."""
        return super().dist(params, **kwargs)

    @staticmethod
    def support_point(rv: TensorVariable, size: Any, *params: Any) -> TensorVariable:
        """Return where a sampler would start, were the variable not observed."""
        return pt.zeros_like(rv)


def rv_signature(ndims: Sequence[int], ndim_supp: int) -> str:
    """Return the signature of a random variable, such as '(),(i10,i11)->()', or '->(o)'."""
    groups = []
    for k, ndim in enumerate(ndims):
        axes = [f"i{k}{axis}" for axis in range(ndim)]
        groups.append(f"({','.join(axes)})")
    return ",".join(groups) + ("->(o)" if ndim_supp else "->()")


def simulators(model: pm.Model) -> dict[Any, AnySimulator]:
    """Return the simulators of a model, computed or not, by their observed variables.

    In a clone they are copies with their own design, count and epsilon, which the first call makes.
    """
    if not isinstance(model, pm.Model):
        raise wrong_value(model, "model", "a pm.Model")
    by_variable = {}
    for rv in model.observed_RVs:
        apply = rv.owner
        if isinstance(apply.op, SimulatorRV):
            if apply.op.owner is None:
                apply.op.owner = weakref.ref(apply)
            # A clone of a model shares the operation with its original, and gets a copy of the
            # simulator.
            if apply.op.owner() is not apply:
                apply.op.assign(apply, copied(apply.op.simulator))
            by_variable[rv] = apply.op.simulator
    return by_variable


def nodes(model: pm.Model) -> dict[Any, Node]:
    """Return the simulators of a model with their first responses, by observed variable.

    The first call computes the first responses. In a clone it makes copies. Where `pymc.set_data`
    or `pymc.observe` changed the data, the metric is prepared again for the same responses.
    """
    by_variable = {}
    for rv, simulator in simulators(model).items():
        node = with_observed(computed(simulator), known_value(model.rvs_to_values[rv]))
        if node is not simulator:
            rv.owner.op.assign(rv.owner, node)
        by_variable[rv] = node
    computed_nodes = list(by_variable.values())
    targets = common_targets(computed_nodes, [node.target for node in computed_nodes])
    for (rv, node), target in zip(by_variable.items(), targets, strict=True):
        if target is not node.target:
            by_variable[rv] = with_target(node, target)
            rv.owner.op.assign(rv.owner, by_variable[rv])
    return by_variable


def common_targets(
    simulators: Sequence[AnySimulator], targets: Sequence[Discrepancy]
) -> list[Discrepancy]:
    """Return the prepared metrics of simulators, of which several are added.

    Those of one response share a bandwidth, and areas have no bias.
    """
    responses, conditions = [], []
    for simulator in simulators:
        calls, group = simulator.responses, simulator.group
        of_response = (s.responses.function is calls.function for s in simulators)
        of_condition = (s.group == group and s.responses.same_as(calls) for s in simulators)
        responses.append(next(k for k, is_same in enumerate(of_response) if is_same))
        conditions.append(next(k for k, is_same in enumerate(of_condition) if is_same))
    result = with_common_bandwidths(targets, responses, conditions)
    return [with_unbiased_areas(target) for target in result] if len(result) > 1 else result


def share_bandwidths(model: pm.Model) -> None:
    """Prepare metrics again that share a bandwidth with a new simulator.

    The next call of `nodes` does this for simulators in use.
    """
    present = list(simulators(model).values())
    targets = common_targets(present, [simulator.target for simulator in present])
    for simulator, target in zip(present, targets, strict=True):
        if isinstance(simulator, Specification) and simulator.node is None:
            vars(simulator)["target"] = target


class abc_distance(Op):  # noqa: N801 (reads as a function in a model)
    """Turn a metric into the ``distance=`` of a stock `pymc.Simulator`.

    Parameters
    ----------
    metric : Metric

    Raises
    ------
    TypeError
        If ``metric`` is not a metric object.

    Notes
    -----
    `pymc.Simulator` draws new responses at every evaluation, each given to all observations;
    numbers of simulated and observed responses may differ. A simulated sample with NaN has
    log-density -inf. A metric compares samples of specimens; one time series is no sample.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> def simulate(rng, mu, size):
    ...     return rng.normal(mu, 1.0, size=500)
    >>> with pm.Model() as model:
    ...     distance = prb.abc_distance(prb.AreaMetric())
    ...     y = pm.Simulator("y", simulate, pm.Normal("mu"), distance=distance,
    ...                      epsilon=0.02, observed=np.array([0.5, 1.0, 4.0]))
    """

    __props__ = ("metric",)
    gufunc_signature = "(),(n),(m)->()"

    def __init__(self, metric: Metric) -> None:
        if not isinstance(metric, Metric):
            raise wrong_value(metric, "abc_distance", "a metric object such as prb.AreaMetric()")
        self.metric = metric
        self._prepared: tuple[Floats, Discrepancy] | None = None

    def make_node(self, epsilon: Any, observed: Any, simulated: Any) -> Apply[Any, Any]:
        """Apply to epsilon and the two samples."""
        tensors = [pt.as_tensor(v) for v in (epsilon, observed, simulated)]
        return Apply(self, tensors, [pt.dscalar()])

    def perform(self, node: Any, inputs: Sequence[Any], outputs: Any) -> None:
        """Return the log-density; the observed side is prepared once."""
        epsilon, observed, simulated = inputs
        if self._prepared is None or not np.array_equal(self._prepared[0], observed):
            self._prepared = (np.array(observed), self.metric.against(observed))
        _, target = self._prepared
        value = -np.inf
        if not (np.isnan(simulated) | np.isneginf(simulated)).any():
            value = log_kernel(target(simulated), epsilon)
        outputs[0][0] = np.asarray(value, dtype=np.float64)
