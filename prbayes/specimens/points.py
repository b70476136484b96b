"""Importance points of measured specimens, doubled until independent halves of them agree.

    log p(y_i | theta) = logsumexp_k(log p(x_ik | theta) + A_ik).

Points x_ik and numbers A_ik do not contain theta. `prbayes.specimens.proposals` derives them for a
normal reference population, which follows from posterior draws of the hyperparameters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from prbayes._finding import any_of
from prbayes._stats import log_sum_exp, positive_scale
from prbayes._validate import IN_CACHE, Bools, Floats, Indices
from prbayes.metrics.readings import Readings, scaled_errors
from prbayes.numerics.mixtures import normalised_weights
from prbayes.numerics.points import sobol
from prbayes.propagation.base import DesignError
from prbayes.specimens.coordinates import Coordinates
from prbayes.specimens.emulation import Emulation, half_difference
from prbayes.specimens.proposals import (
    Modes,
    Normal,
    Proposals,
    Residuals,
    best_rows,
    find_modes,
    mixing_weights,
    with_covered_fibres,
    without_covered,
)
from prbayes.specimens.weighted_points import fit_normal, normal_log_density


@dataclass(frozen=True)
class SpecimenOptions:
    """Settings of runs and points, from the study of guards (docs/likelihood.md)."""

    starts: int = 12  # number of starts of the search for modes, for each specimen
    gap: float = 20.0  # largest misfit of a mode above the specimen's best, in nats
    points: int = 8  # fewest points of a mode in each half; doubled until the halves agree
    most_points: int = 4096  # largest number of points of a specimen, or `most_in_all` / N
    most_in_all: int = 2**17
    cheap_in_all: int = 2**16  # number of points in all up to which doubling them costs little
    # Largest standard deviation, over plausible populations, of half the difference between the
    # log-likelihoods of the two halves.
    half_difference: float = 0.05
    # Largest bias of a mean or standard deviation of an input, in posterior standard deviations.
    # More runs are added where the emulator's error could cause as much.
    bias: float = 0.1
    floor: float = 1e-5  # smallest error of the emulator, as a share of the data's spread
    sampled: int = 8  # runs of a batch that measure the error, at least
    n_first: int | None = None  # number of first runs; by default that of `first_runs`
    max_runs: int | None = None  # by default that of `most_runs`


@dataclass(frozen=True, eq=False)
class SpecimenPoints:
    """Points of N specimens."""

    z: Floats  # (N, K, d): coordinates of the points
    outputs: Floats  # (N, K, m): the emulator's outputs at the points, or those that were read
    # (N, K): the log-likelihood of a specimen under a density p of z is ``logsumexp(log p(z) +
    # log_a, axis=1)``; -inf for points that fill up the array
    log_a: Floats
    # (N, K): log of the number of points times the proposal density: ``log_a`` without the density
    # of the readings, for an error that is not known in advance
    log_proposal: Floats
    n_roots: Indices  # (N,): modes of the readings' density with a thousandth of the mass
    mode: Indices  # (N, K): mode whose proposal drew the point
    difference: float = np.nan  # the half difference of the log-likelihoods
    is_exact: bool = False  # whether readings determine the inputs, so that a mode has one point
    # (N, K, B): changes of ``log_a`` in draws of the emulator of a random response. The likelihood
    # of all specimens is the mean over these draws, which they have in common; None for no draws.
    tilts: Floats | None = None
    scale: int = 0  # row of the likely factors of unknown errors

    def rows(self, index: Indices) -> SpecimenPoints:
        """Return the points of selected specimens."""
        arrays = {k: v[index] for k, v in vars(self).items() if isinstance(v, np.ndarray)}
        return replace(self, **arrays)  # type: ignore[arg-type]


def joined(first: SpecimenPoints, second: SpecimenPoints) -> SpecimenPoints:
    """Return two independent sets of points as one; each counts half."""
    return SpecimenPoints(
        np.concatenate([first.z, second.z], axis=1),
        np.concatenate([first.outputs, second.outputs], axis=1),
        np.concatenate([first.log_a, second.log_a], axis=1) - np.log(2),
        np.concatenate([first.log_proposal, second.log_proposal], axis=1) + np.log(2),
        first.n_roots,
        np.concatenate([first.mode, second.mode], axis=1),
    )


def of_all_specimens(first: SpecimenPoints, second: SpecimenPoints) -> SpecimenPoints:
    """Return points of the specimens of both; the smaller number is filled up without mass.

    Modes are numbered within each part.
    """
    count = max(first.log_a.shape[1], second.log_a.shape[1])

    def together(name: str) -> Any:
        parts = [getattr(points, name) for points in (first, second)]
        wide = [v[:, np.minimum(np.arange(count), v.shape[1] - 1)] for v in parts]
        return np.concatenate(wide)

    sizes = [points.log_a.shape[1] for points in (first, second)]
    numbers = [len(first.z), len(second.z)]
    is_point = np.arange(count) < np.repeat(sizes, numbers)[:, None]
    return SpecimenPoints(
        z=together("z"),
        outputs=together("outputs"),
        log_a=np.where(is_point, together("log_a"), -np.inf),
        log_proposal=np.where(is_point, together("log_proposal"), np.inf),
        n_roots=np.concatenate([first.n_roots, second.n_roots]),
        mode=together("mode"),
        difference=float(np.hypot(first.difference, second.difference)),
        is_exact=first.is_exact and second.is_exact,
        scale=first.scale,
    )


def points_by_mode(points: SpecimenPoints, modes: Modes) -> SpecimenPoints:
    """Return one point for each mode of a specimen: the weighted mean of its points.

    The densities of the proposals are NaN.
    """
    first = np.searchsorted(modes.specimen, np.arange(len(points.z)))
    slot = points.mode - first[:, None]
    largest = points.log_a.max(axis=1, keepdims=True)
    weights = np.exp(points.log_a - np.where(np.isfinite(largest), largest, 0.0))
    slots = np.arange(modes.table.shape[1])
    is_of_mode = slot[:, None] == slots[:, None]
    of_mode = is_of_mode * weights[:, None]
    total = of_mode.sum(axis=2)
    of_mode /= positive_scale(total)[:, :, None]
    with np.errstate(divide="ignore"):
        log_a = np.log(total) + largest
    mode = first[:, None] + np.arange(total.shape[1])
    z, outputs = of_mode @ points.z, of_mode @ points.outputs
    return replace(
        points,
        z=z,
        outputs=outputs,
        log_a=log_a,
        log_proposal=np.full(total.shape, np.nan),
        mode=mode,
        is_exact=True,
    )


class Draws(Protocol):
    """Draws of the hyperparameters."""

    @property
    def thetas(self) -> Floats:
        """The draws, (S, p)."""

    def log_likelihoods(self, z: Floats, log_a: Floats) -> Floats:
        """Return log p(y_i | theta), (S, N)."""

    def specimens(self) -> Floats:
        """Return coordinates of specimens, (n, d)."""


# Function of points, numbers A, a smoothing and, optionally, a share of the populations
type Posterior = Callable[..., Draws]


def normal_of(sample: Floats, inflation: float = 1.0) -> Normal:
    """Return the normal population with the moments of a sample, (n, d), its sd times inflation."""
    mean = sample.mean(axis=0)
    covariance = np.atleast_2d(np.cov(sample.T)) * inflation**2
    sd = np.sqrt(np.diagonal(covariance))
    sd = positive_scale(sd)
    correlation = covariance / np.outer(sd, sd) + 1e-10 * np.eye(len(sd))
    return Normal(mean, sd[:, None] * np.linalg.cholesky(correlation))


def are_near(first: Normal, second: Normal) -> bool:
    """Return whether two populations overlap for the most part."""
    shift = np.linalg.solve(first.root, second.mean - first.mean)
    change = np.linalg.solve(first.root, second.root)
    sizes = np.linalg.svd(change, compute_uv=False)
    if np.abs(shift).max() > 1.0:
        return False
    return bool(sizes.min() > 0.3 and sizes.max() < 3.0)


@dataclass(frozen=True, eq=False)
class SpecimenData:
    """Measured specimens, and what is known of them before any run."""

    readings: Readings
    known: Floats  # (N, d): coordinates that are known for a specimen; NaN of the others
    prior: Floats  # (n, d): specimens of the prior predictive population
    posterior: Posterior  # function of points, log_a and a smoothing that returns posterior draws
    coordinates: Coordinates | None = None  # the map to inputs; None if they have no ends
    # (free,): columns of unknown coordinates, the narrowest possible populations first
    order: Indices | None = None
    # (J, m): factors of unknown reading errors, from larger to smaller ones of their prior; (J, 1)
    # if all outputs have the same
    scales: Floats = field(default_factory=lambda: np.ones((1, 1)))
    gross_errors: bool = False  # whether readings of single specimens may have gross errors
    options: SpecimenOptions = SpecimenOptions()
    name: str = "response"
    output_names: tuple[str, ...] = ()  # names of the m outputs in messages
    labels: NDArray[Any] | None = None  # labels of the N specimens; None for row numbers
    # Advice on more runs, and on another metric, that the model accepts; empty texts for none.
    remedies: Callable[[], tuple[str, str]] = lambda: ("", "")
    # Function of hyperparameters, (S, p), that returns them as draws; for a part of the specimens.
    draws: Callable[[Floats], Draws] | None = None
    seed: int = 0
    # (N, c): outputs of each specimen's own function, the only ones that points have; None where
    # all specimens have the same function.
    columns: Indices | None = None

    @property
    def free(self) -> Indices:
        """Columns of the coordinates that are not known."""
        return np.flatnonzero(np.isnan(self.known[0]))

    def within(self, z: Floats) -> Floats:
        """Return coordinates (..., d) that are moved to where the response may be run."""
        return z if self.coordinates is None else self.coordinates.within(z)

    def scale(self, sd: Floats) -> Floats:
        """Return units of all coordinates, (d,), from those of the unknown coordinates, (free,)."""
        scale = np.maximum(np.ptp(self.known, axis=0), 1e-9)
        scale[self.free] = sd
        return scale

    @cached_property
    def inner(self) -> Floats:
        """Specimens of the prior predictive population without its tails, (n, d).

        95 % of the specimens, nearest to the median in units of the distance of two quantiles.
        """
        z = self.prior[:, self.free]
        low, middle, high = np.quantile(z, [0.16, 0.5, 0.84], axis=0)
        width = np.where(high > low, high - low, 1.0)
        order = np.argsort(np.abs((z - middle) / width).max(axis=1), kind="stable")
        return self.prior[order[: int(0.95 * len(order))]]


def residuals_of(data: SpecimenData, emulation: Emulation, population: Normal) -> Residuals:
    """Return the residuals of an emulator's outputs."""
    readings, is_read = data.readings, data.readings.is_measured
    relative = np.where(is_read, readings.relative, 0.0)
    variance = readings.error**2 + readings.step**2 / 12
    error = np.where(is_read, np.sqrt(variance), np.inf)
    target = np.where(is_read, readings.values, 0.0)
    if emulation.offsets is not None:
        target = target - emulation.offsets
    of_emulator = np.broadcast_to(emulation.error, target.shape)
    box = None
    if data.coordinates is not None:
        # The range of the prior's data sets, and a quarter beyond it.
        low, high = data.coordinates.bounds
        margin = 0.25 * (high - low)
        box = np.stack([low - margin, high + margin])
    columns, count = None, max(int(is_read.sum(axis=1).max()), 1)
    if 2 * count <= is_read.shape[1]:
        columns = np.argsort(~is_read, axis=1, kind="stable")[:, :count]
        target, of_emulator, error, relative = (
            np.take_along_axis(values, columns, axis=1)
            for values in (target, of_emulator, error, relative)
        )
    return Residuals(
        emulation,
        target,
        of_emulator,
        error,
        relative,
        population,
        data.known,
        box,
        data.order,
        columns,
        data.columns is not None,
        data.scales,
    )


