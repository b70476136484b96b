"""What a report is made of: results of any origin, checked, and brought into one form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._checks import Floats
from prbayes._compare import compare
from prbayes._diagnose import Diagnosis, diagnose
from prbayes.estimate.optimum import Optimum
from prbayes.model.description import describe, from_attributes
from prbayes.model.node import nodes
from prbayes.validation.validity import ValidityTest


@dataclass(frozen=True, eq=False)
class Material:
    """Results by label; a single one has its kind as label.

    Attributes
    ----------
    model : pymc.Model or None
    description : dict or None
        Of the model; from a file where there is no model.
    optima : dict of DataTree
    found : dict of Optimum
        Those of the optima that are not from a file.
    posteriors : dict of DataTree
    tests : dict of ValidityTest
    comparison : Dataset or None
    observed : dict of ndarray
        Measured responses by simulator.
    diagnoses : dict of Diagnosis, or None where the model is needed
    """

    model: pm.Model | None
    description: dict[str, Any] | None
    optima: dict[str, xr.DataTree]
    found: dict[str, Optimum]
    posteriors: dict[str, xr.DataTree]
    tests: dict[str, ValidityTest]
    comparison: xr.Dataset | None
    observed: dict[str, Floats]
    diagnoses: dict[str, Diagnosis | None]

    @property
    def results(self) -> dict[str, xr.DataTree]:
        """Optima and posteriors."""
        return self.optima | self.posteriors

    def attrs(self, label: str) -> dict[Any, Any]:
        """Return what a result says about itself."""
        tree = self.results[label]
        return dict(tree["posterior" if label in self.posteriors else "optimum"].attrs)

    @property
    def hyperparameters(self) -> list[str]:
        """Names of the hyperparameters, without deterministics where they are known as such."""
        if self.description is not None:
            return [v["name"] for v in self.description["variables"] if v["role"] == "hyperparameter"]
        first = next(iter(self.results.values()), None)
        group = None if first is None else first["posterior" if "posterior" in first else "optimum"]
        return [] if group is None else list(map(str, group.data_vars))


def gather(model: Any, optimum: Any, posterior: Any, validity: Any, comparison: Any) -> Material:
    """Check what was given.

    Raises
    ------
    TypeError, ValueError
        If a result is not what it is given as.
    """
    if model is not None and not isinstance(model, pm.Model):
        raise TypeError(f"Report: model: got {type(model).__name__}, expected a pm.Model")
    if comparison is not None and not (isinstance(comparison, xr.Dataset) and "estimate" in comparison):
        raise TypeError(f"Report: comparison: got {type(comparison).__name__}, expected the Dataset of prb.compare")
    given, posteriors = _labelled(optimum, "optimum"), _labelled(posterior, "posterior")
    tests = _labelled(validity, "validity")
    twice = sorted(set(given) & set(posteriors))
    if twice:
        raise ValueError(f"Report: got the names {twice} for optima and posteriors, expected different ones")
    for label, test in tests.items():
        if not isinstance(test, ValidityTest):
            raise TypeError(f"Report: {label}: got {type(test).__name__}, expected a ValidityTest from prb.area_test")
    for label, tree in posteriors.items():
        _require(label, tree, "posterior", ("chain", "draw"), "prb.sample_smc")
    optima = {label: o.to_datatree() if isinstance(o, Optimum) else o for label, o in given.items()}
    for label, tree in optima.items():
        _require(label, tree, "optimum", (), "prb.minimize")
        if "stderr" not in tree:
            raise TypeError(f"Report: {label}: got a DataTree without the group stderr, expected one of prb.minimize")
    found = {label: o for label, o in given.items() if isinstance(o, Optimum)}
    results = optima | posteriors
    description = describe(model) if model is not None else _stored_description(results)
    if comparison is None and len(results) > 1:
        comparison = _free_only(compare(results | found, model=model), description)
    return Material(
        model=model,
        description=description,
        optima=optima,
        found=found,
        posteriors=posteriors,
        tests=tests,
        comparison=comparison,
        observed=_observed(model, results),
        diagnoses={label: _diagnosis(found.get(label, tree), model) for label, tree in results.items()},
    )


def _labelled(given: Any, kind: str) -> dict[str, Any]:
    if given is None:
        return {}
    if isinstance(given, Mapping) and not isinstance(given, xr.DataTree):
        return {str(label): value for label, value in given.items()}
    return {kind: given}


def _require(label: str, tree: Any, group: str, dims: tuple[str, ...], origin: str) -> None:
    if not isinstance(tree, xr.DataTree) or group not in tree or not tree[group].data_vars:
        raise TypeError(
            f"Report: {label}: got {type(tree).__name__}, expected a DataTree with the group {group}, from {origin}"
        )
    lacking = [str(n) for n, v in tree[group].data_vars.items() if not set(dims) <= set(v.dims)]
    if lacking:
        raise ValueError(f"Report: {label}: got {lacking} without the dimensions {dims}, expected draws of {origin}")


def _stored_description(results: dict[str, xr.DataTree]) -> dict[str, Any] | None:
    groups = [tree[g] for tree in results.values() for g in ("posterior", "optimum") if g in tree]
    return next((d for d in (from_attributes(g.attrs) for g in groups) if d is not None), None)


def _free_only(comparison: xr.Dataset, description: dict[str, Any] | None) -> xr.Dataset:
    """Leave out deterministics, as `compare` does where it has the model."""
    roles = {v["name"]: v["role"] for v in (description or {"variables": []})["variables"]}
    names = comparison["hyperparameter"].values.tolist()
    kept = [n for n in names if roles.get(n.split("[")[0], "hyperparameter") == "hyperparameter"]
    return comparison.sel(hyperparameter=kept or names)


def _observed(model: pm.Model | None, results: dict[str, xr.DataTree]) -> dict[str, Floats]:
    if model is not None:
        return {node.name: node.target.observed for node in nodes(model).values()}
    for tree in results.values():
        if "observed_data" in tree:
            return {str(n): np.ravel(v.values) for n, v in tree["observed_data"].data_vars.items()}
    return {}


def _diagnosis(result: Any, model: pm.Model | None) -> Diagnosis | None:
    if isinstance(result, Optimum):
        return diagnose(result)
    if "posterior" in result:
        known = model is not None or "calibration" in result
        return diagnose(result, model=model) if known else None
    attrs = result["optimum"].attrs
    lines = str(attrs.get("warnings", "")).splitlines()
    messages = [f"{line[0].upper()}{line[1:]}." for line in lines if line]
    if not attrs.get("converged", 1):
        messages.append(f"The optimiser did not converge ({attrs.get('message', '')}).")
    return Diagnosis(tuple(messages), xr.Dataset())


def elements(group: Any) -> dict[str, Floats]:
    """Return values by element, such as 'mu[1]', of a group's variables; draws as one axis."""
    found: dict[str, Floats] = {}
    for name, variable in group.data_vars.items():
        leading = [d for d in ("chain", "draw") if d in variable.dims]
        values = variable.transpose(*leading, ...).values
        values = values.reshape(-1, *values.shape[len(leading) :]) if leading else values[None]
        for i in np.ndindex(values.shape[1:]):
            found[f"{name}[{','.join(map(str, i))}]" if i else str(name)] = values[(slice(None), *i)]
    return found
