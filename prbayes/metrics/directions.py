"""Directions that are well spread: unit vectors of which none is near another or its opposite."""

from __future__ import annotations

from functools import cache

import numpy as np

from prbayes._validate import Floats

# Steps of the repulsion. With twice as many the largest cosine is the same to .03 (test).
_REPULSIONS = 2000


def enough(m: int) -> int:
    """Return how many directions are enough for m outputs, at least two.

    Twice as many as a scatter's shape has parameters. Errors of means, standard deviations and
    correlations are then those of ten times as many, to 3% (`benchmarks/directions.py`).
    """
    return (m - 1) * (m + 2)


@cache
def directions(m: int, number: int, seed: int) -> Floats:
    """Return unit vectors, shape (number, m), the same for the same arguments.

    In the plane they are at equal angles. With more outputs they start from random places and repel
    each other, and each other's opposites.
    """
    if m == 1:
        return np.ones((number, 1))
    if m == 2:
        angles = np.pi * (np.arange(number) + 0.5) / number
        return np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    start = np.random.default_rng(seed).standard_normal((number, m))
    return repelled(start)


def repelled(u: Floats, steps: int = _REPULSIONS) -> Floats:
    """Return unit vectors at a low energy, the sum of -log(1 - cosine^2) over their pairs."""
    u = _of_unit_length(u)
    number, m = u.shape
    # A fraction of the distance to the next one: longer steps lead to places that hang on rounding.
    longest = 0.2 * number ** (-1 / (m - 1))
    for step in range(steps):
        cosine = u @ u.T
        np.fill_diagonal(cosine, 0.0)
        # Two that start close together are not to be the only ones that move.
        force = (cosine / (1 - cosine**2 + 1e-3)) @ u
        force -= (force * u).sum(axis=-1, keepdims=True) * u
        largest = np.linalg.norm(force, axis=-1).max()
        if largest == 0:
            break
        move = longest * (1 - step / steps) / max(largest, 1.0)
        u = _of_unit_length(u - move * force)
    return u


def _of_unit_length(u: Floats) -> Floats:
    return np.asarray(u / np.linalg.norm(u, axis=-1, keepdims=True))
