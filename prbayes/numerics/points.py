"""Points of the unit cube, from which populations and designs are made."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from prbayes._validate import Floats


def inside(points: Floats) -> Floats:
    """Return points of the unit cube that keep off 0 and 1, where quantiles may be infinite.

    A point of 10^11 is ever closer; any distance from 1e-16 to 1e-9 moves only specimens that are
    rarer than one in 1e9.
    """
    return np.clip(points, 1e-12, 1 - 1e-12)


def sobol(n: int, dimensions: int, seed: int) -> Floats:
    """Return n scrambled Sobol points in the open unit cube, shape (n, dimensions).

    Parameters
    ----------
    n, dimensions, seed : int

    References
    ----------
    .. [1] Owen, A. B. (1998), Scrambling Sobol and Niederreiter-Xing points,
       doi:10.1006/jcom.1998.0487.

    Examples
    --------
    >>> sobol(4, 1, 0).shape
    (4, 1)
    """
    from scipy.stats import qmc  # takes longer to import than the whole package

    engine = qmc.Sobol(dimensions, scramble=True, rng=np.random.default_rng(seed))
    if n == 1:
        points = engine.random(1)
    else:
        power = int(np.ceil(np.log2(n)))
        points = engine.random_base2(power)[:n]
    return inside(points)


def monte_carlo(n: int, dimensions: int, seed: int) -> Floats:
    """Return n independent random points in the open unit cube, shape (n, dimensions).

    For `Resimulated`.

    Parameters
    ----------
    n, dimensions, seed : int

    References
    ----------
    .. [1] Oh et al. (2019), doi:10.1007/s00158-019-02288-6, whose case study has a million of them.

    Examples
    --------
    >>> monte_carlo(4, 1, 0).shape
    (4, 1)
    """
    points = np.random.default_rng(seed).random((n, dimensions))
    return inside(points)


def points_from(points: object) -> Callable[[int, int, int], Floats]:
    """Return the function that makes points, from its name or from itself.

    Raises
    ------
    TypeError, ValueError
        If it is neither.
    """
    named = {"sobol": sobol, "monte_carlo": monte_carlo}
    if isinstance(points, str):
        if points not in named:
            raise ValueError(
                f'points: got {points!r:.60}, expected "sobol", "monte_carlo" or a function '
                "(n, dimensions, seed) -> points"
            )
        return named[points]
    if not callable(points):
        raise TypeError(
            f'points: got {type(points).__name__}, expected "sobol", "monte_carlo" or a function '
            "(n, dimensions, seed) -> points"
        )
    return points


def base_points(
    shapes: Sequence[tuple[int, ...]],
    n: int,
    seed: int,
    points: Callable[[int, int, int], Floats] = sobol,
) -> tuple[Floats, list[Floats]]:
    """Return a spare coordinate, (n,), and points of shape (n, *event) for each event shape."""
    sizes = [int(np.prod(s, dtype=int)) for s in shapes]
    u = points(n, 1 + sum(sizes), seed)
    edges = np.cumsum([1, *sizes])
    by_input = []
    for (start, end), shape in zip(pairwise(edges), shapes, strict=True):
        own = u[:, start:end]
        own = own.reshape(n, *shape)
        by_input.append(own.copy())
    spare = u[:, 0]
    return spare.copy(), by_input
