"""Modes of densities: starts of the search, Laplace approximations, and which modes differ."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from prbayes._validate import Floats
from prbayes.numerics.derivatives import central_derivatives
from prbayes.numerics.points import farthest_rows

# function of points, (S, d), that returns log-densities, (S,)
LogDensity = Callable[[Floats], Floats]


def far_apart(candidates: Floats, count: int, unit: Floats) -> Floats:
    """Return ``count`` candidates, the first and others, that are far apart in a unit, (d,)."""
    scaled = candidates / unit
    return scaled[farthest_rows(scaled, min(count, len(scaled)))] * unit


@dataclass(frozen=True, eq=False)
class Laplace:
    """A mode of a log-density with the inverse of its negative Hessian."""

    mode: Floats  # (d,)
    covariance: Floats  # (d, d)
    log_mass: float  # logarithm of the mass by Laplace's approximation
    converged: bool

    def is_apart(self, other: Laplace) -> bool:
        """Return whether another mode is more than half a standard deviation away."""
        distance = np.abs(other.mode - self.mode) / np.sqrt(np.diag(self.covariance))
        return bool(distance.max() > 0.5)


def laplace(
    log_density: LogDensity, starts: Floats, scale: Floats, steps: int = 20
) -> list[Laplace]:
    """Return the modes near starts, (M, d), by damped Newton steps with finite differences."""
    modes = np.array(starts)
    count, d = modes.shape
    sd = np.tile(0.1 * scale, (count, 1))
    lengths = np.array([2.0, 1.0, 0.5, 0.25, 0.1, 0.03, 0.01, 0.003])
    for _ in range(steps):
        value, gradient, hessian = central_derivatives(log_density, modes, 0.05 * sd)
        values, vectors = np.linalg.eigh(-hessian * np.outer(scale, scale))
        # Absolute eigenvalues give a step away from a saddle, and Newton's step at a mode.
        size = np.maximum(np.abs(values), 0.01)
        inverse = (vectors / size[:, None, :]) @ vectors.swapaxes(1, 2)
        covariance = inverse * np.outer(scale, scale)
        direction = np.einsum("mde,me->md", covariance, gradient)
        decrement = np.einsum("md,md->m", gradient, direction)
        new_sd = np.sqrt(np.einsum("mdd->md", covariance))
        ratio = new_sd / sd
        same_step = ((ratio < 2) & (ratio > 0.5)).all(axis=1)
        is_maximum = values.min(axis=1) > -0.01
        converged = same_step & (decrement < 1e-3) & is_maximum
        if converged.all():
            break
        sd = np.minimum(new_sd, 10 * sd)
        trials = modes[:, None] + lengths[:, None] * direction[:, None]
        heights = np.nan_to_num(log_density(trials.reshape(-1, d)), nan=-np.inf)
        heights = heights.reshape(count, -1)
        best = heights.argmax(axis=1)
        rises = ~converged & (heights[np.arange(count), best] > value)
        modes[rises] = trials[rises, best[rises]]
    _, log_det = np.linalg.slogdet(covariance)
    log_mass = value + log_det / 2 + d / 2 * np.log(2 * np.pi)
    results = zip(modes, covariance, log_mass.tolist(), converged.tolist(), strict=True)
    return [Laplace(*result) for result in results]


def distinct_modes(modes: list[Laplace]) -> list[Laplace]:
    """Return the modes, best ones first, that are half a standard deviation from better ones."""
    distinct: list[Laplace] = []
    for mode in sorted(modes, key=lambda mode: (not mode.converged, -mode.log_mass)):
        if all(better.is_apart(mode) for better in distinct):
            distinct.append(mode)
    return distinct
