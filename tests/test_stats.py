"""Distribution functions, quantiles, combined p-values, sums of exponentials: closed forms, ties, zero weights, +inf and NaN."""

from __future__ import annotations

import numpy as np
import pytensor
import pytensor.tensor as pt
import pytest
from scipy.special import logsumexp

from prbayes._stats import (
    adjusted_p_values,
    cumulated,
    distribution_function,
    log_sum_exp,
    quantile,
    ranked,
    reached,
    summed_below,
    upper_p_values,
)
from prbayes._validate import Floats

INF, NAN = np.inf, np.nan


def sample(seed: int, *batch: int, n: int = 30) -> tuple[Floats, Floats]:
    """Return values with ties and weights, some of them zero."""
    rng = np.random.default_rng(seed)
    weights = rng.dirichlet(np.ones(n), batch)
    weights[..., ::7] = 0
    return np.round(rng.normal(size=n), 1), weights


@pytest.mark.parametrize("kind", ["stable", "quicksort"])
@pytest.mark.parametrize("batch", [(), (4,), (2, 3), (0,)])
def test_it_is_the_sum_of_the_weights_that_are_not_above(kind: str, batch: tuple[int, ...]) -> None:
    x, w = sample(1, *batch)
    at = np.linspace(-2, 2, 9)
    expected = ((x[:, None] <= at) * w[..., None]).sum(axis=-2)
    found = distribution_function(x, w, at, kind=kind)  # type: ignore[arg-type]
    assert found.shape == (*batch, 9)
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-15)


def test_rows_of_values_have_functions_of_their_own() -> None:
    x, w = sample(2, 2, 3)
    at = np.linspace(-1, 1, 5)
    own = x + np.arange(6.0).reshape(2, 3, 1)
    found = distribution_function(own, w, at)
    expected = [[distribution_function(own[i, j], w[i, j], at) for j in range(3)] for i in range(2)]
    np.testing.assert_array_equal(found, expected)
    shared = distribution_function(np.broadcast_to(x, w.shape), w, at)
    np.testing.assert_array_equal(shared, distribution_function(x, w, at))
    np.testing.assert_array_equal(shared, distribution_function(np.tile(x, (2, 3, 1)), w, at))


def test_infinite_values_are_above_all_points_and_nan_above_them() -> None:
    x, w = np.array([NAN, 0.0, INF, -INF]), np.array([0.4, 0.3, 0.2, 0.1])
    found = distribution_function(x, w, np.array([-1e300, 0.0, 1e300, INF, NAN]))
    np.testing.assert_allclose(found, [0.1, 0.4, 0.4, 0.6, 1.0], rtol=1e-14)


def test_both_steps_work_on_symbols_too() -> None:
    x, w = sample(6, 2)
    w = w + 0.01  # the smallest value's too
    at = np.linspace(-9, 2, 23)  # the first ones below all values
    order, below = ranked(x, at)
    assert below[0] == 0
    symbol = pt.matrix("w")
    graph = summed_below(symbol, order, below, pt)
    found = pytensor.function([symbol], graph, mode=pytensor.compile.mode.Mode(linker="py"))(w)
    np.testing.assert_array_equal(found, distribution_function(x, w, at))
    np.testing.assert_array_equal(cumulated(w, order)[..., below], found)
    assert cumulated(w, order).shape == (2, x.size + 1)
    assert (cumulated(w, order)[:, 0] == 0).all()


# --------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 9])
def test_with_equal_weights_quantiles_are_hazens(n: int) -> None:
    x = np.random.default_rng(7).normal(size=n)
    levels = np.linspace(0, 1, 11)
    expected = np.quantile(x, levels, method="hazen")
    found = quantile(x, np.full(n, 1 / n), levels)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)


def test_quantiles_of_batches_are_those_of_each_row() -> None:
    x, w = sample(8, 2, 3)
    rows = x + np.arange(6.0).reshape(2, 3, 1)
    found = quantile(rows, w, [0.2, 0.5])
    assert found.shape == (2, 3, 2)
    assert quantile(rows, w, 0.5).shape == (2, 3)
    assert quantile(x, w, 0.5).shape == (2, 3)
    assert quantile(x, w[0, 0], 0.5).shape == ()
    np.testing.assert_array_equal(found[1, 2], quantile(rows[1, 2], w[1, 2], [0.2, 0.5]))
    np.testing.assert_array_equal(found[..., 1], quantile(rows, w, 0.5))


def test_quantiles_of_infinite_values_and_of_nan() -> None:
    third = np.full(3, 1 / 3)
    np.testing.assert_array_equal(
        quantile(np.array([INF, 0, 1]), third, [0.5, 0.6, 1]), [1, INF, INF]
    )
    np.testing.assert_array_equal(
        quantile(np.array([NAN, 0, 1]), third, [0.4, 1]) > 0, [True, False]
    )
    assert np.isnan(quantile(np.array([NAN, 0, 1]), third, 0.6))


# ------------------------------------------------------------


def test_levels_are_shares_of_the_sum_if_asked() -> None:
    w, levels = np.array([[1.0, 3.0], [2.0, 2.0]]), np.array([0.3, 0.9])
    assert reached(w, levels).tolist() == [[0, 0], [0, 0]]
    assert reached(w, levels, normalized=True).tolist() == [[1, 1], [0, 1]]
    # Without any weight the last index stands for all.
    assert reached(np.zeros(3), levels, normalized=True).tolist() == [2, 2]


def test_evenly_spaced_levels_repeat_points_in_proportion_to_their_weights() -> None:
    w = np.array([[0.1, 0.2, 0.3, 0.4], [0.4, 0.4, 0.2, 0.0]])
    levels = (np.arange(1000) + np.array([[0.3], [0.8]])) / 1000
    found = reached(w, levels, normalized=True)
    counts = [np.bincount(row, minlength=4) for row in found]
    np.testing.assert_allclose(counts, 1000 * w, atol=1)


def test_p_values_count_the_null_values_that_are_as_large() -> None:
    null = np.arange(9.0)[:, None]
    p_values = upper_p_values(np.array([[9.0], [8.0], [7.5], [-1.0]]), null)
    assert p_values[:, 0] == pytest.approx([0.1, 0.2, 0.2, 1.0])
    assert upper_p_values(np.ones((1, 1)), np.ones((99, 1))) == pytest.approx(1.0)  # ties


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


def test_it_is_that_of_scipy() -> None:
    terms = 500 * np.random.default_rng(0).standard_normal((3, 4, 10))
    terms[0, 0] = -np.inf
    terms[1, 2, 3:] = -np.inf
    expected = logsumexp(terms, axis=-1)
    before = terms.copy()
    np.testing.assert_allclose(log_sum_exp(terms), expected, rtol=1e-13)
    np.testing.assert_array_equal(terms, before)
    assert log_sum_exp(np.empty((2, 0))).tolist() == [-np.inf, -np.inf]
