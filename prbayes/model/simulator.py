"""`Simulator`: an observed node of a PyMC model with log-density -discrepancy / epsilon."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from numpy.typing import ArrayLike, NDArray
from pytensor import config
from pytensor.graph.basic import Variable
from pytensor.tensor.variable import TensorVariable

from prbayes._finding import Finding, counted, report
from prbayes._validate import (
    NO_POPULATION,
    Floats,
    Function,
    Labels,
    Names,
    called,
    finite_or_nan,
    flag,
    flat_rows,
    observed_sample,
    plain_text,
    positive_number,
    refuse_huge,
    refuse_single_precision,
    sample_weights,
    texts,
    wrong_value,
)
from prbayes.emulators.runs import Runs
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Discrepancy, Metric, is_likelihood
from prbayes.metrics.joint_summary import has_data_sheets, read_sheets
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.whitening import FewSpecimensError
from prbayes.model.conditions import stacked_values
from prbayes.model.data_checks import duplicate_findings, outlier_findings
from prbayes.model.measurement import (
    Measurement,
    SpecimenLikelihood,
    selection_of,
    specimen_labels,
)
from prbayes.model.observed_data import (
    ObservedData,
    observed_at_conditions,
    observed_by_specimen,
    read_data,
)
from prbayes.model.random_variable import (
    AnySimulator,
    SimulatorDistribution,
    SimulatorRV,
    Specification,
    effective_specimens,
    has_default_epsilon,
    rv_signature,
    share_bandwidths,
    shared_epsilon,
    simulators,
)
from prbayes.model.remedies import (
    PROPAGATIONS,
    advised,
    check_propagation,
    other_metric,
    scatter_advice,
)
from prbayes.model.simulator_with_data import refuse_labels_of_index, unlabelled_specimens
from prbayes.model.specimen_likelihood import (
    SpecimenRV,
    all_simulators,
    measurements_of,
    specimen_likelihoods,
)
from prbayes.model.stochastic_likelihood import refuse_random
from prbayes.propagation.base import Propagation, refuse_nested
from prbayes.propagation.reweighted import Reweighted
from prbayes.response.by_specimen import of_specimens
from prbayes.response.condition import ReadingsCondition, refuse_vectors_of_specimens
from prbayes.response.distributions import refuse_without_density
from prbayes.response.inputs import (
    Groups,
    Inputs,
    is_group,
    model_on_context,
    read_inputs,
    set_units,
)
from prbayes.response.outputs import Outputs, label_text
from prbayes.response.pymc_dims import values_of
from prbayes.response.response import Responses, refuse_misfit, refuse_uncallable, repeats_of
from prbayes.response.stochastic import noise_of

# Options of a propagation that concern the calls of the response.
_CALL_SETTINGS = ("executor", "store", "version", "on_failure", "retry_failed", "timeout")


def Simulator(  # noqa: N802 (named like pm.Normal and pm.Simulator)
    name: str,
    response: Function,
    *inputs: Any,
    metric: Metric | None = None,
    observed: Any,
    epsilon: float | None = None,
    weights: ArrayLike | None = None,
    specimens: ArrayLike | None = None,
    dims: str | Sequence[str] | None = None,
    propagation: Propagation | None = None,
    units: Labels | str | None = None,
    progressbar: bool = True,
) -> TensorVariable | tuple[TensorVariable, ...]:
    r"""Add an observed variable that compares simulated and measured responses to the model.

    Parameters
    ----------
    name : str
        Name of the variable.
    response : callable or Runs
        A table of runs, or ``response(*inputs)``, a NumPy-style function. Each input is an array of
        any leading batch shape; a multivariate input has its event axis last. The function returns
        an array of the batch shape, in units of the observed values; for m outputs of a specimen an
        array with them in a last axis, or a mapping of arrays with the keys of ``observed``. Labels
        of a DataArray or DataFrame are matched to those of ``observed``. NaN, or a masked number,
        is a point without response, +inf a specimen that failed; -inf is refused. The response of a
        specimen depends on the inputs of that specimen alone: three of the first ones are computed
        again, by themselves, and a difference is refused. So is a function that takes one number
        of specimens. Where inputs repeat, as discrete ones do, a design computes the
        response once. Model random scatter of the response as an input, such as ``pm.Normal.dist(0,
        1)``, or use `Fresh`. Simulators with the same response object, inputs and propagation, and
        metrics of distributions, share runs. Variables that the response reads have to stay as they
        are: a few runs are computed again where runs serve another simulator or function, and a
        difference is refused.
    *inputs
        Each is a ``.dist()`` (aleatory: varies between specimens), a model variable (epistemic:
        common to all specimens) or a constant. The same ``.dist()`` in two simulators means the
        same population; ``specimens`` marks values that were measured on the same specimens.
    metric : Metric, optional
        Comparison of simulated and observed responses. By default `LogLikelihood`, the
        log-likelihood by specimen, for a deterministic response of continuous inputs: it needs
        about a hundred runs, and no epsilon.
    observed : array_like, shape (N,) or (N, m), DataFrame, DataArray, mapping, pymc.Data or Summary
        Measured responses, of at least two specimens, or a `Summary` of them. A mapping of
        `Summary` has one for each output of the same specimens.
        Several outputs of a specimen, (N, m), need a metric that compares them together, such as
        `Joint`: an array, a DataFrame whose columns are outputs, a DataArray with specimens first,
        or a mapping of arrays. NaN is an output that was not measured, +inf a specimen that failed.
        After ``pymc.set_data`` or ``pymc.observe`` the metric is prepared against the new values,
        and no response is computed. Include the group of each specimen where inputs depend on
        `prbayes.response.group`.
    epsilon : float, optional
        Scale of the discrepancy. By default 1/N for metrics on the scale of a likelihood, with the
        effective number N of specimens; unset for other metrics, until `calibrate_epsilon` and
        `set_epsilon`, or `sample_smc`, set it.
    weights : array_like, shape (N,), optional
        Integers are frequencies: as many specimens have the value, as in a histogram, and N is
        their sum. Other numbers are relative weights of N specimens, whose effective number is that
        of Kish, (sum w)^2 / sum w^2. An index is matched to that of ``observed``.
    specimens : array_like, shape (N,), optional
        Labels of the specimens. Observations with the same label, also of several simulators,
        belong together: data sets are drawn specimen by specimen. With a metric of distributions
        each simulator's default epsilon counts its specimens. Shared specimens then count several
        times under `pymc.sample`, until `calibrate_epsilon` corrects for it; a warning reports it.
        With `LogLikelihood` observations of a specimen share its inputs, and the last simulator has
        the log-likelihoods of all specimens.
    dims : str or sequence of str, optional
        Names of the observed dimensions.
    propagation : Propagation, optional
        How populations become responses; with a metric ``Reweighted(1024)`` by default.
    units : mapping or str, optional
        Units for tables, pictures and the report; a text is that of a response of one output. A
        mapping has those of aleatory inputs, by the name of the
        ``.dist()`` or of the response's argument (``"x[0]"`` is an element of a vector), and of
        the response, by the name of the simulator or of an output. Those of the response are
        ``observed.attrs["units"]`` by default.
    progressbar : bool
        Whether the first runs show a bar on stderr if they take more than two seconds.

    Returns
    -------
    TensorVariable, or a tuple of them
        The observed variable, or that of each group, such as ``y[Adler]``. PyMC's predictive
        sampling draws N specimens for it: new ones under `Fresh`, else points of the population, by
        weight and with replacement. It draws each variable independently; a warning reports
        simulators that share inputs, for which `predict` draws the same specimens.

    Raises
    ------
    TypeError, ValueError
        If an argument does not have the form above.

    Notes
    -----
    No response is computed when the model is written. The first use of the model computes the first
    responses: `minimize`, `sample_smc`, `pymc.sample`, a plot or a prediction. An executor has to
    be open then. A response that raises, returns a wrong shape or type, or is NaN at all points is
    a `ResponseError` there, and the next use tries again. A line of the log ("prbayes", level INFO)
    reports the number of runs and their time; `cost` reports them before.

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
    name = _new_name(name, model)
    flag(progressbar, "progressbar")
    variables = _read_inputs(name, response, inputs, model)
    settings = Reweighted() if propagation is None else propagation
    if not isinstance(settings, Propagation):
        raise wrong_value(
            propagation,
            f"{name}: propagation",
            "prb.Reweighted(n), prb.Resimulated(n) or prb.Fresh(n)",
        )
    if has_data_sheets(observed):
        unused = [metric, epsilon, weights, specimens, dims, variables.groups]
        _refuse_beside_sheets(name, unused, settings)
        metric, observed = read_sheets(name, observed)
    groups = variables.groups
    observed, metric = observed_at_conditions(name, observed, metric, inputs, groups)
    observed, metric, response = observed_by_specimen(
        name, observed, metric, response, inputs, groups
    )
    data = read_data(name, observed, variables.groups, weights, specimens, dims, model)
    if repeats_of(response) > 1:
        inputs = (*inputs, noise_of(data.outputs.event))
        variables = _read_inputs(name, response, inputs, model)
    data = replace(data, outputs=_with_units(name, units, variables, response, data.outputs))
    refuse_vectors_of_specimens(name, variables.aleatory, variables.parents, len(data))
    times = next((i for i, x in enumerate(inputs) if isinstance(x, ReadingsCondition)), None)
    of_readings = times is not None or of_specimens(response) is not None
    arguments = _Arguments(
        name, model, response, variables, data, settings, epsilon, progressbar, of_readings, times
    )
    metric = LogLikelihood() if metric is None else metric
    earlier = all_simulators(model)
    refuse_labels_of_index(name, variables, data.labels, data.index, earlier)
    if isinstance(metric, Metric) and metric.by_specimen:
        added = _add_measurement(arguments, cast(LogLikelihood, metric))
    else:
        added = _add_by_metric(arguments, metric)
    for variable in added if isinstance(added, tuple) else (added,):
        variable.tag.specimen_index = data.index
    findings = unlabelled_specimens(all_simulators(model))
    report(*findings[len(unlabelled_specimens(earlier)) :])
    return added


