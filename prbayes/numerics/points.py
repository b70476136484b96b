"""Points of the unit cube for populations and designs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from prbayes._validate import Floats, Indices, Shape


def inside(points: Floats) -> Floats:
    """Return points of the unit cube away from 0 and 1, where quantiles may be infinite."""
    return np.clip(points, 1e-12, 1 - 1e-12)


def sobol(n: int, dimensions: int, seed: int) -> Floats:
    """Return n scrambled Sobol points in the open unit cube, shape (n, dimensions).

    Source: Owen (1998), Scrambling Sobol and Niederreiter-Xing points, doi:10.1006/jcom.1998.0487.
    """
    from scipy.stats import qmc  # imported here, because it takes longer than the whole package

    engine = qmc.Sobol(dimensions, scramble=True, rng=np.random.default_rng(seed))
    points = engine.random(1) if n == 1 else engine.random_base2(int(np.ceil(np.log2(n))))[:n]
    return inside(points)


def lattice(place: Indices, count: Indices, dimensions: int) -> Floats:
    """Return points of lattices in the unit cube, (n, dimensions), at places 0 to count - 1.

    The first coordinates are place / count. The others are multiples of powers of the root of
    x^d = x + 1, a generalised golden ratio. Source: Niederreiter (1992), Random number generation
    and quasi-Monte Carlo methods, doi:10.1137/1.9781611970081, ch. 3 and 5.

    Integrals of narrow densities are more accurate than with scrambled points.
    """
    root = 2.0
    for _ in range(60):
        root = (1.0 + root) ** (1.0 / max(dimensions, 2))
    steps = root ** -np.arange(1.0, dimensions)
    return np.column_stack([place / count, (place[:, None] * steps) % 1.0])


def farthest_rows(points: Floats, count: int, squares: Floats | None = None) -> list[int]:
    """Return rows of points, (n, d), selected one by one: each is farthest from those before.

    ``squares``, (n,), are squared distances from earlier points; without them row 0 is the first.
    """
    squares = np.full(len(points), np.inf) if squares is None else squares
    rows: list[int] = []
    while len(rows) < count:
        rows.append(int(np.argmax(squares)))
        squares = np.minimum(squares, ((points - points[rows[-1]]) ** 2).sum(axis=1))
    return rows


def monte_carlo(n: int, dimensions: int, seed: int) -> Floats:
    """Return n independent random points in the open unit cube, shape (n, dimensions)."""
    return inside(np.random.default_rng(seed).random((n, dimensions)))


def points_from(points: object) -> Callable[[int, int, int], Floats]:
    """Return the function of points, from its name or itself; raise if it is neither."""
    by_name = {"sobol": sobol, "monte_carlo": monte_carlo}
    expected = 'expected "sobol", "monte_carlo" or a function (n, dimensions, seed) -> points'
    if isinstance(points, str):
        if points not in by_name:
            raise ValueError(f"points: got {points!r:.60}, {expected}")
        return by_name[points]
    if not callable(points):
        raise TypeError(f"points: got {type(points).__name__}, {expected}")
    return points


def base_points(
    shapes: Sequence[Shape],
    n: int,
    seed: int,
    points: Callable[[int, int, int], Floats] = sobol,
) -> tuple[Floats, list[Floats]]:
    """Return a spare coordinate, (n,), and points of shape (n, *event) for each event shape."""
    sizes = [int(np.prod(s, dtype=int)) for s in shapes]
    u = points(n, 1 + sum(sizes), seed)
    edges = np.cumsum([1, *sizes])
    by_input = [
        u[:, start:end].reshape(n, *shape).copy()
        for (start, end), shape in zip(pairwise(edges), shapes, strict=True)
    ]
    return u[:, 0].copy(), by_input
