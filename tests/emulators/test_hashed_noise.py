"""Noise of a surrogate: residuals nearby, the same for the same input."""

from typing import Any

import numpy as np
import pytest

import prbayes as prb
from prbayes.emulators.hashed_noise import hashed_rows
from prbayes.response.failures import Abort

BOX = {"x": (0.0, 3.0), "y": (1.0, 2.0)}


def bent(x: Any, y: Any) -> Any:
    return np.sin(x) * y


def fresh_points(n: int = 500) -> tuple[Any, Any]:
    u = np.random.default_rng(3).random((2, n))
    return 3 * u[0], 1 + u[1]


def test_noise_is_the_residuals_nearby_and_the_same_for_the_same_input() -> None:
    plain = prb.Surrogate.fit(bent, BOX, 64, model=prb.surrogate.Polynomial(2))
    noisy = plain.with_error(1)
    x, y = fresh_points(4000)
    added = noisy(x, y) - plain(x, y)
    np.testing.assert_array_equal(noisy(x[::-1], y[::-1])[::-1], noisy(x, y))
    assert noisy(x[7], y[7]) == noisy(x, y)[7]
    np.testing.assert_allclose(
        np.abs(np.abs(added[:, None]) - np.abs(plain.error.residuals)).min(axis=1), 0, atol=1e-12
    )
    assert abs(added.mean()) < 5 * added.std() / np.sqrt(4000)
    assert np.sqrt(np.mean(added**2)) == pytest.approx(
        np.sqrt(np.mean(plain.local_error(x, y) ** 2)), rel=0.06
    )
    assert np.mean(plain.with_error(2)(x, y) == noisy(x, y)) < 0.2
    assert len(np.unique(added.round(12))) > 50


def test_noise_widens_a_population_by_the_error() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(1.5, 0.3, 20_000), rng.normal(1.5, 0.1, 20_000)
    plain = prb.Surrogate.fit(bent, BOX, 64, model=prb.surrogate.Polynomial(1), outside=Abort())
    x, y = np.clip(x, 0, 3), np.clip(y, 1, 2)
    more = plain.with_error()(x, y).var() - plain(x, y).var()
    local = np.mean(plain.local_error(x, y) ** 2)
    assert more == pytest.approx(local, rel=0.1)
    assert plain.with_error()(x, y).std() > 1.5 * plain(x, y).std()


def test_equal_rows_have_equal_numbers_and_others_have_not() -> None:
    x = np.array([[0.0, 1.0], [-0.0, 1.0], [1.0, 0.0], [0.0, np.nextafter(1.0, 2.0)]])
    numbers = hashed_rows(x, 1)
    assert numbers[0] == numbers[1]
    assert len(set(numbers.tolist())) == 3
    assert (hashed_rows(x, 2) != numbers).all()


def test_each_bit_is_as_often_set_as_not() -> None:
    numbers = hashed_rows(np.linspace(0, 1, 20_000)[:, None], 0)
    bits = numbers[:, None] >> np.arange(64, dtype=np.uint64) & np.uint64(1)
    # 64 shares with a standard error of .5 / sqrt(20000) = .0035.
    assert np.abs(bits.mean(axis=0) - 0.5).max() < 5 * 0.0035
