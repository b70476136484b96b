"""Descriptions of a model for files and reports: texts, labelled datasets, and versions."""

from __future__ import annotations

import importlib.metadata
import json
import platform
import re
from collections.abc import Mapping, Sequence, Set
from datetime import UTC, datetime
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from pymc.printing import str_for_dist
from pytensor.graph.basic import Variable
from pytensor.graph.traversal import walk

from prbayes._validate import FORMAT, NamedValues
from prbayes.model.evaluator import Evaluator, with_data
from prbayes.model.random_variable import nodes, response_name
from prbayes.model.simulator_with_data import SimulatorWithData
from prbayes.model.specimen_likelihood import measurements_of, specimen_likelihoods
from prbayes.model.specimen_preparation import prepared
from prbayes.response.inputs import argument_names, unit_of
from prbayes.response.outputs import Outputs
from prbayes.response.pymc_dims import is_random

# Fields in the description of a variable, and in that of a simulator.
_VARIABLE = ("name", "role", "distribution")
_SIMULATOR = (
    "name",
    "response",
    "metric",
    "propagation",
    "n_points",
    "specimens",
    "n_specimens",
    "runs",
)

_CONSTANT = "<constant>"  # PyMC prints this text instead of an array


def describe(model: pm.Model) -> dict[str, Any]:
    """Return the model as texts that JSON takes.

    Returns
    -------
    dict
        ``variables``: name, role and distribution of each; ``simulators``: name, response, inputs
        (name, unit, and distribution or value of each), metric, propagation, the number of its
        points, specimens and their number, and runs.
    """
    named = {*model.basic_RVs, *model.deterministics}
    by_metric = nodes(model)
    likelihoods = specimen_likelihoods(model)
    described = [(rv, "hyperparameter", _distribution(rv, named)) for rv in model.free_RVs]
    for v in model.deterministics:
        described.append((v, "deterministic", f"computed from {_parents(v, named)}"))
    for rv in model.observed_RVs:
        if rv not in by_metric and rv not in likelihoods:
            described.append((rv, "observed", _distribution(rv, named)))
    simulators = []
    for node in by_metric.values():
        runs = type(node.propagation).__name__  # a user's own propagation may have no attribute n
        if hasattr(node.propagation, "n"):
            use = ", once; weighted" if node.bound.stored else ""
            runs = f"{node.propagation.n} runs{use} for each population"
        propagation = without_addresses(node.propagation)
        simulators.append(_simulator(node, named, propagation, node.bound.n_points, runs))
    for rv, measurement in measurements_of(model).items():
        n_runs = len(prepared(likelihoods[rv]).emulation.z)
        runs = f"emulator of {n_runs} runs"
        simulators.append(_simulator(measurement, named, runs, n_runs, runs))
    return {
        "variables": [
            {"name": str(variable.name), "role": role, "distribution": text}
            for variable, role, text in described
        ],
        "simulators": simulators,
    }


def _simulator(
    simulator: SimulatorWithData,
    named: Set[Any],
    propagation: str,
    n_points: int,
    runs: str,
) -> dict[str, Any]:
    """Return the description of a simulator."""
    # [name, unit, distribution or value] of each input; an unnamed input is a text alone.
    inputs = []
    names = argument_names(simulator.inputs, simulator.responses.function)
    for name, argument in zip(names, simulator.inputs.arguments, strict=True):
        if isinstance(argument, int):  # the argument is the index of an aleatory input
            x = simulator.inputs.aleatory[argument]
            is_known = argument in simulator.inputs.conditions
            unit = f" ({unit_of(x)})" if unit_of(x) else ""
            inputs.append(
                ["", "", f"condition {x.name}"]
                if is_known
                else [name, unit, f"~ {_distribution(x, named)}"]
            )
        elif isinstance(argument, Variable):
            text = argument.name or f"an expression of {_parents(argument, named)}"
            inputs.append(["", "", str(text)])
        else:
            value = np.asarray(argument)
            number = f"{value.item():.6g}" if value.size == 1 else ""
            inputs.append([name, "", f"= {number or f'an array of shape {value.shape}'}"])
    specimens, n_specimens = "", ""
    if simulator.specimens is not None:
        labels = list(dict.fromkeys(map(str, simulator.specimens.tolist())))
        n_specimens = f"{len(labels)} specimens"
        # 40 labels take about three lines of a report.
        specimens = f"{n_specimens}: {', '.join(labels[:40])}"
        if len(labels) > 40:
            specimens += f", and {len(labels) - 40} more"
    return {
        "name": simulator.name,
        "response": response_name(simulator.responses.function),
        "inputs": inputs,
        "metric": without_addresses(simulator.metric),
        "propagation": propagation,
        "n_points": str(n_points),
        "specimens": specimens,
        "n_specimens": n_specimens,
        "runs": runs,
    }


