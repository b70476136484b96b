"""What a simulator is inside a PyMC model.

A `Specification`, carried by the operation of an observed variable, and from the first use on a
`Node`, whose first responses are computed.

The operation is an instance of one class, `SimulatorRV`, whose log-density is registered once: a
model that is pickled, cloned, conditioned or sent to another process needs nothing else than this
module.
"""

from __future__ import annotations

import logging
import sys
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import cached_property, partial
from inspect import signature
from math import ceil
from typing import Any, ClassVar, Literal

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
from pytensor.graph.rewriting.basic import node_rewriter, out2in
from pytensor.graph.traversal import ancestors
from pytensor.tensor.random.op import RandomVariable
from pytensor.tensor.shape import Shape
from pytensor.tensor.variable import TensorVariable

from prbayes._finding import Finding, report
from prbayes._progress import shown
from prbayes._validate import Floats, called
from prbayes.metrics.base import Discrepancy, Metric, is_likelihood
from prbayes.model.first_look import tell_far_data
from prbayes.model.locking import lock
from prbayes.propagation.base import Bound, Propagation
from prbayes.propagation.reweighted import ReweightedBound, reweighted_of
from prbayes.response.budget import duration
from prbayes.response.compile import PLAIN
from prbayes.response.inputs import Inputs
from prbayes.response.outputs import ONE, Outputs
from prbayes.response.response import Responses

_log = logging.getLogger("prbayes")


@dataclass(frozen=True, eq=False)
class Node:
    """One simulator of a model."""

    name: str
    target: Discrepancy  # the metric, prepared against the observed responses
    bound: Bound  # the propagation at work
    propagation: Propagation  # its configuration
    epsilon: Any  # scalar; NaN while it is not set
    # (N,), or None: labels of the specimens that the observed responses were measured on.
    specimens: NDArray[Any] | None
    # Names of the simulators before it in the model that have a ``.dist()`` of its inputs.
    same_inputs: tuple[str, ...] = ()
    outputs: Outputs = ONE  # of a run
    group: str = ""  # the name of the group whose specimens it has, if it is of one

    is_emulated: ClassVar[Literal[False]] = False

    @property
    def metric(self) -> Metric:
        """The calibration metric."""
        return self.target.metric

    @property
    def node(self) -> Node:
        """The simulator itself, as `Specification.node` is."""
        return self

    @property
    def is_computed(self) -> bool:
        """Whether the first responses are computed."""
        return True

    @property
    def responses(self) -> Responses:
        """The response, and how it is called."""
        return self.bound.responses

    @property
    def observed(self) -> Floats:
        """Measured responses, (N,) or (N, m)."""
        return self.target.observed

    @property
    def weights(self) -> Floats:
        """Weights of the specimens, (N,), which sum to one."""
        return self.target.weights

    @property
    def inputs(self) -> Inputs:
        """The inputs of the response."""
        return self.bound.inputs

    @property
    def has_specimens(self) -> bool:
        """Whether specimens of all populations are there without a run."""
        return self.bound.stored

    @property
    def runs_per_theta(self) -> int:
        """Runs that a population costs."""
        return self.bound.n_per_theta

    @property
    def max_lost(self) -> float:
        """Largest share of a population that may have no response."""
        return self.bound.max_lost

    def populations(self, roots: Sequence[Floats]) -> tuple[Floats, Floats]:
        """Return responses and weights of populations, (k, n) or (k, n, m) and (k, n)."""
        return self.bound.populations(list(roots))

    @property
    def reweighted(self) -> ReweightedBound | None:
        """The propagation with its design, None where it stores no responses."""
        return reweighted_of(self.bound)

    @property
    def epsilon_value(self) -> float:
        """The value of epsilon, NaN while it is not set."""
        return float(self.epsilon.get_value())

    @property
    def epsilon_is_default(self) -> bool:
        """Whether nobody gave epsilon: it is the 1/N of a metric on a likelihood's scale."""
        return has_default_epsilon(self)

    @property
    def n_specimens(self) -> float:
        """Effective number of specimens: repeated observations of one are no further ones."""
        return effective_specimens(self.target, self.specimens)

    def observing(self, values: Floats) -> Node:
        """Return the same simulator with other observed responses; it computes nothing anew.

        Raises
        ------
        TypeError, ValueError
            If the metric does not take them, or weights or labels go with as many as before.
        """
        before = self.target
        values = np.asarray(values, dtype=np.float64)
        if values.shape[1:] != before.event or values.ndim != before.observed.ndim:
            raise ValueError(
                f"{self.name}: observed: got shape {values.shape}, expected "
                f"{('N', *before.event)}, as when the simulator was made"
            )
        weights: Floats | None = before.weights
        n = len(before.weights)
        if len(values) != n:
            # What goes with the values before has no counterpart.
            if self.specimens is not None or np.ptp(before.weights) > 0:
                raise ValueError(
                    f"{self.name}: observed: got {len(values)} specimens, expected "
                    f"{n}, as many as there are specimens= or weights=; build the "
                    "model again with those of the new ones"
                )
            weights = None
        try:
            target = self.metric.against(values, weights)
        except (TypeError, ValueError) as error:
            raise type(error)(f"{self.name}: {error}") from None
        bound = self.bound.copied()
        dimensions = bound.inputs.dimensions
        bound.target = target.metric.beside(target, bound.first_responses, dimensions)
        other = replace(self, target=bound.target, bound=bound)
        if self.epsilon_is_default:
            other.epsilon.set_value(np.asarray(1 / other.n_specimens))
        return other

    def copied(self) -> Node:
        """Return the same simulator with its own design, count of responses and epsilon."""
        epsilon = shared_epsilon(self.name, self.epsilon_value)
        return replace(self, bound=self.bound.copied(), epsilon=epsilon)


