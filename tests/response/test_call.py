"""Calls of the response at points: what is called, what is no response, and failures by bisection."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import prbayes as prb
from prbayes.response.call import Points, checked, compute


def line(n: int) -> Points:
    """The numbers 0 to n - 1, and a constant."""
    return Points([np.arange(float(n)), 2.0], [True, False])


def test_points_give_keys_of_all_numbers_in_the_order_of_the_arguments() -> None:
    x, z = np.arange(3.0), np.arange(6.0).reshape(3, 2)
    points = Points([z, 7.0, x, np.array([8.0, 9.0])], [True, False, True, False])
    assert len(points) == 3
    expected = [[0, 1, 7, 0, 8, 9], [2, 3, 7, 1, 8, 9], [4, 5, 7, 2, 8, 9]]
    np.testing.assert_array_equal(points.keys(), expected)
    np.testing.assert_array_equal(points.at(np.array([2, 0])).keys(), np.array(expected)[[2, 0]])
    first, constant, number, _ = points.at(1).arguments
    np.testing.assert_array_equal(first, [2.0, 3.0])
    assert (constant, number) == (7.0, 1.0)


@pytest.mark.parametrize(
    ("result", "message"),
    [
        (np.ones(3) + 1j, "complex numbers, expected an array of real numbers"),
        (None, "NoneType of dtype object"),
        (np.ones((3, 1)), r"shape \(3, 1\) for inputs of shapes \(3,\), \(\), expected \(3,\)"),
        (1.0, r"shape \(\) .* wrap a function of one specimen in prb.scalar"),
    ],
)
def test_what_is_no_response_is_refused(result: Any, message: str) -> None:
    with pytest.raises(prb.response.ResponseError, match=f"the response returned {message}"):
        checked(result, (3,), [np.zeros(3), 1.0])
    np.testing.assert_array_equal(checked([1, True, np.nan], (3,), []), [1.0, 1.0, np.nan])


def test_a_scalar_needs_a_function() -> None:
    with pytest.raises(TypeError, match=r"scalar: got int, expected a function of one specimen's"):
        prb.scalar(3)  # type: ignore[arg-type]


def test_points_that_fail_are_found_by_halving() -> None:
    seen: list[int] = []

    def response(x: Any, a: Any) -> Any:
        seen.append(len(x))
        if np.isin(x, [3.0, 4.0]).any():
            raise ArithmeticError(f"at {x[0]:.0f}")
        return a * x

    chunk = compute(response, line(8), True)
    expected = [0.0, 2.0, 4.0, np.nan, np.nan, 10.0, 12.0, 14.0]
    np.testing.assert_array_equal(chunk.values, expected)
    text = "it raised ArithmeticError: at "
    assert chunk.raised == {3: text + "3", 4: text + "4"}
    assert seen == [8, 4, 2, 2, 1, 1, 4, 2, 1, 1, 2]
    # Not tolerated: no more calls.
    seen.clear()
    chunk = compute(response, line(8), False)
    assert seen == [8]
    assert np.isnan(chunk.values).all()
    assert list(chunk.raised) == [0]


def test_of_multivariate_inputs_a_call_by_hand_tells_what_to_call() -> None:
    response = prb.scalar(lambda x: x[0] + x[1])
    with pytest.raises(IndexError) as caught:
        response(np.ones((3, 2)))
    assert "response.function(...)" in caught.value.__notes__[0]
    assert response.function(np.array([1.0, 2.0])) == 3.0
