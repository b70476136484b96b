"""Weights with known effective sizes, and mixtures of t distributions against SciPy."""

from __future__ import annotations

import arviz_stats
import numpy as np
import pytest
from scipy.stats import multivariate_t

from prbayes.numerics.mixtures import (
    StudentMixture,
    effective_sample_size,
    normalised_weights,
    pareto_smoothed,
    student_vectors,
)


def test_equal_weights_have_their_number_as_the_effective_sample_size() -> None:
    weights = np.array([[0.25, 0.25, 0.25, 0.25], [1.0, 0.0, 0.0, 0.0]])
    np.testing.assert_allclose(effective_sample_size(weights), [4.0, 1.0])


def test_weights_do_not_overflow() -> None:
    weights = normalised_weights(np.array([[1000.0, 1000.0 + np.log(3.0)]]))
    np.testing.assert_allclose(weights, [[0.25, 0.75]])


def test_log_densities_of_a_mixture_are_those_of_its_components() -> None:
    root = np.array([[[1.0, 0.0], [0.5, 2.0]], [[0.3, 0.0], [0.0, 0.3]]])
    mixture = StudentMixture(np.array([[0.0, 1.0], [4.0, 4.0]]), root, np.array([0.3, 0.7]), 5.0)
    points = np.random.default_rng(0).normal(size=(7, 2))
    expected = [
        np.log(share) + multivariate_t(center, factor @ factor.T, df=5).logpdf(points)
        for center, factor, share in zip(mixture.centers, root, mixture.shares, strict=True)
    ]
    np.testing.assert_allclose(mixture.log_densities(points).T, expected)


def test_t_vectors_at_the_median_radius_are_those_of_the_normal_directions() -> None:
    vectors = student_vectors(np.array([[0.5, 0.5, 0.2], [0.9, 0.5, 0.2]]), 5.0)
    assert vectors[0].tolist() == [0.0, 0.0]
    assert vectors[1, 0] > 0
    assert vectors[1, 1] == 0


def test_a_fitted_mixture_has_the_components_of_the_points() -> None:
    """With 2000 points a center has a standard error of .03."""
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.normal(-5, 1, (1000, 1)), rng.normal(5, 1, (1000, 1))])
    weights = np.full(2000, 1 / 2000)
    mixture = StudentMixture.fitted(points, weights, 2, 30.0, rng)
    np.testing.assert_allclose(np.sort(mixture.centers[:, 0]), [-5.0, 5.0], atol=0.15)
    np.testing.assert_allclose(mixture.shares, 0.5, atol=0.06)


@pytest.mark.parametrize(("n", "scale"), [(60, 1.0), (300, 0.1), (2200, 5.0)])
def test_smoothed_weights_are_those_of_arviz(n: int, scale: float) -> None:
    log_w = scale * np.random.default_rng(n).exponential(size=(3, n))
    smoothed, k = pareto_smoothed(log_w)
    for row, weights, shape in zip(log_w, smoothed, k, strict=True):
        expected, expected_k = arviz_stats.base.array_stats.psislw(-row)
        np.testing.assert_allclose(weights, expected, atol=1e-9)
        assert shape == pytest.approx(expected_k, abs=1e-9)
    assert np.isnan(pareto_smoothed(np.zeros((1, n)))[1]).all()
