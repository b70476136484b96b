"""Values by condition, specimen, output and projection; u-values, and the area of their ECDF."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import xarray as xr

import prbayes as prb
from prbayes._validate import Floats
from prbayes.validation.conditions import (
    Predictive,
    area,
    between,
    comparables,
    projections,
    read_case,
)

DRAWS = np.arange(12.0).reshape(3, 4)


def test_one_condition_two_and_named_ones() -> None:
    one = read_case([1.0, 2.0], DRAWS)
    assert [c.name for c in one.conditions] == ["observed"]
    assert (one.size, one.n_specimens, one.n_draws) == (2, 2, 3)
    listed = read_case([[1.0, 2.0], [3.0]], [DRAWS, DRAWS])
    assert [c.name for c in listed.conditions] == ["0", "1"]
    assert (listed.size, listed.n_specimens, listed.shares_specimens) == (3, 3, False)
    # In the order of the predictions.
    named = read_case({"a": [1.0], "b": [2.0, 3.0]}, {"b": DRAWS, "a": DRAWS})
    assert [c.name for c in named.conditions] == ["b", "a"]
    assert named.conditions[0].observed.tolist() == [2.0, 3.0]


def test_specimens_are_counted_over_all_conditions() -> None:
    labels = {"a": [7, 8], "b": [8.0, 9.0]}
    case = read_case({"a": [1.0, 2.0], "b": [3.0, 4.0]}, {"a": DRAWS, "b": DRAWS}, labels)
    assert [c.numbers.tolist() for c in case.conditions] == [[0, 1], [1, 2]]
    assert (case.n_specimens, case.shares_specimens, case.is_dependent) == (3, True, True)
    assert case.conditions[1].specimens == ("8", "9")
    twice = read_case([1.0, 2.0], DRAWS, ["x", "x"])
    assert (twice.n_specimens, twice.shares_specimens, twice.is_dependent) == (1, False, True)
    assert read_case([1.0], DRAWS).conditions[0].specimens == ("observed, 0",)


def test_predictions_have_their_name_dims_and_notes() -> None:
    array = xr.DataArray(
        DRAWS.reshape(3, 1, 4),
        dims=("draw", "chain", "sample"),
        name="crack",
        attrs={"specimens_id": "x"},
    )
    condition = read_case([1.0], array).conditions[0]
    assert condition.name == "crack"
    assert condition.attributes["specimens_id"] == "x"
    np.testing.assert_array_equal(condition.predicted, DRAWS)
    # One population needs no axis of draws, several may have two.
    assert read_case([1.0], DRAWS[0]).n_draws == 1
    assert read_case([1.0], DRAWS.reshape(1, 3, 4)).n_draws == 3


def test_folded_values_are_the_distance_from_the_middle() -> None:
    u = np.array([0.0, 0.25, 0.5, 1.0])
    np.testing.assert_array_equal(read_case([1.0], DRAWS, folded=True).tested(u), [1, 0.5, 0, 1])
    np.testing.assert_array_equal(read_case([1.0], DRAWS).tested(u), u)


@pytest.mark.parametrize(
    ("observed", "predicted", "specimens", "match"),
    [
        ({"a": [1.0]}, {"a": DRAWS}, {"b": [1]}, r"specimens: got \['b'\], expected a mapping"),
        ({"a": [1.0]}, {"a": DRAWS}, [[1]], "specimens: got list, expected a mapping"),
        ([[1.0]], [DRAWS], [[1], [2]], "specimens: got 2 conditions, expected a list with the"),
        ([], [], None, "observed: got 0 conditions"),
        ([1.0, 2.0], DRAWS, [[1, 2]], r"specimens: got shape \(1, 2\), expected \(2,\)"),
        ([1.0, -np.inf], DRAWS, None, "got 1 NaN or -inf among 2 values"),
        ([1.0], np.array([-np.inf, 1.0]), None, "predicted: got -inf"),
        ([[1.0], [1.0]], [DRAWS, DRAWS[:2]], None, r"got \[3, 2\] draws for the conditions"),
    ],
)
def test_refusals(observed: Any, predicted: Any, specimens: Any, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        read_case(observed, predicted, specimens)


def seen(pool):
    """Return what is seen of all specimens in each direction."""
    return np.array([view.of(pool).ravel() for view in projections(pool)])


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
    for view in projections(pool):
        numbers = view.of(pool)
        assert np.isfinite(numbers[0, 0])
        assert np.isnan(numbers[0, 1])
        assert np.isfinite(numbers[1:]).all()


def test_outputs_and_what_was_not_measured() -> None:
    predicted = xr.DataArray(
        np.arange(24.0).reshape(1, 2, 4, 3), dims=("chain", "draw", "sample", "place")
    )
    measured = np.array([[1.0, np.nan, 3.0], [4.0, 5.0, np.inf]])
    found = comparables({"a/b": measured}, {"a/b": predicted}, "test")
    assert [one.name for one in found] == ["a∕b[0]", "a∕b[1]", "a∕b[2]"]  # noqa: RUF001
    assert [one.measured.tolist() for one in found] == [[1.0, 4.0], [5.0], [3.0, np.inf]]
    np.testing.assert_array_equal(found[1].predicted, predicted.values[0, :, :, 1])


def test_weights_leave_out_what_is_not_known() -> None:
    values = np.array([[1.0, np.nan, 2.0, np.inf], [1.0, 2.0, 3.0, 4.0]])
    predicted = xr.DataArray(values[None], dims=("chain", "draw", "sample"), name="y")
    (one,) = comparables([1.0], predicted, "test")
    np.testing.assert_allclose(one.weights, [[1 / 3, 0, 1 / 3, 1 / 3], [0.25] * 4])


def test_of_many_outputs_some_are_shown() -> None:
    predicted = xr.DataArray(
        np.zeros((1, 1, 4, 30)), dims=("chain", "draw", "sample", "t"), name="curve"
    )
    found = comparables(np.zeros((2, 30)), predicted, "test")
    assert [one.name for one in found][:2] == ["curve[0]", "curve[4]"]
    assert len(found) == 8
    assert found[-1].name == "curve[29]"


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
