"""Noise that repeats: numbers as if random, which are always the same for the same input."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats

# Increment and multipliers of splitmix64: Steele, Lea and Flood (2014),
# doi:10.1145/2660193.2660195.
_INCREMENT = np.uint64(0x9E3779B97F4A7C15)
_MULTIPLIERS = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)


def hashed_rows(x: Floats, random_seed: int) -> NDArray[np.uint64]:
    """Return a number for each row of x, the same for the same row, and else as if random.

    The bits of the rows go through the finalizer of splitmix64.

    Parameters
    ----------
    x : ndarray, shape (n, d)
    random_seed : int

    Returns
    -------
    ndarray of uint64, shape (n,)

    References
    ----------
    .. [1] Steele, G. L., D. Lea and C. H. Flood (2014), Fast splittable pseudorandom number
       generators, doi:10.1145/2660193.2660195.
    """
    first, second = _MULTIPLIERS
    h = np.full(len(x), random_seed, dtype=np.uint64)
    # Adding 0.0 makes -0.0 the number that it equals.
    for column in np.ascontiguousarray(x.T + 0.0):
        bits = column.view(np.uint64)
        h = (h ^ bits) + _INCREMENT
        h = (h ^ (h >> np.uint64(30))) * first
        h = (h ^ (h >> np.uint64(27))) * second
        h = h ^ (h >> np.uint64(31))
    return h
