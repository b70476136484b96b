"""`Identity`: what a result belongs to.

One record of a problem, and one function that compares two of them.

A result carries the identity of the problem that it was made from: an optimum, a posterior, a
checkpoint on disk. Where it meets a model again, `require_same` refuses what is not the same
problem. How much has to be the same depends on the question, see `Level`.
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
from prbayes.model.random_variable import Node, nodes
from prbayes.model.specimen_variable import measurements_of, specimen_likelihoods
from prbayes.response.compile import interpreted
from prbayes.response.inputs import Inputs


class Level(IntEnum):
    """How much of two problems has to be the same.

    Each level asks for what those before it ask for.

    POPULATIONS
        Hyperparameters, data, inputs and responses, so that a population of one is a population of
        the other. Responses at the same points are compared; `require_same_responses` goes on
        where the points are others.
    PRIORS
        And priors and other likelihood terms.
    OPTIMUM
        And metrics and propagations, and whether the prior was part of it: what is minimised. A
        design that has grown since is the same problem.
    POSTERIOR
        And epsilon.
    RUN
        And the design: all that a sampler's draws depend on, but for its own settings.
    """

    POPULATIONS = 1
    PRIORS = 2
    OPTIMUM = 3
    POSTERIOR = 4
    RUN = 5


# What to do about a difference.
_REMEDIES = {
    Level.POPULATIONS: "pass the model that the result was made from, or make the result anew",
    Level.PRIORS: "pass the model that the result was made from, or make the result anew",
    Level.OPTIMUM: "call prb.minimize on this model, and use that optimum",
    Level.POSTERIOR: "sample this model anew",
    Level.RUN: "start a new run",
}


@dataclass(frozen=True)
class SimulatorIdentity:
    """What identifies one simulator.

    Attributes
    ----------
    name : str
    data, weights, specimens : str
        Digests of the observed values, their weights and the specimens' labels, in the order of the
        values.
    inputs : str
        The response's arguments, as PyMC prints them.
    metric, propagation : str
        Their representations.
    n_points, batches : int
        The number of runs of the design, and how often points of it were drawn.
    epsilon : float
        NaN while it is not set.
    responses : tuple of float
        The first responses that are known anyway.
    discrepancies : tuple of float
        At the fixed thetas; empty where that would cost responses.
    points : tuple of tuple of float
        The aleatory inputs of the first two of the responses, one after the other; empty where the
        response has others.
    """

    name: str
    data: str
    weights: str
    specimens: str
    inputs: str
    metric: str
    propagation: str
    n_points: int
    batches: int
    epsilon: float
    responses: tuple[float, ...]
    discrepancies: tuple[float, ...] = ()
    points: tuple[tuple[float, ...], ...] = ()


@dataclass(frozen=True)
class Identity:
    """What identifies a problem.

    Attributes
    ----------
    shapes : dict
        Shapes of the value variables by name, such as 'sigma_log__'.
    priors : dict
        Distributions of the free variables by name, as PyMC prints them.
    terms : tuple of str
        Other observed variables with their distributions, and names of potentials.
    simulators : tuple of SimulatorIdentity
    prior_minimised : bool or None
        Whether minus the log prior was part of the objective; None for what was not minimised.
    thetas : tuple of tuple of float
        Fixed points of the prior, elements in the order of the alphabet; empty if no numbers were
        asked for.
    log_prior, log_other : tuple of float
        Logarithms of the prior density, and of other likelihood terms, at these points.
    """

    shapes: dict[str, tuple[int, ...]]
    priors: dict[str, str]
    terms: tuple[str, ...]
    simulators: tuple[SimulatorIdentity, ...]
    prior_minimised: bool | None = None
    thetas: tuple[tuple[float, ...], ...] = ()
    log_prior: tuple[float, ...] = ()
    log_other: tuple[float, ...] = ()


def identity_of(evaluator: Evaluator, *, prior_minimised: bool | None = None) -> Identity:
    """Return the identity of an evaluator's problem, with numbers.

    No response is computed for them.
    """
    # A change that leaves the values at all of them as they are is none that matters. A power of
    # two, as Sobol points are balanced then.
    thetas = evaluator.hyperparameters.fixed_points(4)
    by_name = np.argsort(evaluator.hyperparameters.plain_names)
    simulators = []
    for k, node in enumerate(evaluator.nodes):
        free = node.bound.stored
        discrepancies = evaluator.discrepancies(thetas, k) if free else np.empty(0)
        simulators.append(_simulator(node, discrepancies))
    simulators += map(_specimen_simulator, evaluator.measurements)
    return _identity(
        evaluator.model,
        simulators,
        shapes=evaluator.hyperparameters.shapes,
        prior_minimised=prior_minimised,
        thetas=tuple(map(_numbers, thetas[:, by_name])),
        log_prior=_numbers(evaluator.hyperparameters.log_prior(thetas)),
        log_other=_numbers(evaluator.log_other(thetas)),
    )


def identity_of_model(model: pm.Model) -> Identity:
    """Return the identity of a model without what has to be compiled.

    Densities and discrepancies.
    """
    found = nodes(model).values()
    simulators = [_simulator(node, np.empty(0)) for node in found]
    simulators += map(_specimen_simulator, measurements_of(model).values())
    shapes = {}
    for rv in model.free_RVs:
        value = model.rvs_to_values[rv]
        shapes[str(value.name)] = value.type.shape
    if any(None in shape for shape in shapes.values()):
        with interpreted():
            point = model.initial_point(random_seed=0)
        shapes = {name: np.shape(point[name]) for name in shapes}
    return _identity(model, simulators, shapes=shapes)


def _identity(model: pm.Model, simulators: Sequence[SimulatorIdentity], **others: Any) -> Identity:
    known = known_variables(model)
    priors = {str(rv.name): as_pymc_writes(rv, known) for rv in model.free_RVs}
    simulated = {*nodes(model), *specimen_likelihoods(model)}
    observed = [rv for rv in model.observed_RVs if rv not in simulated]
    terms = [f"{rv.name} ~ {as_pymc_writes(rv, known)}" for rv in observed]
    terms += [str(potential.name) for potential in model.potentials]
    # Clones may order variables in other ways.
    ordered = sorted(simulators, key=lambda simulator: simulator.name)
    return Identity(priors=priors, terms=tuple(sorted(terms)), simulators=tuple(ordered), **others)


def _simulator(node: Node, discrepancies: Floats) -> SimulatorIdentity:
    observed = node.target.observed
    weights = node.target.weights
    order = np.lexsort((weights, *observed.reshape(len(observed), -1).T[::-1]))
    labels = []
    if node.specimens is not None:
        labels = node.specimens[order].tolist()
    # Stored responses are appended to, so that the first stay the first.
    return SimulatorIdentity(
        name=node.name,
        data=_digest(observed[order].tobytes()),
        weights=_digest(weights[order].tobytes()),
        specimens=_digest(repr(labels).encode()),
        inputs=_inputs(node.bound.inputs),
        metric=without_addresses(node.metric),
        propagation=without_addresses(node.propagation),
        n_points=node.bound.n_runs,
        batches=1 if node.reweighted is None else node.reweighted.design.n_drawn,
        epsilon=node.epsilon_value,
        responses=_numbers(node.bound.first_responses[:8].ravel()),
        discrepancies=_numbers(discrepancies),
        points=_points(node),
    )


def _specimen_simulator(measurement: Measurement) -> SimulatorIdentity:
    """Return the identity of a simulator with a likelihood by specimen."""
    observed = measurement.observed
    labels = [] if measurement.specimens is None else measurement.specimens.tolist()
    weights = b"" if measurement.weights is None else measurement.weights.tobytes()
    groups = b"" if measurement.groups is None else measurement.groups.tobytes()
    return SimulatorIdentity(
        name=measurement.name,
        data=_digest(observed.tobytes() + groups),
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


# Responses by which another one is known: one alone may agree by chance, as at zero.
_POINTS = 2


def _points(node: Node) -> tuple[tuple[float, ...], ...]:
    """Return the aleatory inputs of the first known responses, a row for each."""
    # A propagation of a user's own may know none.
    if node.bound.inputs.epistemic or not len(node.bound.first_points):
        return ()
    columns = [x[:_POINTS].reshape(min(_POINTS, len(x)), -1) for x in node.bound.first_points]
    return tuple(map(_numbers, np.concatenate(columns, axis=1)))


def _inputs(inputs: Inputs) -> str:
    """Return the arguments of a response, the same for all clones of a model."""
    roots = set(inputs.roots)
    texts = []
    for argument in inputs.arguments:
        if isinstance(argument, int):
            texts.append(str_for_dist(inputs.aleatory[argument], named_vars=roots))
        elif argument in inputs.epistemic:
            texts.append(str(argument.name or "an expression"))
        else:
            values = np.asarray(argument, dtype=np.float64)
            content = values.tobytes()
            texts.append(f"{values}" if values.ndim == 0 else _digest(content))
    return ", ".join(texts)


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def _numbers(values: Floats) -> tuple[float, ...]:
    return tuple(map(float, values))


# Text, for files.


def as_text(identity: Identity) -> str:
    """Return an identity as JSON."""
    return json.dumps(asdict(identity))


def from_text(text: str) -> Identity:
    """Return an identity from JSON.

    Raises
    ------
    KeyError, TypeError, ValueError
        If it is none.
    """
    found = json.loads(text)
    simulators = []
    for fields in found.pop("simulators"):
        for key in ("responses", "discrepancies"):
            fields[key] = tuple(fields[key])
        fields["points"] = tuple(tuple(point) for point in fields.get("points", ()))
        simulators.append(SimulatorIdentity(**fields))
    shapes = found.pop("shapes")
    shapes = {name: tuple(shape) for name, shape in shapes.items()}
    thetas = tuple(tuple(theta) for theta in found.pop("thetas"))
    for key in ("terms", "log_prior", "log_other"):
        found[key] = tuple(found[key])
    return Identity(shapes=shapes, simulators=tuple(simulators), thetas=thetas, **found)


def as_attributes(identity: Identity | None) -> dict[str, str]:
    """Return an identity as an attribute of a file; none where it is unknown or too long."""
    if identity is None:
        return {}
    text = as_text(identity)
    return {"identity": text} if fits_attribute(text) else {}


def from_attributes(attributes: Mapping[Any, Any]) -> Identity | None:
    """Return the identity that a file has, or None.

    That of a result of other tools is not known.
    """
    try:
        return from_text(attributes["identity"])
    except (AttributeError, KeyError, TypeError, ValueError):
        return None


# Comparison.


def require_same(
    got: Identity | None, expected: Identity | None, caller: str, level: Level = Level.OPTIMUM
) -> None:
    """Raise unless a result is one of the problem at hand, as far as is known.

    Parameters
    ----------
    got : Identity or None
        Of the result; nothing is asked of one that is not known.
    expected : Identity or None
        Of the problem.
    caller : str
        For the message.
    level : Level
        How much has to be the same.

    Raises
    ------
    ValueError
        With all that differs.
    """
    if got is None or expected is None:
        return
    found = differences(got, expected, level)
    if found:
        raise ValueError(
            f"{caller}: got a result of another problem: {'; '.join(found)}; {_REMEDIES[level]}"
        )


def require_same_responses(got: Identity | None, model: pm.Model, caller: str) -> None:
    """Raise unless the responses of a model are those of a result, also at points of its own.

    `differences` compares those that are known at the same points, which are drawn through the
    priors. With other priors, or another propagation, two responses of each simulator are computed.

    Raises
    ------
    ValueError
        If one has another value.
    """
    known = {} if got is None else {each.name: each for each in got.simulators}
    for node in nodes(model).values():
        before = known.get(node.name)
        if before is None or not before.points or before.points == _points(node):
            continue
        values = _at_points(node, np.array(before.points)).ravel()
        if not _close(values, before.responses[: values.size]):
            raise ValueError(
                f"{caller}: got a result of another problem: the response of {node.name} has other "
                f"values at the same points; {_REMEDIES[Level.POPULATIONS]}"
            )


def _at_points(node: Node, points: Floats) -> Floats:
    """Return a simulator's responses at points, rows of its aleatory inputs."""
    shapes = node.bound.inputs.event_shapes
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
    columns = np.split(points, ends[:-1], axis=1)
    aleatory = [x.reshape(-1, *shape) for x, shape in zip(columns, shapes, strict=True)]
    return node.bound.responses(aleatory, [])


