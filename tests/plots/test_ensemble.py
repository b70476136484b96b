"""The populations that a result stands for."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.plots.ensemble import Calibrated, Ensemble, read_before, read_result, supported


def test_an_optimum_stands_for_its_sampling_distribution(optimum: prb.Optimum) -> None:
    shown = read_result(optimum, None, "test", 200)
    np.testing.assert_array_equal(shown.center, optimum.theta[None])
    assert len(shown.thetas) > 190
    np.testing.assert_allclose(np.cov(shown.thetas.T), optimum.covariance, rtol=0.4, atol=2e-3)
    np.testing.assert_allclose(shown.thetas.mean(axis=0), optimum.theta, atol=0.03)
    np.testing.assert_array_equal(shown.every, np.vstack([optimum.theta, shown.thetas]))


def test_an_optimum_of_unknown_accuracy_stands_alone(optimum: prb.Optimum) -> None:
    alone = replace(optimum, covariance=np.full((2, 2), np.inf))
    shown = read_result(alone, None, "test")
    assert shown.thetas.shape == (0, 2)
    np.testing.assert_array_equal(shown.every, optimum.theta[None])


def test_a_posterior_stands_for_its_draws(
    optimum: prb.Optimum, posterior: xr.DataTree, known: SimpleNamespace
) -> None:
    shown = read_result(posterior, optimum.model, "test", 300)
    expected = np.column_stack([known.mu.ravel(), np.log(known.sigma.ravel())])
    np.testing.assert_allclose(shown.thetas, expected)
    assert shown.center.shape == (0, 2)
    assert shown.evaluator.model is optimum.model
    assert len(read_result(posterior, optimum.model, "test").thetas) == 200


def test_a_model_is_given_or_on_the_context(optimum: prb.Optimum, posterior: xr.DataTree) -> None:
    with pytest.raises(TypeError, match="test: got no model on the context"):
        read_result(posterior, None, "test")
    with pytest.raises(TypeError, match=r"test: got int, expected a pm.Model"):
        read_result(optimum, 3, "test")  # type: ignore[arg-type]


def test_before_is_what_it_says(optimum: prb.Optimum) -> None:
    evaluator = optimum.evaluator
    theta, text = read_before(optimum, evaluator, None)
    np.testing.assert_array_equal(theta[0], evaluator.hyperparameters.initial)
    assert text == "prior's initial point"
    started = prb.minimize(optimum.model, start={"mu": -1.0, "sigma": 1.5})
    theta, text = read_before(started, evaluator, None)
    np.testing.assert_allclose(theta[0], [-1, np.log(1.5)])
    assert text == "optimiser's first point"
    theta, text = read_before(optimum, evaluator, {"mu": 2.0, "sigma": 1.0})
    np.testing.assert_allclose(theta, [[2, 0]])
    assert text == "as given"
    assert len(read_before(optimum, evaluator, False)[0]) == 0
    with pytest.raises(TypeError, match="before: got float, expected a dict"):
        read_before(optimum, evaluator, 3.0)  # type: ignore[arg-type]


def test_what_the_design_does_not_reach_is_not_supported(
    optimum: prb.Optimum, build: Callable[..., pm.Model]
) -> None:
    thetas = np.array([[1.0, -0.7], [60.0, -0.7], [np.nan, 0.0], [1.0, -9.0]])
    found = supported(optimum.evaluator, thetas)
    np.testing.assert_array_equal(found, [True, False, False, False])
    everywhere = supported(Evaluator.of(build(prb.Resimulated(64))), thetas)
    np.testing.assert_array_equal(everywhere, [True, True, False, True])


CURVES = np.arange(11.0)[:, None] * np.array([1.0, -1.0])


def shown(optimum: prb.Optimum, centers: int) -> Ensemble:
    thetas = np.zeros((11 - centers, 2))
    return Ensemble(optimum.evaluator, np.zeros((centers, 2)), thetas, "", "")


def test_the_curve_of_a_posterior_is_the_mean_in_its_band(optimum: prb.Optimum) -> None:
    found = Calibrated.of(CURVES, shown(optimum, 0), 0.8)
    np.testing.assert_allclose(found.middle, [5, -5])
    np.testing.assert_allclose(found.band, [[1, -9], [9, -1]])
    assert found.top == 9


def test_the_curve_of_an_optimum_is_its_own_and_no_part_of_the_band(optimum: prb.Optimum) -> None:
    found = Calibrated.of(CURVES, shown(optimum, 1), 0.8)
    np.testing.assert_allclose(found.middle, [0, 0])
    np.testing.assert_allclose(found.band, [[1.9, -9.1], [9.1, -1.9]])
    alone = Calibrated.of(CURVES[:1], shown(optimum, 1), 0.8)
    assert alone.band is None
    assert alone.top == 0
