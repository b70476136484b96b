"""The simultaneous envelope of sorted u-values."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.special import ndtri

import prbayes as prb
from prbayes._stats import envelope

Posterior = Callable[..., Any]
QUICK = prb.validation.PosteriorNull(999)
GRID = ndtri((np.arange(1000) + 0.5) / 1000)  # a standard normal population


def test_the_envelope_holds_right_models_and_no_wrong_ones(posterior: Posterior) -> None:
    rng = np.random.default_rng(14)
    lower, upper = envelope(rng.random((999, 20)), 0.1)
    u = np.sort(rng.random((4000, 20)), axis=1)
    inside = ((u >= lower) & (u <= upper)).all(axis=1).mean()
    # Standard errors: .009 of the envelope, .005 of the share.
    assert abs(inside - 0.9) < 0.045
    np.testing.assert_allclose(lower + upper[::-1], 1, atol=0.04)
    y = rng.normal(size=20)
    for population in (GRID, posterior(200)):
        for shift, expected in ((0.0, True), (1.5, False)):
            test = prb.area_test(y + shift, population, null=QUICK)
            low, high = test.envelope
            ranked = np.sort(test.u_values)
            assert ((ranked >= low) & (ranked <= high)).all() == expected
    wider, narrow = (
        np.ptp(prb.area_test(y, p, null=QUICK).envelope, axis=0).mean()
        for p in (posterior(15), GRID)
    )
    assert wider > 1.2 * narrow


def test_of_one_value_it_is_an_interval_between_two_replicates() -> None:
    replicates = (np.arange(99) + 1.0)[:, None] / 100
    lower, upper = envelope(replicates, 0.1)
    assert (lower, upper) == (0.05, 0.95)


def test_as_many_replicates_are_inside_as_asked_for() -> None:
    replicates = np.random.default_rng(1).random((999, 12))
    for level in (0.5, 0.1, 0.02):
        lower, upper = envelope(replicates, level)
        rows = np.sort(replicates, axis=1)
        inside = ((rows >= lower) & (rows <= upper)).all(axis=1).mean()
        # Depths are integers: many replicates share one.
        assert 1 - level <= inside < 1 - level + 0.05
