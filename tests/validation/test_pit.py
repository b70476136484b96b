"""Values by condition, specimen, output and projection; u-values, and the area of their ECDF."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import prbayes as prb
from prbayes.validation.pit import (
    Predictive,
    area,
    between,
    comparables,
    projections,
    read_case,
)

Posterior = Callable[..., Any]
DRAWS = np.arange(12.0).reshape(3, 4)
DIMS = ("chain", "draw", "sample")
EXACT = prb.validation.ExactModel()
u_values = prb.validation.u_values


def test_one_condition_two_and_named_ones() -> None:
    case = read_case([1.0, 2.0], DRAWS)
    assert [c.name for c in case.conditions] == ["observed"]
    assert (case.size, case.n_specimens, case.n_draws) == (2, 2, 3)
    case = read_case([[1.0, 2.0], [3.0]], [DRAWS, DRAWS])
    assert [c.name for c in case.conditions] == ["0", "1"]
    assert (case.size, case.n_specimens, case.shares_specimens) == (3, 3, False)
    # In the order of the predictions.
    case = read_case({"a": [1.0], "b": [2.0, 3.0]}, {"b": DRAWS, "a": DRAWS})
    assert [(c.name, c.observed.size) for c in case.conditions] == [("b", 2), ("a", 1)]
    # One population needs no axis of draws, several may have two.
    assert read_case([1.0], DRAWS[0]).n_draws == 1
    array = xr.DataArray(
        DRAWS.reshape(3, 1, 4), dims=("draw", "chain", "sample"), name="crack", attrs={"a": "x"}
    )
    (condition,) = read_case([1.0], array).conditions
    assert (condition.name, condition.attributes) == ("crack", {"a": "x"})
    np.testing.assert_array_equal(condition.predicted, DRAWS)


def test_specimens_are_counted_over_all_conditions() -> None:
    labels = {"a": [7, 8], "b": [8.0, 9.0]}
    case = read_case({"a": [1.0, 2.0], "b": [3.0, 4.0]}, {"a": DRAWS, "b": DRAWS}, labels)
    assert [c.numbers.tolist() for c in case.conditions] == [[0, 1], [1, 2]]
    assert (case.n_specimens, case.shares_specimens, case.is_dependent) == (3, True, True)
    assert case.conditions[1].specimens == ("8", "9")
    case = read_case([1.0, 2.0], DRAWS, ["x", "x"])
    assert (case.n_specimens, case.shares_specimens, case.is_dependent) == (1, False, True)
    assert read_case([1.0], DRAWS).conditions[0].specimens == ("observed, 0",)


@pytest.mark.parametrize(
    ("observed", "predicted", "specimens", "match"),
    [
        ({"a": [1.0]}, {"a": DRAWS}, {"b": [1]}, r"specimens: got \['b'\], expected a mapping"),
        ({"a": [1.0]}, {"a": DRAWS}, [[1]], "specimens: got list, expected a mapping"),
        ([[1.0]], [DRAWS], [[1], [2]], "specimens: got 2 conditions, expected a list with the"),
        ([], [], None, "observed: got 0 conditions"),
        ([[[1.0]]], DRAWS, None, r"observed: got shape \(1, 1, 1\), expected \(n,\)"),
        ([], DRAWS, None, "observed: got shape"),
        ([1.0], np.full(20, np.nan), None, "nothing but NaN"),
        ([1.0], np.array(1.0), None, r"predicted: got shape \(\)"),
        ([1.0], xr.DataArray(DRAWS[0], dims="x"), None, r"got a DataArray with dims \('x',\)"),
        ({"a": [1.0]}, {"b": DRAWS}, None, r"got \['a'\], expected a mapping .* \['b'\]"),
        ({"a": [1.0]}, DRAWS, None, "predicted: got ndarray, expected a mapping"),
        ([1.0], {"a": DRAWS}, None, "observed: got list, expected a mapping"),
        ([[1.0]], [DRAWS, DRAWS], None, "observed: got 1 conditions, expected a list"),
        ([1.0, 2.0], DRAWS, [[1, 2]], r"specimens: got shape \(1, 2\), expected \(2,\)"),
        ([1.0, -np.inf], DRAWS, None, "got 1 NaN or -inf among 2 values"),
        ([1.0], np.array([-np.inf, 1.0]), None, "predicted: got -inf"),
        (
            [[1.0], [1.0]],
            [DRAWS, DRAWS[:2]],
            None,
            r"got \[3, 2\] draws for .*pass .* n_draws= to prb\.predict",
        ),
    ],
)
def test_refusals(observed: Any, predicted: Any, specimens: Any, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        read_case(observed, predicted, specimens)


@pytest.mark.parametrize("m", [2, 4])
def test_outputs_are_white_in_every_direction(m: int) -> None:
    root = np.linalg.cholesky(np.full((m, m), 0.9) + 0.1 * np.eye(m))
    pool = 1e3 * np.random.default_rng(1).standard_normal((20, 400, m)) @ root.T
    spreads = np.array([projection.of(pool).std() for projection in projections(pool)])
    assert np.ptp(spreads) < 0.1 * spreads.mean()
    # Failed specimens are at the end, and those without a response nowhere.
    pool[0, 0, 0] = np.inf
    pool[0, 1, 1] = np.nan
    for projection in projections(pool):
        numbers = projection.of(pool)
        assert np.isfinite(numbers[0, 0])
        assert np.isnan(numbers[0, 1])
        assert np.isfinite(numbers[1:]).all()


def test_many_outputs_of_few_inputs_need_the_error_of_the_readings() -> None:
    x = np.random.default_rng(1).standard_normal((50, 1))
    predicted = x * [1.0, 2.0, 3.0]
    with pytest.raises(ValueError, match=r"^predicted: got outputs 0, 1, 2 .* error, add it"):
        prb.area_test(predicted[:5], predicted)


def test_pairs_of_measured_and_predicted_outputs() -> None:
    values = np.arange(24.0).reshape(1, 2, 4, 3)
    measured = np.array([[1.0, np.nan, 3.0], [4.0, 5.0, np.inf]])
    predicted = xr.DataArray(values, dims=(*DIMS, "place"))
    pairs = comparables({"a/b": measured}, {"a/b": predicted}, "test")
    assert [pair.name for pair in pairs] == ["a/b[0]", "a/b[1]", "a/b[2]"]
    assert [pair.measured.tolist() for pair in pairs] == [[1.0, 4.0], [5.0], [3.0, np.inf]]
    np.testing.assert_array_equal(pairs[1].predicted, values[0, :, :, 1])
    # Of many outputs there are eight.
    curves = xr.DataArray(np.zeros((1, 1, 4, 30)), dims=(*DIMS, "t"), name="curve")
    pairs = comparables(np.zeros((2, 30)), curves, "test")
    assert [pairs[i].name for i in (0, 1, 7)] == ["curve[0]", "curve[4]", "curve[29]"]
    assert len(pairs) == 8
    # NaN has no weight.
    values = np.array([[1.0, np.nan, 2.0, np.inf], [1.0, 2.0, 3.0, 4.0]])
    (pair,) = comparables([1.0], xr.DataArray(values[None], dims=DIMS, name="y"), "test")
    np.testing.assert_allclose(pair.weights, [[1 / 3, 0, 1 / 3, 1 / 3], [0.25] * 4])


def test_measured_outputs_are_in_the_order_of_the_predicted_ones() -> None:
    values = np.random.default_rng(0).normal(size=(1, 3, 40, 2))
    predicted = xr.DataArray(values, dims=(*DIMS, "place"), coords={"place": ["a", "b"]})
    y = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 7.0]])
    swapped = xr.DataArray(
        y[:, ::-1], dims=("specimen", "place"), coords={"place": ["b", "a"]}, name="y"
    )
    for observed in (y, swapped):
        np.testing.assert_array_equal(read_case(observed, predicted).conditions[0].measured, y)
    with pytest.raises(ValueError, match=r"got the outputs \['b', 'c'\], expected \['a', 'b'\]"):
        read_case(swapped.assign_coords(place=["b", "c"]), predicted)
    extra = pd.DataFrame({"specimen": [1, 2, 3], "a": y[:, 0], "b": y[:, 1]})
    with pytest.raises(
        ValueError, match=r"outputs \['specimen', 'a', 'b'\], expected \['a', 'b'\]"
    ):
        read_case(extra, predicted)


def test_the_area_is_the_integral_in_any_order() -> None:
    assert area(np.array([0.2])) == pytest.approx((0.2**2 + 0.8**2) / 2)
    for n in (1, 4, 9):
        assert area((np.arange(n) + 0.5) / n) == pytest.approx(1 / (4 * n))
        assert area(np.zeros(n)) == area(np.ones(n)) == 0.5
    rng = np.random.default_rng(1)
    u = rng.random((3, 7))
    v = (np.arange(200_000) + 0.5) / 200_000
    integral = [np.abs(np.searchsorted(np.sort(row), v, side="right") / 7 - v).mean() for row in u]
    np.testing.assert_allclose(area(u), integral, atol=1e-5)
    np.testing.assert_allclose(area(rng.permuted(u, axis=1)), area(u))
    np.testing.assert_allclose(area(1 - u), area(u))


def test_steps_of_a_predictive_distribution() -> None:
    left, right = Predictive(np.array([1.0, 2.0, 2.0, 4.0])).steps(np.array([0.0, 2.0, 3.0, 4.0]))
    np.testing.assert_array_equal(left, [0, 0.25, 0.75, 0.75])
    np.testing.assert_array_equal(right, [0, 0.75, 0.75, 1])
    y = np.array([0.0, 1.0, 2.0, 3.0])
    twice = Predictive(np.array([1.0, 2.0, 2.0])).transform(y, None)
    weighted = Predictive(np.array([2.0, 1.0]), np.array([4.0, 2.0]))
    np.testing.assert_allclose(weighted.transform(y, None), twice)
    # NaN is left out of the pool, and stays NaN among measured values.
    u = Predictive(np.array([[1.0, np.nan], [3.0, np.inf]])).transform(
        np.array([np.nan, 2.0, np.inf]), None
    )
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


@pytest.mark.parametrize(
    ("observed", "predicted", "expected"),
    [
        ([0, 1, 1.5, 2, 3, 4], [[1.0, 2.0], [2.0, 3.0]], [0, 0.125, 0.25, 0.5, 0.875, 1]),
        ([0.5, 10.5], [[0.0, 1.0], [10.0, 11.0]], [0.25, 0.75]),  # a pool of all populations
        # Failed specimens are the largest, and NaN is left out.
        ([0.5, 1.5, 9.0, np.inf], [1.0, np.nan, 2.0, np.inf, np.inf], [0, 0.25, 0.5, 0.75]),
    ],
)
def test_u_values_are_the_middle_of_the_steps(observed: Any, predicted: Any, expected: Any) -> None:
    u = u_values(observed, np.array(predicted))
    np.testing.assert_allclose(u, expected)
    # Folded values are the distance from the middle.
    folded = read_case(observed, np.array(predicted), folded=True)
    np.testing.assert_allclose(folded.tested(u), np.abs(2 * u - 1))


def test_u_values_of_transformations_and_conditions(posterior: Posterior) -> None:
    y, predicted = np.array([-1.0, 0.3, 2.2]), posterior()
    u = u_values(y, predicted)
    for change in (lambda y: 3 * y - 2, np.exp):
        np.testing.assert_array_equal(u_values(change(y), change(predicted)), u)
    np.testing.assert_allclose(u_values(-y, -predicted), 1 - u)
    # Those of conditions follow one another, in the order of the predictions.
    listed = u_values([y[:2], 2 * y[2:]], [predicted, 2 * predicted])
    np.testing.assert_array_equal(listed, u)
    by_name = {"late": 2 * predicted, "early": predicted}
    named = u_values({"early": y[:2], "late": 2 * y[2:]}, by_name)
    np.testing.assert_array_equal(named, u[[2, 0, 1]])


def test_randomised_u_values_of_ties_are_uniform() -> None:
    rng = np.random.default_rng(3)
    counts, predicted = rng.poisson(2, 4000), np.random.default_rng(4).poisson(2, 200_000)
    u = u_values(counts, predicted, randomize=True)
    np.testing.assert_array_equal(u, u_values(counts, predicted, randomize=True))
    assert EXACT.p_value(float(area(u)), u.size) > 0.01
    middle = u_values(counts, predicted)
    assert np.unique(middle).size == np.unique(counts).size
    assert EXACT.p_value(float(area(middle)), u.size) < 1e-6
    # Rounded measurements have ties with predictions that are rounded alike.
    normal = xr.DataArray(rng.normal(0, 1, (1, 1, 50_000)), dims=DIMS)
    u = u_values(rng.normal(0, 1, 2000).round(0), normal.round(0), randomize=True)
    assert EXACT.p_value(float(area(u)), 2000) > 0.01
