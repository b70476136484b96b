"""`Simulator`: an observed node of a PyMC model with log-density -discrepancy / epsilon."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
from numpy.typing import ArrayLike, NDArray
from pytensor import config
from pytensor.tensor.variable import TensorVariable

from prbayes._checks import observed_sample, positive_number, refuse_single_precision
from prbayes._progress import shown
from prbayes.metrics.base import Discrepancy, Metric
from prbayes.model.node import Node, SimulatorDistribution, model_on_context, shared_epsilon
from prbayes.propagation.base import Propagation
from prbayes.propagation.reweighted import Reweighted
from prbayes.response.inputs import read_inputs
from prbayes.response.response import Responses, refuse_uncallable


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
    progressbar: bool = True,
) -> TensorVariable:
    r"""Add an observed node whose log-density is -discrepancy / epsilon to the current model.

    Parameters
    ----------
    name : str
        Name of the node.
    response : callable
        ``response(*inputs)``, a NumPy-style function: one array per input, any leading batch shape,
        a multivariate input with its event axis last; returns an array of the batch shape, in units
        of the observed values. NaN is a point at which it could not be computed, +inf a specimen
        that failed.
    *inputs
        Each is a ``.dist()`` (aleatory: varies between specimens), a model variable (epistemic:
        common to all specimens) or a constant. The same ``.dist()`` in two simulators means the
        same specimens.
    metric : Metric
        How simulated and observed responses are compared.
    observed : array_like, shape (N,)
        Measured responses, one per specimen, at least two.
    epsilon : float, optional
        Scale of the discrepancy. 1/N for metrics on the scale of a likelihood; unset for the
        others, until `calibrate_epsilon` and `set_epsilon`, or `sample_smc`, set it.
    weights : array_like, shape (N,), optional
        Weights of the observed responses.
    specimens : array_like, shape (N,), optional
        Labels of the specimens.
    dims : str, optional
        Name of the observed dimension.
    propagation : Propagation, optional
        How populations become responses; ``Reweighted(1024)`` by default.
    progressbar : bool
        Whether work of more than two seconds shows a bar on stderr.

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
    .. [2] Bissiri, P. G., C. C. Holmes and S. G. Walker (2016), A general framework for updating
       belief distributions, J. R. Stat. Soc. B 78, 1103-1130, doi:10.1111/rssb.12158.

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
    caller = f"prb.Simulator({name!r}, ...)"
    refuse_single_precision(caller, config.floatX)
    model = model_on_context(None, caller)
    # A model within another one puts its own name before those of its variables.
    name = pm.modelcontext(None).name_for(name)
    target = _target(name, metric, observed, weights)
    propagation = Reweighted() if propagation is None else propagation
    if not isinstance(propagation, Propagation):
        raise TypeError(
            f"{name}: propagation: got {called(propagation)}, expected prb.Reweighted(n), "
            "prb.Resimulated(n) or prb.Fresh(n)"
        )
    labels = None if specimens is None else _labels(name, specimens, target.observed.size)
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
        version=propagation.version,
        on_failure=propagation.on_failure,
    )
    with shown(progressbar):
        bound = propagation.bind(name, sorted_inputs, target, responses)
    if epsilon is None:
        epsilon = 1 / target.n_effective if metric.likelihood else np.nan
    node = Node(name, target, bound, propagation, shared_epsilon(name, epsilon), labels)
    rv = SimulatorDistribution(
        name, *sorted_inputs.roots, node=node, observed=target.observed, dims=dims
    )
    rv.owner.op.own_node(rv.owner)
    return rv


def _target(
    name: str, metric: Metric, observed: ArrayLike, weights: ArrayLike | None
) -> Discrepancy:
    """Return the metric, prepared against the observed responses.

    Mistakes are told with the name.
    """
    if not isinstance(metric, Metric):
        raise TypeError(
            f"{name}: metric: got {called(metric)}, expected a metric object such as "
            "prb.ProbabilityResidual() or prb.AreaMetric(); wrap a function of your own in "
            "prb.FunctionMetric(f)"
        )
    try:
        values = observed_sample(observed, minimum=2)
        return metric.against(values, weights)
    except (TypeError, ValueError) as error:
        raise type(error)(f"{name}: {error}") from None


def called(thing: object) -> str:
    """Return what an argument is, for a message."""
    if isinstance(thing, type):
        return f"the class {thing.__name__}"
    return f"{type(thing).__name__} {thing!r:.60}"


def _labels(name: str, specimens: ArrayLike, n: int) -> NDArray[Any]:
    labels = np.asarray(specimens)
    if labels.shape != (n,):
        raise ValueError(
            f"{name}: specimens: got shape {labels.shape}, expected ({n},), "
            "one label per observation"
        )
    return labels
