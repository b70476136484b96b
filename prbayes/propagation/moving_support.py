"""Densities whose support moves with the hyperparameters, averaged over cells around points.

At a stored point the density of ``Uniform.dist(a, a + b)`` does not depend on a until an edge
passes it, and then it jumps: weights have no derivative where it matters. Its average over a cell
around the point, a difference of the distribution function, changes while the edge is in the cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pymc.distributions.censored import CensoredRV
from pytensor.tensor.variable import TensorVariable

from prbayes._validate import AT_ONCE, Floats, Indices
from prbayes.response.compile import compile_batched, with_leading_axis
from prbayes.response.distributions import ELLIPTICAL
from prbayes.response.inputs import Inputs


def moving_inputs(
    name: str, inputs: Inputs, components: Sequence[Floats], points: Sequence[Floats]
) -> tuple[int, ...]:
    """Return the positions of the aleatory inputs whose support moves with the hyperparameters.

    Their density is zero at a point (n, *event) for some parents, (k, *shape), and not for others.
    Raise TypeError if one is discrete, has atoms, or has no distribution function in PyMC.
    """
    symbols = inputs.placeholders()
    dists, _ = inputs.rebuilt(symbols)
    values = with_leading_axis(inputs.aleatory)
    k = len(components[0])
    moving = []
    for i, (dist, x) in enumerate(zip(dists, values, strict=True)):
        # Elliptical distributions have a positive density everywhere.
        if isinstance(dist.owner.op, ELLIPTICAL):
            continue
        outside = pt.isneginf(pm.logp(dist, x, warn_rvs=False))
        compiled = compile_batched(symbols, [outside], [x])
        step = max(1, AT_ONCE // (k * max(1, points[i][0].size)))
        for start in range(0, len(points[i]), step):
            block = points[i][start : start + step]
            (result,) = compiled(*components, block)
            # The result has an axis for the elements, or none for a vector that is drawn as a
            # whole.
            is_outside = np.broadcast_to(result, (k, *block.shape[: outside.type.ndim]))
            if np.any(is_outside.any(axis=0) & ~is_outside.all(axis=0)):
                _refuse_unaverageable(name, dist)
                moving.append(i)
                break
    return tuple(moving)


def _refuse_unaverageable(name: str, dist: TensorVariable) -> None:
    """Raise if a distribution is discrete or has atoms, or has no known distribution function."""
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
            "responses jump where an edge passes them; use propagation=prb.Fresh()"
        ) from None
    if isinstance(dist.owner.op, CensoredRV):
        raise TypeError(_moving_atoms(name, dist, "bounds"))


def _moving_atoms(name: str, dist: TensorVariable, what: str) -> str:
    return (
        f"{name}: got {dist.owner.op} with {what} that move with its hyperparameters and have "
        f"probability themselves, which no stored point has at other hyperparameters, expected "
        f"{what} that stay; use propagation=prb.Fresh()"
    )


def refuse_moving_atoms(
    name: str, inputs: Inputs, points: Sequence[Floats], population: Indices
) -> None:
    """Refuse values that repeat among the points, (n, *event), of a single population, (n,)."""
    number = population.max() + 1
    for dist, x in zip(inputs.aleatory, points, strict=True):
        if not dist.dtype.startswith("float"):
            # A moving support of discrete inputs is refused above; other values may repeat.
            continue
        for column in x.reshape(len(x), -1).T:
            _, value, repeated = np.unique(column, return_inverse=True, return_counts=True)
            pairs = np.unique(value * number + population)
            n_populations = np.bincount(pairs // number)
            is_atom = (repeated > 1) & (n_populations == 1)
            # Rounding makes continuous values far in the tails equal, but less than 1 % of the
            # points.
            if is_atom.sum() >= 8 and repeated[is_atom].sum() > 0.01 * column.size:
                raise TypeError(_moving_atoms(name, dist, "values"))


def cells_around(points: Floats, reach: int) -> tuple[Floats, Floats]:
    """Return the lower and upper ends of a cell around each point, (n, *event), by element.

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
        # The cells of the first and last points are symmetric around these points.
        low = np.where(below < 0, 2 * ordered - high, low)
        high = np.where(above > last, 2 * ordered - low, high)
        lower[order, k] = low
        upper[order, k] = high
    return lower.reshape(points.shape), upper.reshape(points.shape)


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
