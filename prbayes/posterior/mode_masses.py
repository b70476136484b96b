r"""Masses of the modes of draws, by bridge sampling, and the finding about several modes.

Sequential Monte Carlo draws well within modes, but the shares of modes are those of few early
particles, and the larger modes gain: its proposals are fitted to the particles that they move. The
mass of each mode is estimated by a bridge between its draws and a t distribution (Meng and Wong
1996, Statistica Sinica 6, 831-860):

.. math:: m = \frac{E_q[l / (s l + (1 - s) m)]}{E_p[1 / (s l + (1 - s) m)]}, \quad
          l = \pi / q.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import log_softmax

from prbayes._finding import Finding
from prbayes._stats import log_sum_exp, reached
from prbayes._validate import Floats, Indices
from prbayes.model.evaluator import Evaluator
from prbayes.numerics.mixtures import StudentMixture, normalised_weights
from prbayes.numerics.modes import Laplace, LogDensity, rows_by_mode
from prbayes.optimize.optimum import point_text


class ModeMasses(NamedTuple):
    """Modes of a posterior with their shares."""

    places: Floats  # (M, d): mean of the draws of each mode, or its Laplace mode
    shares: Floats  # (M,)
    errors: Floats  # (M,): standard errors of the shares
    draws: Floats  # (n, d): draws that are resampled so that the modes have these shares


def bridged_modes(
    log_density: LogDensity,
    draws: Floats,
    unit: Floats,
    modes: Sequence[Laplace],
    rng: np.random.Generator,
) -> ModeMasses | None:
    """Return the modes of a posterior with masses by bridge sampling; None if there is one.

    Valleys of the draws, (n, d), separate modes, whose directions are searched in a unit, (d,).
    Half of the draws determine t distributions, the other half estimates the masses. Laplace
    approximations stand for modes with too few draws; their draws are those of the t distribution.
    """
    members = rows_by_mode(draws / unit)
    fits = [_fitted(draws[rows[::2]]) for rows in members]
    is_rich = [True] * len(fits)
    for mode in modes:
        centers = [fit.centers[0] for fit in fits]
        if mode.converged and all(has_valley(log_density, mode.mode, x) for x in centers):
            root = np.linalg.cholesky(mode.covariance)
            fits.append(StudentMixture(mode.mode[None], root[None], np.ones(1), degrees=5.0))
            is_rich.append(False)
    if len(fits) < 2:
        return None

    def mode_of(points: Floats) -> Indices:
        return np.argmax([fit.log_density(points) for fit in fits], axis=0)

    labels, is_held_out = mode_of(draws), np.ones(len(draws), dtype=bool)
    for rows in members:
        is_held_out[rows[::2]] = False
    logs, variances, candidates = [], [], [draws]
    log_weights = [np.full(len(draws), -np.inf)]
    for k, fit in enumerate(fits):
        is_inside = labels == k
        inside = draws[is_inside & is_held_out]
        proposed = fit.draws(max(len(inside), 2000), int(rng.integers(2**31)))
        ratios = [log_density(x) - fit.log_density(x) for x in (inside, proposed)]
        ratios[1][mode_of(proposed) != k] = -np.inf
        log_mass, variance = bridge(*ratios)
        logs.append(log_mass)
        variances.append(variance)
        if is_rich[k]:
            log_weights[0][is_inside] = log_mass - np.log(max(is_inside.sum(), 1))
        else:
            candidates.append(proposed)
            log_weights.append(ratios[1] - np.log(len(proposed)))
    shares = np.exp(log_softmax(logs))
    # Error propagation of shares proportional to masses with independent relative errors.
    slopes = shares[:, None] * (np.eye(len(shares)) - shares)
    levels = (np.arange(len(draws)) + rng.random()) / len(draws)
    weights = normalised_weights(np.concatenate(log_weights))
    rows = rng.permutation(reached(weights, levels, normalized=True))
    return ModeMasses(
        np.array([fit.centers[0] for fit in fits]),
        shares,
        np.sqrt(slopes**2 @ variances),
        np.concatenate(candidates)[rows],
    )


def has_valley(log_density: LogDensity, a: Floats, b: Floats) -> bool:
    """Return whether the log-density falls by one below both modes on the line between them."""
    heights = log_density(a + np.linspace(0, 1, 21)[:, None] * (b - a))
    return bool(heights.min() < min(heights[0], heights[-1]) - 1)


def _fitted(draws: Floats) -> StudentMixture:
    """Return a t distribution with the moments of draws, (n, d)."""
    covariance = np.atleast_2d(np.cov(draws, rowvar=False))
    root = np.linalg.cholesky(covariance + 1e-9 * np.diag(np.diag(covariance)))
    return StudentMixture(draws.mean(axis=0)[None], root[None], np.ones(1), degrees=5.0)


def bridge(at_draws: Floats, at_proposals: Floats) -> tuple[float, float]:
    """Return the log mass of a density and the variance of this estimate.

    The arguments are log ratios of the density to a normalised proposal at draws of the density,
    (n,), and at draws of the proposal, (m,).
    """
    n, m = len(at_draws), len(at_proposals)
    if n == 0:
        at_draws = np.full(1, -np.inf)
    log_s, log_t = np.log([max(n, 1e-9) / (n + m), m / (n + m)])
    log_mass = float(log_sum_exp(at_proposals[None])[0] - np.log(m))
    for _ in range(100):
        # terms of the numerator and of the denominator
        upper = at_proposals - np.logaddexp(log_s + at_proposals, log_t + log_mass)
        lower = -np.logaddexp(log_s + at_draws, log_t + log_mass)
        means = [float(log_sum_exp(x[None])[0]) - np.log(len(x)) for x in (upper, lower)]
        previous, log_mass = log_mass, means[0] - means[1]
        if abs(log_mass - previous) < 1e-6:
            break
    # relative variances of both means (Frühwirth-Schnatter 2004, Econom. J. 7)
    terms = zip((upper, lower), means, strict=True)
    return log_mass, float(sum(np.var(np.exp(x - mean)) / len(x) for x, mean in terms))


def modes_finding(
    evaluator: Evaluator, places: Floats, shares: Floats, error: str
) -> list[Finding]:
    """Report the shares of modes, if two or more have 1 % of the draws.

    Places, (M, d), are in unconstrained space. ``error`` is a remark on the accuracy of the shares.
    """
    parts = [
        f"{share:.0%} near {point_text(evaluator, place)}"
        for place, share in zip(places, shares, strict=True)
        if share >= 0.01
    ]
    if len(parts) < 2:
        return []
    text = (
        f"The posterior has {len(parts)} modes, with shares of the draws{error}: "
        f"{'; '.join(parts)}. "
        "Means and standard deviations over all draws mix them; report each, or state "
        "a prior that excludes the others."
    )
    return [Finding("second-mode", text, "optimum_or_abc.md#two-answers")]
