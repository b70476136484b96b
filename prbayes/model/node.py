"""What a simulator is inside a PyMC model.

A `Node`, carried by the operation of an observed variable.

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
from inspect import signature
from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
from numpy.typing import NDArray
from pymc.logprob.abstract import _logprob
from pymc.logprob.utils import CheckParameterValue
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Apply, Constant
from pytensor.graph.traversal import ancestors
from pytensor.tensor.random.op import RandomVariable
from pytensor.tensor.variable import TensorVariable

from prbayes._checks import Floats, called
from prbayes._pages import more_in
from prbayes.metrics.base import Discrepancy, Metric
from prbayes.propagation.base import Bound, Propagation
from prbayes.propagation.reweighted import Design, design_of
from prbayes.response.compilation import PLAIN
from prbayes.response.outputs import ONE, Outputs

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

    @property
    def metric(self) -> Metric:
        """The calibration metric."""
        return self.target.metric

    @property
    def design(self) -> Design | None:
        """The stored responses, None where the propagation stores none."""
        return design_of(self.bound)

    @property
    def epsilon_value(self) -> float:
        """The value of epsilon, NaN while it is not set."""
        return float(self.epsilon.get_value())

    @property
    def epsilon_is_default(self) -> bool:
        """Whether nobody gave epsilon: it is the 1/N of a metric on a likelihood's scale."""
        # Weights that were normalised again differ by rounding.
        is_default = abs(self.epsilon_value * self.n_specimens - 1) < 1e-12
        return self.target.likelihood and is_default

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
        bound.aim(target.beside(bound.first_responses, bound.dimensions))
        other = replace(self, target=bound.target, bound=bound)
        if self.epsilon_is_default:
            other.epsilon.set_value(np.asarray(1 / other.n_specimens))
        return other

    def copied(self) -> Node:
        """Return the same simulator with its own design, count of responses and epsilon."""
        epsilon = shared_epsilon(self.name, self.epsilon_value)
        return replace(self, bound=self.bound.copied(), epsilon=epsilon)


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
    """The operation of an observed variable: draws data sets, and carries its `Node`.

    Two of them are equal if they carry the same node, so that no rewrite of a graph takes one
    simulator for another.

    PyTensor's rewriters remember every operation that they have met, as long as the process lasts.
    So the node, with all stored responses, is held by the applications of the operation, which live
    as long as a model or a compiled function, and not by the operation itself.

    Attributes
    ----------
    node : Node
    """

    __props__ = ("name", "signature", "dtype", "inplace", "node")

    def __init__(
        self,
        name: str | None = None,
        signature: str | None = None,
        dtype: str = "floatX",
        inplace: bool = False,
        *,
        node: Node,
    ) -> None:
        # What pictures of the model show.
        response = response_name(node.bound.responses.function)
        told = f"Simulator of {response} by {type(node.metric).__name__}"
        super().__init__(name=name or told, signature=signature, dtype=dtype, inplace=inplace)
        self._node = weakref.ref(node)
        self._owner: weakref.ref[Any] | None = None
        self._warned = False

    @property
    def node(self) -> Node:
        """The simulator."""
        found = self._node()
        if found is None:
            raise RuntimeError(f"{self}: got an operation of a model that is gone")
        return found

    def __eq__(self, other: object) -> bool:
        """Return whether it is of the same node, and applied alike."""
        return type(self) is type(other) and self._told() == other._told()

    def __hash__(self) -> int:
        """Return a number that stays when the node is gone."""
        return hash((type(self), self.name, self.signature, self.dtype, self.inplace))

    def _told(self) -> tuple[Any, ...]:
        return self.name, self.signature, self.dtype, self.inplace, self._node

    def make_node(self, *inputs: Any, **keywords: Any) -> Apply[Any, Any]:
        """Apply the operation; copies of the application hold the node as well."""
        apply = super().make_node(*inputs, **keywords)
        apply.tag.simulator = self.node
        return apply

    def __str__(self) -> str:
        """Show the name and the signature, without what the node holds."""
        return f'prbayes_Simulator_rv{{"{self.signature}"}}'

    @property
    def _print_name(self) -> tuple[str, str]:
        """What PyMC prints for the distribution, as text and as LaTeX."""
        response = response_name(self.node.bound.responses.function)
        told = f"{response}, {type(self.node.metric).__name__}"
        latex = told.replace("_", "\\_")
        return f"Simulator[{told}]", f"\\operatorname{{Simulator}}[\\text{{{latex}}}]"

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the owner: a copy that is unpickled belongs to a model of its own."""
        return {**self.__dict__, "_owner": None, "_node": self.node}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take what was left in."""
        self.__dict__.update(state)
        self._node = weakref.ref(state["_node"])

    def own_node(self, apply: Apply[Any, Any]) -> Node:
        """Return the node that belongs to an application of this operation in a model.

        Clones of a model share the operation with the original. Each is then given one of its own,
        whose design, count and epsilon are copies: what is refined or set there leaves the original
        alone.
        """
        if self._owner is None:
            self._owner = weakref.ref(apply)
        if self._owner() is apply:
            return self.node
        return self.replaced(apply, self.node.copied())

    def replaced(self, apply: Apply[Any, Any], node: Node) -> Node:
        """Let an application in a model have an operation of its own, which carries a node."""
        own = SimulatorRV(**{**self._props_dict(), "node": node})
        apply.op = own
        apply.tag.simulator = node
        return own.own_node(apply)

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
        return [pt.constant(n, dtype="int64") for n in self.node.target.event]

    def _warn_of_independence(self) -> None:
        """Say once that PyMC draws each variable by itself."""
        others = self.node.same_inputs
        if not others or self._warned:
            return
        self._warned = True
        _log.warning(
            "%s has inputs that %s has too, the same specimens; PyMC's predictive sampling draws "
            "each variable by itself, and so as independent of the others: use prb.predict for "
            "responses of the same specimens",
            self.node.name,
            ", ".join(others),
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


# Whether densities are made of which only those of hyperparameters are taken: PyMC makes all.
_PRIORS_ALONE: ContextVar[bool] = ContextVar("priors alone", default=False)


@contextmanager
def priors_alone() -> Iterator[None]:
    """Say nothing of epsilon meanwhile, which priors do without."""
    token = _PRIORS_ALONE.set(True)
    try:
        yield
    finally:
        _PRIORS_ALONE.reset(token)


@_logprob.register(SimulatorRV)  # type: ignore[untyped-decorator]
def _log_density(
    op: SimulatorRV, values: Any, rng: Any, size: Any, *params: Any, **kwargs: Any
) -> TensorVariable:
    """Return the log-density of the observed data: a graph of the roots and of epsilon."""
    (value,) = values
    known = known_value(value)
    node = op.node if known is None else _observing(op.node, known)
    unset = (
        f"{node.name}: epsilon is not set; call prb.set_epsilon(model, "
        "prb.calibrate_epsilon(prb.minimize(model))), pass epsilon= to prb.Simulator, or use "
        "prb.sample_smc, which calibrates it"
        f"{more_in('choose.md#epsilon-and-the-width-of-the-posterior')}"
    )
    if np.isnan(node.epsilon_value):
        # nutpie tells no more of an error than its number; nobody else has to be told who may yet
        # calibrate it
        blunt = "nutpie" in sys.modules and not _PRIORS_ALONE.get()
        _log.log(logging.WARNING if blunt else logging.DEBUG, "%s", unset)
    check = CheckParameterValue(unset)
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


class SimulatorDistribution(pm.Distribution):
    """The distribution of an observed variable, as PyMC makes variables from."""

    rv_type = SimulatorRV

    @classmethod
    def rv_op(cls, *params: Any, node: Node, size: Any = None, rng: Any = None) -> TensorVariable:
        """Return a random variable that carries a node."""
        signature = _signature([p.type.ndim for p in params], len(node.target.event))
        op = SimulatorRV(signature=signature, node=node)
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


def _signature(ndims: Sequence[int], ndim_supp: int) -> str:
    """Return the signature of a random variable, such as '(),(i10,i11)->()', or '->(o)'."""
    groups = []
    for k, ndim in enumerate(ndims):
        axes = ",".join(f"i{k}{axis}" for axis in range(ndim))
        groups.append(f"({axes})")
    return ",".join(groups) + ("->(o)" if ndim_supp else "->()")


def nodes(model: pm.Model) -> dict[Any, Node]:
    """Return the simulators of a model, keyed by their observed variables, in the model's order.

    In a clone they are copies, made when they are first asked for, which its compiled functions
    follow from then on. Where `pymc.set_data` or `pymc.observe` gave one other data, its metric is
    prepared anew, and the responses are the same.

    Raises
    ------
    TypeError, ValueError
        If it is no model, or a metric does not take the data that it has now.
    """
    if not isinstance(model, pm.Model):
        raise TypeError(f"model: got {called(model)}, expected a pm.Model")
    found = {}
    for rv in model.observed_RVs:
        if isinstance(rv.owner.op, SimulatorRV):
            own = rv.owner.op.own_node(rv.owner)
            node = _observing(own, known_value(model.rvs_to_values[rv]))
            found[rv] = node if node is own else rv.owner.op.replaced(rv.owner, node)
    return found


def required_nodes(model: pm.Model) -> dict[Any, Node]:
    """Return the simulators of a model, or raise if it has none."""
    found = nodes(model)
    if not found:
        raise ValueError(
            "model: got one without a prb.Simulator, expected at least one; add "
            "prb.Simulator(name, response, *inputs, metric=..., observed=...) inside the "
            "`with pm.Model()`"
        )
    return found


def model_on_context(model: pm.Model | None, caller: str) -> pm.Model:
    """Return the model given, or the one on the context, or raise.

    Within another model, the outermost: that has the variables of all.
    """
    found = pm.Model.get_context(error_if_none=False) if model is None else model
    if not isinstance(found, pm.Model):
        got = "no model on the context" if found is None else type(found).__name__
        raise TypeError(
            f"{caller}: got {got}, expected a pm.Model; "
            "call it inside `with pm.Model():` or pass model="
        )
    return found.root
