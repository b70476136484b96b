"""Standard errors carried to the user's units."""

import numpy as np

from prbayes.estimate.solution import _stderr

COVARIANCE = np.array([[4.0, 1.0], [1.0, 9.0]])


def test_standard_errors_of_sums_and_differences_know_the_correlation() -> None:
    gradients = np.array([[1.0, 0.0], [1.0, 1.0], [1.0, -1.0], [0.0, 0.0]])
    np.testing.assert_allclose(_stderr(gradients, COVARIANCE), np.sqrt([4.0, 15.0, 11.0, 0.0]))


def test_what_depends_on_an_element_that_is_not_identified_is_infinite() -> None:
    covariance = np.array([[4.0, np.inf], [np.inf, np.inf]])
    found = _stderr(np.array([[2.0, 0.0], [0.0, 1.0], [0.0, 0.0]]), covariance)
    np.testing.assert_array_equal(found[1:], [np.inf, np.nan])  # at a bound nothing is known
    assert found[0] == 4.0  # of the other element alone


def test_nothing_known_is_nan() -> None:
    assert np.isnan(_stderr(np.ones((1, 2)), np.full((2, 2), np.nan))).all()
