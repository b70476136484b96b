r"""Points that all specimens share, for the likelihood of a random response.

    log p(y_i | theta) = logsumexp_k(log p(x_k | theta) + A_ik),

where :math:`A_{ik} = \log p(y_i \mid x_k) - \log q(x_k) - \log K` has the density of an emulator of
the random response. Runs come in three rounds: over the prior, then twice where the populations are
that the readings allow. The error of the emulator is that of draws of it, which all specimens have
in common: the likelihood of the specimens is a mean over these draws.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, cast

import numpy as np
from scipy.special import fdtrc, logsumexp, ndtr, ndtri

from prbayes._finding import Finding, Findings
from prbayes._validate import Bools, Floats, Indices
from prbayes.emulators.scatter import Region, Scatter, chosen_degrees, emulator_draws, fit_scatter
from prbayes.numerics.points import inside, lattice, sobol
from prbayes.propagation.base import MAX_LOST, DesignError
from prbayes.propagation.population_density import PopulationDensity
from prbayes.specimens.coordinates import Coordinates
from prbayes.specimens.emulation import DifferencedResponse, Emulation, half_difference
from prbayes.specimens.points import (
    Draws,
    SpecimenData,
    SpecimenPoints,
    normal_of,
    per_hyperparameter,
)
from prbayes.specimens.response_share import ResponseShare
from prbayes.specimens.weighted_points import WeightedPoints

_PAGE = "random_responses.md#what-is-checked"


@dataclass(frozen=True)
class RandomRunOptions:
    """Numbers of runs, points and draws of the emulator of a random response."""

    runs: int = 128  # runs with one or two inputs; 64 for each input with more
    most: int = 1024  # largest number of runs
    draws: int = 24  # number of draws of the emulator
    # Least effective number of these draws at likely populations: the readings would otherwise
    # choose between emulators that the runs do not distinguish.
    least_draws: float = 6.0
    points: int = 256  # number of points to begin with
    most_points: int = 2**14
    reach: float = 3.5  # half the width of the region of runs, in standard deviations
    level: float = 1e-3  # size of the tests of the emulator

    def distinct_inputs(self, stated: int | None, n_inputs: int, repeats: int) -> int:
        """Return the number of distinct inputs of runs, without growth."""
        runs = stated or max(self.runs, 64 * n_inputs)
        return max(runs // repeats, 32)


@dataclass(frozen=True, eq=False)
class RandomRuns:
    """Runs of a random response at the distinct inputs of a design."""

    z: Floats  # (n, d): coordinates of the runs, whose last columns number them
    y: Floats  # (n, m): their outputs
    places: Indices  # (n,): number of the distinct inputs of a run

    def joined(self, other: RandomRuns) -> RandomRuns:
        """Return the runs of both."""
        first = int(self.places.max()) + 1
        return RandomRuns(
            np.concatenate([self.z, other.z]),
            np.concatenate([self.y, other.y]),
            np.concatenate([self.places, first + other.places]),
        )

    def inside(self, region: Region) -> RandomRuns:
        """Return the runs in a region, all of them if it has fewer than eight inputs."""
        unit = region.unit(self.z[:, : len(region.center)])
        is_inside = np.abs(unit) <= 1.0 + 1e-9
        part = self.rows(is_inside.all(axis=1))
        n_inputs = len(np.unique(part.places))
        return part if n_inputs >= 8 else self

    def rows(self, is_used: Bools) -> RandomRuns:
        """Return a part of the runs."""
        _, places = np.unique(self.places[is_used], return_inverse=True)
        return RandomRuns(self.z[is_used], self.y[is_used], places)


@dataclass(frozen=True, eq=False)
class Noise:
    """The last coordinates of a specimen, which stand for standard normal noise."""

    center: Floats  # (m,): noise at the coordinate zero
    scale: Floats  # (m,): noise of a unit of the coordinate

    def of(self, z: Floats) -> Floats:
        """Return the noise of coordinates, (..., d) -> (..., m)."""
        of_noise = z[..., -len(self.scale) :]
        return np.asarray(self.center + self.scale * of_noise)

    def coordinates(self, noise: Floats) -> Floats:
        """Return the coordinates of noise, (..., m)."""
        return np.asarray((noise - self.center) / self.scale)


@dataclass(frozen=True, eq=False)
class PointMass:
    r"""Mass of populations at shared points, :math:`\sum_k p(x_k) / (K q(x_k))`.

    It is the probability of the region of the points, unless the population is narrower than the
    distances between points. One that contains a point then has a mass above one, by which its
    likelihood is divided: otherwise the posterior would be drawn to the points.
    """

    z: Floats  # (K, d): coordinates of the points
    log_b: Floats  # (K,): minus the log of K times the proposal density of z
    with_response: ClassVar[None] = None  # no points without a response are needed

    @classmethod
    def of(cls, points: SpecimenPoints) -> PointMass:
        """Return the mass of points; all specimens have the same one."""
        return cls(points.z[0], -points.log_proposal[0])

    def of_populations(
        self, density: PopulationDensity, parents: Sequence[Floats], coordinates: Coordinates
    ) -> Floats:
        """Return the log of a mass above one, and zero otherwise, (S,), at parents (S, *shape)."""
        log_b = self.log_b + coordinates.log_jacobian(self.z)
        x = [v[None] for v in coordinates.inputs(self.z)]
        points = WeightedPoints.of(density, x, log_b[None])
        return np.maximum(points.log_likelihoods(parents)[:, 0], 0.0)


type PopulationShare = ResponseShare | PointMass


class DrawsWithMass(Draws, Protocol):
    """Draws of the hyperparameters, with the masses of their populations at points."""

    def log_share(self, share: PopulationShare) -> Floats:
        """Return the sum over the specimens of the log of the mass, (S,)."""


@dataclass(frozen=True, eq=False)
class ScatterSurface:
    """Outputs of a random response at inputs and standard normal noise."""

    scatter: Scatter
    noise: Noise
    runs: RandomRuns

    def values(self, z: Floats, columns: Any = None) -> Floats:
        """Return outputs (k, m) at coordinates (k, d); those in ``columns``, (k, c)."""
        inputs = z[:, : len(self.scatter.region.center)]
        values = self.scatter.outputs(inputs, self.noise.of(z))
        return values if columns is None else np.take_along_axis(values, columns, axis=1)

    def __call__(self, z: Floats, columns: Any = None) -> tuple[Floats, Floats]:
        """Return values and Jacobian; of the outputs in ``columns``, (k, c), of each point."""
        return DifferencedResponse(self.values, step=1e-4)(z, columns)

    def variance(self, z: Floats) -> Floats:
        """Return zeros: the error of the emulator is part of the likelihood."""
        return np.zeros((len(z), len(self.scatter.factor)))


@dataclass(frozen=True, eq=False)
class RandomResponse:
    """A random response with the measured specimens, and how its runs are placed."""

    run: Callable[[Floats], Floats]  # coordinates (n, d) -> outputs (n, m)
    data: SpecimenData
    repeats: int
    noise: Noise
    options: RandomRunOptions = RandomRunOptions()

    @property
    def free(self) -> Indices:
        """Columns of the unknown inputs."""
        free = self.data.free
        n_inputs = self.data.known.shape[1] - len(self.noise.scale)
        return np.asarray(free[free < n_inputs])

    @property
    def conditions(self) -> Indices:
        """Columns of the known inputs."""
        is_known = ~np.isnan(self.data.known[0])
        return np.asarray(np.flatnonzero(is_known))

    def region(self, specimens: Floats, reach: float) -> Region:
        """Return the region of specimens (n, d), and of the conditions."""
        width = self.data.known.shape[1] - len(self.noise.scale)
        center, root = np.zeros(width), np.eye(width)
        normal = normal_of(specimens[:, self.free])
        center[self.free] = normal.mean
        root[np.ix_(self.free, self.free)] = reach * normal.root
        for column in self.conditions:
            values = self.data.known[:, column]
            low, high = values.min(), values.max()
            center[column] = (low + high) / 2
            half_width = (high - low) / 2
            root[column, column] = max(half_width, 1e-9)
        return Region(center, root)

    def at(self, region: Region, u: Floats, spread: float = 1.4) -> tuple[Floats, Floats]:
        """Return inputs at points of the unit cube, (n, free), and the log of their density.

        Their density is normal, ``spread`` times as wide as that of the specimens, and ends at the
        region. Conditions are those of the first specimen.
        """
        reach = self.options.reach / spread
        tail = ndtr(-reach)
        normal = ndtri(tail + (1 - 2 * tail) * u)
        unit = np.zeros((len(u), len(region.center)))
        unit[:, self.free] = normal / reach
        constant = np.log(reach) - 0.5 * np.log(2 * np.pi)
        log_density = constant - 0.5 * normal**2
        log_q = log_density.sum(axis=1)
        log_q -= len(self.free) * np.log(1 - 2 * tail)
        root = region.root[np.ix_(self.free, self.free)]
        return region.at(unit), log_q - np.linalg.slogdet(root)[1]

    def runs_in(self, region: Region, count: int, seed: int, first: int) -> RandomRuns:
        """Compute runs at ``count`` inputs of a region; ``first`` is the number of earlier runs."""
        u = sobol(count, len(self.free) + len(self.conditions), seed)
        # Runs are nearly uniform, because few at the ends would leave the spread open there.
        x, _ = self.at(region, u[:, : len(self.free)], spread=8.0)
        for place, column in enumerate(self.conditions, start=len(self.free)):
            x[:, column] = np.quantile(self.data.known[:, column], u[:, place])
        low, high = self.data.prior.min(axis=0), self.data.prior.max(axis=0)
        width = x.shape[1]
        inside = np.clip(x, low[:width], high[:width])
        x[:, self.free] = inside[:, self.free]
        places = np.repeat(np.arange(count), self.repeats)
        # The noise of a run is its number, so that a store keeps each of the repeated runs.
        number = first + np.arange(len(places))
        even = (number * 0.6180339887498949) % 1.0
        noise = np.asarray(4.0 * (2 * even - 1), dtype=np.float64)
        z = np.column_stack([x[places], self.noise.coordinates(noise[:, None])])
        y = self.run(z)
        is_finite = np.isfinite(y).all(axis=1)
        if is_finite.mean() < 1 - MAX_LOST:
            raise DesignError(
                f"{self.data.name}: got {int((~is_finite).sum())} of {len(y)} runs without a "
                f"finite response, expected at most {MAX_LOST:.0%} for a random response; return "
                "finite numbers, or give the inputs priors where the response exists"
            )
        return RandomRuns(z, y, places).rows(is_finite)

    def first_runs(self, count: int) -> RandomRuns:
        """Compute runs over the prior; raise if the response is not random."""
        region = self.region(self.data.inner, self.options.reach)
        runs = self.runs_in(region, count, self.data.seed, 0)
        _, first = np.unique(runs.places, return_index=True)
        of_first = runs.y[first][runs.places]
        if (runs.y == of_first).all():
            raise DesignError(
                f"{self.data.name}: got the same response in all repeated runs with the same "
                "inputs, expected a random one; pass the function itself without "
                "prb.response.Stochastic, or use the generator rng that it gets"
            )
        return runs

    def emulators(self, region: Region, runs: RandomRuns, count: int) -> list[Scatter]:
        """Return the emulator in a region, and ``count`` draws of it."""
        inner = runs.inside(region)
        x = inner.z[:, : len(region.center)]
        degrees = chosen_degrees(region, x, inner.y, inner.places)
        arguments = region, x, inner.y, inner.places, degrees
        return [fit_scatter(*arguments), *emulator_draws(*arguments, count, self.data.seed)]

    def points(self, scatters: list[Scatter], region: Region, u: Floats) -> SpecimenPoints:
        """Return shared points at places of the unit cube, (K, free), with draws of the emulator.

        The coordinates of the noise are those that give the readings, and A has their density.
        """
        readings, of_specimens = self.data.readings, self.data.known
        values = np.where(readings.is_measured, readings.values, np.nan)
        n, count = len(of_specimens), len(u)
        x, log_q = self.at(region, u)
        x = np.repeat(x[None], n if self.conditions.size else 1, axis=0)
        x[:, :, self.conditions] = of_specimens[: len(x), None, self.conditions]
        logs = [scatter.log_density(x, values, readings.error) for scatter in scatters]
        noise = scatters[0].noise(x, values)
        constant = np.log(self.noise.scale) - 0.5 * np.log(2 * np.pi)
        log_noise = constant - 0.5 * noise**2
        log_proposal = log_q + np.log(count) + log_noise.sum(axis=-1)
        of_noise = self.noise.coordinates(noise)
        z = np.concatenate([np.broadcast_to(x, (n, *x.shape[1:])), of_noise], axis=2)
        tilts = np.empty((n, count, 0))
        if len(scatters) > 1:
            of_draws = np.stack(logs[1:], axis=2)
            change = of_draws - logs[0][..., None]
            tilts = np.clip(change, -100.0, 100.0)
        of_all = x if len(x) == n else np.repeat(x, n, axis=0)
        flat = of_all.reshape(n * count, -1)
        flat_noise = noise.reshape(n * count, -1)
        outputs = scatters[0].outputs(flat, flat_noise)
        outputs = outputs.reshape(n, count, -1)
        n_roots = np.ones(n, dtype=np.intp)
        mode = np.zeros((n, count), dtype=np.intp)
        log_a = logs[0] - log_proposal
        return SpecimenPoints(z, outputs, log_a, log_proposal, n_roots, mode, tilts=tilts)

    def cube(self, count: int) -> Floats:
        """Return places of points in two independent halves, (count, free)."""
        d, half = len(self.free), count // 2
        if d == 1:
            steps = np.arange(half)[:, None] * 2
            order = np.concatenate([steps, steps + 1])
            return (order + 0.5) / count
        # Lattices integrate narrow densities better than scrambled points.
        rng = np.random.default_rng([self.data.seed, 11])
        places = lattice(np.arange(half), np.full(half, half), d)
        shifts = rng.random((2, 1, d))
        shifted = (places + shifts) % 1.0
        halves = inside(shifted)
        return halves.reshape(count, d)


def half_of(points: SpecimenPoints, part: slice) -> SpecimenPoints:
    """Return half of the points, with the numbers A of all points."""
    z = points.z[:, part]
    log_a = points.log_a[:, part] + np.log(2)
    log_proposal = points.log_proposal[:, part] - np.log(2)
    return replace(points, z=z, log_a=log_a, log_proposal=log_proposal)


def log_likelihoods_of(draws: DrawsWithMass, points: SpecimenPoints) -> Floats:
    """Return log-likelihoods of all specimens at a quarter of the draws, (S, 1)."""
    logs = draws.log_likelihoods(points.z, points.log_a)
    mass = draws.log_share(PointMass.of(points))
    result = logs.sum(axis=1) - mass[::4]
    return np.asarray(result)[:, None]


def agreeing_shared_points(
    response: RandomResponse, scatters: list[Scatter], region: Region, draws: DrawsWithMass
) -> SpecimenPoints:
    """Return points whose halves agree at posterior draws; raise DesignError if none do."""
    options = response.options
    # As for other points of inputs that the readings leave open.
    half_limit = response.data.options.half_difference
    limit = 2 * half_limit * per_hyperparameter(draws)
    count = options.points
    most = min(options.most_points, max(2**22 // len(response.data.readings), count))
    while True:
        points = response.points(scatters[:1], region, response.cube(count))
        parts = slice(count // 2), slice(count // 2, None)
        halves = [log_likelihoods_of(draws, half_of(points, part)) for part in parts]
        first, second = halves
        difference = half_difference(first, second)
        if difference[1] <= limit:
            points = response.points(scatters, region, response.cube(count))
            return replace(points, difference=difference[1])
        if 2 * count > most:
            raise DesignError(
                f"{response.data.name}: got two halves of {count} points whose log-likelihoods "
                f"differ by {difference[1]:.2g} nats, expected at most {limit:.2g}: the population "
                "is much narrower than the scatter of the response, or has many inputs; narrow the "
                "priors, or model fewer inputs as random"
            )
        count *= 2


@dataclass(frozen=True, eq=False)
class SharedPoints:
    """Runs, emulator and points of a random response."""

    emulation: Emulation
    points: SpecimenPoints
    draws: DrawsWithMass
    findings: Findings


def first_rounds(
    response: RandomResponse, earlier: Emulation | None, count: int
) -> tuple[RandomRuns, Region, DrawsWithMass]:
    """Return runs at ``count`` inputs, their region, and posterior draws from their emulator.

    Runs of an ``earlier`` emulator take their place.
    """
    options, data = response.options, response.data
    if earlier is not None:
        surface = cast(ScatterSurface, earlier.surface)
        runs, region = surface.runs, surface.scatter.region
        return runs, region, coarse_draws(response, runs, region)
    runs = response.first_runs(count // 4)
    region = response.region(data.inner, options.reach)
    draws = coarse_draws(response, runs, region)
    for size in (count // 4, count - count // 2):
        # Populations of the first runs are uncertain, so that the region is a quarter wider.
        reach = 1.25 * options.reach
        region = response.region(draws.specimens(), reach)
        n_runs = len(runs.z)
        more = response.runs_in(region, size, data.seed + n_runs, n_runs)
        runs = runs.joined(more)
        draws = coarse_draws(response, runs, region)
    return runs, region, draws


def shared_points(response: RandomResponse, earlier: Emulation | None) -> SharedPoints:
    """Return emulator and points of a random response; ``earlier`` has runs for other specimens.

    Runs are added until they cover the populations of the posterior, and doubled until the readings
    do not choose between draws of the emulator.
    """
    options, data = response.options, response.data
    n_inputs = len(response.free) + len(response.conditions)
    stated = data.options.n_first
    count = options.distinct_inputs(stated, n_inputs, response.repeats)
    runs, region, draws = first_rounds(response, earlier, count)
    while True:
        scatters = response.emulators(region, runs, options.draws)
        points = agreeing_shared_points(response, scatters, region, draws)
        draws = posterior_of(response, points)
        shares, shift = draw_shares(draws, points)
        squares = (shares**2).sum(axis=1)
        effective = float(np.mean(1 / squares))
        latest = response.region(draws.specimens(), options.reach)
        is_inside = region.contains(latest)
        if is_inside and effective >= options.least_draws:
            break
        n_runs = len(runs.z)
        size = int(runs.places.max()) + 1 if is_inside else count // 2
        if n_runs + response.repeats * size > options.most:
            break
        # Polynomials have no meaning where no runs are, so that the region changes with the runs.
        region = region if is_inside else latest
        more = response.runs_in(region, size, data.seed + n_runs, n_runs)
        runs = runs.joined(more)
    used = runs.inside(region)
    findings = [
        *scatter_findings(response, scatters[0], used),
        *_unreached(response, points),
        *_uncertain(response, len(runs.z), effective),
    ]
    surface = ScatterSurface(scatters[0], response.noise, runs)
    error = data.options.floor * data.readings.spread()
    ends = np.stack([used.z.min(axis=0), used.z.max(axis=0)])
    emulation = Emulation(runs.z, runs.y, surface, error, shift, ends)
    return SharedPoints(emulation, points, draws, tuple(findings))


def _uncertain(response: RandomResponse, n_runs: int, effective: float) -> list[Finding]:
    """Report an emulator that is less certain than the readings, by its effective draws."""
    name, options = response.data.name, response.options
    if effective >= options.least_draws:
        return []
    text = (
        f"{name}: got {n_runs} runs of a random response, whose emulator is less certain than the "
        f"readings: {effective:.1f} of {options.draws} draws of it count, expected "
        f"{options.least_draws:g}; intervals may be too narrow. Ask for more runs with "
        "propagation=prb.Reweighted(n)."
    )
    return [Finding("random-response", text, _PAGE)]


def coarse_draws(response: RandomResponse, runs: RandomRuns, region: Region) -> DrawsWithMass:
    """Return posterior draws from the emulator of the first runs."""
    scatters = response.emulators(region, runs, 0)
    return posterior_of(
        response, response.points(scatters, region, response.cube(response.options.points))
    )


def posterior_of(response: RandomResponse, points: SpecimenPoints) -> DrawsWithMass:
    """Return posterior draws of the hyperparameters given shared points."""
    draws = response.data.posterior(points.z, points.log_a, None, PointMass.of(points))
    return cast(DrawsWithMass, draws)


def draw_shares(draws: DrawsWithMass, points: SpecimenPoints) -> tuple[Floats, float]:
    """Return weights of draws of the emulator at posterior draws, (S, B), and their largest shift.

    The shift is the standard deviation, over the emulator, of posterior means, in posterior
    standard deviations.
    """
    assert points.tilts is not None
    first = draws.log_likelihoods(points.z, points.log_a).sum(axis=1)
    logs = np.stack(
        [
            draws.log_likelihoods(points.z, points.log_a + tilt).sum(axis=1)
            for tilt in np.moveaxis(points.tilts, 2, 0)
        ],
        axis=1,
    )
    shares = np.exp(logs - logsumexp(logs, axis=1, keepdims=True))
    ratio = logs - first[:, None]
    of_draws = np.exp(ratio - logsumexp(ratio, axis=0))
    step = len(draws.thetas) // len(first)
    thetas = draws.thetas[::step][: len(first)]
    means = of_draws.T @ thetas
    sd = np.maximum(thetas.std(axis=0), 1e-300)
    return shares, float((means.std(axis=0) / sd).max())


def scatter_findings(response: RandomResponse, scatter: Scatter, runs: RandomRuns) -> list[Finding]:
    """Report a mean that lacks detail, and residuals whose distribution differs by region."""
    data, level = response.data, response.options.level
    x = runs.z[:, : len(scatter.region.center)]
    mean, sd = scatter.moments(x)
    residuals = (runs.y - mean) / sd
    counts = np.bincount(runs.places)
    sums = np.zeros((len(counts), residuals.shape[1]))
    np.add.at(sums, runs.places, residuals)
    means = sums / counts[:, None]
    deviations = residuals - means[runs.places]
    within = (deviations**2).sum(axis=0)
    between = (counts[:, None] * means**2).sum(axis=0)
    df = len(counts) - len(scatter.mean_terms), len(residuals) - len(counts)
    findings = []
    for j, label in enumerate(data.output_names):
        explained = between[j] / df[0]
        unexplained = within[j] / df[1]
        p_fit = fdtrc(*df, explained / unexplained)
        if p_fit < level / len(data.output_names):
            text = (
                f"{data.name}: the mean of {label} given the inputs has more detail than the "
                f"emulator of {len(counts)} inputs (lack of fit, p = {p_fit:.1g}), which counts as "
                "scatter; ask for more runs with propagation=prb.Reweighted(n), or narrow the "
                "priors."
            )
            findings.append(Finding("random-response", text, _PAGE))
        columns = range(x.shape[1])
        p_shapes = [_p_of_halves(x[:, k], residuals[:, j]) for k in columns]
        if min(p_shapes) < level / (x.shape[1] * len(data.output_names)):
            k = int(np.argmin(p_shapes))
            text = (
                f"{data.name}: the scatter of {label} has another distribution at low than at high "
                f"values of input {k + 1} (p = {p_shapes[k]:.1g}), expected the same but for mean "
                "and spread; ask for more runs with propagation=prb.Reweighted(n), narrow the "
                "priors, or transform the output."
            )
            findings.append(Finding("random-response", text, _PAGE))
    return findings


def _p_of_halves(x: Floats, residuals: Floats) -> float:
    """Return the p-value of equal distributions of residuals below and above the median of x."""
    from scipy.stats import ks_2samp  # heavy, and only needed here

    is_low = x <= np.median(x)
    if is_low.all():
        return 1.0
    below = residuals[is_low]
    above = residuals[~is_low]
    test = ks_2samp(below, above)
    return float(test.pvalue)


def _unreached(response: RandomResponse, points: SpecimenPoints) -> list[Finding]:
    """Report specimens whose readings are far from all responses of the emulator."""
    best = (points.log_a + points.log_proposal).argmax(axis=1)
    z = points.z[np.arange(len(best)), best]
    noise = np.abs(response.noise.of(z)).max(axis=1)
    is_far = noise >= 3.99
    if not is_far.any():
        return []
    data = response.data
    row = int(np.argmax(is_far))
    count = int(is_far.sum())
    label = row if data.labels is None else data.labels[row]
    text = (
        f"{data.name}: got {count} specimens, such as {label}, whose readings no input "
        "explains by less than four standard deviations of the scatter, expected none; look at "
        "these readings, their units and the priors."
    )
    return [
        Finding("readings-misfit", text, "likelihood_findings.md#readings-that-no-inputs-reproduce")
    ]
