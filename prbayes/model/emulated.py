"""Emulated populations of simulators with the log-likelihood by specimen.

Such a simulator stores no weighted responses. Its populations are new specimens with emulated
responses. `EmulatedSimulator` has the attributes of `Node` that predictions, decisions, plots and
reports use.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pytensor.graph.basic import Variable
from scipy.special import logsumexp, ndtr

from prbayes._validate import (
    AT_ONCE,
    ArrayFunction,
    Arrays,
    Bools,
    Floats,
    Indices,
    Shape,
    complete_rows,
)
from prbayes.emulators.emulator import fit_emulator, with_failures
from prbayes.metrics.base import Discrepancy, Metric
from prbayes.model.conditions import at_conditions
from prbayes.model.measurement import (
    Measurement,
    SpecimenLikelihood,
    output_columns,
)
from prbayes.model.random_variable import Node, nodes
from prbayes.model.specimen_likelihood import measurements_of, specimen_likelihoods
from prbayes.model.specimen_preparation import prepared
from prbayes.numerics.mixtures import effective_sample_size, normalised_weights
from prbayes.propagation.base import MAX_LOST, DesignError, responding_weights
from prbayes.propagation.importance import MixtureSampler, new_specimens
from prbayes.propagation.population_density import PopulationDensity
from prbayes.response.condition import is_condition
from prbayes.response.distributions import normal_scores
from prbayes.response.inputs import Inputs, aleatory_names, event_shape
from prbayes.response.outputs import Outputs
from prbayes.response.response import Responses
from prbayes.specimens.coordinates import Coordinates


@dataclass(frozen=True)
class EmulatedPopulationSizes:
    """Sizes of emulated samples."""

    # Number of specimens of a population in plots and scores. The error of a quantile is then far
    # below the width of a posterior band.
    specimens: int = 1024
    # Number of populations, and number of specimens, in the weighted sample of a decision. Twice as
    # many change probabilities by less than their reported error.
    populations: int = 64
    points: int = 8192
    blocks: int = 8  # number of batches of the sample, whose scatter gives the Monte Carlo error
    # Runs of another response in a round at specimens, the largest number of rounds, and the
    # error relative to the spread that ends them.
    checked: int = 16
    rounds: int = 4
    tolerance: float = 0.02


_SIZES = EmulatedPopulationSizes()


@dataclass(frozen=True, eq=False)
class EmulatedResponse:
    """A response between its runs, as a function of the inputs."""

    coordinates: Coordinates
    z: Floats  # (n, d): coordinates of the runs
    y: Floats  # (n, m): outputs of the runs; +inf is a failed specimen, NaN no response
    outputs: ArrayFunction  # all outputs at coordinates (k, d) between the finite runs
    columns: slice  # columns of the surface that belong to the response
    event: Shape  # shape of a specimen's outputs, () or (m,)
    error: Floats  # (m,): root mean square cross-validation error near the specimens
    # Whether responses beyond the runs' range are those at its end, or NaN.
    is_continued: bool = True

    def __call__(self, inputs: Arrays) -> Floats:
        """Return responses of specimens, (n, *event) by input -> (n, *event); computes no run.

        Beyond the runs' range an input has the response at the end of the range, or NaN. Where
        the nearest run has no finite response, the response is that of the run.
        """
        z = self.coordinates.of(inputs, 1)
        ends = self._in_range(z)
        values = self._at(ends)
        if not self.is_continued:
            values[(np.abs(z - ends) > 1e-9).any(axis=1)] = np.nan
        return values.reshape(len(z), *self.event)

    def steepened(self, inputs: Arrays) -> Floats:
        """Return responses that have twice the end slope of the runs' range beyond it.

        Their difference from the constant response there estimates its error.
        """
        values = self(inputs)
        z = self.coordinates.of(inputs, 1)
        ends = self._in_range(z)
        beyond = z - ends
        # Slopes are differences to points further inside, by up to 2 % of the range.
        share = 0.02 / np.maximum((np.abs(beyond) / self._width).max(axis=1), 1e-12)
        inner = self._in_range(ends - share[:, None] * beyond)
        # Infinite outputs, of failed specimens, have no difference.
        with np.errstate(invalid="ignore"):
            difference = (self._at(ends) - self._at(inner)).reshape(values.shape)
        change = 2 * difference / share.reshape(-1, *(1,) * len(self.event))
        return np.where(np.isfinite(values + change), values + change, values)

    def share_beyond(self, inputs: Arrays, values: Floats) -> float:
        """Return the share of specimens, with responses (n, *event), beyond the runs' range.

        It counts those that twice the end slope would move by a tenth of the standard deviation.
        """
        z = self.coordinates.of(inputs, 1)
        rows = np.flatnonzero((np.abs(z - self._in_range(z)) > 1e-9).any(axis=1))
        if not self.is_continued or not rows.size:
            return 0.0
        columns = values.reshape(len(z), -1)
        finite = columns[complete_rows(columns)]
        steeper = self.steepened([x[rows] for x in inputs]).reshape(len(rows), -1)
        with np.errstate(invalid="ignore"):  # Infinite outputs, of failed specimens, stay.
            change = np.abs(steeper - columns[rows])
        is_moved = change > 0.1 * finite.std(axis=0)
        return float(is_moved.any(axis=1).sum() / len(z))

    @cached_property
    def _width(self) -> Floats:
        """The runs' range in each coordinate, (d,)."""
        return np.maximum(np.ptp(self.z, axis=0), 1e-300)

    def _in_range(self, z: Floats) -> Floats:
        """Return the nearest coordinates within the runs' range."""
        return np.clip(z, self.z.min(axis=0), self.z.max(axis=0))

    def _at(self, z: Floats) -> Floats:
        """Return the outputs at coordinates within the runs' range, (n, m)."""
        values = self.outputs(z)[:, self.columns]
        return with_failures(values, z / self._width, self.z / self._width, self.y)


