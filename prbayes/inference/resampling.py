"""Data sets that might have been observed: drawn from the model, or by resampling specimens.

Observations that carry the same specimen label, within a simulator or between simulators, belong
together: they are drawn, or get their weight, together.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import AT_ONCE, Floats
from prbayes.metrics.base import Discrepancy
from prbayes.model.emulated import PopulationSimulator
from prbayes.model.evaluator import Evaluator
from prbayes.model.random_variable import Node
from prbayes.response.distributions import PopulationSampler

# Points of a resimulated population from which data sets are drawn: hundreds of data sets are then
# weights of some ten million numbers at most.
_MOST_POINTS = 1 << 15
# Data sets that tell a sampling distribution: standard errors from them have an error of 5%, those
# of their middle 89% of 6%, and a coverage of 89% one of 2.2%.
SETS = 200


@dataclass(frozen=True, eq=False)
class DataSets:
    """Data sets for all simulators of a model, as weights on fixed values."""

    # (n_k,), or (n_k, m) of several outputs: by simulator: all values that occur. NaN is an output
    # that was not measured.
    values: list[Floats]
    # (n_sets, n_k): by simulator: the weight of each value in each data set; they sum to one.
    weights: list[Floats]


def specimens(nodes: Sequence[PopulationSimulator]) -> tuple[list[NDArray[np.intp]], int]:
    """Return the specimen's number of each observation, by simulator, and the number of specimens.

    Observations without labels are specimens of their own.
    """
    numbers: dict[object, int] = {}
    out = []
    for k, node in enumerate(nodes):
        found = []
        for label in _labels(node, k):
            number = numbers.setdefault(label, len(numbers))
            found.append(number)
        out.append(np.array(found, dtype=np.intp))
    return out, len(numbers)


def _labels(node: PopulationSimulator, k: int) -> list[object]:
    """Return the labels of the k-th simulator's observations; one for each if there are none."""
    labels = node.specimens
    if labels is not None:
        return list(labels.tolist())
    size = len(node.observed)
    return [(k, i) for i in range(size)]


def dependent(nodes: Sequence[Node]) -> bool:
    """Return whether a specimen has several observations."""
    numbers, total = specimens(nodes)
    return total < sum(n.size for n in numbers)


def groups(nodes: Sequence[Node]) -> list[list[int]]:
    """Return simulators by position, those together that share specimens, even through others."""
    numbers, _ = specimens(nodes)
    found: list[tuple[list[int], set[int]]] = []
    for k, number in enumerate(numbers):
        members = [k]
        shared = set(number.tolist())
        own = frozenset(shared)
        # Groups that have a specimen of this simulator become one with it.
        apart = []
        for group, theirs in found:
            if theirs.isdisjoint(own):
                apart.append((group, theirs))
            else:
                members = members + group
                shared = shared | theirs
        joined = (sorted(members), shared)
        found = [*apart, joined]
    return sorted(members for members, _ in found)


def siblings(nodes: Sequence[Node], names: set[str]) -> set[str]:
    """Return names with those of simulators that share specimens, or are of groups of the same.

    They share a design.
    """
    found = set(names)
    for group in [*groups(nodes), *families(nodes)]:
        together = {nodes[k].name for k in group}
        if together & found:
            found |= together
    return found


def families(nodes: Sequence[Node]) -> list[list[int]]:
    """Return simulators by position, those together whose specimens are of groups of the same."""
    found: dict[int, list[int]] = {}
    for k, node in enumerate(nodes):
        if node.group:
            found.setdefault(id(node.bound.inputs), []).append(k)
    return list(found.values())


def aligned(nodes: Sequence[Node]) -> bool:
    """Return whether the i-th points of all simulators' populations are the same specimen."""
    return all(_same_specimens(node, nodes[0]) for node in nodes)


def _same_specimens(node: Node, other: Node) -> bool:
    """Return whether two simulators have the same inputs at the same points."""
    bound = node.bound
    theirs = other.bound
    inputs = [id(x) for x in bound.inputs.aleatory]
    others = [id(x) for x in theirs.inputs.aleatory]
    if inputs != others:
        return False
    if type(bound) is not type(theirs):
        return False
    if node.propagation != other.propagation:
        return False
    return bound.same_points(theirs)


