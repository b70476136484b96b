"""`Optimum`: what `minimize` returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._display import view
from prbayes._finding import Finding, as_json
from prbayes._validate import Floats
from prbayes.inference.checks.flat_edge import breakdown_findings
from prbayes.inference.refits import SamplingDistribution
from prbayes.inference.requirements import refit_obstacle, sampling_obstacle
from prbayes.metrics.multivariate import components_summary
from prbayes.model.description import as_attribute, without_addresses
from prbayes.model.elements import optimum_elements, readable_variables, single_elements
from prbayes.model.evaluator import Evaluator, likelihood_of, specimen_log_likelihoods
from prbayes.model.fingerprint import (
    Identity,
    Level,
    as_attributes,
    from_attributes,
    identity_of,
    identity_of_model,
    require_same,
)
from prbayes.model.labels import failures_dataset, labelled, observed_dataset, versions
from prbayes.model.locking import locked
from prbayes.model.specimen_preparation import prepared

# What is less is written as 0.0%.
TOLD_SHARE = 5e-4
# Elements of a variable that make as many lines.
_ONE_BY_ONE = 20
# How specimens whose response is NaN are told of.
NO_RESPONSE = "have no response (NaN) and are left out"


@dataclass(frozen=True, eq=False, repr=False)
class Optimum:
    """The result of `minimize`; numerical failure is a value in it, not an exception.

    Attributes
    ----------
    point : dict
        Hyperparameters and deterministics by name, in the user's own units.
    discrepancy : float
        The minimised sum of d_k / s_k; with one simulator, its discrepancy.
    discrepancies : dict
        Discrepancy by simulator.
    scales : dict
        The s_k by simulator.
    n_evaluations : int
        Evaluations of the objective by the optimiser; one with an exact gradient counts as one,
        each of those that make a gradient by differences counts too.
    n_screened : int
        Points of the prior that were tried as starting points, in one batch.
    n_responses : int
        Scalar responses that this optimum took, the design's included, and those found in a store;
        `n_computed` has how many were computed.
    converged : bool
    message : str
        What the optimiser said.
    stderr : dict
        Standard errors by name, in the user's own units: the estimator's sampling standard
        deviation; infinite along directions that the data do not identify; NaN where nothing is
        known, as at the edge of a support.
    covariance : ndarray, shape (d, d)
        Sampling covariance in unconstrained space.
    theta : ndarray, shape (d,)
        The optimum in unconstrained space.
    names : list of str
        Names of the elements of theta.
    support : dict
        By simulator: ``lost_mass``, the share of the population at the optimum that has no
        response (NaN), and ``failed_mass``, that of specimens that failed (+inf) in the rest; with
        `Reweighted` also ``weight_ess`` and ``mean_weight``.
    trace : dict
        ``theta`` (n, d), ``discrepancy`` (n,) and ``evaluations`` (n,) of each point that the
        optimiser asked for: unconstrained hyperparameters, the objective there, and how many
        evaluations there were until then.
    seconds : float
    design_error : float
        How far the optimum of an independent design of the same size would be, in standard errors,
        along the worst direction; NaN where it is not known (`Resimulated`) or is negligible (one
        input).
    rivals : tuple of dict
        Other optima, such as mirror solutions: ``point``, ``discrepancy`` (the sum of d_k / s_k),
        ``theta``, and ``comparable``, whether the data could as well come from there.
    findings : tuple of Finding
        What is not identified, and what else to know of the answer; also logged.
    at_edge : tuple of str
        Elements that went far out, where no change of them changes the discrepancy: their best
        value is at the edge of the support, the optimiser has not converged, and nothing is known
        of standard errors.
    at_jump : tuple of str
        Simulators whose discrepancy jumps at the optimum, since points lose their response there:
        nothing is known of standard errors.
    prior : bool
        Whether minus the log prior was part of the objective.
    stopped : str
        Which budget ended it before it was finished; empty if none. It has not converged then, and
        what would have cost responses is NaN or left out.
    identity : Identity or None
        Of the problem that was solved, by which it is known again.
    """

    point: dict[str, Any]
    discrepancy: float
    discrepancies: dict[str, float]
    scales: dict[str, float]
    n_evaluations: int
    n_screened: int
    n_responses: int
    converged: bool
    message: str
    stderr: dict[str, Any]
    covariance: Floats
    theta: Floats
    names: list[str]
    evaluator: Evaluator
    support: dict[str, dict[str, float]] = field(default_factory=dict)
    trace: dict[str, Floats] = field(default_factory=dict)
    seconds: float = 0.0
    design_error: float = np.nan
    rivals: tuple[dict[str, Any], ...] = ()
    findings: tuple[Finding, ...] = ()
    at_edge: tuple[str, ...] = ()
    at_jump: tuple[str, ...] = ()
    prior: bool = False
    stopped: str = ""
    identity: Identity | None = None

    def __repr__(self) -> str:
        """Show the answer, what it cost, and what is to be said of it."""
        found = [f"{name} = {value} ± {error}" for name, value, error in self._told()]
        return "\n  ".join([self._heading(), *found, *self._shares(), *map(str, self.findings)])

    def _repr_html_(self) -> str:
        """Show the same in a notebook, as a table."""
        rows = [list(told) for told in self._told()]
        header = ["", "estimate", "standard error"]
        sentences = [*self._shares(), *map(str, self.findings)]
        return view(self._heading(), header=header, rows=rows, sentences=sentences)

    def _told(self) -> list[tuple[str, str, str]]:
        """Return name, estimate and standard error in words.

        Elements with labels, and those of matrices, one by one.
        """
        point = labelled(self.evaluator, self.point, {}).data_vars
        stderr = labelled(self.evaluator, self.stderr, {}).data_vars
        rows = []
        names = [str(name) for name in point]
        for name in readable_variables(names, names):
            value, error = point[name], stderr[name]
            alone = value.ndim == 2 or (value.ndim == 1 and bool(value.coords))
            if not alone or value.size > _ONE_BY_ONE:
                rows.append((name, _short(value), _short(error)))
                continue
            values, errors = single_elements({name: value}), single_elements({name: error})
            for element in optimum_elements({name: value}, {name: error}):
                rows.append((element, _short(values[element]), _short(errors[element])))
        return rows

    def _heading(self) -> str:
        """Say how good it is, and what it cost."""
        state = "converged" if self.converged else "NOT converged"
        what = "Optimum with the prior" if self.prior else "Optimum"
        label = "discrepancy" if self.evaluator.nodes else "minus log-likelihood"
        value = f"{label} {self.discrepancy:.4g}"
        head = f"{what}: {value} after"
        return f"{head} {self.n_evaluations} evaluations, {self.n_responses} responses, {state}"

    def _shares(self) -> list[str]:
        """Say which share of the specimens fails, or has no response, where some do."""
        said = []
        for name, each in self.support.items():
            for key, what in (("failed_mass", "fail"), ("lost_mass", NO_RESPONSE)):
                share = each.get(key, 0.0)
                if share >= TOLD_SHARE:
                    said.append(f"{name}: {share:.1%} of specimens {what}")
        return said

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

    @property
    def n_computed(self) -> int:
        """Responses computed for the model so far.

        Without those found in a store, with those computed again.
        """
        evaluator = self.evaluator
        by_metric = sum(node.bound.responses.computed for node in evaluator.nodes)
        return by_metric + sum(m.responses.computed for m in evaluator.measurements)

    @property
    def failures(self) -> xr.Dataset:
        """Points whose response failed for the model so far.

        Dims (failure) and (failure, column): ``simulator``, ``inputs``, the arguments of the
        response one after the other, and ``reason``.
        """
        return failures_dataset(self.evaluator)

    @locked
    def sampling(self, *, weakest: float = 1.0) -> SamplingDistribution:
        """Return the sampling distribution of the minimiser around the optimum.

        Parameters
        ----------
        weakest : float
            Largest standard error of a direction that counts as identified, in spreads of the
            prior.

        Raises
        ------
        ValueError
            If nothing is known around the optimum: it is at the edge of a support, or at a jump; or
            if the prior was part of it, or the model has changed since.
        TypeError
            If a metric declares nothing of its minimum, or a discrepancy is random.
        """
        require_sampling(self, "sampling")
        obstacle = sampling_obstacle(self.evaluator)
        if obstacle is not None:
            raise TypeError(f"sampling: {obstacle}")
        require_minimiser(self, "sampling")
        scales = np.array(list(self.scales.values()))
        return SamplingDistribution.of(self.evaluator, self.theta, scales, weakest)

    def to_datatree(self) -> xr.DataTree:
        """Return the optimum as a DataTree.

        Groups ``optimum``, ``stderr``, ``trace`` and ``calibration``.
        """
        return optimum_tree(self)


def _short(value: Any) -> str:
    return np.array2string(
        np.asarray(value), precision=4, threshold=8, formatter={"float_kind": "{:.4g}".format}
    )


def require_sampling(optimum: Optimum, caller: str) -> Optimum:
    """Return the optimum, or raise where nothing is known of the discrepancy around it.

    Raises
    ------
    ValueError
        If it is at the edge of a support, or at a jump.
    """
    findings = breakdown_findings(optimum.at_edge, optimum.at_jump)
    if findings:
        reasons = " ".join(map(str, findings))
        raise ValueError(
            f"{caller}: got an optimum around which nothing is known: {reasons} "
            "prb.sample_smc(epsilon=..., adjustment=None) makes no use of it"
        )
    return optimum


def identity_in(result: Any) -> Identity | None:
    """Return the identity that a result carries, an Optimum, a DataTree or a Dataset; or None."""
    if isinstance(result, Optimum):
        return result.identity
    if isinstance(result, xr.Dataset):
        return from_attributes(result.attrs)
    if not isinstance(result, xr.DataTree):
        return None
    group = "posterior" if "posterior" in result.children else "optimum"
    return from_attributes(result[group].attrs) if group in result.children else None


def require_refits(optimum: object, caller: str, advice: str) -> Optimum:
    """Return an optimum whose model can be calibrated to other data sets, or raise.

    Raises
    ------
    TypeError
        If it is no Optimum.
    ValueError
        If nothing is known around it, or the prior was part of it, or the model has changed since,
        or cannot be calibrated anew; then with ``advice``.
    """
    if not isinstance(optimum, Optimum):
        got = type(optimum).__name__
        raise TypeError(f"{caller}: got {got}, expected an Optimum; call prb.minimize() first")
    obstacle = refit_obstacle(require_sampling(optimum, caller).evaluator)
    if obstacle is not None:
        raise ValueError(f"{caller}: {obstacle}{advice}")
    return require_minimiser(optimum, caller)


def optima_of(optimum: Optimum, evaluator: Evaluator) -> Floats:
    """Return the optimum and local optima that the data support as well, (M, d).

    Their elements are in the evaluator's order, which may differ in a clone of the optimum's model.
    """
    order = [optimum.names.index(name) for name in evaluator.hyperparameters.names]
    rivals = [rival["theta"] for rival in optimum.rivals if rival["comparable"]]
    return np.array([optimum.theta, *rivals])[:, order]


def require_minimiser(optimum: Optimum, caller: str) -> Optimum:
    """Return an optimum of the discrepancy alone, whose model is the one that was minimised.

    Raises
    ------
    ValueError
        If the prior was part of the objective, or the model has changed since.
    """
    expected = identity_of(optimum.evaluator, prior_minimised=False)
    require_same(optimum.identity, expected, caller)
    return optimum


def require_of_model(result: Any, model: pm.Model, caller: str, level: Level) -> None:
    """Raise if a result is of another problem than a model's.

    Raises
    ------
    ValueError
        With all that differs.
    """
    require_same(identity_in(result), identity_of_model(model), caller, level)


def plain(value: Any) -> Any:
    """Return a float, or an array where there are several numbers."""
    return float(value) if np.ndim(value) == 0 else np.asarray(value)


def optimum_tree(optimum: Optimum) -> xr.DataTree:
    """Return the DataTree of an optimum."""
    evaluator = optimum.evaluator
    attrs = {
        "discrepancy": optimum.discrepancy,
        "converged": int(optimum.converged),
        "prior": int(optimum.prior),
        "message": optimum.message,
        "stopped": optimum.stopped,
        "n_evaluations": optimum.n_evaluations,
        "n_screened": optimum.n_screened,
        "n_responses": optimum.n_responses,
        "seconds": optimum.seconds,
        "findings": as_json(optimum.findings),
        **versions(),
        **as_attribute(optimum.model),
        **as_attributes(optimum.identity),
    }
    groups = {
        "optimum": labelled(evaluator, optimum.point, {}).assign_attrs(attrs),
        "stderr": labelled(evaluator, optimum.stderr, {}),
        "trace": _trace_dataset(optimum),
        "calibration": _calibration_dataset(optimum),
        "observed_data": observed_dataset(evaluator),
    }
    failures = optimum.failures
    if failures.sizes["failure"]:
        groups["failures"] = failures
    return xr.DataTree.from_dict(groups)


def _trace_dataset(optimum: Optimum) -> xr.Dataset:
    trace = optimum.trace
    variables = {
        "theta": (["evaluation", "element"], trace["theta"]),
        "discrepancy": ("evaluation", trace["discrepancy"]),
        "evaluations": ("evaluation", trace["evaluations"]),
    }
    return xr.Dataset(variables, coords={"element": optimum.names})


def _calibration_dataset(optimum: Optimum) -> xr.Dataset:
    evaluator = optimum.evaluator
    nodes, measurements = evaluator.nodes, evaluator.measurements
    discrepancies = {name: -float(v.sum()) for name, v in _log_likelihoods(optimum).items()}
    discrepancies |= optimum.discrepancies
    names = [node.name for node in nodes] + [m.name for m in measurements]
    variables: dict[str, Any] = {
        "discrepancy": ("simulator", [discrepancies[name] for name in names]),
        "scale": ("simulator", [optimum.scales.get(name, 1.0) for name in names]),
    }
    for key in ("weight_ess", "mean_weight", "lost_mass", "failed_mass"):
        values = [optimum.support.get(n, {}).get(key, np.nan) for n in names]
        variables[key] = ("simulator", values)
    variables["theta"] = ("element", optimum.theta)
    variables["covariance"] = (["element", "other_element"], optimum.covariance)
    metrics = [node.metric for node in nodes] + [m.metric for m in measurements]
    variables["metric"] = ("simulator", [without_addresses(metric) for metric in metrics])
    compared = [components_summary(node.target) for node in nodes] + [""] * len(measurements)
    variables["compared"] = ("simulator", compared)
    is_likelihood = [0] * len(nodes) + [1] * len(measurements)
    variables["is_likelihood"] = ("simulator", is_likelihood)
    runs = [node.bound.n_runs for node in nodes]
    runs += [len(prepared(likelihood_of(evaluator, m)).emulation.z) for m in measurements]
    variables["n_runs"] = ("simulator", runs)
    elements = {"element": optimum.names, "other_element": optimum.names}
    return xr.Dataset(variables, coords={"simulator": names, **elements})


def _log_likelihoods(optimum: Optimum) -> dict[str, Floats]:
    """Return the log-likelihoods of the specimens at the optimum, by simulator, (1, N)."""
    return specimen_log_likelihoods(optimum.evaluator, optimum.theta[None])


def compared_in(calibration: xr.Dataset) -> tuple[str, ...]:
    """Say by what the outputs of simulators are compared, where it is not by themselves."""
    if "compared" not in calibration:
        return ()
    told = calibration["compared"].values.tolist()
    pairs = zip(calibration["simulator"].values.tolist(), told, strict=True)
    return tuple(f"{name}: {clause}." for name, clause in pairs if clause)
