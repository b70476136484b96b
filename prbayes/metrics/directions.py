"""Directions that are well spread: unit vectors of which none is near another or its opposite."""

from __future__ import annotations

from functools import cache

import numpy as np

from prbayes._checks import Floats

# Steps of the repulsion. Half and twice as many change the largest cosine by little (test).
_STEPS = 400


def default_number(m: int) -> int:
    """Return how many directions are enough for m outputs (`benchmarks/directions.py`)."""
    return m * (m + 1)


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
    u = np.random.default_rng(seed).standard_normal((number, m))
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    for step in range(_STEPS):
        cosine = u @ u.T
        np.fill_diagonal(cosine, 0.0)
        # The gradient of the sum of -log(1 - cosine^2).
        force = (cosine / (1 - cosine**2 + 1e-3)) @ u
        along = (force * u).sum(axis=-1, keepdims=True)
        force -= along * u
        size = np.linalg.norm(force, axis=-1).max()
        if size == 0:
            break
        u -= 0.3 * (1 - step / _STEPS) * force / size
        u /= np.linalg.norm(u, axis=-1, keepdims=True)
    u.flags.writeable = False
    return u