def simulated_sets(evaluator: Evaluator, theta: Floats, n_sets: int, seed: int = 0) -> DataSets:
    """Draw data sets of the observed sizes from the populations at theta (parametric bootstrap).

    Specimens without a response (NaN) cannot be observed, and those that failed (+inf) only where
    the metric counts them. Of populations of more than 2^15 points that many, the first of a Sobol
    sequence, stand for all. Repeated observations of one specimen within a simulator are equal, as
    the model has them.

    Raises
    ------
    ValueError
        If specimens are shared by simulators whose inputs are not the same ``.dist()`` objects, or
        whose designs differ, so that the model does not say how their responses depend on each
        other.
    """
    populations = []
    for k, node in enumerate(evaluator.nodes):
        values, weights = evaluator.populations(theta[None], k)
        population = thinned(values, weights, node)
        populations.append(population)
    points = simulated_points(evaluator, populations, n_sets, seed)
    return sets_at(evaluator, populations, points)


def stored_populations(evaluator: Evaluator, thetas: Floats) -> list[tuple[Floats, Floats]]:
    """Return stored responses by simulator, (1, n), as `sets_at` takes them."""
    populations = []
    for k in range(len(evaluator.nodes)):
        responses, _ = evaluator.populations(thetas[:1], k)
        populations.append((responses, np.empty(0)))
    return populations


def points_along(
    evaluator: Evaluator, thetas: Floats, rng: np.random.Generator
) -> list[NDArray[np.intp]]:
    """Draw the specimens of one data set at each theta: points by simulator, (n, specimens).

    Raises
    ------
    ValueError
        As `simulated_sets`.
    """
    nodes = evaluator.nodes
    n_specimens = specimens(nodes)[1]
    size = (len(thetas), n_specimens)
    populations = stored_populations(evaluator, thetas)
    points: dict[int, NDArray[np.intp]] = {}
    for group in groups(nodes):
        _refuse_unlike([nodes[k] for k in group])
        finite = _observable_together(nodes, populations, group)
        uniform = rng.random(size)
        drawn = _drawn_along(evaluator, group[0], thetas, finite, uniform)
        points |= dict.fromkeys(group, drawn)
    return [points[k] for k in range(len(nodes))]


