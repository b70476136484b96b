"""Importance sampling from Laplace approximations, against densities with known integrals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal, multivariate_t, norm

from prbayes._validate import Floats
from prbayes.numerics.modes import laplace
from prbayes.posterior.importance import ImportanceOptions, importance_sample, importance_samples

MEAN = np.array([1.0, -2.0, 0.5])
COVARIANCE = np.array([[1.0, 0.6, 0.0], [0.6, 0.5, -0.1], [0.0, -0.1, 0.3]])
SCALE = np.array([3.0, 5.0, 2.0])
NORMAL = multivariate_normal(MEAN, COVARIANCE)


def normal(thetas: Floats) -> Floats:
    return np.asarray(7.0 + NORMAL.logpdf(thetas))


def test_moments_and_evidence_of_a_normal_density() -> None:
    sample = importance_sample(normal, laplace(normal, MEAN[None], SCALE), 4000, seed=1)
    assert sample.is_reliable
    assert sample.efficiency > 0.7
    np.testing.assert_allclose(sample.log_evidence, 7.0, atol=0.01)
    # Five standard errors of 4000 independent draws.
    sd = np.sqrt(np.diag(COVARIANCE))
    assert (np.abs(sample.draws.mean(axis=0) - MEAN) < 5 * sd / np.sqrt(4000)).all()
    np.testing.assert_allclose(np.cov(sample.draws.T), COVARIANCE, atol=5 * np.sqrt(2 / 4000))
    np.testing.assert_allclose(sample.log_density, normal(sample.draws))
    # Rows are in random order: halves have the same mean.
    first, second = sample.draws.reshape(2, 2000, -1).mean(axis=1)
    assert (np.abs(first - second) < 5 * sd * np.sqrt(2 / 2000)).all()


def test_the_error_of_draws_is_at_most_that_of_independent_ones() -> None:
    """Every fourth point of a Sobol sequence is no sample."""
    modes = laplace(normal, MEAN[None], SCALE)
    samples = [importance_sample(normal, modes, 4000, seed) for seed in range(10)]
    errors = np.array([sample.draws.mean(axis=0) - MEAN for sample in samples])
    # Thirty numbers: the standard error of their root mean square is .13.
    scaled = errors / np.sqrt(np.diag(COVARIANCE) / 4000)
    assert np.sqrt(np.mean(scaled**2)) < 1.4


def test_a_second_round_repairs_a_narrow_proposal() -> None:
    (mode,) = laplace(normal, MEAN[None], SCALE)
    narrow = replace(mode, mode=mode.mode + 0.5, covariance=mode.covariance / 4)
    one = importance_sample(normal, [narrow], 2000, 0, ImportanceOptions(rounds=1))
    two = importance_sample(normal, [narrow], 2000, 0)
    assert one.efficiency < 0.25
    assert two.efficiency > 0.5
    assert two.is_reliable


def test_a_tail_that_the_proposal_lacks_is_not_reliable() -> None:
    """A Cauchy density in five dimensions has heavier tails than t(5)."""
    heavy = multivariate_t(np.zeros(5), np.eye(5), df=1)
    modes = laplace(heavy.logpdf, np.zeros((1, 5)), np.full(5, 3.0))
    sample = importance_sample(heavy.logpdf, modes, 2000, 0, ImportanceOptions(rounds=1))
    assert not sample.is_reliable


def test_further_rounds_follow_a_bent_ridge_into_the_prior() -> None:
    """Only the sum of two variances is known: either may be nearly zero."""
    prior = multivariate_normal(np.zeros(2), 4 * np.eye(2))

    def ridge(thetas: Floats) -> Floats:
        total = np.exp(thetas).sum(axis=1)
        return np.asarray(prior.logpdf(thetas) - 0.5 * ((total - 1) / 0.05) ** 2)

    def draws(size: int, seed: int) -> Floats:
        return np.asarray(prior.rvs(size, random_state=seed))

    modes = laplace(ridge, np.full((1, 2), np.log(0.5)), np.full(2, 2.0))
    sample = importance_sample(ridge, modes, 4000, seed=0, prior=(draws, prior.logpdf))
    assert sample.effective_size / sample.efficiency > 8000  # points
    assert sample.is_reliable
    x = np.linspace(-14, 1, 1001)
    grid = np.stack([a.ravel() for a in np.meshgrid(x, x)], axis=1)
    weights = np.exp(ridge(grid))
    mean = weights @ grid[:, 0] / weights.sum()
    sd = np.sqrt(weights @ (grid[:, 0] - mean) ** 2 / weights.sum())
    # Five standard errors of the smallest effective size.
    assert (np.abs(sample.draws.mean(axis=0) - mean) < 5 * sd / np.sqrt(2000)).all()


@pytest.mark.parametrize("nuisance", [0, 2])
def test_a_ridge_between_two_modes_has_its_mass(nuisance: int) -> None:
    """Squares of normal specimens: either sign of the mean, or one near zero with a large spread.

    A prior of the nuisance elements, twenty times as wide as their posterior, reaches no point of
    the ridge.
    """
    specimens = np.random.default_rng(34).normal(1.0, 0.5, 20)
    sd = np.concatenate([[2.0, 1.0], np.full(nuisance, 20.0)])

    def prior(thetas: Floats) -> Floats:
        return np.asarray(norm.logpdf(thetas, 0.0, sd).sum(axis=1))

    def folded(thetas: Floats) -> Floats:
        mean, spread = thetas[:, :1], np.exp(thetas[:, 1:2])
        signs = [norm.logpdf(sign * specimens, mean, spread) for sign in (1, -1)]
        nuisances = norm.logpdf(thetas[:, 2:]).sum(axis=1)
        return np.asarray(prior(thetas) + np.logaddexp(*signs).sum(axis=1) + nuisances)

    def draws(size: int, seed: int) -> Floats:
        return sd * np.random.default_rng(seed).standard_normal((size, len(sd)))

    grid = np.stack(
        [a.ravel() for a in np.meshgrid(np.linspace(-3, 3, 301), np.linspace(-2, 2, 201))]
    )
    weights = np.exp(folded(np.hstack([grid.T, np.zeros((grid.shape[1], nuisance))])))
    right = weights[np.abs(grid[0]) < 0.4].sum() / weights.sum()
    assert 0.005 < right < 0.05
    starts = np.zeros((2, len(sd)))
    starts[:, :2] = [[1.0, -0.7], [-1.0, -0.7]]
    modes = laplace(folded, starts, sd)
    shares = []
    for seed in range(8):
        sample = importance_sample(folded, modes, 4000, seed, prior=(draws, prior))
        assert sample.is_reliable
        shares.append(float(np.mean(np.abs(sample.draws[:, 0]) < 0.4)))
    # The standard error of 4000 independent draws.
    error = np.sqrt(right / 4000)
    assert np.abs(np.array(shares) - right).max() < 4 * error
    assert abs(np.mean(shares) - right) < 4 * error / np.sqrt(8)


def test_densities_in_a_batch_have_the_draws_that_they_have_alone() -> None:
    """None where the first proposal does not suffice."""
    prior = multivariate_normal(np.zeros(3), 4 * np.eye(3))

    def draws(size: int, seed: int) -> Floats:
        return np.asarray(prior.rvs(size, random_state=seed))

    (mode,) = laplace(normal, MEAN[None], SCALE)
    narrow = replace(mode, covariance=mode.covariance / 50)
    samples = importance_samples(
        lambda points: (normal(points), prior.logpdf(points)),
        [mode, narrow],
        draws(400, 3),
        2000,
        3,
    )
    expected = importance_sample(normal, [mode], 2000, 3, prior=(draws, prior.logpdf))
    assert samples[1] is None
    assert samples[0] is not None
    np.testing.assert_allclose(samples[0].draws, expected.draws, rtol=1e-9)
    np.testing.assert_allclose(samples[0].pareto_k, expected.pareto_k, atol=1e-9)
