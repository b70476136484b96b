"""Robust coordinates of a sample in which its units and correlations do not matter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from prbayes._checks import Floats
from prbayes._weighted import quantile
from prbayes.metrics.density import spread

_ITERATIONS = 2000
_CONVERGED = 1e-13
# Of variances in units of the outputs' own: below it what sets two outputs apart is 1e-5 of their
# spread, which rounding makes.
_DEPENDENT = 1e-10


@dataclass(frozen=True, eq=False)
class Whitening:
    """Coordinates ``(y - center) @ axes`` of outputs y; their median length is a normal sample's."""

    center: Floats  # (m,)
    axes: Floats  # (m, m): a coordinate a column


def whitening(sample: Floats, weights: Floats) -> Whitening:
    """Return invariant coordinates of a weighted sample, shapes (n, m), (n,), all finite.

    They are the same, to rounding, after any affine map of the outputs that can be undone.
    """
    center, unit = _units(sample, weights)
    z = (sample - center) / unit
    middle, root = _scatter(z, weights)
    z = (z - middle) @ root
    turn = _turned(z, weights)
    axes = root @ turn / unit[:, None]
    return Whitening(center + middle * unit, axes)


def _units(sample: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return a median and a spread of each output, or raise for an output without spread."""
    center = np.array([quantile(y, weights, 0.5) for y in sample.T])
    unit = np.ptp(sample, axis=0)
    unit = np.where(unit > 0, unit, 1.0)
    unit = unit * [spread((y - c) / u, weights) for y, c, u in zip(sample.T, center, unit)]
    constant = np.flatnonzero(~(unit > 0))
    if constant.size:
        raise ValueError(
            f"observed: got output {constant[0]} (counted from 0) with equal values for all "
            "specimens, expected values that differ; leave that output out"
        )
    return center, unit


def _scatter(z: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return location and inverse root of the scatter, Student's t with one degree of freedom."""
    n, m = z.shape
    middle = np.zeros(m)
    root = np.eye(m)
    for _ in range(_ITERATIONS):
        x = (z - middle) @ root
        squares = (x**2).sum(axis=-1)
        w = weights / (1 + squares)
        w /= w.sum()
        shift = w @ x
        x = x - shift
        scatter = (x * w[:, None]).T @ x * (m + 1) / (m + 1)
        values, vectors = np.linalg.eigh(scatter)
        if values[0] < _DEPENDENT**2:
            break
        middle = middle + shift @ np.linalg.inv(root)
        step = vectors / np.sqrt(values) @ vectors.T
        root = root @ step
        if np.abs(scatter - np.eye(m)).max() < _CONVERGED:
            break
    x = (z - middle) @ root
    squares = (x**2).sum(axis=-1)
    size = quantile(squares, weights, 0.5) / chi2(m).median()
    return middle, root / np.sqrt(size)


def _turned(z: Floats, weights: Floats) -> Floats:
    """Return the rotation to the axes of a second scatter, with signs by a third moment."""
    squares = (z**2).sum(axis=-1)
    w = weights * squares / (1 + squares) ** 2
    _, vectors = np.linalg.eigh((z * w[:, None]).T @ z)
    x = z @ vectors
    third = (weights / (1 + squares) ** 1.5) @ x**3
    return vectors * np.where(third < 0, -1.0, 1.0)
