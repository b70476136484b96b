"""The results of a report, of any origin: checked, and in one form."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._finding import from_json
from prbayes._stats import INTERVAL
from prbayes._validate import Floats, called, texts
from prbayes.model.description import describe, from_attributes
from prbayes.model.emulated import population_simulators
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import (
    Identity,
    Level,
    differences,
    identity_of,
    require_same,
    require_together,
)
from prbayes.model.fingerprint import from_attributes as identity_of_attributes
from prbayes.optimize.optimum import Optimum, identity_in
from prbayes.plots.canvas import refuse_labels
from prbayes.response.outputs import SINGLE_OUTPUT, Outputs, read_observed
from prbayes.results.compare import compare
from prbayes.results.diagnose import Diagnosis, diagnose
from prbayes.validation.area_test import ValidityTest
from prbayes.validation.pit import comparables, u_values


@dataclass(frozen=True, eq=False)
class Material:
    """Results by label; a single one has its kind as label."""

    model: pm.Model | None
    description: dict[str, Any] | None  # of the model; from a file where there is no model
    optima: dict[str, xr.DataTree]
    live_optima: dict[str, Optimum]  # the optima that are not from a file
    posteriors: dict[str, xr.DataTree]
    tests: dict[str, ValidityTest]
    comparison: xr.Dataset | None
    observed: dict[str, Floats]  # measured responses by simulator; of several outputs (N, m)
    outputs: dict[str, Outputs]  # of a run, by simulator
    diagnoses: dict[str, Diagnosis | None]
    decisions: dict[str, xr.Dataset]
    # Measured and predicted responses of other specimens, by condition
    validation: dict[str, tuple[Any, xr.DataArray]] = field(default_factory=dict)
    # Labels of variables, inputs, simulators and outputs, with units
    labels: Mapping[str, str] = field(default_factory=dict)
    sheets: Mapping[str, str] = field(default_factory=dict)  # statistics by simulator

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

    def attrs(self, label: str) -> dict[Any, Any]:
        """Return the attributes of a result."""
        return dict(_estimates(self.results[label]).attrs)

    @property
    def problems(self) -> list[str]:
        """The problems that a diagnosis found, each once.

        Specimens that are too few for the standard errors of an optimum are none beside draws.
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

    @property
    def simulators(self) -> list[dict[str, Any]]:
        """The simulators of the model; none where they are unknown."""
        return [] if self.description is None else list(self.description["simulators"])

    @property
    def hyperparameters(self) -> list[str]:
        """Names of the hyperparameters, without deterministics where they are known as such."""
        if self.description is not None:
            variables = self.description["variables"]
            return [v["name"] for v in variables if v["role"] == "hyperparameter"]
        first = next(iter(self.results.values()), None)
        return [] if first is None else list(map(str, _estimates(first).data_vars))


def metrics_of(m: Material) -> dict[str, str]:
    """Return the metric by simulator; by result as well, where results differ in it."""
    by_result = {}
    for label, table in m.calibrations.items():
        pairs = zip(table["simulator"].values, table["metric"].values, strict=True)
        by_result[label] = {str(name): str(metric) for name, metric in pairs}
    if not by_result:
        return {s["name"]: s["metric"] for s in m.simulators}
    first, *rest = by_result.values()
    if all(metrics == first for metrics in rest):
        return first
    return {
        f"{label}, {name}": metric
        for label, metrics in by_result.items()
        for name, metric in metrics.items()
    }


def sheets_of(m: Material) -> dict[str, str]:
    """Return the statistics of each simulator that has a data sheet in place of specimens."""
    pattern = re.compile(r"SummaryLikelihood\(summary=Summary\((.*)\)\)", re.S)
    found = {name: pattern.fullmatch(metric) for name, metric in metrics_of(m).items()}
    return {name: x[1].replace("=", " = ") for name, x in found.items() if x is not None}


def constants_of(description: Mapping[str, Any] | None) -> set[str]:
    """Return the names of inputs that are numbers."""
    texts = [s["inputs"] for s in (description or {}).get("simulators", ())]
    return {name for text in texts for name in re.findall(r"(?:^|, )(\w+) = ", text)}


def date_of(m: Material) -> str:
    """Return the day of the latest result: of an optimum in memory today; nothing if unknown."""
    days = [str(m.attrs(label).get("created_at", ""))[:10] for label in m.results]
    if m.live_optima:
        days.append(datetime.now(UTC).isoformat()[:10])
    return max((day for day in days if re.fullmatch(r"\d{4}-\d\d-\d\d", day)), default="")


