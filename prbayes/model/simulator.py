"""What stands in a PyMC model: `Simulator`, and `abc_distance` for stock `pymc.Simulator`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
from numpy.typing import ArrayLike, NDArray
from pymc.logprob.abstract import _logprob
from pymc.logprob.utils import CheckParameterValue
from pytensor.graph.basic import Apply
from pytensor.graph.op import Op
from pytensor.tensor.variable import TensorVariable

from prbayes._checks import Floats, observed_sample, positive_number
from prbayes.metrics.base import Discrepancy, Metric
from prbayes.propagation.base import Bound, Propagation
from prbayes.propagation.reweighted import Design, Reweighted, design_of
from prbayes.response.inputs import read_inputs
from prbayes.response.response import Responses, refuse_uncallable


@dataclass(frozen=True, eq=False)
class Node:
    """One simulator of a model.

    Attributes
    ----------
    name : str
    target : Discrepancy
        The metric, prepared against the observed responses.
    bound : Bound
        The propagation at work.
    epsilon : shared variable
        Scalar; NaN while it is not set.
    specimens : ndarray, shape (N,), or None
        Labels of the specimens that the observed responses were measured on.
    """

    name: str
    target: Discrepancy
    bound: Bound
    propagation: Propagation
    epsilon: Any
    specimens: NDArray[Any] | None

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
        """Whether epsilon is the 1/N of a metric on the scale of a likelihood, which nobody gave."""
        return self.metric.likelihood and self.epsilon_value == 1 / self.target.n_effective


def log_kernel(discrepancy: Any, epsilon: Any) -> Any:
    """Return the log-density of an observed node; the only place where the sign of a discrepancy changes."""
    return -discrepancy / epsilon


def nodes(model: pm.Model) -> dict[Any, Node]:
    """Return the simulators of a model, keyed by their observed variables, in the model's order."""
    found = {rv: getattr(type(rv.owner.op), "prbayes_node", None) for rv in model.observed_RVs}
    return {rv: node for rv, node in found.items() if node is not None}


def required_nodes(model: pm.Model) -> dict[Any, Node]:
    """Return the simulators of a model, or raise if it has none."""
    found = nodes(model)
    if not found:
        raise ValueError(
            "model: got one without a prb.Simulator, expected at least one; add "
            "prb.Simulator(name, response, *inputs, metric=..., observed=...) inside the `with pm.Model()`"
        )
    return found


def model_on_context(model: pm.Model | None, caller: str) -> pm.Model:
    """Return the model given, or the one on the context, or raise."""
    found = pm.Model.get_context(error_if_none=False) if model is None else model
    if not isinstance(found, pm.Model):
        got = "no model on the context" if found is None else type(found).__name__
        raise TypeError(f"{caller}: got {got}, expected a pm.Model; call it inside `with pm.Model():` or pass model=")
    return found


