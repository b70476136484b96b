"""The pooled predictive distribution."""

import numpy as np
import pytest

from prbayes.validation.predictive import Predictive, between


def test_weights_of_a_predictive_distribution() -> None:
    y = np.array([0.0, 1.0, 2.0, 3.0])
    twice = Predictive(np.array([1.0, 2.0, 2.0])).transform(y, None)
    np.testing.assert_allclose(
        Predictive(np.array([2.0, 1.0]), np.array([4.0, 2.0])).transform(y, None), twice
    )


def test_steps_are_the_two_sides_of_the_distribution_function() -> None:
    left, right = Predictive(np.array([1.0, 2.0, 2.0, 4.0])).steps(np.array([0.0, 2.0, 3.0, 4.0]))
    np.testing.assert_array_equal(left, [0, 0.25, 0.75, 0.75])
    np.testing.assert_array_equal(right, [0, 0.75, 0.75, 1])


def test_nan_is_left_out_of_the_pool_and_stays_nan_in_what_is_asked() -> None:
    pool = Predictive(np.array([[1.0, np.nan], [3.0, np.inf]]))
    u = pool.transform(np.array([np.nan, 2.0, np.inf]), None)
    np.testing.assert_allclose(u, [np.nan, 1 / 3, 5 / 6])
    weighted = Predictive(np.array([np.nan, 1.0, 3.0]), np.array([9.0, 1.0, 3.0]))
    assert weighted.transform(np.array([2.0]), None) == pytest.approx(0.25)


def test_between_is_the_middle_or_uniform() -> None:
    left, right = np.full(10_000, 0.2), np.full(10_000, 0.6)
    np.testing.assert_allclose(between(left, right, None), 0.4)
    u = between(left, right, np.random.default_rng(0))
    # Standard error of the mean .4 / sqrt(12) / 100 = .0012.
    assert u.mean() == pytest.approx(0.4, abs=0.006)
    assert (u.min(), u.max()) == pytest.approx((0.2, 0.6), abs=1e-3)
