"""Synthetic data sets, drawn from the model, and bootstrap samples of the observed specimens.

Observations with the same specimen label, within a simulator or between simulators, are drawn, or
weighted, together.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import AT_ONCE, ArrayPair, Bools, Floats, Indices, NamedArrays
from prbayes.metrics.base import Discrepancy
from prbayes.model.emulated import PopulationSimulator
from prbayes.model.evaluator import Evaluator
from prbayes.model.random_variable import Node
from prbayes.model.simulator_with_data import number_specimens
from prbayes.propagation.reweighted import same_points
from prbayes.response.distributions import PopulationSampler

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# Number of points of a resimulated population from which data sets are drawn, so that hundreds of
# data sets have ten million weights at most
_MAX_POINTS = 1 << 15
# Number of data sets for a sampling distribution, with which standard errors have an error of 5 %
SETS = 200


@dataclass(frozen=True, eq=False)
class DataSets:
    """Data sets for all simulators of a model, as weights on fixed values."""

    # All values that occur, by simulator: (n_k,), or (n_k, m) of several outputs. NaN marks an
    # output that was not measured.
    values: list[Floats]
    # Weights of the values in each data set, by simulator: (n_sets, n_k), with sum one
    weights: list[Floats]


# -- specimens in common ---------------------------------------------------------------------------


def dependent(nodes: Sequence[Node]) -> bool:
    """Return whether a specimen has several observations."""
    numbers, total = number_specimens(nodes)
    return total < np.concatenate(numbers).size


def groups(nodes: Sequence[Node]) -> list[list[int]]:
    """Return groups of simulators that share specimens, as indices, also by a third one."""
    from scipy.sparse.csgraph import connected_components

    if all(node.specimens is None for node in nodes):
        return [[k] for k in range(len(nodes))]
    numbers, total = number_specimens(nodes)
    measures = np.array([np.isin(np.arange(total), number) for number in numbers])
    _, group = connected_components(measures @ measures.T)
    return [np.flatnonzero(group == g).tolist() for g in np.unique(group)]


def siblings(nodes: Sequence[Node], names: set[str]) -> set[str]:
    """Return names, and those of all simulators that share a design with them."""
    result = set(names)
    for group in [*groups(nodes), *families(nodes)]:
        members = {nodes[k].name for k in group}
        if members & result:
            result |= members
    return result


def families(nodes: Sequence[Node]) -> list[list[int]]:
    """Return lists of indices of simulators that belong to groups of the same specimens."""
    by_inputs: dict[int, list[int]] = {}
    for k, node in enumerate(nodes):
        if node.group:
            by_inputs.setdefault(id(node.bound.inputs), []).append(k)
    return list(by_inputs.values())


def aligned(nodes: Sequence[Node]) -> bool:
    """Return whether the i-th points of all simulators' populations are the same specimen."""
    first = nodes[0]
    inputs = [id(x) for x in first.bound.inputs.aleatory]
    return all(
        [id(x) for x in node.bound.inputs.aleatory] == inputs
        and node.propagation == first.propagation
        and same_points(node.bound, first.bound)
        for node in nodes[1:]
    )


def _aligned_groups(nodes: Sequence[Node]) -> list[list[int]]:
    """Return groups that share specimens, or raise if the model does not define how they depend."""
    result = groups(nodes)
    for group in result:
        members = [nodes[k] for k in group]
        if not aligned(members):
            names = ", ".join([node.name for node in members])
            raise ValueError(
                f"specimens: got the same labels in {names} with different inputs or designs, "
                "expected the same .dist() objects, n and seed in all, which determine how "
                "responses of one specimen depend on each other"
            )
    return result


# -- parametric bootstrap --------------------------------------------------------------------------