@dataclass(frozen=True, eq=False)
class _Arguments:
    """Validated arguments of a simulator."""

    name: str
    model: pm.Model
    response: Function
    inputs: Inputs
    data: ObservedData
    propagation: Propagation
    epsilon: float | None
    progressbar: bool
    at_conditions: bool  # whether outputs are readings at values of a vector condition
    times: int | None  # position of this condition among the inputs, if it is one

    def other_metric(self) -> str:
        """Return advice to use a metric of distributions that the simulator accepts, or none."""
        if self.at_conditions:
            return ""
        is_random = self.propagation.is_random
        propagations = [self.propagation] if is_random else PROPAGATIONS
        return other_metric(self.name, self.inputs, self.data.values, AreaMetric(), propagations)

    def responses(self, name: str, inputs: Inputs, scatter: float | None) -> Responses:
        """Return the response of inputs, and how the propagation calls it."""
        calls = {key: getattr(self.propagation, key) for key in _CALL_SETTINGS}
        calls |= {"outputs": self.data.outputs, "caller": self.name, "scatter": scatter}
        calls["times"] = self.times
        return Responses(name, self.response, inputs, **calls)


def _new_name(name: str, model: pm.Model) -> str:
    """Return the name of a variable that the model does not have yet."""
    # A nested model prefixes the names of its variables with its own name.
    name = pm.modelcontext(None).name_for(plain_text(name, "prb.Simulator: name"))
    if model.name_for(name) in model.named_vars:
        raise ValueError(
            f"prb.Simulator: name: got {name!r}, which is in the model already, expected a new "
            "name; to run this again, run `with pm.Model():` and all below it again"
        )
    return name


