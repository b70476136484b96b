"""The aleatory inputs of a model by name, and the densities of their margins."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pytensor.tensor.variable import TensorVariable

from prbayes._validate import Floats, called
from prbayes.model.elements import element_name, variable_of
from prbayes.model.evaluator import Evaluator
from prbayes.plots._curves import GRID_POINTS, central_range, smooth_densities
from prbayes.response.compile import compile_batched
from prbayes.response.distributions import PopulationSampler, is_mvnormal
from prbayes.response.inputs import Inputs, aleatory_names


@dataclass(frozen=True, eq=False)
class Margin:
    """One number that varies from specimen to specimen."""

    # That of the distribution if it has one, or of the response's argument; with an element's
    # index.
    name: str
    dist: TensorVariable  # the ``.dist()``
    # Which simulator has it, and which of its aleatory inputs it is.
    node: int
    position: int
    index: tuple[int, ...]  # element of a multivariate input
    group: str = ""  # whose population it is, where there are groups

    @property
    def axis(self) -> Hashable:
        """What the margins have in common that are drawn over the same values."""
        return (self.dist, self.index) if self.group else self.name

    @property
    def discrete(self) -> bool:
        """Whether it takes whole numbers only."""
        return not self.dist.dtype.startswith("float")


def margins(evaluator: Evaluator) -> list[Margin]:
    """Return the margins of all aleatory inputs; an input of several simulators counts once."""
    found: list[Margin] = []
    variables = evaluator.model.basic_RVs
    taken = {str(variable.name) for variable in variables}
    for k, node in enumerate(evaluator.simulators):
        inputs = node.inputs
        names = aleatory_names(inputs, node.responses.function)
        for position, dist in enumerate(inputs.aleatory):
            if any(margin.dist is dist and margin.group == node.group for margin in found):
                continue
            own = [node.group] if node.group else []
            name = names[position]
            if element_name(name, own) in taken:
                name = f"{name} of {node.name}"
            taken.add(element_name(name, own))
            for index in np.ndindex(inputs.event_shapes[position]):
                element = element_name(name, [*own, *index])
                found.append(Margin(element, dist, k, position, index, node.group))
    return found


def chosen(known: list[Margin], inputs: Iterable[Any] | None) -> list[Margin]:
    """Return those margins that a user asked for: by name, with or without index, or ``.dist()``.

    Raises
    ------
    KeyError
        If there is no such input.
    """
    if inputs is None:
        return known
    if isinstance(inputs, str | TensorVariable):
        inputs = [inputs]
    if not isinstance(inputs, list | tuple) or not inputs:
        raise TypeError(
            f"inputs: got {called(inputs)}, expected a list of names or .dist() objects, such as "
            f"{[margin.name for margin in known][:2]}"
        )
    found: list[Margin] = []
    for x in inputs:
        new = [margin for margin in known if _is(margin, x)]
        if not new:
            names = [margin.name for margin in known]
            raise KeyError(f"inputs: got {x}, expected some of {names}, or their .dist() objects")
        found += [margin for margin in new if margin not in found]
    return found


def _is(margin: Margin, wanted: Any) -> bool:
    """Whether a margin is, or is an element of, what a user asked for."""
    if isinstance(wanted, str):
        return wanted in (margin.name, variable_of(margin.name))
    return margin.dist is wanted


def margin_densities(
    evaluator: Evaluator, wanted: list[Margin], thetas: Floats
) -> dict[str, tuple[Floats, Floats]]:
    """Return by margin a grid, shape (g,), and densities at thetas, shape (P, g); or probabilities.

    They are exact where the input has an elementwise density or is a multivariate normal, and else
    kernel densities, or shares, of random draws. No response is computed. The populations of
    several groups have one grid.
    """
    drawn = {}
    for k in sorted({margin.node for margin in wanted}):
        sampler = PopulationSampler(evaluator.simulators[k].inputs)
        drawn[k] = _Draws(sampler, evaluator.roots(thetas, k))
    ranges: dict[Any, tuple[float, float]] = {}
    for margin in wanted:
        own = _range(_values(drawn[margin.node].few, margin))
        low, high = ranges.get(margin.axis, own)
        ranges[margin.axis] = min(low, own[0]), max(high, own[1])
    found = {}
    for margin in wanted:
        of_node = drawn[margin.node]
        inputs = evaluator.simulators[margin.node].inputs
        grid = _grid(margin, *ranges[margin.axis])
        y = None if inputs.nested else _exact(inputs, margin, of_node.roots, grid)
        if y is None:
            y = _estimated(margin, _values(of_node.many, margin), grid)
        found[margin.name] = grid, y
    return found


@dataclass(frozen=True, eq=False)
class _Draws:
    """Random draws of the inputs of one simulator."""

    sampler: PopulationSampler
    roots: list[Floats]

    @cached_property
    def few(self) -> list[Any]:
        """Specimens from some populations, by input; they say what an axis covers."""
        populations = len(self.roots[0])
        step = max(1, populations // 40)
        some = [root[::step] for root in self.roots]
        rng = np.random.default_rng(0)
        return list(self.sampler(some, 400, rng)[0])

    @cached_property
    def many(self) -> list[Any]:
        """Specimens from all populations, by input; densities are estimated from them."""
        rng = np.random.default_rng(1)
        return list(self.sampler(self.roots, 1600, rng)[0])


def _values(drawn: list[Any], margin: Margin) -> Floats:
    """Return the draws of a margin, shape (P, n)."""
    of_input = drawn[margin.position]
    of_element = of_input[(slice(None), slice(None), *margin.index)]
    return np.asarray(of_element, dtype=np.float64)


def _equal_weights(values: Floats) -> Floats:
    return np.full(values.shape, 1 / values.shape[1])


def _range(values: Floats) -> tuple[float, float]:
    """Return between which ends a density of draws is hardly zero."""
    return central_range(values, _equal_weights(values), tail=0.002)


def _grid(margin: Margin, low: float, high: float) -> Floats:
    """Return where a density is evaluated: between two ends, or at the whole numbers there."""
    if margin.discrete:
        first = np.floor(low)
        last = np.ceil(high)
        return np.arange(first, last + 1)
    return np.linspace(low, high, GRID_POINTS)


def _estimated(margin: Margin, values: Floats, grid: Floats) -> Floats:
    """Return densities, or shares of whole numbers, of draws, shape (P, n): (P, g)."""
    if margin.discrete:
        shares = [(values == x).mean(axis=1) for x in grid]
        return np.column_stack(shares)
    return smooth_densities(values, _equal_weights(values), grid)


def _exact(inputs: Inputs, margin: Margin, roots: list[Floats], grid: Floats) -> Floats | None:
    """Return the densities, shape (P, g), or None where PyMC has no density of one element."""
    symbols = inputs.placeholders()
    dists, *_ = inputs.rebuilt(symbols)
    dist: Any = dists[margin.position]
    x = pt.lvector("x") if margin.discrete else pt.dvector("x")
    logp = _log_density(dist, margin.index, x)
    if logp is None:
        return None
    function = compile_batched(symbols, [pt.exp(logp)], extra=[x])
    (density,) = function(*roots, grid.astype(x.dtype))
    density = np.nan_to_num(density)
    return np.broadcast_to(density, (len(roots[0]), grid.size))


def _log_density(dist: Any, index: tuple[int, ...], x: Any) -> Any:
    """Return the log-density of an element at x, shape (g,), or None where there is none."""
    if is_mvnormal(dist):
        mean, covariance = dist.owner.op.dist_params(dist.owner)
        (i,) = index
        sd = pt.sqrt(covariance[i, i])
        return pm.logp(pm.Normal.dist(mean[i], sd), x)
    # All elements at the same value
    columns = pt.shape_padright(x, dist.type.ndim)
    everywhere = columns + pt.zeros_like(dist)
    try:
        logp = pm.logp(dist, everywhere, warn_rvs=False)
    except NotImplementedError:
        return None
    if logp.type.ndim != 1 + dist.type.ndim:
        return None  # a density of all elements together
    return logp[(slice(None), *index)]