def Simulator(  # noqa: N802 (stands beside pm.Normal and pm.Simulator)
    name: str,
    response: Callable[..., Any],
    *inputs: Any,
    metric: Metric,
    observed: ArrayLike,
    epsilon: float | None = None,
    weights: ArrayLike | None = None,
    specimens: ArrayLike | None = None,
    dims: str | None = None,
    propagation: Propagation | None = None,
) -> TensorVariable:
    r"""Add an observed node whose log-density is -discrepancy / epsilon to the current model.

    Parameters
    ----------
    name : str
        Name of the node.
    response : callable
        ``response(*inputs)``, a NumPy-style function: one array per input, any leading batch shape, a
        multivariate input with its event axis last; returns an array of the batch shape, in units of the
        observed values. NaN is a point at which it could not be computed, +inf a specimen that failed.
    *inputs
        Each is a ``.dist()`` (aleatory: varies between specimens), a model variable (epistemic: common to
        all specimens) or a constant. The same ``.dist()`` in two simulators means the same specimens.
    metric : Metric
        How simulated and observed responses are compared.
    observed : array_like, shape (N,)
        Measured responses, one per specimen, at least two.
    epsilon : float, optional
        Scale of the discrepancy. 1/N for metrics on the scale of a likelihood; unset for the others, until
        `calibrate_epsilon` and `set_epsilon`, or `sample_smc`, set it.
    weights : array_like, shape (N,), optional
        Weights of the observed responses.
    specimens : array_like, shape (N,), optional
        Labels of the specimens.
    dims : str, optional
        Name of the observed dimension.
    propagation : Propagation, optional
        How populations become responses; ``Reweighted(1024)`` by default.

    Returns
    -------
    TensorVariable
        The observed variable. Predictive sampling draws N different specimens for it.

    Raises
    ------
    TypeError, ValueError
        If an argument is not what is described here; before the response is computed.
    ResponseError
        If the response raises, returns a wrong shape or type, or is NaN at all points.

    References
    ----------
    .. [1] Oh et al. (2019), doi:10.1007/s00158-019-02288-6.
    .. [2] Bissiri, P. G., C. C. Holmes and S. G. Walker (2016), A general framework for updating belief
       distributions, J. R. Stat. Soc. B 78, 1103-1130, doi:10.1111/rssb.12158.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     mu = pm.Normal("mu", 0, 2)
    ...     x = pm.Normal.dist(mu, 1.0)
    ...     y = prb.Simulator("y", np.square, x, metric=prb.AreaMetric(), observed=[0.5, 1.0, 4.0])
    >>> y.name
    'y'
    """
    model = model_on_context(None, f"prb.Simulator({name!r}, ...)")
    if not isinstance(metric, Metric):
        raise TypeError(
            f"{name}: metric: got {_called(metric)}, expected a metric object such as prb.ProbabilityResidual() "
            "or prb.AreaMetric(); wrap a function of your own in prb.FunctionMetric(f)"
        )
    propagation = Reweighted() if propagation is None else propagation
    if not isinstance(propagation, Propagation):
        raise TypeError(
            f"{name}: propagation: got {_called(propagation)}, expected prb.Reweighted(n), prb.Resimulated(n) "
            "or prb.Fresh(n)"
        )
    try:
        values = observed_sample(observed, minimum=2)
        target = metric.against(values, weights)
    except (TypeError, ValueError) as error:
        raise type(error)(f"{name}: {error}") from None
    labels = None if specimens is None else _labels(name, specimens, values.size)
    if epsilon is not None:
        positive_number(epsilon, f"{name}: epsilon")
    refuse_uncallable(name, response)
    sorted_inputs = read_inputs(name, inputs, model)
    responses = Responses(
        name,
        response,
        sorted_inputs,
        executor=propagation.executor,
        store=propagation.store,
        on_failure=propagation.on_failure,
    )
    bound = propagation.bind(name, sorted_inputs, target, responses)
    if epsilon is None:
        epsilon = 1 / target.n_effective if metric.likelihood else np.nan
    shared = pytensor.shared(np.asarray(epsilon, dtype=np.float64), name=f"{name}_epsilon")
    node = Node(name, target, bound, propagation, shared, labels)
    check = CheckParameterValue(
        f"{name}: epsilon is not set; call prb.set_epsilon(model, prb.calibrate_epsilon(prb.minimize(model))), pass "
        "epsilon= to prb.Simulator, or use prb.sample_smc, which calibrates it"
    )

    def logp(value: Any, *params: Any) -> Any:
        set_epsilon = check(shared, pt.gt(shared, 0.0))
        return log_kernel(bound.discrepancy(sorted_inputs.core(params)), set_epsilon)

    def random(*params: Any, rng: np.random.Generator, size: Any) -> Floats:
        return bound.draw(rng, int(np.prod(size, dtype=int)), sorted_inputs.core(params)).reshape(size)

    rv = pm.CustomDist(
        name,
        *sorted_inputs.roots,
        logp=logp,
        random=random,
        signature=_signature([r.type.ndim for r in sorted_inputs.roots]),
        observed=values,
        dims=dims,
        class_name="prbayes_Simulator",
    )
    type(rv.owner.op).prbayes_node = node
    type(rv.owner.op).prbayes_logp = staticmethod(logp)
    return rv