@dataclass(frozen=True, eq=False)
class Specification:
    """One simulator of a model, before its first use; no response is computed for it."""

    name: str
    target: Discrepancy  # the metric, prepared against the observed responses
    responses: Responses  # which stay as they are
    propagation: Propagation
    epsilon: Any  # scalar; NaN while it is not set
    specimens: NDArray[Any] | None  # (N,): labels
    same_inputs: tuple[str, ...] = ()
    outputs: Outputs = ONE
    group: str = ""
    progressbar: bool = True
    original: Specification | None = None  # of a clone, which takes the runs of the original

    @property
    def node(self) -> Node:
        """The simulator, with its first responses: the first access computes them.

        After an error, or an interruption, the next access tries again.

        Raises
        ------
        BudgetError, ResponseError, StoreError
            If the first responses cannot be computed.
        TypeError, ValueError
            If the propagation does not take the inputs or their priors.
        """
        with lock(self):
            return self._node

    @property
    def is_computed(self) -> bool:
        """Whether the first responses are computed."""
        return "_node" in vars(self.original or self)

    @cached_property
    def _node(self) -> Node:
        if self.original is not None:
            return replace(self.original.node.copied(), epsilon=self.epsilon)
        # What an attempt that fails counts and notes is dropped with it.
        responses = self.responses.copied()
        responses.runs = self.responses.runs
        responses.on_start = partial(_log_first_runs, self.propagation, responses)
        with shown(self.progressbar):
            bound = self.propagation.bind(self.name, responses.inputs, self.target, responses)
            dimensions = bound.inputs.dimensions
            metric = self.target.metric
            bound.target = metric.beside(self.target, bound.first_responses, dimensions)
        responses.on_start = None
        tell_far_data(self.name, self.target.observed, bound.first_responses, self.outputs.names)
        return Node(
            self.name,
            bound.target,
            bound,
            self.propagation,
            self.epsilon,
            self.specimens,
            self.same_inputs,
            self.outputs,
            self.group,
        )

    def copied(self) -> Specification:
        """Return the same simulator with its own epsilon, for a clone of the model."""
        epsilon = shared_epsilon(self.name, float(self.epsilon.get_value()))
        return replace(self, epsilon=epsilon, original=self.original or self)


