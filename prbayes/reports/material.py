"""What a report is made of: results of any origin, checked, and brought into one form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._validate import Floats, called, texts
from prbayes.model.description import describe, from_attributes
from prbayes.model.emulated import population_simulators
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import (
    Identity,
    Level,
    differences,
    identity_of_model,
    require_same,
    require_together,
)
from prbayes.model.fingerprint import from_attributes as identity_of_attributes
from prbayes.optimize.optimum import Optimum, identity_in
from prbayes.plots._labels import refuse_labels
from prbayes.response.outputs import ONE, Outputs, read_observed
from prbayes.results.compare import compare
from prbayes.results.diagnose import Diagnosis, diagnose
from prbayes.validation.area_test import ValidityTest, u_values
from prbayes.validation.conditions import comparables

# Measured values are rounded, or predicted ones for a test: by far less than this in half of the
# u-values, while those of other data are apart by .3 on average.
_ROUNDED_BY = 0.02


@dataclass(frozen=True, eq=False)
class Material:
    """Results by label; a single one has its kind as label."""

    model: pm.Model | None
    description: dict[str, Any] | None  # of the model; from a file where there is no model
    optima: dict[str, xr.DataTree]
    found: dict[str, Optimum]  # those of the optima that are not from a file
    posteriors: dict[str, xr.DataTree]
    tests: dict[str, ValidityTest]
    comparison: xr.Dataset | None
    observed: dict[str, Floats]  # measured responses by simulator; of several outputs (N, m)
    outputs: dict[str, Outputs]  # of a run, by simulator
    diagnoses: dict[str, Diagnosis | None]
    decisions: dict[str, xr.Dataset]
    # Of other specimens, by condition: what was measured, and what was predicted of it.
    validation: dict[str, tuple[Any, xr.DataArray]] = field(default_factory=dict)
    # What a reader calls variables, inputs, simulators and outputs, with units.
    labels: Mapping[str, str] = field(default_factory=dict)

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
        """Discrepancies, metrics and epsilons, of those results that have them."""
        found = {}
        for label, tree in self.results.items():
            if "calibration" in tree.children:
                found[label] = tree.children["calibration"].to_dataset()
        return found

    def attrs(self, label: str) -> dict[Any, Any]:
        """Return what a result says about itself."""
        return dict(_answer(self.results[label]).attrs)

    @property
    def is_by_specimen(self) -> bool:
        """Whether all simulators of all results have the log-likelihood by specimen."""
        known = [
            calibration["is_likelihood"].values
            for calibration in self.calibrations.values()
            if "is_likelihood" in calibration
        ]
        return bool(known) and all(bool(own.all()) for own in known)

    @property
    def variables(self) -> list[dict[str, Any]]:
        """The variables of the model; none where they are not known."""
        return [] if self.description is None else list(self.description["variables"])

    @property
    def hyperparameters(self) -> list[str]:
        """Names of the hyperparameters, without deterministics where they are known as such."""
        if self.description is not None:
            return [v["name"] for v in self.variables if v["role"] == "hyperparameter"]
        if not self.results:
            return []
        first = next(iter(self.results.values()))
        return list(map(str, _answer(first).data_vars))


def gather(
    model: Any,
    optimum: Any,
    posterior: Any,
    validity: Any,
    comparison: Any,
    decision: Any = None,
    validation: Any = None,
    labels: Mapping[str, str] | None = None,
) -> Material:
    """Check what was given.

    Raises
    ------
    TypeError, ValueError
        If a result is not what it is given as, or of other populations or data than the model or
        the first of them.
    """
    given = _labelled(optimum, "optimum")
    posteriors = _labelled(posterior, "posterior")
    tests = _labelled(validity, "validity")
    decisions = _labelled(decision, "decision")

    # Refuse what is not as described
    _require_model(model)
    _require_comparison(comparison)
    _require_validation(validation)
    if labels is not None:
        texts(labels, "Report: labels")
    _require_different_names(given, posteriors)
    for label, test in tests.items():
        _require_test(label, test)
    for label, tree in posteriors.items():
        _require(label, tree, "posterior", ("chain", "draw"), "prb.sample_smc")
    found = {label: o for label, o in given.items() if isinstance(o, Optimum)}
    optima = given | {label: o.to_datatree() for label, o in found.items()}
    for label, tree in optima.items():
        _require_optimum(label, tree)

    # Refuse what is of different problems
    results = optima | posteriors
    identities = {label: identity_in(result) for label, result in (results | found).items()}
    identities |= {label: test.identity for label, test in tests.items()}
    identities |= {label: identity_in(table) for label, table in decisions.items()}
    for label, (_, predicted) in (validation or {}).items():
        identities[f"validation, {label}"] = identity_of_attributes(predicted.attrs)
    identities["comparison"] = identity_in(comparison)
    require_together(identities, "Report", model=model)
    _require_prior({label: identities[label] for label in posteriors}, model)
    _require_tested(validation or {}, tests)

    # Find out what was not given
    description = _stored_description(results) if model is None else describe(model)
    if comparison is None and len(results) > 1:
        comparison = compare(results | found, model=model)
    observed, outputs = _observed(model, results)
    _require_known_labels(labels, model, description, outputs, validation)
    diagnoses = {}
    for label, result in (results | found).items():
        diagnoses[label] = _diagnosis(result, model)
    return Material(
        model=model,
        description=description,
        optima=optima,
        found=found,
        posteriors=posteriors,
        tests=tests,
        comparison=comparison,
        observed=observed,
        outputs=outputs,
        diagnoses=diagnoses,
        decisions=decisions,
        validation=dict(validation or {}),
        labels=dict(labels or {}),
    )


# -- checks ----------------------------------------------------------------------------------


def _labelled(given: Any, kind: str) -> dict[str, Any]:
    if given is None:
        return {}
    if isinstance(given, Mapping) and not isinstance(given, xr.DataTree | xr.Dataset):
        return {str(label): value for label, value in given.items()}
    return {kind: given}


def _require_model(model: Any) -> None:
    if model is not None and not isinstance(model, pm.Model):
        raise TypeError(f"Report: model: got {type(model).__name__}, expected a pm.Model")


def _require_validation(validation: Any) -> None:
    """Refuse what is no data with a prediction of them, by condition."""
    if validation is None:
        return
    expected = (
        "expected by condition what was measured and what prb.predict says of it, such as "
        '{"80 000 cycles": (lengths, prb.predict(...))}'
    )
    if not isinstance(validation, Mapping):
        raise TypeError(f"Report: validation: got {called(validation)}, {expected}")
    for condition, pair in validation.items():
        if not isinstance(condition, str) or not isinstance(pair, tuple) or len(pair) != 2:
            raise TypeError(f"Report: validation: {condition}: got {called(pair)}, {expected}")
        comparables({condition: pair[0]}, {condition: pair[1]}, "Report: validation")


def _require_prior(identities: Mapping[str, Identity | None], model: pm.Model | None) -> None:
    """Refuse draws none of which is under the prior of the model, which the report prints."""
    if model is None or not population_simulators(model):
        return
    expected = identity_of_model(model)
    found = {}
    for label, identity in identities.items():
        if identity is not None:
            found[label] = differences(identity, expected, Level.PRIORS)
    if found and all(found.values()):
        label = next(iter(found))
        require_same(identities[label], expected, f"Report: {label}", Level.PRIORS)


def _require_tested(
    validation: Mapping[str, tuple[Any, xr.DataArray]], tests: Mapping[str, ValidityTest]
) -> None:
    """Refuse validation data that are not those of a test, where there are tests."""
    known: list[Floats] = []
    for test in tests.values():
        known.append(test.u_values)
        for condition in np.unique(test.conditions):
            known.append(test.u_values[test.conditions == condition])
    for condition, (measured, predicted) in validation.items():
        u = u_values({condition: measured}, {condition: predicted})
        if known and not any(_alike(u, own) for own in known):
            raise ValueError(
                f"Report: validation: {condition}: got {u.size} values other than those of the "
                f"tests in validity=, expected what prb.area_test was given; test them too, or "
                "leave validity= out"
            )


def _alike(u: Floats, tested: Floats) -> bool:
    """Return whether u-values are those of a test, up to rounding and ties, in their order."""
    folded = np.abs(2 * u - 1)
    return u.shape == tested.shape and any(
        np.median(np.abs(own - tested)) < _ROUNDED_BY for own in (u, folded)
    )


def _require_known_labels(
    labels: Mapping[str, str] | None,
    model: pm.Model | None,
    description: dict[str, Any] | None,
    outputs: Mapping[str, Outputs],
    validation: Mapping[str, Any] | None,
) -> None:
    """Refuse labels of what the report does not have, where it is known what it has."""
    if not labels or (description is None and model is None):
        return
    known = set(validation or {})
    for simulator, own in outputs.items():
        known |= {simulator, *own.names}
    if description is not None:
        known |= {str(variable["name"]) for variable in description["variables"]}
    evaluator = None if model is None else Evaluator.of(model)
    refuse_labels(labels, sorted(known), evaluator=evaluator)


def _require_comparison(comparison: Any) -> None:
    if comparison is None:
        return
    if not isinstance(comparison, xr.Dataset) or "estimate" not in comparison:
        raise TypeError(
            f"Report: comparison: got {type(comparison).__name__}, "
            "expected the Dataset of prb.compare"
        )


def _require_different_names(optima: dict[str, Any], posteriors: dict[str, Any]) -> None:
    twice = sorted(set(optima) & set(posteriors))
    if twice:
        raise ValueError(
            f"Report: got the names {twice} for optima and posteriors, expected different ones"
        )


def _require_test(label: str, test: Any) -> None:
    if not isinstance(test, ValidityTest):
        raise TypeError(
            f"Report: {label}: got {type(test).__name__}, "
            "expected a ValidityTest from prb.area_test"
        )


def _require(label: str, tree: Any, group: str, dims: tuple[str, ...], origin: str) -> None:
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


def _require_optimum(label: str, tree: Any) -> None:
    _require(label, tree, "optimum", (), "prb.minimize")
    if "stderr" not in tree:
        raise TypeError(
            f"Report: {label}: got a DataTree without the group stderr, "
            "expected one of prb.minimize"
        )


# -- what was not given ----------------------------------------------------------------------


def _answer(tree: xr.DataTree) -> xr.DataTree:
    """Return the group of a result that has its estimates."""
    return tree.children["posterior" if "posterior" in tree else "optimum"]


def _stored_description(results: dict[str, xr.DataTree]) -> dict[str, Any] | None:
    """Return the first description of the model that a result has."""
    for tree in results.values():
        description = from_attributes(_answer(tree).attrs)
        if description is not None:
            return description
    return None


def _observed(
    model: pm.Model | None, results: dict[str, xr.DataTree]
) -> tuple[dict[str, Floats], dict[str, Outputs]]:
    """Return the measured responses, and what their columns are, by simulator."""
    if model is not None:
        known = population_simulators(model)
        observed = {simulator.name: simulator.observed for simulator in known}
        return observed, {simulator.name: simulator.outputs for simulator in known}
    for tree in results.values():
        if "observed_data" in tree:
            stored = tree["observed_data"].data_vars.items()
            found = {str(name): _stored_observed(str(name), values) for name, values in stored}
            return (
                {name: values for name, (values, _) in found.items()},
                {name: outputs for name, (_, outputs) in found.items()},
            )
    return {}, {}


def _stored_observed(name: str, values: xr.DataArray) -> tuple[Floats, Outputs]:
    """Return the measured responses of a simulator, and what their columns are, from a result."""
    if values.ndim != 2:
        unit = values.attrs.get("units")
        outputs = Outputs(units=(unit,)) if isinstance(unit, str) and unit else ONE
        return np.ravel(values.values), outputs
    units = values.attrs.get("units")
    if units is not None and not isinstance(units, str):  # of each output
        values = values.assign_coords(units=(values.dims[1], np.asarray(units)))
    return read_observed(name, values)


def _diagnosis(result: Optimum | xr.DataTree, model: pm.Model | None) -> Diagnosis | None:
    """Return what is wrong with a result; None where only the model could tell."""
    if isinstance(result, Optimum):
        return diagnose(result)
    stored = "optimum" in result or "calibration" in result
    # By a metric or prior other than the model's, say: the result then tells by itself.
    if model is not None and not _is_of(result, model):
        model = None
    if model is None and not stored:
        return None
    return diagnose(result, model=model)


def _is_of(result: xr.DataTree, model: pm.Model) -> bool:
    """Return whether a result is of a model's very problem, as far as is known."""
    identity = identity_in(result)
    if identity is None:
        return True
    return not differences(identity, identity_of_model(model), Level.OPTIMUM)
