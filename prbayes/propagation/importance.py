"""Importance sampling of populations: points from mixtures, stored runs, and weighted samples.

Between stored runs a sample may have points with emulated responses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pytensor.tensor as pt
from scipy.special import ndtr, ndtri

from prbayes._stats import positive_scale
from prbayes._validate import IN_CACHE, Bools, Floats, Indices, Shape
from prbayes.emulators.emulator import ROUGH_CANDIDATES, Emulator
from prbayes.emulators.selection import TrainingRuns, weight_of_runs
from prbayes.emulators.surfaces import as_surface
from prbayes.numerics.points import base_points, inside
from prbayes.numerics.threads import one_thread
from prbayes.propagation.base import N_BLOCKS
from prbayes.propagation.moving_support import refuse_moving_atoms
from prbayes.propagation.population_density import PopulationDensity
from prbayes.response.compile import compile_batched
from prbayes.response.distributions import PopulationSampler, quantiles
from prbayes.response.inputs import Inputs


@dataclass(frozen=True, eq=False)
class Mixture:
    """A finite mixture of populations."""

    components: tuple[Floats, ...]  # (k, *shape): values of each parent, a row for each population
    counts: Floats  # (k,): number of points from each population, its mixing weight

    def joined(self, more: Mixture) -> Mixture:
        """Return the mixture of the points of both."""
        components = concatenated(self.components, more.components)
        return Mixture(components, np.concatenate([self.counts, more.counts]))


@dataclass(frozen=True, eq=False)
class MixtureSampler:
    """Quasi-random points from mixtures of populations of some inputs."""

    name: str  # name of the simulator, for messages
    inputs: Inputs
    density: PopulationDensity

    def draw(
        self,
        components: Sequence[Floats],
        n: int,
        seed: int,
        shares: Floats | None = None,
        spread: float = 1.0,
    ) -> tuple[tuple[Floats, ...], Mixture]:
        """Return n points of populations with ``shares``, (k,), equal by default.

        Their normal scores have the standard deviation ``spread``. If it is not one, an input
        without an inverse distribution function raises TypeError.
        """
        points, mixture = self._drawn(components, n, seed, shares, spread)
        return self._off_the_edges(points, mixture), mixture

    def equal_mass(
        self, components: Sequence[Floats], n: int, seed: int
    ) -> tuple[tuple[Floats, ...], Mixture]:
        """Return n points of one input that cut the mixture into parts of equal mass."""
        # Draw 16 candidates for each point, which needs no response. 2^18 candidates are a fine
        # grid for any design.
        n_draft = min(16 * n, 1 << 18)
        (draft,), drawn = self._drawn(components, n_draft, seed, None)
        mixture = Mixture(drawn.components, drawn.counts * (n / drawn.counts.sum()))
        shift = np.random.default_rng(seed).uniform()
        finite = draft[np.isfinite(draft)]
        grid, n_equal = np.unique(finite, return_counts=True)
        levels = (np.arange(n) + shift) / n
        log_density = self.log_density(drawn, [grid])
        # A value that more than two points of the design would have, and that has a finite density,
        # has positive probability, such as a bound of a censored input.
        is_frequent = n_equal > 2 * n_draft / n
        if np.any(is_frequent & np.isfinite(log_density)):
            ranks = (levels * finite.size).astype(int)
            return self._off_the_edges([np.sort(finite)[ranks]], mixture), mixture
        cumulated = (np.arange(grid.size) + 0.5) / grid.size
        density = np.exp(log_density)
        with np.errstate(invalid="ignore", over="ignore"):
            trapezoids = 0.5 * (density[1:] + density[:-1]) * np.diff(grid)
            mass = np.concatenate([[0.0], np.cumsum(trapezoids)])
            difference = np.abs(mass / mass[-1] - cumulated).max()
        # The integral by trapezoids is more accurate than the empirical distribution function of
        # the grid, unless the density is infinite at an edge or has peaks between grid points. In
        # these cases the two functions differ by more than the sampling error.
        if difference < 1 / np.sqrt(grid.size):
            points = np.interp(levels * mass[-1], mass, grid)
        else:
            points = np.interp(levels, cumulated, grid)
        return self._off_the_edges([points], mixture), mixture

    def log_density(self, mixture: Mixture, points: Sequence[Floats]) -> Floats:
        """Return the log-density of a mixture at points, (n,)."""
        shares = mixture.counts / mixture.counts.sum()
        n = len(points[0])
        result = np.empty(n)
        log_densities = self.density.at(mixture.components, points)
        step = max(1, IN_CACHE // shares.size)
        for start in range(0, n, step):
            chunk = slice(start, start + step)
            densities = log_densities(chunk)
            largest = densities.max(axis=0)
            largest = np.where(np.isfinite(largest), largest, 0.0)
            densities -= largest
            np.exp(densities, out=densities)
            with np.errstate(divide="ignore"):
                result[chunk] = np.log(shares @ densities) + largest
        return result

    def _drawn(
        self,
        components: Sequence[Floats],
        n: int,
        seed: int,
        shares: Floats | None,
        spread: float = 1.0,
    ) -> tuple[list[Floats], Mixture]:
        """Return points and the mixture from which they were drawn.

        Scrambled Sobol points are transformed by the inverse distribution functions where these
        exist. One of the Sobol axes selects the population, so that populations are stratified.
        """
        k = len(components[0])
        selector, uniforms = base_points(self.inputs.event_shapes, n, seed)
        if spread != 1.0:
            uniforms = [inside(ndtr(spread * ndtri(u))) for u in uniforms]
        if shares is None:
            population = (selector * k).astype(int)
        else:
            population = np.searchsorted(np.cumsum(shares), selector, side="right")
        population = np.minimum(population, k - 1)
        parents = [c[population] for c in components]
        try:
            points = list(self._quantiles(*parents, *uniforms))
            if any(np.isnan(x).any() for x in points):
                raise TypeError("an inverse distribution function without a number")
        except TypeError:  # without an inverse distribution function points are drawn at random
            if spread != 1.0:
                raise
            rng = np.random.default_rng(seed)
            draws, _ = PopulationSampler(self.inputs)(parents, 1, rng)
            points = [x[:, 0] for x in draws]
        refuse_moving_atoms(self.name, self.inputs, points, population)
        counts = np.bincount(population, minlength=k).astype(float)
        return points, Mixture(tuple(components), counts)

    def _off_the_edges(self, points: Sequence[Floats], mixture: Mixture) -> tuple[Floats, ...]:
        """Return points, after a shift by a rounding unit of those where the density is infinite.

        Quantiles may be rounded to the edge of a support, where densities such as that of
        ``Beta.dist(1, 0.5)`` have no finite value.
        """
        is_infinite = np.isposinf(self.log_density(mixture, points))
        moved = list(points)
        if is_infinite.any():
            for i, x in enumerate(moved):
                if x.dtype.kind == "f":
                    inner = np.nextafter(x, np.median(x, axis=0))
                    moved[i] = x.copy()
                    moved[i][is_infinite] = inner[is_infinite]
        return tuple(moved)

    @cached_property
    def _quantiles(self) -> Any:
        """Compiled function from parents and uniform numbers to quantiles of the inputs."""
        symbols = self.inputs.placeholders()
        shapes = [x.type.shape for x in self.inputs.aleatory]
        uniforms = [pt.tensor(dtype="float64", shape=shape) for shape in shapes]
        batched = [u[None] for u in uniforms]
        placed, _ = through_inverses(self.name, self.inputs, symbols, batched)
        return compile_batched([*symbols, *uniforms], [x[0] for x in placed])


def new_specimens(
    label: str, inputs: Inputs, parents: list[Floats], n: int, rng: np.random.Generator
) -> tuple[list[Floats], list[Floats]]:
    """Return aleatory inputs, (k, n, *event), and epistemic ones of n specimens of k populations.

    Sobol points in random order with a random shift for each population; random draws where an
    input has no inverse distribution function.
    """
    symbols = inputs.placeholders()
    uniforms = [pt.tensor(dtype="float64", shape=(None, *s)) for s in inputs.event_shapes]
    try:
        placed, epistemic = through_inverses(label, inputs, symbols, uniforms)
    except TypeError:
        return PopulationSampler(inputs)(parents, n, rng)
    _, base = base_points(inputs.event_shapes, n, int(rng.integers(2**31)))
    order = rng.permutation(n)
    k = len(parents[0])
    shifted = []
    for points in base:
        shift = rng.random((k, 1, *points.shape[1:]))
        shifted.append(inside((points[order] + shift) % 1))
    function = compile_batched([*symbols, *uniforms], [*placed, *epistemic])
    values = function(*inputs.for_specimens(parents, n), *shifted)
    aleatory = values[: len(placed)]
    return aleatory, [v[:, None] for v in values[len(placed) :]]


def through_inverses(
    label: str, inputs: Inputs, symbols: list[Any], uniforms: list[Any]
) -> tuple[list[Any], list[Any]]:
    """Return inputs by inverse distribution functions; raise TypeError where there is none."""
    if inputs.nested:
        raise TypeError("no inverse of a conditional distribution")
    dists, epistemic = inputs.rebuilt(symbols)
    placed = [quantiles(label, d, u) for d, u in zip(dists, uniforms, strict=True)]
    return placed, epistemic


@dataclass(frozen=True)
class EmulatedSizes:
    """Sizes of emulated samples, whose points cost no run; few populations fill space evenly."""

    first: int = 8192  # number of points of the first emulated sample
    largest: int = 65536  # number of points of the largest emulated sample
    # Share of points from the prior, if there are populations of interest.
    prior_share: float = 1 / 16
    # Number of populations from the prior, if there are populations of interest.
    from_prior: int = 96
    near: int = 30  # number of populations from each other group, in a sample of the first size
    # Mixing weight of the runs above which only the runs are used, and below which only the
    # emulated points are used. In between a mixture of both has the least error.
    runs_alone: float = 0.95
    runs_negligible: float = 0.05


SIZES = EmulatedSizes()


@dataclass(frozen=True, eq=False)
class Sample:
    """Points with their responses and proposal density, for importance weights."""

    points: tuple[Floats, ...]  # (n, *event): points, an array for each aleatory input
    values: Floats  # (n,) or (n, m): responses; NaN without a response
    log_density: Floats  # (n,): log-density of the mixture that the points were drawn from
    blocks: Indices  # (n,): index of the batch, of eight, that each point belongs to

    def __len__(self) -> int:
        return len(self.values)

    def rows(self, mask: Bools) -> Sample:
        """Return some of the points."""
        points = tuple(x[mask] for x in self.points)
        return Sample(points, self.values[mask], self.log_density[mask], self.blocks[mask])


@dataclass(frozen=True, eq=False)
class DesignEmulator:
    """An emulator of one response, fitted to the runs of a design."""

    runs: TrainingRuns
    emulator: Emulator
    left_out: Floats  # (n, m): cross-validation predictions at the runs
    event: Shape  # shape of one response: () or (m,)
    weights: Floats  # (T, n): importance weights of the runs in T populations of interest
    run_share: float = 1.0  # mixing weight of the runs among the points of a population
    # Root mean square cross-validation error of the worst output, in units of the output's spread
    # in the populations of interest.
    error: float = np.nan
    worst_output: int = 0

    @classmethod
    @one_thread()
    def fit(cls, emulator: Any, runs: Sample, weights: Floats) -> DesignEmulator | None:
        """Fit an emulator to runs; None where the runs alone are as good.

        ``emulator`` is a surface or a regressor, or a text for the best of several surfaces.
        ``weights``, (T, n), are those of the runs in the populations that matter.
        """
        x = columns(runs.points)
        y = runs.values.reshape(len(runs), -1)
        fitted = TrainingRuns(x, y, weights.mean(axis=0), runs.blocks)
        tried = ROUGH_CANDIDATES if isinstance(emulator, str) else [as_surface(emulator)]
        try:
            best = fitted.fit(tried)
            left_out = fitted.left_out_predictions(best)
        except np.linalg.LinAlgError:
            return None
        fit = cls(fitted, best, left_out, runs.values.shape[1:], weights)
        return fit.for_populations(weights)

    def for_populations(self, weights: Floats) -> DesignEmulator | None:
        """Return the same surfaces for populations; None where the runs alone are as good."""
        runs, left_out = self.runs, self.left_out
        share = weight_of_runs(weights, runs.y, left_out, runs.blocks)
        if share > SIZES.runs_alone:
            return None
        share = 0.0 if share < SIZES.runs_negligible else share
        has_prediction = runs.good & np.isfinite(left_out).all(axis=1)
        importance = weights.mean(axis=0)[has_prediction]
        total = importance.sum()
        errors = np.full(runs.y.shape[1], np.nan)
        if total > 0:
            y = runs.y[has_prediction]
            importance = importance / total
            spread = np.sqrt(importance @ (y - importance @ y) ** 2)
            error = np.sqrt(importance @ (left_out[has_prediction] - y) ** 2)
            errors = error / positive_scale(spread)
        worst = int(errors.argmax())
        return replace(
            self, weights=weights, run_share=share, error=float(errors[worst]), worst_output=worst
        )

    @property
    def error_text(self) -> str:
        """The error of the worst output."""
        name = "the response"
        if self.event:
            name = f"output {self.worst_output} of {self.event[0]} (counted from 0)"
        return f"{self.error:.2g} standard deviations of {name}"

    @one_thread()
    def at(self, points: Sequence[Floats]) -> Floats:
        """Return the responses at points, (M, *event) by input -> (M,) or (M, m)."""
        return self.runs.predict(self.emulator, columns(points)).reshape(-1, *self.event)

    @one_thread()
    def without_each_block(self, points: Sequence[Floats]) -> list[Floats]:
        """Return the responses by emulators that were fitted without one block of the runs."""
        by_block = self.runs.predict_without_blocks(self.emulator, columns(points))
        return [values.reshape(-1, *self.event) for values in by_block]

    def joined(self, points: tuple[Floats, ...], log_density: Floats, runs: Sample) -> Sample:
        """Return emulated points and runs as one sample, in which runs have their share."""
        m, n = len(points[0]), len(runs)
        values = self.at(points)
        blocks = np.arange(m) * N_BLOCKS // m
        if not self.run_share:
            return Sample(points, values, log_density, blocks)
        # Importance weights are p / g. These constants make their mean over all points one.
        of_points = log_density - np.log((1 - self.run_share) * (m + n) / m)
        of_runs = runs.log_density - np.log(self.run_share * (m + n) / n)
        return Sample(
            points=concatenated(points, runs.points),
            values=np.concatenate([values, runs.values]),
            log_density=np.concatenate([of_points, of_runs]),
            blocks=np.concatenate([blocks, runs.blocks]),
        )


def columns(points: Sequence[Floats]) -> Floats:
    """Return inputs as columns, (n, d)."""
    return np.concatenate([x.reshape(len(x), -1).astype(float) for x in points], axis=1)


def spread_over(group: Sequence[Floats], count: int) -> list[Floats]:
    """Return ``count`` populations, spread evenly over a group; those of a small one repeat."""
    size = len(group[0])
    if size < count:
        rows = np.arange(count) * size // count
    else:
        rows = np.linspace(0, size - 1, count).astype(int)
    return [values[rows] for values in group]


def mixture_of(groups: Sequence[Sequence[Floats]], size: int) -> tuple[list[Floats], Floats]:
    """Return the populations of an emulated sample, and their shares; the prior comes first."""
    prior, *posteriors = groups
    if not posteriors:
        count = 384  # more populations take time and do not change the results
        return spread_over(prior, count), np.full(count, 1 / count)
    near = SIZES.near * size // SIZES.first
    parts = [spread_over(prior, SIZES.from_prior), *(spread_over(g, near) for g in posteriors)]
    share = (1 - SIZES.prior_share) / (near * len(posteriors))
    shares = np.full(SIZES.from_prior + near * len(posteriors), share)
    shares[: SIZES.from_prior] = SIZES.prior_share / SIZES.from_prior
    return list(concatenated(*parts)), shares


def concatenated(*parts: Sequence[Floats]) -> tuple[Floats, ...]:
    """Return arrays by input, each of which joins those of the parts."""
    return tuple(map(np.concatenate, zip(*parts, strict=True)))