def _refuse_beside_sheets(name: str, unused: Sequence[Any], propagation: Propagation) -> None:
    """Raise for arguments beside a data sheet that need specimens."""
    names = ("metric=", "epsilon=", "weights=", "specimens=", "dims=", "groups")
    arguments = [text for text, value in zip(names, unused, strict=True) if value is not None]
    if arguments:
        text = ", ".join(arguments)
        raise TypeError(
            f"{name}: observed: got a prb.Summary and {text}, expected the Summary alone: it has "
            f"no single specimens, and its likelihood needs no scale; leave {text} out, or write a "
            "simulator for each data sheet"
        )
    if propagation.is_random:
        raise TypeError(
            f"{name}: propagation: got {called(propagation)}, whose likelihood would be random, "
            "expected prb.Reweighted(n) or prb.Resimulated(n) for a prb.Summary"
        )


def _read_inputs(name: str, response: Function, inputs: Sequence[Any], model: pm.Model) -> Inputs:
    """Return the inputs of a response; raise if the arguments are invalid."""
    refuse_uncallable(name, response)
    variables = read_inputs(name, inputs, model)
    if isinstance(response, Runs):
        refuse_misfit(name, response, variables.sizes)
        response.refuse_inputs(name, variables)
    for rv in simulators(model):
        if rv in variables.parents:
            raise TypeError(
                f"{name}: got inputs that depend on the simulator {rv.name}, expected "
                "hyperparameters; let one response call the other, or return the outputs of both "
                "from one response, with prb.Joint(metric)"
            )
    for parent in variables.parents:
        refuse_single_precision(f"{name}: {parent.name}", parent.dtype)
    return variables


