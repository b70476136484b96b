"""Modes of densities: starts of the search, Laplace approximations, and which modes differ."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from prbayes._validate import Arrays, Bools, Floats, Indices
from prbayes.numerics.derivatives import central_derivatives
from prbayes.numerics.points import farthest_rows

# function of points, (S, d), that returns log-densities, (S,)
LogDensity = Callable[[Floats], Floats]
# function of points, (A, n, d), and numbers, (A,), that returns their log-densities, (A, n), in the
# densities with these numbers
RowDensity = Callable[[Floats, Indices], Floats]


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
    return laplace_each(
        of_one(log_density), starts, np.zeros(len(starts), dtype=np.intp), scale, steps
    )


def of_one(log_density: LogDensity) -> RowDensity:
    """Return a density as the only one of a `RowDensity`."""

    def log_densities(points: Floats, numbers: Indices) -> Floats:
        return log_density(points.reshape(-1, points.shape[2])).reshape(points.shape[:2])

    return log_densities


def laplace_each(
    log_density: RowDensity, starts: Floats, number: Indices, scale: Floats, steps: int = 20
) -> list[Laplace]:
    """Return the modes near starts, (M, d), of the densities with these numbers, (M,).

    The steps of a density end when all of its starts have converged.
    """
    modes = np.array(starts)
    count, d = modes.shape
    sd = np.tile(0.1 * scale, (count, 1))
    height, covariances = np.empty(count), np.empty((count, d, d))
    is_done = np.zeros(count, dtype=bool)
    lengths = np.array([2.0, 1.0, 0.5, 0.25, 0.1, 0.03, 0.01, 0.003])
    rows = np.arange(count)

    def of_rows(points: Floats) -> Floats:
        return log_density(points, number[rows])

    for _ in range(steps):
        height[rows], gradient, hessian = central_derivatives(of_rows, modes[rows], 0.05 * sd[rows])
        covariances[rows], is_maximum = _inverse_curvature(hessian, scale)
        direction = np.einsum("mde,me->md", covariances[rows], gradient)
        decrement = np.einsum("md,md->m", gradient, direction)
        new_sd = np.sqrt(np.einsum("mdd->md", covariances[rows]))
        ratio = new_sd / sd[rows]
        same_step = ((ratio < 2) & (ratio > 0.5)).all(axis=1)
        is_done[rows] = same_step & (decrement < 1e-3) & is_maximum
        is_open = (np.bincount(number, ~is_done) > 0)[number[rows]]
        if not is_open.any():
            break
        rows = rows[is_open]
        sd[rows] = np.minimum(new_sd[is_open], 10 * sd[rows])
        trials = modes[rows, None] + lengths[:, None] * direction[is_open, None]
        heights = np.nan_to_num(of_rows(trials), nan=-np.inf)
        best = heights.argmax(axis=1)
        rises = ~is_done[rows] & (heights.max(axis=1) > height[rows])
        modes[rows[rises]] = trials[rises, best[rises]]
    _, log_det = np.linalg.slogdet(covariances)
    log_mass = height + log_det / 2 + d / 2 * np.log(2 * np.pi)
    results = zip(modes, covariances, log_mass.tolist(), is_done.tolist(), strict=True)
    return [Laplace(*result) for result in results]


def _inverse_curvature(hessian: Floats, scale: Floats) -> tuple[Floats, Bools]:
    """Return the inverse of negative Hessians, (M, d, d), and which are those of maxima, (M,).

    Absolute eigenvalues give a step away from a saddle, and Newton's step at a mode.
    """
    units = np.outer(scale, scale)
    values, vectors = np.linalg.eigh(-hessian * units)
    size = np.maximum(np.abs(values), 0.01)
    inverse = (vectors / size[:, None, :]) @ vectors.swapaxes(1, 2)
    return inverse * units, values.min(axis=1) > -0.01


def distinct_modes(modes: list[Laplace]) -> list[Laplace]:
    """Return the modes, best ones first, that are half a standard deviation from better ones."""
    distinct: list[Laplace] = []
    for mode in sorted(modes, key=lambda mode: (not mode.converged, -mode.log_mass)):
        if all(better.is_apart(mode) for better in distinct):
            distinct.append(mode)
    return distinct


def modes_each(log_density: RowDensity, starts: Arrays, scale: Floats) -> list[list[Laplace]]:
    """Return distinct modes of each density from its starts, (M, d), the largest masses first.

    All densities have one start, or all have several. Modes with less than e^-10 of the largest
    mass are left out.
    """
    if max(map(len, starts)) > 1:
        # Continue once from starts that are on the way to the same mode.
        rough = _laplace_from(log_density, starts, scale, 6)
        starts = [np.stack([mode.mode for mode in distinct_modes(modes)]) for modes in rough]
    result = []
    for candidates in _laplace_from(log_density, starts, scale, 20):
        highest = max(mode.log_mass for mode in candidates)
        modes = [
            mode
            for i, mode in enumerate(distinct_modes(candidates))
            if mode.log_mass >= highest - 10 and (mode.converged or i == 0)
        ]
        result.append(modes)  # empty where populations that shrink to a point have no mass
    return result


def _laplace_from(
    log_density: RowDensity, starts: Arrays, scale: Floats, steps: int
) -> list[list[Laplace]]:
    """Return the modes near the starts of each density."""
    sizes = [len(of_density) for of_density in starts]
    number = np.repeat(np.arange(len(starts)), sizes)
    modes = iter(laplace_each(log_density, np.concatenate(starts), number, scale, steps))
    return [list(islice(modes, size)) for size in sizes]


def ridges(log_density: LogDensity, modes: Sequence[Laplace]) -> list[Laplace]:
    """Return the ridges halfway between the first mode and the others.

    Those with less than e^-10 of the largest mass of a mode are left out.
    """
    result = []
    for mode in modes[1:]:
        try:
            ridge = ridge_between(log_density, modes[0], mode)
        except (ValueError, np.linalg.LinAlgError):
            continue  # because the density is zero near the ridge
        if ridge.log_mass > max(mode.log_mass for mode in modes) - 10:
            result.append(ridge)
    return result


def ridge_between(log_density: LogDensity, first: Laplace, second: Laplace) -> Laplace:
    """Return a normal approximation around the maximum on the plane halfway between two modes.

    Along the line through the modes the density counts as uniform.
    """
    difference = second.mode - first.mode
    middle = (first.mode + second.mode) / 2
    scale = np.sqrt(np.diag(first.covariance + second.covariance) / 2)
    # (d, d - 1): basis of the plane, orthogonal in units of the modes' standard deviations
    direction = (difference / scale)[None]
    _, _, axes = np.linalg.svd(direction)
    plane = axes[1:].T * scale[:, None]
    size = plane.shape[1]

    def on_plane(u: Floats) -> Floats:
        return log_density(middle + u @ plane.T)

    (top,) = laplace(on_plane, np.zeros((1, size)), np.ones(size))
    along = np.outer(difference, difference) / 12  # variance of a uniform density
    covariance = plane @ top.covariance @ plane.T + along
    _, log_det_on_plane = np.linalg.slogdet(2 * np.pi * top.covariance)
    _, log_det = np.linalg.slogdet(2 * np.pi * covariance)
    height = top.log_mass - log_det_on_plane / 2
    log_mass = float(height + log_det / 2)
    return Laplace(middle + plane @ top.mode, covariance, log_mass, top.converged)


def rows_by_mode(points: Floats) -> list[Indices]:
    """Return the rows of each mode of points, (n, d): one array unless a valley separates them.

    The points are split at the valley of the density of an element, or of a principal component,
    that lies a quarter, and five standard errors of the estimate, below its maxima on both sides. A
    mode has at least a fiftieth of the points.
    """
    fewest = max(len(points) // 50, 2 * points.shape[1])

    def split(rows: Indices) -> list[Indices]:
        if len(rows) < 2 * fewest:
            return [rows]
        standard = points[rows] - points[rows].mean(axis=0)
        standard /= np.maximum(standard.std(axis=0), 1e-300)
        _, _, axes = np.linalg.svd(standard, full_matrices=False)
        valleys = [deepest_valley(x, fewest) for x in np.hstack([standard, standard @ axes.T]).T]
        depth, is_low = max(valleys, key=lambda valley: valley[0])
        if depth < 5:
            return [rows]
        return [*split(rows[is_low]), *split(rows[~is_low])]

    return split(np.arange(len(points)))


def deepest_valley(x: Floats, fewest: int) -> tuple[float, Bools]:
    """Return the depth of the deepest valley of a density, and which points, (n,), are below it.

    The depth is the distance to the lower maximum beside the valley, in standard errors.
    """
    from scipy.stats import gaussian_kde

    ordered = np.sort(x)
    grid = np.linspace(ordered[fewest], ordered[-1 - fewest], 200)
    if grid[0] == grid[-1]:
        return 0.0, x < grid[0]
    kernel = gaussian_kde(x, "silverman")
    density = kernel(grid)
    rising, falling = np.maximum.accumulate([density, density[::-1]], axis=1)
    peaks = np.minimum(rising, falling[::-1])
    # The square of a normal kernel has the integral 1 / sqrt(4 pi).
    bandwidth = kernel.factor * x.std(ddof=1)
    error = np.sqrt(np.maximum(density, 1 / len(x)) / (len(x) * bandwidth * np.sqrt(4 * np.pi)))
    depth = np.where(density < 0.75 * peaks, (peaks - density) / error, 0.0)
    return float(depth.max()), x < grid[depth.argmax()]
