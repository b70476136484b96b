"""Points from mixtures of populations, and the log-density of the mixtures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pytensor.tensor as pt

from prbayes._validate import IN_CACHE, Floats
from prbayes.numerics.points import base_points, inside
from prbayes.propagation.moving_support import refuse_moving_atoms
from prbayes.propagation.population_density import PopulationDensity
from prbayes.response.compile import compile_batched
from prbayes.response.distributions import PopulationSampler, quantiles
from prbayes.response.inputs import Inputs


@dataclass(frozen=True, eq=False)
class Mixture:
    """A finite mixture of populations."""

    components: tuple[Floats, ...]  # (k, *shape), by root
    counts: Floats  # (k,): number of points from each component, its weight

    def joined(self, more: Mixture) -> Mixture:
        """Return the mixture of the points of both."""
        pairs = zip(self.components, more.components, strict=True)
        components = tuple(np.concatenate([a, b]) for a, b in pairs)
        return Mixture(components, np.concatenate([self.counts, more.counts]))


@dataclass(frozen=True, eq=False)
class MixtureSampler:
    """Quasi-random points from mixtures of populations of some inputs."""

    name: str  # of the simulator, for messages
    inputs: Inputs
    density: PopulationDensity

    def draw(
        self, components: Sequence[Floats], n: int, seed: int, shares: Floats | None = None
    ) -> tuple[tuple[Floats, ...], Mixture]:
        """Return n points of populations with ``shares``, (k,), equal by default.

        Scrambled Sobol points go through the inverse distribution functions where they exist. One
        of their axes selects the population: populations are stratified.
        """
        points, mixture = self._drawn(components, n, seed, shares)
        return self._off_the_edges(points, mixture), mixture

    def equal_mass(
        self, components: Sequence[Floats], n: int, seed: int
    ) -> tuple[tuple[Floats, ...], Mixture]:
        """Return n points of one input that cut the mixture into parts of equal mass."""
        # 16 draft points for each, without a response; 2^18 are a grid for any design.
        n_draft = min(16 * n, 1 << 18)
        (draft,), drawn = self._drawn(components, n_draft, seed, None)
        mixture = Mixture(drawn.components, drawn.counts * (n / drawn.counts.sum()))
        shift = np.random.default_rng(seed).uniform()
        finite = draft[np.isfinite(draft)]
        grid, n_equal = np.unique(finite, return_counts=True)
        levels = (np.arange(n) + shift) / n
        log_density = self.log_density(drawn, [grid])
        # A value with probability itself, such as a bound of a censored input, is more frequent
        # than two points of the design, and has a finite density.
        is_frequent = n_equal > 2 * n_draft / n
        if np.any(is_frequent & np.isfinite(log_density)):
            ranks = (levels * finite.size).astype(int)
            points = np.sort(finite)[ranks]
        else:
            points = _inverted(levels, grid, np.exp(log_density))
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
        self, components: Sequence[Floats], n: int, seed: int, shares: Floats | None
    ) -> tuple[list[Floats], Mixture]:
        """Return points and their mixture."""
        k = len(components[0])
        selector, uniforms = base_points(self.inputs.event_shapes, n, seed)
        if shares is None:
            population = (selector * k).astype(int)
        else:
            population = np.searchsorted(np.cumsum(shares), selector, side="right")
        population = np.minimum(population, k - 1)
        roots = [c[population] for c in components]
        try:
            points = list(self._quantiles(*roots, *uniforms))
        except TypeError:  # a distribution without inverse distribution function
            rng = np.random.default_rng(seed)
            draws, _ = PopulationSampler(self.inputs)(roots, 1, rng)
            points = [x[:, 0] for x in draws]
        refuse_moving_atoms(self.name, self.inputs, points, population)
        counts = np.bincount(population, minlength=k).astype(float)
        return points, Mixture(tuple(components), counts)

    def _off_the_edges(self, points: Sequence[Floats], mixture: Mixture) -> tuple[Floats, ...]:
        """Return points, moved by a rounding where the density is infinite.

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
        """The compiled inverse distribution functions of roots and uniform numbers."""
        symbols = self.inputs.placeholders()
        shapes = [x.type.shape for x in self.inputs.aleatory]
        uniforms = [pt.tensor(dtype="float64", shape=shape) for shape in shapes]
        dists, _ = self.inputs.rebuilt(symbols)
        pairs = zip(dists, uniforms, strict=True)
        points = [quantiles(self.name, dist, uniform[None])[0] for dist, uniform in pairs]
        return compile_batched([*symbols, *uniforms], points)


def _inverted(levels: Floats, grid: Floats, density: Floats) -> Floats:
    """Return the quantiles of some levels, (n,), from a density on an ascending grid, (m,)."""
    cumulated = (np.arange(grid.size) + 0.5) / grid.size
    with np.errstate(invalid="ignore", over="ignore"):
        trapezoids = 0.5 * (density[1:] + density[:-1]) * np.diff(grid)
        mass = np.concatenate([[0.0], np.cumsum(trapezoids)])
        difference = np.abs(mass / mass[-1] - cumulated).max()
    # Trapezoids are finer than the empirical distribution function of the grid, unless the density
    # is infinite at an edge, or has peaks between points: both then differ more than random points.
    if difference < 1 / np.sqrt(grid.size):
        return np.asarray(np.interp(levels * mass[-1], mass, grid))
    return np.asarray(np.interp(levels, cumulated, grid))


def new_specimens(
    label: str, inputs: Inputs, roots: list[Floats], n: int, rng: np.random.Generator
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
        return PopulationSampler(inputs)(roots, n, rng)
    _, base = base_points(inputs.event_shapes, n, int(rng.integers(2**31)))
    order = rng.permutation(n)
    k = len(roots[0])
    shifted = []
    for points in base:
        shift = rng.random((k, 1, *points.shape[1:]))
        shifted.append(inside((points[order] + shift) % 1))
    function = compile_batched([*symbols, *uniforms], [*placed, *epistemic])
    values = function(*roots, *shifted)
    aleatory = values[: len(placed)]
    return aleatory, [v[:, None] for v in values[len(placed) :]]


def through_inverses(
    label: str, inputs: Inputs, symbols: list[Any], uniforms: list[Any]
) -> tuple[list[Any], list[Any]]:
    """Return aleatory inputs as inverse distribution functions of uniforms, and epistemic ones.

    Raises
    ------
    TypeError
        If a distribution has no inverse, or depends on another one.
    """
    if inputs.nested:
        raise TypeError("no inverse of a conditional distribution")
    dists, epistemic = inputs.rebuilt(symbols)
    placed = [quantiles(label, d, u) for d, u in zip(dists, uniforms, strict=True)]
    return placed, epistemic
