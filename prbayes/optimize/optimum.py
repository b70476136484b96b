"""`Optimum`, the result of `minimize`, and its storage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._display import view, without_constructor
from prbayes._finding import Findings, as_json
from prbayes._validate import Floats, NamedArrays, Names
from prbayes.inference.asymptotics import Local
from prbayes.inference.checks.identification import breakdown_findings, no_information
from prbayes.inference.checks.population import failing_share
from prbayes.inference.refits import (
    SamplingDistribution,
    refit_obstacle,
    sampling_obstacle,
    sampling_of_functions,
)
from prbayes.metrics.multivariate import components_of
from prbayes.model.description import (
    as_attribute,
    failures_dataset,
    labelled,
    observed_dataset,
    versions,
    without_addresses,
)
from prbayes.model.evaluator import (
    Evaluator,
    has_other_terms,
    likelihood_of,
    missing_mass,
    specimen_log_likelihoods,
    with_data,
)
from prbayes.model.fingerprint import (
    Identity,
    Level,
    as_attributes,
    identity_from_attributes,
    identity_of,
    require_same,
    require_same_responses,
)
from prbayes.model.locking import locked
from prbayes.model.parameters import (
    THETAS,
    optimum_elements,
    readable_variables,
    single_elements,
    split_elements,
    table_elements,
)
from prbayes.model.specimen_preparation import prepared
from prbayes.numerics.derivatives import cross, slopes
from prbayes.optimize.convergence import OVERLAP, Fit, Result, Search, stored_overlap

# Smallest share that is not displayed as 0.0%
SMALLEST_SHARE = 5e-4
NO_RESPONSE = "have no response (NaN) and are left out"


@dataclass(frozen=True, eq=False)
class SearchRecord:
    """How a minimisation went, and what it cost.

    Attributes
    ----------
    result : Result
        How it ended, with a message.
    details : str
        Sentences with the numbers behind the result.
    prior : bool
        Whether minus the log prior was part of the objective.
    n_evaluations : int
        Evaluations of the objective by the optimiser. One with an exact gradient counts as one; of
        a gradient by differences each evaluation counts.
    n_screened : int
        Points of the prior that were tried as starting points, in one batch.
    n_computed : int
        Responses computed for the model up to the end, without those found in a store.
    seconds : float
    trace : dict
        ``theta`` (n, d), ``discrepancy`` (n,) and ``evaluations`` (n,) of each point that the
        optimiser evaluated: unconstrained hyperparameters, the objective, and the evaluations up to
        the point.
    stopped : str
        The budget that ended the minimisation; empty if none. What would have cost responses is
        then NaN or left out.
    at_edge : tuple of str
        Elements that moved far out, where the discrepancy no longer depends on them: their best
        value is at the edge of the support, and standard errors are not known.
    at_jump : tuple of str
        Simulators whose discrepancy jumps at the optimum, as points lose their response there;
        standard errors are not known.
    support : dict
        By simulator: ``lost_mass``, the share of the population at the optimum without response
        (NaN), and ``failed_mass``, the share of failed specimens (+inf) in the rest; with
        `Reweighted` also ``weight_ess`` and ``mean_weight``.
    identity : Identity or None
        Fingerprint of the problem.
    """

    result: Result
    details: str = ""
    prior: bool = False
    n_evaluations: int = 0
    n_screened: int = 0
    n_computed: int = 0
    seconds: float = 0.0
    trace: NamedArrays = field(default_factory=dict)
    stopped: str = ""
    at_edge: Names = ()
    at_jump: Names = ()
    support: dict[str, dict[str, float]] = field(default_factory=dict)
    identity: Identity | None = None


# -- display ---------------------------------------------------------------------------------------


def _heading(optimum: Optimum) -> str:
    """Return the discrepancy and its cost in words."""
    kind = "Optimum with the prior" if optimum.search.prior else "Optimum"
    label = "discrepancy" if optimum.evaluator.nodes else "minus log-likelihood"
    state = "converged" if optimum.converged else "NOT converged"
    return (
        f"{kind}: {label} {optimum.discrepancy:.4g} after {optimum.search.n_evaluations} "
        f"evaluations, {optimum.n_responses} responses, {state}"
    )


def _rows(optimum: Optimum) -> list[list[str]]:
    """Return name, estimate and standard error in words.

    Elements with labels, and those of matrices, have rows of their own, up to twenty of a variable.
    """

    def short(value: Any) -> str:
        return np.array2string(
            np.asarray(value), precision=4, threshold=8, formatter={"float_kind": "{:.4g}".format}
        )

    point = labelled(optimum.evaluator, optimum.point, {}).data_vars
    stderr = labelled(optimum.evaluator, optimum.stderr, {}).data_vars
    names = [str(name) for name in point]
    rows = []
    for name in readable_variables(names, names):
        value, error = point[name], stderr[name]
        has_rows = value.ndim == 2 or (value.ndim == 1 and bool(value.coords))
        if not has_rows or value.size > 20:
            rows.append([name, short(value), short(error)])
            continue
        for element, *numbers in _elements({name: value}, {name: error}):
            rows.append([element, *map(short, numbers)])
    return rows


def _elements(
    point: Mapping[Any, xr.DataArray], stderr: Mapping[Any, xr.DataArray]
) -> list[tuple[str, float, float]]:
    """Return name, estimate and standard error of each element in a table."""
    values, errors = single_elements(point), single_elements(stderr)
    return [(name, values[name], errors[name]) for name in optimum_elements(point, stderr)]


def _failures_and_findings(optimum: Optimum) -> list[str]:
    """Return the shares of specimens that fail or have no response, and the findings."""
    sentences = []
    for name, support in optimum.search.support.items():
        for key, verb in (("failed_mass", "fail"), ("lost_mass", NO_RESPONSE)):
            share = support.get(key, 0.0)
            if share >= SMALLEST_SHARE:
                sentences.append(f"{name}: {share:.1%} of specimens {verb}")
    return [*sentences, *map(str, optimum.findings)]


def _text(optimum: Optimum) -> str:
    """Return the estimates, their cost, and the findings."""
    rows = [f"{name} = {value} ± {error}" for name, value, error in _rows(optimum)]
    return "\n  ".join([_heading(optimum), *rows, *_failures_and_findings(optimum)])


def _html(optimum: Optimum) -> str:
    """Return estimates, cost and findings as a table for a notebook."""
    header = ["", "estimate", "standard error"]
    return view(
        _heading(optimum),
        header=header,
        rows=_rows(optimum),
        sentences=_failures_and_findings(optimum),
    )


@dataclass(frozen=True, eq=False, repr=False)
class PointEstimate:
    """An estimate of the hyperparameters of a model, with standard errors."""

    point: dict[str, Any]
    stderr: dict[str, Any]
    theta: Floats
    covariance: Floats
    evaluator: Evaluator

    @property
    def model(self) -> pm.Model:
        """The model."""
        return self.evaluator.model

    @property
    def initvals(self) -> dict[str, Any]:
        """The free variables at the optimum.

        For ``pm.sample(initvals=optimum.initvals, init="adapt_diag")``, which starts every chain
        there: PyMC's default jitter can move a chain into another mode.
        """
        return {str(rv.name): self.point[str(rv.name)] for rv in self.model.free_RVs}

    def to_dataframe(self) -> Any:
        """Return a row for each number: its estimate and standard error."""
        import pandas as pd

        point = labelled(self.evaluator, self.point, {}).data_vars
        stderr = labelled(self.evaluator, self.stderr, {}).data_vars
        columns = ["hyperparameter", "estimate", "standard error"]
        rows = _elements(point, stderr)
        return pd.DataFrame(rows, columns=columns).set_index("hyperparameter")


@without_constructor
@dataclass(frozen=True, eq=False, repr=False)
class Optimum(PointEstimate):
    """The result of `minimize`; numerical failure is a value in it, not an exception.

    Attributes
    ----------
    point : dict
        Hyperparameters and deterministics by name, in the user's units.
    stderr : dict
        Standard errors by name, in the user's units: the sampling standard deviation of the
        estimator; infinite along directions that the data do not identify; NaN where not known, as
        at the edge of a support.
    theta : ndarray, shape (d,)
        The optimum in unconstrained space.
    covariance : ndarray, shape (d, d)
        Sampling covariance in unconstrained space.
    evaluator : Evaluator
        The model, and its simulators at any hyperparameters.
    discrepancy : float
        The minimised sum of d_k / s_k; with one simulator, its discrepancy.
    discrepancies : dict
        Discrepancy by simulator; of several with `AreaMetric` as in its notes.
    scales : dict
        The s_k by simulator.
    n_responses : int
        Scalar responses that this optimum took, including the design's and those found in a store.
    design_error : float
        Distance to the optimum of an independent design of the same size, in standard errors along
        the worst direction; NaN where it is not known (`Resimulated`) or negligible (one input).
    local_optima : tuple of dict
        Other optima, such as mirror solutions: ``point``, ``discrepancy`` (the sum of d_k / s_k),
        ``theta``, and ``comparable``, whether the data could as well come from there.
    findings : tuple of Finding
        What is not identified, and what else to know of the answer; also logged.
    search : SearchRecord
        How the minimisation went, and what it cost.

    Examples
    --------
    >>> import pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
    ...     )
    >>> optimum = prb.minimize(model)
    >>> optimum.converged, list(optimum.point), list(optimum.stderr)
    (True, ['mu'], ['mu'])
    """

    discrepancy: float
    discrepancies: dict[str, float]
    scales: dict[str, float]
    n_responses: int
    search: SearchRecord
    design_error: float = np.nan
    local_optima: tuple[dict[str, Any], ...] = ()
    findings: Findings = ()

    __repr__ = _text
    _repr_html_ = _html

    @property
    def converged(self) -> bool:
        """Whether the minimum is found."""
        return self.search.result.converged

    @property
    def message(self) -> str:
        """How the minimisation ended."""
        return f"{self.search.result.value} {self.search.details}".strip()

    @property
    def failures(self) -> xr.Dataset:
        """Points whose response failed for the model so far.

        Dims (failure) and (failure, column): ``simulator``, ``inputs``, the arguments of the
        response one after the other, and ``reason``.
        """
        return failures_dataset(self.evaluator)

    @locked
    def sampling(self) -> SamplingDistribution:
        """Return the sampling distribution of the minimiser around the optimum.

        Raises
        ------
        ValueError
            If the optimum is at the edge of a support or at a jump, if the prior was part of the
            objective, or if the model has changed since.
        TypeError
            If a discrepancy is random, or a metric without stored responses does not declare its
            behaviour at the minimum.
        """
        require_sampling(self, "sampling")
        obstacle = sampling_obstacle(self.evaluator)
        if obstacle is not None:
            raise TypeError(f"sampling: {obstacle}")
        require_minimiser(self, "sampling")
        scales = np.array(list(self.scales.values()))
        return SamplingDistribution.of(self.evaluator, self.theta, scales)

    def to_datatree(self) -> xr.DataTree:
        """Return the optimum as a DataTree.

        Groups ``optimum``, ``stderr``, ``trace``, ``calibration`` and ``observed_data``, and
        ``failures`` if there are any.
        """
        search = self.search
        attributes = {
            "discrepancy": self.discrepancy,
            "converged": int(self.converged),
            "prior": int(search.prior),
            "message": self.message,
            "stopped": search.stopped,
            "n_evaluations": search.n_evaluations,
            "n_screened": search.n_screened,
            "n_responses": self.n_responses,
            "seconds": search.seconds,
            "findings": as_json(self.findings),
            **versions(),
            **as_attribute(self.model),
            **as_attributes(search.identity),
        }
        trace = {
            "theta": (["evaluation", "element"], search.trace["theta"]),
            "discrepancy": ("evaluation", search.trace["discrepancy"]),
            "evaluations": ("evaluation", search.trace["evaluations"]),
        }
        elements = {"element": self.evaluator.hyperparameters.names}
        groups = {
            "optimum": labelled(self.evaluator, self.point, {}).assign_attrs(attributes),
            "stderr": labelled(self.evaluator, self.stderr, {}),
            "trace": xr.Dataset(trace, coords=elements),
            "calibration": _calibration_dataset(self),
            "observed_data": observed_dataset(self.evaluator),
        }
        failures = self.failures
        if failures.sizes["failure"]:
            groups["failures"] = failures
        return xr.DataTree.from_dict(groups)


# -- from the end of a minimisation ----------------------------------------------------------------


def optimum_of(search: Search, fit: Fit, record: SearchRecord, n_previous: int) -> Optimum:
    """Return the optimum of a fit, without findings, local optima and design error.

    ``n_previous`` responses were computed before the search. No response is computed if a budget
    has stopped it.
    """
    evaluator, theta, scales = search.evaluator, fit.theta, fit.scales
    hyperparameters = evaluator.hyperparameters
    covariance = fit.covariance
    functions = None if fit.sampling is None else sampling_of_functions(fit.sampling)
    point, stderr = point_and_stderr(evaluator, theta, covariance, functions)
    # Report how the search ended, unless its end is no minimum. If all variances are infinite or
    # rounding errors, check whether the discrepancy changes at all.
    is_affordable = not (record.stopped and evaluator.responses_per_theta)
    variance = np.diag(covariance) / hyperparameters.prior_sd**2
    is_suspect = bool((np.isinf(variance) | (variance < 1e-16)).all())
    is_flat = is_suspect and no_information(evaluator, theta)
    result = fit.result
    if record.stopped:
        result = Result.STOPPED
    elif record.at_edge:
        result = Result.AT_EDGE
    elif is_flat:
        result = Result.NO_INFORMATION
    elif is_affordable and not search.settings.prior and stored_overlap(evaluator, theta) < OVERLAP:
        # Without overlap the minimum is not a fit, because the data lie beyond the metric's grid,
        # and the discrepancy measures only the mass there.
        result = Result.NO_OVERLAP
    if is_affordable:
        values = evaluator(theta[None]).discrepancies[0]
    elif len(scales) > 1 or search.settings.prior or has_other_terms(evaluator.model):
        values = np.full(len(scales), np.nan)
    else:
        values = fit.lowest * scales
    n_responses = evaluator.n_responses - n_previous  # counted before the support computes any
    support = {
        name: {key: float(value[0]) for key, value in numbers.items()}
        for name, numbers in evaluator.support(theta[None]).items()
    }
    for k, node in enumerate(evaluator.nodes):
        if node.reweighted is None and is_affordable:
            support[node.name] = missing_mass(evaluator, theta, k)
    names = [node.name for node in evaluator.nodes]
    identity = identity_of(evaluator, prior_minimised=search.settings.prior)
    return Optimum(
        point=point,
        stderr=stderr,
        theta=theta,
        covariance=covariance,
        evaluator=evaluator,
        discrepancy=float((values / scales).sum()),
        discrepancies=dict(zip(names, map(float, values), strict=True)),
        scales=dict(zip(names, map(float, scales), strict=True)),
        n_responses=n_responses,
        search=replace(
            record,
            result=result,
            n_evaluations=fit.trace.count,
            trace={
                "theta": np.array(fit.trace.thetas).reshape(-1, theta.size),
                "discrepancy": np.array(fit.trace.values),
                "evaluations": np.array(fit.trace.counts, dtype=np.int64),
            },
            support=support,
            identity=identity,
        ),
    )


def n_computed(evaluator: Evaluator) -> int:
    """Return the number of responses computed for a model, without those found in a store."""
    return sum(simulator.responses.computed for simulator in with_data(evaluator))


def point_text(evaluator: Evaluator, theta: Floats) -> str:
    """Return the free variables at theta in words, without constants."""
    hyperparameters = evaluator.hyperparameters
    # Constants are recognised by a comparison with a second point.
    points = hyperparameters.constrained(np.stack([theta, hyperparameters.initial]))
    names = readable_variables([str(rv.name) for rv in evaluator.model.free_RVs], points)
    values = labelled(evaluator, {name: points[name] for name in names}, {"point": 2}).data_vars
    elements = split_elements(values)
    return ", ".join(f"{name} = {elements[name][0]:.4g}" for name in table_elements(values))


def local_optimum(
    evaluator: Evaluator, theta: Floats, value: float, *, comparable: bool
) -> dict[str, Any]:
    """Return the record of a local optimum in `Optimum.local_optima`."""
    values = evaluator.hyperparameters.constrained(theta[None])
    point = {name: _number(value[0]) for name, value in values.items()}
    return {"point": point, "discrepancy": value, "theta": theta, "comparable": comparable}


def point_and_stderr(
    evaluator: Evaluator, theta: Floats, covariance: Floats, functions: Local | None = None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return variables and deterministics in the user's units, and their standard errors."""
    hyperparameters = evaluator.hyperparameters
    step = 1e-4 * hyperparameters.prior_sd  # any small step will do, because transforms are smooth
    values = hyperparameters.constrained(cross(theta, step))
    prior = hyperparameters.constrained(hyperparameters.prior_thetas(THETAS, seed=0))
    deterministics = {str(variable.name) for variable in evaluator.model.deterministics}
    stderr = {}
    for name, value in values.items():
        gradients = slopes(value, step)
        errors = delta_method(gradients, covariance)
        if functions is not None and name in deterministics:
            # Functions of unidentified elements may be identified: require a smaller error than the
            # prior's spread.
            faint = np.sqrt(functions.variance(gradients))
            upper, lower = np.quantile(prior[name], [0.84, 0.16], axis=0)
            errors = np.where(np.isinf(errors) & (faint < (upper - lower) / 2), faint, errors)
        # Constants, such as the diagonal of a correlation matrix, vary by rounding alone.
        ranges = np.ptp(np.concatenate([value, prior[name]]), axis=0)
        is_constant = ranges <= 1e-12 * np.abs(value[0])
        stderr[name] = _number(np.where(is_constant, 0.0, errors))
    return {name: _number(value[0]) for name, value in values.items()}, stderr


