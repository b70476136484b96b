"""The probability integral transform: the pooled distribution, u-values, the area of their ECDF."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import xarray as xr

import prbayes as prb
from prbayes._validate import Floats
from prbayes.validation.probability_transform import Predictive, area, between


def test_area_of_known_samples() -> None:
    assert area(np.array([0.5])) == 0.25
    assert area(np.array([0.2])) == pytest.approx((0.2**2 + 0.8**2) / 2)
    for n in (1, 4, 9):
        assert area((np.arange(n) + 0.5) / n) == pytest.approx(1 / (4 * n))
        assert area(np.zeros(n)) == area(np.ones(n)) == 0.5


def test_area_is_the_integral() -> None:
    u = np.random.default_rng(1).random((3, 7))
    v = (np.arange(200_000) + 0.5) / 200_000
    integral = [np.abs(np.searchsorted(np.sort(row), v, side="right") / 7 - v).mean() for row in u]
    np.testing.assert_allclose(area(u), integral, atol=1e-5)


def test_area_does_not_care_for_order_or_reflection() -> None:
    rng = np.random.default_rng(2)
    u = rng.random((5, 11))
    np.testing.assert_allclose(area(rng.permuted(u, axis=1)), area(u))
    np.testing.assert_allclose(area(1 - u), area(u))


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


Posterior = Callable[..., Any]
EXACT = prb.validation.ExactModel()


def as_array(values: Any, **attrs: Any) -> xr.DataArray:
    return xr.DataArray(
        np.asarray(values)[None], dims=("chain", "draw", "sample"), name="crack", attrs=attrs
    )


def test_u_values_are_the_middle_of_the_steps() -> None:
    predicted = np.array([[1.0, 2.0], [2.0, 3.0]])
    np.testing.assert_allclose(
        prb.validation.u_values([0, 1, 1.5, 2, 3, 4], predicted), [0, 0.125, 0.25, 0.5, 0.875, 1]
    )


@pytest.mark.parametrize("change", [lambda y: 3 * y - 2, np.exp])
def test_u_values_do_not_care_for_increasing_transformations(
    change: Callable[[Floats], Floats], posterior: Posterior
) -> None:
    y = np.array([-1.0, 0.3, 2.2])
    np.testing.assert_array_equal(
        prb.validation.u_values(change(y), change(posterior())),
        prb.validation.u_values(y, posterior()),
    )


def test_u_values_of_a_decreasing_transformation_are_reflected(posterior: Posterior) -> None:
    y = np.array([-1.0, 0.3, 2.2])
    np.testing.assert_allclose(
        prb.validation.u_values(-y, -posterior()), 1 - prb.validation.u_values(y, posterior())
    )


def test_randomised_u_values_of_ties_are_uniform() -> None:
    rng = np.random.default_rng(3)
    counts, predicted = rng.poisson(2, 4000), np.random.default_rng(4).poisson(2, 200_000)
    u = prb.validation.u_values(counts, predicted, randomize=True)
    np.testing.assert_array_equal(u, prb.validation.u_values(counts, predicted, randomize=True))
    assert EXACT.p_value(float(area(u)), u.size) > 0.01
    middle = prb.validation.u_values(counts, predicted)
    assert np.unique(middle).size == np.unique(counts).size
    assert EXACT.p_value(float(area(middle)), u.size) < 1e-6


def test_failed_specimens_are_the_largest_and_nan_is_left_out() -> None:
    predicted = np.array([1.0, np.nan, 2.0, np.inf, np.inf])
    np.testing.assert_allclose(
        prb.validation.u_values([0.5, 1.5, 9.0, np.inf], predicted), [0, 0.25, 0.5, 0.75]
    )


def test_rounded_measurements_have_ties_with_predictions_rounded_alike() -> None:
    rng = np.random.default_rng(5)
    predicted = as_array(rng.normal(0, 1, (1, 50_000)), nan=0)
    u = prb.validation.u_values(rng.normal(0, 1, 2000).round(0), predicted.round(0), randomize=True)
    assert EXACT.p_value(float(area(u)), 2000) > 0.01


def test_u_values_of_conditions_follow_one_another(posterior: Posterior) -> None:
    a, b = np.array([0.1, 0.2]), np.array([0.3])
    one = np.concatenate(
        [prb.validation.u_values(a, posterior()), prb.validation.u_values(b, 2 * posterior())]
    )
    both = {"late": 2 * posterior(), "early": posterior()}
    np.testing.assert_array_equal(
        prb.validation.u_values([a, b], [posterior(), 2 * posterior()]), one
    )
    np.testing.assert_array_equal(
        prb.validation.u_values({"early": a, "late": b}, both), one[[2, 0, 1]]
    )


def test_a_response_below_all_predicted_ones_has_the_smallest_u() -> None:
    u = prb.validation.u_values([-9.0, 0.5, 9.0], np.arange(4.0))
    np.testing.assert_array_equal(u, [0.0, 0.25, 1.0])


def test_all_populations_are_pooled() -> None:
    populations = np.array([[0.0, 1.0], [10.0, 11.0]])
    np.testing.assert_array_equal(prb.validation.u_values([0.5, 10.5], populations), [0.25, 0.75])
