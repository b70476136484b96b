"""Directions in which predicted outputs are seen."""

import numpy as np

from prbayes.validation.views import views


def seen(pool):
    """Return what is seen of all specimens in each direction."""
    return np.array([view.of(pool).ravel() for view in views(pool)])


def correlated(rng, m):
    """Return predicted outputs with correlation .9, in units of a thousand."""
    root = np.linalg.cholesky(np.full((m, m), 0.9) + 0.1 * np.eye(m))
    return 1e3 * rng.standard_normal((20, 400, m)) @ root.T


def test_outputs_are_white_in_every_direction():
    for m in (2, 4):
        spreads = seen(correlated(np.random.default_rng(1), m)).std(axis=1)
        assert np.ptp(spreads) < 0.1 * spreads.mean()


def test_specimens_that_failed_are_seen_at_the_end_and_those_without_response_nowhere():
    pool = correlated(np.random.default_rng(2), 2)
    pool[0, 0, 0] = np.inf
    pool[0, 1, 1] = np.nan
    for view in views(pool):
        numbers = view.of(pool)
        assert np.isfinite(numbers[0, 0])
        assert np.isnan(numbers[0, 1])
        assert np.isfinite(numbers[1:]).all()
