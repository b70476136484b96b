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

from prbayes._checks import Floats
from prbayes.metrics.readings import Readings
from prbayes.propagation.base import DesignError
from prbayes.propagation.fibre import ReferencePopulation, fit_fibres, with_error
from prbayes.propagation.guards import half_difference
from prbayes.propagation.points import sobol
from prbayes.propagation.roots import Response
from prbayes.propagation.specimen_points import (
    Emulation,
    PointOptions,
    SpecimenPoints,
    extended,
    first_runs,
    spread_out,
    typical_sd,
)


class Draws(Protocol):
    """Draws of the hyperparameters."""

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
    emulation = Emulation.first(run, 2 * sobol(n, d, seed) - 1, bounds, readings, options, name)
    population = ReferencePopulation.from_sample(prior_specimens)
    rng = np.random.default_rng([seed, 1])
    count = 256
    for batch in range(6):
        points, draws = _reliable_draws(
            emulation, readings, population, posterior, count, options, seed + batch, name
        )
        count = points.z.shape[1]
        population = ReferencePopulation.from_sample(draws.specimens())
        if batch >= 2 and emulation.bias <= options.bias:
            break
        fresh = _fresh(points, draws, max(n // 2, options.fresh), options.fresh, bounds, rng)
        emulation = extended(emulation, run, fresh, readings, options, spread, name)
    if emulation.bias > options.bias:
        raise DesignError(
            f"{name}: got an emulator whose error would shift a mean or standard deviation of an "
            f"input by {emulation.bias:.2g} posterior standard deviations after "
            f"{len(emulation.z)} runs, expected at most {options.bias}; use "
            "metric=prb.ProbabilityResidual(), or more first runs with "
            "propagation=prb.Reweighted(n)"
        )
    # Points on fibres cost more than those around roots, and their error falls more slowly.
    goal, largest = 2 * options.half_difference, 3 * options.half_difference
    count = 128
    while True:
        halves = [_draw(emulation, readings, population, count, 100 + seed + h) for h in (0, 1)]
        difference = _difference(*(draws.log_likelihoods(p.z, p.log_a) for p in halves))
        is_last = 4 * count > options.most_points
        if difference <= (largest if is_last else goal):
            break
        if is_last:
            raise _monte_carlo_error(name, 2 * count, difference, largest)
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
        Half difference in nats that shifts a posterior by about its standard deviation.
    """
    free = population.root.shape[0] - int(readings.is_measured.sum(axis=1).min())
    narrows = False
    while True:
        points = _draw(emulation, readings, population, count, seed)
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
            if difference <= largest:
                return points, draws
            if 2 * count > options.most_points:
                raise _monte_carlo_error(name, count, difference, largest)
        smoothing = count ** (-2 / (free + 4)) * population.root @ population.root.T
        specimens = posterior(points.z, points.log_a, smoothing).specimens()
        smoothed = ReferencePopulation.from_sample(specimens).wider(smoothing)
        volumes = [np.diag(p.root).prod() for p in (smoothed, population)]
        narrows = bool(volumes[0] < volumes[1] / 2)
        population = smoothed
        count = count if narrows else 2 * count


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
    """Return two independent sets of points as one; each counts half."""
    return _Points(
        np.concatenate([first.z, second.z], axis=1),
        np.concatenate([first.outputs, second.outputs], axis=1),
        np.concatenate([first.log_a, second.log_a], axis=1) - np.log(2),
        np.concatenate([first.log_proposal, second.log_proposal], axis=1) + np.log(2),
    )


def _draw(
    emulation: Emulation, readings: Readings, population: ReferencePopulation, count: int, seed: int
) -> _Points:
    """Draw points of all specimens, by the pattern of outputs that were measured."""
    n, m = readings.values.shape
    d = len(population.mean)
    z = np.empty((n, count, d))
    log_proposal = np.full((n, count), np.inf)
    exact = np.zeros((n, count))
    sd = readings.comparison_sd(emulation.error)
    has_error = readings.is_measured & ((readings.error > 0) | (readings.step > 0))
    patterns, which = np.unique(
        np.concatenate([readings.is_measured, has_error], axis=1), axis=0, return_inverse=True
    )
    numbers = np.arange(n)
    for k, pattern in enumerate(patterns):
        rows = np.flatnonzero(which.ravel() == k)
        columns = np.flatnonzero(pattern[:m])
        noisy = pattern[m:][columns]
        part = readings.rows(rows)
        if not len(columns):
            z[rows], log_proposal[rows] = _population_points(population, rows, count, seed)
            continue
        response = _columns(emulation, columns)
        y = part.values[:, columns]
        if not noisy.any() and len(columns) < d:
            points = fit_fibres(response, y, population, seed=seed, numbers=numbers[rows]).draw(
                count, seed
            )
            z[rows], exact[rows] = points.x, points.log_a
            log_proposal[rows] = 0.0
            continue
        # A reading error per pattern; the density of each reading replaces it below.
        error = typical_sd(sd[np.ix_(rows, columns)])
        proposal = fit_fibres(
            with_error(response, error),
            y,
            population.with_errors(len(columns)),
            seed=seed,
            numbers=numbers[rows],
        )
        points = proposal.draw(count, seed).without_errors(len(columns))
        z[rows] = points.x
        values, _ = response(points.x.reshape(-1, d))
        away = (y[:, None] - values.reshape(len(rows), count, -1)) / error
        log_normal = -0.5 * away**2 - np.log(error) - 0.5 * np.log(2 * np.pi)
        normal = log_normal.sum(axis=-1)
        log_proposal[rows] = normal - points.log_a
    outputs = emulation(z.reshape(-1, d))[0].reshape(n, count, m)
    is_exact = np.isfinite(log_proposal) & (log_proposal == 0.0)
    censored = replace(readings, values=np.full_like(readings.values, np.nan))
    log_a = np.where(
        is_exact,
        exact + censored.log_density(outputs, emulation.error),
        readings.log_density(outputs, emulation.error) - log_proposal,
    )
    return _Points(z, outputs, np.where(np.isnan(log_a), -np.inf, log_a), log_proposal)


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
    population: ReferencePopulation, rows: NDArray[np.intp], count: int, seed: int
) -> tuple[Floats, Floats]:
    """Return points of a wide population, and the log of count times their density."""
    from scipy.special import ndtri

    d = len(population.mean)
    base = sobol(count, d, seed)
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
    sampled: int,
    bounds: Floats,
    rng: np.random.Generator,
) -> Floats:
    """Return points for new runs: a sample of the specimens' inputs, and the rest spread out."""
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
    return spread_out(z, bounds, count, sampled, rng)
