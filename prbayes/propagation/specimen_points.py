"""Importance points around the roots of each measured specimen.

The likelihood of specimen i under a population p(x | theta) is

    p(y_i | theta) = integral p(y_i | f(x)) p(x | theta) dx  ~=  sum_k exp(A_ik) p(x_ik | theta).

Points x_ik and numbers A_ik do not contain theta. An emulator of the response is fitted to runs
over the prior's range and at the roots of the specimens. Points are drawn around every root from a
multivariate t distribution, whose mixture over the roots of a specimen is the proposal density.

References
----------
Papadimas, N. and T. Dodwell (2021), A hierarchical Bayesian approach for calibration of stochastic
material models, Data-Centric Engineering 2, e20, doi:10.1017/dce.2021.20.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, expit, gammaln, ndtri

from prbayes._validate import AT_ONCE, IN_CACHE, Floats
from prbayes.emulators.interpolant import Interpolant, fit_interpolant
from prbayes.metrics.readings import Readings
from prbayes.numerics.log_sum_exp import log_sum_exp
from prbayes.numerics.points import sobol
from prbayes.propagation.base import DesignError
from prbayes.propagation.guards import half_difference, missing_share, predicted_bias
from prbayes.propagation.roots import (
    Response,
    Roots,
    find_roots,
    gabriel_neighbours,
    nearest_starts,
)


@dataclass(frozen=True)
class PointOptions:
    """Settings of the points, from the study of guards (docs/likelihood.md).

    Attributes
    ----------
    starts : int
        Fewest starts of the search for roots, by specimen; doubled while simulated specimens do not
        get their inputs back.
    gap : float
        Largest misfit of a root above the specimen's best, in nats.
    points : int
        Points around each root; doubled until two independent halves agree.
    most_points : int
        Largest number of points of a specimen.
    half_difference : float
        Largest standard deviation, over plausible populations, of half the difference between the
        log-likelihoods of the two halves.
    fresh : int
        Runs at roots that measure the emulator's bias; they stay in the emulator.
    bias : float
        Largest bias of a mean or standard deviation of an input, in posterior standard deviations.
        More runs are added where the emulator's error could cause as much.
    floor : float
        Smallest standard deviation of a comparison, as a share of the data's.
    """

    starts: int = 12
    gap: float = 20.0
    points: int = 4
    most_points: int = 4096
    half_difference: float = 0.05
    fresh: int = 16
    bias: float = 0.15
    floor: float = 1e-6
    degrees: float = 5.0


def first_runs(dimensions: int) -> int:
    """Return the number of runs that an emulator of so many inputs starts from."""
    return 64 if dimensions <= 2 else 128 if dimensions <= 4 else 480


class Surface(Protocol):
    """Outputs at coordinates between runs, with their Jacobian."""

    def __call__(self, z: Floats) -> tuple[Floats, Floats]:
        """Return values and Jacobian, (k, d) -> (k, m), (k, m, d)."""

    def values(self, z: Floats) -> Floats:
        """Return the values alone."""


@dataclass(frozen=True, eq=False)
class DifferencedResponse:
    """The response itself, with central differences for its Jacobian: 2 d + 1 runs a point.

    Attributes
    ----------
    values : callable
        Coordinates (k, d) -> outputs (k, m).
    step : float
        In units of the coordinates.
    """

    values: Callable[[Floats], Floats]
    step: float = 1e-5

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
    """Runs of the response, and the emulator through them.

    Attributes
    ----------
    z : ndarray, shape (n, d)
        Coordinates of the runs.
    y : ndarray, shape (n, m)
        Their outputs; NaN where there is no response.
    box : ndarray, shape (2, d)
        Bounds of the search for roots.
    surface : Interpolant
    error : ndarray, shape (m,)
        Standard deviation of the emulator's error at the roots: twice the error at runs there
        before they were part of it.
    bias : float
        Predicted bias of a mean or standard deviation of an input, in posterior standard
        deviations.
    range : ndarray, shape (2, d)
        Of the roots at which runs were made.
    """

    z: Floats
    y: Floats
    box: Floats
    surface: Surface
    error: Floats
    bias: float
    range: Floats

    @classmethod
    def first(
        cls,
        run: Callable[[Floats], Floats],
        z: Floats,
        box: Floats,
        readings: Readings,
        options: PointOptions,
        name: str,
    ) -> Emulation:
        """Return the emulation of runs at first points."""
        y = run(z)
        spread = readings.spread()
        surface, left_out, is_near = surface_near(z, y, readings, spread, name)
        rms = np.sqrt((left_out[is_near] ** 2).mean(axis=0))
        error = np.maximum(2 * rms, options.floor * spread)
        nothing = np.full(z.shape[1], np.inf)
        empty = np.stack([nothing, -nothing])
        return cls(
            z=z,
            y=y,
            box=box,
            surface=surface,
            error=error,
            bias=np.inf,
            range=empty,
        )

    @classmethod
    def of_function(
        cls,
        run: Callable[[Floats], Floats],
        box: Floats,
        search_box: Floats,
        readings: Readings,
        options: PointOptions,
    ) -> Emulation:
        """Return the response itself in place of an emulator, with runs as starts of a search."""
        d = box.shape[1]
        z = box[0] + (box[1] - box[0]) * sobol(first_runs(d), d, 0)
        error = options.floor * readings.spread()
        infinite = np.full(d, np.inf)
        whole = np.stack([-infinite, infinite])
        return cls(
            z=z,
            y=run(z),
            box=search_box,
            surface=DifferencedResponse(run),
            error=error,
            bias=0.0,
            range=whole,
        )

    def covers(self, z: Floats) -> bool:
        """Return whether points lie in the range of the roots at which runs were made."""
        with np.errstate(invalid="ignore"):
            margin = np.nan_to_num(0.1 * np.maximum(self.range[1] - self.range[0], 0.0))
        low, high = self.range
        is_covered = (z >= low - margin) & (z <= high + margin)
        return bool(is_covered.all())

    def __call__(self, z: Floats) -> tuple[Floats, Floats]:
        """Return values and Jacobian, NaN where the nearest run has no response."""
        values, jacobian = self.surface(z)
        failed = self.fails(z)
        if failed.any():
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
        result = np.zeros(len(z), dtype=bool)
        width = self.box[1] - self.box[0]
        if len(z) and of_runs.any() and not _is_farther(of_runs, self.z / width, z / width):
            _, nearest = self._tree.query(z / width)
            result = of_runs[nearest]
        return result

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.z / (self.box[1] - self.box[0]))


def _is_farther(of_runs: NDArray[np.bool_], runs: Floats, points: Floats) -> bool:
    """Return whether each of these runs is farther from all points than another run.

    |x - f|^2 - |x - g|^2 is linear in x: it is least at a corner of the points' range.
    """
    # By columns: along the first axis of many rows it takes five times as long.
    low = np.array([column.min() for column in points.T])
    high = np.array([column.max() for column in points.T])
    middle, reach = (low + high) / 2, (high - low) / 2
    these, others = runs[of_runs, None] - middle, runs[~of_runs] - middle
    # Runs near the middle are most likely nearer.
    others = others[np.argsort((others**2).sum(axis=1))[: len(low) * 8]]
    margin = (these**2).sum(axis=2) - (others**2).sum(axis=1)
    margin = margin - 2 * np.abs(these - others) @ reach
    return bool((margin.max(axis=1, initial=-np.inf) > 0).all())


def emulate(
    run: Callable[[Floats], Floats],
    readings: Readings,
    box: Floats,
    search_box: Floats,
    options: PointOptions,
    *,
    n: int | None = None,
    known: Emulation | None = None,
    seed: int = 0,
    name: str = "response",
) -> tuple[Emulation, Roots]:
    """Fit the emulator: runs over a box, then batches at the roots until the bias is small.

    Parameters
    ----------
    run : callable
        Coordinates (n, d) -> outputs (n, m); NaN where there is no response.
    readings : Readings
    box, search_box : ndarray, shape (2, d)
        Of the first runs, and of the search for roots.
    options : PointOptions
    n : int, optional
        First runs.
    known : Emulation, optional
        Of the same response for other data: runs are added where the roots leave its range.
    seed : int
    name : str
        For messages.

    Raises
    ------
    DesignError
        If the response cannot be emulated well enough.
    """
    d = box.shape[1]
    n = first_runs(d) if n is None else n
    spread = readings.spread()
    if known is None:
        first = box[0] + (box[1] - box[0]) * sobol(n, d, seed)
        emulation = Emulation.first(run, first, search_box, readings, options, name)
    else:
        emulation = known
    rng = np.random.default_rng([seed, 1])
    for batch in range(6):
        roots = specimen_roots(emulation, readings, options)
        if batch < 2 and len(roots.z):
            # Twice at most: a reading that no inputs reproduce is reported.
            emulation = replace(emulation, box=_widened(emulation.box, roots))
            roots = specimen_roots(emulation, readings, options)
        enough = (batch >= 2 or known is not None) and emulation.covers(roots.z)
        if enough and emulation.bias <= options.bias:
            # Zero for the response itself, which no run improves.
            narrowing = 0.0 if emulation.bias == 0 else _narrowing(emulation, readings, roots)
            if narrowing <= options.bias:
                break
        count = max(n // 2, options.fresh)
        fresh = spread_out(roots.z, emulation.box, count, options.fresh, rng)
        emulation = extended(emulation, run, fresh, readings, options, spread, name)
    else:
        roots = specimen_roots(emulation, readings, options)
    options, roots = _all_roots(emulation, readings, options, roots, seed)
    require_accurate(emulation, readings, options, name)
    return emulation, roots


def require_accurate(
    emulation: Emulation, readings: Readings, options: PointOptions, name: str
) -> None:
    """Raise if the emulator's error is as large as the scatter of the data, or shifts populations.

    Raises
    ------
    DesignError
    """
    rough = (
        "the response is not smooth enough for prb.LogLikelihood(): use "
        "metric=prb.ProbabilityResidual(), or more first runs with propagation=prb.Reweighted(n)"
    )
    scatter = readings.robust_spread()
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

    In posterior standard deviations of its standard deviation sigma. The comparison allows an error
    covariance C of a root; the part of it that the runs have overestimated is missing in sigma^2:

        sqrt(2 N) / 2 max_j mean_i sum_r w_ir C_jj / (C_jj + sigma_j^2)

    with weights w_ir of the roots under a normal population that is fitted to them.
    """
    sd = np.where(readings.is_measured, readings.comparison_sd(emulation.error), 1.0)
    factor = (sd / emulation.error)[roots.specimen][:, :, None]
    table, log_mass, covariance = _laplace(roots, emulation.box)
    _, _, of_error = _laplace(replace(roots, jacobian=roots.jacobian * factor), emulation.box)
    ((mean, root),) = normal_populations(roots.z[table], log_mass, 1, 0, bootstrap=False)
    w = _normalised_weights(normal_log_density(roots.z[table], mean, root) + log_mass)
    whole, part = (np.einsum("rdd->rd", each)[table] for each in (covariance, of_error))
    share = np.einsum("nr,nrd->nd", w, part / (whole + (root**2).sum(axis=1)))
    return float(np.sqrt(len(share) / 2) * share.mean(axis=0).max())


