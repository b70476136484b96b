"""The fingerprint of a problem: what a result was computed from, and how two problems differ.

A result carries the fingerprint of its problem: an optimum, a posterior, a checkpoint on disk.
Where it meets a model again, `require_same` refuses another problem.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import IntEnum
from typing import Any

import numpy as np
import pymc as pm
from pymc.printing import str_for_dist

from prbayes._validate import Floats
from prbayes.model.description import (
    as_pymc_writes,
    fits_attribute,
    known_variables,
    without_addresses,
)
from prbayes.model.evaluator import Evaluator
from prbayes.model.measurement import Measurement
from prbayes.model.parameters import fixed_points, plain_names
from prbayes.model.random_variable import Node, nodes
from prbayes.model.specimen_likelihood import measurements_of, specimen_likelihoods
from prbayes.response.compile import interpreted
from prbayes.response.inputs import Inputs


class Level(IntEnum):
    """How much of two problems has to be the same; each level includes those before it."""

    # Hyperparameters, data, inputs and responses: populations agree. Responses at the same points
    # are compared; `require_same_responses` continues where the points differ.
    POPULATIONS = 1
    PRIORS = 2  # and priors and other likelihood terms
    # And metrics and propagations, and whether the prior was minimised. A design that has grown
    # since is the same problem.
    OPTIMUM = 3
    POSTERIOR = 4  # and epsilons
    RUN = 5  # and designs: all that draws depend on, except the sampler's settings


_REMEDIES = {
    Level.POPULATIONS: "pass the model that the result was made from, or make the result again",
    Level.PRIORS: "pass the model that the result was made from, or make the result again",
    Level.OPTIMUM: "call prb.minimize on this model, and use that optimum",
    Level.POSTERIOR: "sample this model again",
    Level.RUN: "start a new run",
}


@dataclass(frozen=True)
class SimulatorIdentity:
    """What identifies one simulator; digests are of values in a fixed order."""

    name: str
    data: str  # digest of the observed values
    weights: str  # digest of their weights
    specimens: str  # digest of the specimens' labels
    inputs: str  # the response's arguments, as PyMC prints them
    metric: str
    propagation: str
    n_points: int  # runs of the design
    batches: int  # how often points of the design were drawn
    epsilon: float  # NaN while unset
    responses: tuple[float, ...]  # the first ones
    discrepancies: tuple[float, ...] = ()  # at fixed thetas; empty where they would cost responses
    # Aleatory inputs of the first two responses; empty where the response has epistemic ones.
    points: tuple[tuple[float, ...], ...] = ()


@dataclass(frozen=True)
class Identity:
    """What identifies a problem."""

    shapes: dict[str, tuple[int, ...]]  # of value variables by name, such as 'sigma_log__'
    priors: dict[str, str]  # distributions of free variables, as PyMC prints them
    terms: tuple[str, ...]  # other observed variables, and names of potentials
    simulators: tuple[SimulatorIdentity, ...]
    prior_minimised: bool | None = None  # None for what was not minimised
    # Fixed points of the prior, elements in the order of the alphabet; empty without numbers.
    thetas: tuple[tuple[float, ...], ...] = ()
    log_prior: tuple[float, ...] = ()  # at these points
    log_other: tuple[float, ...] = ()  # log-likelihood of other terms at these points


def identity_of(evaluator: Evaluator, *, prior_minimised: bool | None = None) -> Identity:
    """Return the identity of an evaluator's problem, with numbers; computes no response."""
    names = evaluator.hyperparameters
    thetas = fixed_points(names, 4)  # a power of two: Sobol points are balanced then
    simulators = []
    for k, node in enumerate(evaluator.nodes):
        values = evaluator.discrepancies(thetas, k) if node.bound.stored else np.empty(0)
        simulators.append(_node_identity(node, values))
    simulators += map(_measurement_identity, evaluator.measurements)
    return _identity(
        evaluator.model,
        simulators,
        shapes=names.shapes,
        prior_minimised=prior_minimised,
        thetas=_tuples(thetas[:, np.argsort(plain_names(names))]),
        log_prior=_tuples(names.log_prior(thetas)),
        log_other=_tuples(evaluator.log_other(thetas)),
    )


