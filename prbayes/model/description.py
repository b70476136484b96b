"""What a model is, in words that go into a file: variables, simulators, names of elements."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Set
from typing import Any

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pymc.printing import str_for_dist
from pytensor.graph.basic import Variable
from pytensor.graph.traversal import walk

from prbayes.model.measurement import Measurement, SpecimenLikelihood
from prbayes.model.random_variable import Node, nodes, response_name
from prbayes.model.specimen_preparation import prepared
from prbayes.model.specimen_variable import measurements_of, specimen_likelihoods
from prbayes.response.inputs import Inputs, is_random

# What is told of a variable and of a simulator.
_VARIABLE = ("name", "role", "distribution")
_SIMULATOR = ("name", "response", "inputs", "metric", "propagation", "n_points", "specimens")

# What PyMC writes for an array, and how many numbers of one are told instead.
_CONSTANT = "<constant>"
_TOLD_NUMBERS = 6


def describe(model: pm.Model) -> dict[str, Any]:
    """Return the model in words and numbers that JSON takes.

    Returns
    -------
    dict
        ``variables``: name, role and distribution of each; ``simulators``: name, response, inputs,
        metric, propagation, the number of its points, and specimens.
    """
    known = known_variables(model)
    simulators = nodes(model)
    measurements = measurements_of(model)
    likelihoods = specimen_likelihoods(model)
    variables = []
    for rv in model.free_RVs:
        variables.append(_variable(rv, "hyperparameter", _distribution(rv, known)))
    for computed in model.deterministics:
        text = f"computed from {_above(computed, known)}"
        variables.append(_variable(computed, "deterministic", text))
    for rv in model.observed_RVs:
        if rv not in simulators and rv not in likelihoods:
            variables.append(_variable(rv, "observed", _distribution(rv, known)))
    described = [_simulator(node, known) for node in simulators.values()]
    described += [_specimen_simulator(m, likelihoods[rv], known) for rv, m in measurements.items()]
    return {"variables": variables, "simulators": described}


def without_addresses(configuration: object) -> str:
    """Return the representation of a metric or propagation, the same in every session.

    Functions are told by their names.
    """
    without = re.sub(r" at 0x[0-9a-fA-F]+", "", repr(configuration))
    return re.sub(r"<function ((?:[\w.]|<locals>|<lambda>)+)>", r"\1", without)


def as_attribute(model: pm.Model) -> dict[str, str]:
    """Return the description as an attribute of a file; none where it is too long for one."""
    text = json.dumps(describe(model))
    return {"model": text} if fits_attribute(text) else {}


def fits_attribute(text: str) -> bool:
    """Return whether a text is short enough for an attribute of an HDF5 file.

    That holds less than 64 KiB, with what surrounds it. JSON writes letters beyond ASCII as six
    characters of a byte each, so that its characters are bytes.
    """
    return len(text) <= 60_000


def from_attributes(attrs: Mapping[Any, Any]) -> dict[str, Any] | None:
    """Return the description that a file has; None where there is none, or it is damaged."""
    try:
        found = json.loads(attrs["model"])
        variables = [_texts(v, _VARIABLE) for v in found["variables"]]
        simulators = [_texts(s, _SIMULATOR) for s in found["simulators"]]
    except (KeyError, TypeError, ValueError, RecursionError):
        return None
    return {"variables": variables, "simulators": simulators}


def _texts(found: Mapping[str, Any], keys: tuple[str, ...]) -> dict[str, str]:
    return {key: str(found[key]) for key in keys}


def _variable(variable: Any, role: str, distribution: str) -> dict[str, str]:
    return {"name": str(variable.name), "role": role, "distribution": distribution}


def _simulator(node: Node, known: Set[Any]) -> dict[str, str]:
    return {
        "name": node.name,
        "response": response_name(node.bound.responses.function),
        "inputs": _arguments(node.bound.inputs, known),
        "metric": without_addresses(node.metric),
        "propagation": without_addresses(node.propagation),
        "n_points": str(node.bound.n_points),
        "specimens": _specimens(node.specimens),
    }


def _specimen_simulator(
    measurement: Measurement, likelihood: SpecimenLikelihood, known: Set[Any]
) -> dict[str, str]:
    return {
        "name": measurement.name,
        "response": response_name(measurement.responses.function),
        "inputs": _arguments(measurement.inputs, known),
        "metric": without_addresses(measurement.metric),
        "propagation": f"emulator of {len(prepared(likelihood).emulation.z)} runs",
        "n_points": str(len(prepared(likelihood).emulation.z)),
        "specimens": _specimens(measurement.specimens),
    }


def _arguments(inputs: Inputs, known: Set[Any]) -> str:
    """Return the arguments of a response in words."""
    return ", ".join(_input(x, inputs.aleatory, known) for x in inputs.arguments)


def _input(argument: Any, aleatory: tuple[Any, ...], known: Set[Any]) -> str:
    """Return an argument of a simulator in words; an int is the place of an aleatory one."""
    if isinstance(argument, int):
        return _distribution(aleatory[argument], known)
    if isinstance(argument, Variable):
        return str(argument.name or f"an expression of {_above(argument, known)}")
    value = np.asarray(argument)
    if value.size == 1:
        return f"{value.item():.6g}"
    return f"an array of shape {value.shape}"


def known_variables(model: pm.Model) -> set[Any]:
    """Return the variables that distributions are told by."""
    return {*model.basic_RVs, *model.deterministics}


def as_pymc_writes(rv: Any, known: Set[Any]) -> str:
    """Return a distribution in PyMC's words, by which results know their model again."""
    text: str = str_for_dist(rv, named_vars=known)
    return text.removeprefix(f"{rv.name} ~ ")


