"""Minimisers of a metric that is prepared for each data set anew, told from some of them.

Where several outputs are measured, a metric takes from the data in which coordinates it looks at
them. It would look at another data set in others, and its minimiser would be another one, with a
bias that refits by what was prepared for the data do not have. These are made by thousands; some
are made by what is prepared for each of them, and tell how both hang together.
"""

from __future__ import annotations

import numpy as np

from prbayes._checks import Floats

# By judgement, as all that follows: data sets that a metric is prepared for, at most. From so many
# pairs a difference that scatters by half a standard error has an error of .06.
PREPARED = 64
# Of them, below which nothing is told.
FEWEST_PAIRS = 16
# Error of the mean difference, in standard errors, at which there are enough of them.
_DIFFERENCE_KNOWN = 0.06
# Standard errors up to which a minimiser follows the other one on a line, and from which on a
# minimiser that ran away is no farther.
_ON_A_LINE = 3.0
_RAN_AWAY = 6.0
# Slope beyond near from which on those that ran away farther are farther still.
_FOLLOWS = 0.5
# Of slopes, as of a pair that is one standard error off: without any pair that ran away those that
# did stay where they are.
_RIDGE = 1.0


def as_prepared_anew(away: Floats, anew: Floats, luck: Floats) -> Floats:
    """Return minimisers as if the metric were prepared for each data set anew.

    Each is a line in that of the metric as it is prepared for the data, bent where this ran away,
    and a difference from the line that one of the pairs has.

    Parameters
    ----------
    away : ndarray, shape (n, r)
        Minimisers, from where the data sets were drawn, in standard errors.
    anew : ndarray, shape (n, r)
        The same of a metric prepared for each; NaN where there is none.
    luck : ndarray, shape (n,)
        Which pair's difference each of the others gets, in [0, 1).
    """
    known = np.isfinite(anew).all(axis=1)
    pairs = int(known.sum())
    if pairs < FEWEST_PAIRS:
        return away
    told = np.empty_like(away)
    left = np.empty((pairs, away.shape[1]))
    for i, (one, other) in enumerate(zip(away.T, anew.T, strict=True)):
        terms = _terms(one)
        seen = terms[known]
        wanted = np.clip(other[known], -_RAN_AWAY, _RAN_AWAY)
        normal = seen.T @ seen + _RIDGE * np.eye(3)
        straight = np.array([0.0, 1.0, 1.0])
        coefficients = straight + np.linalg.solve(normal, seen.T @ (wanted - seen @ straight))
        told[:, i] = terms @ coefficients
        left[:, i] = wanted - seen @ coefficients
        if coefficients[2] > _FOLLOWS:
            told[:, i] += one - np.clip(one, -_RAN_AWAY, _RAN_AWAY)
    told += left[(luck * pairs).astype(np.intp)]
    told[known] = anew[known]
    return told


def told_enough(differences: Floats) -> bool:
    """Return whether pairs, (n, r), of which some are NaN, tell their mean difference."""
    known = differences[np.isfinite(differences).all(axis=1)]
    if len(known) < FEWEST_PAIRS:
        return False
    scatter = np.clip(known, -_RAN_AWAY, _RAN_AWAY).std(axis=0).max(initial=0.0)
    return bool(scatter < _DIFFERENCE_KNOWN * np.sqrt(len(known)))


def of_few_pairs(anew: Floats) -> list[str]:
    """Say so where too few are known of minimisers, (n, r), as `as_prepared_anew` has them."""
    pairs = int(np.isfinite(anew).all(axis=1).sum())
    if pairs >= FEWEST_PAIRS:
        return []
    return [
        f"the metric could be prepared for {pairs} of the data sets drawn from the calibrated "
        f"population, expected at least {FEWEST_PAIRS}, as where few specimens have several "
        "outputs: estimates are those of a metric that looks at all data sets as at the measured "
        "one, and draws too wide"
    ]


def _terms(away: Floats) -> Floats:
    """Return one, how far minimisers are away, and how much farther than near, (n, 3)."""
    within = np.clip(away, -_RAN_AWAY, _RAN_AWAY)
    near = np.clip(away, -_ON_A_LINE, _ON_A_LINE)
    return np.column_stack([np.ones(len(away)), near, within - near])
