"""The results of a report, of any origin: checked, and in one form."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._stats import INTERVAL
from prbayes._validate import Floats, Labels, NamedValues, Names, called, texts, wrong_type
from prbayes.model.description import describe, from_attributes
from prbayes.model.emulated import population_simulators
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import (
    Identity,
    Level,
    identity_from_attributes,
    identity_of,
    problem_differences,
    require_same,
    require_together,
)
from prbayes.optimize.optimum import Optimum, identity_in
from prbayes.plots.canvas import refuse_labels
from prbayes.response.outputs import SINGLE_OUTPUT, Outputs, read_observed
from prbayes.results.compare import compare, estimates_in
from prbayes.results.diagnose import Diagnosis, diagnose
from prbayes.results.products import model_of_product, one_posterior
from prbayes.validation.area_test import ValidityTest
from prbayes.validation.fleet import tests_of_products
from prbayes.validation.pit import Comparable, comparables, u_values


@dataclass(frozen=True, eq=False)
class Observed:
    """The measured responses of a simulator."""

    values: Floats  # (N,), or (N, m) of several outputs
    outputs: Outputs = SINGLE_OUTPUT

    def columns(self) -> list[tuple[str, str, Floats]]:
        """Return name, unit and values of each output; a single one has no name."""
        names = self.outputs.names or ("",)
        units = self.outputs.units or ("",) * len(names)
        return list(zip(names, units, np.atleast_2d(self.values.T), strict=True))


@dataclass(frozen=True, eq=False)
class Validation:
    """Responses of specimens under a condition that were not used in the calibration."""

    measured: Any
    predicted: xr.DataArray
    pairs: list[Comparable]  # measured and predicted values of each output


@dataclass(frozen=True, eq=False)
class Material:
    """Results by label; a single result has its kind as label."""

    model: pm.Model | None
    # variables and simulators of the model, which a file describes too; empty lists if unknown
    description: dict[str, Any]
    optima: dict[str, xr.DataTree]
    live_optima: dict[str, Optimum]  # optima in memory, which have an evaluator
    posteriors: dict[str, xr.DataTree]
    tests: dict[str, ValidityTest]
    comparison: xr.Dataset | None
    observed: dict[str, Observed]  # measured responses by simulator
    sheets: dict[str, str]  # statistics of data sheets, which are no responses, by simulator
    diagnoses: dict[str, Diagnosis | None]
    decisions: dict[str, xr.Dataset]
    validation: dict[str, Validation]  # responses of other specimens by condition
    labels: Labels  # labels of variables, inputs, simulators and outputs, with units

    @property
    def results(self) -> dict[str, xr.DataTree]:
        """Optima and posteriors."""
        return self.optima | self.posteriors

    @property
    def rejected(self) -> bool:
        """Whether a test rejected the model."""
        return any(test.rejected for test in self.tests.values())

    @property
    def calibrations(self) -> dict[str, xr.Dataset]:
        """Discrepancies, metrics and epsilons, of the results that have them."""
        return {
            label: tree.children["calibration"].to_dataset()
            for label, tree in self.results.items()
            if "calibration" in tree.children
        }

    @property
    def problems(self) -> list[str]:
        """The problems that a diagnosis found, each once.

        If there are draws, too few specimens for the standard errors of an optimum are no problem.
        """
        accepted = {"few-specimens"} if self.posteriors else set()
        texts = [
            str(finding)
            for diagnosis in self.diagnoses.values()
            if diagnosis is not None
            for finding in diagnosis.findings
            if finding.code not in accepted
        ]
        return list(dict.fromkeys(texts))

    @property
    def is_usable(self) -> bool:
        """Whether no test rejected the model, and no diagnosis found a problem."""
        return not (self.rejected or self.problems)

    @property
    def prob(self) -> float:
        """The probability of all intervals: that of the first probability of a decision."""
        probs = [t.attrs["prob"] for t in self.decisions.values() if kind_of_decision(t) == "risk"]
        return float(probs[0]) if probs else INTERVAL

    @property
    def is_by_specimen(self) -> bool:
        """Whether all simulators of all results have the log-likelihood by specimen."""
        flags = [
            bool(calibration["is_likelihood"].values.all())
            for calibration in self.calibrations.values()
            if "is_likelihood" in calibration
        ]
        return bool(flags) and all(flags)


def metrics_of(m: Material) -> dict[str, str]:
    """Return the metric of each simulator, for each result if results have different metrics."""
    by_result = {}
    for label, table in m.calibrations.items():
        pairs = zip(table["simulator"].values, table["metric"].values, strict=True)
        by_result[label] = {str(name): str(metric) for name, metric in pairs}
    if not by_result:
        return {s["name"]: s["metric"] for s in m.description["simulators"]}
    first, *rest = by_result.values()
    if all(metrics == first for metrics in rest):
        return first
    return {
        f"{label}, {name}": metric
        for label, metrics in by_result.items()
        for name, metric in metrics.items()
    }


def constants_of(description: NamedValues) -> set[str]:
    """Return the names of inputs that are numbers."""
    inputs = [x for s in description["simulators"] for x in s["inputs"]]
    return {name for name, _, text in inputs if text.startswith("=")}


def names_in(description: NamedValues) -> set[str]:
    """Return the names of variables, and of inputs that are numbers."""
    return {v["name"] for v in description["variables"]} | constants_of(description)


def attributes_of(result: xr.DataTree) -> dict[Any, Any]:
    """Return the attributes of a posterior or an optimum."""
    return dict(estimates_in(result).attrs)


def date_of(m: Material) -> str:
    """Return the day of the latest result, which is today for an optimum in memory."""
    days = [str(attributes_of(r).get("created_at", ""))[:10] for r in m.results.values()]
    if m.live_optima:
        days.append(datetime.now(UTC).isoformat()[:10])
    return max((day for day in days if re.fullmatch(r"\d{4}-\d\d-\d\d", day)), default="")


def versions_of(m: Material) -> dict[str, str]:
    """Return the versions of packages that the results were computed with."""
    attrs = [pair for result in m.results.values() for pair in attributes_of(result).items()]
    names = ("prbayes", "pymc", "pytensor", "arviz", "numpy", "scipy", "python")
    versions = {str(key).removesuffix("_version"): str(value) for key, value in attrs}
    return {name: versions[name] for name in names if name in versions}


def gather(
    model: Any = None,
    optimum: Any = None,
    posterior: Any = None,
    validity: Any = None,
    comparison: Any = None,
    decision: Any = None,
    validation: Any = None,
    labels: Labels | None = None,
) -> Material:
    """Check results, and derive the missing ones."""
    optima = _by_label(optimum, "optimum")
    posteriors = {
        label: one_posterior(result, f"Report: {label}")
        for label, result in _by_label(posterior, "posterior").items()
    }
    tests = _by_label(validity, "validity") or _tests_of(posteriors)
    decisions = _by_label(decision, "decision")
    _require_kinds(model, optima, posteriors, tests, comparison, decisions, labels)
    validations = _validations(validation)
    live_optima = {label: o for label, o in optima.items() if isinstance(o, Optimum)}
    optima |= {label: o.to_datatree() for label, o in live_optima.items()}
    for label, tree in optima.items():
        _require_group(label, tree, "optimum", (), "prb.minimize")
        _require_group(label, tree, "stderr", (), "prb.minimize")
    results = optima | posteriors
    identities = {label: identity_in(result) for label, result in (results | live_optima).items()}
    identities |= {label: test.identity for label, test in tests.items()}
    identities |= {label: identity_in(table) for label, table in decisions.items()}
    for label, data in validations.items():
        identities[f"validation, {label}"] = identity_from_attributes(data.predicted.attrs)
    require_together(identities | {"comparison": identity_in(comparison)}, "Report", model=model)
    _require_prior({label: identities[label] for label in posteriors}, model)
    _require_tested(validations, tests)

    stored = (from_attributes(attributes_of(tree)) for tree in results.values())
    descriptions = filter(None, stored if model is None else [describe(model)])
    description: dict[str, Any] = next(descriptions, {"variables": [], "simulators": []})
    if comparison is None and len(results) > 1:
        comparison = compare(results | live_optima, model=model)
    observed, sheets = _observed(model, results)
    if labels and description["variables"]:
        names = {*validations, *sheets, *observed, *names_in(description)}
        names = names.union(*(simulator.outputs.names for simulator in observed.values()))
        evaluator = None if model is None else Evaluator.of(model)
        refuse_labels(labels, sorted(names), evaluator=evaluator)
    diagnoses = {}
    for label, result in (results | live_optima).items():
        can_diagnose, own_model = _model_of_diagnosis(result, model)
        diagnoses[label] = diagnose(result, model=own_model) if can_diagnose else None
    return Material(
        model=model,
        description=description,
        optima=optima,
        live_optima=live_optima,
        posteriors=posteriors,
        tests=tests,
        comparison=comparison,
        observed=observed,
        sheets=sheets,
        diagnoses=diagnoses,
        decisions=decisions,
        validation=validations,
        labels=dict(labels or {}),
    )


def _tests_of(posteriors: NamedValues) -> dict[str, ValidityTest]:
    """Return the validity tests that posteriors of products have."""
    tests: dict[str, ValidityTest] = {}
    for result in posteriors.values():
        tests |= tests_of_products(result)
    return tests


def _by_label(results: Any, kind: str) -> dict[str, Any]:
    if results is None:
        return {}
    if isinstance(results, Mapping) and not isinstance(results, xr.DataTree | xr.Dataset):
        return {str(label): value for label, value in results.items()}
    return {kind: results}


# -- checks ----------------------------------------------------------------------------------


def _require_kinds(
    model: Any,
    optima: dict[str, Any],
    posteriors: dict[str, Any],
    tests: dict[str, Any],
    comparison: Any,
    decisions: dict[str, Any],
    labels: Any,
) -> None:
    """Raise if an argument is of another kind."""
    for table in decisions.values():
        if kind_of_decision(table) is None:
            expected = (
                "the Dataset of prb.exceedance, prb.sensitivity or prb.plan, or several by name"
            )
            raise wrong_type(table, "Report: decision", expected)
    if model is not None and not isinstance(model, pm.Model):
        raise wrong_type(model, "Report: model", "a pm.Model")
    is_comparison = isinstance(comparison, xr.Dataset) and "estimate" in comparison
    if comparison is not None and not is_comparison:
        raise wrong_type(comparison, "Report: comparison", "the Dataset of prb.compare")
    if labels is not None:
        texts(labels, "Report: labels")
    names = sorted(set(optima) & set(posteriors))
    if names:
        raise ValueError(
            f"Report: got the names {names} for optima and posteriors, expected different ones"
        )
    for label, test in tests.items():
        if not isinstance(test, ValidityTest):
            raise wrong_type(test, f"Report: {label}", "a ValidityTest from prb.area_test")
    for label, tree in posteriors.items():
        _require_group(label, tree, "posterior", ("chain", "draw"), "prb.sample_smc")


def _validations(validation: Any) -> dict[str, Validation]:
    """Return the responses of a test by condition, or raise if an argument is no such pair."""
    expected = (
        "expected by condition the measured responses and their prediction, such as "
        '{"80 000 cycles": (lengths, prb.predict(...))}'
    )
    if validation is None:
        return {}
    if not isinstance(validation, Mapping):
        raise TypeError(f"Report: validation: got {called(validation)}, {expected}")
    validations = {}
    for condition, pair in validation.items():
        if not isinstance(condition, str) or not isinstance(pair, tuple) or len(pair) != 2:
            raise TypeError(f"Report: validation: {condition}: got {called(pair)}, {expected}")
        measured, predicted = pair
        pairs = comparables({condition: measured}, {condition: predicted}, "Report: validation")
        validations[condition] = Validation(measured, predicted, pairs)
    return validations


def _require_group(label: str, tree: Any, group: str, dims: Names, origin: str) -> None:
    if not isinstance(tree, xr.DataTree) or group not in tree or not tree[group].data_vars:
        expected = f"a DataTree with the group {group}, from {origin}"
        raise wrong_type(tree, f"Report: {label}", expected)
    variables = tree[group].data_vars.items()
    lacking = [str(name) for name, values in variables if not set(dims) <= set(values.dims)]
    if lacking:
        raise ValueError(
            f"Report: {label}: got {lacking} without the dimensions {dims}, "
            f"expected draws of {origin}"
        )


def _require_prior(identities: Mapping[str, Identity | None], model: pm.Model | None) -> None:
    """Raise if all posteriors have other priors than the model, whose priors the report prints."""
    if model is None or not population_simulators(model):
        return
    expected = identity_of(model)
    posteriors = {label: identity for label, identity in identities.items() if identity is not None}
    if posteriors and all(
        problem_differences(i, expected, Level.PRIORS) for i in posteriors.values()
    ):
        label, identity = next(iter(posteriors.items()))
        require_same(identity, expected, f"Report: {label}", Level.PRIORS)


def _require_tested(
    validation: Mapping[str, Validation], tests: Mapping[str, ValidityTest]
) -> None:
    """Raise if there are tests, and validation data are not those of a test."""
    tested = []
    for test in tests.values():
        tested.append(test.u_values)
        tested += [test.u_values[test.conditions == name] for name in np.unique(test.conditions)]
    for condition, data in validation.items():
        u = u_values({condition: data.measured}, {condition: data.predicted})
        # The data of the test may have been rounded, which changes half of the u-values by far less
        # than .02. The u-values of other data are .3 apart on average.
        distances = [
            np.median(np.abs(values - tested_u))
            for values in (u, np.abs(2 * u - 1))
            for tested_u in tested
            if tested_u.shape == u.shape
        ]
        if tested and not min(distances, default=1.0) < 0.02:
            raise ValueError(
                f"Report: validation: {condition}: got {u.size} values other than those of the "
                f"tests in validity=, expected what prb.area_test was given; test them too, or "
                "leave validity= out"
            )


# -- derived results -------------------------------------------------------------------------


def _observed(
    model: pm.Model | None, results: Mapping[str, xr.DataTree]
) -> tuple[dict[str, Observed], dict[str, str]]:
    """Return the measured responses, and the statistics of data sheets, by simulator."""
    observed, sheets = {}, {}
    if model is not None:
        for result in results.values():
            model = model_of_product(result, model)
        for simulator in population_simulators(model):
            observed[simulator.name] = Observed(simulator.observed, simulator.outputs)
            sheets[simulator.name] = simulator.metric.data_sheet
    else:
        groups = [tree["observed_data"] for tree in results.values() if "observed_data" in tree]
        for key, array in groups[0].data_vars.items() if groups else ():
            name = str(key)
            # A tool other than this package may store arrays with more axes.
            values = array if array.ndim in (1, 2) else np.ravel(array)
            y, outputs = read_observed(name, values.astype(np.float64))
            observed[name] = Observed(y, outputs)
            sheets[name] = str(array.attrs.get("data_sheet", ""))
    sheets = {name: sheet for name, sheet in sheets.items() if sheet}
    return {name: y for name, y in observed.items() if name not in sheets}, sheets


def _model_of_diagnosis(result: Any, model: pm.Model | None) -> tuple[bool, pm.Model | None]:
    """Return whether a result can be diagnosed, and the model for that.

    The model of a saved result is no other one, with a different metric or prior.
    """
    if isinstance(result, Optimum):
        return True, None
    identity = identity_in(result)
    if model is not None and identity is not None:
        is_other = problem_differences(identity, identity_of(model), Level.OPTIMUM)
        model = None if is_other else model
    return model is not None or bool({"optimum", "calibration"} & set(result.children)), model


# -- decisions -------------------------------------------------------------------------------


# variables that identify a table of a decision, and functions that return the tables
_TABLES = {
    "risk": {"probability", "by_draw", "error"},
    "sensitivity": {"first", "total", "derivative"},
    "plan": {"sd", "now"},
}
CALLED = {"risk": "exceedance", "sensitivity": "sensitivity", "plan": "plan"}


def kind_of_decision(table: Any) -> str | None:
    """Return the kind of a table of a decision, or None if it is no such table."""
    if isinstance(table, xr.Dataset):
        for kind, variables in _TABLES.items():
            if variables <= set(table.data_vars):
                return kind
    return None
