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
from prbayes.response.distributions import is_elliptical
from prbayes.response.inputs import Inputs

# Probability of a cell below which it is the density at the point times the width: the difference
# of two distribution functions, each rounded to 1e-16, has lost half of its digits there.
_RESOLVED = 1e-8
# Share of points with values that only their own population has, and number of these values, above
# which they are no accident: continuous ones meet by rounding, far out.
_NO_ROUNDING = 0.01
_FEW = 8


@dataclass(frozen=True)
class Cells:
    """Cells around points of an input, one for each point."""

    lower: Floats  # (n, *event)
    upper: Floats  # (n, *event)


def moving_inputs(
    name: str, inputs: Inputs, components: Sequence[Floats], points: Sequence[Floats]
) -> tuple[int, ...]:
    """Return which aleatory inputs have a support that moves, by their positions.

    That is, those whose density is zero at some point for some hyperparameters, and is not for
    others.

    Parameters
    ----------
    name : str
        The simulator's, for messages.
    inputs : Inputs
    components : sequence of ndarray, shapes (k, *shape)
        Values of the roots.
    points : sequence of ndarray, shapes (n, *event)
        Of each aleatory input.

    Raises
    ------
    TypeError
        If one is discrete, or PyMC does not know its distribution function.
    """
    symbols = inputs.placeholders()
    dists, _ = inputs.rebuilt(symbols)
    given = with_leading_axis(inputs.aleatory)
    moving = []
    for i, (dist, x) in enumerate(zip(dists, given, strict=True)):
        if is_elliptical(dist):  # positive everywhere
            continue
        outside = pt.isneginf(pm.logp(dist, x, warn_rvs=False))
        compiled = compile_batched(symbols, [outside], [x])
        if _is_outside_for_some(compiled, outside.type.ndim, components, points[i]):
            _require_distribution_function(name, dist)
            _refuse_atoms(name, dist)
            moving.append(i)
    return tuple(moving)


def _is_outside_for_some(
    compiled: Any, ndim: int, components: Sequence[Floats], points: Floats
) -> bool:
    """Return whether a point is outside the support of some populations, and inside of others."""
    k = len(components[0])
    step = max(1, AT_ONCE // (k * max(1, points[0].size)))
    for start in range(0, len(points), step):
        some = points[start : start + step]
        (found,) = compiled(*components, some)
        # One of each element, or one of a vector that is drawn as a whole.
        at_each = np.broadcast_to(found, (k, *some.shape[:ndim]))
        if np.any(at_each.any(axis=0) & ~at_each.all(axis=0)):
            return True
    return False


def _require_distribution_function(name: str, dist: TensorVariable) -> None:
    kind = dist.owner.op
    refused = (
        f"{name}: got {kind} with a support that moves with its hyperparameters, expected one that "
        "stays, or "
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


def _refuse_atoms(name: str, dist: TensorVariable) -> None:
    """Refuse bounds that have probability themselves, and move."""
    if isinstance(dist.owner.op, CensoredRV):
        raise TypeError(_moving_atoms(name, dist, "bounds"))


def _moving_atoms(name: str, dist: TensorVariable, what: str) -> str:
    return (
        f"{name}: got {dist.owner.op} with {what} that move with its hyperparameters and have "
        f"probability themselves, which no stored point has at other hyperparameters, expected "
        f"{what} that stay; use propagation=prb.Resimulated() or prb.Fresh()"
    )


def refuse_moving_atoms(
    name: str, inputs: Inputs, points: Sequence[Floats], which: NDArray[np.intp]
) -> None:
    """Refuse continuous inputs that have values with probability themselves, which move.

    A value that comes again and again, but from one population only, is such a one.

    Parameters
    ----------
    name : str
        The simulator's, for messages.
    inputs : Inputs
    points : sequence of ndarray, shapes (n, *event)
        Of each aleatory input.
    which : ndarray, shape (n,)
        The population that each point was drawn from.
    """
    for dist, x in zip(inputs.aleatory, points, strict=True):
        if not dist.dtype.startswith("float"):
            continue  # one whose support moves is refused, and in others no value does
        for column in x.reshape(len(x), -1).T:
            if _share_of_own_atoms(column, which) > _NO_ROUNDING:
                raise TypeError(_moving_atoms(name, dist, "values"))


def _share_of_own_atoms(column: Floats, which: NDArray[np.intp]) -> float:
    """Return the share of points whose value comes again, and from one population only.

    Zero if these are of few populations.
    """
    _, value, repeated = np.unique(column, return_inverse=True, return_counts=True)
    number = which.max() + 1
    pairs = np.unique(value * number + which)
    n_populations = np.bincount(pairs // number)
    own = (repeated > 1) & (n_populations == 1)
    if own.sum() < _FEW:
        return 0.0
    return float(repeated[own].sum() / column.size)


def cells_around(points: Floats, reach: int) -> Cells:
    """Return a cell around each point, of each element by itself.

    Parameters
    ----------
    points : ndarray, shape (n, *event)
    reach : int
        How many neighbours a cell reaches on either side: with one it ends half way to the next.

    Returns
    -------
    Cells
    """
    flat = points.reshape(len(points), -1)
    lower = np.empty_like(flat)
    upper = np.empty_like(flat)
    for k, column in enumerate(flat.T):
        order = np.argsort(column, kind="stable")
        ordered = column[order]
        both = ordered[1:] + ordered[:-1]
        half_way = 0.5 * both
        last = half_way.size - 1
        rank = np.arange(column.size)
        below = rank - reach
        above = rank + reach - 1
        low = half_way[np.maximum(below, 0)]
        high = half_way[np.minimum(above, last)]
        # The outermost points are in the middle of theirs.
        mirrored = 2 * ordered - high
        low = np.where(below < 0, mirrored, low)
        mirrored = 2 * ordered - low
        high = np.where(above > last, mirrored, high)
        lower[order, k] = low
        upper[order, k] = high
    shape = points.shape
    return Cells(lower.reshape(shape), upper.reshape(shape))


def averaged_log_density(dist: TensorVariable, x: Any, lower: Any, upper: Any) -> TensorVariable:
    """Return the logarithm of the mean density between two ends, elementwise.

    The density at the point itself where the probability between them is too small for a
    difference.
    """
    at_upper = pm.logcdf(dist, upper, warn_rvs=False)
    at_lower = pm.logcdf(dist, lower, warn_rvs=False)
    probability = pt.exp(at_upper) - pt.exp(at_lower)
    resolved = (probability > _RESOLVED) & (upper > lower)
    width = upper - lower
    mean = pt.switch(resolved, probability / width, 1.0)
    at_point = pm.logp(dist, x, warn_rvs=False)
    return pt.switch(resolved, pt.log(mean), at_point)