def _laplace(roots: Roots, box: Floats) -> tuple[NDArray[np.intp], Floats, Floats]:
    """Return the roots of each specimen that has some, their log masses, and covariances.

    Returns
    -------
    table : ndarray of int, shape (N, most)
        Rows of the roots, filled up with -1.
    log_mass : ndarray, shape (N, most)
    covariance : ndarray, shape (R, d, d)
    """
    precision = np.einsum("rmd,rme->rde", roots.jacobian, roots.jacobian)
    precision = precision + np.diag(4.0 / (box[1] - box[0]) ** 2)
    _, specimen = np.unique(roots.specimen, return_inverse=True)
    table = _Components(specimen, roots.z, precision, roots.misfit).table
    log_mass = -np.linalg.slogdet(precision)[1] / 2 - roots.misfit
    masses = np.where(table >= 0, log_mass[table], -np.inf)
    return table, masses, np.linalg.inv(precision)


def extended(
    emulation: Emulation,
    run: Callable[[Floats], Floats],
    fresh: Floats,
    readings: Readings,
    options: PointOptions,
    spread: Floats,
    name: str,
    sampled: int | None = None,
) -> Emulation:
    """Return the emulation with runs at fresh points, whose misfit gives its error and bias.

    The misfit is that of the emulator before at the first points. With `sampled` it is the left-out
    error of the new emulator at so many first points, which are a sample of the specimens' inputs.
    """
    values, jacobian = emulation.surface(fresh)
    outputs = run(fresh)
    z = np.concatenate([emulation.z, fresh])
    y = np.concatenate([emulation.y, outputs])
    surface, left_out, _ = surface_near(z, y, readings, spread, name)
    misfit = outputs - values if sampled is None else left_out[len(emulation.z) :]
    good = np.isfinite(misfit).all(axis=1)
    error, bias = emulation.error, np.inf
    count = options.fresh if sampled is None else sampled
    some = np.flatnonzero(good[:count])
    if len(some) >= 4:
        # At the roots alone: points around them may lie far out, where nothing was measured.
        error = 2 * np.sqrt((misfit[some] ** 2).mean(axis=0))
        error = np.maximum(error, options.floor * spread)
        unit = typical_sd(readings.comparison_sd(error))
        scaled = misfit[some] / unit, jacobian[some] / unit[:, None]
        bias = float(np.abs(predicted_bias(*scaled, fresh[some], len(readings))).max())
        # m readings identify m of d directions; the posterior is wider than the formula assumes.
        readings_per_specimen = (readings.is_measured | readings.is_censored).sum(axis=1).mean()
        bias *= np.sqrt(min(1.0, readings_per_specimen / fresh.shape[1]))
    reach = np.concatenate([emulation.range, fresh])
    extremes = np.stack([reach.min(axis=0), reach.max(axis=0)])
    return Emulation(
        z=z,
        y=y,
        box=emulation.box,
        surface=surface,
        error=error,
        bias=bias,
        range=extremes,
    )