def values_of_inputs(
    values: Arrays,
    inputs: Inputs,
    subset: Inputs,
    replaced: Mapping[Variable, Variable] = MappingProxyType({}),
) -> list[Floats]:
    """Return the values of a subset of the inputs, from those of all inputs of a response.

    Some of the subset may be replaced by others among the inputs.
    """
    places = [inputs.aleatory.index(replaced.get(x, x)) for x in subset.aleatory]
    return [values[place] for place in places]


@dataclass(frozen=True, eq=False)
class EmulatedSimulator:
    """The specimens of a simulator, or of one of its groups, whose responses are emulated."""

    likelihood: SpecimenLikelihood
    measurement: Measurement
    place: int | None = None  # index of the group; None without groups
    name: str = field(init=False)  # name such as 'y', or 'y[Adler]' of a group
    group: str = field(init=False)  # name of the group, empty without groups
    rows: Indices = field(init=False)  # (N,): indices among the rows of the measurement
    observed: Floats = field(init=False)  # measured responses, (N,) or (N, m)
    weights: Floats = field(init=False)  # (N,): weights of the specimens, of sum one
    specimens: NDArray[Any] | None = field(init=False)  # (N,): labels of the specimens
    n_specimens: float = field(init=False)  # effective number of specimens
    metric: Metric = field(init=False)
    inputs: Inputs = field(init=False)
    responses: Responses = field(init=False)
    outputs: Outputs = field(init=False)
    # Whether responses of a population's specimens are available without further runs.
    has_specimens: bool = field(init=False)

    # A `Node` has its design in this attribute; emulated responses need no design.
    reweighted: ClassVar[None] = None
    max_lost: float = field(init=False)  # largest accepted share of a population without response

    def __post_init__(self) -> None:
        """Copy the attributes of the measurement, or of one of its groups."""
        m, groups = self.measurement, self.measurement.inputs.groups
        name, group, rows = m.name, "", np.arange(len(m.observed))
        if groups is not None and self.place is not None:
            name, group = groups.name(m.name, self.place), groups.names[self.place]
            rows = np.flatnonzero(m.groups == self.place)
        weights = np.ones(len(rows)) if m.weights is None else m.weights[rows]
        weights = weights / weights.sum()
        vars(self).update(
            name=name,
            group=group,
            rows=rows,
            observed=m.observed[rows],
            weights=weights,
            specimens=None if m.specimens is None else m.specimens[rows],
            n_specimens=float(effective_sample_size(weights)),
            metric=m.metric,
            inputs=m.inputs,
            responses=m.responses,
            outputs=m.outputs,
            max_lost=getattr(m.propagation, "max_lost", MAX_LOST),
            has_specimens=self.likelihood.has_table or not self.likelihood.calls_response,
        )

    @cached_property
    def emulated(self) -> EmulatedResponse:
        """The emulator of the simulator's outputs; the first access computes the runs."""
        emulation = prepared(self.likelihood).emulation
        columns = output_columns(self.likelihood, self.measurement)
        return EmulatedResponse(
            self.likelihood.coordinates,
            emulation.z,
            emulation.y[:, columns],
            emulation.extended,
            columns,
            self.measurement.event,
            emulation.error[columns],
            is_continued=not self.likelihood.has_table,
        )

    def populations(self, parents: Sequence[Floats]) -> tuple[Floats, Floats]:
        """Return emulated responses and weights of populations, (k, n) or (k, n, m) and (k, n).

        The quasi-random numbers are the same for all calls.
        """
        size, n = len(parents[0]), _SIZES.specimens
        specimens = draw_specimens(self, self.inputs, parents, n)
        cache = self.likelihood.cache
        # Several pictures of a result show the same populations. The last one is kept.
        emulation = prepared(self.likelihood).emulation
        last, name, previous, values = cache.get("populations", (None, "", [], None))
        is_same = last is emulation and name == self.name
        if is_same and all(map(np.array_equal, previous, specimens)):
            values = values.copy()
        else:
            values = self.emulated(specimens)
            if size > 1 and values.size <= AT_ONCE:
                cache["populations"] = emulation, self.name, specimens, values.copy()
        return values.reshape(size, n, *self.measurement.event), np.full((size, n), 1 / n)

    def discrepancies(self, parents: Sequence[Floats], target: Discrepancy) -> Floats:
        """Return the discrepancies of populations from a prepared metric, (k,)."""
        values, weights = self.populations(parents)
        weights = responding_weights(values, weights)
        return np.array([target.of(values[[i]], weights[[i]])[0] for i in range(len(values))])