def versions_of(m: Material) -> dict[str, str]:
    """Return versions by package, as the results have them."""
    attrs = [pair for label in m.results for pair in m.attrs(label).items()]
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
    labels: Mapping[str, str] | None = None,
) -> Material:
    """Check results, and derive the missing ones."""
    optima = _by_label(optimum, "optimum")
    posteriors = _by_label(posterior, "posterior")
    tests = _by_label(validity, "validity")
    decisions = _by_label(decision, "decision")
    validation = {} if validation is None else validation
    _require_kinds(model, optima, posteriors, tests, comparison, decisions, validation, labels)
    live_optima = {label: o for label, o in optima.items() if isinstance(o, Optimum)}
    optima |= {label: o.to_datatree() for label, o in live_optima.items()}
    for label, tree in optima.items():
        _require_group(label, tree, "optimum", (), "prb.minimize")
        if "stderr" not in tree:
            raise TypeError(
                f"Report: {label}: got a DataTree without the group stderr, "
                "expected one of prb.minimize"
            )

    results = optima | posteriors
    identities = {label: identity_in(result) for label, result in (results | live_optima).items()}
    identities |= {label: test.identity for label, test in tests.items()}
    identities |= {label: identity_in(table) for label, table in decisions.items()}
    for label, (_, predicted) in validation.items():
        identities[f"validation, {label}"] = identity_of_attributes(predicted.attrs)
    identities["comparison"] = identity_in(comparison)
    require_together(identities, "Report", model=model)
    _require_prior({label: identities[label] for label in posteriors}, model)
    _require_tested(validation, tests)

    stored = (from_attributes(_estimates(tree).attrs) for tree in results.values())
    first = next((text for text in stored if text is not None), None)
    description = first if model is None else describe(model)
    if comparison is None and len(results) > 1:
        comparison = compare(results | live_optima, model=model)
    observed, outputs = _observed(model, results)
    if labels and (description is not None or model is not None):
        names = set(validation).union(outputs, *(columns.names for columns in outputs.values()))
        if description is not None:
            names |= {str(variable["name"]) for variable in description["variables"]}
            names |= constants_of(description)
        evaluator = None if model is None else Evaluator.of(model)
        refuse_labels(labels, sorted(names), evaluator=evaluator)
    diagnoses: dict[str, Diagnosis | None] = {}
    for label, result in results.items():
        if label in live_optima:
            diagnoses[label] = diagnose(live_optima[label])
            continue
        own_model = _model_of(result, model)
        needs_model = not {"optimum", "calibration"} & set(result.children)
        is_possible = own_model is not None or not needs_model
        diagnoses[label] = diagnose(result, model=own_model) if is_possible else None
    material = Material(
        model=model,
        description=description,
        optima=optima,
        live_optima=live_optima,
        posteriors=posteriors,
        tests=tests,
        comparison=comparison,
        observed=observed,
        outputs=outputs,
        diagnoses=diagnoses,
        decisions=decisions,
        validation=dict(validation),
        labels=dict(labels or {}),
    )
    # Statistics of a data sheet are no measured responses
    sheets = sheets_of(material)
    sampled = {name: y for name, y in observed.items() if name not in sheets}
    return replace(material, observed=sampled, sheets=sheets)


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
    validation: Any,
    labels: Any,
) -> None:
    """Raise if an argument is of another kind."""
    for table in decisions.values():
        if kind_of_decision(table) is None:
            raise TypeError(
                f"Report: decision: got {type(table).__name__}, expected the Dataset of "
                "prb.exceedance, prb.sensitivity or prb.plan, or several by name"
            )
    if model is not None and not isinstance(model, pm.Model):
        raise TypeError(f"Report: model: got {type(model).__name__}, expected a pm.Model")
    is_comparison = isinstance(comparison, xr.Dataset) and "estimate" in comparison
    if comparison is not None and not is_comparison:
        raise TypeError(
            f"Report: comparison: got {type(comparison).__name__}, expected the Dataset of "
            "prb.compare"
        )
    expected = (
        "expected by condition the measured responses and their prediction, such as "
        '{"80 000 cycles": (lengths, prb.predict(...))}'
    )
    if not isinstance(validation, Mapping):
        raise TypeError(f"Report: validation: got {called(validation)}, {expected}")
    for condition, pair in validation.items():
        if not isinstance(condition, str) or not isinstance(pair, tuple) or len(pair) != 2:
            raise TypeError(f"Report: validation: {condition}: got {called(pair)}, {expected}")
        comparables({condition: pair[0]}, {condition: pair[1]}, "Report: validation")
    if labels is not None:
        texts(labels, "Report: labels")
    names = sorted(set(optima) & set(posteriors))
    if names:
        raise ValueError(
            f"Report: got the names {names} for optima and posteriors, expected different ones"
        )
    for label, test in tests.items():
        if not isinstance(test, ValidityTest):
            raise TypeError(
                f"Report: {label}: got {type(test).__name__}, expected a ValidityTest from "
                "prb.area_test"
            )
    for label, tree in posteriors.items():
        _require_group(label, tree, "posterior", ("chain", "draw"), "prb.sample_smc")