def identity_of_model(model: pm.Model) -> Identity:
    """Return the identity of a model without densities and discrepancies, which are compiled."""
    simulators = [_node_identity(node, np.empty(0)) for node in nodes(model).values()]
    simulators += map(_measurement_identity, measurements_of(model).values())
    values = [model.rvs_to_values[rv] for rv in model.free_RVs]
    shapes = {str(value.name): value.type.shape for value in values}
    if any(None in shape for shape in shapes.values()):
        with interpreted():
            point = model.initial_point(random_seed=0)
        shapes = {name: np.shape(point[name]) for name in shapes}
    return _identity(model, simulators, shapes=shapes)


def _identity(model: pm.Model, simulators: Sequence[SimulatorIdentity], **fields: Any) -> Identity:
    variables = known_variables(model)
    simulated = {*nodes(model), *specimen_likelihoods(model)}
    observed = [rv for rv in model.observed_RVs if rv not in simulated]
    terms = [f"{rv.name} ~ {as_pymc_writes(rv, variables)}" for rv in observed]
    terms += [str(potential.name) for potential in model.potentials]
    return Identity(
        priors={str(rv.name): as_pymc_writes(rv, variables) for rv in model.free_RVs},
        terms=tuple(sorted(terms)),
        # Clones may order variables in other ways.
        simulators=tuple(sorted(simulators, key=lambda simulator: simulator.name)),
        **fields,
    )


def _node_identity(node: Node, discrepancies: Floats) -> SimulatorIdentity:
    observed, weights, bound = node.observed, node.weights, node.bound
    order = np.lexsort((weights, *observed.reshape(len(observed), -1).T[::-1]))
    labels = [] if node.specimens is None else node.specimens[order].tolist()
    batches = 1
    if node.reweighted is not None:
        design = node.reweighted.design
        batches = len(design.batch_sizes) + design.n_emulated_samples
    return SimulatorIdentity(
        name=node.name,
        data=_digest(observed[order].tobytes()),
        weights=_digest(weights[order].tobytes()),
        specimens=_digest(repr(labels).encode()),
        inputs=_inputs(bound.inputs),
        metric=without_addresses(node.metric),
        propagation=without_addresses(node.propagation),
        n_points=bound.n_runs,
        batches=batches,
        epsilon=node.epsilon_value,
        # Stored responses are appended to, so that the first stay the first.
        responses=_tuples(bound.first_responses[:8].ravel()),
        discrepancies=_tuples(discrepancies),
        points=_points(node),
    )


def _measurement_identity(measurement: Measurement) -> SimulatorIdentity:
    labels = [] if measurement.specimens is None else measurement.specimens.tolist()
    weights = b"" if measurement.weights is None else measurement.weights.tobytes()
    groups = b"" if measurement.groups is None else measurement.groups.tobytes()
    return SimulatorIdentity(
        name=measurement.name,
        data=_digest(measurement.observed.tobytes() + groups),
        weights=_digest(weights),
        specimens=_digest(repr(labels).encode()),
        inputs=_inputs(measurement.inputs),
        metric=without_addresses(measurement.metric),
        propagation=without_addresses(measurement.propagation),
        n_points=0,
        batches=1,
        epsilon=1.0,
        responses=(),
    )


def _points(node: Node) -> tuple[tuple[float, ...], ...]:
    """Return the aleatory inputs of the first two responses, a row for each.

    One response alone may agree with another by chance, as at zero.
    """
    # A user's own propagation may store no points.
    if node.inputs.epistemic or not len(node.bound.first_points):
        return ()
    columns = [x[:2].reshape(min(2, len(x)), -1) for x in node.bound.first_points]
    points: tuple[tuple[float, ...], ...] = _tuples(np.concatenate(columns, axis=1))
    return points


def _inputs(inputs: Inputs) -> str:
    """Return the arguments of a response as text, the same for all clones of a model."""
    texts = []
    for argument in inputs.arguments:
        if isinstance(argument, int):
            texts.append(str_for_dist(inputs.aleatory[argument], named_vars=set(inputs.roots)))
        elif argument in inputs.epistemic:
            texts.append(str(argument.name or "an expression"))
        else:
            values = np.asarray(argument, dtype=np.float64)
            texts.append(f"{values}" if values.ndim == 0 else _digest(values.tobytes()))
    return ", ".join(texts)


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def _tuples(values: Any) -> Any:
    """Return nested sequences and arrays of numbers or texts as tuples."""
    if isinstance(values, np.ndarray):
        values = values.astype(np.float64).tolist()
    return tuple(map(_tuples, values)) if isinstance(values, list | tuple) else values