def require_together(
    identities: Mapping[str, Identity | None],
    caller: str,
    *,
    model: pm.Model | None = None,
    level: Level = Level.POPULATIONS,
) -> Identity | None:
    """Return the identity of a model, or else of the first result that has one.

    Parameters
    ----------
    identities : mapping
        Of results, by their labels.
    caller : str
        For the message.
    model : pymc.Model, optional
        Nothing is asked of one without a simulator.
    level : Level

    Raises
    ------
    ValueError
        If one of the results is of another problem.
    """
    known = [identity for identity in identities.values() if identity is not None]
    expected = known[0] if known else None
    if model is not None and (nodes(model) or specimen_likelihoods(model)):
        expected = identity_of_model(model)
    for label, identity in identities.items():
        require_same(identity, expected, f"{caller}: {label}", level)
    return expected


def differences(got: Identity, expected: Identity, level: Level) -> list[str]:
    """Return in what two problems differ, as far as a level asks for it, in words.

    Numbers up to rounding.
    """
    if got.shapes != expected.shapes:
        return [_told("hyperparameters", _shown(got.shapes), _shown(expected.shapes))]
    names = [[s.name for s in one.simulators] for one in (got, expected)]
    if names[0] != names[1]:
        return [_told("simulators", *names)]
    found: list[str] = []
    pairs = list(zip(got.simulators, expected.simulators, strict=True))
    priors = _prior_differences(got, expected)
    for a, b in pairs:
        # Design points are drawn through the priors: with others, other responses are known.
        comparable = not priors and a.propagation == b.propagation
        found += _population_differences(a, b, comparable=comparable)
    if level >= Level.PRIORS:
        found += priors
    if level >= Level.OPTIMUM:
        found += _minimised_differences(got.prior_minimised, expected.prior_minimised)
        for a, b in pairs:
            found += _discrepancy_differences(a, b)
    if level >= Level.POSTERIOR:
        for a, b in pairs:
            if not _close([a.epsilon], [b.epsilon]):
                found.append(_told(f"epsilon of {a.name}", a.epsilon, b.epsilon))
    if level >= Level.RUN:
        for a, b in pairs:
            if not _same_design(a, b):
                found.append(_told(f"number of responses of {a.name}", a.n_points, b.n_points))
    return found


