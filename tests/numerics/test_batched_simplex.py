"""Many simplices in step, on parabolas, kinks and flats."""

from typing import Any

import numpy as np
import pytest
from scipy import optimize

from prbayes._validate import Floats
from prbayes.numerics.batched_simplex import descend_by_simplex

CENTERS = np.random.default_rng(1).normal(size=(20, 3))
SIZES = (1.0, -0.5)


def gap(x: Floats, rows: Any) -> Floats:
    return np.asarray(x - CENTERS[rows][:, None, : x.shape[-1]])


FUNCTIONS = {
    "parabola": lambda x, rows: (gap(x, rows) ** 2 * [1.0, 3.0, 0.5][: x.shape[-1]]).sum(axis=-1),
    "kink": lambda x, rows: np.abs(gap(x, rows)).max(axis=-1),
    "edges": lambda x, rows: np.abs(gap(x, rows)).sum(axis=-1),
}


@pytest.mark.parametrize("r", [1, 2, 3])
@pytest.mark.parametrize("name", list(FUNCTIONS))
def test_every_row_finds_its_own_minimum(name: str, r: int) -> None:
    value = FUNCTIONS[name]
    x, values, converged = descend_by_simplex(value, np.zeros((20, r)), sizes=SIZES)
    assert converged.all()
    # A hundredth of the mean gain is the range over the last simplex, whose middle is not looked
    # at.
    gain = value(np.zeros((20, 1, r)), np.arange(20)).mean()
    assert values.max() < 0.06 * gain
    np.testing.assert_array_equal(values, value(x[:, None], np.arange(20))[:, 0])


def test_a_row_does_not_depend_on_the_others_path() -> None:
    alone = optimize.minimize(
        lambda t: FUNCTIONS["parabola"](t[None, None], np.array([4]))[0, 0],
        np.zeros(2),
        method="Nelder-Mead",
    )
    x, _, _ = descend_by_simplex(FUNCTIONS["parabola"], np.zeros((20, 2)), sizes=SIZES)
    np.testing.assert_allclose(x[4], alone.x, atol=0.2)


def test_what_is_flat_stays_and_what_is_infinite_is_left() -> None:
    x, values, _ = descend_by_simplex(
        lambda x, rows: np.zeros(x.shape[:2]), np.ones((3, 2)), sizes=[1.0]
    )
    np.testing.assert_array_equal(values, 0)
    np.testing.assert_array_equal(x, 1)

    def half(x: Floats, rows: Any) -> Floats:
        return np.where(x[..., 0] < 0.1, np.inf, x[..., 0] ** 2)

    x, values, _ = descend_by_simplex(half, np.full((2, 1), 2.0), sizes=[-1.0])
    assert (x >= 0.1).all()
    assert (x < 0.3).all()


def test_no_parameters() -> None:
    x, values, converged = descend_by_simplex(
        lambda x, rows: np.full(x.shape[:2], 7.0), np.empty((3, 0)), sizes=SIZES
    )
    assert x.shape == (3, 0)
    np.testing.assert_array_equal(values, 7)
    assert converged.all()
