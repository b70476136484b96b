"""Draws where hyperparameters have hyperparameters of their own: the prior as it is, not as normal.

Groups tell how far they are apart, and that tells how much they tell each other: a prior that
learns is no normal distribution, and taken as one it leaves each group to itself.
"""

from __future__ import annotations

import numpy as np

from prbayes._checks import Floats
from prbayes.estimate.refit import SamplingDistribution
from prbayes.posterior.walk import REMEMBERED, walked

# Steps at most, and at least: where the spread of groups is near zero a walk is slow, and who has
# forgotten the beginning need not have arrived. From draws of the prior 20 steps leave a spread of
# six groups too large by a third of a standard deviation, 100 to 1000 by less than a twentieth.
_LONG_WALK = 1000
_ARRIVED_AFTER = 200


def pooled(
    sampling: SamplingDistribution,
    center: Floats,
    information: Floats,
    draws: Floats,
    seed: int,
) -> tuple[Floats, tuple[str, ...]]:
    """Return draws of the prior times a normal density of the estimate, (n, d), and doubts.

    Parameters
    ----------
    sampling : SamplingDistribution
        Of the estimate, whose coordinates are meant.
    center : ndarray, shape (r,)
        The estimate, without its bias.
    information : ndarray, shape (r, r)
        Inverse of its covariance.
    draws : ndarray, shape (n, d)
        Where to begin.
    seed : int
    """
    evaluator = sampling.evaluator

    def log_density(thetas: Floats) -> Floats:
        x, _ = sampling.coordinates(thetas)
        away = x - center
        squared = np.einsum("ni,ij,nj->n", away, information, away)
        prior = evaluator.hyperparameters.log_prior(thetas) + evaluator.log_other(thetas)
        total = prior - 0.5 * squared
        return np.where(np.isnan(total), -np.inf, total)

    rng = np.random.default_rng([seed, 11])
    found, memory = walked(log_density, draws, rng, _LONG_WALK, _ARRIVED_AFTER)
    if memory <= REMEMBERED:
        return found, ()
    return found, (
        f"after {_LONG_WALK} steps the draws still have a correlation of {memory:.2f} with where "
        f"they began, expected at most {REMEMBERED}, so that they are not yet those of prior and "
        "estimate together; compare with another random_seed",
    )