def _with_units(
    name: str,
    units: Labels | str | None,
    inputs: Inputs,
    response: Function,
    outputs: Outputs,
) -> Outputs:
    """Store the units of the inputs with them, and return the outputs with their units."""
    if units is None:
        return outputs
    if isinstance(units, str):
        if len(outputs.names) > 1:
            raise TypeError(
                f"{name}: units: got {units!r:.60} for {len(outputs.names)} outputs, expected a "
                f'mapping of names to units, such as {{"{outputs.names[0]}": {units!r:.60}}}'
            )
        units = {name: units}
    texts(units, f"{name}: units")
    labels = outputs.names or (name,)
    names = [*set_units(inputs, response, units), name, *outputs.names]
    unknown = [key for key in units if key not in names]
    if unknown:
        # Check the names of the response's arguments first, since wrong names are the likelier
        # mistake.
        refuse_misfit(name, response, inputs.sizes, outputs)
        raise KeyError(
            f"{name}: units: got {unknown[0]!r:.60}, expected some of {list(dict.fromkeys(names))}"
        )
    defaults = outputs.units or ("",) * len(labels)
    pairs = zip(labels, defaults, strict=True)
    of_outputs = [units.get(label, units.get(name, unit)) for label, unit in pairs]
    return replace(outputs, units=tuple(of_outputs)) if any(of_outputs) else outputs


# The log-likelihood by specimen.


def _add_measurement(arguments: _Arguments, metric: LogLikelihood) -> TensorVariable:
    """Add an observed variable whose log-density is the log-likelihood by specimen."""
    name, model, data = arguments.name, arguments.model, arguments.data
    _refuse_by_specimen(arguments)
    if arguments.at_conditions and metric.selected is not None:
        raise ValueError(
            f"{name}: metric: selected: got limits with readings of each specimen's own, expected "
            "the same outputs of all specimens: the share that is never seen differs; leave "
            "selected= out"
        )
    if data.rows is not None:
        metric = metric.of_frequencies(data.rows, data.n_rows)
    values = _checked_specimens(arguments)
    arguments.propagation.check_likelihood(name)
    partners = _with_common_specimens(name, data.labels, model)
    inputs = _inputs_of_partners(name, arguments.inputs, partners)
    weights = data.weights
    if weights is not None:
        weights = sample_weights(weights, len(values), f"{name}: weights")
        # The sum of the weights is now the effective number of specimens (Kish).
        weights /= (weights**2).sum()
    conditions = data.known_values([inputs.aleatory[place] for place in inputs.conditions])
    measurement = Measurement(
        name,
        metric,
        values,
        weights,
        data.labels,
        inputs,
        arguments.responses(name, inputs, 0.0),
        arguments.propagation,
        data.outputs,
        data.groups,
        data.known_values(inputs.covariates),
        stacked_values(conditions),
        arguments.at_conditions,
        _measurement_variables(name, model, metric, partners),
        data.rows,
    )
    if measurement.responses.repeats > 1:
        refuse_random(measurement, partners)
    likelihood = _joint_likelihood(measurement, partners, model)
    joined = [rv for rv, joint in specimen_likelihoods(model).items() if joint in partners]
    names = tuple(m.name for m in likelihood.measurements)
    with_dims = [rv.name for rv in joined if model.named_vars_to_dims.get(rv.name)]
    if specimen_labels(likelihood) is not None and (with_dims or data.dims is not None):
        raise ValueError(
            f"{name}: dims: got dimensions of {(with_dims or [name])[0]}, whose specimens have "
            "several readings, expected none: log-likelihoods are by specimen; leave dims= out"
        )
    constants = {v: pt.constant(measurement.covariates[str(v.name)]) for v in inputs.covariates}
    constants |= {v: pt.constant(measurement.groups) for v in filter(is_group, inputs.parents)}
    params = [constants.get(v, v) for v in likelihood.variables(names)]
    params += joined
    signature = rv_signature([p.type.ndim for p in params], len(measurement.event))
    operation = SpecimenRV(signature=signature, reference=weakref.ref(likelihood), simulators=names)
    rv = SimulatorDistribution(
        name, *params, operation=operation, observed=data.for_pymc(values), dims=data.dims
    )
    for partner in joined:
        partner.owner.op.assign(partner.owner, likelihood)
    return rv


