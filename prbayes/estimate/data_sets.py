"""Data sets that might have been observed: drawn from the model, or by resampling specimens.

Observations that carry the same specimen label, within a simulator or between simulators, belong together:
they are drawn, or get their weight, together.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats
from prbayes.model.evaluator import Evaluator
from prbayes.model.node import Node
from prbayes.response.distributions import PopulationSampler

_MOST = 1 << 15  # points of a resimulated population from which data sets are drawn
_SPARE = 4  # draws for each specimen that is needed, in case responses are not finite


@dataclass(frozen=True, eq=False)
class DataSets:
    """Data sets for all simulators of a model, as weights on fixed values.

    Attributes
    ----------
    values : list of ndarray, shapes (n_k,)
        By simulator: all values that occur.
    weights : list of ndarray, shapes (n_sets, n_k)
        By simulator: the weight of each value in each data set; they sum to one.
    """

    values: list[Floats]
    weights: list[Floats]


def specimens(nodes: list[Node]) -> tuple[list[NDArray[np.intp]], int]:
    """Return the number of the specimen of each observation, by simulator, and how many specimens there are.

    Observations without labels are specimens of their own.
    """
    numbers: dict[object, int] = {}
    out = []
    for k, node in enumerate(nodes):
        size = node.target.observed.size
        labels = [(k, i) for i in range(size)] if node.specimens is None else node.specimens.tolist()
        out.append(np.array([numbers.setdefault(label, len(numbers)) for label in labels], dtype=np.intp))
    return out, len(numbers)


def dependent(nodes: list[Node]) -> bool:
    """Return whether a specimen has several observations."""
    numbers, total = specimens(nodes)
    return total < sum(n.size for n in numbers)


def groups(nodes: list[Node]) -> list[list[int]]:
    """Return the simulators by their position, those together that share specimens, be it through others."""
    numbers, _ = specimens(nodes)
    found: list[tuple[list[int], set[int]]] = []
    for k, own in enumerate(set(n.tolist()) for n in numbers):
        joined = [g for g in found if g[1] & own]
        found = [g for g in found if not g[1] & own]
        found.append((sorted([k, *(i for g in joined for i in g[0])]), own.union(*(g[1] for g in joined))))
    return sorted(g[0] for g in found)


def siblings(nodes: list[Node], names: set[str]) -> set[str]:
    """Return names with those of simulators that share specimens with them, whose designs have to stay the same."""
    together = [{nodes[k].name for k in group} for group in groups(nodes)]
    return names.union(*(g for g in together if g & names))


def aligned(nodes: list[Node]) -> bool:
    """Return whether the i-th points of all simulators' populations are the same specimen."""
    first = nodes[0].bound
    return all(
        list(map(id, n.bound.inputs.aleatory)) == list(map(id, first.inputs.aleatory))
        and type(n.bound) is type(first)
        and n.propagation == nodes[0].propagation
        and n.bound.same_points(first)
        for n in nodes
    )


def simulated_sets(evaluator: Evaluator, theta: Floats, n_sets: int, seed: int = 0) -> DataSets:
    """Draw data sets of the observed sizes from the populations at theta (parametric bootstrap).

    Only responses that are finite can be observed. Of populations of more than 2^15 points that many, the first of a
    Sobol sequence, stand for all. Repeated observations of one specimen within a simulator
    are equal, as the model has them.

    Raises
    ------
    ValueError
        If specimens are shared by simulators whose inputs are not the same ``.dist()`` objects, or whose
        designs differ, so that the model does not say how their responses depend on each other.
    """
    populations = [thinned(*evaluator.populations(theta[None], k), n) for k, n in enumerate(evaluator.nodes)]
    return sets_at(evaluator, populations, simulated_points(evaluator, populations, n_sets, seed))


