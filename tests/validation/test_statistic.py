"""The area between an ECDF and the identity."""

import numpy as np
import pytest

from prbayes.validation.statistic import area


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