def _with_common_specimens(
    name: str, labels: NDArray[Any] | None, model: pm.Model
) -> list[SpecimenLikelihood]:
    """Return the likelihoods of a model whose specimens have these labels."""
    if labels is None:
        return []
    by_metric = list(simulators(model).values())
    measurements = list(measurements_of(model).values())
    _refuse_ambiguous_labels(name, labels, [*by_metric, *measurements])

    def common(simulator: AnySimulator | Measurement) -> list[str]:
        if simulator.specimens is None:
            return []
        return sorted(map(label_text, set(labels.tolist()) & set(simulator.specimens.tolist())))

    for simulator in by_metric:
        if common(simulator):
            raise ValueError(
                f"{name}: specimens: got {common(simulator)[0]!r}, which {simulator.name} has too "
                f"with {called(simulator.target.metric)}, expected one kind of metric for each "
                f"specimen: pass metric=prb.LogLikelihood() to {simulator.name}, or the same "
                f"metric to {name}"
            )
    likelihoods = dict.fromkeys(specimen_likelihoods(model).values())
    return [joint for joint in likelihoods if any(map(common, joint.measurements))]


def _inputs_of_partners(
    name: str, inputs: Inputs, partners: Sequence[SpecimenLikelihood]
) -> Inputs:
    """Return the inputs in the order in which simulators with the same specimens have them."""
    for partner in partners:
        if set(inputs.aleatory) != set(partner.inputs.aleatory):
            raise ValueError(
                f"{name}: got other inputs than {partner.name}, which has the same specimens, "
                "expected the same .dist() objects in both: a specimen has one value of each "
                "input; pass all of them to both responses, also those that one does not use"
            )
        if partner.inputs.aleatory != partners[0].inputs.aleatory:
            raise ValueError(
                f"{name}: got specimens of {partners[0].name} and of {partner.name}, expected "
                "these to have their inputs in the same order; reorder the arguments of one"
            )
    return inputs.ordered_as(partners[0].inputs) if partners else inputs


def _joint_likelihood(
    measurement: Measurement, partners: Sequence[SpecimenLikelihood], model: pm.Model
) -> SpecimenLikelihood:
    """Return the joint likelihood of a simulator and of others with the same specimens.

    Raises a ValueError if their measurements cannot be combined.
    """
    name = measurement.name
    try:
        _ = measurement.readings
    except ValueError as error:
        raise ValueError(f"{name}: metric: {error}") from None
    selection_of([measurement])
    joined = {m for partner in partners for m in partner.measurements}
    earlier = [m for m in measurements_of(model).values() if m in joined]
    likelihood = SpecimenLikelihood((*earlier, measurement), weakref.ref(model))
    size = len(likelihood.readings)
    if size < 2:
        raise ValueError(f"{name}: specimens: got {size} specimen, expected at least 2")
    weighted = [m.name for m in likelihood.measurements if m.weights is not None]
    if weighted and size < sum(len(m.observed) for m in likelihood.measurements):
        raise ValueError(
            f"{name}: weights: got weights of {weighted[0]}, which has specimens with several "
            "readings, expected none: a specimen has one weight; leave weights= out"
        )
    for m in earlier:
        if m.propagation.calls_response != measurement.propagation.calls_response:
            raise ValueError(
                f"{name}: propagation: got {called(measurement.propagation)}, and "
                f"{called(m.propagation)} in {m.name}, which has the same specimens, "
                "expected the same kind in both"
            )
        functions = m.responses.function, measurement.responses.function
        if isinstance(functions[0], Runs) != isinstance(functions[1], Runs):
            raise ValueError(
                f"{name}: response: got a table of runs in one and a function in the other of "
                f"{name} and {m.name}, which have the same specimens, expected the same kind in "
                "both; make a table of both"
            )
        if m.gross_errors != measurement.gross_errors:
            raise ValueError(
                f"{name}: metric: gross_errors: got {measurement.gross_errors}, and "
                f"{m.gross_errors} in {m.name}, which has the same specimens, expected "
                "the same in both: a specimen has a gross error in all of its readings or in none"
            )
    return likelihood