def _require_group(label: str, tree: Any, group: str, dims: tuple[str, ...], origin: str) -> None:
    if not isinstance(tree, xr.DataTree) or group not in tree or not tree[group].data_vars:
        raise TypeError(
            f"Report: {label}: got {type(tree).__name__}, "
            f"expected a DataTree with the group {group}, from {origin}"
        )
    variables = tree[group].data_vars.items()
    lacking = [str(name) for name, values in variables if not set(dims) <= set(values.dims)]
    if lacking:
        raise ValueError(
            f"Report: {label}: got {lacking} without the dimensions {dims}, "
            f"expected draws of {origin}"
        )


def _require_prior(identities: Mapping[str, Identity | None], model: pm.Model | None) -> None:
    """Raise if no posterior is under the prior of the model, which the report prints."""
    if model is None or not population_simulators(model):
        return
    expected = identity_of(model)
    posteriors = {label: identity for label, identity in identities.items() if identity is not None}
    if posteriors and all(differences(i, expected, Level.PRIORS) for i in posteriors.values()):
        label, identity = next(iter(posteriors.items()))
        require_same(identity, expected, f"Report: {label}", Level.PRIORS)


def _require_tested(
    validation: Mapping[str, tuple[Any, xr.DataArray]], tests: Mapping[str, ValidityTest]
) -> None:
    """Raise if validation data are not those of a test, where there are tests."""
    tested: list[Floats] = []
    for test in tests.values():
        tested.append(test.u_values)
        tested += [test.u_values[test.conditions == name] for name in np.unique(test.conditions)]
    for condition, (measured, predicted) in validation.items():
        u = u_values({condition: measured}, {condition: predicted})
        # Up to rounding and ties, in their order: rounded data change half of the values by far
        # less than .02; other data are .3 apart on average.
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


def _estimates(tree: xr.DataTree) -> xr.DataTree:
    """Return the group of a result with its estimates."""
    return tree.children["posterior" if "posterior" in tree else "optimum"]


def _observed(
    model: pm.Model | None, results: dict[str, xr.DataTree]
) -> tuple[dict[str, Floats], dict[str, Outputs]]:
    """Return the measured responses, and their columns, by simulator."""
    if model is not None:
        simulators = population_simulators(model)
        observed = {simulator.name: simulator.observed for simulator in simulators}
        return observed, {simulator.name: simulator.outputs for simulator in simulators}
    observed, outputs = {}, {}
    tree = next((tree for tree in results.values() if "observed_data" in tree), None)
    for key, values in {} if tree is None else tree["observed_data"].data_vars.items():
        name = str(key)
        units = values.attrs.get("units")
        if values.ndim != 2:
            observed[name] = np.ravel(values.values)
            outputs[name] = SINGLE_OUTPUT
            if isinstance(units, str) and units:
                outputs[name] = Outputs(units=(units,))
            continue
        if units is not None and not isinstance(units, str):  # of each output
            values = values.assign_coords(units=(values.dims[1], np.asarray(units)))
        observed[name], outputs[name] = read_observed(name, values)
    return observed, outputs


def _model_of(result: xr.DataTree, model: pm.Model | None) -> pm.Model | None:
    """Return the model for the diagnosis of a saved result; None if its metric or prior differs."""
    identity = identity_in(result)
    if model is None or identity is None:
        return model
    return None if differences(identity, identity_of(model), Level.OPTIMUM) else model


# -- schema of results in files --------------------------------------------------------------


# Variables that identify a table of a decision, and the function that returns it.
_TABLES = {
    "risk": {"probability", "by_draw", "error"},
    "sensitivity": {"first", "total", "derivative"},
    "plan": {"sd", "now"},
}
CALLED = {"risk": "exceedance", "sensitivity": "sensitivity", "plan": "plan"}
# Variables and attributes that a report reads.
_OF_DECISION = {
    "risk": ("lower", "upper", "limit", "below", "prob"),
    "sensitivity": ("factor", "kind", "first_error", "total_error", "quantity", "value", "sd"),
    "plan": ("name", "candidate", "k"),
}
_OF_CALIBRATION = (
    *("epsilon", "metric", "propagation", "n_points", "required_ess", "max_lost"),
    *("discrepancy", "discrepancy_error", "weight_ess", "mean_weight", "lost_mass"),
)
_OF_TEST = ("statistic", "critical_value", "p_value", "alpha", "folded")


