"""Emulator of a random response: densities, draws and fits against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.special import ndtr

from prbayes.emulators.scatter import (
    Region,
    Scatter,
    chosen_degrees,
    emulator_draws,
    fit_scatter,
    largest_degree,
    legendre_products,
)


def runs_of(n: int, repeats: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return inputs, two correlated outputs with skewed noise, and numbers of the inputs."""
    rng = np.random.default_rng(seed)
    x = np.repeat(-1 + 2 * (np.arange(n) + 0.5) / n, repeats)[:, None]
    noise = (rng.gamma(4.0, size=(len(x), 2)) - 4) / 2
    first, second = noise[:, 0], 0.6 * noise[:, 0] + 0.8 * noise[:, 1]
    y = np.column_stack([1 + x[:, 0] + np.exp(0.5 * x[:, 0]) * first, 2 * second])
    return x, y, np.repeat(np.arange(n), repeats)


UNIT = Region(np.zeros(1), np.eye(1))


@pytest.fixture(scope="module")
def fitted() -> Scatter:
    x, y, places = runs_of(1000, 2, 1)
    return fit_scatter(UNIT, x, y, places, (2, 1))


def test_mean_spread_and_correlation_are_those_of_the_response(fitted: Scatter) -> None:
    at = np.array([[-0.8], [0.0], [0.8]])
    mean, sd = fitted.moments(at)
    error = sd / np.sqrt(2000 / 9)  # at most nine times the variance of a mean of all runs
    assert (np.abs(mean - np.column_stack([1 + at, 0 * at])) < 4 * error).all()
    expected = np.column_stack([np.exp(0.5 * at), np.full(3, 2.0)])
    assert np.abs(np.log(sd / expected)).max() < 4 * np.sqrt(9 * 3.5 / 4 / 2000)
    assert (fitted.factor @ fitted.factor.T)[0, 1] == pytest.approx(0.6, abs=0.08)
    assert stats.skew(fitted.residuals[:, 0]) == pytest.approx(1.0, abs=0.4)


def test_density_is_a_mixture_of_normal_ones(fitted: Scatter) -> None:
    x, error = np.array([[[0.3]]]), np.array([[0.4, 0.1]])
    y = np.array([[1.5, -0.7]])
    mean, sd = (v[0, 0] for v in fitted.moments(x))
    h = fitted.bandwidth
    factor = np.diag(sd) @ fitted.factor
    covariance = h**2 * factor @ factor.T + np.diag(error[0] ** 2)
    centers = mean + np.sqrt(1 - h**2) * fitted.residuals @ factor.T
    expected = fitted.weights @ stats.multivariate_normal(y[0], covariance).pdf(centers)
    assert np.exp(fitted.log_density(x, y, error)) == pytest.approx(expected, rel=1e-9)
    # An output that was not measured is integrated out.
    partial = np.array([[np.nan, -0.7]])
    grid = np.linspace(-12, 16, 4001)
    whole = np.column_stack([grid, np.full(4001, -0.7)])
    joint = np.exp(fitted.log_density(x, whole, np.repeat(error, 4001, axis=0)))
    marginal = np.exp(fitted.log_density(x, partial, error))
    assert marginal == pytest.approx(joint.sum() * (grid[1] - grid[0]), rel=1e-6)


def test_density_of_many_specimens_is_that_of_each(fitted: Scatter) -> None:
    rng = np.random.default_rng(0)
    y, error = rng.normal(1, 1, (6, 2)), np.tile([[0.0, 0.2], [0.1, 0.0]], (3, 1))
    y[4, 0] = np.nan
    x = np.linspace(-1, 1, 5)[None, :, None]
    together = fitted.log_density(x, y, error)
    for k in range(6):
        alone = fitted.log_density(x, y[[k]], error[[k]])
        own = fitted.log_density(np.repeat(x, 6, axis=0), y, error)
        np.testing.assert_allclose(together[[k]], alone, rtol=1e-9)
        np.testing.assert_allclose(together, own, rtol=1e-9)


def test_outputs_have_the_moments_and_noise_is_their_inverse(fitted: Scatter) -> None:
    noise = np.random.default_rng(3).standard_normal((40_000, 2))
    x = np.full((len(noise), 1), 0.5)
    y = fitted.outputs(x, noise)
    mean, sd = fitted.moments(x[:1])
    assert (np.abs(y.mean(axis=0) - mean[0]) < 5 * sd[0] / 200).all()
    np.testing.assert_allclose(y.std(axis=0), sd[0], rtol=0.03)
    rho = (fitted.factor @ fitted.factor.T)[0, 1]
    assert np.corrcoef(y.T)[0, 1] == pytest.approx(rho, abs=0.02)
    inverse = fitted.noise(x[None, :1], y[:50])[:, 0]
    np.testing.assert_allclose(inverse, np.clip(noise[:50], -4, 4), atol=0.01)


def test_draws_scatter_by_the_standard_error_of_the_mean() -> None:
    rng = np.random.default_rng(5)
    x = np.repeat(np.linspace(-1, 1, 64), 2)[:, None]
    y = 0.3 * rng.standard_normal((128, 1))
    places = np.repeat(np.arange(64), 2)
    draws = emulator_draws(UNIT, x, y, places, (0, 0), 200, 0)
    means = np.array([draw.moments(np.zeros((1, 1)))[0][0, 0] for draw in draws])
    by_place = y.reshape(64, 2).mean(axis=1)
    expected = by_place.std() / 8
    assert means.std() == pytest.approx(expected, rel=5 / np.sqrt(400))
    assert np.log([np.exp(d.spread_terms[0, 0]) for d in draws]).std() > 0.03


def test_degrees_follow_the_response() -> None:
    x, y, places = runs_of(64, 2, 2)
    assert chosen_degrees(UNIT, x, y, places)[0] <= 3
    cubic = np.column_stack([20 * x[:, 0] ** 3, y[:, 1]]) + 0.1 * y
    assert chosen_degrees(UNIT, x, cubic, places)[0] >= 3
    assert [largest_degree(d, 64 / 6, 6) for d in (1, 2, 3, 5)] == [6, 3, 2, 1]
    assert legendre_products(np.zeros((1, 3)), 2).shape == (1, 10)


def test_beyond_the_region_are_the_moments_of_its_end(fitted: Scatter) -> None:
    ends = fitted.moments(np.array([[1.0], [-1.0]]))
    beyond = fitted.moments(np.array([[3.0], [-9.0]]))
    np.testing.assert_array_equal(ends, beyond)
    assert np.isfinite(fitted.noise(np.zeros((1, 1, 1)), np.array([[1e9, np.nan]]))).all()
    assert ndtr(4.0) < 1


def test_variance_of_few_runs_is_unbiased() -> None:
    rng = np.random.default_rng(8)
    x = np.repeat(np.linspace(-1, 1, 10), 2)[:, None]
    places = np.repeat(np.arange(10), 2)
    variances = []
    for _ in range(300):
        y = rng.standard_normal((20, 1))
        fit = fit_scatter(UNIT, x, y, places, (4, 0))
        variances.append(np.exp(2 * fit.spread_terms[0, 0]))
    error = np.std(variances) / np.sqrt(300)
    assert np.mean(variances) == pytest.approx(1.0, abs=4 * error)