def _measurement_variables(
    name: str, model: pm.Model, metric: Any, partners: Sequence[SpecimenLikelihood]
) -> dict[str, TensorVariable]:
    """Return the measurement's model variables by role, after adding the share of gross errors.

    Simulators with the same specimens use the same share of gross errors.
    """
    extras = {}
    for role, value in (metric.roles | {"gross_errors": metric.gross_errors}).items():
        if role == "gross_errors" and value is True:
            value = partners[0].measurements[0].extras.get(role) if partners else None
            value = pm.Beta(f"{name}_gross_errors", 1, 9) if value is None else value
        if not isinstance(value, Variable):
            continue
        label = "error" if role == "relative" else role
        if value not in (*model.free_RVs, *model.deterministics):
            raise TypeError(
                f"{name}: metric: {label}: got {value}, expected a named variable of the model, "
                "such as pm.HalfNormal('error', 0.1), or a number"
            )
        extras[role] = values_of(value)
    return extras


def _refuse_by_specimen(arguments: _Arguments) -> None:
    """Raise if the log-likelihood by specimen does not apply, and name what the model accepts."""
    name, propagation = arguments.name, arguments.propagation
    if arguments.epsilon is not None:
        raise ValueError(
            f"{name}: epsilon: got {arguments.epsilon!r}, expected none: prb.LogLikelihood() is a "
            "likelihood and has no scale to choose; leave epsilon= out"
        )
    try:
        _refuse_inputs(name, arguments.inputs, len(arguments.data))
    except TypeError as error:
        text, leave = str(error), ""
    else:
        text, leave = "", "leave propagation= out, with random scatter of the response as an input"
    if propagation.is_random:
        text = (
            f"{name}: propagation: got {called(propagation)}, expected stored responses of a "
            "deterministic response for prb.LogLikelihood()"
        )
        raise TypeError(advised(text, arguments.other_metric(), leave))
    if text:
        raise TypeError(advised(text, arguments.other_metric()))


def _likelihood_advice(arguments: _Arguments) -> str:
    """Return advice to use the log-likelihood by specimen if the simulator accepts it."""
    try:
        _refuse_by_specimen(arguments)
    except (TypeError, ValueError):
        return ""
    return "leave metric= out, for the log-likelihood by specimen"


def _refuse_inputs(name: str, inputs: Inputs, specimens: int) -> None:
    """Raise TypeError for inputs without a density that varies between specimens."""
    discrete = [x for x in inputs.aleatory if not x.dtype.startswith("float")]
    if discrete:
        raise TypeError(
            f"{name}: got {discrete[0].owner.op}, which is discrete, expected continuous inputs "
            "for prb.LogLikelihood()"
        )
    refuse_nested(name, inputs)
    refuse_without_density(name, inputs)
    if inputs.epistemic:
        names = ", ".join(str(e.name or e) for e in inputs.epistemic)
        raise TypeError(
            f"{name}: got {names}, which goes into the response as a model variable, expected "
            "aleatory inputs and constants for prb.LogLikelihood(); "
            f"{scatter_advice(inputs, specimens)}"
        )


def _checked_specimens(arguments: _Arguments) -> Floats:
    """Return measured outputs, (N,) or (N, m), of at least two specimens."""
    name, outputs = arguments.name, arguments.data.outputs
    values = np.asarray(arguments.data.values, dtype=np.float64)
    if values.ndim not in (1, 2) or len(values) < 2:
        raise ValueError(
            f"{name}: observed: got shape {values.shape}, expected (N,) or (N, m) with at least "
            f"2 specimens; {NO_POPULATION}"
        )
    rows = flat_rows(values)
    if np.isnan(rows).all(axis=1).any():
        row = int(np.flatnonzero(np.isnan(rows).all(axis=1))[0])
        raise ValueError(
            f"{name}: observed: got no measured output of specimen {row}, expected at least one; "
            "leave the specimen out"
        )
    empty = np.isnan(rows).all(axis=0)
    if empty.any():
        label = [*outputs.names, name][int(empty.argmax())]
        raise ValueError(
            f"{name}: observed: got no measured value of the output {label}, expected at least "
            "one; leave the output out, here and in the response or its condition"
        )
    if np.isinf(rows).any():
        text = (
            f"{name}: observed: got infinite values, expected finite ones for prb.LogLikelihood()"
        )
        raise ValueError(advised(text, "leave these specimens out", arguments.other_metric()))
    refuse_huge(rows, f"{name}: observed")
    return values


# Metrics of distributions.