type AnySimulator = Specification | Node


def _log_first_runs(
    propagation: Propagation, responses: Responses, runs: int, seconds: float
) -> None:
    """Log how many runs there are, and how long they take, from the time of one run, or NaN."""
    cost = propagation.cost
    if cost.each and np.isnan(seconds):
        return  # known after the first call
    responses.on_start = None

    def with_duration(number: int) -> str:
        total = ceil(number / responses.workers) * seconds
        if not number or np.isnan(total):
            return str(number)
        return f"{number}, {f'about {duration(total)}' if total >= 1 else 'less than 1 s'}"

    setting = type(propagation).__name__
    if hasattr(propagation, "n"):
        setting += f"(n={propagation.n})"
    _log.info(
        "%s: runs at first: %s; for each value of the hyperparameters: %s; to change this, pass "
        "another number in propagation=%s; more: %s",
        responses.name,
        with_duration(runs),
        with_duration(cost.each),
        setting,
        cost.growth,
    )


def has_default_epsilon(simulator: AnySimulator) -> bool:
    """Return whether nobody gave epsilon: it is the 1/N of a metric on a likelihood's scale."""
    target = simulator.target
    epsilon = float(simulator.epsilon.get_value())
    # Weights that were normalised again differ by rounding.
    is_default = abs(epsilon * effective_specimens(target, simulator.specimens) - 1) < 1e-12
    return is_likelihood(target) and is_default


def effective_specimens(target: Discrepancy, labels: NDArray[Any] | None) -> float:
    """Return 1 / sum of squared weights of the specimens; without labels, of the observations."""
    if labels is None:
        return target.n_effective
    _, number = np.unique(labels.astype(str), return_inverse=True)
    weights = np.bincount(number.ravel(), target.weights)
    # All different: the same number to the last digit.
    if weights.size == target.weights.size:
        return target.n_effective
    return float(1 / (weights**2).sum())


def shared_epsilon(name: str, value: float) -> Any:
    """Return the shared scalar that holds a simulator's epsilon."""
    return pytensor.shared(np.asarray(value, dtype=np.float64), name=f"{name}_epsilon")


def log_kernel(discrepancy: Any, epsilon: Any) -> Any:
    """Return the log-density of an observed node.

    The only place where the sign of a discrepancy changes.
    """
    return -discrepancy / epsilon


