"""Whether a prior allows what the data tell: estimates that it leads to, and that of the data.

A hyperparameter drawn from the prior, with the estimate's own sampling error, is an estimate that
the prior leads to. Where that of the data is among them is a tail probability that is uniform if
the truth was drawn from the prior (Evans and Moshonov 2006, doi:10.1214/06-BA129). No response is
computed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats
from prbayes._pages import more_in
from prbayes.estimate.goodness import UNLIKELY
from prbayes.estimate.refit import SamplingDistribution
from prbayes.model.hyperparameters import THETAS

# Estimates that the prior leads to: 4096, by which one in a hundred is known to a sixth.
_ESTIMATES = 16 * THETAS


def prior_probabilities(
    sampling: SamplingDistribution, center: Floats, shifts: Floats, seed: int
) -> dict[str, float]:
    """Return how probable estimates as far out as that of the data are, given the prior.

    Two-sided, by name of each hyperparameter that the data identify; and, under the empty name, of
    all of them together, from their Mahalanobis distance.

    Parameters
    ----------
    sampling : SamplingDistribution
    center : ndarray, shape (r,)
        The minimiser of the observed data, in coordinates.
    shifts : ndarray, shape (n, r)
        Of refits, from that centre.
    seed : int
    """
    evaluator = sampling.evaluator
    known = np.isfinite(np.diag(sampling.local.in_theta))
    bias = np.median(shifts, axis=0)
    estimate = sampling.thetas(center - bias)[known]
    refitted = sampling.thetas(shifts - bias)
    errors = (refitted - sampling.theta)[:, known]
    prior = evaluator.prior_thetas(_ESTIMATES, seed)[:, known]
    finite = np.isfinite(prior).all(axis=1)
    prior = prior[finite]
    if not (known.any() and len(prior)):
        return {}
    rng = np.random.default_rng([seed, 5])
    chosen = rng.integers(len(errors), size=len(prior))
    expected = prior + errors[chosen]
    below = _share(expected <= estimate)
    above = _share(expected >= estimate)
    tail = np.minimum(below, above)
    two_sided = np.minimum(1.0, 2 * tail)
    names = [name for name, one in zip(evaluator.readable_names, known, strict=True) if one]
    found = dict(zip(names, two_sided.tolist(), strict=True))
    if len(names) > 1:
        distances = _distances(np.vstack([expected, estimate]))
        farther = distances[:-1] >= distances[-1]
        found[""] = float(_share(farther))
    return found


def _share(true: NDArray[np.bool_]) -> Floats:
    """Return the share that is true, and not less than one more draw could make it."""
    return np.asarray((1 + np.sum(true, axis=0)) / (1 + len(true)))


def _distances(points: Floats) -> Floats:
    """Return Mahalanobis distances of points (n, d) from their middle, by robust spreads."""
    middle = np.median(points, axis=0)
    upper, lower = np.quantile(points, [0.84, 0.16], axis=0)
    spread = np.maximum((upper - lower) / 2, 1e-300)
    away = (points - middle) / spread
    # Ranks stand for places far out, of which a few decide a covariance.
    within = np.clip(away, -3.0, 3.0)
    covariance = np.atleast_2d(np.cov(within, rowvar=False))
    # A little is added, so that there is an inverse.
    ridge = 1e-9 * np.eye(len(covariance))
    turned = np.linalg.solve(covariance + ridge, away.T)
    return np.asarray(np.einsum("nd,dn->n", away, turned))


def least_probability(probabilities: dict[str, float]) -> float:
    """Return the least of several probabilities, as large as chance alone lets it be; NaN of none.

    Bonferroni's bound: times their number, and one at most.
    """
    if not probabilities:
        return np.nan
    return min(1.0, len(probabilities) * min(probabilities.values()))


def of_conflict(probabilities: dict[str, float]) -> list[str]:
    """Say so where the prior hardly allows what the data tell."""
    probability = least_probability(probabilities)
    if not probability < UNLIKELY:
        return []
    limit = UNLIKELY / len(probabilities)
    alone = [name for name, p in probabilities.items() if name and p < limit]
    what = ", ".join(alone) or "the hyperparameters together"
    return [
        f"prior and data contradict each other ({what}): estimates as far out as that of the data "
        f"are {probability:.1%} of those that the prior leads to, expected at least "
        f"{UNLIKELY:.0%}; look at the prior, and at prb.minimize without it"
        f"{more_in('optimum_or_abc.md#few-specimens-and-a-prior-that-knows-something')}"
    ]