def _add_by_metric(
    arguments: _Arguments, metric: Metric
) -> TensorVariable | tuple[TensorVariable, ...]:
    """Add an observed variable with a metric of distributions, or one for each group."""
    name, model, data, inputs = arguments.name, arguments.model, arguments.data, arguments.inputs
    if repeats_of(arguments.response) > 1:
        arguments = replace(arguments, propagation=_of_random_runs(name, arguments.propagation))
    if inputs.covariates:
        text = (
            f"{name}: inputs: got a population that depends on {inputs.covariates[0].name}, "
            "expected one population, as a metric compares distributions; use prb.response.group "
            "for few different values"
        )
        raise TypeError(advised(text, _likelihood_advice(arguments)))
    try:
        target = _prepared_metric(name, metric, data.values, data.weights)
    except FewSpecimensError as error:
        raise ValueError(advised(str(error), _likelihood_advice(arguments))) from None
    if data.labels is not None:
        _refuse_ambiguous_labels(name, data.labels, list(simulators(model).values()))
    if arguments.epsilon is not None:
        positive_number(arguments.epsilon, f"{name}: epsilon")
    parts = [(name, target, data.labels, "")]
    if inputs.groups is not None:
        parts = _parts_by_group(target, inputs.groups, data)
    scatter = None if arguments.propagation.is_random else 0.01
    variables = []
    for place, (part_name, part, labels, group) in enumerate(parts):
        scale = 1 / effective_specimens(part, labels) if is_likelihood(part) else np.nan
        scale = scale if arguments.epsilon is None else arguments.epsilon
        specification = Specification(
            part_name,
            part,
            arguments.responses(part_name, inputs, scatter),
            arguments.propagation,
            shared_epsilon(part_name, scale),
            labels,
            outputs=data.outputs,
            group=group,
            progressbar=arguments.progressbar,
        )
        values = part.observed if inputs.groups is not None else data.for_pymc(part.observed)
        variables.append(_add_specification(model, specification, place, values, data.dims))
    share_bandwidths(model)
    return tuple(variables) if inputs.groups is not None else variables[0]


def _of_random_runs(name: str, propagation: Propagation) -> Propagation:
    """Return the propagation of a random response, whose runs are a sample of its distribution."""
    # An emulator would interpolate between runs whose differences are noise.
    if propagation.is_random:
        return propagation
    emulator = getattr(propagation, "emulator", propagation)
    if emulator is None or isinstance(emulator, str):
        return replace(cast(Reweighted, propagation), emulator=None)
    raise TypeError(
        f"{name}: propagation: got {called(propagation)} for a random response "
        "(prb.response.Stochastic) and a metric, expected prb.Reweighted(n) without an emulator, "
        "whose runs are kept, or prb.Fresh(n)"
    )


def _add_specification(
    model: pm.Model,
    specification: Specification,
    place: int,
    observed: Any,
    dims: Names | None,
) -> TensorVariable:
    """Add an observed variable with a metric of distributions; ``place`` is its group's index."""
    name, target, labels = specification.name, specification.target, specification.specimens
    responses, inputs = specification.responses, specification.responses.inputs
    earlier = list(simulators(model).values())
    check_propagation(name, specification.propagation, inputs, target)
    for simulator in earlier:
        has_same_propagation = simulator.propagation == specification.propagation
        if has_same_propagation and responses.same_as(simulator.responses):
            responses.share(simulator.responses)
            break
    if labels is None:
        report(*duplicate_findings(name, target.observed))
    else:
        _warn_shared_specimens(specification, labels, earlier)
    aleatory = set(inputs.aleatory)
    same_inputs = tuple(
        simulator.name
        for simulator in earlier
        if simulator.group == specification.group
        and not aleatory.isdisjoint(simulator.responses.inputs.aleatory)
    )
    group = pt.constant(place, dtype="int64")
    params = [group if is_group(v) else v for v in inputs.parents]
    signature = rv_signature([p.type.ndim for p in params], len(target.event))
    reference = weakref.ref(specification)
    names = (*same_inputs, name)
    operation = SimulatorRV(signature=signature, reference=reference, simulators=names)
    rv = SimulatorDistribution(name, *params, operation=operation, observed=observed, dims=dims)
    # The owner is set at once, because a clone of the model could become the owner otherwise.
    rv.owner.op.owner = weakref.ref(rv.owner)
    return rv