# In files.


def as_text(identity: Identity) -> str:
    """Return an identity as JSON."""
    return json.dumps(asdict(identity))


def from_text(text: str) -> Identity:
    """Return an identity from JSON; raise KeyError, TypeError or ValueError if it is none."""
    stored = json.loads(text)
    simulators = tuple(
        SimulatorIdentity(**{key: _tuples(value) for key, value in fields.items()})
        for fields in stored.pop("simulators")
    )
    shapes = {name: tuple(shape) for name, shape in stored.pop("shapes").items()}
    for key in ("terms", "thetas", "log_prior", "log_other"):
        stored[key] = _tuples(stored[key])
    return Identity(shapes=shapes, simulators=simulators, **stored)


def as_attributes(identity: Identity | None) -> dict[str, str]:
    """Return an identity as an attribute of a file; none where it is unknown or too long."""
    text = "" if identity is None else as_text(identity)
    return {"identity": text} if text and fits_attribute(text) else {}


def from_attributes(attributes: Mapping[Any, Any]) -> Identity | None:
    """Return the identity that a file has; None for results of other tools."""
    try:
        return from_text(attributes["identity"])
    except (AttributeError, KeyError, TypeError, ValueError):
        return None


# Comparison.


def require_same(
    got: Identity | None, expected: Identity | None, caller: str, level: Level = Level.OPTIMUM
) -> None:
    """Raise a ValueError with all that differs, up to a level; unknown identities pass."""
    if got is None or expected is None:
        return
    texts = differences(got, expected, level)
    if texts:
        raise ValueError(
            f"{caller}: got a result of another problem: {'; '.join(texts)}; {_REMEDIES[level]}"
        )


def require_same_responses(got: Identity | None, model: pm.Model, caller: str) -> None:
    """Raise a ValueError unless a model has a result's responses, also at the result's points.

    `differences` compares responses at the same points, which are drawn through the priors. With
    other priors, or another propagation, two responses of each simulator are computed.
    """
    stored = {} if got is None else {simulator.name: simulator for simulator in got.simulators}
    for node in nodes(model).values():
        saved = stored.get(node.name)
        if saved is None or not saved.points or saved.points == _points(node):
            continue
        shapes = node.inputs.event_shapes
        ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
        columns = np.split(np.array(saved.points), ends[:-1], axis=1)
        aleatory = [x.reshape(-1, *shape) for x, shape in zip(columns, shapes, strict=True)]
        values = node.responses(aleatory, []).ravel()
        if not _close(values, saved.responses[: values.size]):
            raise ValueError(
                f"{caller}: got a result of another problem: the response of {node.name} has other "
                f"values at the same points; {_REMEDIES[Level.POPULATIONS]}"
            )


def require_together(
    identities: Mapping[str, Identity | None],
    caller: str,
    *,
    model: pm.Model | None = None,
    level: Level = Level.POPULATIONS,
) -> Identity | None:
    """Return the identity of a model, or else of the first result that has one.

    Raise a ValueError if one of the results, by label, is of another problem. A model without a
    simulator is not compared.
    """
    with_identity = [i for i in identities.values() if i is not None]
    expected = with_identity[0] if with_identity else None
    if model is not None and (nodes(model) or specimen_likelihoods(model)):
        expected = identity_of_model(model)
    for label, identity in identities.items():
        require_same(identity, expected, f"{caller}: {label}", level)
    return expected