def _drawn_along(
    evaluator: Evaluator, k: int, thetas: Floats, finite: NDArray[np.bool_], uniform: Floats
) -> NDArray[np.intp]:
    """Return the points of the specimens of each theta, (n, specimens), by inverted sums."""
    at_once = max(1, AT_ONCE // finite.size)
    drawn = np.empty(uniform.shape, dtype=np.intp)
    for first in range(0, len(thetas), at_once):
        rows = slice(first, first + at_once)
        _, weights = evaluator.populations(thetas[rows], k)
        below = np.cumsum(weights * finite, axis=1)
        for i, sums in enumerate(below, start=first):
            height = uniform[i] * sums[-1]
            # On the right of equal sums, so that no point without weight is drawn.
            drawn[i] = np.searchsorted(sums, height, side="right")
    # A product may be rounded up to the whole.
    return np.minimum(drawn, finite.size - 1)


def simulated_points(
    evaluator: Evaluator,
    populations: list[tuple[Floats, Floats]],
    n_sets: int,
    seed: int = 0,
    *,
    more: int = 0,
) -> list[NDArray[np.intp]]:
    """Draw the specimens of data sets.

    By simulator the points of its population, (n_sets, specimens + more).

    Parameters
    ----------
    evaluator : Evaluator
    populations : list of (ndarray, ndarray)
        By simulator: responses and weights, shapes (1, n).
    n_sets, seed : int
    more : int
        Specimens besides those observed.
    """
    nodes = evaluator.nodes
    rng = np.random.default_rng([seed, 1])
    _, total = specimens(nodes)
    size = (n_sets, total + more)
    draws: dict[int, NDArray[np.intp]] = {}
    for group in groups(nodes):
        members = [nodes[k] for k in group]
        _refuse_unlike(members)
        # All that share specimens have the same points, with the same weights.
        finite = _observable_together(nodes, populations, group)
        _, weights = populations[group[0]]
        drawn = _draw(weights[0], finite, size, rng)
        draws |= dict.fromkeys(group, drawn)
    return [draws[k] for k in range(len(nodes))]


def sets_at(
    evaluator: Evaluator, populations: list[tuple[Floats, Floats]], points: list[NDArray[np.intp]]
) -> DataSets:
    """Return the data sets that are measured on specimens, given by `simulated_points`."""
    numbers, _ = specimens(evaluator.nodes)
    values = []
    weights = []
    for k, node in enumerate(evaluator.nodes):
        responses = populations[k][0][0]
        finite = observable(responses, node.target)
        # The place of each point among those that can be observed.
        place = np.cumsum(finite) - 1
        measured = place[points[k][:, numbers[k]]]
        seen = responses[finite]
        patterns, own = _patterns(node.target.observed)
        if len(patterns) > 1:
            measured, seen = _seen(measured, seen, patterns, own)
        counted = _counted(
            measured,
            node.target.weights,
            size=len(seen),
        )
        values.append(seen)
        weights.append(counted)
    return DataSets(values, weights)


def _seen(
    measured: NDArray[np.intp],
    values: Floats,
    patterns: NDArray[np.bool_],
    own: NDArray[np.intp],
) -> tuple[NDArray[np.intp], Floats]:
    """Return places, (n_sets, N), and the values there, with NaN for outputs not measured.

    Each specimen shows the outputs that the observed one in its place shows.
    """
    size = len(values)
    cells, places = np.unique(measured + size * own, return_inverse=True)
    shown = np.where(patterns[cells // size], values[cells % size], np.nan)
    return places.reshape(measured.shape), shown


def observable(responses: Floats, target: Discrepancy) -> NDArray[np.bool_]:
    """Return which points can be observed, (n,) or (n, m) -> (n,).

    A specimen that failed is observed as such, if the metric counts failures.
    """
    known = ~np.isnan(responses) if target.metric.counts_failures else np.isfinite(responses)
    return known if known.ndim == 1 else known.all(axis=1)


def _observable_together(
    nodes: Sequence[Node], populations: list[tuple[Floats, Floats]], group: list[int]
) -> NDArray[np.bool_]:
    """Return which points can be observed by all of some simulators, (n,)."""
    seen = [observable(populations[k][0][0], nodes[k].target) for k in group]
    return np.asarray(np.all(seen, axis=0))


def _patterns(observed: Floats) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
    """Return which outputs are measured together, (p, m), and the pattern of each specimen, (N,).

    Of one output there is one pattern.
    """
    if observed.ndim == 1:
        return np.ones((1, 1), dtype=bool), np.zeros(len(observed), dtype=np.intp)
    patterns, own = np.unique(~np.isnan(observed), axis=0, return_inverse=True)
    return patterns, own.ravel()


def _counted(places: NDArray[np.intp], own: Floats, *, size: int) -> Floats:
    """Add up the observations' own weights at the places drawn, (n_sets, n) -> (n_sets, size)."""
    n_sets = len(places)
    # All data sets in one row, one after the other.
    begin = size * np.arange(n_sets)
    cells = places + begin[:, None]
    repeated = np.tile(own, n_sets)
    count = np.bincount(cells.ravel(), repeated, n_sets * size)
    return np.asarray(count.reshape(n_sets, size))


def thinned(values: Floats, weights: Floats, node: Node) -> tuple[Floats, Floats]:
    """Return the first 2^15 points, of equal weights, of resimulated populations, (k, n) each."""
    if node.bound.stored or values.shape[1] <= _MOST_POINTS:
        return values, weights
    equal = np.broadcast_to(1 / _MOST_POINTS, (len(values), _MOST_POINTS))
    return values[:, :_MOST_POINTS], equal


def _refuse_unlike(nodes: Sequence[Node]) -> None:
    if not aligned(nodes):
        names = ", ".join(n.name for n in nodes)
        raise ValueError(
            f"specimens: got the same labels in {names} with different inputs or designs, "
            "expected the same .dist() objects, n and seed in all; then the model says how "
            "responses of one specimen depend on each other"
        )


def _draw(
    weights: Floats, finite: NDArray[np.bool_], size: tuple[int, int], rng: np.random.Generator
) -> NDArray[np.intp]:
    observable = np.where(finite, weights, 0.0)
    probability = observable / observable.sum()
    return rng.choice(probability.size, size=size, p=probability)


def fresh_data(evaluator: Evaluator, theta: Floats, rng: np.random.Generator) -> dict[str, Floats]:
    """Draw one data set from the populations at theta by calling the response.

    Specimens that cannot be observed are replaced by others, as in `simulated_sets`.

    Raises
    ------
    ValueError
        If hardly any response can be observed.
    """
    nodes = evaluator.nodes
    numbers, total = specimens(nodes)
    together = groups(nodes)
    generators = rng.spawn(len(together))
    data = {}
    for group, generator in zip(together, generators, strict=True):
        _refuse_unlike([nodes[k] for k in group])
        columns = []
        for k in group:
            # Four for each that is needed, in case three of four responses are not finite.
            column = _responses(evaluator, theta, k, 4 * total, generator)
            columns.append(column)
        # What one simulator of a specimen cannot measure, none of them has.
        targets = [nodes[k].target for k in group]
        finite = np.all(list(map(observable, columns, targets)), axis=0)
        for k, column in zip(group, columns, strict=True):
            node = nodes[k]
            _refuse_few(node, finite, total)
            drawn = column[finite][numbers[k]]
            data[node.name] = np.where(np.isnan(node.target.observed), np.nan, drawn)
    return {node.name: data[node.name] for node in nodes}


def _responses(
    evaluator: Evaluator, theta: Floats, k: int, size: int, generator: np.random.Generator
) -> Floats:
    """Return responses of new specimens, (size,) or (size, m); the same for the same generator."""
    bound = evaluator.nodes[k].bound
    sampler = PopulationSampler(bound.inputs)
    roots = evaluator.roots(theta[None], k)
    again = copy.deepcopy(generator)
    aleatory, epistemic = sampler(roots, size, again)
    responses = bound.responses(aleatory, epistemic)
    return np.asarray(responses[0])


def _refuse_few(node: Node, finite: NDArray[np.bool_], expected: int) -> None:
    count = finite.sum()
    if count < expected:
        raise ValueError(
            f"{node.name}: got {count} responses that can be observed of {finite.size}, expected "
            f"at least {expected}"
        )


def observed_set(evaluator: Evaluator) -> DataSets:
    """Return the observed responses as the only data set."""
    values = []
    weights = []
    for node in evaluator.nodes:
        values.append(node.target.observed)
        weights.append(node.target.weights[None])
    return DataSets(values, weights)


def one_set(
    evaluator: Evaluator, sets: DataSets, i: int
) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Return the i-th data set as it would be measured: values and their weights, by simulator.

    Specimens that count alike are repeated where a value occurs several times.
    """
    observed: dict[str, Floats] = {}
    counted: dict[str, Floats] = {}
    for node, values, weights in zip(evaluator.nodes, sets.values, sets.weights, strict=True):
        own = node.target.weights
        seen = np.flatnonzero(weights[i])
        times = weights[i, seen] / own[0]
        whole = np.rint(times).astype(np.intp)
        if np.ptp(own) == 0 and np.allclose(times, whole):
            seen = np.repeat(seen, whole)
            counted[node.name] = np.full(seen.size, own[0])
        else:
            counted[node.name] = weights[i, seen]
        observed[node.name] = values[seen]
    return observed, counted


def dirichlet_weights(
    simulators: Sequence[PopulationSimulator], n_sets: int, seed: int = 0
) -> list[Floats]:
    """Return Dirichlet weights of the observed specimens, times their own, (n_sets, N) each.

    Observations with the same label are weighted together.
    """
    rng = np.random.default_rng([seed, 2])
    numbers, total = specimens(simulators)
    gains = rng.standard_exponential((n_sets, total))
    weights = []
    for number, simulator in zip(numbers, simulators, strict=True):
        w = gains[:, number] * simulator.weights
        weights.append(w / w.sum(axis=-1, keepdims=True))
    return weights


def reweighted_sets(evaluator: Evaluator, n_sets: int, seed: int = 0) -> DataSets:
    """Give the observed specimens Dirichlet weights (Bayesian bootstrap), times their own."""
    values = [node.target.observed for node in evaluator.nodes]
    return DataSets(values, dirichlet_weights(evaluator.nodes, n_sets, seed))