class SimulatorRV(RandomVariable):
    """The operation of an observed variable: draws data sets, and carries its simulator.

    Two of them are equal if they carry the same simulator, so that no rewrite of a graph takes one
    for another.

    PyTensor's rewriters remember every operation that they have met, as long as the process lasts.
    So the simulator, with all stored responses, is held by the applications of the operation, which
    live as long as a model or a compiled function, and not by the operation itself.

    Attributes
    ----------
    simulator : Specification or Node
        No response is computed for it; a specification before `nodes` was asked for it.
    node : Node
        The first access computes its first responses.
    """

    __props__ = ("name", "signature", "dtype", "inplace", "simulator")

    def __init__(
        self,
        name: str | None = None,
        signature: str | None = None,
        dtype: str = "floatX",
        inplace: bool = False,
        *,
        simulator: AnySimulator,
    ) -> None:
        # What pictures of the model show.
        response = response_name(simulator.responses.function)
        told = f"Simulator of {response} by {type(simulator.target.metric).__name__}"
        super().__init__(name=name or told, signature=signature, dtype=dtype, inplace=inplace)
        self._simulator = weakref.ref(simulator)
        self._owner: weakref.ref[Any] | None = None
        self._warned = False

    @property
    def simulator(self) -> AnySimulator:
        """The simulator, as far as it is computed."""
        simulator = self._simulator()
        if simulator is None:
            raise RuntimeError(f"{self}: got an operation of a model that is gone")
        return simulator

    @property
    def node(self) -> Node:
        """The simulator with its first responses."""
        return self.simulator.node

    def __eq__(self, other: object) -> bool:
        """Return whether it is of the same simulator, and applied alike."""
        return type(self) is type(other) and self._told() == other._told()

    def __hash__(self) -> int:
        """Return a number that stays when the simulator is gone."""
        return hash((type(self), self.name, self.signature, self.dtype, self.inplace))

    def _told(self) -> tuple[Any, ...]:
        return self.name, self.signature, self.dtype, self.inplace, self._simulator

    def make_node(self, *inputs: Any, **keywords: Any) -> Apply[Any, Any]:
        """Apply the operation; copies of the application hold the simulator as well."""
        apply = super().make_node(*inputs, **keywords)
        apply.tag.simulator = self.simulator
        return apply

    def __str__(self) -> str:
        """Show the name and the signature, without what the simulator holds."""
        return f'prbayes_Simulator_rv{{"{self.signature}"}}'

    @property
    def _print_name(self) -> tuple[str, str]:
        """What PyMC prints for the distribution, as text and as LaTeX."""
        response = response_name(self.simulator.responses.function)
        told = f"{response}, {type(self.simulator.target.metric).__name__}"
        latex = told.replace("_", "\\_")
        return f"Simulator[{told}]", f"\\operatorname{{Simulator}}[\\text{{{latex}}}]"

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the owner: a copy that is unpickled belongs to a model of its own."""
        return {**self.__dict__, "_owner": None, "_simulator": self.simulator}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take what was left in."""
        self.__dict__.update(state)
        self._simulator = weakref.ref(state["_simulator"])

    def own_simulator(self, apply: Apply[Any, Any]) -> AnySimulator:
        """Return the simulator that belongs to an application of this operation in a model.

        Clones of a model share the operation with the original. Each is then given one of its own,
        whose design, count and epsilon are copies: what is refined or set there leaves the original
        alone.
        """
        if self._owner is None:
            self._owner = weakref.ref(apply)
        if self._owner() is apply:
            return self.simulator
        simulator = self.simulator.copied()
        self.assign(apply, simulator)
        return simulator

    def assign(self, apply: Apply[Any, Any], simulator: AnySimulator) -> None:
        """Give an application in a model an operation of its own, which carries a simulator."""
        own = SimulatorRV(**{**self._props_dict(), "simulator": simulator})
        own._owner = weakref.ref(apply)
        apply.op = own
        apply.tag.simulator = simulator

    def rng_fn(self, rng: np.random.Generator, *arguments: Any) -> Floats:
        """Draw responses of specimens; their shape is the last of the arguments."""
        self._warn_of_independence()
        *params, size = arguments
        bound = self.node.bound
        event = self.node.target.event
        batches = []
        for root, param in zip(bound.inputs.roots, params, strict=True):
            leading = param.ndim - root.type.ndim
            batches.append(param.shape[:leading])
        batch = np.broadcast_shapes(*batches)
        values = np.empty((*(batch if size is None else size), *event))
        # One population for each element of a batch of parameters: commonly there is one.
        for index in np.ndindex(batch):
            pairs = zip(params, batches, strict=True)
            at = [param[_own_index(index, own)] for param, own in pairs]
            places = _places(index, batch)
            there = values[places]
            n = there.size // int(np.prod(event, dtype=int))
            drawn = bound.draw(rng, n, at)
            values[places] = drawn.reshape(there.shape)
        return values

    def _supp_shape_from_params(self, dist_params: Any, param_shapes: Any = None) -> Any:
        """Return how many outputs a specimen has."""
        return [pt.constant(n, dtype="int64") for n in self.simulator.target.event]

    def _warn_of_independence(self) -> None:
        """Say once that PyMC draws each variable by itself."""
        others = self.simulator.same_inputs
        if not others or self._warned:
            return
        self._warned = True
        report(
            Finding(
                "independent-draws",
                f"{self.simulator.name} has inputs that {', '.join(others)} has too, the same "
                "specimens; PyMC's predictive sampling draws each variable by itself, and so "
                "as independent of the others: use prb.predict for responses of the same "
                "specimens.",
            )
        )


