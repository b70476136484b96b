"""u-values: the probability transform of measured responses."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import xarray as xr

import prbayes as prb
from prbayes._validate import Floats
from prbayes.validation.statistic import area

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
