"""Points of specimens with fewer measured outputs than inputs: emulation and points on fibres.

The readings of such a specimen do not determine its inputs: its points have to cover every
plausible population. The reference population in which they are drawn is the prior
predictive one at first, then that of draws of the posterior, twice. Posteriors of smoothed
populations come before these where points lie farther apart than populations are wide.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from prbayes._validate import Floats
from prbayes.metrics.readings import Readings
from prbayes.numerics.points import sobol
from prbayes.numerics.threads import one_thread
from prbayes.propagation.base import DesignError
from prbayes.propagation.charts import ReferencePopulation
from prbayes.propagation.fibre import FibreProposal, fit_fibres, with_error
from prbayes.propagation.guards import half_difference
from prbayes.propagation.roots import Response
from prbayes.propagation.specimen_emulation import (
    Emulation,
    PointOptions,
    extended,
    first_runs,
    require_accurate,
    spread_out,
    typical_sd,
)
from prbayes.propagation.specimen_points import SpecimenPoints, joined


class Draws(Protocol):
    """Draws of the hyperparameters."""

    @property
    def thetas(self) -> Floats:
        """The draws, (S, p)."""

    def log_likelihoods(self, z: Floats, log_a: Floats) -> Floats:
        """Return log p(y_i | theta), (S, N)."""

    def specimens(self) -> Floats:
        """Return coordinates of specimens, (n, d)."""


type Posterior = Callable[[Floats, Floats, Floats | None], Draws]


def fibre_points(
    run: Callable[[Floats], Floats],
    readings: Readings,
    bounds: Floats,
    prior_specimens: Floats,
    posterior: Posterior,
    options: PointOptions,
    *,
    n: int | None = None,
    seed: int = 0,
    name: str = "response",
) -> tuple[Emulation, SpecimenPoints]:
    """Emulate a response and draw points on the fibres of all specimens.

    ``run`` maps coordinates (n, d) to outputs (n, m), NaN where there is no response. ``bounds``,
    (2, d), and ``prior_specimens``, (n, d), are those of the prior predictive population, whose
    middle 99 % lies within [-1, 1]. ``posterior`` maps points (N, K, d), their numbers (N, K), and
    None or a covariance (d, d) by which populations are smoothed, to draws of the hyperparameters.
    ``n`` is the number of first runs.

    Raises
    ------
    DesignError
        If the response cannot be emulated well enough, or `most_points` are not enough.
    """
    d = bounds.shape[1]
    n = first_runs(d) if n is None else n
    population = ReferencePopulation.from_sample(prior_specimens)
    # Wider than the population by half; even points of a box would be in its corners.
    first = np.clip(population.inputs(1.5 * ndtri(sobol(n, d, seed))), *bounds)
    emulation = Emulation.first(run, first, bounds, readings, options, name)
    rng = np.random.default_rng([seed, 1])
    count, batch_size = 256, max(n // 2, options.fresh)
    for batch in range(6):
        points, draws = _reliable_draws(
            emulation, readings, population, posterior, count, options, seed + batch, name
        )
        count = points.z.shape[1]
        population = ReferencePopulation.from_sample(draws.specimens())
        if batch >= 2 and emulation.bias <= options.bias:
            break
        fresh = _fresh(points, draws, batch_size, bounds, rng)
        half = batch_size // 2
        emulation = extended(emulation, run, fresh, readings, options, name, half)
    require_accurate(emulation, readings, options, name)
    # Points on fibres cost more than those around roots, and their error falls more slowly.
    unit = options.half_difference * _per_hyperparameter(draws)
    count = 128
    proposals = [
        FibreProposals.fitted(emulation, readings, population, 100 + seed + half) for half in (0, 1)
    ]
    halves = [proposal.draw(count) for proposal in proposals]
    while True:
        difference = _difference(*(draws.log_likelihoods(p.z, p.log_a) for p in halves))
        is_last = 4 * count > options.most_points
        largest = 3 * unit if is_last else 2 * unit
        if difference <= largest:
            break
        if is_last:
            raise _monte_carlo_error(name, 2 * count, difference, largest)
        halves = [
            joined(half, proposal.draw(count, after=count))
            for half, proposal in zip(halves, proposals, strict=True)
        ]
        count *= 2
    return emulation, replace(joined(*halves), difference=difference)


def _reliable_draws(
    emulation: Emulation,
    readings: Readings,
    population: ReferencePopulation,
    posterior: Posterior,
    count: int,
    options: PointOptions,
    seed: int,
    name: str,
) -> tuple[SpecimenPoints, Draws]:
    """Return points, at first ``count``, and draws at which both halves of the points agree.

    Where points lie farther apart than populations are wide, the likely populations are those
    where points happen to lie close. Populations that are wider by the bandwidth of Scott's rule
    have a smooth log-likelihood. They narrow the reference population, in which points are drawn
    again, until it narrows no more; then points are doubled. A half difference of one nat shifts
    the posterior of four hyperparameters by about half of their standard deviations.
    """
    free = population.root.shape[0] - int(readings.is_measured.sum(axis=1).min())
    narrows = False
    while True:
        points = FibreProposals.fitted(emulation, readings, population, seed).draw(count)
        if not narrows:
            draws = posterior(points.z, points.log_a, None)
            halves = slice(count // 2), slice(count // 2, None)
            difference = _difference(
                *(draws.log_likelihoods(points.z[:, k], points.log_a[:, k]) for k in halves)
            )
            limit = _per_hyperparameter(draws)
            if difference <= limit:
                return points, draws
            if 2 * count > options.most_points:
                raise _monte_carlo_error(name, count, difference, limit)
        smoothing = count ** (-2 / (free + 4)) * population.root @ population.root.T
        specimens = posterior(points.z, points.log_a, smoothing).specimens()
        smoothed = ReferencePopulation.from_sample(specimens).wider(smoothing)
        volumes = [np.diag(p.root).prod() for p in (smoothed, population)]
        narrows = bool(volumes[0] < volumes[1] / 2)
        population = smoothed
        count = count if narrows else 2 * count


def _per_hyperparameter(draws: Draws) -> float:
    """Return the error of a log-likelihood that shifts hyperparameters as 1 shifts each of four.

    A random function of p hyperparameters with a standard deviation of s nats over the posterior
    has slopes of about s / sqrt(p) nats a posterior standard deviation, and shifts means by that.
    """
    return float(np.sqrt(max(draws.thetas.shape[1], 4) / 4))


def _monte_carlo_error(name: str, count: int, difference: float, largest: float) -> DesignError:
    return DesignError(
        f"{name}: got two halves of {count} points a specimen whose log-likelihoods differ by "
        f"{difference:.2g} nats, expected at most {largest:.2g}; measure more outputs of each "
        "specimen, narrow the priors, or use metric=prb.ProbabilityResidual()"
    )


def _difference(first: Floats, second: Floats) -> float:
    """Return the half difference of log-likelihoods (S, N) over the draws where both are finite."""
    finite = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
    return half_difference(first[finite], second[finite]) if finite.any() else np.inf


@dataclass(frozen=True, eq=False)
class FibreProposals:
    """Proposals on the fibres of specimens, by the pattern of outputs that were measured."""

    emulation: Emulation
    readings: Readings
    population: ReferencePopulation
    seed: int
    patterns: list[_Pattern]

    @classmethod
    @one_thread()
    def fitted(
        cls, emulation: Emulation, readings: Readings, population: ReferencePopulation, seed: int
    ) -> FibreProposals:
        """Return proposals that are fitted to the fibres under a population."""
        m = readings.values.shape[1]
        sd = readings.comparison_sd(emulation.error)
        has_error = readings.is_measured & ((readings.error > 0) | (readings.step > 0))
        flags = np.concatenate([readings.is_measured, has_error], axis=1)
        patterns, number = np.unique(flags, axis=0, return_inverse=True)
        proposals = []
        for k, pattern in enumerate(patterns):
            rows = np.flatnonzero(number.ravel() == k)
            columns = np.flatnonzero(pattern[:m])
            if not len(columns):
                proposals.append(_Pattern(rows, columns))
                continue
            response = _columns(emulation, columns)
            y = readings.values[np.ix_(rows, columns)]
            error, reference = None, population
            if pattern[m:].any() or len(columns) >= len(population.mean):
                # A reading error per pattern; the density of each reading replaces it in `draw`.
                error = typical_sd(sd[np.ix_(rows, columns)])
                response = with_error(response, error)
                reference = population.with_errors(len(columns))
            proposal = fit_fibres(response, y, reference, seed=seed, numbers=rows)
            proposals.append(_Pattern(rows, columns, proposal, error))
        return cls(emulation, readings, population, seed, proposals)

    @one_thread()
    def draw(self, count: int, after: int = 0) -> SpecimenPoints:
        """Draw points of all specimens, other ones than the first `after`."""
        n, m = self.readings.values.shape
        d = len(self.population.mean)
        z = np.empty((n, count, d))
        log_proposal = np.full((n, count), np.inf)
        exact = np.full((n, count), np.nan)
        for pattern in self.patterns:
            rows, columns = pattern.rows, pattern.columns
            if pattern.proposal is None:
                z[rows], log_proposal[rows] = _population_points(
                    self.population, rows, count, self.seed, after
                )
                continue
            points = pattern.proposal.draw(count, self.seed, after)
            if pattern.error is None:
                z[rows], exact[rows] = points.x, points.log_a
                log_proposal[rows] = 0.0
                continue
            points = points.without_errors(len(columns))
            z[rows] = points.x
            values, _ = _columns(self.emulation, columns)(points.x.reshape(-1, d))
            y = self.readings.values[np.ix_(rows, columns)]
            residual = (y[:, None] - values.reshape(len(rows), count, -1)) / pattern.error
            log_normal = -0.5 * residual**2 - np.log(pattern.error) - 0.5 * np.log(2 * np.pi)
            log_proposal[rows] = log_normal.sum(axis=-1) - points.log_a
        outputs = self.emulation.values(z.reshape(-1, d)).reshape(n, count, m)
        readings, error = self.readings, self.emulation.error
        censored = replace(readings, values=np.full_like(readings.values, np.nan))
        log_a = np.where(
            np.isnan(exact),
            readings.log_density(outputs, error) - log_proposal,
            exact + censored.log_density(outputs, error),
        )
        log_a = np.where(np.isnan(log_a), -np.inf, log_a)
        return SpecimenPoints(z, outputs, log_a, log_proposal, np.zeros(n, dtype=np.intp))


@dataclass(frozen=True, eq=False)
class _Pattern:
    """Specimens with the same outputs measured, and the proposal on their fibres."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    proposal: FibreProposal | None = None  # None: nothing is measured
    error: Floats | None = None  # (columns,): of the readings; None if they are exact


