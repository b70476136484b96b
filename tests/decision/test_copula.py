"""A normal copula: its margins, and draws of one element given the others."""

import numpy as np
import pytest

from prbayes.decision.copula import Copula

CORRELATION = np.array([[1.0, 0.6, 0.0], [0.6, 1.0, -0.3], [0.0, -0.3, 1.0]])
SD = np.array([0.1, 1.0, 20.0])
RNG = np.random.default_rng(0)
DRAWS = 5 + RNG.multivariate_normal(np.zeros(3), CORRELATION, 20_000) * SD
COPULA = Copula.of(DRAWS)
Z = RNG.multivariate_normal(np.zeros(3), COPULA.correlation, 20_000)
FRESH = RNG.normal(size=Z.shape)


def test_normal_draws_are_found_again() -> None:
    np.testing.assert_allclose(COPULA.correlation, CORRELATION, atol=4 / np.sqrt(20_000))
    thetas = COPULA.thetas(Z)
    np.testing.assert_allclose(thetas.mean(axis=0), 5, atol=0.05 * SD.max())
    np.testing.assert_allclose(thetas.std(axis=0), SD, rtol=0.03)
    skew = Copula.of(np.exp(DRAWS[:, 1:2]))
    np.testing.assert_allclose(
        np.quantile(skew.thetas(Z[:, :1]), [0.1, 0.5, 0.9]),
        np.quantile(np.exp(DRAWS[:, 1]), [0.1, 0.5, 0.9]),
        rtol=0.05,
    )


@pytest.mark.parametrize("i", range(3))
def test_a_redrawn_element_has_the_same_distribution_with_the_others(i: int) -> None:
    found = COPULA.element_given_rest(Z, FRESH, i)
    np.testing.assert_array_equal(np.delete(found, i, 1), np.delete(Z, i, 1))
    np.testing.assert_allclose(np.cov(found.T), COPULA.correlation, atol=0.05)
    # Given the others, the old and the new are independent.
    others = np.delete(Z, i, 1)
    residuals = [
        y - others @ np.linalg.lstsq(others, y, rcond=None)[0] for y in (Z[:, i], found[:, i])
    ]
    assert abs(np.corrcoef(residuals)[0, 1]) < 5 / np.sqrt(len(Z))
    np.testing.assert_allclose(residuals[1].std(), COPULA.conditional_sd[i], rtol=0.03)


@pytest.mark.parametrize("i", range(3))
def test_others_are_redrawn_given_an_element(i: int) -> None:
    elsewhere = FRESH @ COPULA.root.T
    found = COPULA.rest_given_element(Z, elsewhere, i)
    np.testing.assert_allclose(found[:, i], Z[:, i])
    np.testing.assert_allclose(np.cov(found.T), COPULA.correlation, atol=0.05)
    for j in {0, 1, 2} - {i}:
        expected = COPULA.correlation[i, j] ** 2
        assert abs(np.corrcoef(Z[:, j], found[:, j])[0, 1] - expected) < 5 / np.sqrt(len(Z))
