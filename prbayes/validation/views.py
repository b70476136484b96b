"""Directions in which several outputs are held against their prediction, one number at a time."""

from __future__ import annotations

import numpy as np

from prbayes._validate import Floats
from prbayes.metrics.multivariate import directions, failure_caps, sufficient_directions
from prbayes.metrics.views import Centered, Projection
from prbayes.metrics.whitening import whitening

# Specimens of the prediction that tell its coordinates: their correlations are then known to .02,
# and any directions give a test of the right size.
_SEEN_BY = 4096


def views(pool: Floats) -> list[Projection]:
    """Return the directions for predicted outputs of all draws, shape (D, S, m).

    They are well spread in coordinates in which the predicted outputs are white: what is measured
    has no part in the choice, so that replicates are seen in the same ones.
    """
    m = pool.shape[-1]
    rows = pool.reshape(-1, m)
    rows = rows[~np.isnan(rows).any(axis=1)]
    caps = failure_caps(rows)
    finite = rows[np.isfinite(rows).all(axis=1)]
    step = -(-len(finite) // _SEEN_BY)
    some = finite[::step]
    every = np.arange(m)
    equal = np.full(len(some), 1 / len(some))
    white = whitening(some, equal, every)
    centered = Centered(every, caps, white.center)
    number = max(1, sufficient_directions(m))
    return [Projection(centered, white.axes @ u) for u in directions(m, number, 0)]
