"""Runs of a response where the measured specimens are.

A few runs over the prior predictive population, then batches: a sample of the specimens' likely
inputs, whose misfit measures the error of the emulator before they join it, points far from all
runs, and points of the prior where a specimen could lie.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri, ndtri

from prbayes._finding import any_of
from prbayes._validate import ArrayFunction, Bools, Floats, Indices, complete_rows
from prbayes.metrics.readings import has_error, located_values, relative_error
from prbayes.numerics.points import farthest_rows, sobol
from prbayes.propagation.base import DesignError
from prbayes.specimens.emulation import Emulation, Surface, fit_surface, predicted_bias
from prbayes.specimens.points import (
    Draws,
    Plausible,
    SpecimenData,
    SpecimenPoints,
    are_near,
    at_scale,
    draw_points,
    draws_of,
    fit_proposals,
    likely_scale,
    likely_weights,
    normal_of,
    residuals_of,
    typical_specimens,
)
from prbayes.specimens.proposals import Normal, Proposals, best_rows, mode_coordinates
from prbayes.specimens.weighted_points import fit_normal


def first_runs(dimensions: int) -> int:
    """Return the default number of first runs for an emulator of so many inputs."""
    return 6 * dimensions + 4


def most_runs(dimensions: int) -> int:
    """Return the largest number of runs before a response is refused."""
    return 256 if dimensions < 2 else 384 if dimensions == 2 else 512 if dimensions <= 4 else 1920


# Coordinates (n, d) -> outputs (n, m), NaN where there is no response.
type Run = ArrayFunction


def first_emulation(run: Run, data: SpecimenData) -> Emulation:
    """Return the emulation through first runs, 1.5 times as wide as the prior's population."""
    d = data.known.shape[1]
    n = data.options.n_first or first_runs(d)
    u = sobol(n, d, data.seed)
    population = normal_of(data.inner[:, data.free])
    z = np.empty((n, d))
    normal = ndtri(u[:, : len(data.free)])
    z[:, data.free] = population.mean + 1.5 * normal @ population.root.T
    low = data.prior.min(axis=0)
    high = data.prior.max(axis=0)
    z = np.clip(z, low, high)
    conditions = np.flatnonzero(~np.isnan(data.known[0]))
    # Runs have the conditions of the specimens.
    for place, column in enumerate(conditions):
        values = np.quantile(data.known[:, column], u[:, len(data.free) + place])
        z[:, column] = values
    y = run(z)
    while np.isfinite(y).all(axis=1).sum() < 8 and len(z) < 8 * n:
        rng = np.random.default_rng([data.seed, len(z)])
        rows = rng.integers(0, len(data.inner), n)
        more = data.inner[rows]
        z = np.concatenate([z, more])
        y = np.concatenate([y, run(more)])
    surface, left_out, is_near = fit_surface(z, y, data.readings, data.name)
    square = left_out[is_near] ** 2
    rms = np.sqrt(square.mean(axis=0))
    error = np.maximum(2 * rms, _least_error(data, z, surface))
    return Emulation(z, y, surface, error, np.inf)


def _least_error(data: SpecimenData, z: Floats, surface: Surface) -> Floats:
    """Return the least error of an emulator, (m,): a share of the data's spread, or rounding.

    Newton's method needs outputs whose rounding errors are far smaller than the error.
    """
    z = z[-32:]
    step = 1e-9 * np.ptp(z, axis=0)
    # Second differences at so small a distance have rounding errors alone.
    below = surface.values(z - step)
    above = surface.values(z + step)
    # The surface of a table has no values beyond its ends.
    change = np.nan_to_num(below + above - 2 * surface.values(z))
    rounding = np.sqrt(np.median(change**2, axis=0) / 6)
    return np.asarray(np.maximum(data.options.floor * data.readings.spread(), 1e3 * rounding))