def simulated_sets(evaluator: Evaluator, theta: Floats, n_sets: int, seed: int = 0) -> DataSets:
    """Draw data sets of the observed sizes from the populations at theta (parametric bootstrap).

    Repeated observations of one specimen within a simulator are equal, as in the model. Raises
    ValueError if simulators share specimens, but not their ``.dist()`` objects and designs.
    """
    populations = [
        thinned(*evaluator.populations(theta[None], k), node)
        for k, node in enumerate(evaluator.nodes)
    ]
    responses = [values[0] for values, _ in populations]
    if _are_countable(evaluator, responses):
        rng = np.random.default_rng([seed, 3])
        masses = [np.broadcast_to(weights[0], (n_sets, weights.size)) for _, weights in populations]
        counts = _drawn_counts(evaluator, responses, masses, rng)
        return _counted_sets(evaluator, responses, counts)
    points = simulated_points(evaluator, populations, n_sets, seed)
    return sets_at(evaluator, responses, points)


def _are_countable(evaluator: Evaluator, responses: list[Floats]) -> bool:
    """Return whether it suffices, and is faster, to draw how often each point occurs.

    This requires that observations are different specimens, measured alike, and more than the
    points.
    """
    nodes = evaluator.nodes
    for node in nodes:
        if node.specimens is not None or np.ptp(node.target.weights) > 0:
            return False
    n_observed = sum(len(node.observed) for node in nodes)
    is_measured = not any(np.isnan(node.observed).any() for node in nodes)
    return n_observed > sum(map(len, responses)) and is_measured


def _drawn_counts(
    evaluator: Evaluator,
    responses: list[Floats],
    masses: Iterable[Floats],
    rng: np.random.Generator,
) -> list[NDArray[np.int64]]:
    """Draw how often each point occurs in data sets with weights (n_sets, n), by simulator."""
    counts = []
    for node, values, weights in zip(evaluator.nodes, responses, masses, strict=True):
        mass = weights * observable(values, node.target)
        share = mass / mass.sum(axis=1, keepdims=True)
        counts.append(rng.multinomial(len(node.observed), share))
    return counts


def _counted_sets(
    evaluator: Evaluator, responses: list[Floats], counts: list[NDArray[np.int64]]
) -> DataSets:
    """Return data sets from the numbers of times that each point occurs."""
    values, weights = [], []
    for node, response, count in zip(evaluator.nodes, responses, counts, strict=True):
        is_observable = observable(response, node.target)
        values.append(response[is_observable])
        weights.append(count[:, is_observable] / len(node.observed))
    return DataSets(values, weights)


