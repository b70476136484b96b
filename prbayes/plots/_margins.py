"""The aleatory inputs of a model by name, and the densities of their margins at given hyperparameters."""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pytensor.tensor.variable import TensorVariable

from prbayes._checks import Floats
from prbayes.model.evaluator import Evaluator
from prbayes.plots._curves import central_range, densities, typical_bandwidth
from prbayes.response.compilation import compile_batched
from prbayes.response.distributions import PopulationSampler, is_mvnormal

_SPECIMENS, _SOME = 400, 40  # random draws of inputs, never of responses, and from how many populations
_TAIL = 0.002


@dataclass(frozen=True, eq=False)
class Margin:
    """One number that varies from specimen to specimen.

    Attributes
    ----------
    name : str
        That of the distribution if it has one, or of the response's argument; with the index of an element.
    dist : variable
        The ``.dist()``.
    node, position : int
        Which simulator has it, and which of its aleatory inputs it is.
    index : tuple of int
        Element of a multivariate input.
    """

    name: str
    dist: TensorVariable
    node: int
    position: int
    index: tuple[int, ...]

    @property
    def discrete(self) -> bool:
        """Whether it takes whole numbers only."""
        return not self.dist.dtype.startswith("float")


def margins(evaluator: Evaluator) -> list[Margin]:
    """Return the margins of all aleatory inputs; an input of several simulators counts once."""
    found: list[Margin] = []
    for k, node in enumerate(evaluator.nodes):
        inputs, arguments = node.bound.inputs, _arguments(node.bound.responses.function)
        for position, dist in enumerate(inputs.aleatory):
            if any(m.dist is dist for m in found):
                continue
            place = inputs.arguments.index(position)
            name = dist.name or (arguments[place] if place < len(arguments) else f"input {place + 1}")
            if name in {m.name.partition("[")[0] for m in found} | {str(v.name) for v in evaluator.model.basic_RVs}:
                name = f"{name} of {node.name}"
            for index in np.ndindex(inputs.event_shapes[position]):
                element = f"{name}[{','.join(map(str, index))}]" if index else name
                found.append(Margin(element, dist, k, position, index))
    return found


def _arguments(function: Any) -> list[str]:
    """Return the names of a response's arguments, as far as there are any."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return []
    plain = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return [p.name for p in parameters if p.kind in plain]


def chosen(known: list[Margin], inputs: Iterable[Any] | None) -> list[Margin]:
    """Return those of the margins that a user asked for, by name, by the name without index, or as ``.dist()``.

    Raises
    ------
    KeyError
        If there is no such input.
    """
    if inputs is None:
        return known
    wanted = [inputs] if isinstance(inputs, str | TensorVariable) else list(inputs)
    found: list[Margin] = []
    for x in wanted:
        new = [m for m in known if (x in (m.name, m.name.partition("[")[0]) if isinstance(x, str) else m.dist is x)]
        if not new:
            raise KeyError(f"inputs: got {x}, expected some of {[m.name for m in known]}, or their .dist() objects")
        found += [m for m in new if m not in found]
    return found


def margin_densities(evaluator: Evaluator, wanted: list[Margin], thetas: Floats) -> dict[str, tuple[Floats, Floats]]:
    """Return by margin a grid, shape (g,), and the densities at thetas, shape (P, g); probabilities if it is discrete.

    They are exact where the input has an elementwise density or is a multivariate normal, and else kernel densities
    of random draws. No response is computed.
    """
    out: dict[str, tuple[Floats, Floats]] = {}
    for k in sorted({m.node for m in wanted}):
        inputs, here = evaluator.nodes[k].bound.inputs, [m for m in wanted if m.node == k]
        roots = evaluator.roots(thetas, k)
        some = [r[:: max(1, len(thetas) // _SOME)] for r in roots]
        sampler = PopulationSampler(inputs)
        drawn, _ = sampler(some, _SPECIMENS, np.random.default_rng(0))
        for m in here:
            values = _element(drawn[m.position], m.index)
            low, high = central_range(values, np.full(values.shape, 1 / values.shape[1]), _TAIL)
            grid = np.arange(np.floor(low), np.ceil(high) + 1) if m.discrete else np.linspace(low, high, 257)
            exact = None if inputs.nested else _exact(evaluator, m, roots, grid)
            if exact is None:
                every, _ = sampler(roots, 4 * _SPECIMENS, np.random.default_rng(1))
                values = _element(every[m.position], m.index)
                weights = np.full(values.shape, 1 / values.shape[1])
                exact = (
                    np.array([[(row == x).mean() for x in grid] for row in values])
                    if m.discrete
                    else densities(values, weights, grid, typical_bandwidth(values[:_SOME], weights[:_SOME]))
                )
            out[m.name] = grid, exact
    return {m.name: out[m.name] for m in wanted}


def _element(drawn: Any, index: tuple[int, ...]) -> Floats:
    return np.asarray(drawn[(slice(None), slice(None), *index)], dtype=np.float64)


def _exact(evaluator: Evaluator, margin: Margin, roots: list[Floats], grid: Floats) -> Floats | None:
    """Return the densities, shape (P, g), or None where PyMC has no density of one element."""
    inputs = evaluator.nodes[margin.node].bound.inputs
    symbols = inputs.placeholders()
    dist: Any = inputs.rebuilt(symbols)[0][margin.position]
    x = pt.lvector("x") if margin.discrete else pt.dvector("x")
    try:
        if is_mvnormal(dist):
            mean, covariance = dist.owner.op.dist_params(dist.owner)
            (i,) = margin.index
            logp = pm.logp(pm.Normal.dist(mean[i], pt.sqrt(covariance[i, i])), x)
        else:
            columns = x[(slice(None), *(None,) * dist.type.ndim)]
            logp = pm.logp(dist, columns + pt.zeros_like(dist), warn_rvs=False)
            if logp.type.ndim != 1 + dist.type.ndim:
                return None  # a density of all elements together
            logp = logp[(slice(None), *margin.index)]
    except NotImplementedError:
        return None
    (found,) = compile_batched(symbols, [pt.exp(logp)], extra=[x])(*roots, grid.astype(x.dtype))
    return np.broadcast_to(np.nan_to_num(found), (len(roots[0]), grid.size))