def without_addresses(configuration: object) -> str:
    """Return the representation of a metric or propagation, the same in every session.

    Functions have their names.
    """
    without = re.sub(r" at 0x[0-9a-fA-F]+", "", repr(configuration))
    return re.sub(r"<function ((?:[\w.]|<locals>|<lambda>)+)>", r"\1", without)


def as_attribute(model: pm.Model) -> dict[str, str]:
    """Return the description as an attribute of a file; none where it is too long for one."""
    return json_attribute("model", describe(model))


def json_attribute(name: str, content: NamedValues) -> dict[str, str]:
    """Return JSON as an attribute of an HDF5 file; none where it is too long, near 64 KiB."""
    # JSON escapes letters beyond ASCII, so that its length in characters is the length in bytes.
    text = json.dumps(content)
    return {name: text} if len(text) <= 60_000 else {}


def from_attributes(attrs: Mapping[Any, Any]) -> dict[str, Any] | None:
    """Return the description that a file has; None where there is none, or it is damaged."""
    try:
        stored = json.loads(attrs["model"])
        return {
            "variables": [{key: str(v[key]) for key in _VARIABLE} for v in stored["variables"]],
            "simulators": [_stored_simulator(s) for s in stored["simulators"]],
        }
    except (KeyError, TypeError, ValueError, RecursionError):
        return None


def _stored_simulator(stored: NamedValues) -> dict[str, Any]:
    texts = {key: str(stored[key]) for key in _SIMULATOR}
    rows = [[str(name), str(unit), str(text)] for name, unit, text in stored["inputs"]]
    return {**texts, "inputs": rows}


def as_pymc_writes(rv: Any, named: Set[Any]) -> str:
    """Return a distribution as PyMC prints it, with names of some variables.

    Results recognise their model by this text.
    """
    text: str = str_for_dist(rv, named_vars=named)
    return text.removeprefix(f"{rv.name} ~ ")


def _distribution(rv: Any, named: Set[Any]) -> str:
    """Return a distribution as text for a report, with the numbers of arrays, which PyMC omits."""
    text = as_pymc_writes(rv, named).replace("_lkjcholeskycov(", "LKJCholeskyCov(")
    arrays = _constants(rv)
    if text.count(_CONSTANT) == len(arrays):
        for array in arrays:
            text = text.replace(_CONSTANT, array, 1)
    return text


def _constants(rv: Any) -> list[str]:
    """Return the parameters of a distribution that are constant arrays, as texts."""
    try:
        parameters = rv.owner.op.dist_params(rv.owner)
    except (AttributeError, TypeError, ValueError):  # some distributions have no such method
        return []
    texts = []
    for parameter in parameters:
        while parameter.owner is not None and len(parameter.owner.inputs) == 1:
            (parameter,) = parameter.owner.inputs  # operations with one input only change the axes
        if is_random(parameter):  # such as the distribution of standard deviations in a covariance
            texts += _constants(parameter)
            continue
        value = getattr(parameter, "data", None)
        if value is None or np.size(value) == 1:
            continue
        if np.size(value) > 6:
            texts.append(f"{np.size(value)} numbers")
        else:
            texts.append(f"[{', '.join(f'{number:.4g}' for number in np.ravel(value))}]")
    return texts


def _parents(variable: Any, named: Set[Any]) -> str:
    """Return the names of the nearest variables of the model that a variable depends on."""

    def inputs_of(v: Any) -> Any:
        return None if v in named or v.owner is None else v.owner.inputs

    start = [] if variable.owner is None else variable.owner.inputs
    names = [str(v.name) for v in walk(start, inputs_of) if v in named]
    return ", ".join(names) or "constants"


@cache
def versions() -> dict[str, str]:
    """Return the versions that a result depends on, and the format of its attributes."""
    packages = ("prbayes", "pymc", "pytensor", "arviz", "numpy", "scipy")
    result = {f"{package}_version": importlib.metadata.version(package) for package in packages}
    return {
        **result,
        "prbayes_format": str(FORMAT),
        "python_version": platform.python_version(),
    }