def fit_proposals(
    data: SpecimenData,
    emulation: Emulation,
    population: Normal,
    earlier: Modes | None = None,
) -> Proposals:
    """Return proposals at the modes of all specimens.

    The search for modes starts at specimens of the prior, and of the population, whose outputs are
    nearer to the specimen's readings than those of their neighbours; or at the modes of an
    ``earlier`` emulator in the same population. Raise DesignError if no specimen has a mode.
    """
    residuals = residuals_of(data, emulation, population)
    # Candidates are not chosen by an output that a reading error dominates.
    target = np.where(data.readings.is_measured, data.readings.values, 0.0)
    if emulation.offsets is not None:
        target = target - emulation.offsets
    error = np.median(data.readings.error_sd(target), axis=0)
    unit = np.hypot(data.readings.spread(), 10 * error)
    unit = np.where(data.readings.is_measured, unit, np.inf)
    if earlier is None:
        starts = _starts(data, emulation, residuals, target, unit)
    else:
        starts = _as_starts(earlier, np.zeros((len(target), 1, len(data.free))))
    parts = []
    for scale in range(len(data.scales)):
        modes = find_modes(residuals, starts, scale=scale, gap=data.options.gap)
        if not len(modes.specimen):
            raise DesignError(
                f"{data.name}: got no input at which the emulator gives the readings of any "
                "specimen, expected one of most specimens; check the response, its outputs, the "
                "priors and the units"
            )
        proposals = without_covered(Proposals.at_modes(residuals, modes))
        parts.append(with_covered_fibres(proposals, starts, scale).modes)
        starts = _as_starts(parts[-1], starts)
    return Proposals.at_modes(residuals, Modes.joined(parts))