def simulated_points(
    evaluator: Evaluator, populations: list[tuple[Floats, Floats]], n_sets: int, seed: int = 0, *, more: int = 0
) -> list[NDArray[np.intp]]:
    """Draw the specimens of data sets: by simulator the points of its population, (n_sets, specimens + more).

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
    draws: dict[int, NDArray[np.intp]] = {}
    for group in groups(nodes):
        _refuse_unlike([nodes[k] for k in group])
        ok = np.all([np.isfinite(populations[k][0][0]) for k in group], axis=0)
        drawn = _draw(populations[group[0]][1][0], ok, (n_sets, total + more), rng)
        draws |= dict.fromkeys(group, drawn)
    return [draws[k] for k in range(len(nodes))]


def sets_at(evaluator: Evaluator, populations: list[tuple[Floats, Floats]], points: list[NDArray[np.intp]]) -> DataSets:
    """Return the data sets that are measured on specimens, given by `simulated_points`."""
    numbers, _ = specimens(evaluator.nodes)
    n_sets = len(points[0])
    values, weights = [], []
    for k, node in enumerate(evaluator.nodes):
        responses = populations[k][0][0]
        finite = np.isfinite(responses)
        where = np.cumsum(finite) - 1
        size = int(finite.sum())
        cells = where[points[k][:, numbers[k]]] + size * np.arange(n_sets)[:, None]
        count = np.bincount(cells.ravel(), np.tile(node.target.weights, n_sets), n_sets * size)
        values.append(responses[finite])
        weights.append(count.reshape(n_sets, size))
    return DataSets(values, weights)


def thinned(values: Floats, weights: Floats, node: Node) -> tuple[Floats, Floats]:
    """Return the first 2^15 points of resimulated populations, (k, n) each, which all have equal weights."""
    if node.bound.stored or values.shape[-1] <= _MOST:
        return values, weights
    return values[:, :_MOST], np.broadcast_to(1 / _MOST, (len(values), _MOST))


def _refuse_unlike(nodes: list[Node]) -> None:
    if not aligned(nodes):
        raise ValueError(
            f"specimens: got the same labels in {', '.join(n.name for n in nodes)} with different inputs or designs, "
            "expected the same .dist() objects, n and seed in all; then the model says how responses of one specimen "
            "depend on each other"
        )


def _draw(
    weights: Floats, finite: NDArray[np.bool_], size: tuple[int, int], rng: np.random.Generator
) -> NDArray[np.intp]:
    p = np.where(finite, weights, 0.0)
    return rng.choice(p.size, size=size, p=p / p.sum())


def fresh_data(evaluator: Evaluator, theta: Floats, rng: np.random.Generator) -> dict[str, Floats]:
    """Draw one data set from the populations at theta by calling the response, not from design points.

    Specimens whose response is not finite cannot be observed; others take their place.

    Raises
    ------
    ValueError
        If hardly any response is finite.
    """
    nodes = evaluator.nodes
    numbers, total = specimens(nodes)
    data = {}
    together = groups(nodes)
    columns, finite = [np.empty(0)] * len(nodes), [np.empty(0, dtype=bool)] * len(nodes)
    for group, seed in zip(together, rng.spawn(len(together)), strict=True):
        _refuse_unlike([nodes[k] for k in group])
        for k in group:
            sampler = PopulationSampler(nodes[k].bound.inputs)
            # The same generator for all that share specimens: the same inputs, one row per specimen.
            aleatory, epistemic = sampler(evaluator.roots(theta[None], k), _SPARE * total, copy.deepcopy(seed))
            columns[k] = nodes[k].bound.responses(aleatory, epistemic)[0]
        ok = np.all([np.isfinite(columns[k]) for k in group], axis=0)
        for k in group:
            finite[k] = ok
    for node, number, column, ok in zip(nodes, numbers, columns, finite, strict=True):
        if ok.sum() < total:
            raise ValueError(f"{node.name}: got {ok.sum()} finite responses of {ok.size}, expected at least {total}")
        data[node.name] = column[ok][number]
    return data


def observed_set(evaluator: Evaluator) -> DataSets:
    """Return the observed responses as the only data set."""
    targets = [n.target for n in evaluator.nodes]
    return DataSets([t.observed for t in targets], [t.weights[None] for t in targets])


def reweighted_sets(evaluator: Evaluator, n_sets: int, seed: int = 0) -> DataSets:
    """Give the observed specimens Dirichlet weights (Bayesian bootstrap), on top of the observations' own."""
    rng = np.random.default_rng([seed, 2])
    numbers, total = specimens(evaluator.nodes)
    gains = rng.standard_exponential((n_sets, total))
    weights = [gains[:, i] * n.target.weights for i, n in zip(numbers, evaluator.nodes, strict=True)]
    return DataSets(
        [n.target.observed for n in evaluator.nodes],
        [w / w.sum(axis=-1, keepdims=True) for w in weights],
    )