def response_name(function: Any) -> str:
    """Return what a response is called, or else what it is of."""
    inner = getattr(function, "function", function)  # of what `scalar` wraps
    name = str(getattr(inner, "__name__", type(inner).__name__))
    if name != "<lambda>":
        return name
    return f"lambda({', '.join(signature(inner).parameters)})"


def _own_index(index: tuple[int, ...], shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return where an array of this leading shape is read, for an index after broadcasting."""
    last = index[len(index) - len(shape) :]
    pairs = zip(last, shape, strict=True)
    return tuple(0 if n == 1 else i for i, n in pairs)


def _places(index: tuple[int, ...], batch: tuple[int, ...]) -> tuple[int | slice, ...]:
    """Return where the values for an index of a batch stand: all along its axes of length one."""
    pairs = zip(index, batch, strict=True)
    return tuple(slice(None) if n == 1 else i for i, n in pairs)


# PyMC builds the log-densities of all variables, also where a part of them is asked for.
_QUIET: ContextVar[bool] = ContextVar("no warning of epsilon", default=False)
_PRIORS_ALONE: ContextVar[bool] = ContextVar("densities of hyperparameters alone", default=False)


@contextmanager
def without_epsilon_warning() -> Iterator[None]:
    """Log nothing of an unset epsilon, which the terms that are built do without."""
    token = _QUIET.set(True)
    try:
        yield
    finally:
        _QUIET.reset(token)


@contextmanager
def priors_alone() -> Iterator[None]:
    """Build the densities of hyperparameters: likelihoods by specimen are left out."""
    token = _PRIORS_ALONE.set(True)
    try:
        with without_epsilon_warning():
            yield
    finally:
        _PRIORS_ALONE.reset(token)


def builds_priors_alone() -> bool:
    """Return whether the densities of hyperparameters alone are built."""
    return _PRIORS_ALONE.get()


@_logprob.register(SimulatorRV)  # type: ignore[untyped-decorator]
def _log_density(
    op: SimulatorRV, values: Any, rng: Any, size: Any, *params: Any, **kwargs: Any
) -> TensorVariable:
    """Return the log-density of the observed data: a graph of the roots and of epsilon."""
    (value,) = values
    known = known_value(value)
    node = op.node if known is None else _observing(op.node, known)
    unset = Finding(
        "epsilon-unset",
        f"{node.name}: epsilon is not set; call prb.set_epsilon(model, "
        "prb.calibrate_epsilon(prb.minimize(model))), pass epsilon= to prb.Simulator, or use "
        "prb.sample_smc, which calibrates it.",
        "choose.md#epsilon-and-the-width-of-the-posterior",
    )
    if np.isnan(node.epsilon_value):
        # nutpie tells no more of an error than its number; nobody else has to be told who may yet
        # calibrate it
        blunt = "nutpie" in sys.modules and not _QUIET.get()
        report(unset, level=logging.WARNING if blunt else logging.DEBUG)
    check = CheckParameterValue(str(unset))
    epsilon = check(node.epsilon, pt.gt(node.epsilon, 0.0))
    inputs = node.bound.inputs
    density = log_kernel(node.bound.discrepancy(inputs.core(params)), epsilon)
    if isinstance(value, Constant):
        return density
    observed = node.target.observed.astype(value.dtype)
    first = value[: len(observed)]
    equal = pt.eq(first, observed)
    if np.isnan(observed).any():
        equal = equal | (pt.isnan(first) & np.isnan(observed))
    same = pt.eq(value.shape[0], len(observed)) & pt.all(equal)
    return CheckParameterValue(
        f"{node.name}: got other observed values than when this was compiled, expected the same "
        "ones, against which its metric is prepared; compile it again, as pm.sample, prb.minimize "
        "and prb.sample_smc do"
    )(density, same)


def known_value(value: Any) -> Any:
    """Return the numbers of observed values that a model holds, as `pymc.Data`; else None."""
    if isinstance(value, Constant):
        return value.data
    if isinstance(value, SharedVariable):
        return value.get_value()
    leaves = [v for v in ancestors([value]) if v.owner is None]
    if all(isinstance(leaf, Constant | SharedVariable) for leaf in leaves):
        return value.eval(mode=PLAIN)  # as whole numbers that became real ones
    return None


def _observing(node: Node, values: Any) -> Node:
    """Return a simulator with these observed responses: the same one, where it has them."""
    given = np.asarray(values)
    own = node.target.observed.astype(given.dtype)
    return node if np.array_equal(given, own, equal_nan=True) else node.observing(given)


@node_rewriter([Shape])  # type: ignore[untyped-decorator]
def shape_without_draw(fgraph: Any, apply: Apply[Any, Any]) -> list[Any] | None:
    """Return the shape of a simulator's variable without a draw, which would compute responses."""
    rv = apply.inputs[0].owner
    if rv is None or not isinstance(rv.op, SimulatorRV):
        return None
    parameters = [variable.shape for variable in rv.inputs[2:]]
    _, shape = rv.op.infer_shape(rv, [None, None, *parameters])
    return [pt.stack([pt.cast(size, "int64") for size in shape])]


# In all modes: pictures of a model compile shapes without any other rewrite.
optdb.register("prbayes_shape", out2in(shape_without_draw), "minimum_compile", position=0)


class SimulatorDistribution(pm.Distribution):
    """The distribution of an observed variable, as PyMC makes variables from."""

    rv_type = SimulatorRV

    @classmethod
    def rv_op(
        cls, *params: Any, simulator: Specification, size: Any = None, rng: Any = None
    ) -> TensorVariable:
        """Return a random variable that carries a simulator."""
        signature = rv_signature([p.type.ndim for p in params], len(simulator.target.event))
        op = SimulatorRV(signature=signature, simulator=simulator)
        generator = pt.random.shared_rng(seed=None) if rng is None else rng
        _, rv = op(*params, size=size, rng=generator, return_next_rng=True)
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
        axes = ",".join(f"i{k}{axis}" for axis in range(ndim))
        groups.append(f"({axes})")
    return ",".join(groups) + ("->(o)" if ndim_supp else "->()")


def simulators(model: pm.Model) -> dict[Any, AnySimulator]:
    """Return the simulators of a model as far as they are computed, by their observed variables.

    In a clone they are copies, made when they are first asked for.

    Raises
    ------
    TypeError
        If it is no model.
    """
    if not isinstance(model, pm.Model):
        raise TypeError(f"model: got {called(model)}, expected a pm.Model")
    applied = {rv: rv.owner for rv in model.observed_RVs if isinstance(rv.owner.op, SimulatorRV)}
    return {rv: apply.op.own_simulator(apply) for rv, apply in applied.items()}


def nodes(model: pm.Model) -> dict[Any, Node]:
    """Return the simulators of a model, keyed by their observed variables, in the model's order.

    The first call computes their first responses. In a clone they are copies, made when they are
    first asked for, which its compiled functions follow from then on. Where `pymc.set_data` or
    `pymc.observe` gave one other data, its metric is prepared anew, and the responses are the same.

    Raises
    ------
    BudgetError, ResponseError, StoreError
        If the first responses cannot be computed; the next call tries again.
    TypeError, ValueError
        If it is no model, or a metric does not take the data that it has now.
    """
    computed = {}
    for rv, simulator in simulators(model).items():
        node = _observing(simulator.node, known_value(model.rvs_to_values[rv]))
        if node is not simulator:
            rv.owner.op.assign(rv.owner, node)
        computed[rv] = node
    return computed


def required_simulators(model: pm.Model) -> dict[Any, AnySimulator]:
    """Return the simulators of a model as far as they are computed, or raise if it has none."""
    by_variable = simulators(model)
    if not by_variable:
        raise ValueError(
            "model: got one without a prb.Simulator, expected at least one; add "
            "prb.Simulator(name, response, *inputs, metric=..., observed=...) inside the "
            "`with pm.Model()`"
        )
    return by_variable