def _distribution(rv: Any, known: Set[Any]) -> str:
    """Return a distribution in the words of a report."""
    text = as_pymc_writes(rv, known).replace("_lkjcholeskycov(", "LKJCholeskyCov(")
    # PyMC does not tell the numbers of arrays.
    arrays = _constants(rv)
    if text.count(_CONSTANT) != len(arrays):
        return text
    for array in arrays:
        text = text.replace(_CONSTANT, array, 1)
    return text


def _constants(rv: Any) -> list[str]:
    """Return in words the parameters of a distribution that are arrays of constants."""
    try:
        parameters = rv.owner.op.dist_params(rv.owner)
    except (AttributeError, TypeError, ValueError):  # some distributions do not say
        return []
    found = []
    for parameter in parameters:
        while parameter.owner is not None and len(parameter.owner.inputs) == 1:
            (parameter,) = parameter.owner.inputs  # with other axes
        if is_random(parameter):  # as standard deviations are that a covariance has
            found += _constants(parameter)
            continue
        value = getattr(parameter, "data", None)
        if value is None or np.size(value) == 1:
            continue
        if np.size(value) > _TOLD_NUMBERS:
            found.append(f"{np.size(value)} numbers")
        else:
            numbers = ", ".join(f"{number:.4g}" for number in np.ravel(value))
            found.append(f"[{numbers}]")
    return found


def _above(variable: Any, known: Set[Any]) -> str:
    """Return the names of the model's variables next above one."""

    def inputs_of(v: Any) -> Any:
        # Not beyond a variable of the model
        if v in known or v.owner is None:
            return None
        return v.owner.inputs

    start = [] if variable.owner is None else variable.owner.inputs
    above = walk(start, inputs_of)
    names = [str(v.name) for v in above if v in known]
    return ", ".join(names) or "constants"


def _specimens(specimens: NDArray[Any] | None) -> str:
    if specimens is None:
        return ""
    labels = list(dict.fromkeys(map(str, specimens.tolist())))
    shown = labels[:40]  # three lines of a report
    text = f"{len(labels)} specimens: {', '.join(shown)}"
    more = len(labels) - len(shown)
    return f"{text}, and {more} more" if more > 0 else text