def _starts(
    data: SpecimenData,
    emulation: Emulation,
    residuals: Residuals,
    target: Floats,
    unit: Floats,
    most: int = 512,
) -> Floats:
    """Return whitened starts of the search for modes, (N, S, free)."""
    from scipy.spatial import cKDTree

    free, n = data.free, len(data.known)
    rng = np.random.default_rng([data.seed, 2])
    half = most // 2
    of_inner = rng.permutation(len(data.inner))[:half]
    of_prior = data.inner[of_inner]
    uniform = sobol(half, len(free), data.seed)
    a = 2.0 * ndtri(uniform)
    a = np.concatenate([residuals.whitened(of_prior), a])
    # In the units of the prior's spread: a narrow population would leave regions far apart.
    n_near = min(len(a), 4 + 2 * len(free))
    _, near = cKDTree(a).query(a, n_near)
    # Without conditions all specimens have the same outputs at the starts.
    is_common = len(free) == data.known.shape[1]
    of_first = residuals.coordinates(np.zeros(len(a), dtype=int), a)
    common = emulation.values(of_first)[None]
    starts = []
    for rows in np.array_split(np.arange(n), 1 + n * len(a) // IN_CACHE):
        values = common
        if not is_common:
            z = residuals.coordinates(rows.repeat(len(a)), np.tile(a, (len(rows), 1)))
            values = emulation.values(z).reshape(len(rows), len(a), -1)
        distance = np.zeros((len(rows), len(a)))
        with np.errstate(invalid="ignore", over="ignore"):
            for readings, simulated, scale in zip(
                target[rows].T, values.T, unit[rows].T, strict=True
            ):
                distance += ((readings[:, None] - simulated.T) / scale[:, None]) ** 2
        distance = np.where(np.isnan(distance), np.inf, distance)
        is_minimum = np.ones(distance.shape, dtype=bool)
        for column in near[:, 1:].T:
            is_minimum &= distance <= distance[:, column]
        # Minima come first. Positive numbers have the order of their bits, whose first one is free.
        first_bit = (~is_minimum).astype(np.uint64) << np.uint64(63)
        keys = distance.view(np.uint64) | first_bit
        count = data.options.starts
        nearest = np.argpartition(keys, count, axis=1)[:, :count]
        of_nearest = np.take_along_axis(keys, nearest, axis=1)
        order = np.argsort(of_nearest, axis=1, kind="stable")
        rows_in_order = np.take_along_axis(nearest, order, axis=1)
        starts.append(a[rows_in_order])
    return np.concatenate(starts)


def _as_starts(modes: Modes, starts: Floats) -> Floats:
    """Return the modes of each specimen as starts, (N, S, free); earlier starts without a mode."""
    result = starts[:, :1].repeat(modes.table.shape[1], axis=1)
    filled = modes.table
    rows = np.flatnonzero((filled >= 0).any(axis=1))
    first = modes.a[np.where(filled[rows] >= 0, filled[rows], filled[rows, :1])]
    result[rows] = first
    return result


def reading_log_density(
    data: SpecimenData, readings: Readings, outputs: Floats, error: Floats
) -> Floats:
    """Return the log-density of readings at outputs of points, (N, K); ``error`` is (m,)."""
    if data.columns is None:
        return readings.log_density(outputs, error)
    of_outputs = readings.at_columns(data.columns)
    return of_outputs.log_density(outputs, error[data.columns])


def outputs_at(data: SpecimenData, emulation: Emulation, z: Floats) -> Floats:
    """Return the emulator's outputs at points of all specimens, (N, K, d) -> (N, K, m)."""
    n, k, d = z.shape
    parts = []
    for rows in np.array_split(np.arange(n), 1 + n * k // IN_CACHE):
        columns, offsets = None, emulation.offsets
        if data.columns is not None:
            columns = data.columns[rows].repeat(k, axis=0)
        values = emulation.values(z[rows].reshape(-1, d), columns)
        values = values.reshape(len(rows), k, -1)
        if offsets is not None:
            of_rows = offsets[rows]
            if data.columns is not None:
                of_rows = np.take_along_axis(of_rows, data.columns[rows], axis=1)
            values = values + of_rows[:, None]
        parts.append(values)
    return np.concatenate(parts)


def reading_change(
    data: SpecimenData, points: SpecimenPoints, before: Emulation, after: Emulation
) -> Floats:
    """Return the change of the readings' log-density at points with a later emulator, (N, K)."""
    if after.surface is before.surface:
        return np.zeros(points.log_a.shape)
    first = reading_log_density(data, data.readings, points.outputs, before.error)
    outputs = outputs_at(data, after, points.z)
    change = reading_log_density(data, data.readings, outputs, after.error) - first
    return np.where(np.isfinite(change), change, -np.inf)


def draw_points(data: SpecimenData, proposals: Proposals, count: int, seed: int) -> SpecimenPoints:
    """Return points of all specimens, ``count`` of each."""
    emulation = proposals.residuals.response
    z, log_proposal, mode = proposals.draw(count, seed)
    if data.coordinates is not None and data.coordinates.support is not None:
        low, high = data.coordinates.support
        is_beyond = (z < low) | (z > high)
        log_proposal = np.where(is_beyond.any(axis=2), np.inf, log_proposal)
    outputs = outputs_at(data, emulation, z)
    log_a = reading_log_density(data, data.readings, outputs, emulation.error) - log_proposal
    log_a = np.where(np.isnan(log_a), -np.inf, log_a)
    n_roots = (proposals.modes.table >= 0).sum(axis=1) // len(data.scales)
    return SpecimenPoints(z, outputs, log_a, log_proposal, n_roots, mode)


@dataclass(frozen=True, eq=False)
class Plausible:
    """Posterior draws of the hyperparameters, and coarse points of which they follow."""

    draws: Draws
    proposals: Proposals
    points: SpecimenPoints
    scale: int  # row of the likely factors of unknown errors
    count: int  # points of each half to begin with

    @classmethod
    def of(
        cls,
        data: SpecimenData,
        emulation: Emulation,
        population: Normal,
        earlier: Plausible | None = None,
    ) -> Plausible:
        """Return draws; ``population`` is the first reference, or that of earlier draws.

        Where the readings leave inputs open, the reference has the moments of specimens of
        posterior draws, refitted twice. Raise DesignError if `most_points` are not enough.
        """
        options = data.options
        if earlier is not None and earlier.proposals.is_open(earlier.scale):
            population = earlier.proposals.residuals.population
        proposals = fit_proposals(data, emulation, population)
        # With many specimens few points of each suffice, because their errors average out. The
        # halves have to agree all the same.
        n = len(data.readings)
        of_mode = options.points if n <= 512 else max(2, 512 * options.points // n)
        count = of_mode * proposals.modes.table.shape[1]
        if proposals.residuals.has_errors:  # inputs are spread around a mode
            count = max(count, min(4 * options.points, options.cheap_in_all // (8 * n)))
        points = draw_points(data, proposals, 2 * count, data.seed)
        scale = likely_scale(data, points, emulation.error)
        if not proposals.is_open(scale):
            points = at_scale(data, points, emulation.error, scale)
            draws = draws_of(data, proposals, points)
            return cls(draws, proposals, points, scale, count)
        affordable = min(options.cheap_in_all // len(data.readings), options.most_points)
        count = max(2 * count, min(64 * options.points, affordable), 32 * options.points)
        for refit in range(3):
            seed = data.seed + refit
            draws, points, proposals = reliable_draws(data, proposals, count, seed, scale)
            count = points.log_a.shape[1]
            previous = proposals.residuals.population
            population = normal_of(draws.specimens()[:, data.free], 1.15)
            proposals = fit_proposals(data, emulation, population)
            change = np.linalg.solve(previous.root, population.root)
            if np.abs(change - np.eye(len(change))).max() < 0.2:
                break
        points = draw_points(data, proposals, count, data.seed)
        points = at_scale(data, points, emulation.error, scale)
        return cls(draws, proposals, points, scale, count // 2)

    def is_near(self, earlier: Plausible) -> bool:
        """Return whether specimens of the draws are those of earlier draws, nearly."""
        first = normal_of(earlier.draws.specimens())
        return are_near(first, normal_of(self.draws.specimens()))

    def of_emulation(
        self, data: SpecimenData, emulation: Emulation, earlier: Modes | None = None
    ) -> Plausible:
        """Return the same draws with proposals of a better emulator, from ``earlier`` modes."""
        reference = self.proposals.residuals.population
        proposals = fit_proposals(data, emulation, reference, earlier)
        points = draw_points(data, proposals, self.points.log_a.shape[1], data.seed)
        points = at_scale(data, points, emulation.error, self.scale)
        return replace(self, proposals=proposals, points=points)

    def agreeing(self, data: SpecimenData) -> tuple[SpecimenPoints, Proposals]:
        """Return points whose halves agree at the draws."""
        proposals, points, modes = self.proposals, self.points, self.proposals.modes
        population = normal_of(self.draws.specimens()[:, data.free])
        # Proposals of a wider population have points on branches that only such populations reach.
        wide = Normal(population.mean, 2.5 * population.root)
        masses = [
            np.bincount(
                points.mode.ravel(),
                likely_weights(data, points, reference).ravel(),
                len(proposals.share),
            )
            for reference in (population, wide)
        ]
        # Scales of an unknown error that are not likely have points as well, because the prior
        # allows them.
        if proposals.is_open(self.scale) and len(data.scales) == 1:
            proposals = replace(proposals, share=mixing_weights(modes, masses[0] + masses[1]))
        result, _ = agreeing_points(data, proposals, self.count, self.draws, self.scale)
        largest = np.zeros(len(data.known))
        np.maximum.at(largest, modes.specimen, masses[0])
        counts = masses[0] > 1e-3 * largest[modes.specimen]
        counts &= modes.scale == self.scale
        n_roots = np.bincount(modes.specimen[counts], minlength=len(data.known))
        result = replace(result, n_roots=np.maximum(n_roots, 1), scale=self.scale)
        if len(data.scales) > 1:
            return result, proposals
        # Exact readings determine the inputs of a mode, so that one point suffices.
        fewer = points_by_mode(result, proposals.modes)
        sums = [self.draws.log_likelihoods(p.z, p.log_a).sum(axis=1) for p in (result, fewer)]
        with np.errstate(invalid="ignore"):
            is_same = np.ptp(sums, axis=0).max() < 1e-3 * data.options.half_difference
        return fewer if is_same else result, proposals


def specimen_points(
    data: SpecimenData, emulation: Emulation, population: Normal
) -> tuple[SpecimenPoints, Proposals, Draws]:
    """Return points whose halves agree, their proposals, and posterior draws at which they agree.

    ``population`` is the first reference. Raise DesignError if `most_points` are not enough.
    """
    plausible = Plausible.of(data, emulation, population)
    return *plausible.agreeing(data), plausible.draws


def at_scale(
    data: SpecimenData, points: SpecimenPoints, error: Floats, scale: int
) -> SpecimenPoints:
    """Return points with weights for readings whose errors have the factors of a row."""
    if len(data.scales) == 1:
        return points
    readings = scaled_errors(data.readings, data.scales[scale])
    log_a = reading_log_density(data, readings, points.outputs, error) - points.log_proposal
    return replace(points, log_a=np.where(np.isnan(log_a), -np.inf, log_a))


def likely_scale(data: SpecimenData, points: SpecimenPoints, error: Floats) -> int:
    """Return the row of factors of errors that a fitted normal population makes likeliest."""
    totals = []
    for scale in range(len(data.scales)) if len(data.scales) > 1 else ():
        log_a = at_scale(data, points, error, scale).log_a
        rows = np.isfinite(log_a).any(axis=1)
        z = points.z[rows][..., data.free]
        logs = log_a[rows] + normal_log_density(z, *fit_normal(z, log_a[rows]))
        totals.append(log_sum_exp(logs).sum() if rows.all() else -np.inf)
    return int(np.argmax(totals)) if totals else 0


def likely_weights(data: SpecimenData, points: SpecimenPoints, population: Normal) -> Floats:
    """Return weights of the points of each specimen under a population, (N, K)."""
    z = points.z[..., data.free]
    logs = points.log_a + normal_log_density(z, population.mean, population.root)
    logs[~np.isfinite(logs).any(axis=1)] = 0.0
    return normalised_weights(logs)


def agreeing_points(
    data: SpecimenData,
    proposals: Proposals,
    count: int,
    draws: Draws,
    scale: int = 0,
) -> tuple[SpecimenPoints, Proposals]:
    """Return points whose halves agree at draws, doubled from ``count`` in each half.

    ``scale`` is the row of the likely factors of errors; the halves agree over all rows, too.
    """
    options = data.options
    over_scales = 0.03 * np.sqrt(max(len(data.readings), 10) / 10)
    # Along inputs that readings leave open the error decreases more slowly with the number of
    # points, so that a larger one is accepted.
    largest = options.half_difference * per_hyperparameter(draws)
    largest *= 2 if proposals.is_open(scale) else 1
    most = max(options.most_points, options.most_in_all // len(data.readings))
    last = np.inf
    while True:
        halves = [draw_points(data, proposals, count, 100 + 2 * data.seed + h) for h in (0, 1)]
        difference = _half_difference(data, proposals, halves, draws, (scale,))
        # The error drops at once when the distance of points becomes less than the width of the
        # narrowest populations.
        falls = difference[0] < last / 3
        is_cheap = 4 * count * len(data.readings) <= options.cheap_in_all * (4 if falls else 1)
        last = difference[0]
        is_precise = difference[0 if is_cheap else 1] <= largest and difference[2] <= 4 * largest
        if is_precise and (
            len(data.scales) == 1
            or count >= 512
            or _half_difference(data, proposals, halves, draws, range(len(data.scales)))[0]
            <= over_scales
        ):
            return replace(joined(*halves), difference=difference[1]), proposals
        if 4 * count > most:
            raise _monte_carlo_error(data, 2 * count, max(difference[1:]), largest)
        # The error falls like 1 / count at best.
        ratio = difference[1] / largest
        ratio = np.clip(ratio, 2, most // (2 * count))
        times = 2 ** int(np.log2(ratio))
        count *= times


def _half_difference(
    data: SpecimenData,
    proposals: Proposals,
    halves: Sequence[SpecimenPoints],
    draws: Draws,
    scales: Sequence[int],
) -> tuple[float, float, float]:
    """Return the Monte Carlo error over draws, and over rows of factors of unknown errors.

    The second number has no contribution of the few populations that are narrower than the
    distances between points. The third is that of a constant.
    """
    error, logs = proposals.residuals.response.error, []
    for half in halves:
        by_scale = [at_scale(data, half, error, scale) for scale in scales]
        logs.append(np.concatenate([draws.log_likelihoods(p.z, p.log_a) for p in by_scale]))
    a, b = logs
    if data.gross_errors:
        typical = typical_specimens(proposals.modes, len(data.readings))
        a, b = a[:, typical], b[:, typical]
    finite = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    if len(scales) > 1 and (np.ptp(data.scales, axis=1) > 0).any():
        # Combinations of errors that the readings exclude do not count.
        totals = a.sum(axis=1)
        finite &= totals > totals.max() - 100.0
    return half_difference(a[finite], b[finite]) if finite.any() else (np.inf, np.inf, np.inf)


def typical_specimens(modes: Modes, n: int) -> Bools:
    """Return which specimens have no gross error, (n,), by the best mode of each.

    An outlier is five robust standard deviations from the median, or no inputs reproduce it.
    """
    best = modes.rows(best_rows(modes.specimen, modes.misfit))
    specimens, a, misfit = best.specimen, best.a, best.misfit
    away = np.abs(a - np.median(a, axis=0))
    sd = 1.4826 * np.median(away, axis=0)
    is_outlier = (away > 5.0 * positive_scale(sd, np.inf)).any(axis=1) | (misfit > 50.0)
    typical = np.ones(n, dtype=bool)
    if 2 * is_outlier.sum() < len(specimens):
        typical[specimens[is_outlier]] = False
    return typical


def draws_of(data: SpecimenData, proposals: Proposals, points: SpecimenPoints) -> Draws:
    """Return posterior draws given points; of several modes where specimens have several."""
    has_several = np.bincount(proposals.modes.specimen, proposals.modes.is_stationary()) > 1
    # Outliers, which gross errors explain, leave small modes that only the emulator has.
    is_sought = has_several.mean() > 0.1 and not data.gross_errors
    settings = {"several": True} if is_sought else {}
    return data.posterior(points.z, points.log_a, None, **settings)


def reliable_draws(
    data: SpecimenData,
    proposals: Proposals,
    count: int,
    seed: int,
    scale: int = 0,
) -> tuple[Draws, SpecimenPoints, Proposals]:
    """Return draws at which both halves of at least ``count`` points agree, and these points.

    Where points lie farther apart than populations are wide, the likely populations are those
    where points happen to lie close. Populations that are wider by the bandwidth of Scott's rule
    narrow the reference population, until it narrows no more; then points are doubled.
    """
    narrows = False
    while True:
        halves = [draw_points(data, proposals, count // 2, seed + h) for h in (0, 1000)]
        points = at_scale(data, joined(*halves), proposals.residuals.response.error, scale)
        if not narrows:
            draws = draws_of(data, proposals, points)
            difference, *_ = _half_difference(data, proposals, halves, draws, (scale,))
            limit = per_hyperparameter(draws)
            if difference <= limit:
                return draws, points, proposals
            if 2 * count > data.options.most_points:
                raise _monte_carlo_error(data, count, difference, limit)
        previous = proposals.residuals.population
        covariance = previous.root @ previous.root.T
        smoothing = count ** (-2 / (len(covariance) + 4)) * covariance
        specimens = data.posterior(points.z, points.log_a, smoothing).specimens()
        narrow = normal_of(specimens[:, data.free])
        root = np.linalg.cholesky(narrow.root @ narrow.root.T + smoothing)
        narrows = bool(np.diag(root).prod() < np.diag(previous.root).prod() / 2)
        emulation = proposals.residuals.response
        proposals = fit_proposals(data, emulation, Normal(narrow.mean, root))
        count = count if narrows else 2 * count


def per_hyperparameter(draws: Draws) -> float:
    """Return the error of a log-likelihood that shifts hyperparameters as 1 shifts each of four.

    A random function of p hyperparameters with a standard deviation of s nats shifts means by about
    s / sqrt(p) posterior standard deviations.
    """
    return float(np.sqrt(max(draws.thetas.shape[1], 4) / 4))


def _monte_carlo_error(
    data: SpecimenData, count: int, difference: float, largest: float
) -> DesignError:
    remedies = "measure more outputs of each specimen", "narrow the priors", data.remedies()[1]
    return DesignError(
        f"{data.name}: got two halves of {count} points a specimen whose log-likelihoods differ by "
        f"{difference:.2g} nats, expected at most {largest:.2g}; {any_of(*remedies)}"
    )