def delta_method(gradients: Floats, covariance: Floats) -> Floats:
    """Return standard errors of functions with gradients (..., d); inf, or NaN at a bound."""
    is_infinite = np.isinf(covariance)
    finite = np.where(is_infinite, 0.0, covariance)
    variance = np.einsum("...i,ij,...j->...", gradients, finite, gradients)
    size = np.abs(gradients)
    is_touched = np.einsum("...i,ij,...j->...", size, is_infinite.astype(float), size) > 0
    # At a bound of the support a function of theta may have a gradient of zero. Then its standard
    # error is unknown, not zero.
    is_at_bound = is_infinite.any() & (gradients == 0).all(axis=-1)
    variance = np.where(is_touched, np.inf, np.maximum(variance, 0))
    return np.sqrt(np.where(is_at_bound, np.nan, variance))


def _number(value: Any) -> Any:
    """Return a float, or an array of several numbers."""
    return float(value) if np.ndim(value) == 0 else np.asarray(value)


# -- requirements ----------------------------------------------------------------------------------


def refuse_model(result: object, caller: str) -> None:
    """Raise if a model is passed instead of a result."""
    if isinstance(result, pm.Model):
        raise TypeError(
            f"{caller}: got a Model, expected a result of prb.minimize or prb.sample; pass the "
            "model as model="
        )