def arviz_attributes() -> dict[str, str]:
    """Return the attributes that ArviZ gives a group."""
    version = versions()["prbayes_version"]
    return {
        "created_at": datetime.now(UTC).isoformat(),
        "creation_library": "prbayes",
        "creation_library_version": version,
        "creation_library_language": "Python",
        "inference_library": "prbayes",
        "inference_library_version": version,
    }


def labelled(evaluator: Evaluator, values: dict[str, Any], leading: dict[str, int]) -> xr.Dataset:
    """Label values, shapes (*leading, *shape), with the model's own dimensions and coordinates."""
    model = evaluator.model
    coords = {name: np.arange(size) for name, size in leading.items()}
    variables = {}
    for name, value in values.items():
        array = np.asarray(value)
        unnamed = [None] * (array.ndim - len(leading))
        dims = model.named_vars_to_dims.get(name) or unnamed
        for dim in filter(None, dims):
            if model.coords.get(dim) is not None:
                coords[dim] = np.asarray(model.coords[dim])
        names = [dim or f"{name}_dim_{i}" for i, dim in enumerate(dims)]
        variables[name] = ([*leading, *names], array)
    return xr.Dataset(variables, coords=coords)


def failures_dataset(evaluator: Evaluator) -> xr.Dataset:
    """Return the points whose response failed: simulator, inputs, reason, and replacement.

    Dims (failure) and (failure, column): the arguments of the response one after the other, NaN
    where another simulator has more of them. The replacement, ``instead``, is NaN for none.
    """
    failures = [
        (simulator.name, simulator.responses.replacement, failure)
        for simulator in with_data(evaluator)
        for failure in simulator.responses.failed
    ]
    columns = max((failure.inputs.size for _, _, failure in failures), default=0)
    inputs = np.full((len(failures), columns), np.nan)
    for row, (_, _, failure) in zip(inputs, failures, strict=True):
        row[: failure.inputs.size] = failure.inputs
    names = np.array([name for name, _, _ in failures], dtype=object)
    reasons = np.array([failure.reason for _, _, failure in failures], dtype=object)
    return xr.Dataset(
        {
            "simulator": ("failure", names.astype(str)),
            "inputs": (["failure", "column"], inputs),
            "reason": ("failure", reasons.astype(str)),
            "instead": ("failure", np.array([value for _, value, _ in failures], dtype=float)),
        }
    )


def observed_dataset(evaluator: Evaluator) -> xr.Dataset:
    """Return the observed responses of all simulators, labelled; several outputs by their names."""
    observed = {simulator.name: simulator.observed for simulator in with_data(evaluator)}
    data = labelled_responses(evaluator, observed)
    for simulator in with_data(evaluator):
        if sheet := simulator.metric.data_sheet:
            data[simulator.name].attrs["data_sheet"] = sheet
    return data


def labelled_responses(
    evaluator: Evaluator, values: dict[str, Any], leading: Sequence[int] = ()
) -> xr.Dataset:
    """Return responses of simulators by their names, shapes (*leading, N) or (*leading, N, m).

    Leading dimensions are chains and draws.
    """
    sizes = dict(zip(("chain", "draw"), leading, strict=False))
    data = labelled(evaluator, values, sizes)
    for simulator in with_data(evaluator):
        name, outputs = simulator.name, simulator.outputs
        if name in values:
            if outputs.event:
                data = _with_output_names(data, name, outputs)
            data[name].attrs |= outputs.attrs
    return data


def _with_output_names(data: xr.Dataset, name: str, outputs: Outputs) -> xr.Dataset:
    """Return responses with a dimension that names the outputs, unless the model names it."""
    last = str(data[name].dims[-1])
    if last != f"{name}_dim_1":
        return data
    labels = np.asarray(outputs.labels)
    if labels.dtype.kind not in "iuf":  # a file can store numbers and texts only
        labels = np.array(outputs.names)
    dim = outputs.dim
    if dim in data.coords:
        is_free = np.array_equal(data.coords[dim].values, labels)
    else:
        is_free = dim not in data.dims and dim not in data.data_vars
    if not is_free:
        # The dimension's name is in use for another simulator with other outputs.
        dim = f"{name}_{dim}"
    renamed = data[name].rename({last: dim})
    return data.drop_vars(name).assign({name: renamed}).assign_coords({dim: labels})