@dataclass(frozen=True, eq=False)
class Likely:
    """Likely inputs of the specimens: weighted points, and the population that weights them."""

    proposals: Proposals
    points: SpecimenPoints
    population: Normal
    weights: Floats  # (N, K): weights of the points of each specimen, of sum one

    @classmethod
    def of(cls, data: SpecimenData, emulation: Emulation, population: Normal, seed: int) -> Likely:
        """Return likely inputs under the population that fits them."""
        # The reference is twice as wide, because the population of the last round may have been
        # too narrow.
        wide = Normal(population.mean, 2.0 * population.root)
        proposals = fit_proposals(data, emulation, wide)
        count = max(8 * proposals.modes.table.shape[1], 64 if proposals.is_open() else 0)
        points = draw_points(data, proposals, count, seed)
        scale = likely_scale(data, points, emulation.error)
        points = at_scale(data, points, emulation.error, scale)
        has_point = np.isfinite(points.log_a).any(axis=1)
        if data.gross_errors:
            has_point &= typical_specimens(proposals.modes, len(has_point))
        has_several = np.bincount(proposals.modes.specimen) > 1
        if has_several.mean() > 0.1 and not proposals.is_open(scale):
            # If specimens have several roots, the prior decides which of them form a population,
            # so that the population follows from posterior draws.
            draws = draws_of(data, proposals, points)
            population = normal_of(draws.specimens()[:, data.free])
            return cls(proposals, points, population, likely_weights(data, points, population))
        z = points.z[has_point][..., data.free]
        # Along inputs that the readings leave open, a fit that converges would collapse to a point:
        # a few steps of EM from the last population do not.
        start = None if not proposals.is_open(scale) else population
        population = Normal(*fit_normal(z, points.log_a[has_point], start))
        return cls(proposals, points, population, likely_weights(data, points, population))

    @classmethod
    def of_draws(cls, data: SpecimenData, plausible: Plausible) -> Likely:
        """Return likely inputs under the populations of posterior draws."""
        population = normal_of(plausible.draws.specimens()[:, data.free], 1.2)
        weights = likely_weights(data, plausible.points, population)
        return cls(plausible.proposals, plausible.points, population, weights)

    def sample(
        self, count: int, rng: np.random.Generator, weights: Floats | None = None
    ) -> tuple[Floats, Indices]:
        """Return likely inputs, (count, d), and their specimens, which repeat only beyond N."""
        weights = self.weights if weights is None else weights
        n = len(weights)
        specimens = np.concatenate([rng.permutation(n) for _ in range(-(-count // n))])[:count]
        totals = np.cumsum(weights[specimens], axis=1)
        places = (totals < rng.random((count, 1)) * totals[:, -1:]).sum(axis=1)
        return self.points.z[specimens, places], specimens

    def scale(self, data: SpecimenData) -> Floats:
        """Return the unit of distances, (d,): the population's standard deviation of each input."""
        return data.scale(np.sqrt((self.population.root**2).sum(axis=1)))

    def is_known(self, largest: float = 0.3) -> bool:
        """Return whether likely inputs of each specimen scatter less than the population."""
        residuals = self.proposals.residuals
        a = residuals.whitened(self.points.z)
        weights = self.weights[:, :, None]
        mean = (weights * a).sum(axis=1, keepdims=True)
        variance = (weights * (a - mean) ** 2).sum(axis=1)
        root = np.linalg.solve(residuals.population.root, self.population.root)
        of_population = (root**2).sum(axis=1)
        return bool((variance <= largest**2 * of_population).all())

    def best(self) -> Floats:
        """Return the likeliest input of each specimen, (N, d)."""
        best = self.weights.argmax(axis=1)
        return self.points.z[np.arange(len(best)), best]

    def has_runs(self, data: SpecimenData, runs: Floats) -> bool:
        """Return whether half of the specimens are within three standard deviations of runs."""
        best = self.best()
        squares = squared_distances(runs, best, self.scale(data))
        return bool(np.median(squares) <= 9 * best.shape[1])

    def possible(self, data: SpecimenData, count: int, rng: np.random.Generator) -> Floats:
        """Return inputs, (count, d), that are likely under a wider population.

        It is twice as wide with two inputs, and 1.5 times with eight: a typical specimen of it is
        at the edge of the region that has 98 % of the population.
        """
        d = len(data.free)
        width = np.sqrt(chdtri(d, 0.02) / d)
        wide = Normal(self.population.mean, width * self.population.root)
        return self.sample(count, rng, likely_weights(data, self.points, wide))[0]


def emulate(
    run: Run,
    data: SpecimenData,
    previous: Emulation | None = None,
    part: SpecimenData | None = None,
) -> tuple[Emulation, SpecimenPoints, Proposals, Draws]:
    """Fit the emulator: runs over the prior, then where the specimens are until the bias is small.

    ``previous`` is the emulation of the same response for other data. ``part`` is a sample of many
    specimens, for which the emulator is fitted before its error is measured at all of them. Raise
    DesignError if the response cannot be emulated well enough.
    """
    emulation, plausible = sequential_design(run, data if part is None else part, previous)
    if part is not None:
        emulation, plausible = extend_to_all(run, data, emulation, plausible)
    return emulation, *plausible.agreeing(data), plausible.draws


def extend_to_all(
    run: Run, data: SpecimenData, emulation: Emulation, plausible: Plausible
) -> tuple[Emulation, Plausible]:
    """Return emulation and points of all specimens, given those of a part of them.

    Populations that are plausible for a part are so for all.
    """
    if emulation.offsets is None and data.draws is not None:
        plausible = replace(plausible, draws=data.draws(plausible.draws.thetas))
        plausible = plausible.of_emulation(data, emulation)
        likely = Likely.of_draws(data, plausible)
        surface, rng = emulation.surface, np.random.default_rng([data.seed, 6])
        emulation = audited(run, data, emulation, likely, rng)
        if has_small_bias(data, emulation):
            if emulation.surface is not surface:
                modes = plausible.proposals.modes
                plausible = plausible.of_emulation(data, emulation, modes)
            return emulation, plausible
    return sequential_design(run, data, emulation)


def sequential_design(
    run: Run, data: SpecimenData, previous: Emulation | None
) -> tuple[Emulation, Plausible]:
    """Return an emulation whose bias is small, or raise, and coarse points of the specimens."""
    if previous is None:
        emulation = first_emulation(run, data)
    else:
        emulation = replace(previous, bias=np.inf, offsets=None)
    population = normal_of(data.inner[:, data.free])
    most, bias = largest_design(data), data.options.bias
    rng = np.random.default_rng([data.seed, 1])
    enough_batches = 1 if has_fewer_readings(data) else 2
    # The emulator of earlier data needs one batch, which measures its error at the new data.
    batches, enough = 0, 2 if previous is None else 1
    further = 0  # number of batches since the bias was small
    plausible = settled = None
    while True:
        likely = Likely.of(data, emulation, population, batches)
        if settled is not None and not is_elsewhere(data, settled[0], likely):
            # Runs at the other population have shown that it does not exist.
            emulation = replace(settled[1], z=emulation.z, y=emulation.y)
            return emulation, settled[2].of_emulation(data, emulation)
        is_unbiased = emulation.bias <= bias and (batches >= enough or len(emulation.z) >= most)
        if is_unbiased and len(emulation.z) < most and not likely.has_runs(data, emulation.z):
            # The bias is that at another population. Far from runs an emulator is often wrong.
            emulation = with_likely_runs(run, data, emulation, likely, population)
            batches += 1
            continue
        population = likely.population
        can_correct = may_correct(data, likely) and likely.is_known()
        # More runs decrease an error that would be reported, where corrections cannot. With fewer
        # readings than inputs it matters less, because the inputs are not known well.
        is_last = further >= enough_batches or len(emulation.z) >= most
        may_be_rough = can_correct or is_last
        is_smooth = may_be_rough or not is_rough(data, emulation)
        if is_unbiased and is_smooth:
            before = without_spurious_modes(run, data, emulation, likely)
            plausible = Plausible.of(data, before, wider(population), plausible)
            emulation, plausible, likely, is_good = verified(
                run, data, before, plausible, population, batches, rng
            )
            if not has_small_bias(data, emulation) and not likely.has_runs(data, before.z):
                continue
            if is_good and is_rough(data, emulation):
                if can_correct:
                    emulation = corrected(run, data, emulation, population)
                is_good = may_be_rough or len(emulation.z) >= most
            if is_good:
                elsewhere = population_elsewhere(data, emulation, likely, batches)
                if elsewhere is None:
                    return emulation, plausible.of_emulation(data, emulation)
                settled = likely, emulation, plausible
                emulation, likely = elsewhere
                population = likely.population
        if len(emulation.z) >= most:
            return at_most_runs(run, data, emulation, likely, population)
        further += emulation.bias <= bias
        count = batch_size(data, emulation, previous)
        emulation = extended(run, data, emulation, likely, count, rng)
        batches += 1


def has_small_bias(data: SpecimenData, emulation: Emulation) -> bool:
    """Return whether an audit accepts the bias of an emulation."""
    return emulation.bias <= 1.5 * data.options.bias


def verified(
    run: Run,
    data: SpecimenData,
    emulation: Emulation,
    plausible: Plausible,
    population: Normal,
    seed: int,
    rng: np.random.Generator,
) -> tuple[Emulation, Plausible, Likely, bool]:
    """Return the audited emulation, posterior draws, likely inputs, and whether these are right.

    If the audit fails, the next batch is drawn from the likely inputs of the audit.
    """
    surface, likely = emulation.surface, Likely.of_draws(data, plausible)
    emulation = audited(run, data, emulation, likely, rng)
    is_right = has_small_bias(data, emulation)
    if not is_right or emulation.surface is surface:
        return emulation, plausible, likely, is_right
    # The audit's runs changed the surface, so that another population may be likely.
    earlier, likely = plausible, Likely.of(data, emulation, population, seed)
    confirmed = without_spurious_modes(run, data, emulation, likely)
    plausible = Plausible.of(data, confirmed, wider(population))
    if confirmed is not emulation:  # Rounds may end with spurious modes left.
        confirmed = audited(run, data, confirmed, Likely.of_draws(data, plausible), rng)
    is_same = plausible.is_near(earlier) or len(confirmed.z) >= largest_design(data)
    return confirmed, plausible, likely, is_same and has_small_bias(data, confirmed)


def population_elsewhere(
    data: SpecimenData, emulation: Emulation, likely: Likely, seed: int
) -> tuple[Emulation, Likely] | None:
    """Return a surface through all runs, and its likely inputs where these are others.

    None if the surface leaves out no run, or has the same modes, or both are near each other. Runs
    far from the likely population are left out, so that the surface does not know whether another
    one is likelier.
    """
    z, y = emulation.z, emulation.y
    is_used = _near_population(data, z, likely.population)
    is_used[list(emulation.audited)] = True
    was_elsewhere = len(emulation.audited) > len(z) // 2
    if was_elsewhere or is_used.all() or len(z) >= largest_design(data):
        return None
    surface, *_ = fit_surface(z, y, data.readings, data.name, emulation.surface)
    audited = tuple(range(len(z)))
    through_all = replace(emulation, surface=surface, bias=np.inf, audited=audited)
    first = normal_of(data.inner[:, data.free])
    proposals = fit_proposals(data, through_all, wider(first))
    if not has_other_modes(data, likely, proposals):
        return None
    # Populations far from each other need more points than likely inputs do.
    count = min(512, data.options.most_in_all // len(data.readings))
    points = draw_points(data, proposals, count, seed)
    row = likely_scale(data, points, emulation.error)
    points = at_scale(data, points, emulation.error, row)
    specimens = draws_of(data, proposals, points).specimens()
    population = normal_of(specimens[:, data.free])
    weights = likely_weights(data, points, population)
    if are_near(likely.population, population):
        return None
    return through_all, Likely(proposals, points, population, weights)


def has_other_modes(data: SpecimenData, likely: Likely, proposals: Proposals) -> bool:
    """Return whether proposals have modes that are far from those of likely inputs."""
    from scipy.spatial import cKDTree

    scale = likely.scale(data)
    earlier = mode_coordinates(likely.proposals) / scale
    modes = mode_coordinates(proposals)[proposals.modes.is_stationary()] / scale
    distance, _ = cKDTree(earlier).query(modes)
    return bool((distance > 1).any())


def is_elsewhere(data: SpecimenData, earlier: Likely, likely: Likely) -> bool:
    """Return whether likely inputs have another population than earlier ones, or other modes."""
    is_same = are_near(earlier.population, likely.population)
    return not is_same or has_other_modes(data, earlier, likely.proposals)


def has_fewer_readings(data: SpecimenData) -> bool:
    """Return whether most specimens have fewer readings than unknown inputs."""
    return bool(np.median(data.readings.is_measured.sum(axis=1)) < len(data.free))


def largest_design(data: SpecimenData) -> int:
    """Return the number of runs at which a design ends."""
    options = data.options
    return options.max_runs or most_runs(data.known.shape[1]) + (options.n_first or 0)


def with_likely_runs(
    run: Run, data: SpecimenData, emulation: Emulation, likely: Likely, population: Normal
) -> Emulation:
    """Return the emulation with four runs at likely inputs, near another population."""
    runs = farthest(emulation.z, likely.best(), 4, likely.scale(data))
    return with_audited_runs(run, data, emulation, runs, likely, population)[0]


def at_most_runs(
    run: Run, data: SpecimenData, emulation: Emulation, likely: Likely, population: Normal
) -> tuple[Emulation, Plausible]:
    """Return an emulation with the largest number of runs, corrected where it may be, or raise."""
    if may_correct(data, likely):
        emulation = corrected(run, data, emulation, population)
    if emulation.bias > data.options.bias:
        require_accurate(data, emulation, likely)
    plausible = Plausible.of(data, emulation, wider(population))
    likely = Likely.of_draws(data, plausible)
    candidates, _ = likely.sample(64 * data.options.sampled, np.random.default_rng([data.seed, 7]))
    far = data.within(_far_from_runs(data, emulation, likely, candidates))
    if len(far):
        bias = _bias_of_possible(data, run(far) - emulation.surface.values(far), len(far))
        if bias > 1.5 * data.options.bias:
            require_accurate(data, replace(emulation, bias=bias), likely)
    return emulation, plausible


def batch_size(data: SpecimenData, emulation: Emulation, previous: Emulation | None) -> int:
    """Return the number of runs by which an emulation grows; few if one of other data exists.

    A batch has half as many runs as exist, a quarter if the bias is nearly small enough, and at
    most three times the first runs.
    """
    least = data.options.sampled + 2
    if previous is not None:
        return least
    share = 2 if emulation.bias > 3 * data.options.bias else 4
    most = 3 * first_runs(data.known.shape[1])
    return max(least, min(len(emulation.z) // share, most))


def wider(population: Normal) -> Normal:
    """Return a population that is twice as wide."""
    return Normal(population.mean, 2.0 * population.root)


def extended(
    run: Run,
    data: SpecimenData,
    emulation: Emulation,
    likely: Likely,
    count: int,
    rng: np.random.Generator,
) -> Emulation:
    """Return the emulation with a batch of ``count`` runs."""
    n_possible = max(2, count // 4)
    n_explored = max(2, count // 8)
    rest = count - n_explored - n_possible
    n_sampled = max(data.options.sampled, rest // 2)
    sampled, specimens = likely.sample(n_sampled, rng)
    sampled = data.within(sampled)
    possible = likely.possible(data, n_possible, rng)
    possible = data.within(possible)
    scale = likely.scale(data)
    # Candidates for runs far from all others are inputs beside the likely ones, and specimens of
    # the whole population, because the emulator predicts both.
    near, _ = likely.sample(8 * count, rng)
    of_population = near.repeat(4, axis=0)
    noise = rng.standard_normal((len(near), len(data.free)))
    near[:, data.free] += 0.4 * scale[data.free] * noise
    near = data.within(near)
    noise = 2.0 * rng.standard_normal((len(of_population), len(data.free)))
    population = likely.population
    of_population[:, data.free] = population.mean + noise @ population.root.T
    of_population = data.within(of_population)
    of_inner = rng.permutation(len(data.inner))[:1024]
    prior = data.inner[of_inner].copy()
    is_condition = ~np.isnan(data.known[0])
    owners = rng.integers(0, len(data.known), len(prior))
    of_specimens = data.known[owners]
    prior[:, is_condition] = of_specimens[:, is_condition]
    of_prior = data.scale(data.inner[:, data.free].std(axis=0))
    runs = np.concatenate([emulation.z, sampled, possible])
    # Likely inputs may have a run already, so that only the new ones count.
    is_new = _is_new(emulation.z, runs[len(emulation.z) :], scale)
    n_far = max(0, count - n_explored - int(is_new.sum()) - 3)
    far = farthest(runs, near, n_far, scale)
    uncertain = _explored(data, emulation, runs, of_population, 3, scale)
    runs = np.concatenate([runs, far, uncertain])
    explored = _explored(data, emulation, runs, prior, n_explored, of_prior)
    distant = np.concatenate([far, uncertain, explored])
    return joined(run, data, emulation, likely, sampled, specimens, possible, distant)


def joined(
    run: Run,
    data: SpecimenData,
    emulation: Emulation,
    likely: Likely,
    sampled: Floats,
    specimens: Indices,
    possible: Floats,
    distant: Floats,
) -> Emulation:
    """Return the emulation with runs at fresh points.

    The sampled points give its error and bias. At those that are possible under a wide population
    a coarser error is allowed.
    """
    fresh = np.concatenate([sampled, possible, distant])
    grown, misfit, is_new = _compared(run, emulation, fresh, likely.scale(data))
    at_sampled, at_possible, _ = np.split(misfit, [len(sampled), len(sampled) + len(possible)])
    error, bias = error_and_bias(data, emulation, likely, sampled, specimens, at_sampled)
    bias = max(bias, _bias_of_possible(data, at_possible))
    grown, left_out = _refitted(data, grown, likely.population)
    if np.isfinite(bias):
        at_sampled = left_out[len(emulation.z) :][: is_new[: len(sampled)].sum()]
        least = _least_error(data, grown.z, grown.surface)
        error = _improved(error, at_sampled, least)
    return _with_bias_at_ends(data, replace(grown, error=error, bias=bias), likely)


def _improved(error: Floats, left_out: Floats, least: Floats) -> Floats:
    """Return errors, (m,), from misfits at runs and left-out errors, (k, m), at the same runs.

    Misfits are those of the emulator without these runs. Left-out errors show what the runs have
    improved.
    """
    left_out = left_out[np.isfinite(left_out).all(axis=1)]
    if not len(left_out):
        return error
    with np.errstate(over="ignore"):  # An infinite error improves nothing.
        improved = 2 * np.sqrt((left_out**2).mean(axis=0))
    return np.asarray(np.maximum(np.minimum(error, improved), least))


def _is_new(runs: Floats, z: Floats, scale: Floats) -> Bools:
    """Return which points (k, d) coincide with no run and with no earlier point, (k,)."""
    cells = np.round(np.concatenate([runs, z]) / (1e-4 * scale))
    _, first = np.unique(cells, axis=0, return_index=True)
    is_first = np.zeros(len(cells), dtype=bool)
    is_first[first] = True
    return is_first[len(runs) :]


def _compared(
    run: Run, emulation: Emulation, z: Floats, scale: Floats
) -> tuple[Emulation, Floats, Bools]:
    """Return the emulation with runs at points, its misfits there, (k, m), and which are new, (k,).

    Points that coincide have the misfit of one run. The surface is not fitted again.
    """
    from scipy.spatial import cKDTree

    is_new = _is_new(emulation.z, z, scale)
    outputs = run(z[is_new]) if is_new.any() else emulation.y[:0]
    grown = emulation.with_runs(z[is_new], outputs)
    _, rows = cKDTree(grown.z / scale).query(z / scale)
    misfit = grown.y[rows] - emulation.surface.values(grown.z[rows])
    # Squares of larger numbers overflow, for example where a response is an exponential function.
    finite = np.isfinite(misfit)
    misfit[finite] = np.clip(misfit[finite], -1e100, 1e100)
    return grown, misfit, is_new


def _refitted(
    data: SpecimenData, emulation: Emulation, population: Normal
) -> tuple[Emulation, Floats]:
    """Return the emulation with a surface through all of its runs, and left-out errors, (n, m)."""
    z, y, rows = emulation.z, emulation.y, _near_population(data, emulation.z, population)
    # Without these runs the emulator would have the same spurious inputs again.
    rows[list(emulation.audited)] = True
    surface, left_out, _ = fit_surface(z, y, data.readings, data.name, emulation.surface, rows)
    error = np.maximum(emulation.error, _least_error(data, z, surface))
    return replace(emulation, surface=surface, error=error, offsets=None), left_out


def _bias_of_possible(data: SpecimenData, misfit: Floats, n_likely: int = 0) -> float:
    """Return misfits (n, m) at possible inputs as a bias that is too large above .1.

    The limit is in units of the data's spread and the readings' errors. Possible inputs may have no
    response; at the last ``n_likely``, which are likely, that is the largest misfit.
    """
    readings = data.readings
    error = np.median(readings.error_sd(np.nan_to_num(readings.values)), axis=0)
    scaled = np.clip(misfit / np.hypot(readings.spread(), error), -3.0, 3.0)
    is_missing = ~np.isfinite(misfit).all(axis=1)
    scaled[is_missing] = 3.0
    is_missing[len(misfit) - n_likely :] = False
    scaled = scaled[~is_missing]
    if not len(scaled):
        return 0.0
    return float(data.options.bias / 0.1 * np.sqrt((scaled**2).mean(axis=0).max()))


def error_and_bias(
    data: SpecimenData,
    emulation: Emulation,
    likely: Likely,
    z: Floats,
    specimens: Indices,
    misfit: Floats,
) -> tuple[Floats, float]:
    """Return the error of the emulator, (m,), and the bias that it causes, from misfits (n, m)."""
    good = np.isfinite(misfit).all(axis=1)
    if good.sum() < 4:
        return emulation.error, np.inf
    z, specimens, misfit = z[good], specimens[good], misfit[good]
    least = _least_error(data, emulation.z, emulation.surface)
    error = np.maximum(2 * np.sqrt((misfit**2).mean(axis=0)), least)
    measured = replace(emulation, error=error)
    residuals = residuals_of(data, measured, likely.population)
    a = residuals.whitened(z)
    _, slopes = residuals.errors(specimens, a)
    sd = data.readings.comparison_sd(error)[specimens]
    relative = np.stack([misfit / sd, np.where(np.isinf(sd), 0.0, error / sd)])
    if residuals.columns is not None:
        relative = np.take_along_axis(relative, residuals.columns[specimens][None], axis=2)
    # Shift of the inputs of a specimen that the error of the emulator causes.
    hessian = np.einsum("kmd,kme->kde", slopes, slopes) + np.eye(a.shape[1])
    gain = np.linalg.solve(hessian, slopes.swapaxes(1, 2))
    shift = -np.einsum("kdm,km->kd", gain, relative[0])
    bias = np.abs(predicted_bias(shift, a, len(data.readings))).max()
    # With fewer readings than inputs the posterior is wider than the formula for the bias assumes,
    # because m readings identify only m of d directions.
    of_each = data.readings.is_measured.sum(axis=1).mean()
    bias *= np.sqrt(min(1.0, of_each / a.shape[1]))
    # The error is part of the comparison at each specimen. If it is overestimated, it takes a part
    # of the scatter, so that the population is too narrow.
    by_error = gain * relative[1][:, None]
    share = (by_error**2).sum(axis=2)
    narrowing = np.sqrt(len(data.readings) / 2) * share.mean(axis=0).max()
    return error, float(max(bias, narrowing))


def _with_bias_at_ends(data: SpecimenData, emulation: Emulation, likely: Likely) -> Emulation:
    """Return the emulation with the bias of specimens near an end of the range of their inputs.

    A density may be infinite at the end, so that the error of an input is compared with its
    distance from the end. The bias is too large above a share of .1.
    """
    if data.coordinates is None or np.isinf(data.coordinates.ends).all():
        return emulation
    z = likely.best()
    share = shares_of_distance(data, emulation.error, z, emulation(z)[1])
    at_ends = data.options.bias / 0.1 * np.sqrt((share**2).mean(axis=0).max())
    return replace(emulation, bias=max(emulation.bias, float(at_ends)))


def shares_of_distance(
    data: SpecimenData,
    error: Floats,
    z: Floats,
    jacobian: Floats,
    scale: Floats | float = np.inf,
) -> Floats:
    """Return errors of inputs z, (N, d), in units of their distances from the ends, (N, free).

    ``error``, (m,), is that of the emulator, ``jacobian``, (N, m, d), its slope. ``scale``, (d,),
    is the largest distance. Shares above 3 are 3.
    """

    def input_sd(sd: Floats) -> Floats:
        """Return standard deviations of the inputs, (N, free), by those of the outputs, (N, m)."""
        slopes = np.nan_to_num(jacobian[:, :, data.free] / sd[:, :, None])
        covariance = np.linalg.pinv(slopes.swapaxes(1, 2) @ slopes)
        return np.asarray(np.sqrt(np.einsum("ndd->nd", covariance)))

    by_emulator = input_sd(np.where(data.readings.is_measured, error, np.inf))
    by_all = input_sd(data.readings.comparison_sd(error))
    # Errors of readings smooth the density near the end, so that the emulator's error is compared
    # with them as well as with the distance.
    by_readings = np.sqrt(np.maximum(by_all**2 - by_emulator**2, 0.0))
    low: Floats | float = -np.inf
    high: Floats | float = np.inf
    if data.coordinates is not None:
        low, high = data.coordinates.ends
    # The distance is reduced by three standard deviations, because the input is not known exactly.
    distance = np.minimum(z - low, high - z)[:, data.free] - 3 * by_emulator
    distance = np.minimum(distance, np.broadcast_to(scale, z.shape)[:, data.free])
    share = by_emulator / np.maximum(np.maximum(distance, by_readings), 1e-300)
    return np.asarray(np.nan_to_num(np.clip(share, 0.0, 3.0)))


def _near_population(data: SpecimenData, z: Floats, population: Normal) -> Bools:
    """Return which runs are near a population, (n,), at least twice those of the first batch.

    A response that oscillates in the tails of a vague prior needs short lengths there alone.
    """
    a = np.linalg.solve(population.root, (z[:, data.free] - population.mean).T)
    distance = (a**2).sum(axis=0)
    least = 2 * first_runs(z.shape[1])
    nearest = np.sort(distance)
    limit = max(6.0**2, float(nearest[min(least, len(z)) - 1]))
    return np.asarray(distance <= limit)


def farthest(runs: Floats, candidates: Floats, count: int, scale: Floats) -> Floats:
    """Return candidates, (count, d), each the farthest from the runs and from earlier ones."""
    squares = squared_distances(runs, candidates, scale)
    return candidates[farthest_rows(candidates / scale, count, squares)]


def squared_distances(runs: Floats, z: Floats, scale: Floats) -> Floats:
    """Return the squared distance of points from their nearest runs, (k, d) -> (k,)."""
    squares = np.full(len(z), np.inf)
    with np.errstate(over="ignore"):  # An infinite distance is the largest.
        for at in runs:
            away = (z - at) / scale
            squares = np.minimum(squares, (away**2).sum(axis=1))
    return squares


def _is_far(emulation: Emulation, z: Floats, scale: Floats, spread: Floats) -> Bools:
    """Return which points (k, d) have no run whose inputs and outputs are near theirs, (k,)."""
    units = np.concatenate([scale, spread])
    runs = np.hstack([emulation.z, emulation.y])
    runs = runs[complete_rows(runs)]
    predicted = np.hstack([z, emulation.surface.values(z)])
    return squared_distances(runs, predicted, units) > len(units)


def _far_from_runs(
    data: SpecimenData, emulation: Emulation, likely: Likely, candidates: Floats
) -> Floats:
    """Return some of the candidates, (n, d), that may be inputs of the emulator alone."""
    is_far = _is_far(emulation, candidates, likely.scale(data), data.readings.spread())
    return candidates[is_far][: data.options.sampled // 2]


def _explored(
    data: SpecimenData, emulation: Emulation, runs: Floats, z: Floats, count: int, scale: Floats
) -> Floats:
    """Return points of a sample z, (n, d), that are uncertain, and at which a specimen could lie.

    They are far from all runs.
    """
    readings, spread = data.readings, data.readings.spread()
    # Far from runs the emulator's outputs may be wrong, so that outputs within three of its
    # predictive standard deviations count as possible.
    error = np.sqrt(emulation.surface.variance(z))
    deviation = spread + 3 * error
    values = emulation.surface.values(z)
    low = np.nanmin(located_values(readings), axis=0) - deviation
    high = np.nanmax(located_values(readings), axis=0) + deviation
    is_possible = ((values >= low) & (values <= high)).all(axis=1)
    if is_possible.sum() >= count:
        z, error = z[is_possible], error[is_possible]
    order = np.argsort(-(error / spread).max(axis=1), kind="stable")
    z = z[order[: max(count, len(z) // 4)]]
    return farthest(runs, z, count, scale)


def audited(
    run: Run,
    data: SpecimenData,
    emulation: Emulation,
    likely: Likely,
    rng: np.random.Generator,
) -> Emulation:
    """Return the emulation with runs at points that matter to the posterior, and their bias.

    Its surface stays if the error at these runs is at most twice the stated one. That of left-out
    runs, which are far from each other, is often too large: it decreases towards what is measured
    here.
    """
    sampled, specimens = likely.sample(data.options.sampled // 2, rng)
    candidates, owners = likely.sample(64 * data.options.sampled, rng)
    # Half of the runs are drawn from the quarter of the candidates with the largest predictive
    # variance.
    variance = emulation.surface.variance(candidates)
    deviation = np.sqrt(variance) / data.readings.spread()
    order = np.argsort(-deviation.max(axis=1), kind="stable")
    least_certain = order[: len(candidates) // 4]
    rows = rng.permutation(least_certain)[: len(sampled)]
    specimens = np.concatenate([specimens, owners[rows]])
    possible = likely.possible(data, data.options.sampled // 4, rng)
    far = _far_from_runs(data, emulation, likely, candidates)
    possible = np.concatenate([possible, far])
    z = np.concatenate([sampled, candidates[rows], possible])
    z = data.within(z)
    grown, misfit, is_new = _compared(run, emulation, z, likely.scale(data))
    at_audited, at_possible = np.split(misfit, [len(specimens)])
    stratum = np.repeat([0.75, 0.25], len(sampled))
    root_weights = np.sqrt(2 * stratum)
    weighted = root_weights[:, None] * at_audited
    audited_z = z[: len(specimens)]
    error, bias = error_and_bias(data, emulation, likely, audited_z, specimens, weighted)
    bias = max(bias, _bias_of_possible(data, at_possible, len(far)), emulation.bias)
    measured, stated = (relative_error(data.readings, e) for e in (error, emulation.error))
    if (measured <= 2 * stated).all() and bias <= 1.5 * data.options.bias:
        # Eight runs may miss the places where the emulator is wrong, so that the new error is the
        # geometric mean of the stated and the measured one.
        squares = (error / emulation.error) ** 2
        ratio = np.sqrt(squares.mean())
        error = np.sqrt(min(ratio, 1.0)) * emulation.error
        return _with_bias_at_ends(data, replace(grown, error=error, bias=bias), likely)
    grown, left_out = _refitted(data, grown, likely.population)
    if bias <= 1.5 * data.options.bias:
        n_audited = is_new[: len(specimens)].sum()
        of_new_runs = left_out[len(emulation.z) :]
        at_audited = of_new_runs[:n_audited]
        least = _least_error(data, grown.z, grown.surface)
        error = _improved(error, at_audited, least)
    else:  # The error stays, because specimens may be at inputs that the runs do not have.
        error = np.maximum(error, emulation.error)
    return _with_bias_at_ends(data, replace(grown, error=error, bias=bias), likely)


def with_audited_runs(
    run: Run,
    data: SpecimenData,
    emulation: Emulation,
    runs: Floats,
    likely: Likely,
    population: Normal,
) -> tuple[Emulation, Floats]:
    """Return the emulation with runs that its surface never leaves out, and the misfits there."""
    grown, misfit, _ = _compared(run, emulation, runs, likely.scale(data))
    audited = range(len(emulation.z), len(grown.z))
    grown = replace(grown, audited=(*emulation.audited, *audited))
    return _refitted(data, grown, population)[0], misfit


def without_spurious_modes(
    run: Run, data: SpecimenData, emulation: Emulation, likely: Likely
) -> Emulation:
    """Return the emulation with runs at those modes of specimens that the emulator does not know.

    Far from its runs an emulator may reach the readings where the response does not. Such a mode is
    improbable, but those of all specimens together may be a population.
    """
    proposals, scale = likely.proposals, likely.scale(data)
    # With an unknown error the prior's largest would leave all inputs open.
    if proposals.is_open(likely_scale(data, likely.points, emulation.error)):
        return emulation
    # The points have modes in such a population.
    proposals = fit_proposals(data, emulation, wider(likely.population))
    spread = data.readings.spread()
    # As `is_rough`, and far less certain than at most likely inputs
    largest = np.maximum(0.03 * spread, 10 * emulation.error)
    likeliest, before = likely.best(), emulation
    for _ in range(8):
        modes = proposals.modes
        z = data.within(mode_coordinates(proposals))
        deviation = np.sqrt(emulation.surface.variance(z))
        # Without runs whose inputs and outputs are near, the deviation may be far too small.
        is_far = _is_far(emulation, z, scale, spread)
        cost = modes.misfit + (modes.a**2).sum(axis=1) / 2
        is_far[best_rows(modes.specimen, cost)] = False
        is_uncertain = (deviation > largest).any(axis=1)
        doubtful = z[is_uncertain | is_far]
        if not len(doubtful):
            return emulation
        runs = farthest(emulation.z, doubtful, min(2, len(doubtful)), scale)
        emulation, misfit = with_audited_runs(run, data, emulation, runs, likely, likely.population)
        change = emulation.surface.values(likeliest) - before.surface.values(likeliest)
        exist = (np.abs(misfit) < 0.1 * spread).all()
        if exist or (np.abs(change) > largest).any():
            break
        proposals = fit_proposals(data, emulation, proposals.residuals.population)
    # A response that oscillates far off is not known from a few runs, which also make the surface
    # worse at the specimens.
    harmless = np.maximum(0.01 * spread, 3 * before.error)
    return before if (np.abs(change) > harmless).any() else emulation


def is_rough(data: SpecimenData, emulation: Emulation) -> bool:
    """Return whether the emulator's error is not small beside the scatter of the readings."""
    return bool((relative_error(data.readings, emulation.error) > 0.03).any())


def most_corrections(specimens: int, dimensions: int) -> int:
    """Return the largest number of runs of corrections: three a specimen, none for many."""
    return 3 * specimens if 2 * specimens <= most_runs(dimensions) else 0


def may_correct(data: SpecimenData, likely: Likely) -> bool:
    """Return whether the readings determine the inputs of the specimens, and these are not many."""
    return not likely.proposals.is_open() and most_corrections(*data.known.shape) > 0


def corrected(run: Run, data: SpecimenData, emulation: Emulation, population: Normal) -> Emulation:
    """Return the emulation with the response itself at the likely inputs of each specimen.

    A kink or a jump between runs leaves an error that more runs hardly decrease. The output less
    that of the surface, at the best mode of a specimen, is added to the surface; the mode moves,
    and the change in the next round is the error that is left. The error stays where inputs of
    specimens are not known, or no inputs reproduce most of them.
    """
    uncorrected = emulation
    offsets = np.zeros(data.readings.values.shape)
    for seed in range(most_corrections(*data.known.shape) // len(offsets)):
        likely = Likely.of(data, emulation, population, seed)
        residuals = likely.proposals.residuals
        modes = likely.proposals.modes
        if seed == 0 and not likely.is_known():
            return uncorrected
        rows = best_rows(modes.specimen, modes.misfit + 0.05 * (modes.a**2).sum(axis=1))
        z = residuals.coordinates(modes.specimen[rows], modes.a[rows])
        z = data.within(z)
        outputs = run(z)
        misfit = outputs - emulation.surface.values(z) - offsets[modes.specimen[rows]]
        offsets[modes.specimen[rows]] += np.nan_to_num(misfit)
        error, bias = error_and_bias(data, emulation, likely, z, modes.specimen[rows], misfit)
        emulation = replace(
            emulation.with_runs(z, outputs), error=error, bias=bias, offsets=offsets.copy()
        )
        if seed and not is_rough(data, emulation):
            break
    misfit = Likely.of(data, emulation, population, 0).proposals.modes.best_misfit()
    if np.median(misfit) > 50:
        return replace(uncorrected, z=emulation.z, y=emulation.y)
    return emulation


def refuse_at_end(data: SpecimenData, specimen: int) -> None:
    """Raise if a specimen with exact readings has an input nearer to an end than it is known."""
    if has_error(data.readings)[specimen].any():
        return
    label = specimen if data.labels is None else data.labels[specimen]
    raise DesignError(
        f"{data.name}: got an exact reading of specimen {label} whose input is at an end of the "
        "input's range, or nearer to it than the emulator is accurate, where densities of "
        "populations may be infinite or zero; expected readings farther from the end; pass "
        "metric=prb.LogLikelihood(error=...) with the standard deviation of the readings' error"
    )


def require_accurate(data: SpecimenData, emulation: Emulation, likely: Likely) -> None:
    """Raise an error that names the output and the specimen at which the emulator is worst."""
    share = emulation.error / data.readings.spread()
    output = int(np.argmax(share))
    z = likely.best()
    shares = shares_of_distance(data, emulation.error, z, emulation(z)[1]).max(axis=1)
    if np.sqrt((shares**2).mean()) > 0.1:
        refuse_at_end(data, int(shares.argmax()))
    variance = emulation.surface.variance(z)[:, output]
    is_read = data.readings.is_measured[:, output]
    specimen = int(np.argmax(np.where(is_read, variance, -1.0)))
    name = data.output_names[output] if data.output_names else data.name
    label = specimen if data.labels is None else data.labels[specimen]
    more_runs, other_metric = data.remedies()
    raise DesignError(
        f"{data.name}: the response is not smooth enough for prb.LogLikelihood(): got an emulator "
        f"of {len(emulation.z)} runs whose error of {name} is {share[output]:.2g} times the "
        f"scatter, the largest at specimen {label}, and would shift an estimate by "
        f"{emulation.bias:.2g} posterior standard deviations, expected at most "
        f"{data.options.bias}; {any_of('narrow the priors', more_runs, other_metric)}"
    )