def sets_along(
    evaluator: Evaluator, thetas: Floats, rng: np.random.Generator
) -> tuple[DataSets, list[csr_array]]:
    """Draw one data set at each theta, and return it with counts of each point, by group.

    Points are those of stored responses: counts have shape (n, points).
    """
    from scipy.sparse import csr_array

    nodes = evaluator.nodes
    responses = [evaluator.populations(thetas[:1], k)[0][0] for k in range(len(nodes))]
    if _are_countable(evaluator, responses):
        masses = (evaluator.populations(thetas, k)[1] for k in range(len(nodes)))
        drawn_counts = _drawn_counts(evaluator, responses, masses, rng)
        sets = _counted_sets(evaluator, responses, drawn_counts)
        return sets, [csr_array(count.astype(np.float64)) for count in drawn_counts]
    numbers, total = number_specimens(nodes)
    size = (len(thetas), total)
    points: dict[int, Indices] = {}
    counts = []
    for group in _aligned_groups(nodes):
        is_observable = _observable_by_all(evaluator, responses, group)
        uniform = rng.random(size)
        drawn = np.empty(size, dtype=np.intp)
        at_once = max(1, AT_ONCE // is_observable.size)
        for first in range(0, len(thetas), at_once):
            _, weights = evaluator.populations(thetas[first : first + at_once], group[0])
            for i, mass in enumerate(weights * is_observable, start=first):
                drawn[i] = _points_of(mass, uniform[i])
        points |= dict.fromkeys(group, drawn)
        # Count how often each stored response is a specimen of each data set.
        places = drawn[:, np.unique(np.concatenate([numbers[k] for k in group]))]
        n_sets, n = places.shape
        ends = n * np.arange(n_sets + 1)
        shape = (n_sets, nodes[group[0]].bound.n_points)
        count = csr_array((np.ones(places.size), places.ravel(), ends), shape=shape)
        count.sum_duplicates()
        counts.append(count)
    by_simulator = [points[k] for k in range(len(nodes))]
    return sets_at(evaluator, responses, by_simulator), counts


def simulated_points(
    evaluator: Evaluator,
    populations: list[ArrayPair],
    n_sets: int,
    seed: int,
    *,
    more: int = 0,
) -> list[Indices]:
    """Draw the specimens of data sets: points of populations, (n_sets, specimens + more) each.

    Populations are responses and weights by simulator, (1, n) each.
    """
    nodes = evaluator.nodes
    rng = np.random.default_rng([seed, 1])
    size = number_specimens(nodes)[1] + more
    responses = [values[0] for values, _ in populations]
    points: dict[int, Indices] = {}
    for group in _aligned_groups(nodes):
        # Draw once for the group, because simulators that share specimens have the same points and
        # weights.
        mass = populations[group[0]][1][0] * _observable_by_all(evaluator, responses, group)
        drawn = np.empty((n_sets, size), dtype=np.intp)
        for rows in _blocks(n_sets, size):
            drawn[rows] = _points_of(mass, rng.random(drawn[rows].shape))
        points |= dict.fromkeys(group, drawn)
    return [points[k] for k in range(len(nodes))]


def _observable_by_all(evaluator: Evaluator, responses: list[Floats], group: list[int]) -> Bools:
    """Return which points all simulators of a group can observe, (n,)."""
    columns = [observable(responses[k], evaluator.nodes[k].target) for k in group]
    return np.all(columns, axis=0)


def _points_of(mass: Floats, uniform: Floats) -> Indices:
    """Return points of a population at levels of its cumulated weights, (n,), (...) -> (...)."""
    below = np.cumsum(mass / mass.sum())
    # Search on the right of equal sums, so that no point without weight is drawn.
    points = np.searchsorted(below / below[-1], uniform, side="right")
    return np.minimum(points, mass.size - 1)  # because a level may be rounded up to one


def sets_at(evaluator: Evaluator, populations: list[Floats], points: list[Indices]) -> DataSets:
    """Return data sets of specimens, which are given as indices of the responses (n,)."""
    numbers, _ = number_specimens(evaluator.nodes)
    values, weights = [], []
    for k, (node, responses) in enumerate(zip(evaluator.nodes, populations, strict=True)):
        is_observable = observable(responses, node.target)
        # Number the points that can be observed.
        index = np.cumsum(is_observable) - 1
        cells = index[points[k][:, numbers[k]]]
        occurring = responses[is_observable]
        observed = node.target.observed
        if observed.ndim > 1:
            # A synthetic specimen has the outputs that were measured of the observed one in its
            # place, and NaN for the rest.
            patterns, row = np.unique(~np.isnan(observed), axis=0, return_inverse=True)
            if len(patterns) > 1:
                size = len(occurring)
                pairs, places = np.unique(cells + size * row.ravel(), return_inverse=True)
                cells = places.reshape(cells.shape)
                occurring = np.where(patterns[pairs // size], occurring[pairs % size], np.nan)
        # Add up the observations' weights by value. One call of bincount serves all data sets of a
        # block.
        size = len(occurring)
        summed = np.empty((len(cells), size))
        for rows in _blocks(len(cells), cells.shape[1]):
            count = len(cells[rows])
            stacked = cells[rows] + (size * np.arange(count))[:, None]
            repeated = np.tile(node.target.weights, count)
            summed[rows] = np.bincount(stacked.ravel(), repeated, count * size).reshape(count, size)
        values.append(occurring)
        weights.append(summed)
    return DataSets(values, weights)


def _blocks(n_sets: int, size: int) -> Iterator[slice]:
    """Yield blocks of data sets whose specimens fit into the memory."""
    step = max(1, AT_ONCE // size)
    for first in range(0, n_sets, step):
        yield slice(first, min(first + step, n_sets))


def observable(responses: Floats, target: Discrepancy) -> Bools:
    """Return which points can be observed, (n,) or (n, m) -> (n,).

    A failed specimen is observed as such, if the metric counts failures.
    """
    is_known = ~np.isnan(responses) if target.metric.counts_failures else np.isfinite(responses)
    return is_known if is_known.ndim == 1 else is_known.all(axis=1)


def thinned(values: Floats, weights: Floats, node: Node) -> ArrayPair:
    """Return the first 2^15 points, of equal weights, of resimulated populations, (k, n) each."""
    if node.bound.stored or values.shape[1] <= _MAX_POINTS:
        return values, weights
    equal = np.broadcast_to(1 / _MAX_POINTS, (len(values), _MAX_POINTS))
    return values[:, :_MAX_POINTS], equal


def fresh_data(evaluator: Evaluator, theta: Floats, rng: np.random.Generator) -> NamedArrays:
    """Draw one data set from the populations at theta by calling the response.

    Specimens that cannot be observed are replaced, as in `simulated_sets`.
    """
    nodes = evaluator.nodes
    numbers, total = number_specimens(nodes)
    node_groups = _aligned_groups(nodes)
    data = {}
    for group, generator in zip(node_groups, rng.spawn(len(node_groups)), strict=True):
        members = [nodes[k] for k in group]
        columns = []
        for k, node in zip(group, members, strict=True):
            sampler = PopulationSampler(node.bound.inputs)
            parents = evaluator.parents(theta[None], k)
            # Draw four candidates for each specimen. The copied generator gives all simulators of
            # the group the same candidates.
            aleatory, epistemic = sampler(parents, 4 * total, copy.deepcopy(generator))
            columns.append(np.asarray(node.bound.responses(aleatory, epistemic)[0]))
        # Leave out specimens that any simulator of the group cannot measure.
        targets = [node.target for node in members]
        is_observable = np.all(list(map(observable, columns, targets)), axis=0)
        for k, node, column in zip(group, members, columns, strict=True):
            if is_observable.sum() < total:
                raise ValueError(
                    f"{node.name}: got {is_observable.sum()} responses that can be observed of "
                    f"{is_observable.size}, expected at least {total}; use more responses, or "
                    "repair those that are NaN"
                )
            drawn = column[is_observable][numbers[k]]
            data[node.name] = np.where(np.isnan(node.target.observed), np.nan, drawn)
    return {node.name: data[node.name] for node in nodes}


# -- the observed data -----------------------------------------------------------------------------


def observed_set(evaluator: Evaluator) -> DataSets:
    """Return the observed responses as the only data set."""
    targets = [node.target for node in evaluator.nodes]
    return DataSets([t.observed for t in targets], [t.weights[None] for t in targets])


def one_set(evaluator: Evaluator, sets: DataSets, i: int) -> tuple[NamedArrays, NamedArrays]:
    """Return the i-th data set as it would be measured: values and their weights, by simulator.

    Specimens of equal weights are repeated if a value occurs several times.
    """
    data = {}
    data_weights = {}
    for node, values, weights in zip(evaluator.nodes, sets.values, sets.weights, strict=True):
        unit = node.target.weights
        rows = np.flatnonzero(weights[i])
        times = weights[i, rows] / unit[0]
        repeats = np.rint(times).astype(np.intp)
        if np.ptp(unit) == 0 and np.allclose(times, repeats):
            rows = np.repeat(rows, repeats)
            data_weights[node.name] = np.full(rows.size, unit[0])
        else:
            data_weights[node.name] = weights[i, rows]
        data[node.name] = values[rows]
    return data, data_weights


def dirichlet_weights(
    simulators: Sequence[PopulationSimulator], n_sets: int, seed: int
) -> list[Floats]:
    """Return Dirichlet weights of the observed specimens, times their own, (n_sets, N) each.

    Observations with the same label are weighted together.
    """
    rng = np.random.default_rng([seed, 2])
    numbers, total = number_specimens(simulators)
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