def _same_design(a: SimulatorIdentity, b: SimulatorIdentity) -> bool:
    return a.n_points == b.n_points and a.batches == b.batches


def _population_differences(
    a: SimulatorIdentity, b: SimulatorIdentity, *, comparable: bool
) -> list[str]:
    found = [
        f"other {what} of {a.name}"
        for what, one, other in (
            ("observed values", a.data, b.data),
            ("weights of observed values", a.weights, b.weights),
            ("labels of specimens", a.specimens, b.specimens),
        )
        if one != other
    ]
    if _without_names(a.inputs) != _without_names(b.inputs):
        found.append(_told(f"inputs of {a.name}", a.inputs, b.inputs))
    elif comparable and not _close(a.responses, b.responses):
        found.append(f"the response of {a.name} has other values at the same points")
    return found


def _without_names(inputs: str) -> str:
    """Return inputs as they are distributed: what they are called makes no other population."""
    return re.sub(r"(^|, )[^,()~]+ ~ ", r"\1", inputs)


def _prior_differences(got: Identity, expected: Identity) -> list[str]:
    found = [
        _told(f"prior of {name}", got.priors[name], expected.priors[name])
        for name in got.priors
        if got.priors[name] != expected.priors.get(name)
    ]
    if got.terms != expected.terms:
        found.append(_told("other likelihood terms", got.terms or "none", expected.terms or "none"))
    if found or not got.thetas or not expected.thetas:
        return found
    same_prior = _close(got.thetas, expected.thetas) and _close(got.log_prior, expected.log_prior)
    if not same_prior:
        found.append("the priors have other densities")
    elif not _close(got.log_other, expected.log_other):
        found.append("other likelihood terms, or potentials, have other values")
    return found