def require_sampling(optimum: Optimum, caller: str) -> Optimum:
    """Return the optimum, or raise if it is at the edge of a support or at a jump."""
    findings = breakdown_findings(optimum.search.at_edge, optimum.search.at_jump)
    if findings:
        reasons = " ".join(map(str, findings))
        raise ValueError(
            f"{caller}: got an optimum without standard errors or curvature: {reasons} Use "
            "prb.sample_smc(epsilon=..., adjustment=None), which needs no optimum"
        )
    return optimum


def require_refits(optimum: object, caller: str, advice: str) -> Optimum:
    """Return an optimum whose model can be calibrated to other data sets, or raise with advice."""
    if not isinstance(optimum, Optimum):
        got = type(optimum).__name__
        raise TypeError(f"{caller}: got {got}, expected an Optimum; call prb.minimize() first")
    obstacle = refit_obstacle(require_sampling(optimum, caller).evaluator)
    if obstacle is not None:
        raise ValueError(f"{caller}: {obstacle}{advice}")
    return require_minimiser(optimum, caller)


def require_minimiser(optimum: Optimum, caller: str) -> Optimum:
    """Return an optimum without the prior, whose model has not changed since, or raise."""
    expected = identity_of(optimum.evaluator, prior_minimised=False)
    require_same(optimum.search.identity, expected, caller)
    return optimum