def differences(got: Identity, expected: Identity, level: Level) -> list[str]:
    """Return the differences of two problems, up to a level, as texts; numbers up to rounding."""
    if got.shapes != expected.shapes:
        texts = [_shapes_text(identity.shapes) for identity in (got, expected)]
        return [_unlike("hyperparameters", *texts)]
    names = [[simulator.name for simulator in i.simulators] for i in (got, expected)]
    if names[0] != names[1]:
        return [_unlike("simulators", *names)]
    pairs = list(zip(got.simulators, expected.simulators, strict=True))
    priors = _prior_differences(got, expected)
    result: list[str] = []
    for a, b in pairs:
        # Design points are drawn through the priors: other priors give other responses.
        comparable = not priors and a.propagation == b.propagation
        result += _population_differences(a, b, comparable=comparable)
    if level >= Level.PRIORS:
        result += priors
    if level >= Level.OPTIMUM:
        result += _minimised_differences(got.prior_minimised, expected.prior_minimised)
        for a, b in pairs:
            result += _discrepancy_differences(a, b)
    for a, b in pairs if level >= Level.POSTERIOR else ():
        if not _close([a.epsilon], [b.epsilon]):
            result.append(_unlike(f"epsilon of {a.name}", a.epsilon, b.epsilon))
    for a, b in pairs if level >= Level.RUN else ():
        if not _same_design(a, b):
            result.append(_unlike(f"number of responses of {a.name}", a.n_points, b.n_points))
    return result


def _same_design(a: SimulatorIdentity, b: SimulatorIdentity) -> bool:
    return (a.n_points, a.batches) == (b.n_points, b.batches)


def _population_differences(
    a: SimulatorIdentity, b: SimulatorIdentity, *, comparable: bool
) -> list[str]:
    data = {
        "data": "observed values",
        "weights": "weights of observed values",
        "specimens": "labels of specimens",
    }
    result = [
        f"other {text} of {a.name}"
        for field, text in data.items()
        if getattr(a, field) != getattr(b, field)
    ]
    # Names of inputs do not matter to a population.
    inputs = [re.sub(r"(^|, )[^,()~]+ ~ ", r"\1", simulator.inputs) for simulator in (a, b)]
    if inputs[0] != inputs[1]:
        result.append(_unlike(f"inputs of {a.name}", a.inputs, b.inputs))
    elif comparable and not _close(a.responses, b.responses):
        result.append(f"the response of {a.name} has other values at the same points")
    return result


def _prior_differences(got: Identity, expected: Identity) -> list[str]:
    result = [
        _unlike(f"prior of {name}", prior, expected.priors[name])
        for name, prior in got.priors.items()
        if prior != expected.priors.get(name)
    ]
    if got.terms != expected.terms:
        terms = got.terms or "none", expected.terms or "none"
        result.append(_unlike("other likelihood terms", *terms))
    if result or not got.thetas or not expected.thetas:
        return result
    if not (_close(got.thetas, expected.thetas) and _close(got.log_prior, expected.log_prior)):
        return ["the priors have other densities"]
    if not _close(got.log_other, expected.log_other):
        return ["other likelihood terms, or potentials, have other values"]
    return []


def _minimised_differences(got: bool | None, expected: bool | None) -> list[str]:
    if None in (got, expected) or got == expected:
        return []
    texts = {
        True: "an optimum of discrepancy and prior together (prior=True)",
        False: "one of the discrepancy alone",
    }
    return [f"got {texts[bool(got)]}, expected {texts[bool(expected)]}"]


def _discrepancy_differences(a: SimulatorIdentity, b: SimulatorIdentity) -> list[str]:
    result = [
        _unlike(f"{field} of {a.name}", getattr(a, field), getattr(b, field))
        for field in ("metric", "propagation")
        if getattr(a, field) != getattr(b, field)
    ]
    comparable = a.discrepancies and b.discrepancies and _same_design(a, b)
    if not result and comparable and not _close(a.discrepancies, b.discrepancies):
        result.append(f"the discrepancy of {a.name} has other values at the same hyperparameters")
    return result


def _unlike(what: str, got: object, expected: object) -> str:
    return f"{what}: got {got}, expected {expected}"


def _shapes_text(shapes: Mapping[str, tuple[int, ...]]) -> str:
    return ", ".join(f"{name} {shape}" if shape else name for name, shape in shapes.items())


def _close(got: Any, expected: Any) -> bool:
    """Return whether numbers are the same up to rounding, relative to the largest of them."""
    a, b = np.asarray(got, dtype=np.float64), np.asarray(expected, dtype=np.float64)
    size = np.abs(a[np.isfinite(a)]).max(initial=0.0)
    # As much as another machine, or another version of NumPy, may change.
    return a.shape == b.shape and bool(
        np.allclose(a, b, rtol=0.0, atol=1e-6 * size, equal_nan=True)
    )