def _parts_by_group(
    target: Discrepancy, groups: Groups, data: ObservedData
) -> list[tuple[str, Discrepancy, NDArray[Any] | None, str]]:
    """Return name, prepared metric, labels and group name of each group."""
    name, labels, places = data.name, data.labels, np.asarray(data.groups)
    if data.dims is not None:
        raise ValueError(
            f"{name}: dims: got {list(data.dims)}, expected none: specimens are divided into the "
            f"groups {groups.names}, each with observed values of its own; leave dims= out"
        )
    place_of: dict[object, int] = {}
    for label, place in zip([] if labels is None else labels.tolist(), places, strict=False):
        first = place_of.setdefault(label, place)
        if first != place:
            raise ValueError(
                f"{name}: specimens: got the label {label!r} in {groups.names[first]} and in "
                f"{groups.names[place]}, expected each specimen in one group; write labels that "
                "are different"
            )
    parts = []
    for place, group in enumerate(groups.names):
        rows = places == place
        weights = target.weights[rows] if np.ptp(target.weights) > 0 else None
        part_name = groups.name(name, place)
        part = _prepared_metric(part_name, target.metric, target.observed[rows], weights)
        parts.append((part_name, part, None if labels is None else labels[rows], group))
    return parts


def _prepared_metric(
    name: str, metric: Metric, observed: Floats, weights: ArrayLike | None
) -> Discrepancy:
    """Return the metric, prepared for the observed responses; errors begin with the name."""
    if not isinstance(metric, Metric):
        raise wrong_value(
            metric,
            f"{name}: metric",
            "a metric object such as prb.ProbabilityResidual() or prb.AreaMetric(); wrap a "
            "function of your own in prb.FunctionMetric(f)",
        )
    try:
        if np.ndim(observed) != 2:
            least = 1 if metric.exact_likelihood else 2
            observed = observed_sample(observed, minimum=least, failures=metric.counts_failures)
        elif len(observed) < 2 and not metric.exact_likelihood:
            raise ValueError(
                f"observed: got {counted(len(observed), 'specimen')}, expected at least 2 of "
                f"them; {NO_POPULATION}"
            )
        target = metric.against(observed, weights)
        if not metric.symbolic:
            try_function(target)
        return target
    except (TypeError, ValueError) as error:
        values = np.asarray(observed, dtype=np.float64)
        is_sample = values.ndim == 1 and values.size
        causes = outlier_findings(name, values, np.empty(0), ()) if is_sample else ()
        cause = "".join(f" {finding.text}" for finding in causes)
        raise type(error)(f"{name}: {error}{cause and f'.{cause}'}") from None


def try_function(target: Discrepancy) -> None:
    """Call a user's function before any run, for two populations in the range of the data."""
    finite = finite_or_nan(target.observed)
    low, high = np.nanmin(finite, axis=0), np.nanmax(finite, axis=0)
    trial = np.linspace(low, high, 2 * len(finite)).reshape(2, *finite.shape)
    with np.errstate(all="ignore"):
        target(trial)


def _warn_shared_specimens(
    simulator: AnySimulator, labels: NDArray[Any], earlier: list[AnySimulator]
) -> None:
    """Warn if default epsilons of several simulators count the same specimens more than once."""
    for second in earlier:
        if second.specimens is None or set(labels.tolist()).isdisjoint(second.specimens.tolist()):
            continue
        if has_default_epsilon(simulator) or has_default_epsilon(second):
            report(
                Finding(
                    "shared-specimens",
                    f"{second.name} and {simulator.name} share specimens, and each epsilon counts "
                    "them: under pm.sample they count twice, and the posterior is too narrow; "
                    "call prb.set_epsilon(model, prb.calibrate_epsilon(prb.minimize(model))) "
                    "before, or use prb.sample, whose posterior counts them once.",
                )
            )


def _refuse_ambiguous_labels(
    name: str, labels: NDArray[Any], earlier: Sequence[AnySimulator | Measurement]
) -> None:
    """Raise if labels look alike but differ, as 1 and "1", which would be two specimens."""
    first_use: dict[str, tuple[str, object]] = {}
    labels_of = [(simulator.name, simulator.specimens) for simulator in earlier]
    for simulator, specimens in [*labels_of, (name, labels)]:
        for label in [] if specimens is None else specimens.tolist():
            first, first_label = first_use.setdefault(label_text(label), (simulator, label))
            if first_label != label:
                raise TypeError(
                    f"{name}: specimens: got the label {label!r} and, in {first}, "
                    f"{first_label!r}, expected labels of one type, since these would count as "
                    "two specimens; pass numbers, or strings, in all simulators"
                )