def require_of_model(result: Any, model: pm.Model, caller: str, level: Level) -> None:
    """Raise with all differences if a result is of another problem than a model's."""
    identity, expected = identity_in(result), identity_of(model)
    require_same(identity, expected, caller, level)
    require_same_responses(identity, expected, model, caller)


def identity_in(result: Any) -> Identity | None:
    """Return the fingerprint in an Optimum, a DataTree or a Dataset; None without one."""
    if isinstance(result, Optimum):
        return result.search.identity
    if isinstance(result, xr.Dataset):
        return identity_from_attributes(result.attrs)
    if not isinstance(result, xr.DataTree):
        return None
    group = "posterior" if "posterior" in result.children else "optimum"
    return identity_from_attributes(result[group].attrs) if group in result.children else None


def element_order(optimum: Optimum, evaluator: Evaluator) -> list[int]:
    """Return the places of an evaluator's elements in an optimum, whose model may be a clone."""
    names = optimum.evaluator.hyperparameters.names
    return [names.index(name) for name in evaluator.hyperparameters.names]


def optima_of(optimum: Optimum, evaluator: Evaluator, *, comparable: bool = True) -> Floats:
    """Return the optimum and local optima, (M, d), in the evaluator's order of elements.

    By default these are the comparable ones. The order may differ in a clone of the optimum's
    model.
    """
    order = element_order(optimum, evaluator)
    modes = [m["theta"] for m in optimum.local_optima if m["comparable"] or not comparable]
    return np.array([optimum.theta, *modes])[:, order]


