"""Numbers of weighted populations beside NumPy's and closed forms."""

from typing import Any

import numpy as np
import pymc as pm
import pytest
from decisions import same
from scipy.special import ndtri

import prbayes as prb
from prbayes.decision.quantities import interval_grid, interval_values

VALUES = np.array([1.0, 2.0, 2.5, 7.0])
WEIGHTS = np.array([[0.25, 0.25, 0.25, 0.25], [0.5, 0.0, 0.5, 0.0]])
X = pm.Normal.dist()


@pytest.mark.parametrize(
    ("quantity", "expected", "of_specimens"),
    [
        (prb.decision.Mean(same, X), [3.125, 1.75], VALUES),
        (prb.decision.StandardDeviation(same, X), [np.std(VALUES), 0.75], VALUES),
        (prb.decision.Exceedance(same, X, limit=2.0), [0.5, 0.5], [0, 0, 1, 1]),
        (prb.decision.Exceedance(same, X, limit=2.0, below=True), [0.25, 0.5], [1, 0, 0, 0]),
        (prb.decision.Exceedance(same, X, limit=7.0), [0.0, 0.0], [0, 0, 0, 0]),
        (prb.decision.Quantile(same, X, probability=0.5), [2.25, 2.0], [0, 0, 1, 1]),
    ],
    ids=repr,
)
def test_numbers_of_a_population_and_of_specimens(
    quantity: prb.decision.Quantity, expected: Any, of_specimens: Any
) -> None:
    np.testing.assert_allclose(quantity.of(VALUES, WEIGHTS), expected, rtol=1e-12)
    np.testing.assert_array_equal(quantity.of_specimen(VALUES, 2.25), of_specimens)


def test_a_quantile_of_many_and_a_spread_beside_a_large_mean() -> None:
    z = ndtri((np.arange(2000) + 0.5) / 2000)
    quantile = prb.decision.Quantile(same, X, probability=0.9)
    np.testing.assert_allclose(quantile.of(z, np.full((1, 2000), 1 / 2000)), ndtri(0.9), atol=1e-3)
    sd = prb.decision.StandardDeviation(same, X)
    np.testing.assert_allclose(sd.of(VALUES + 1e9, WEIGHTS), sd.of(VALUES, WEIGHTS), rtol=1e-6)


def test_intervals_have_every_combination_with_the_ends() -> None:
    inputs = [prb.decision.Interval(1, 2), "x", prb.decision.Interval(-1, 1)]
    found = interval_grid(inputs, 3)
    assert len(found) == 9
    assert {(1.0, "x", -1.0), (1.5, "x", 0.0), (2.0, "x", 1.0)} <= set(found)
    assert interval_grid(["x", 2.6], 3) == [("x", 2.6)]
    assert interval_values(inputs, found[-1]) == "2, 1"
