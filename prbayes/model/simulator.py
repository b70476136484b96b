"""`Simulator`: an observed node of a PyMC model with log-density -discrepancy / epsilon."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
from numpy.typing import ArrayLike
from pytensor.tensor.variable import TensorVariable

from prbayes._checks import (
    called,
    observed_sample,
    plain_text,
    positive_number,
    sample_labels,
)
from prbayes._progress import shown
from prbayes.metrics.base import Discrepancy, Metric
from prbayes.model.node import Node, SimulatorDistribution, model_on_context, shared_epsilon
from prbayes.propagation.base import Propagation
from prbayes.propagation.reweighted import Reweighted
from prbayes.response.compilation import PLAIN
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
    model = model_on_context(None, f"prb.Simulator({name!r}, ...)")
    _refuse_name(name, model)
    target = _target(name, metric, observed, weights)
    propagation = Reweighted() if propagation is None else propagation
    if not isinstance(propagation, Propagation):
        raise TypeError(
            f"{name}: propagation: got {called(propagation)}, expected prb.Reweighted(n), "
            "prb.Resimulated(n) or prb.Fresh(n)"
        )
    size = target.observed.size
    labels = None if specimens is None else sample_labels(specimens, size, f"{name}: specimens")
    _refuse_dims(name, dims, size, model)
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
        retry_failed=propagation.retry_failed,
        timeout=propagation.timeout,
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


def _refuse_name(name: object, model: pm.Model) -> None:
    """Raise if a name is no text, or one that the model has already."""
    full = model.name_for(plain_text(name, "prb.Simulator: name"))
    if full in model.named_vars:
        raise ValueError(
            f"prb.Simulator: name: got {name!r}, which is in the model already, expected a new "
            "name; to run this again, run `with pm.Model():` and all below it again"
        )


def _refuse_dims(name: str, dims: object, size: int, model: pm.Model) -> None:
    """Raise if dims are not the name of one dimension of the model, as long as the data."""
    if dims is None:
        return
    names = [dims] if isinstance(dims, str) else dims
    if not isinstance(names, list | tuple) or [type(one) for one in names] != [str]:
        raise TypeError(f"{name}: dims: got {called(dims)}, expected the name of one dimension")
    (dim,) = names
    lengths = model.dim_lengths
    if dim not in lengths:
        raise ValueError(
            f"{name}: dims: got {dim!r}, expected one of the model's dimensions, {list(lengths)}; "
            f"add it with pm.Model(coords={{{dim!r}: ...}})"
        )
    length = int(lengths[dim].eval(mode=PLAIN))
    if length != size:
        raise ValueError(
            f"{name}: dims: got {dim!r} of length {length}, expected {size}, as many as there are "
            "observed values"
        )