# -- storage ---------------------------------------------------------------------------------------


def simulator_records(evaluator: Evaluator) -> list[dict[str, Any]]:
    """Return name, settings and runs of each simulator, log-likelihoods by specimen last."""
    records = [
        {
            "simulator": node.name,
            "metric": without_addresses(node.metric),
            "compared": "; ".join(c.summary for c in components_of(node.target)),
            "is_likelihood": 0,
            "n_runs": node.bound.n_runs,
        }
        for node in evaluator.nodes
    ]
    for measurement in evaluator.measurements:
        emulation = prepared(likelihood_of(evaluator, measurement)).emulation
        record = {
            "simulator": measurement.name,
            "metric": without_addresses(measurement.metric),
            "compared": "",
            "is_likelihood": 1,
            "n_runs": len(emulation.z),
        }
        records.append(record)
    return records


def by_simulator(records: list[dict[str, Any]]) -> xr.Dataset:
    """Return records as variables of one dimension, NaN where a simulator has no number."""
    keys = dict.fromkeys(key for record in records for key in record)
    return xr.Dataset(
        {key: ("simulator", [record.get(key, np.nan) for record in records]) for key in keys}
    )


def _calibration_dataset(optimum: Optimum) -> xr.Dataset:
    """Return the figures of the simulators at the optimum, and its covariance."""
    evaluator, records = optimum.evaluator, simulator_records(optimum.evaluator)
    likelihoods = specimen_log_likelihoods(evaluator, optimum.theta[None])
    failing = failing_share(evaluator, optimum.theta)
    for record in records:
        name = record["simulator"]
        if name in optimum.discrepancies:
            discrepancy = optimum.discrepancies[name]
        else:
            discrepancy = -float(likelihoods[name].sum())
        support = optimum.search.support.get(name, {})
        record |= {"discrepancy": discrepancy, "scale": optimum.scales.get(name, 1.0)}
        for key in ("weight_ess", "mean_weight", "lost_mass", "failed_mass"):
            record[key] = support.get(key, np.nan)
        record["failing_share"] = failing.get(name, np.nan)
    names = evaluator.hyperparameters.names
    variables = {
        "theta": ("element", optimum.theta),
        "covariance": (["element", "other_element"], optimum.covariance),
    }
    figures = by_simulator(records).assign_coords(element=names, other_element=names)
    return figures.assign(variables)


def compared_in(calibration: xr.Dataset) -> Names:
    """Return how simulators compare several outputs together."""
    if "compared" not in calibration:
        return ()
    clauses = calibration["compared"].values.tolist()
    pairs = zip(calibration["simulator"].values.tolist(), clauses, strict=True)
    return tuple(f"{name}: {clause}." for name, clause in pairs if clause)
