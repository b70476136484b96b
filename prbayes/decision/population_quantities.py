"""Moments and quantiles of inputs, and of responses, in each of many populations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from pytensor.tensor.variable import TensorVariable

from prbayes._finding import Findings
from prbayes._validate import Floats, NamedArrays, wrong_value
from prbayes.decision.plan import Condition
from prbayes.decision.populations import Populations, checked_quantity
from prbayes.decision.quantities import Mean, Quantile, Quantity, StandardDeviation
from prbayes.model.evaluator import read_inputs_of_copy
from prbayes.model.fingerprint import identity_from_attributes, require_together
from prbayes.model.margins import margins, select_margins
from prbayes.model.parameters import element_name, variable_of, variables_at
from prbayes.optimize.optimum import identity_in
from prbayes.response.inputs import (
    Groups,
    event_shape,
    unit_of,
)
from prbayes.response.moments import InputMoments
from prbayes.response.outputs import SINGLE_OUTPUT
from prbayes.response.pymc_dims import is_random
from prbayes.results.predict import covariate_values, points_by_group


@dataclass(frozen=True, eq=False)
class Element:
    """One number that varies from specimen to specimen."""

    name: str
    unit: str
    groups: Groups | None
    # Values by the name of a quantity, (groups, k), or (1, k) without groups. If the result is an
    # optimum, the first of the k populations is that of the optimum.
    numbers: NamedArrays
    findings: Findings = ()


@dataclass(frozen=True, eq=False)
class PopulationReader:
    """Quantities of inputs and responses in the populations of a result."""

    populations: Populations
    levels: Mapping[str, float]  # probabilities of quantiles, by name
    at: Mapping[str, float]  # values of covariates

    @cached_property
    def _thetas(self) -> Floats:
        populations = self.populations
        if populations.are_draws:
            return populations.thetas
        return np.vstack([populations.center[None], populations.thetas])

    @cached_property
    def _points(self) -> NamedArrays:
        return variables_at(self.populations.evaluator.hyperparameters, self._thetas)

    def elements(self, requested: Any) -> list[Element]:
        """Return the requested elements, or those of all inputs of the model."""
        caller = self.populations.caller
        available = margins(self.populations.evaluator)
        if requested is None:
            requested = list(dict.fromkeys(margin.dist for margin in available))
        if not isinstance(requested, list | tuple):
            requested = [requested]
        if not requested:
            raise wrong_value(requested, f"{caller}: inputs", "one at least")
        elements = []
        for x in requested:
            if isinstance(x, xr.DataArray):
                elements += self._predicted(x)
            elif isinstance(x, Condition):
                elements += self._response(x)
            elif isinstance(x, TensorVariable) and not is_random(x):
                raise TypeError(
                    f"{caller}: inputs: got an expression ({x}), expected a `.dist()`, or the name "
                    f"of an input or element among {[m.name for m in available]}; an expression is "
                    "a response: prb.decision.Condition(function, x)"
                )
            elif isinstance(x, TensorVariable) and all(m.dist is not x for m in available):
                elements += self._input(x.name or f"input {len(elements) + 1}", x)
            else:
                selection = select_margins(available, [x])
                for dist in dict.fromkeys(margin.dist for margin in selection):
                    matches = [margin for margin in selection if margin.dist is dist]
                    every = self._input(variable_of(matches[0].name), dist)
                    shape = event_shape(dist)
                    indices = dict.fromkeys(margin.index for margin in matches)
                    elements += [every[np.ravel_multi_index(i, shape) if i else 0] for i in indices]
        return elements

    def _input(self, name: str, dist: TensorVariable) -> list[Element]:
        """Return the elements of an input."""
        label = f"{self.populations.caller}: {name}"
        inputs = read_inputs_of_copy(label, [dist], self.populations.evaluator.model, fixed=True)
        at = {str(v.name): self.at[v.name] for v in inputs.covariates if v.name in self.at}
        size = len(self._thetas)
        points = self._points | covariate_values(label, inputs, at, {}, size, has_runs=False)
        functions, levels = self.populations.evaluator.functions, list(self.levels.values())
        key = ("moments", dist, *levels)
        if key not in functions:
            functions[key] = InputMoments(label, inputs, levels)
        moments = functions[key]
        arrays = []  # (k, q, elements): numbers of each group
        for group_points in points_by_group(inputs, points):
            arrays.append(moments.numbers([group_points[str(p.name)] for p in inputs.parents]))
        numbers = np.stack(arrays)
        numbers = np.broadcast_to(numbers, (len(arrays), size, *numbers.shape[2:]))
        (shape,) = inputs.event_shapes
        elements = [element_name(name, index) for index in np.ndindex(shape)]
        names = ["mean", "sd", *self.levels]
        names += [f"correlation with {x}" for x in elements[: numbers.shape[2] - len(names)]]
        return [
            Element(x, unit_of(dist, index), inputs.groups, _by_name(names, numbers[..., i]))
            for i, (x, index) in enumerate(zip(elements, np.ndindex(shape), strict=True))
        ]

    def _response(self, condition: Condition) -> list[Element]:
        """Return the outputs of a response at stored specimens, weighted by each population."""
        sample = self.populations.sample_of_all_outputs(condition.response, condition.inputs)
        several = sample.outputs.ndim > 1
        outputs = sample.responses.outputs or SINGLE_OUTPUT
        labels = outputs.names or tuple(map(str, range(sample.outputs.shape[-1] if several else 1)))
        response = condition.response
        moments = [Mean(response), StandardDeviation(response)]
        by_level = [Quantile(response, probability=p) for p in self.levels.values()]
        elements = []
        for column, label in enumerate(labels):
            output = replace(sample, column=column if several else None)
            findings, _ = checked_quantity(output, by_level[-1])
            quantities = [*([] if np.isposinf(output.values[-1]) else moments), *by_level]
            numbers = np.full((1, len(self._thetas), 2 + len(by_level)), np.nan)
            numbers[0, :, -len(quantities) :] = output.evaluate(
                _side_by_side(quantities), self._thetas
            )
            name = element_name(sample.responses.name, [label] if several else [])
            unit = outputs.units[column] if outputs.units else ""
            named = _by_name(["mean", "sd", *self.levels], numbers)
            elements.append(Element(name, unit, None, named, findings))
        return elements

    def _predicted(self, predicted: xr.DataArray) -> list[Element]:
        """Return the outputs of a prediction, whose draws are the populations."""
        caller, name = self.populations.caller, str(predicted.name or "response")
        dims = ("chain", "draw", "sample")
        if not set(dims) <= set(predicted.dims) or not self.populations.are_draws:
            raise TypeError(
                f"{caller}: {name}: got a DataArray of {list(predicted.dims)}, expected "
                "prb.predict of a posterior, whose draws are populations; for an optimum pass "
                "prb.decision.Condition(response, *inputs)"
            )
        identities = {"result": identity_in(self.populations.result)}
        require_together(identities | {name: identity_from_attributes(predicted.attrs)}, caller)
        nodes = self.populations.evaluator.simulators
        groups = next((n.inputs.groups for n in nodes if n.inputs.groups is not None), None)
        groups = groups if groups is not None and groups.dim in predicted.dims else None
        leading = [] if groups is None else [groups.dim]
        output_dims = [d for d in predicted.dims if d not in (*dims, *leading)]
        values = predicted.transpose(*leading, *dims[:2], *output_dims, dims[2]).values
        n_populations = predicted.sizes["chain"] * predicted.sizes["draw"]
        n_groups = 1 if groups is None else len(groups.labels)
        values = values.reshape(n_groups, n_populations, -1, predicted.sizes["sample"])
        with np.errstate(invalid="ignore"):
            moments = [np.nanmean(values, axis=-1), np.nanstd(values, axis=-1)]
            levels = np.nanquantile(values, list(self.levels.values()), axis=-1)
        numbers = np.stack([*moments, *levels], axis=2)
        labels = [str(x) for d in output_dims for x in predicted[d].values]
        units = np.broadcast_to(predicted.attrs.get("units", ""), len(labels) or 1)
        names = ["mean", "sd", *self.levels]
        return [
            Element(element_name(name, labels[j : j + 1]), str(unit), groups, _by_name(names, x))
            for j, (unit, x) in enumerate(zip(units, np.moveaxis(numbers, -1, 0), strict=True))
        ]


def _side_by_side(quantities: Sequence[Quantity]) -> Callable[[Floats, Floats], Floats]:
    """Return a functional whose last axis has the quantities."""

    def functional(values: Floats, weights: Floats) -> Floats:
        return np.stack([quantity.of(values, weights) for quantity in quantities], axis=-1)

    return functional


def _by_name(names: Sequence[str], numbers: Floats) -> NamedArrays:
    """Return numbers, (groups, k, q) -> (groups, k), by quantity, and the cv."""
    by_name = dict(zip(names, np.moveaxis(numbers, -1, 0), strict=True))
    mean, sd = by_name.pop("mean"), by_name.pop("sd")
    # A mean of zero is computed with rounding errors, and has no cv.
    mean = np.where(np.abs(mean) <= 1e-9 * sd, 0.0, mean)
    cv = sd / np.where(mean == 0, np.nan, np.abs(mean))
    return {"mean": mean, "sd": sd, "cv": cv} | by_name
