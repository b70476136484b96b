"""The log-gamma distribution: its moments, what it is of chi-squared variables, and its tails."""

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

from prbayes.posterior.log_gamma import LogGamma


def density(shape: float, z: float, side: float = 0.0) -> float:
    found = LogGamma(shape).log_likelihood(np.array([z]), np.array([side]))
    return float(np.exp(found[0]))


@pytest.mark.parametrize("shape", [-1.3, -0.4, 0.0, 0.7])
def test_it_is_standardised_and_skewed_by_its_shape(shape: float) -> None:
    moments = [
        quad(lambda z, k=k: z**k * density(shape, z), -40, 40, limit=400)[0] for k in range(4)
    ]
    np.testing.assert_allclose(moments[:3], [1, 0, 1], atol=1e-6)
    # To first order the skewness is the shape; the one that stands for zero is a hundredth.
    assert np.sign(moments[3]) == (np.sign(shape) or 1)
    assert abs(moments[3] - shape) < 0.05 + 0.15 * abs(shape)


@pytest.mark.parametrize("freedom", [3, 9, 40])
def test_a_standard_deviation_of_normal_data_has_it_exactly(freedom: int) -> None:
    logarithm = stats.loggamma(freedom / 2)
    z = np.linspace(-3, 2.5, 12)
    found = LogGamma(-np.sqrt(2 / freedom)).log_likelihood(z, np.zeros(12))
    there = logarithm.mean() + logarithm.std() * z
    np.testing.assert_allclose(found, logarithm.logpdf(there) + np.log(logarithm.std()), rtol=1e-10)


@pytest.mark.parametrize("shape", [-0.9, 0.0, 0.5])
def test_probabilities_are_integrals_of_the_density(shape: float) -> None:
    for z in (-1.7, 0.2, 1.4):
        below = quad(lambda t: density(shape, t), -40, z, limit=400)[0]
        np.testing.assert_allclose(density(shape, z, -1.0), below, rtol=1e-6)
        np.testing.assert_allclose(density(shape, z, 1.0), 1 - below, rtol=1e-6)


def test_the_normal_is_its_middle_and_far_tails_are_numbers() -> None:
    z = np.array([-3.0, 0.0, 2.0])
    found = LogGamma(0.0).log_likelihood(z, np.zeros(3))
    np.testing.assert_allclose(found, stats.norm.logpdf(z), atol=0.07)
    for shape, far, side in ((-1.0, 300.0, 0.0), (1.0, -300.0, 0.0), (0.5, 90.0, 1.0)):
        known = LogGamma(shape).log_likelihood(np.array([far]), np.array([side]))
        assert known < -100


def test_the_shape_is_found_with_some_numbers_out_of_sight() -> None:
    logarithm = np.log(np.random.default_rng(1).chisquare(9, 20_000))
    z = (logarithm - logarithm.mean()) / logarithm.std()
    side = np.sign(z) * (np.abs(z) > 1.5)
    seen = np.clip(z, -1.5, 1.5)
    found = LogGamma.fit(seen, side, np.ones(z.size)).shape
    assert abs(found + np.sqrt(2 / 9)) < 0.04