def kind_of_decision(table: Any) -> str | None:
    """Return the kind of a table of a decision; None for anything else."""
    if isinstance(table, xr.Dataset):
        for kind, variables in _TABLES.items():
            if variables <= set(table.data_vars):
                return kind
    return None


def complaints(tree: xr.DataTree) -> Iterator[str]:
    """Yield errors of a posterior, an optimum, a test of validity or a table: got, expected."""
    groups = {str(name): group.to_dataset() for name, group in tree.children.items()}
    if "posterior" in groups or "optimum" in groups:
        yield from _of_estimates(groups)
    elif "u" in tree.data_vars:
        yield from _of_test(tree.to_dataset())
    else:
        table = tree.to_dataset()
        kind = kind_of_decision(table) or ""
        present = {*table.variables, *table.attrs}
        lacking = [name for name in _OF_DECISION[kind] if name not in present]
        if lacking:
            yield f"got no {lacking}, expected a table of prb.{CALLED[kind]}"
        yield from _not_numbers("a decision", table.data_vars)
    for group in {"posterior", "optimum"} & set(groups):
        attrs = groups[group].attrs
        for name in ("n_responses", "seconds"):
            value = np.asarray(attrs.get(name, 0.0))
            if value.size != 1 or value.dtype.kind not in "fiu" or np.isnan(value).any():
                yield f"{group}: {name}: got {attrs[name]!r:.60}, expected a number"
        try:
            from_json(str(attrs.get("findings", "[]")))
        except ValueError as error:
            yield f"{group}: {error}"
    if "observed_data" in groups:
        yield from _not_numbers("observed_data", groups["observed_data"].data_vars)


def _of_estimates(groups: Mapping[str, xr.Dataset]) -> Iterator[str]:
    """Yield errors of a posterior, or else of an optimum."""
    kind = "posterior" if "posterior" in groups else "optimum"
    variables = groups[kind].data_vars
    yield from _not_numbers(kind, variables)
    for name, values in variables.items():
        if not values.size:
            yield f"{kind}: {name}: got no values (shape {values.shape}), expected some"
        elif values.dtype.kind == "f" and not np.isfinite(values.values).any():
            yield f"{kind}: {name}: got NaN or infinite values only, expected finite ones"
    needed: dict[str, tuple[str, ...]] = {"calibration": ("discrepancy", "metric")}
    if kind == "posterior":
        needed = {"calibration": _OF_CALIBRATION}
        if "sample_stats" in groups and "stage" in groups["sample_stats"].dims:
            needed["sample_stats"] = ("beta", "accept_rate", "n_steps")
    elif "stderr" in groups:
        errors = groups["stderr"]
        for name, value in variables.items():
            if name not in errors or errors[name].shape != value.shape:
                yield f"stderr: got no standard error of {name}, expected one of the same shape"
    for group, names in needed.items():
        lacking = [name for name in names if group in groups and name not in groups[group]]
        if lacking:
            yield f"{group}: got no {lacking}, expected them beside {list(groups[group])}"
    if "sample_stats" in needed:
        yield from _not_numbers("sample_stats", groups["sample_stats"].data_vars)


def _of_test(test: xr.Dataset) -> Iterator[str]:
    lacking = [name for name in (*_OF_TEST, "lower", "upper") if name not in test.variables]
    if lacking:
        yield f"got no {lacking}, expected a validity test saved by to_dataset()"
        return
    for name in _OF_TEST:
        if test[name].size != 1 or test[name].dtype.kind not in "fiub":
            yield f"{name}: got shape {test[name].shape}, expected one number"
    u = test["u"]
    yield from _not_numbers("a validity test", {"u": u})
    if u.ndim != 1 or not u.size or not bool(((u >= 0) & (u <= 1)).all()):
        yield f"u: got shape {u.shape}, expected one or more numbers between 0 and 1"
    for name in ("condition", "specimen", "lower", "upper"):
        if name in test.variables and test[name].shape != u.shape:
            yield f"{name}: got shape {test[name].shape}, expected that of u, {u.shape}"
    for name in ("statistic", "p_value"):
        if not np.isfinite(test[name].values).all():
            yield f"{name}: got NaN or an infinite number, expected a finite one"


def _not_numbers(group: str, variables: Mapping[Any, xr.DataArray]) -> Iterator[str]:
    for name, values in variables.items():
        if values.dtype.kind not in "fiu":
            yield f"{group}: {name}: got values of dtype {values.dtype}, expected numbers"
