"""The fingerprint of a problem: what a result was computed from, and how two problems differ.

A result carries the fingerprint of its problem: an optimum, a posterior, a checkpoint on disk.
Where it meets a model again, `require_same` refuses another problem.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import IntEnum
from operator import attrgetter
from typing import Any

import numpy as np
import pymc as pm
from pymc.printing import str_for_dist

from prbayes._finding import Finding, report
from prbayes._validate import Arrays, Floats, Names, Shape, flat_rows, require_format
from prbayes.model.description import as_pymc_writes, json_attribute, without_addresses
from prbayes.model.evaluator import Evaluator
from prbayes.model.measurement import Measurement, SpecimenLikelihood, output_columns
from prbayes.model.parameters import fixed_points, value_shapes
from prbayes.model.random_variable import Node, nodes
from prbayes.model.specimen_likelihood import measurements_of, specimen_likelihoods
from prbayes.model.specimen_preparation import is_prepared, prepared
from prbayes.response.compile import interpreted
from prbayes.response.inputs import Inputs
from prbayes.response.variables import listed


class Level(IntEnum):
    """How much of two problems has to be the same; each level includes those before it."""

    # Hyperparameters, data, inputs and responses are the same, so that populations agree. Responses
    # are compared at the same points; `require_same_responses` compares them if the points differ.
    POPULATIONS = 1
    PRIORS = 2  # priors and other likelihood terms are the same as well
    # Metrics and propagations are the same as well, and whether the prior was minimised. A design
    # that has grown since then counts as the same.
    OPTIMUM = 3
    POSTERIOR = 4  # epsilons are the same as well
    # Designs are the same as well: everything that draws depend on, except the sampler's settings.
    RUN = 5


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
    n_points: int = 0  # number of runs of the design
    batches: int = 1  # number of batches in which the design's points were drawn
    epsilon: float = 1.0  # epsilon, NaN while it is not set
    responses: tuple[float, ...] = ()  # first responses, at most 16 runs
    # Discrepancies at fixed thetas; empty if they would need further responses.
    discrepancies: tuple[float, ...] = ()
    # Aleatory inputs of the first responses; empty if the response has epistemic inputs.
    points: tuple[tuple[float, ...], ...] = ()
    # Digests of data, weights and labels as a metric of distributions would have them; only for a
    # log-likelihood by specimen.
    with_metric: Names = ()
    # Digests of the response's code and of variables that it reads; empty in older results.
    code: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Identity:
    """What identifies a problem."""

    shapes: dict[str, Shape]  # shapes of value variables by name, such as 'sigma_log__'
    priors: dict[str, str]  # distributions of free variables, as PyMC prints them
    terms: Names  # other observed variables, and names of potentials
    simulators: tuple[SimulatorIdentity, ...]
    # Whether the prior was minimised; None if nothing was minimised.
    prior_minimised: bool | None = None
    # Fixed points of the prior, with elements in alphabetical order; empty if no numbers are
    # computed.
    thetas: tuple[tuple[float, ...], ...] = ()
    log_prior: tuple[float, ...] = ()  # log-density of the prior at these points
    log_other: tuple[float, ...] = ()  # log-likelihood of other terms at these points


def identity_of(problem: Evaluator | pm.Model, *, prior_minimised: bool | None = None) -> Identity:
    """Return the identity of a problem; computes no response.

    That of a model is without densities and discrepancies, which an evaluator compiles.
    """
    numbers: dict[str, Any] = {}
    if isinstance(problem, Evaluator):
        model, hyperparameters = problem.model, problem.hyperparameters
        shapes = value_shapes(hyperparameters)
        parts: list[Node | Measurement] = [*problem.nodes, *problem.measurements]
        simulators = [_simulator_identity(part, problem.likelihoods) for part in parts]
        # Four points, because Sobol points are balanced if their number is a power of two.
        thetas, order = fixed_points(hyperparameters, 4)
        for k, node in enumerate(problem.nodes):
            if node.bound.stored:
                values = _tuples(problem.discrepancies(thetas, k))
                simulators[k] = replace(simulators[k], discrepancies=values)
        numbers = {
            "thetas": _tuples(thetas[:, order]),
            "log_prior": _tuples(hyperparameters.log_prior(thetas)),
            # An audit changes the emulator of a likelihood, and not the problem.
            "log_other": _tuples(
                problem.log_other(thetas, [x.cache.get("first", x) for x in problem.likelihoods])
            ),
        }
    else:
        model = problem
        likelihoods = specimen_likelihoods(model).values()
        parts = [*nodes(model).values(), *measurements_of(model).values()]
        simulators = [_simulator_identity(part, likelihoods) for part in parts]
        values = [model.rvs_to_values[rv] for rv in model.free_RVs]
        shapes = {str(value.name): value.type.shape for value in values}
        if any(None in shape for shape in shapes.values()):
            with interpreted():
                point = model.initial_point(random_seed=0)
            shapes = {name: np.shape(point[name]) for name in shapes}
    named = {*model.basic_RVs, *model.deterministics}
    simulated = {*nodes(model), *specimen_likelihoods(model)}
    observed = [rv for rv in model.observed_RVs if rv not in simulated]
    terms = [f"{rv.name} ~ {as_pymc_writes(rv, named)}" for rv in observed]
    terms += [str(potential.name) for potential in model.potentials]
    return Identity(
        shapes=shapes,
        priors={str(rv.name): as_pymc_writes(rv, named) for rv in model.free_RVs},
        terms=tuple(sorted(terms)),
        # Simulators are sorted, because clones may order variables differently.
        simulators=tuple(sorted(simulators, key=attrgetter("name"))),
        prior_minimised=prior_minimised,
        **numbers,
    )


def _simulator_identity(
    simulator: Node | Measurement, likelihoods: Iterable[SpecimenLikelihood]
) -> SimulatorIdentity:
    observed, weights, labels = simulator.observed, simulator.weights, simulator.specimens
    of_specimens: tuple[Any, ...] = ()
    fields: dict[str, Any] = {}
    if isinstance(simulator, Node):
        bound = simulator.bound
        batches = 1
        if simulator.reweighted is not None:
            design = simulator.reweighted.design
            batches = len(design.batch_sizes) + design.n_emulated_samples
        observed, weights, labels = _in_fixed_order(observed, simulator.weights, labels)
        fields = {
            "n_points": bound.n_runs,
            "batches": batches,
            "epsilon": simulator.epsilon_value,
        }
    else:
        of_specimens = simulator.groups, *simulator.covariates.values(), simulator.conditions
        if all(values is None for values in of_specimens):
            n = len(observed)
            equal = np.full(n, 1 / n) if weights is None else weights / weights.sum()
            fields = {"with_metric": _digests(*_in_fixed_order(observed, equal, labels))}
    _, of_weights, of_labels = _digests(observed, weights, labels)
    points, responses = _first_runs(simulator, likelihoods)
    # Variables that calls change have no digest. A file has room for a hundred.
    digests = list(simulator.responses.watched.digests().items())[:100]
    return SimulatorIdentity(
        name=simulator.name,
        data=_digest(observed, *of_specimens),
        weights=of_weights,
        specimens=of_labels,
        inputs=_inputs(simulator.inputs),
        metric=without_addresses(simulator.metric),
        propagation=without_addresses(simulator.propagation),
        points=points,
        responses=responses,
        # Other versions of Python compile the same code differently.
        code={
            "version of Python": sys.version.partition(" ")[0],
            **{k: v for k, v in digests if v},
        },
        **fields,
    )


def _in_fixed_order(observed: Floats, weights: Floats, labels: Any) -> tuple[Floats, Floats, Any]:
    """Return data in sorted order, because a metric does not depend on the order of specimens."""
    order = np.lexsort((weights, *flat_rows(observed).T[::-1]))
    return observed[order], weights[order], None if labels is None else labels[order]


def _digests(observed: Floats, weights: Floats | None, labels: Any) -> tuple[str, str, str]:
    """Return digests of observed values, weights and labels of specimens."""
    of_labels = _digest(repr([] if labels is None else labels.tolist()))
    return _digest(observed), _digest(weights), of_labels


def _first_runs(
    simulator: Node | Measurement, likelihoods: Iterable[SpecimenLikelihood]
) -> tuple[Any, Any]:
    """Return aleatory inputs of the first runs, a row for each, and their responses as numbers.

    Designs grow at their ends, so that the first runs do not change. A likelihood by specimen has
    none before its first use, and a user's own propagation may store no points.
    """
    points: Arrays = ()
    values = np.empty(0)
    if isinstance(simulator, Node):
        values = simulator.bound.first_responses
        points = () if simulator.inputs.epistemic else simulator.bound.first_points
    for likelihood in likelihoods:
        for measurement in likelihood.measurements:
            if measurement.name == simulator.name and is_prepared(likelihood):
                emulation = prepared(likelihood).emulation
                points = likelihood.coordinates.inputs_of_runs(emulation.z)
                values = emulation.y[:, output_columns(likelihood, measurement)]
    n_rows = len(values)
    if not n_rows:
        return (), ()
    columns = [x[:n_rows].reshape(n_rows, -1) for x in points]
    inputs = np.concatenate(columns, axis=1) if columns else np.empty((0, 0))
    outputs = values.reshape(n_rows, -1)
    # A file has room for some hundred numbers.
    most = int(np.clip(400 // max(1, inputs.shape[1], outputs.shape[1]), 2, 16))
    return _tuples(inputs[:most]), _tuples(outputs[:most].ravel())


def _inputs(inputs: Inputs) -> str:
    """Return the arguments of a response as text, the same for all clones of a model."""
    texts = []
    for argument in inputs.arguments:
        if isinstance(argument, int):
            texts.append(str_for_dist(inputs.aleatory[argument], named_vars=set(inputs.parents)))
        elif argument in inputs.epistemic:
            texts.append(str(argument.name or "an expression"))
        else:
            values = np.asarray(argument, dtype=np.float64)
            texts.append(f"{values}" if values.ndim == 0 else _digest(values))
    return ", ".join(texts)


def _digest(*contents: Any) -> str:
    """Return a digest of arrays and texts, without those that are None."""
    data = [x.encode() if isinstance(x, str) else x.tobytes() for x in contents if x is not None]
    return hashlib.sha256(b"".join(data)).hexdigest()[:16]


def _tuples(values: Any) -> Any:
    """Return nested sequences and arrays of numbers or texts as nested tuples."""
    if isinstance(values, np.ndarray):
        values = values.astype(np.float64).tolist()
    return tuple(map(_tuples, values)) if isinstance(values, list | tuple) else values


# Storage of an identity as text.


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
    return {} if identity is None else json_attribute("identity", asdict(identity))


def identity_from_attributes(attributes: Mapping[Any, Any]) -> Identity | None:
    """Return the identity that a file has; None for results of other tools.

    Results of release candidates, and of later formats, raise a ValueError.
    """
    if "prbayes_version" in attributes:
        require_format(attributes.get("prbayes_format"))
    try:
        return from_text(attributes["identity"])
    except (AttributeError, KeyError, TypeError, ValueError):
        return None


# Comparison of two problems.


def require_same(
    got: Identity | None, expected: Identity | None, caller: str, level: Level = Level.OPTIMUM
) -> None:
    """Raise a ValueError with all that differs, up to a level; unknown identities pass."""
    if got is None or expected is None:
        return
    texts = problem_differences(got, expected, level)
    if texts:
        raise ValueError(
            f"{caller}: got a result of another problem: {'; '.join(texts)}; {_REMEDIES[level]}"
        )


def require_same_responses(
    got: Identity | None, expected: Identity, model: pm.Model, caller: str
) -> None:
    """Raise a ValueError unless a model has a result's responses, also at the result's points.

    `problem_differences` compares responses at the same points, which are drawn through the priors.
    At other points two responses of each simulator are computed, and all that the result has if the
    code is another one and these take less than a second. None is computed of the same code of a
    likelihood whose model is used for the first time.
    """
    stored = {} if got is None else {simulator.name: simulator for simulator in got.simulators}
    parts: list[Node | Measurement] = [*nodes(model).values(), *measurements_of(model).values()]
    simulators = {simulator.name: simulator for simulator in parts}
    for new in expected.simulators:
        if new.name not in stored:
            continue
        saved, simulator = stored[new.name], simulators[new.name]
        names = [k for k, v in new.code.items() if saved.code.get(k, v) != v]
        has_same_code = bool(saved.code) and not names
        values: Any = new.responses
        if saved.points and not (new.points and _agree(saved.points, new.points, first=True)):
            if has_same_code and not new.points:
                continue
            shapes = simulator.inputs.event_shapes
            ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
            columns = np.split(np.array(saved.points), ends[:-1], axis=1)
            aleatory = [x.reshape(-1, *s) for x, s in zip(columns, shapes, strict=True)]
            start = time.perf_counter()
            values = simulator.responses([x[:2] for x in aleatory], []).ravel()
            if not has_same_code and time.perf_counter() - start < 1:
                values = simulator.responses(aleatory, []).ravel()
        if saved.points and not _agree(values, saved.responses, first=True):
            raise ValueError(
                f"{caller}: got a result of another problem: the response of {new.name} has other "
                f"values at the same points; {_REMEDIES[Level.POPULATIONS]}"
            )
        # Private attributes of objects are often memories of earlier calls.
        public = [name for name in names if "._" not in name]
        if public and "version of Python" not in names:
            text = (
                f"{caller}: {new.name}: {listed(public)} has changed since the result was made. "
                "The first runs have the same values, others may differ; pass the model that the "
                "result was made from."
            )
            report(Finding("other-code", text, "expensive.md#nothing-is-computed-twice"))


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
    has_simulator = model is not None and (nodes(model) or specimen_likelihoods(model))
    if model is not None and has_simulator:
        expected = identity_of(model)
    for label, identity in identities.items():
        require_same(identity, expected, f"{caller}: {label}", level)
        if model is not None and expected is not None and has_simulator:
            require_same_responses(identity, expected, model, f"{caller}: {label}")
    return expected


def problem_differences(got: Identity, expected: Identity, level: Level) -> list[str]:
    """Return the differences of two problems, up to a level, as texts; numbers up to rounding."""
    if got.shapes != expected.shapes:
        texts = []
        for shapes, others in ((got.shapes, expected.shapes), (expected.shapes, got.shapes)):
            names = [
                f"{name} {shape}" if shape else name
                for name, shape in shapes.items()
                if others.get(name) != shape
            ]
            texts.append(", ".join(names) or "none")
        return [_unlike("hyperparameters", *texts)]
    names_of = [[simulator.name for simulator in i.simulators] for i in (got, expected)]
    if names_of[0] != names_of[1]:
        return [_unlike("simulators", *names_of)]
    priors = [
        _unlike(f"prior of {name}", prior, expected.priors[name])
        for name, prior in got.priors.items()
        if prior != expected.priors.get(name)
    ]
    if got.terms != expected.terms:
        terms = got.terms or "none", expected.terms or "none"
        priors.append(_unlike("other likelihood terms", *terms))
    if not priors and got.thetas and expected.thetas:
        has_same_points = _agree(got.thetas, expected.thetas)
        if not (has_same_points and _agree(got.log_prior, expected.log_prior)):
            priors = ["the priors have other densities"]
        elif not _agree(got.log_other, expected.log_other):
            priors = ["other likelihood terms, or potentials, have other values"]
    minimised = []
    if got.prior_minimised is not None and expected.prior_minimised is not None:
        goals = (
            "one of the discrepancy alone",
            "an optimum of discrepancy and prior together (prior=True)",
        )
        if got.prior_minimised != expected.prior_minimised:
            was, should_be = goals[got.prior_minimised], goals[expected.prior_minimised]
            minimised.append(f"got {was}, expected {should_be}")
    pairs = list(zip(got.simulators, expected.simulators, strict=True))
    by_level = [_simulator_differences(a, b, same_priors=not priors) for a, b in pairs]
    result = [text for texts in by_level for text in texts[Level.POPULATIONS]]
    if level >= Level.PRIORS:
        result += priors
    if level >= Level.OPTIMUM:
        result += minimised
    for each in (Level.OPTIMUM, Level.POSTERIOR, Level.RUN):
        if level >= each:
            result += [text for texts in by_level for text in texts[each]]
    return result


def _simulator_differences(
    a: SimulatorIdentity, b: SimulatorIdentity, *, same_priors: bool
) -> dict[Level, list[str]]:
    """Return the differences of two simulators by level."""
    data = "observed values", "weights of observed values", "labels of specimens"
    # Whether one simulator has a metric of distributions and the other a log-likelihood by
    # specimen.
    mixed = bool(a.with_metric) != bool(b.with_metric)
    digests = [
        x.with_metric if mixed and x.with_metric else (x.data, x.weights, x.specimens)
        for x in (a, b)
    ]
    populations = [
        f"other {text} of {a.name}"
        for text, *pair in zip(data, *digests, strict=True)
        if pair[0] != pair[1]
    ]
    # Names of inputs are removed, because a population does not depend on them.
    inputs = [re.sub(r"(^|, )[^,()~]+ ~ ", r"\1", simulator.inputs) for simulator in (a, b)]
    # The points of a design depend on the priors, so that other priors give other responses.
    has_same_points = same_priors and a.propagation == b.propagation and not mixed
    if inputs[0] != inputs[1]:
        populations.append(_unlike(f"inputs of {a.name}", a.inputs, b.inputs))
    elif has_same_points and not _agree(*_at_same_points(a, b), first=True):
        populations.append(f"the response of {a.name} has other values at the same points")
    optimum = [
        _unlike(f"{field} of {a.name}", getattr(a, field), getattr(b, field))
        for field in ("metric", "propagation")
        if getattr(a, field) != getattr(b, field)
    ]
    has_same_design = (a.n_points, a.batches) == (b.n_points, b.batches)
    is_comparable = a.discrepancies and b.discrepancies and has_same_design
    if not optimum and is_comparable and not _agree(a.discrepancies, b.discrepancies):
        optimum.append(f"the discrepancy of {a.name} has other values at the same hyperparameters")
    posterior, run = [], []
    if not _agree([a.epsilon], [b.epsilon]):
        posterior.append(_unlike(f"epsilon of {a.name}", a.epsilon, b.epsilon))
    if not has_same_design:
        run.append(_unlike(f"number of responses of {a.name}", a.n_points, b.n_points))
    return {
        Level.POPULATIONS: populations,
        Level.OPTIMUM: optimum,
        Level.POSTERIOR: posterior,
        Level.RUN: run,
    }


def _unlike(what: str, got: object, expected: object) -> str:
    return f"{what}: got {got}, expected {expected}"


def _at_same_points(a: SimulatorIdentity, b: SimulatorIdentity) -> tuple[Any, Any]:
    """Return the responses of the first runs, without those from the first other point on.

    Runs near the specimens follow the first ones, and depend on the order in which data came.
    """
    if not (a.points and b.points):
        return a.responses, b.responses
    n = min(len(a.points), len(b.points))
    is_same = [_agree(a.points[k], b.points[k]) for k in range(n)]
    n_same = is_same.index(False) if False in is_same else n
    size = len(a.responses) // len(a.points)
    return a.responses[: n_same * size], b.responses[: n_same * size]


def _agree(got: Any, expected: Any, *, first: bool = False) -> bool:
    """Return whether numbers are the same up to rounding, relative to the largest of them.

    With ``first`` those at the start of two sequences are compared, as many as both have.
    """
    if first:
        got, expected = got[: len(expected)], expected[: len(got)]
    a, b = np.asarray(got, dtype=np.float64), np.asarray(expected, dtype=np.float64)
    size = np.abs(a[np.isfinite(a)]).max(initial=0.0)
    # The tolerance allows for another machine, or another version of NumPy.
    return a.shape == b.shape and bool(
        np.allclose(a, b, rtol=0.0, atol=1e-6 * size, equal_nan=True)
    )
