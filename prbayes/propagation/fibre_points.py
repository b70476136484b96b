"""Points of specimens with fewer measured outputs than inputs: emulation and points on fibres.

The inputs of such a specimen are not determined by its readings, so that its points have to cover
every plausible population. The reference population in which they are drawn is the prior
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
from prbayes.propagation.fibre import (
    FibreProposal,
    ReferencePopulation,
    fit_fibres,
    with_error,
)
from prbayes.propagation.guards import half_difference
from prbayes.propagation.roots import Response
from prbayes.propagation.specimen_points import (
    Emulation,
    PointOptions,
    SpecimenPoints,
    extended,
    first_runs,
    require_accurate,
    spread_out,
    typical_sd,
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


@dataclass(frozen=True, eq=False)
class _Points:
    """Points of all specimens."""

    z: Floats  # (N, K, d)
    outputs: Floats  # (N, K, m)
    log_a: Floats  # (N, K)
    log_proposal: Floats  # (N, K)


def fibre_points(
    run: Callable[[Floats], Floats],
    readings: Readings,
    bounds: Floats,
    prior_specimens: Floats,
    posterior: Callable[[Floats, Floats, Floats | None], Draws],
    options: PointOptions,
    *,
    n: int | None = None,
    seed: int = 0,
    name: str = "response",
) -> tuple[Emulation, SpecimenPoints]:
    """Emulate a response and draw points on the fibres of all specimens.

    Parameters
    ----------
    run : callable
        Coordinates (n, d) -> outputs (n, m); NaN where there is no response.
    readings : Readings
    bounds : ndarray, shape (2, d)
        Of the prior predictive population; its middle 99 % lies within [-1, 1].
    prior_specimens : ndarray, shape (n, d)
        Specimens of the prior predictive population.
    posterior : callable
        Points (N, K, d), their numbers (N, K), and a covariance (d, d) by which populations are
        smoothed, or None -> draws of the hyperparameters.
    options : PointOptions
    n : int, optional
        First runs.
    seed : int
    name : str
        For messages.

    Raises
    ------
    DesignError
        If the response cannot be emulated well enough, or `most_points` are not enough.
    """
    d = bounds.shape[1]
    n = first_runs(d) if n is None else n
    spread = readings.spread()
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
        emulation = extended(emulation, run, fresh, readings, options, spread, name, half)
    require_accurate(emulation, readings, options, name)
    # Points on fibres cost more than those around roots, and their error falls more slowly.
    unit = options.half_difference * _per_hyperparameter(draws)
    goal, largest = 2 * unit, 3 * unit
    count = 128
    proposals = [
        FibreProposals.fitted(emulation, readings, population, 100 + seed + half) for half in (0, 1)
    ]
    halves = [proposal.draw(count) for proposal in proposals]
    while True:
        difference = _difference(*(draws.log_likelihoods(p.z, p.log_a) for p in halves))
        is_last = 4 * count > options.most_points
        if difference <= (largest if is_last else goal):
            break
        if is_last:
            raise _monte_carlo_error(name, 2 * count, difference, largest)
        halves = [
            _joined(half, proposal.draw(count, after=count))
            for half, proposal in zip(halves, proposals, strict=True)
        ]
        count *= 2
    joint = _joined(*halves)
    return emulation, SpecimenPoints(
        joint.z,
        joint.outputs,
        joint.log_a,
        joint.log_proposal,
        np.zeros(len(readings), dtype=np.intp),
        difference,
    )


def _reliable_draws(
    emulation: Emulation,
    readings: Readings,
    population: ReferencePopulation,
    posterior: Callable[[Floats, Floats, Floats | None], Draws],
    count: int,
    options: PointOptions,
    seed: int,
    name: str,
    largest: float = 1.0,
) -> tuple[_Points, Draws]:
    """Return points and draws at which both halves of the points agree.

    Where points lie farther apart than populations are wide, the likely populations are those
    where points happen to lie close. Populations that are wider by the bandwidth of Scott's rule
    have a smooth log-likelihood. They narrow the reference population, in which points are drawn
    anew, until it narrows no more; then points are doubled.

    Parameters
    ----------
    count : int
        Points at first.
    largest : float
        Half difference in nats that shifts the posterior of four hyperparameters by about half of
        their standard deviations.
    """
    free = population.root.shape[0] - int(readings.is_measured.sum(axis=1).min())
    narrows = False
    while True:
        points = FibreProposals.fitted(emulation, readings, population, seed).draw(count)
        if not narrows:
            draws = posterior(points.z, points.log_a, None)
            half = count // 2
            parts = (
                (points.z[:, :half], points.log_a[:, :half]),
                (
                    points.z[:, half:],
                    points.log_a[:, half:],
                ),
            )
            difference = _difference(*(draws.log_likelihoods(*part) for part in parts))
            limit = largest * _per_hyperparameter(draws)
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


def _joined(first: _Points, second: _Points) -> _Points:
    """Return two sets of points as one; each counts half."""
    return _Points(
        np.concatenate([first.z, second.z], axis=1),
        np.concatenate([first.outputs, second.outputs], axis=1),
        np.concatenate([first.log_a, second.log_a], axis=1) - np.log(2),
        np.concatenate([first.log_proposal, second.log_proposal], axis=1) + np.log(2),
    )


@dataclass(frozen=True, eq=False)
class FibreProposals:
    """Proposals on the fibres of specimens, by the pattern of outputs that were measured.

    Attributes
    ----------
    emulation : Emulation
    readings : Readings
    population : ReferencePopulation
    seed : int
    patterns : list of _Pattern
    """

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
        both = np.concatenate([readings.is_measured, has_error], axis=1)
        patterns, which = np.unique(both, axis=0, return_inverse=True)
        fitted = []
        for k, pattern in enumerate(patterns):
            rows = np.flatnonzero(which.ravel() == k)
            columns = np.flatnonzero(pattern[:m])
            if not len(columns):
                fitted.append(_Pattern(rows, columns))
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
            fitted.append(_Pattern(rows, columns, proposal, error))
        return cls(emulation, readings, population, seed, fitted)

    @one_thread()
    def draw(self, count: int, after: int = 0) -> _Points:
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
            away = (y[:, None] - values.reshape(len(rows), count, -1)) / pattern.error
            log_normal = -0.5 * away**2 - np.log(pattern.error) - 0.5 * np.log(2 * np.pi)
            log_proposal[rows] = log_normal.sum(axis=-1) - points.log_a
        outputs = self.emulation.values(z.reshape(-1, d)).reshape(n, count, m)
        readings, error = self.readings, self.emulation.error
        censored = replace(readings, values=np.full_like(readings.values, np.nan))
        log_a = np.where(
            np.isnan(exact),
            readings.log_density(outputs, error) - log_proposal,
            exact + censored.log_density(outputs, error),
        )
        return _Points(z, outputs, np.where(np.isnan(log_a), -np.inf, log_a), log_proposal)


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
        is_beyond = (z < low - 0.5) | (z > high + 0.5)
        outside = is_beyond.any(axis=1)
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
    points: _Points,
    draws: Draws,
    count: int,
    bounds: Floats,
    rng: np.random.Generator,
) -> Floats:
    """Return points for new runs: half a sample of the specimens' inputs, half spread out."""
    specimens = draws.specimens()
    _, each, d = points.z.shape
    # Weights of the points under the normal population of the draws.
    mean, covariance = specimens.mean(axis=0), np.cov(specimens.T).reshape(d, d)
    away = points.z - mean
    log_w = -0.5 * np.einsum("nkd,de,nke->nk", away, np.linalg.inv(covariance), away) + points.log_a
    finite = np.isfinite(log_w).any(axis=1)
    log_w = log_w[finite]
    weights = np.exp(log_w - log_w.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    cumulative = np.cumsum(weights, axis=1)
    chosen = []
    for _ in range(max(1, -(-2 * count // len(weights)))):
        k = (cumulative < rng.random((len(weights), 1))).sum(axis=1).clip(max=each - 1)
        chosen.append(points.z[finite][np.arange(len(k)), k])
    z = np.clip(np.concatenate(chosen), bounds[0], bounds[1])
    return spread_out(z, bounds, count, count // 2, rng)