def _minimised_differences(got: bool | None, expected: bool | None) -> list[str]:
    if None in (got, expected) or got == expected:
        return []
    with_prior = "an optimum of discrepancy and prior together (prior=True)"
    without = "one of the discrepancy alone"
    told = (with_prior, without) if got else (without, with_prior)
    return [f"got {told[0]}, expected {told[1]}"]


def _discrepancy_differences(a: SimulatorIdentity, b: SimulatorIdentity) -> list[str]:
    found = []
    for what in ("metric", "propagation"):
        one = getattr(a, what)
        other = getattr(b, what)
        if one != other:
            found.append(_told(f"{what} of {a.name}", one, other))
    known = bool(a.discrepancies and b.discrepancies)
    if found or not known or not _same_design(a, b):
        return found
    if not _close(a.discrepancies, b.discrepancies):
        found.append(f"the discrepancy of {a.name} has other values at the same hyperparameters")
    return found


def _told(what: str, got: object, expected: object) -> str:
    return f"{what}: got {got}, expected {expected}"


def _shown(shapes: Mapping[str, tuple[int, ...]]) -> str:
    texts = []
    for name, shape in shapes.items():
        texts.append(f"{name} {shape}" if shape else name)
    return ", ".join(texts)


def _close(got: Any, expected: Any) -> bool:
    """Return whether numbers are the same up to rounding, relative to the largest of them."""
    a = np.asarray(got, dtype=np.float64)
    b = np.asarray(expected, dtype=np.float64)
    if a.shape != b.shape:
        return False
    finite = a[np.isfinite(a)]
    size = np.abs(finite).max(initial=0.0)
    # As much as another machine, or another version of NumPy, may make.
    return bool(np.allclose(a, b, rtol=0.0, atol=1e-6 * size, equal_nan=True))
