"""Densities whose support moves with the hyperparameters, averaged over cells around points.

At a stored point the density of ``Uniform.dist(a, a + b)`` does not depend on a until an edge
passes it, and then it jumps: weights have no derivative where it matters. Its average over a cell
around the point, a difference of the distribution function, changes while the edge is in the cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from numpy.typing import NDArray
from pymc.distributions.censored import CensoredRV
from pytensor.tensor.variable import TensorVariable

from prbayes._validate import AT_ONCE, Floats
from prbayes.response.compile import compile_batched, with_leading_axis
from prbayes.response.distributions import ELLIPTICAL
from prbayes.response.inputs import Inputs


@dataclass(frozen=True)
class Cells:
    """Cells around points of an input, one for each point."""

    lower: Floats  # (n, *event)
    upper: Floats  # (n, *event)


def moving_inputs(
    name: str, inputs: Inputs, components: Sequence[Floats], points: Sequence[Floats]
) -> tuple[int, ...]:
    """Return the positions of the aleatory inputs whose support moves with the hyperparameters.

    Their density is zero at a point (n, *event) for some roots, (k, *shape), and not for others.

    Raises
    ------
    TypeError
        If one is discrete or has atoms, or PyMC does not know its distribution function.
    """
    symbols = inputs.placeholders()
    dists, _ = inputs.rebuilt(symbols)
    values = with_leading_axis(inputs.aleatory)
    moving = []
    for i, (dist, x) in enumerate(zip(dists, values, strict=True)):
        if isinstance(dist.owner.op, ELLIPTICAL):  # positive everywhere
            continue
        outside = pt.isneginf(pm.logp(dist, x, warn_rvs=False))
        compiled = compile_batched(symbols, [outside], [x])
        if _support_moves(compiled, outside.type.ndim, components, points[i]):
            _require_distribution_function(name, dist)
            if isinstance(dist.owner.op, CensoredRV):
                raise TypeError(_moving_atoms(name, dist, "bounds"))
            moving.append(i)
    return tuple(moving)


def _support_moves(compiled: Any, ndim: int, components: Sequence[Floats], points: Floats) -> bool:
    """Return whether a point is outside the support of some populations, and inside of others."""
    k = len(components[0])
    step = max(1, AT_ONCE // (k * max(1, points[0].size)))
    for start in range(0, len(points), step):
        block = points[start : start + step]
        (outside,) = compiled(*components, block)
        # By element, or for a vector that is drawn as a whole.
        is_outside = np.broadcast_to(outside, (k, *block.shape[:ndim]))
        if np.any(is_outside.any(axis=0) & ~is_outside.all(axis=0)):
            return True
    return False


def _require_distribution_function(name: str, dist: TensorVariable) -> None:
    """Raise if a distribution is discrete, or PyMC does not know its distribution function."""
    refused = (
        f"{name}: got {dist.owner.op} with a support that moves with its hyperparameters, expected "
        "one that stays, or "
    )
    if not dist.dtype.startswith("float"):
        raise TypeError(f"{refused}a continuous distribution; use propagation=prb.Fresh()")
    try:
        pm.logcdf(dist, pt.zeros_like(dist), warn_rvs=False)
    except (NotImplementedError, TypeError, ValueError):
        raise TypeError(
            f"{refused}one whose distribution function PyMC knows, since the weights of stored "
            "responses jump where an edge passes them; use propagation=prb.Resimulated() or "
            "prb.Fresh()"
        ) from None


def _moving_atoms(name: str, dist: TensorVariable, what: str) -> str:
    return (
        f"{name}: got {dist.owner.op} with {what} that move with its hyperparameters and have "
        f"probability themselves, which no stored point has at other hyperparameters, expected "
        f"{what} that stay; use propagation=prb.Resimulated() or prb.Fresh()"
    )


def refuse_moving_atoms(
    name: str, inputs: Inputs, points: Sequence[Floats], population: NDArray[np.intp]
) -> None:
    """Refuse continuous inputs that have values with probability themselves, which move.

    Such a value repeats among the points, (n, *event), of a single population, numbers (n,).
    """
    for dist, x in zip(inputs.aleatory, points, strict=True):
        if not dist.dtype.startswith("float"):
            continue  # one whose support moves is refused, and in others no value does
        for column in x.reshape(len(x), -1).T:
            # Continuous values repeat by rounding, far out: in less than 1 % of the points.
            if _share_of_atoms(column, population) > 0.01:
                raise TypeError(_moving_atoms(name, dist, "values"))


def _share_of_atoms(column: Floats, population: NDArray[np.intp]) -> float:
    """Return the share of points whose value repeats in one population only; zero if few do."""
    _, value, repeated = np.unique(column, return_inverse=True, return_counts=True)
    number = population.max() + 1
    pairs = np.unique(value * number + population)
    n_populations = np.bincount(pairs // number)
    is_atom = (repeated > 1) & (n_populations == 1)
    if is_atom.sum() < 8:
        return 0.0
    return float(repeated[is_atom].sum() / column.size)


def cells_around(points: Floats, reach: int) -> Cells:
    """Return a cell around each point, (n, *event), by element.

    A cell reaches ``reach`` neighbours on either side: with one it ends half way to the next.
    """
    flat = points.reshape(len(points), -1)
    lower = np.empty_like(flat)
    upper = np.empty_like(flat)
    for k, column in enumerate(flat.T):
        order = np.argsort(column, kind="stable")
        ordered = column[order]
        half_way = 0.5 * (ordered[1:] + ordered[:-1])
        last = half_way.size - 1
        rank = np.arange(column.size)
        below = rank - reach
        above = rank + reach - 1
        low = half_way[np.maximum(below, 0)]
        high = half_way[np.minimum(above, last)]
        # The outermost points are in the middle of their cells.
        low = np.where(below < 0, 2 * ordered - high, low)
        high = np.where(above > last, 2 * ordered - low, high)
        lower[order, k] = low
        upper[order, k] = high
    shape = points.shape
    return Cells(lower.reshape(shape), upper.reshape(shape))


def averaged_log_density(dist: TensorVariable, x: Any, lower: Any, upper: Any) -> TensorVariable:
    """Return the logarithm of the mean density between two ends, elementwise.

    Below a probability of 1e-8 the difference of two distribution functions, each rounded to 1e-16,
    has lost half of its digits: the density at the point takes its place.
    """
    at_upper = pm.logcdf(dist, upper, warn_rvs=False)
    at_lower = pm.logcdf(dist, lower, warn_rvs=False)
    probability = pt.exp(at_upper) - pt.exp(at_lower)
    resolved = (probability > 1e-8) & (upper > lower)
    width = upper - lower
    mean = pt.switch(resolved, probability / width, 1.0)
    at_point = pm.logp(dist, x, warn_rvs=False)
    return pt.switch(resolved, pt.log(mean), at_point)
