from __future__ import annotations

import numpy as np
import pytest

from prbayes.numerics.min_p import adjusted_p_values, upper_p_values


def test_p_values_count_the_null_values_that_are_as_large() -> None:
    null = np.arange(9.0)[:, None]
    p_values = upper_p_values(np.array([[9.0], [8.0], [7.5], [-1.0]]), null)
    assert p_values[:, 0] == pytest.approx([0.1, 0.2, 0.2, 1.0])


def test_ties_count_as_large() -> None:
    assert upper_p_values(np.ones((1, 1)), np.ones((99, 1))) == pytest.approx(1.0)


def test_one_statistic_needs_no_adjustment() -> None:
    null = np.random.default_rng(0).standard_normal((399, 1))
    for value in (-1.0, 0.3, 2.0):
        observed = np.array([value])
        plain = upper_p_values(observed[None], null)[0]
        assert adjusted_p_values(observed, null) == pytest.approx(plain, abs=1 / 400)


def test_two_independent_statistics_double_a_small_p_value() -> None:
    null = np.random.default_rng(1).standard_normal((9999, 2))
    p_value = adjusted_p_values(np.array([2.3263, 0.0]), null)[0]
    # 1 - (1 - .01)^2; the standard error of the two p-values together is .0017
    assert p_value == pytest.approx(0.0199, abs=0.008)


def test_the_combined_test_has_its_size() -> None:
    rng = np.random.default_rng(2)
    values = rng.standard_normal((1000, 100, 3)) ** 2  # (data sets, B + 1, C)
    rejected = [adjusted_p_values(v[0], v[1:]).min() <= 0.05 for v in values]
    # standard error .007
    assert np.mean(rejected) == pytest.approx(0.05, abs=0.03)


def test_a_monotone_change_of_a_statistic_changes_nothing() -> None:
    rng = np.random.default_rng(3)
    null, observed = rng.standard_normal((199, 2)), rng.standard_normal(2)
    changed = adjusted_p_values(
        np.array([np.exp(observed[0]), observed[1]]), np.c_[np.exp(null[:, 0]), null[:, 1]]
    )
    assert changed == pytest.approx(adjusted_p_values(observed, null))