def revive(model: pm.Model) -> pm.Model:
    """Tell PyMC of the log-densities of simulators in a model that was sent from another process."""

    def logp(op: Any, values: Any, rng: Any, size: Any, *params: Any, **kwargs: Any) -> Any:
        return op.prbayes_logp(values[0], *params)

    for rv in nodes(model):
        if _logprob.dispatch(type(rv.owner.op)) is _logprob.dispatch(object):
            _logprob.register(type(rv.owner.op), logp)
    return model


def _signature(ndims: Sequence[int]) -> str:
    """Return the signature of a random variable of scalar support, such as '(),(i10,i11)->()'."""
    axes = (",".join(f"i{k}{axis}" for axis in range(ndim)) for k, ndim in enumerate(ndims))
    return ",".join(f"({a})" for a in axes) + "->()"


def _called(thing: object) -> str:
    return f"the class {thing.__name__}" if isinstance(thing, type) else f"{type(thing).__name__} {thing!r:.60}"


def _labels(name: str, specimens: ArrayLike, n: int) -> NDArray[Any]:
    labels = np.asarray(specimens)
    if labels.shape != (n,):
        raise ValueError(f"{name}: specimens: got shape {labels.shape}, expected ({n},), one label per observation")
    return labels


def set_epsilon(model: pm.Model, epsilon: dict[str, float]) -> None:
    """Set the epsilon of simulators by name.

    Parameters
    ----------
    model : pymc.Model
    epsilon : dict
        Positive numbers by the names of simulators; others keep theirs.

    Raises
    ------
    KeyError, TypeError, ValueError
        If a name is unknown or a value is not a positive number; then nothing is changed.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu"), 1.0)
    ...     y = prb.Simulator("y", np.square, x, metric=prb.AreaMetric(), observed=[0.5, 1.0, 4.0])
    >>> prb.set_epsilon(model, {"y": 0.1})
    """
    found = {node.name: node for node in required_nodes(model).values()}
    unknown = sorted(set(epsilon) - set(found))
    if unknown:
        raise KeyError(f"epsilon: got {unknown}, expected names of simulators: {sorted(found)}")
    values = {name: positive_number(value, f"{name}: epsilon") for name, value in epsilon.items()}
    for name, value in values.items():
        found[name].epsilon.set_value(np.asarray(value))


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
    `pymc.Simulator` draws new responses at every evaluation, each given to all observations; numbers of
    simulated and observed responses may differ. A simulated sample with NaN has log-density -inf.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> def simulate(rng, mu, size):
    ...     return rng.normal(mu, 1.0, size=500)
    >>> with pm.Model() as model:
    ...     y = pm.Simulator("y", simulate, pm.Normal("mu"), distance=prb.abc_distance(prb.AreaMetric()),
    ...                      epsilon=0.02, observed=np.array([0.5, 1.0, 4.0]))
    """

    __props__ = ("metric",)
    gufunc_signature = "(),(n),(m)->()"

    def __init__(self, metric: Metric) -> None:
        if not isinstance(metric, Metric):
            raise TypeError(f"abc_distance: got {_called(metric)}, expected a metric object such as prb.AreaMetric()")
        self.metric = metric
        self._prepared: tuple[Floats, Discrepancy] | None = None

    def make_node(self, epsilon: Any, observed: Any, simulated: Any) -> Apply[Any, Any]:
        """Apply to epsilon and the two samples."""
        return Apply(self, [pt.as_tensor(v) for v in (epsilon, observed, simulated)], [pt.dscalar()])

    def perform(self, node: Any, inputs: Sequence[Any], outputs: Any) -> None:
        """Return the log-density; the observed side is prepared once."""
        epsilon, observed, simulated = inputs
        if self._prepared is None or not np.array_equal(self._prepared[0], observed):
            self._prepared = (np.array(observed), self.metric.against(observed))
        bad = np.isnan(simulated).any() or np.isneginf(simulated).any()
        value = log_kernel(self._prepared[1](simulated), epsilon) if not bad else -np.inf
        outputs[0][0] = np.asarray(value, dtype=np.float64)
