"""How much each of several modes counts: what the fits of data sets by all of them tell.

exp(-d / epsilon) is no likelihood of the mode: a kernel hides what tells two modes apart, and an
area sees it otherwise than its epsilon says. So data sets are drawn from each mode and fitted in
all of them, and it is seen how differences of their discrepancies are distributed in each; where
that of the measured data lies among them tells the modes apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from prbayes._checks import Floats
from prbayes.estimate.batch_objective import BatchObjective
from prbayes.estimate.data_sets import DataSets, observed_set, sets_along
from prbayes.estimate.refit import SamplingDistribution
from prbayes.model.elements import split_elements, told_elements

# By judgement, as all that follows. Standard errors beyond which a fit ran away, and tells nothing
# of the others.
_ELSEWHERE_BY_FAR = 6.0
# Share of the data sets of a mode that have to be fitted in all of them.
_FITTED = 0.5
# Difference of d / epsilon that tells nothing: a tenth of a unit of a log-likelihood, of which
# refits are known to a hundredth.
_TELLS_NOTHING = 0.1
# Hyperparameters that a sentence about modes has at most, those in which they are farthest apart.
_SAID = 4
# What is said of modes where fits do not tell how much they count.
BY_EPSILON = ", which count as epsilon says"


@dataclass(frozen=True, eq=False)
class Mode:
    """A mode of the draws, and where they should be."""

    sampling: SamplingDistribution  # at its optimum; scales are epsilons
    share: float  # of the draws
    before: Floats  # (r, r): covariance of the draws, in coordinates
    center: Floats  # (r,): of those that the data warrant
    after: Floats  # (r, r)


def mode_weights(modes: Sequence[Mode], n_sets: int, rng: np.random.Generator) -> Floats | None:
    """Return how much modes count, (M,), with sum one; None where fits do not tell.

    In place of exp(-d / epsilon) at each optimum, and of the draws' volume around it, come the
    density of the measured data's differences among those of data sets from the mode, given its
    estimate, and the volume that the data warrant. The prior is in the shares of the draws.

    Parameters
    ----------
    modes : sequence of Mode
        Of stored responses.
    n_sets : int
        Data sets that are drawn in each, and fitted in all.
    rng : numpy.random.Generator

    References
    ----------
    .. [1] Marin, J.-M., N. S. Pillai, C. P. Robert and J. Rousseau (2014), Relevant statistics for
       Bayesian model choice, J. R. Stat. Soc. B 76, 833-859, doi:10.1111/rssb.12056.
    """
    evaluator = modes[0].sampling.evaluator
    places, (here,) = _fitted(modes, observed_set(evaluator))
    measured = here[1:] - here[0]
    centers = []
    scatters = []
    for m, mode in enumerate(modes):
        root = np.linalg.cholesky(mode.after)
        points = mode.center + rng.standard_normal((n_sets, len(root))) @ root.T
        sets = sets_along(evaluator, mode.sampling.thetas(points), rng)
        estimates, least = _fitted(modes, sets)
        differences = least[:, 1:] - least[:, :1]
        away = estimates[m] - places[m]
        known = np.isfinite(differences).all(axis=1)
        known &= (np.abs(away) < _ELSEWHERE_BY_FAR).all(axis=1)
        if known.sum() < _FITTED * n_sets:
            return None
        center, scatter = _given_estimate(differences[known], away[known])
        centers.append(center)
        scatters.append(scatter)
    # One for all modes: with one each, the widest would win where measured differences are far off.
    scatter = np.mean(scatters, axis=0) + _TELLS_NOTHING**2 * np.eye(len(modes) - 1)
    off = measured - np.array(centers)
    log_density = -0.5 * np.einsum("mi,mi->m", off, np.linalg.solve(scatter, off.T).T)
    log_share = np.log([mode.share for mode in modes])
    log_volume = [
        0.5 * (np.linalg.slogdet(mode.after)[1] - np.linalg.slogdet(mode.before)[1])
        for mode in modes
    ]
    found = np.asarray(softmax(log_share + here + log_volume + log_density))
    return found if np.isfinite(found).all() else None


def _fitted(modes: Sequence[Mode], sets: DataSets) -> tuple[list[Floats], Floats]:
    """Return minimisers of data sets in each mode, (n, r) each, and their values, (n, M).

    NaN where a fit did not converge.
    """
    places = []
    columns = []
    for mode in modes:
        sampling = mode.sampling
        x, converged = sampling.refit(sets)
        objective = BatchObjective.of(sampling.evaluator, sampling.scales, sets)
        (values,) = objective(sampling.thetas(x)[:, None], np.arange(len(x))).T
        places.append(x)
        columns.append(np.where(converged, values, np.nan))
    return places, np.stack(columns, axis=1)


def _given_estimate(differences: Floats, away: Floats) -> tuple[Floats, Floats]:
    """Return mean and covariance of differences, (n, M - 1), where estimates are not away, (n, r).

    By their regression on the estimates.
    """
    terms = np.column_stack([np.ones(len(away)), away])
    coefficients, *_ = np.linalg.lstsq(terms, differences)
    left = differences - terms @ coefficients
    spread = left.T @ left / max(1, len(left) - terms.shape[1])
    return coefficients[0], spread


def dealt_out(
    nearest: NDArray[np.intp], weights: Floats, rng: np.random.Generator
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return which draws stand for the posterior, (n,), and their modes, so that these count so.

    Draws of a mode that has too many give way to ones of those with too few.
    """
    wanted = np.rint(weights * nearest.size).astype(np.intp)
    rows = np.arange(nearest.size)
    having = [np.flatnonzero(nearest == m) for m in range(len(weights))]
    free = np.concatenate(
        [rng.permutation(own)[number:] for own, number in zip(having, wanted, strict=True)]
    )
    free = rng.permutation(free)
    modes = nearest.copy()
    for m, (own, number) in enumerate(zip(having, wanted, strict=True)):
        some, free = np.split(free, [max(0, number - own.size)])
        rows[some] = rng.choice(own, size=some.size)
        modes[some] = m
    return rows, modes


def of_several_modes(
    draws: Mapping[str, Floats], modes: NDArray[np.intp], counted: str
) -> list[str]:
    """Say so where draws, (n, *shape) by variable, are of several modes, which has shape (n,).

    Their mean lies between the modes, where the posterior has next to nothing. ``counted`` says by
    what modes count.
    """
    labels, numbers = np.unique(modes, return_counts=True)
    if len(labels) < 2:
        return []
    values = split_elements(draws)
    medians = {}
    gaps = {}
    for name in told_elements(draws):
        own = [values[name][modes == label] for label in labels]
        medians[name] = [np.median(some) for some in own]
        widest = max(some.std() for some in own)
        gaps[name] = np.ptp(medians[name]) / max(widest, 1e-300)
    by_gap = sorted(gaps, key=gaps.__getitem__, reverse=True)
    # No farther apart than they are wide, they do not tell modes apart; one does most.
    apart = [name for name in by_gap[:_SAID] if gaps[name] > 1] or by_gap[:1]
    each = []
    for m in np.argsort(-numbers, stable=True):
        place = ", ".join(f"{name} = {medians[name][m]:.3g}" for name in apart)
        each.append(f"{numbers[m] / modes.size:.0%} of the draws around {place}")
    return [
        f"the posterior has {len(labels)} modes{counted}: {'; '.join(each)}. Means and standard "
        "deviations over all draws describe none of them: look at each by itself, or state a prior "
        "that excludes what cannot be"
    ]