def draw_specimens(
    simulator: EmulatedSimulator, inputs: Inputs, parents: Arrays, n: int
) -> list[Floats]:
    """Return n specimens of each of k populations, (k n, *event) by input."""
    rng = np.random.default_rng(0)
    specimens, _ = new_specimens(simulator.name, inputs, list(parents), n, rng)
    specimens = _at_conditions(simulator, inputs, specimens)
    return [x.reshape(-1, *x.shape[2:]) for x in specimens]


def _at_conditions(simulator: EmulatedSimulator, inputs: Inputs, specimens: Arrays) -> list[Floats]:
    """Return inputs of specimens with the conditions of those of the simulator in turn."""
    conditions = simulator.measurement.conditions
    rows = None if conditions is None else conditions[simulator.rows]
    return at_conditions(inputs, specimens, rows)


def emulator_of(
    simulator: EmulatedSimulator, responses: Responses, specimens: Arrays
) -> EmulatedResponse:
    """Return a response of a simulator's inputs as a function of them.

    The simulator's own response costs no run. Another one is computed at the points of the
    emulator's runs, and at some of the specimens, (n, *event) by input, until it is accurate there.
    Raises a DesignError if fewer than eight of the runs have a finite response.
    """
    likelihood = simulator.likelihood
    preparation = prepared(likelihood)
    run_z = preparation.emulation.z
    runs = likelihood.coordinates.inputs_of_runs(run_z)
    points = values_of_inputs(runs, likelihood.inputs, responses.inputs)
    if responses.same_as(simulator.responses):
        emulated = simulator.emulated
        values = emulated.y.reshape(len(run_z), *emulated.event)
        responses.refuse_change(points, values, simulator.responses)
        return emulated
    values = responses(points, [])
    coordinates = Coordinates.of_prior(responses.inputs)
    z = coordinates.of(points, 1)
    y = values.reshape(len(z), -1)
    is_finite = complete_rows(y)
    if is_finite.sum() < 8:
        raise DesignError(
            f"{responses.name}: got {int(is_finite.sum())} finite responses at {len(z)} points of "
            f"the runs of {likelihood.name}, expected at least 8; pass stored=False to "
            "prb.predict, which computes responses at new specimens"
        )
    # Cross-validation errors count at runs within the range of the specimens' likely inputs, or at
    # all runs if this range contains few runs.
    roots = preparation.points.z[np.isfinite(preparation.points.log_a)]
    of_roots = likelihood.coordinates.inputs_of_runs(roots)
    likely = coordinates.of(values_of_inputs(of_roots, likelihood.inputs, responses.inputs), 1)
    low, high = np.quantile(likely, [0.01, 0.99], axis=0)
    is_near = ((z >= low) & (z <= high)).all(axis=1)
    if is_near.sum() < 16:
        is_near = np.ones(len(z), dtype=bool)
    event = values.shape[1:]
    emulated = _emulator_through(coordinates, z, y, is_near, event)
    step = max(1, len(specimens[0]) // _SIZES.points)
    specimens = [x[::step] for x in specimens]
    for round_ in range(_SIZES.rounds):
        predicted = emulated(specimens).reshape(len(specimens[0]), -1)
        rows = _stratified(predicted, round_)
        points = [x[rows] for x in specimens]
        at_points = responses(points, []).reshape(len(rows), -1)
        y = np.concatenate([y, at_points])
        new_z = coordinates.of(points, 1)
        of_new = ((new_z >= low) & (new_z <= high)).all(axis=1)
        is_near = np.append(is_near, of_new)
        z = np.concatenate([z, new_z])
        emulated = _emulator_through(coordinates, z, y, is_near, event)
        with np.errstate(invalid="ignore"):  # because a failed specimen is infinite
            low_value, high_value = np.nanquantile(predicted, ndtr([-1.0, 1.0]), axis=0)
            spread = (high_value - low_value) / 2
            misfit = at_points - predicted[rows]
            misfit = np.nan_to_num(misfit, posinf=0.0, neginf=0.0)
            largest = np.abs(misfit).max(axis=0)
            if (largest <= _SIZES.tolerance * spread).all():
                break
    return emulated


def _stratified(values: Floats, round_: int) -> Indices:
    """Return indices of specimens at normal scores of -3.3 to 3.3 of their responses, (n, m)."""
    n = _SIZES.checked
    scores = np.linspace(-3.3, 3.3, n * _SIZES.rounds)[round_ :: _SIZES.rounds]
    ranks = (ndtr(scores) * (len(values) - 1)).round().astype(int)
    columns = np.arange(n) * 7 % values.shape[1]
    return np.unique(np.argsort(values, axis=0)[ranks, columns])


def _emulator_through(
    coordinates: Coordinates, z: Floats, y: Floats, is_near: Bools, event: Shape
) -> EmulatedResponse:
    """Return the emulator of the finite ones of the runs y at z; errors are those of near runs."""
    is_finite = complete_rows(y)
    _, distinct = np.unique(z[is_finite], axis=0, return_index=True)
    rows = np.flatnonzero(is_finite)[distinct]
    near = is_near[rows]
    if not near.any():
        near = np.ones(len(rows), dtype=bool)
    surface = fit_emulator(z[rows], y[rows], near)
    squares = surface.left_out[near] ** 2
    error = np.sqrt(squares.mean(axis=0))
    return EmulatedResponse(coordinates, z, y, surface.values, slice(None), event, error)


def replaced_inputs(
    simulators: Sequence[EmulatedSimulator], responses: Responses
) -> tuple[EmulatedSimulator | None, dict[Variable, Variable]]:
    """Return a simulator whose inputs a response has from another population, and which are which.

    The response of the simulator has its inputs in the same places. Another response has inputs of
    the same names. Returns None and an empty mapping without such a simulator.
    """
    for simulator in simulators:
        replaced = _replaced(simulator, responses)
        pair = list(replaced), list(replaced.values())
        shapes = [[event_shape(x) for x in inputs] for inputs in pair]
        conditions = [[x for x in inputs if is_condition(x)] for inputs in pair]
        is_same_kind = shapes[0] == shapes[1] and conditions[0] == conditions[1]
        is_complete = set(pair[1]) == set(responses.inputs.aleatory)
        if is_same_kind and is_complete and simulator.has_specimens:
            return simulator, replaced
    return None, {}


def _replaced(simulator: EmulatedSimulator, responses: Responses) -> dict[Variable, Variable]:
    """Return the inputs of a response by the simulator's inputs in whose place they are."""
    model_inputs, inputs = simulator.inputs, responses.inputs
    if responses.function is not simulator.responses.function:
        names = aleatory_names(model_inputs, simulator.responses.function)
        by_name = dict(zip(names, model_inputs.aleatory, strict=True))
        names = aleatory_names(inputs, responses.function)
        pairs = zip(names, inputs.aleatory, strict=True)
        return {by_name[name]: x for name, x in pairs if name in by_name}
    replaced = {}
    for x, y in zip(model_inputs.sources, inputs.sources, strict=True):
        if isinstance(x, Variable) and isinstance(y, Variable):
            replaced[x] = y
        elif isinstance(x, Variable) or isinstance(y, Variable) or not np.array_equal(x, y):
            return {}
    return replaced


type PopulationSimulator = Node | EmulatedSimulator


def emulated_simulators(model: pm.Model) -> list[EmulatedSimulator]:
    """Return the simulators with a likelihood by specimen, by group where they have groups."""
    result = []
    likelihoods = specimen_likelihoods(model)
    for rv, measurement in measurements_of(model).items():
        places = [None]
        if measurement.groups is not None:
            places = np.unique(measurement.groups).tolist()
        result += [EmulatedSimulator(likelihoods[rv], measurement, place) for place in places]
    return result


def population_simulators(model: pm.Model) -> list[PopulationSimulator]:
    """Return all simulators of a model: those with a metric of distributions first."""
    return [*nodes(model).values(), *emulated_simulators(model)]


@dataclass(frozen=True, eq=False)
class EmulatedSample:
    """Weighted specimens whose responses are emulated, for populations of one result.

    Specimens are drawn from a mixture of populations. A population of the mixture's range is the
    specimens with importance weights.
    """

    simulator: EmulatedSimulator
    points: list[Floats]  # values of each input, (n, *event)
    log_mixture: Floats  # (n,): log-density of the specimens in the mixture
    # (n,): batch of each specimen; each of the eight batches represents the mixture itself.
    blocks: Indices
    inputs: Inputs  # inputs of the simulator, or of another population
    n_points: int  # number of specimens
    # inputs of the simulator that are those of another population here
    replaced: Mapping[Variable, Variable]
    density: PopulationDensity
    # Whether the points are spread evenly over the tails, by inverse distribution functions.
    has_tails: bool
    _emulators: dict[Responses, EmulatedResponse] = field(default_factory=dict)

    max_lost: ClassVar[float] = MAX_LOST  # largest accepted share of a population without response
    # Whether the points are runs, as those of a design are. Otherwise responses beyond the runs are
    # those at the end of their range.
    has_runs: ClassVar[Literal[False]] = False
    on_line: ClassVar[bool] = False  # whether the points form a quadrature rule

    @classmethod
    def of(
        cls,
        simulator: EmulatedSimulator,
        parents: Sequence[Floats],
        inputs: Inputs,
        replaced: Mapping[Variable, Variable],
    ) -> EmulatedSample:
        """Draw specimens of inputs from populations at parents, shapes (k, *shape)."""
        places = np.linspace(0, len(parents[0]) - 1, _SIZES.populations)
        rows = np.unique(places.round().astype(int))
        parents = [parent[rows] for parent in parents]
        n, density = _SIZES.points, PopulationDensity(inputs)
        sampler = MixtureSampler(simulator.name, inputs, density)
        scores = normal_scores(inputs)
        # Wide populations have many points in the tails. The effective number of points is at least
        # n / e^2.
        size = inputs.dimensions - len(inputs.conditions)
        spread = 1.0 if scores is None else 1 + size**-0.5
        try:
            points, _ = sampler.draw(parents, n, 0, spread=spread)
        except TypeError:  # without an inverse distribution function
            spread = 1.0
            points, _ = sampler.draw(parents, n, 0)
        log_q = density.at(parents, points)(slice(None))
        if spread > 1:
            squares = _squared_scores(inputs, scores(*parents, *points))
            log_q += squares * (1 - spread**-2) / 2 - size * np.log(spread)
        order = np.random.default_rng(0).permutation(n)  # because conditions repeat periodically
        shuffled = _at_conditions(simulator, inputs, [x[order] for x in points])
        log_mixture = (logsumexp(log_q, axis=0) - np.log(len(rows)))[order]
        # Points that were rounded beyond the end of a support have no weight.
        log_mixture[np.isneginf(log_mixture)] = np.inf
        blocks = order * _SIZES.blocks // n
        has_tails = spread > 1
        return cls(
            simulator, shuffled, log_mixture, blocks, inputs, n, replaced, density, has_tails
        )

    def points_of(self, inputs: Inputs) -> list[Floats]:
        """Return the specimens' values of some inputs."""
        return values_of_inputs(self.points, self.inputs, inputs, self.replaced)

    def values_of(self, responses: Responses) -> Floats:
        """Return a response of the specimens, (n,) or (n, m)."""
        return _emulator(self, responses)(self.points_of(responses.inputs))

    def emulated(self, responses: Responses, points: Arrays) -> list[Floats]:
        """Return a response at any points, (n,) or (n, m), and with two errors of it.

        The errors are that at left-out runs, and that beyond the range of the runs.
        """
        emulator = _emulator(self, responses)
        inputs = values_of_inputs(points, self.inputs, responses.inputs, self.replaced)
        values = emulator(inputs)
        return [values, values + emulator.error.reshape(emulator.event), emulator.steepened(inputs)]

    @property
    def n_runs(self) -> int:
        """Number of runs of the emulator of any response."""
        return len(self.simulator.emulated.z)

    def populations(self, parents: Sequence[Floats]) -> tuple[None, Floats]:
        """Return nothing, and the weights of the specimens in populations at parents, (k, n)."""
        log_p = self.density.at(parents, self.points)(slice(None)) - self.log_mixture
        with np.errstate(invalid="ignore"):
            return None, normalised_weights(log_p)

    def refuse_unsupported(self, name: str, parents: Arrays) -> None:
        """Raise if the weights of most populations are those of a few specimens."""
        _, weights = self.populations(parents)
        size = float(np.median(effective_sample_size(weights)))
        if not size >= 32:
            raise DesignError(
                f"{name}: got a weight effective sample size of {size:.0f} of {self.n_points} "
                "emulated specimens (median over the populations), expected at least 32; the "
                "populations of this result are too different from each other; compute the "
                "quantity from prb.predict"
            )


def _squared_scores(inputs: Inputs, scores: Arrays) -> Floats:
    """Return the squared lengths of normal scores, (k, n, *event) by input -> (k, n)."""
    total: Any = 0.0
    for dist, z in zip(inputs.aleatory, scores, strict=True):
        if is_condition(dist):
            continue
        # PyMC returns NaN for some distribution functions of far tails.
        squares = np.nan_to_num(z, nan=8.0) ** 2
        total = total + squares.reshape(*squares.shape[:2], -1).sum(axis=-1)
    return np.asarray(total)


def _emulator(sample: EmulatedSample, responses: Responses) -> EmulatedResponse:
    """Return the emulator of a response; the first call for the response fits the emulator."""
    if responses not in sample._emulators:
        specimens = sample.points_of(responses.inputs)
        sample._emulators[responses] = emulator_of(sample.simulator, responses, specimens)
    return sample._emulators[responses]


def emulator_error(sample: EmulatedSample, responses: Responses) -> Floats:
    """Return the cross-validation error of the emulator of a response, () or (m,)."""
    emulator = _emulator(sample, responses)
    return emulator.error.reshape(emulator.event)
