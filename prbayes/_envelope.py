"""The simultaneous envelope of sorted values, from replicates of any kind."""

from __future__ import annotations

import numpy as np

from prbayes._validate import Floats

# Replicates from which an envelope is made. The share of right models within it then has a standard
# error of sqrt(.05 * .95 / 999) = .007. More of them cost memory, n numbers each, and no null needs
# them for its p-value.
ENVELOPED = 999


def envelope(replicates: Floats, alpha: float) -> tuple[Floats, Floats]:
    """Return bounds of sorted values within which a share 1 - alpha of replicates lies entirely.

    The bounds of all n leave out the same number of replicates on either side, the largest that
    will do. This is the simulation of Säilynoja, Bürkner and Vehtari [1]_, with ranks among
    replicates in place of binomial tails: `arviz_stats.ecdf_utils` has it for values that are
    independent and uniform, which those of a posterior's populations, or of one specimen under
    several conditions, are not.

    Parameters
    ----------
    replicates : ndarray, shape (r, n)
    alpha : float

    Returns
    -------
    lower, upper : ndarray, shape (n,)

    References
    ----------
    .. [1] Säilynoja, T., P.-C. Bürkner and A. Vehtari (2022), Graphical test for discrete
       uniformity and its applications in goodness-of-fit evaluation and multiple sample comparison,
       Stat. Comput. 32, 32, doi:10.1007/s11222-022-10090-6.
    """
    rows = np.sort(replicates, axis=1)
    columns = np.sort(rows, axis=0)
    size = len(rows)
    # How many replicates are as far out as each one, on the nearer side, where it is farthest out.
    depth = np.full(size, size)
    for column, values in zip(columns.T, rows.T, strict=True):
        as_low = np.searchsorted(column, values, side="right")
        lower = np.searchsorted(column, values, side="left")
        as_high = size - lower
        nearer = np.minimum(as_low, as_high)
        depth = np.minimum(depth, nearer)
    # The share to be left out is that of the farthest ones.
    depth.sort()
    outermost = int(alpha * size)
    k = max(1, int(depth[outermost]))
    return columns[k - 1], columns[size - k]