def typical_sd(sd: Floats) -> Floats:
    """Return the median of finite values by output, (N, m) -> (m,)."""
    return np.array([np.median(column[np.isfinite(column)]) for column in sd.T])


def surface_near(
    z: Floats, y: Floats, readings: Readings, spread: Floats, name: str
) -> tuple[Interpolant, Floats, NDArray[np.bool_]]:
    """Return the interpolant, left-out errors, (n, m), and which runs are near the data, (n,).

    Of runs that are equal to nine digits one is taken: others add nothing but rounding errors.
    Left-out errors are NaN where there is no response.
    """
    good = np.isfinite(y).all(axis=1)
    if good.sum() < 8:
        raise DesignError(
            f"{name}: got {int(good.sum())} runs with a response of {len(y)}, expected at least 8; "
            "check the response, or give the hyperparameters priors where it exists"
        )
    rows = np.flatnonzero(good)
    _, first, copies = np.unique(
        np.round(z[rows], 9), axis=0, return_index=True, return_inverse=True
    )
    zg = z[rows[first]]
    yg = _limited(y[rows[first]], readings, spread)
    inside = _is_near(yg, readings, spread)
    if inside.sum() < len(yg) // 4:
        distance = (((yg - np.nanmean(readings.values, axis=0)) / spread) ** 2).sum(axis=1)
        inside = np.zeros(len(yg), dtype=bool)
        inside[np.argsort(distance, kind="stable")[: max(8, len(yg) // 4)]] = True
    surface = fit_interpolant(zg, yg, inside)
    left_out, is_near = np.full_like(y, np.nan), np.zeros(len(y), dtype=bool)
    left_out[rows], is_near[rows] = surface.left_out[copies.ravel()], inside[copies.ravel()]
    return surface, left_out, is_near


def _limited(y: Floats, readings: Readings, spread: Floats, most: float = 1e4) -> Floats:
    """Return outputs (n, m) within a distance of the data, beyond which they are not resolved.

    A response that is steep outside the data would take the digits that outputs near them need.
    The distance is `most` standard deviations of the data, and at least ten times that of 90 % of
    the runs, so that outputs over a wide prior keep their values.
    """
    center = np.nanmean(readings.values, axis=0)
    away = np.abs(y - center)
    largest = np.maximum(most * spread, 10 * np.quantile(away, 0.9, axis=0))
    return np.clip(y, center - largest, center + largest)


def _widened(box: Floats, roots: Roots, misfit: float = 50.0, outside: float = 1 / 4097) -> Floats:
    """Return the box with more room where roots or their population reach beyond its sides.

    A quarter where the search for a root ends at the side with a misfit. And room for a normal
    population that is fitted to the roots: all specimens of a data set are within the box, with a
    probability as of `Coordinates.bounds`.
    """
    poor = roots.z[roots.misfit > misfit]
    width = box[1] - box[0]
    at_low = poor <= box[0] + 1e-6 * width
    at_high = poor >= box[1] - 1e-6 * width
    ends = np.stack([at_low, at_high])
    wider = box + 0.25 * width * np.array([[-1.0], [1.0]]) * ends.any(axis=1)
    table, log_mass, _ = _laplace(roots, box)
    ((mean, root),) = normal_populations(roots.z[table], log_mass, 1, 0, bootstrap=False)
    sd = np.sqrt((root**2).sum(axis=1))
    reach = -ndtri(outside / len(table)) * sd
    low = np.minimum(wider[0], mean - reach)
    high = np.maximum(wider[1], mean + reach)
    return np.stack([low, high])


def _all_roots(
    emulation: Emulation, readings: Readings, options: PointOptions, roots: Roots, seed: int
) -> tuple[PointOptions, Roots]:
    """Double the starts until simulated specimens get their own inputs back."""
    values = readings.values[np.isfinite(readings.values).all(axis=1)]
    if len(values) < 2 or readings.values.shape[1] < emulation.z.shape[1]:
        return options, roots

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
    return options, roots


def _is_near(y: Floats, readings: Readings, spread: Floats) -> NDArray[np.bool_]:
    """Return which outputs, (n, m), are within the range of the readings or half of it away."""
    low, high = np.nanmin(readings.values, axis=0), np.nanmax(readings.values, axis=0)
    margin = np.maximum((high - low) / 2, spread)
    is_near = (y >= low - margin) & (y <= high + margin)
    return np.asarray(is_near.all(axis=1))


def specimen_roots(emulation: Emulation, readings: Readings, options: PointOptions) -> Roots:
    """Return the roots of the specimens with at least as many measured outputs as inputs."""
    good = np.isfinite(emulation.y).all(axis=1)
    run_z, run_y = emulation.z[good], emulation.y[good]
    measured = readings.is_measured
    target = np.where(measured, readings.values, 0.0)
    sd = readings.comparison_sd(emulation.error)
    solvable = np.flatnonzero(measured.sum(axis=1) >= emulation.z.shape[1])
    # Runs are not chosen by an output that a reading error dominates.
    error = readings.error_sd(target)
    unit = np.hypot(readings.spread(), 10 * np.median(error, axis=0))
    unit = np.where(measured, unit, np.inf)
    neighbours = gabriel_neighbours(run_z)
    parts = []
    # Specimens in blocks, so that memory stays constant.
    block = max(1, AT_ONCE // (options.starts * len(run_z) * 4))
    for first in range(0, len(solvable), block):
        rows = solvable[first : first + block]
        starts = nearest_starts(run_z, run_y, target[rows], unit[rows], options.starts, neighbours)
        roots = find_roots(
            emulation,
            target[rows],
            np.where(measured[rows], sd[rows], 1e150),
            starts,
            emulation.box,
            gap=options.gap,
        )
        parts.append((roots, rows))
    names = ("z", "misfit", "residual", "jacobian")
    joined = [np.concatenate([getattr(r, name) for r, _ in parts]) for name in names]
    specimen = np.concatenate([rows[r.specimen] for r, rows in parts])
    return Roots(specimen, *joined)


def spread_out(
    z: Floats, box: Floats, count: int, sampled: int, rng: np.random.Generator
) -> Floats:
    """Return points for new runs, (count, d): a sample of the given ones, then others spread out.

    The spread ones are chosen one by one, each farthest from all others, among the given points
    and points around them.
    """
    scale = np.maximum(z.std(axis=0), 1e-9 * (box[1] - box[0]))
    chosen = z[rng.permutation(len(z))[: min(sampled, len(z))]]
    around = z[rng.integers(0, len(z), 8 * count)]
    jittered = around + 0.4 * scale * rng.standard_normal(around.shape)
    both = np.concatenate([z, jittered])
    candidates = np.clip(both, box[0], box[1]) / scale
    picked = list(chosen / scale)
    distance = np.min([((candidates - p) ** 2).sum(axis=1) for p in picked], axis=0)
    while len(picked) < count:
        best = int(np.argmax(distance))
        picked.append(candidates[best])
        distance = np.minimum(distance, ((candidates - candidates[best]) ** 2).sum(axis=1))
    return np.asarray(np.array(picked) * scale)


# -- points ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SpecimenPoints:
    """Points of N specimens.

    Attributes
    ----------
    z : ndarray, shape (N, K, d)
    outputs : ndarray, shape (N, K, m)
        The emulator's outputs at the points.
    log_a : ndarray, shape (N, K)
        The log-likelihood of a specimen under a density p of z is
        ``logsumexp(log p(z) + log_a, axis=1)``; -inf for points that fill up the array.
    log_proposal : ndarray, shape (N, K)
        Log of the number of points times the proposal density: ``log_a`` without the density of
        the readings, for an error that is not known in advance.
    n_roots : ndarray of int, shape (N,)
    difference : float
        The half difference of the log-likelihoods.
    """

    z: Floats
    outputs: Floats
    log_a: Floats
    log_proposal: Floats
    n_roots: NDArray[np.intp]
    difference: float


@dataclass(frozen=True, eq=False)
class _Components:
    """Multivariate t components, one for each root."""

    specimen: NDArray[np.intp]  # (R,)
    center: Floats  # (R, d)
    root: Floats  # (R, d, d): lower Cholesky factors of the scale matrices
    log_mass: Floats  # (R,): log of the integral of the readings' density; NaN of uncertain ones

    @property
    def sd(self) -> Floats:
        """Standard deviations of the components by input, (R, d)."""
        return np.asarray(np.sqrt(np.einsum("rde,rde->rd", self.root, self.root)))

    @property
    def table(self) -> NDArray[np.intp]:
        """The components of each specimen, (N, most), filled up with -1."""
        count = np.bincount(self.specimen)
        first = np.cumsum(count) - count
        slot = np.arange(len(self.specimen)) - np.repeat(first, count)
        table = np.full((len(count), count.max()), -1)
        table[self.specimen, slot] = np.arange(len(self.specimen))
        return table

    def of_specimens(self, rows: NDArray[np.intp]) -> _Components:
        """Return the components of some specimens, with the numbers 0, 1, ..."""
        place = np.searchsorted(rows, self.specimen)
        is_of_rows = np.isin(self.specimen, rows)
        _, *others = (field[is_of_rows] for field in _fields(self))
        return _Components(place[is_of_rows], *others)


def draw_points(
    emulation: Response,
    error: Floats,
    readings: Readings,
    roots: Roots,
    box: Floats,
    options: PointOptions,
    *,
    error_is_known: bool = True,
    seed: int = 0,
) -> SpecimenPoints:
    """Draw points around all roots until two independent halves of them agree.

    Parameters
    ----------
    emulation : callable
    error : ndarray, shape (m,)
        Standard deviation of its error.
    readings : Readings
        A specimen without a root, whose readings are censored, gets points of the population.
    roots : Roots
    box : ndarray, shape (2, d)
    options : PointOptions
    error_is_known : bool
        Whether the error of the readings is the one given; else it is about so large. With a known
        error the weights around the root of certain readings are scaled to its mass, which 256
        points measure.
    seed : int

    Raises
    ------
    DesignError
        If `most_points` are not enough.
    """
    components = _fit_components(emulation, error, readings, roots, box, options, seed)
    is_certain = np.isfinite(components.log_mass).all()
    count = options.points * (1 if is_certain and error_is_known else 16)
    scales = (1.0,) if error_is_known else (0.125, 0.25, 0.5, 1.0, 1.3)
    fits: dict[float, list[tuple[Floats, Floats]]] = {}
    # Where the error of the readings is as large as the scatter, populations may be much narrower
    # than their fit. They are added step by step: too few points exclude them wrongly.
    narrowing = [1.0, 0.5]
    while True:
        halves = [
            _draw(emulation, error, readings, components, max(1, count // 2), options, (seed, h))
            for h in (1, 2)
        ]
        if error_is_known:
            halves = [_normalised(half, components) for half in halves]
        points = _joined(halves)
        of_error = {
            k: halves if k == 1.0 else _of_error(halves, readings, error, k) for k in scales
        }
        samples = {k: _joined(pair) for k, pair in of_error.items()}
        fits = fits or {k: normal_populations(x.z, x.log_a, 32, seed) for k, x in samples.items()}
        difference = 0.0
        while narrowing and difference <= options.half_difference:
            plausible = _plausible(samples, fits, narrowing[0])
            values = [_difference(of_error[k], few) for k, few in plausible.items() if few]
            difference = max(values, default=0.0)
            narrowing = narrowing[1:] if difference <= options.half_difference else narrowing
        largest = components.table.shape[1] * count
        if difference <= options.half_difference or 2 * largest > options.most_points:
            break
        count *= 2
    if difference > options.half_difference and narrowing[0] == 1.0:
        raise DesignError(
            f"log-likelihood: got two halves of {largest} points a specimen that differ by "
            f"{difference:.2g} nats, expected at most {options.half_difference}; use another "
            "metric, such as prb.ProbabilityResidual()"
        )
    n_roots = np.bincount(roots.specimen, minlength=len(readings))
    return SpecimenPoints(
        z=points.z,
        outputs=points.outputs,
        log_a=points.log_a,
        log_proposal=points.log_proposal,
        n_roots=n_roots,
        difference=difference,
    )


def _plausible(
    samples: dict[float, _Sample],
    fits: dict[float, list[tuple[Floats, Floats]]],
    narrowing: float,
    largest: float = 4.0,
) -> dict[float, list[tuple[Floats, Floats]]]:
    """Return narrowed normal populations that the data do not exclude, by scale of the error.

    Parameters
    ----------
    samples, fits : dict
        Points and bootstrap fits, by scale of the reading error.
    narrowing : float
        Factor of the fits' standard deviations.
    largest : float
        Difference from the largest log-likelihood of the fits, in nats.
    """

    def likely(sample: _Sample, few: list[tuple[Floats, Floats]]) -> Floats:
        return _log_likelihoods(sample, few).sum(axis=1)

    best = max(likely(samples[k], few).max() for k, few in fits.items())
    narrowed = {k: [(mean, narrowing * root) for mean, root in few] for k, few in fits.items()}
    return {
        k: list(compress(few, likely(samples[k], few) > best - largest))
        for k, few in narrowed.items()
    }


def _log_likelihoods(sample: _Sample, populations: list[tuple[Floats, Floats]]) -> Floats:
    """Return the log-likelihoods of the specimens in B normal populations, (B, N)."""
    block = max(1, IN_CACHE // sample.log_a.size)
    parts = []
    for first in range(0, len(populations), block):
        mean, root = map(np.stack, zip(*populations[first : first + block], strict=True))
        parts.append(log_sum_exp(normal_log_density(sample.z, mean, root) + sample.log_a))
    return np.concatenate(parts)


def _of_error(
    halves: list[_Sample], readings: Readings, error: Floats, factor: float
) -> list[_Sample]:
    """Return samples with the weights of another reading error."""
    other = readings.scaled(factor)
    return [
        replace(half, log_a=other.log_density(half.outputs, error) - half.log_proposal)
        for half in halves
    ]


def _fit_components(
    emulation: Response,
    error: Floats,
    readings: Readings,
    roots: Roots,
    box: Floats,
    options: PointOptions,
    seed: int,
    fine: int = 256,
    share: float = 0.1,
) -> _Components:
    """Return a t component for each root, fitted to the readings' density around it.

    The first scale matrix is that of the Gauss-Newton approximation, within the box. Where the
    weights of 256 points are uneven, as at a turning point of the response, location and scale
    become their weighted moments, twice. The points of the last components give the population and
    the masses. Where the readings leave an input about as uncertain as the population does, the
    component is that of the specimen given a population twice as wide. A component or a reading
    that is uncertain by this share of the scatter has no mass: see `_normalised`.
    """
    d = roots.z.shape[1] if len(roots.z) else box.shape[1]
    precision = np.einsum("rmd,rme->rde", roots.jacobian, roots.jacobian)
    precision = precision + np.diag(4.0 / (box[1] - box[0]) ** 2)
    scale = np.linalg.cholesky(1.5 * np.linalg.inv(precision))
    components = _Components(roots.specimen, roots.z, scale, np.zeros(len(scale)))
    mean, covariance = np.zeros(d), 0.15 * np.eye(d)
    some = np.unique(roots.specimen)
    if some.size:
        # Specimens without a root wait for the population of the others.
        own = readings.rows(some)
        rank = _Components(np.searchsorted(some, roots.specimen), *_fields(components)[1:])
        rank, sample = _moment_matched(emulation, error, own, rank, options, seed, fine)
        ((mean, root),) = normal_populations(sample.z, sample.log_a, 1, seed, bootstrap=False)
        covariance = root @ root.T
        scatter = np.sqrt(np.diag(covariance))
        is_pulled = (rank.sd > 0.2 * scatter).any()
        if is_pulled:
            wide = np.linalg.inv(4 * covariance)
            narrow = np.linalg.inv(rank.root @ rank.root.swapaxes(1, 2) / 1.5)
            combined = np.linalg.inv(narrow + wide)
            pull = np.einsum("rde,re->rd", narrow, rank.center) + wide @ mean
            center = np.einsum("rde,re->rd", combined, pull)
            # Roots of another population, such as a mirror one, keep their components.
            away = rank.center - mean
            spread = np.linalg.inv(narrow) + 4 * covariance
            square = np.einsum("rd,rd->r", away, np.linalg.solve(spread, away[..., None])[..., 0])
            is_near = (square < chdtri(d, 0.001))[:, None]
            combined_root = np.linalg.cholesky(1.5 * combined)
            rank = replace(
                rank,
                center=np.where(is_near, center, rank.center),
                root=np.where(is_near[..., None], combined_root, rank.root),
            )
        is_wide = (rank.sd > share * scatter).any(axis=1)
        is_noisy = (own.comparison_sd(error) > share * readings.spread()) & own.is_measured
        is_uncertain = (is_noisy | own.is_censored).any(axis=1)
        has_mass = ~(is_wide | is_uncertain[rank.specimen])
        if is_pulled and has_mass.any():
            sample = _draw(emulation, error, own, rank, fine, options, (seed, 9))
        log_mass = np.where(has_mass, _component_weights(sample, rank)[1], np.nan)
        components = _Components(some[rank.specimen], rank.center, rank.root, log_mass)
    without = np.setdiff1d(np.arange(len(readings)), some)
    if without.size:
        # Eight components of the population, and sixteen over the box: the specimens with a root
        # may be few, and far from the others.
        width = box[1] - box[0]
        centers = np.concatenate([np.tile(mean, (8, 1)), box[0] + width * sobol(16, d, seed)])
        roots_of_population = np.tile(2.5 * np.linalg.cholesky(covariance), (8, 1, 1))
        roots_of_box = np.tile(np.diag(width / 16 ** (1 / d)), (16, 1, 1))
        specimen = np.repeat(without, len(centers))
        center = np.tile(centers, (len(without), 1))
        root = np.tile(np.concatenate([roots_of_population, roots_of_box]), (len(without), 1, 1))
        added = (specimen, center, root, np.full(len(specimen), np.nan))
        joined = [np.concatenate(pair) for pair in zip(_fields(components), added, strict=True)]
        order = np.argsort(joined[0], kind="stable")
        components = _Components(*(field[order] for field in joined))
    return components


def _fields(components: _Components) -> tuple[Any, ...]:
    return components.specimen, components.center, components.root, components.log_mass


def _moment_matched(
    emulation: Response,
    error: Floats,
    readings: Readings,
    components: _Components,
    options: PointOptions,
    seed: int,
    fine: int,
) -> tuple[_Components, _Sample]:
    """Return components with the weighted moments of uneven points, and points of all components.

    Only specimens with a changed component get other points.
    """
    d = components.center.shape[1]
    sample = _draw(emulation, error, readings, components, fine, options, (seed, 3))
    for attempt in range(2):
        weights, log_mass = _component_weights(sample, components)
        size = 1 / np.maximum((weights**2).sum(axis=1), 1e-300)
        uneven = np.flatnonzero((size < fine / 2) & np.isfinite(log_mass))
        if not uneven.size:
            break
        z = _by_component(sample.z, components)[uneven]
        w = weights[uneven]
        center = np.einsum("rk,rkd->rd", w, z)
        away = z - center[:, None]
        covariance = np.einsum("rk,rkd,rke->rde", w, away, away)
        before = components.root[uneven] @ components.root[uneven].swapaxes(1, 2)
        # A few effective points leave most of the scale as it was.
        trust = (size[uneven] / (size[uneven] + 4 * d))[:, None, None]
        covariance = trust * 1.5 * covariance + (1 - trust) * before
        new_center, new_root = components.center.copy(), components.root.copy()
        new_center[uneven] = center
        new_root[uneven] = np.linalg.cholesky(covariance + 1e-14 * before)
        components = replace(components, center=new_center, root=new_root)
        changed = np.unique(components.specimen[uneven])
        fresh = _draw(
            emulation,
            error,
            readings.rows(changed),
            components.of_specimens(changed),
            fine,
            options,
            (seed, 4 + attempt),
        )
        sample = sample.with_rows(changed, fresh)
    return components, sample


@dataclass(frozen=True, eq=False)
class _Sample:
    """Points by specimen, filled up to the largest number of roots."""

    z: Floats  # (N, S * k, d)
    outputs: Floats  # (N, S * k, m)
    log_a: Floats  # (N, S * k)
    log_proposal: Floats  # (N, S * k)
    n_roots: NDArray[np.intp]  # (N,)

    def with_rows(self, rows: NDArray[np.intp], sample: _Sample) -> _Sample:
        """Return the sample with the points of another one for some specimens."""
        arrays = {}
        for name in ("z", "outputs", "log_a", "log_proposal"):
            values = getattr(sample, name)
            arrays[name] = getattr(self, name).copy()
            # Without the places of more roots that others have.
            arrays[name][rows, : values.shape[1]] = values
        return replace(self, **arrays)


def _draw(
    emulation: Response,
    error: Floats,
    readings: Readings,
    components: _Components,
    count: int,
    options: PointOptions,
    seed: tuple[int, int],
) -> _Sample:
    """Draw points from each component, weighted by the mixture over a specimen's components."""
    table = components.table
    n, slots = table.shape
    d = components.center.shape[1]
    u = _scrambled(len(components.specimen), count, d + 1, seed)
    nu = options.degrees
    normal = ndtri(u[..., :d])
    normal *= _t_radius(u[..., d], nu)[..., None]
    z = components.center[:, None] + normal @ components.root.swapaxes(1, 2)
    values = _in_blocks(emulation, z.reshape(-1, d))
    # By specimen.
    filled = np.maximum(table, 0)
    z_all = z[filled].reshape(n, slots * count, d)
    by_root = values.reshape(len(z), count, -1)
    outputs = by_root[filled].reshape(n, slots * count, -1)
    log_q = np.full((n, slots, slots * count), -np.inf)
    for s in range(slots):
        c = filled[:, s]
        away = z_all - components.center[c][:, None]
        inverse = np.linalg.inv(components.root[c])
        standard = away @ inverse.swapaxes(1, 2)
        square = np.einsum("nkd,nkd->nk", standard, standard)
        log_det = np.log(np.einsum("ndd->nd", components.root[c])).sum(axis=1)
        constant = gammaln((nu + d) / 2) - gammaln(nu / 2) - d / 2 * np.log(nu * np.pi)
        tail = (nu + d) / 2 * np.log1p(square / nu)
        density = constant - log_det[:, None] - tail
        log_q[:, s] = np.where(table[:, s, None] >= 0, density, -np.inf)
    log_proposal = log_sum_exp(log_q.swapaxes(1, 2)) + np.log(count)
    exists = np.repeat(table >= 0, count, axis=1)
    log_proposal = np.where(exists, log_proposal, np.inf)
    log_a = readings.log_density(outputs, error) - log_proposal
    return _Sample(
        z=z_all,
        outputs=outputs,
        log_a=log_a,
        log_proposal=log_proposal,
        n_roots=(table >= 0).sum(axis=1),
    )


def _in_blocks(emulation: Response, z: Floats) -> Floats:
    """Return values at points, without the Jacobian where the emulation has them alone."""
    values = getattr(emulation, "values", lambda z: emulation(z)[0])
    step = IN_CACHE
    return np.concatenate([values(z[first : first + step]) for first in range(0, len(z), step)])


def _scrambled(components: int, count: int, dimensions: int, seed: tuple[int, int]) -> Floats:
    """Return Sobol points with a random shift for each component, (components, count, d)."""
    base = sobol(count, dimensions, seed[0] * 1009 + seed[1])
    u = base + np.random.default_rng(seed).random((components, 1, dimensions))
    u -= u >= 1.0
    return np.clip(u, 1e-9, 1 - 1e-9, out=u)


def _t_radius(u: Floats, degrees: float) -> Floats:
    """Return the factors that turn normal vectors into vectors of a t distribution.

    Their log is smooth in the logit of u. A spline of it, to nine digits, takes a tenth of the time
    of the quantiles.
    """
    from scipy.interpolate import CubicSpline  # takes long to import

    knots = np.linspace(-21.0, 21.0, 513)
    cubic, *others = CubicSpline(knots, 0.5 * np.log(degrees / chdtri(degrees, expit(knots)))).c
    away = np.log(u / (1.0 - u)) - knots[0]
    piece = (away / (knots[1] - knots[0])).astype(np.intp)
    away -= (knots - knots[0])[piece]
    log_radius = cubic[piece]
    for coefficient in others:
        log_radius *= away
        log_radius += coefficient[piece]
    return np.asarray(np.exp(log_radius, out=log_radius))


def _by_component(values: Floats, components: _Components) -> Floats:
    """Return values by component, (R, k, ...), of values by specimen, (N, S * k, ...)."""
    table = components.table
    n, slots = table.shape
    count = values.shape[1] // slots
    shaped = values.reshape(n, slots, count, *values.shape[2:])
    rows, columns = np.nonzero(table >= 0)
    result = np.empty((len(components.specimen), count, *values.shape[2:]))
    result[table[rows, columns]] = shaped[rows, columns]
    return result


def _component_weights(sample: _Sample, components: _Components) -> tuple[Floats, Floats]:
    """Return normalised weights, (R, k), and log masses, (R,), by component."""
    log_a = _by_component(sample.log_a, components)
    log_mass = log_sum_exp(log_a)
    safe = np.where(np.isfinite(log_mass), log_mass, 0.0)
    return np.exp(log_a - safe[:, None]), log_mass


def _normalised(sample: _Sample, components: _Components) -> _Sample:
    """Scale the weights of the points around each root to the root's mass, if there is one.

    Few points with scaled weights have too small a variance: a negligible bias if the readings are
    certain. Both halves have that bias, so that their difference does not show it.
    """
    table = components.table
    n, slots = table.shape
    log_a = sample.log_a.reshape(n, slots, -1)
    total = log_sum_exp(log_a)
    by_slot = components.log_mass[np.maximum(table, 0)]
    mass = np.where(table >= 0, by_slot, -np.inf)
    scales = np.isfinite(total) & np.isfinite(mass)
    shift = np.where(scales, mass - np.where(scales, total, 0.0), 0.0)
    scaled = (log_a + shift[..., None]).reshape(n, -1)
    return replace(sample, log_a=scaled)


def _joined(halves: list[_Sample]) -> _Sample:
    """Return two independent samples as one; each counts half."""
    first, second = halves
    return _Sample(
        np.concatenate([first.z, second.z], axis=1),
        np.concatenate([first.outputs, second.outputs], axis=1),
        np.concatenate([first.log_a, second.log_a], axis=1) - np.log(2),
        np.concatenate([first.log_proposal, second.log_proposal], axis=1) + np.log(2),
        first.n_roots,
    )


def _difference(halves: list[_Sample], populations: list[tuple[Floats, Floats]]) -> float:
    """Return the half difference of log L over normal populations."""
    return half_difference(*(_log_likelihoods(half, populations) for half in halves))


def normal_populations(
    z: Floats, log_a: Floats, draws: int, seed: int, steps: int = 30, bootstrap: bool = True
) -> list[tuple[Floats, Floats]]:
    """Fit normal populations to Bayesian bootstrap samples of the specimens, by EM.

    Returns
    -------
    list of (mean (d,), root (d, d))
        Means and lower Cholesky factors of the covariances.
    """
    rng = np.random.default_rng([seed, 7])
    n, count, d = z.shape
    columns = np.ascontiguousarray(z.reshape(-1, d).T)
    prior = 1e-12 * np.diag(np.maximum(columns.var(axis=1), 1e-300))

    def moments(weights: Floats) -> tuple[Floats, Floats]:
        weights = weights.reshape(len(weights), -1)
        mean = weights @ columns.T
        away = columns - mean[..., None]
        return mean, (away * weights[:, None]) @ away.swapaxes(1, 2) + prior

    def fit(start: tuple[Floats, Floats], share: Floats, steps: int) -> tuple[Floats, Floats]:
        mean, covariance = start
        for _ in range(steps):
            log_w = normal_log_density(z, mean, np.linalg.cholesky(covariance)) + log_a
            mean_before, covariance_before = mean, covariance
            mean, covariance = moments(_normalised_weights(log_w) * share[..., None])
            variance = np.einsum("...dd->...d", covariance)
            change = np.einsum("...dd->...d", covariance - covariance_before) / variance
            shift = (mean - mean_before) / np.sqrt(variance)
            if max(np.abs(change).max(), np.abs(shift).max()) < 1e-9:
                break
        return mean, covariance

    equal = np.full((1, n), 1 / n)
    mean, covariance = fit(moments(_normalised_weights(log_a)[None] / n), equal, steps)
    if bootstrap:
        # A bootstrap sample has its fit near that of all specimens. In blocks, for memory's sake.
        shares = np.stack([rng.dirichlet(np.ones(n)) for _ in range(draws)])
        block = max(1, IN_CACHE // (n * count))
        fits = [
            fit((mean, covariance), shares[first : first + block], 5)
            for first in range(0, draws, block)
        ]
        mean, covariance = (np.concatenate(parts) for parts in zip(*fits, strict=True))
    return list(zip(mean, np.linalg.cholesky(covariance), strict=True))


def _normalised_weights(log_w: Floats) -> Floats:
    """Return weights with sum 1 along the last axis."""
    weights = np.exp(log_w - log_w.max(axis=-1, keepdims=True))
    return np.asarray(weights / weights.sum(axis=-1, keepdims=True))


def normal_log_density(z: Floats, mean: Floats, root: Floats) -> Floats:
    """Return log-densities of points in normal populations, of one or of B.

    Parameters
    ----------
    z : ndarray, shape (..., d)
    mean : ndarray, shape (d,) or (B, d)
    root : ndarray, shape (d, d) or (B, d, d)
        Lower Cholesky factors of the covariances.

    Returns
    -------
    ndarray, shape (...) or (B, ...)
    """
    d = z.shape[-1]
    away = np.ascontiguousarray(z.reshape(-1, d).T) - mean[..., None]
    standard = np.linalg.inv(root) @ away
    square = np.einsum("...dk,...dk->...k", standard, standard)
    constant = np.log(np.einsum("...dd->...d", root)).sum(axis=-1) + d / 2 * np.log(2 * np.pi)
    return np.asarray(-0.5 * square - constant[..., None]).reshape(*mean.shape[:-1], *z.shape[:-1])
