"""Share of a population that has a response, under the log-likelihood by specimen.

Where a response is NaN, no specimen can be measured. The measured specimens are then from the
population that is truncated to inputs with a response,

    log p(y_i | theta) = log L_i(theta) - log S(theta),

    S(theta) = integral over inputs with a response of p(x | theta) dx
             ~= sum_{k with a response} exp(B_k) p(x_k | theta) / sum_k exp(B_k) p(x_k | theta),

B_k = -log q(x_k). Neither the points x_k nor the proposal density q contain theta.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import logsumexp, stdtrit

from prbayes._finding import any_of
from prbayes._validate import ArrayFunction, Floats
from prbayes.numerics.points import farthest_rows, sobol
from prbayes.propagation.base import DesignError
from prbayes.propagation.population_density import PopulationDensity
from prbayes.specimens.coordinates import Coordinates
from prbayes.specimens.design import first_runs
from prbayes.specimens.emulation import Emulation, fit_surface
from prbayes.specimens.points import SpecimenData
from prbayes.specimens.selection import Selection
from prbayes.specimens.weighted_points import WeightedPoints


@dataclass(frozen=True, eq=False)
class ResponseShare:
    """Points from which the share of a population that has a response follows."""

    z: Floats  # (M, d): coordinates; the points with a response first
    log_b: Floats  # (M,): minus the log of the proposal density of z, up to a constant
    with_response: int  # number of points with a response

    def of_populations(
        self, density: PopulationDensity, parents: Sequence[Floats], coordinates: Coordinates
    ) -> Floats:
        """Return log S of the populations at parents, shapes (S, *shape) -> (S,).

        Zero where the populations have no point with a response.
        """
        log_b = self.log_b + coordinates.log_jacobian(self.z)
        x = coordinates.inputs(self.z)
        integrals = []
        for rows in (slice(self.with_response), slice(self.with_response, None)):
            of_rows = [v[None, rows] for v in x]
            points = WeightedPoints.of(density, of_rows, log_b[None, rows])
            integrals.append(points.log_likelihoods(parents)[:, 0])
        inside, outside = integrals
        is_finite = np.isfinite(inside)
        log_ratio = outside - np.where(is_finite, inside, 0)
        return np.where(is_finite, -np.logaddexp(0.0, log_ratio), 0.0)


def response_share(
    run: ArrayFunction,
    data: SpecimenData,
    emulation: Emulation,
    posterior: Callable[[ResponseShare | None, Emulation], Any],
    selection: Selection | None = None,
    *,
    count: int = 4096,
    batches: int = 6,
) -> tuple[Emulation, ResponseShare | None]:
    """Return the points of the share, and the emulation with runs at the failing region's boundary.

    None where the share changes the log-likelihood of no plausible population by more than the
    error of the points of the specimens. ``posterior`` maps a share and its emulation to draws of
    the hyperparameters, with ``log_share(share)``, (S,), and ``specimens()``, (n, d). Each half has
    ``count`` points at first, and there are at most ``batches`` batches of runs at the boundary.
    With a ``selection`` the share is that of the specimens that are measured.

    Raise DesignError if boundary or points do not determine the share.
    """
    if selection is None and not np.isnan(emulation.y).any():
        return emulation, None
    seed, name, options = data.seed, data.name, data.options
    largest = options.half_difference
    draws = posterior(None, emulation)

    def draw(number: int, half: int) -> ResponseShare:
        samples = (data.prior, draws.specimens())
        return _points(emulation, samples, number, 2 * seed + half, selection)

    share = draw(count, 0)
    if selection is None and np.sqrt((draws.log_share(share) ** 2).mean()) <= largest:
        return emulation, None
    draws = posterior(share, emulation)
    _, other_metric = data.remedies()
    # Probabilities are smooth beside a boundary, so that fewer points suffice.
    count = count if selection is None else count // 2
    subject = "a failing region (NaN)" if selection is None else "limits of selected="
    batch = max(2 * first_runs(emulation.z.shape[1]), 32)
    for _ in range(batches):
        fresh = boundary_points(emulation, draws.specimens(), batch, seed)
        if selection is not None:
            uncertain = selection.uncertain_points(emulation, draws.specimens(), batch)
            fresh = np.concatenate([fresh, uncertain])
        previous = draws.log_share(share)
        if len(fresh):
            emulation = emulation.with_runs(fresh, run(fresh))
        if selection is not None:
            z, y = emulation.z, emulation.y
            surface, *_ = fit_surface(z, y, data.readings, name, emulation.surface)
            emulation = replace(emulation, surface=surface)
        share = draw(count, 0)
        change = float(np.std(draws.log_share(share) - previous))
        if change <= largest / 4:
            break
    else:
        raise DesignError(
            f"{name}: got {subject} whose boundary still changes the log-likelihood "
            f"by {change:.2g} nats after {batches} batches of {batch} runs there, expected at most "
            f"{largest / 4}; {any_of('repair the response', 'narrow the priors', other_metric)}"
        )
    draws = posterior(share, emulation)
    return emulation, _agreeing_share(data, draws, draw, count)


def _agreeing_share(
    data: SpecimenData, draws: Any, draw: Callable[[int, int], ResponseShare], count: int
) -> ResponseShare:
    """Return a share whose halves agree at draws, doubled from ``count`` points in each."""
    largest = data.options.half_difference
    _, other_metric = data.remedies()
    while True:
        halves = [draw(count, half) for half in (0, 1)]
        logs = [draws.log_share(half) for half in halves]
        difference = float(np.std(logs[0] - logs[1]) / 2)
        if difference <= largest:
            break
        count *= 2
        if count > 2**16:
            raise DesignError(
                f"{data.name}: got two halves of {count // 2} points whose shares without response "
                f"change the log-likelihood by {difference:.2g} nats, expected at most {largest}; "
                f"{any_of('narrow the priors', other_metric)}"
            )
    return _of_both_halves(halves)


def renewed_share(
    data: SpecimenData,
    emulation: Emulation,
    specimens: Floats,
    share: ResponseShare,
    selection: Selection,
) -> ResponseShare:
    """Return as many new points around specimens, (n, d), with the outputs of a later emulation."""
    samples, count = (data.prior, specimens), len(share.z) // 4
    halves = [_points(emulation, samples, count, 2 * data.seed + k, selection) for k in (0, 1)]
    return _of_both_halves(halves)


def _of_both_halves(halves: Sequence[ResponseShare]) -> ResponseShare:
    """Return the points of several shares as one."""
    z = np.concatenate([half.z for half in halves])
    log_b = np.concatenate([half.log_b for half in halves])
    # Each half has the points with a response, or its part that is measured, first.
    first = [np.arange(len(half.z)) < half.with_response for half in halves]
    order = np.argsort(~np.concatenate(first), kind="stable")
    return ResponseShare(z[order], log_b[order], sum(h.with_response for h in halves))


def _points(
    emulation: Emulation,
    samples: tuple[Floats, ...],
    count: int,
    seed: int,
    selection: Selection | None,
    degrees: float = 5.0,
) -> ResponseShare:
    """Draw Sobol points from a mixture around samples: whitened, t distributed elements."""
    size = count // len(samples)
    d = samples[0].shape[1]
    # By sample: a mean, and the root of an inflated covariance.
    normals = [
        (sample.mean(axis=0), np.linalg.cholesky(1.5 * np.cov(sample.T).reshape(d, d)))
        for sample in samples
    ]
    parts = []
    for k, (mean, root) in enumerate(normals):
        parts.append(mean + stdtrit(degrees, sobol(size, d, 1009 * seed + k)) @ root.T)
    z = np.concatenate(parts)
    log_q = []
    for mean, root in normals:
        standard = np.linalg.solve(root, (z - mean).T)
        log_t = -(degrees + 1) / 2 * np.log1p(standard**2 / degrees)
        log_q.append(log_t.sum(axis=0) - np.log(np.diag(root)).sum())
    return _sorted(z, -logsumexp(log_q, axis=0), emulation, selection)


def _sorted(
    z: Floats, log_b: Floats, emulation: Emulation, selection: Selection | None
) -> ResponseShare:
    """Return the share with the points that have a response first.

    With a selection a point is there twice: with the probability that it is measured, and with that
    of the contrary.
    """
    is_missing = emulation.is_missing(z)
    order = np.argsort(is_missing, kind="stable")
    count = int((~is_missing).sum())
    z, log_b = z[order], log_b[order]
    if selection is None:
        return ResponseShare(z, log_b, count)
    # Beyond the runs' range the response is that at the end of the range.
    inside = np.clip(z[:count], emulation.box[0], emulation.box[1])
    log_seen = selection.log_probability(emulation.extended(inside), emulation.error)
    with np.errstate(divide="ignore"):
        log_unseen = np.log(-np.expm1(log_seen))
    is_seen, is_unseen = log_seen > -100, log_unseen > -100
    points = np.concatenate([z[:count][is_seen], z[:count][is_unseen], z[count:]])
    logs = [(log_b[:count] + log_seen)[is_seen], (log_b[:count] + log_unseen)[is_unseen]]
    return ResponseShare(points, np.concatenate([*logs, log_b[count:]]), int(is_seen.sum()))


def boundary_points(emulation: Emulation, z: Floats, count: int, seed: int = 0) -> Floats:
    """Return points for runs between runs with and without response, at most (count, d).

    A point is near the boundary if its distances to the nearest run with and to the nearest run
    without a response differ by less than a factor of two. They are selected one by one among
    specimens z of plausible populations, (n, d), each farthest from all runs.
    """
    from scipy.spatial import cKDTree

    width = emulation.box[1] - emulation.box[0]
    is_missing = np.isnan(emulation.y).any(axis=1)
    with_response, without = (
        cKDTree(emulation.z[rows] / width).query(z / width)[0] for rows in (~is_missing, is_missing)
    )
    distance = np.minimum(with_response, without)
    near = np.flatnonzero(np.maximum(with_response, without) < 2 * distance)
    # A sample: the population decides where on the boundary the runs are.
    near = np.random.default_rng(seed).permutation(near)[: 4 * count]
    rows = farthest_rows(z[near] / width, min(count, len(near)), distance[near] ** 2)
    return z[near[rows]]
