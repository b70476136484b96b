"""Emulation of a response near the measured specimens: runs over the prior and at the roots.

Guards (missing roots, emulator error, Monte Carlo error) return numbers, with which loops add
starts, runs or points. No guard detects a root outside the box of the search, or an emulator error
that is smooth between the fresh runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from prbayes._validate import AT_ONCE, Floats
from prbayes.emulators.interpolant import Interpolant, fit_interpolant
from prbayes.metrics.readings import Readings
from prbayes.numerics.points import farthest_rows, sobol
from prbayes.propagation.base import DesignError
from prbayes.propagation.population_density import (
    fit_normal,
    normal_log_density,
    normalised_weights,
)
from prbayes.propagation.roots import (
    Roots,
    find_roots,
    gabriel_neighbours,
    nearest_starts,
    rows_by_specimen,
)
from prbayes.response.distributions import PopulationSampler, PriorSampler
from prbayes.response.inputs import Inputs


@dataclass(frozen=True)
class PointOptions:
    """Settings of the points, from the study of guards (docs/likelihood.md)."""

    # Fewest starts of the search for roots, by specimen; doubled while simulated specimens do not
    # get their inputs back.
    starts: int = 12
    gap: float = 20.0  # largest misfit of a root above the specimen's best, in nats
    points: int = 4  # points around each root; doubled until two independent halves agree
    most_points: int = 4096  # largest number of points of a specimen; of few, `most_in_all`
    most_in_all: int = 2**17
    # Largest standard deviation, over plausible populations, of half the difference between the
    # log-likelihoods of the two halves.
    half_difference: float = 0.05
    fresh: int = 16  # runs at roots that measure the emulator's bias; they stay in the emulator
    # Largest bias of a mean or standard deviation of an input, in posterior standard deviations.
    # More runs are added where the emulator's error could cause as much.
    bias: float = 0.15
    floor: float = 1e-6  # smallest standard deviation of a comparison, as a share of the data's
    degrees: float = 5.0  # degrees of freedom of the t distribution around a root


def first_runs(dimensions: int) -> int:
    """Return the number of runs that an emulator of so many inputs starts from."""
    return 64 if dimensions <= 2 else 128 if dimensions <= 4 else 480


@dataclass(frozen=True, eq=False)
class EmulationProblem:
    """A response to emulate for measured specimens."""

    # Coordinates (n, d) -> outputs (n, m), NaN where there is no response.
    run: Callable[[Floats], Floats]
    readings: Readings
    options: PointOptions = PointOptions()
    n: int | None = None  # number of first runs
    seed: int = 0
    name: str = "response"

    def n_first(self, dimensions: int) -> int:
        """Return the number of first runs."""
        return first_runs(dimensions) if self.n is None else self.n


class Surface(Protocol):
    """Outputs (k, m) at coordinates (k, d) between runs, with their Jacobian (k, m, d)."""

    def __call__(self, z: Floats) -> tuple[Floats, Floats]:
        """Return values and Jacobian."""

    def values(self, z: Floats) -> Floats:
        """Return the values alone."""


@dataclass(frozen=True, eq=False)
class DifferencedResponse:
    """The response itself, with central differences for its Jacobian: 2 d + 1 runs a point."""

    values: Callable[[Floats], Floats]  # coordinates (k, d) -> outputs (k, m)
    step: float = 1e-5  # in units of the coordinates

    def __call__(self, z: Floats) -> tuple[Floats, Floats]:
        """Return values and Jacobian."""
        k, d = z.shape
        axes = np.eye(d)
        shifts = self.step * np.concatenate([np.zeros((1, d)), axes, -axes])
        points = (z + shifts[:, None]).reshape(-1, d)
        values = self.values(points).reshape(2 * d + 1, k, -1)
        slopes = (values[1 : d + 1] - values[d + 1 :]) / (2 * self.step)
        return values[0], np.moveaxis(slopes, 0, -1)


@dataclass(frozen=True, eq=False)
class Emulation:
    """Runs of the response, and the emulator through them."""

    z: Floats  # (n, d): coordinates of the runs
    y: Floats  # (n, m): their outputs; NaN where there is no response
    box: Floats  # (2, d): bounds of the search for roots
    surface: Surface
    # (m,): standard deviation of the emulator's error at the roots: twice the error at runs there
    # before they were part of it.
    error: Floats
    # Predicted bias of a mean or standard deviation of an input, in posterior standard deviations.
    bias: float
    range: Floats  # (2, d): of the roots at which runs were made

    @classmethod
    def first(cls, problem: EmulationProblem, z: Floats, box: Floats) -> Emulation:
        """Return the emulation of runs at first points."""
        y = problem.run(z)
        surface, left_out, is_near = surface_near(z, y, problem.readings, problem.name)
        rms = np.sqrt((left_out[is_near] ** 2).mean(axis=0))
        error = np.maximum(2 * rms, problem.options.floor * problem.readings.spread())
        infinite = np.full(z.shape[1], np.inf)
        return cls(z, y, box, surface, error, np.inf, np.stack([infinite, -infinite]))

    @classmethod
    def of_function(cls, problem: EmulationProblem, box: Floats, search_box: Floats) -> Emulation:
        """Return the response itself in place of an emulator, with runs as starts of a search."""
        d = box.shape[1]
        z = box[0] + (box[1] - box[0]) * sobol(first_runs(d), d, 0)
        error = problem.options.floor * problem.readings.spread()
        infinite = np.full(d, np.inf)
        whole = np.stack([-infinite, infinite])
        surface = DifferencedResponse(problem.run)
        return cls(z, problem.run(z), search_box, surface, error, 0.0, whole)

    def covers(self, z: Floats) -> bool:
        """Return whether points lie in the range of the roots at which runs were made."""
        low, high = self.range
        with np.errstate(invalid="ignore"):
            margin = np.nan_to_num(0.1 * np.maximum(high - low, 0.0))
        return bool(((z >= low - margin) & (z <= high + margin)).all())

    def __call__(self, z: Floats) -> tuple[Floats, Floats]:
        """Return values and Jacobian, NaN where the nearest run has no response."""
        values, jacobian = self.surface(z)
        failed = self.fails(z)
        values[failed], jacobian[failed] = np.nan, np.nan
        return values, jacobian

    def values(self, z: Floats) -> Floats:
        """Return the values alone."""
        values = self.surface.values(z)
        values[self.fails(z)] = np.nan
        return values

    def fails(self, z: Floats) -> NDArray[np.bool_]:
        """Return where the nearest run has no finite response."""
        return self._of_nearest(~np.isfinite(self.y).all(axis=1), z)

    def is_missing(self, z: Floats) -> NDArray[np.bool_]:
        """Return where the nearest run has no response: NaN, while +inf is a failed specimen."""
        return self._of_nearest(np.isnan(self.y).any(axis=1), z)

    def _of_nearest(self, of_runs: NDArray[np.bool_], z: Floats) -> NDArray[np.bool_]:
        """Return a property of the nearest run of each point."""
        if not of_runs.any():
            return np.zeros(len(z), dtype=bool)
        _, nearest = self._tree.query(z / (self.box[1] - self.box[0]))
        return np.asarray(of_runs[nearest])

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.z / (self.box[1] - self.box[0]))


def emulate(
    problem: EmulationProblem,
    box: Floats,
    search_box: Floats,
    previous: Emulation | None = None,
) -> tuple[Emulation, Roots]:
    """Fit the emulator: runs over a box, then batches at the roots until the bias is small.

    ``previous`` is the emulation of the same response for other data. Raise DesignError if the
    response cannot be emulated well enough.
    """
    readings, options, seed = problem.readings, problem.options, problem.seed
    d = box.shape[1]
    n = problem.n_first(d)
    emulation = previous
    if emulation is None:
        first = box[0] + (box[1] - box[0]) * sobol(n, d, seed)
        emulation = Emulation.first(problem, first, search_box)
    rng = np.random.default_rng([seed, 1])
    for batch in range(6):
        roots = specimen_roots(emulation, readings, options)
        if batch < 2 and len(roots.z):
            # Twice at most: a reading that no inputs reproduce is reported.
            emulation = replace(emulation, box=_widened(emulation.box, roots))
            roots = specimen_roots(emulation, readings, options)
        enough = (batch >= 2 or previous is not None) and emulation.covers(roots.z)
        if enough and emulation.bias <= options.bias:
            # Zero for the response itself, which no run improves.
            narrowing = 0.0 if emulation.bias == 0 else _narrowing(emulation, readings, roots)
            if narrowing <= options.bias:
                break
        count = max(n // 2, options.fresh)
        fresh = spread_out(roots.z, emulation.box, count, options.fresh, rng)
        emulation = extended(emulation, problem, fresh)
    else:
        roots = specimen_roots(emulation, readings, options)
    roots = all_roots(emulation, readings, options, roots, seed)
    require_accurate(emulation, problem)
    return emulation, roots


def require_accurate(emulation: Emulation, problem: EmulationProblem) -> None:
    """Raise if the emulator's error is as large as the data's scatter, or shifts populations."""
    rough = (
        "the response is not smooth enough for prb.LogLikelihood(): use "
        "metric=prb.ProbabilityResidual(), or more first runs with propagation=prb.Reweighted(n)"
    )
    name, options, scatter = problem.name, problem.options, problem.readings.robust_spread()
    if (emulation.error > scatter).any():
        raise DesignError(
            f"{name}: got an emulator with errors of {emulation.error} at the specimens, expected "
            f"less than the data's standard deviations {scatter}; {rough}"
        )
    if emulation.bias > options.bias:
        raise DesignError(
            f"{name}: got an emulator whose error would shift a mean or standard deviation of an "
            f"input by {emulation.bias:.2g} posterior standard deviations after "
            f"{len(emulation.z)} runs, expected at most {options.bias}; {rough}"
        )


def _narrowing(emulation: Emulation, readings: Readings, roots: Roots) -> float:
    """Return by how much the error of the emulator could narrow the population of an input.

    The comparison allows an error covariance C of a root; the part of it that the runs have
    overestimated is missing in sigma^2. In posterior standard deviations of sigma, with weights
    w_ir of the roots under a fitted normal population:

        sqrt(2 N) / 2 max_j mean_i sum_r w_ir C_jj / (C_jj + sigma_j^2)
    """
    sd = np.where(readings.is_measured, readings.comparison_sd(emulation.error), 1.0)
    factor = (sd / emulation.error)[roots.specimen][:, :, None]
    table, log_mass, covariance = _laplace(roots, emulation.box)
    _, _, of_error = _laplace(replace(roots, jacobian=roots.jacobian * factor), emulation.box)
    mean, root = fit_normal(roots.z[table], log_mass)
    w = normalised_weights(normal_log_density(roots.z[table], mean, root) + log_mass)
    whole, part = (np.einsum("rdd->rd", matrix)[table] for matrix in (covariance, of_error))
    share = np.einsum("nr,nrd->nd", w, part / (whole + (root**2).sum(axis=1)))
    return float(np.sqrt(len(share) / 2) * share.mean(axis=0).max())


def likely_roots(roots: Roots, box: Floats) -> Floats:
    """Return the likeliest root of each specimen under a fitted normal population, (n, d)."""
    table, log_mass, _ = _laplace(roots, box)
    mean, root = fit_normal(roots.z[table], log_mass)
    log_weights = normal_log_density(roots.z[table], mean, root) + log_mass
    return np.asarray(roots.z[table[np.arange(len(table)), log_weights.argmax(axis=1)]])


def _laplace(roots: Roots, box: Floats) -> tuple[NDArray[np.intp], Floats, Floats]:
    """Return the roots of each specimen that has one, their log masses, and covariances.

    Shapes (N, most), with rows filled up by -1, (N, most) and (R, d, d).
    """
    precision = np.einsum("rmd,rme->rde", roots.jacobian, roots.jacobian)
    precision = precision + np.diag(4.0 / (box[1] - box[0]) ** 2)
    _, specimen = np.unique(roots.specimen, return_inverse=True)
    table = rows_by_specimen(specimen)
    log_mass = -np.linalg.slogdet(precision)[1] / 2 - roots.misfit
    masses = np.where(table >= 0, log_mass[table], -np.inf)
    return table, masses, np.linalg.inv(precision)


def extended(
    emulation: Emulation, problem: EmulationProblem, fresh: Floats, sampled: int | None = None
) -> Emulation:
    """Return the emulation with runs at fresh points, whose misfit gives its error and bias.

    With `sampled` the misfit is the left-out error of the new emulator at so many first points.
    """
    readings, options = problem.readings, problem.options
    values, jacobian = emulation.surface(fresh)
    outputs = problem.run(fresh)
    z = np.concatenate([emulation.z, fresh])
    y = np.concatenate([emulation.y, outputs])
    surface, left_out, _ = surface_near(z, y, readings, problem.name)
    misfit = outputs - values if sampled is None else left_out[len(emulation.z) :]
    good = np.isfinite(misfit).all(axis=1)
    error, bias = emulation.error, np.inf
    count = options.fresh if sampled is None else sampled
    rows = np.flatnonzero(good[:count])
    if len(rows) >= 4:
        # At the roots alone: points around them may lie far out, where nothing was measured.
        error = 2 * np.sqrt((misfit[rows] ** 2).mean(axis=0))
        error = np.maximum(error, options.floor * readings.spread())
        bias = shift_by_misfit(problem, error, misfit[rows], jacobian[rows], fresh[rows])
    reach = np.concatenate([emulation.range, fresh])
    extremes = np.stack([reach.min(axis=0), reach.max(axis=0)])
    return Emulation(z, y, emulation.box, surface, error, bias, extremes)


def shift_by_misfit(
    problem: EmulationProblem, error: Floats, misfit: Floats, jacobian: Floats, z: Floats
) -> float:
    """Return the largest `predicted_bias` of misfits (n, m) at coordinates (n, d)."""
    readings = problem.readings
    unit = typical_sd(readings.comparison_sd(error))
    biases = predicted_bias(misfit / unit, jacobian / unit[:, None], z, len(readings))
    # m readings identify m of d directions; the posterior is wider than the formula assumes.
    of_each = (readings.is_measured | readings.is_censored).sum(axis=1).mean()
    return float(np.abs(biases).max() * np.sqrt(min(1.0, of_each / z.shape[1])))


def typical_sd(sd: Floats) -> Floats:
    """Return the median of finite values by output, (N, m) -> (m,)."""
    return np.array([np.median(column[np.isfinite(column)]) for column in sd.T])


def surface_near(
    z: Floats, y: Floats, readings: Readings, name: str
) -> tuple[Interpolant, Floats, NDArray[np.bool_]]:
    """Return the interpolant, left-out errors, (n, m), and which runs are near the data, (n,).

    Runs that are equal to nine digits count once. Left-out errors are NaN without a response.
    """
    good = np.isfinite(y).all(axis=1)
    if good.sum() < 8:
        raise DesignError(
            f"{name}: got {int(good.sum())} runs with a response of {len(y)}, expected at least 8; "
            "check the response, or give the hyperparameters priors where it exists"
        )
    spread = readings.spread()
    rows = np.flatnonzero(good)
    rounded = np.round(z[rows], 9)
    _, first, copies = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    # A response that is steep outside the data would take the digits that outputs near them need:
    # outputs are limited to 10^4 standard deviations of the data, and at least ten times the
    # distance of 90 % of the runs.
    yg = y[rows[first]]
    center = np.nanmean(readings.values, axis=0)
    largest = 10 * np.quantile(np.abs(yg - center), 0.9, axis=0)
    largest = np.maximum(1e4 * spread, largest)
    yg = np.clip(yg, center - largest, center + largest)
    inside = near_readings(yg, readings)
    surface = fit_interpolant(z[rows[first]], yg, inside)
    left_out, is_near = np.full_like(y, np.nan), np.zeros(len(y), dtype=bool)
    left_out[rows], is_near[rows] = surface.left_out[copies.ravel()], inside[copies.ravel()]
    return surface, left_out, is_near


def near_readings(y: Floats, readings: Readings) -> NDArray[np.bool_]:
    """Return which outputs (n, m) are within the range of the readings, or half of it away.

    If these are less than a quarter, the nearest quarter, and at least eight.
    """
    spread, center = readings.spread(), np.nanmean(readings.values, axis=0)
    low, high = np.nanmin(readings.values, axis=0), np.nanmax(readings.values, axis=0)
    margin = np.maximum((high - low) / 2, spread)
    is_near = ((y >= low - margin) & (y <= high + margin)).all(axis=1)
    if is_near.sum() < len(y) // 4:
        distance = (((y - center) / spread) ** 2).sum(axis=1)
        is_near = np.zeros(len(y), dtype=bool)
        is_near[np.argsort(distance, kind="stable")[: max(8, len(y) // 4)]] = True
    return is_near


def _widened(box: Floats, roots: Roots) -> Floats:
    """Return the box with room for roots that end at its sides, and for their population.

    All specimens of a data set are then within it with a probability of 1 - 1 / 4097.
    """
    poor = roots.z[roots.misfit > 50.0]
    width = box[1] - box[0]
    ends = np.stack([poor <= box[0] + 1e-6 * width, poor >= box[1] - 1e-6 * width])
    wider = box + 0.25 * width * np.array([[-1.0], [1.0]]) * ends.any(axis=1)
    table, log_mass, _ = _laplace(roots, box)
    mean, root = fit_normal(roots.z[table], log_mass)
    reach = -ndtri(1 / 4097 / len(table)) * np.sqrt((root**2).sum(axis=1))
    return np.stack([np.minimum(wider[0], mean - reach), np.maximum(wider[1], mean + reach)])


def all_roots(
    emulation: Emulation, readings: Readings, options: PointOptions, roots: Roots, seed: int
) -> Roots:
    """Double the starts until simulated specimens get their own inputs back."""
    values = readings.values[np.isfinite(readings.values).all(axis=1)]
    if len(values) < 2 or readings.values.shape[1] < emulation.z.shape[1]:
        return roots

    def find(y: Floats) -> list[Floats]:
        error = np.broadcast_to(np.median(readings.error, axis=0), y.shape)
        relative = np.broadcast_to(readings.is_relative[:1], y.shape)
        measured = replace(Readings.exact(y), error=error, is_relative=relative)
        simulated = specimen_roots(emulation, measured, options)
        return [simulated.z[simulated.specimen == i] for i in range(len(y))]

    good = np.isfinite(emulation.y).all(axis=1)
    run_z = emulation.z[good]
    box = np.stack([run_z.min(axis=0), run_z.max(axis=0)])
    while options.starts < len(emulation.z):
        share = missing_share(find, lambda z: emulation(z)[0], box, values, seed=seed)
        if not share > 0:
            break
        options = replace(options, starts=2 * options.starts)
        roots = specimen_roots(emulation, readings, options)
    return roots


def specimen_roots(emulation: Emulation, readings: Readings, options: PointOptions) -> Roots:
    """Return the roots of the specimens with at least as many measured outputs as inputs."""
    good = np.isfinite(emulation.y).all(axis=1)
    run_z, run_y = emulation.z[good], emulation.y[good]
    measured = readings.is_measured
    target = np.where(measured, readings.values, 0.0)
    scale = np.where(measured, readings.comparison_sd(emulation.error), 1e150)
    solvable = np.flatnonzero(measured.sum(axis=1) >= emulation.z.shape[1])
    # Runs are not chosen by an output that a reading error dominates.
    error = readings.error_sd(target)
    unit = np.hypot(readings.spread(), 10 * np.median(error, axis=0))
    unit = np.where(measured, unit, np.inf)
    neighbours = gabriel_neighbours(run_z)
    parts = []
    # Specimens in blocks: memory stays constant.
    block = max(1, AT_ONCE // (options.starts * len(run_z) * 4))
    for first in range(0, len(solvable), block):
        rows = solvable[first : first + block]
        starts = nearest_starts(run_z, run_y, target[rows], unit[rows], options.starts, neighbours)
        roots = find_roots(
            emulation, target[rows], scale[rows], starts, emulation.box, gap=options.gap
        )
        parts.append(replace(roots, specimen=rows[roots.specimen]))
    arrays = zip(*(vars(part).values() for part in parts), strict=True)
    return Roots(*map(np.concatenate, arrays))


def spread_out(
    z: Floats, box: Floats, count: int, sampled: int, rng: np.random.Generator
) -> Floats:
    """Return points for new runs, (count, d): a sample of the given ones, then points far apart."""
    scale = np.maximum(z.std(axis=0), 1e-9 * (box[1] - box[0]))
    sample = z[rng.permutation(len(z))[: min(sampled, len(z))]]
    around = z[rng.integers(0, len(z), 8 * count)]
    jittered = around + 0.4 * scale * rng.standard_normal(around.shape)
    candidates = np.clip(np.concatenate([z, jittered]), box[0], box[1]) / scale
    points = sample / scale
    squares = np.min([((candidates - p) ** 2).sum(axis=1) for p in points], axis=0)
    rows = farthest_rows(candidates, count - len(points), squares)
    return np.asarray(np.concatenate([points, candidates[rows]]) * scale)


@dataclass(frozen=True, eq=False)
class Coordinates:
    """A smooth map between the aleatory inputs and a vector z with the prior range [-1, 1]."""

    shapes: tuple[tuple[int, ...], ...]  # event shape of each aleatory input
    # (d,): logarithms are positive inputs whose prior spans more than a factor of ten.
    is_log: NDArray[np.bool_]
    # Of the prior range, which has 99 % of the specimens of the prior predictive population.
    center: Floats  # (d,)
    half_width: Floats  # (d,)
    # (2, d): smallest and largest z in data sets of the prior, one for each of 4096 populations. A
    # new data set of the prior exceeds an end with a probability of 1 in 4097.
    bounds: Floats
    is_condition: NDArray[np.bool_]  # (d,): known for each specimen, and not integrated over

    @classmethod
    def of_prior(
        cls,
        inputs: Inputs,
        n: int = 1,
        populations: int = 4096,
        sampler: PopulationSampler | None = None,
    ) -> Coordinates:
        """Return the coordinates of populations of the prior, and bounds of n specimens of each."""
        roots = PriorSampler(inputs.parents)(populations, 0)
        sampler = PopulationSampler(inputs) if sampler is None else sampler
        rng = np.random.default_rng([0, 11])

        def draw(count: int) -> Floats:
            drawn, _ = sampler(roots, count, rng)
            flat = np.concatenate([x.reshape(populations * count, -1) for x in drawn], axis=1)
            return flat[np.isfinite(flat).all(axis=1)]

        flat = draw(1)
        low, high = np.quantile(flat, [0.005, 0.995], axis=0)
        is_log = (flat > 0).all(axis=0) & (high > 10 * low)
        low, high = np.quantile(_logs(flat, is_log), [0.005, 0.995], axis=0)
        half_width = np.where(high > low, (high - low) / 2, 1.0)
        center = (low + high) / 2
        is_condition = np.zeros(center.size, dtype=bool)
        sizes = [int(np.prod(shape, dtype=int)) for shape in inputs.event_shapes]
        for place in inputs.conditions:
            column = sum(sizes[:place])
            is_condition[column] = True
            scale = inputs.aleatory[place].owner.op.scale
            is_log[column], center[column], half_width[column] = scale
        ends = []
        # Specimens in blocks: memory stays constant.
        block = max(1, 16 * AT_ONCE // (populations * len(center)))
        for first in (0, *range(1, n, block)):
            flat = draw(min(block, n - first)) if first else flat
            z = (_logs(flat, is_log) - center) / half_width
            z = z[np.isfinite(z).all(axis=1)]
            ends += [z.min(axis=0), z.max(axis=0)]
        bounds = np.stack([np.min(ends, axis=0), np.max(ends, axis=0)])
        return cls(inputs.event_shapes, is_log, center, half_width, bounds, is_condition)

    @property
    def size(self) -> int:
        """Number of aleatory numbers of a specimen, d."""
        return len(self.center)

    def inputs(self, z: Floats) -> list[Floats]:
        """Return the aleatory inputs, shapes (..., *event), of coordinates (..., d)."""
        flat = self.center + self.half_width * z
        flat = np.where(self.is_log, np.exp(np.where(self.is_log, flat, 0.0)), flat)
        arrays, first = [], 0
        for shape in self.shapes:
            last = first + int(np.prod(shape, dtype=int))
            part = flat[..., first:last]
            arrays.append(part.reshape(*z.shape[:-1], *shape))
            first = last
        return arrays

    def of(self, inputs: Sequence[Floats], batch_ndim: int) -> Floats:
        """Return the coordinates (..., d) of aleatory inputs with so many batch axes."""
        batch = inputs[0].shape[:batch_ndim]
        flat = np.concatenate([x.reshape(*batch, -1) for x in inputs], axis=-1)
        return np.asarray((_logs(flat, self.is_log) - self.center) / self.half_width)

    def log_jacobian(self, z: Floats) -> Floats:
        """Return log|dx/dz|, (..., d) -> (...), of all inputs but conditions."""
        is_log = self.is_log & ~self.is_condition
        logs = np.where(is_log, self.center + self.half_width * z, 0.0).sum(axis=-1)
        return np.asarray(logs + np.log(self.half_width[~self.is_condition]).sum())


@np.errstate(divide="ignore", invalid="ignore")
def _logs(flat: Floats, is_log: NDArray[np.bool_]) -> Floats:
    """Return inputs (..., d), the logarithms of some; NaN of negative values."""
    return np.where(is_log, np.log(np.where(is_log, flat, 1.0)), flat)


def missing_share(
    find_roots: Callable[[Floats], Sequence[Floats]],
    response: Callable[[Floats], Floats],
    box: Floats,
    y: Floats,
    n: int = 128,
    seed: int = 0,
    tolerance: float = 0.03,
) -> float:
    """Return the share of n simulated specimens whose own inputs are not among their roots.

    Inputs x* are uniform in the box of the runs, with responses near the data y, (N, m); NaN if
    there are none. As x* is a draw from its own posterior under a flat population, the share
    estimates the missing posterior mass. A root may differ from x* by ``tolerance`` of the box.
    """
    low, high = box
    y = y[np.isfinite(y).all(axis=1)]
    # Far more inputs than n, as few responses of a large box are near the data.
    inputs = low + (high - low) * sobol(16 * n, len(low), seed)
    responses = response(inputs)
    margin = 0.1 * np.ptp(y, axis=0)
    near = (responses >= y.min(axis=0) - margin) & (responses <= y.max(axis=0) + margin)
    rows = np.flatnonzero(near.all(axis=1))
    # Outputs in the range of the data may be far from all specimens together.
    unit = np.where(y.std(axis=0) > 0, y.std(axis=0), 1.0)
    squares = [(((y - value) / unit) ** 2).sum(axis=1).min() for value in responses[rows]]
    rows = rows[np.array(squares) < 1][:n]
    if not len(rows):
        return np.nan
    is_missing = []
    for roots, x in zip(find_roots(responses[rows]), inputs[rows], strict=True):
        distance = np.abs(np.reshape(roots, (-1, len(low))) - x)
        is_missing.append(not (distance < tolerance * (high - low)).all(axis=1).any())
    return float(np.mean(is_missing))


def half_difference(log_likelihoods_a: Floats, log_likelihoods_b: Floats) -> float:
    """Return the Monte Carlo error of the log-likelihood over the posterior, in nats.

    sd_s sum_i (log L_i^a(theta_s) - log L_i^b(theta_s)) / 2 over posterior draws theta_s, with
    points of two independent halves a and b, both (S, N). A tilt of one nat for each posterior
    standard deviation moves the posterior mean by one standard deviation. A specimen without a
    point in one of the halves is left out. Size and power: docs/likelihood.md.
    """
    is_finite = np.isfinite(log_likelihoods_a) & np.isfinite(log_likelihoods_b)
    with np.errstate(invalid="ignore"):
        by_specimen = np.where(is_finite, log_likelihoods_a - log_likelihoods_b, 0.0)
    difference = by_specimen.sum(axis=1)
    return float(difference.std() / 2)


def predicted_bias(misfit: Floats, jacobian: Floats, x: Floats, size: int) -> Floats:
    """Return the bias that the emulator's error causes, (2, d), in posterior standard deviations.

    The true root lies at x + shift, where shift = -J^+ (run - emulator). From the shifts follow the
    biases of mean (first row) and standard deviation (second row) of each input's population.
    ``misfit`` is run minus emulator, (n, m), at a sample x, (n, d), of the roots of ``size``
    specimens. Infinite if all runs have the same value of an input. At a jump the prediction has
    .10 to .45 of the true size.
    """
    shift = -np.einsum("ndm,nm->nd", np.linalg.pinv(jacobian), misfit)
    sd = x.std(axis=0)
    if (sd == 0).any():
        # Roots at one place, such as the maximum of a response, show no spread.
        return np.full((2, len(sd)), np.inf)
    mean_bias = -shift.mean(axis=0) / sd * np.sqrt(size)
    covariance = ((x - x.mean(axis=0)) * shift).mean(axis=0)
    # var(x) = var(x + shift) - 2 cov(x, shift) - var(shift)
    sd_bias = -(covariance + shift.var(axis=0) / 2) / sd**2 * np.sqrt(2 * size)
    return np.stack([mean_bias, sd_bias])