def _columns(emulation: Emulation, columns: NDArray[np.intp]) -> Response:
    """Return the response of some outputs."""

    def response(z: Floats) -> tuple[Floats, Floats]:
        values, jacobian = emulation(z)
        low, high = emulation.box
        outside = ((z < low - 0.5) | (z > high + 0.5)).any(axis=1)
        values, jacobian = values[:, columns], jacobian[:, columns]
        # The emulator has no runs there.
        values[outside], jacobian[outside] = np.nan, np.nan
        return values, jacobian

    return response


def _population_points(
    population: ReferencePopulation, rows: NDArray[np.intp], count: int, seed: int, after: int
) -> tuple[Floats, Floats]:
    """Return points of a wide population, and the log of count times their density."""
    d = len(population.mean)
    base = sobol(after + count, d, seed)[after:]
    rng = np.random.default_rng([seed, 2])
    size = int(rows.max()) + 1
    shift = rng.random((size, 1, d))[rows]
    u = np.clip((base + shift) % 1.0, 1e-12, 1 - 1e-12)
    standard = ndtri(u)
    wide = 1.5
    z = population.mean + wide * standard @ population.root.T
    log_det = np.log(np.diag(population.root)).sum() + d * np.log(wide)
    square = (standard**2).sum(axis=-1)
    density = -0.5 * square - d / 2 * np.log(2 * np.pi) - log_det
    return z, density + np.log(count)


def _fresh(
    points: SpecimenPoints,
    draws: Draws,
    count: int,
    bounds: Floats,
    rng: np.random.Generator,
) -> Floats:
    """Return points for new runs: half a sample of the specimens' inputs, half spread out."""
    specimens = draws.specimens()
    _, n_points, d = points.z.shape
    # Weights of the points under the normal population of the draws.
    mean, covariance = specimens.mean(axis=0), np.cov(specimens.T).reshape(d, d)
    centred = points.z - mean
    square = np.einsum("nkd,de,nke->nk", centred, np.linalg.inv(covariance), centred)
    log_w = -0.5 * square + points.log_a
    finite = np.isfinite(log_w).any(axis=1)
    log_w = log_w[finite]
    weights = np.exp(log_w - log_w.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    cumulative = np.cumsum(weights, axis=1)
    samples = []
    for _ in range(max(1, -(-2 * count // len(weights)))):
        k = (cumulative < rng.random((len(weights), 1))).sum(axis=1).clip(max=n_points - 1)
        samples.append(points.z[finite][np.arange(len(k)), k])
    z = np.clip(np.concatenate(samples), bounds[0], bounds[1])
    return spread_out(z, bounds, count, count // 2, rng)
