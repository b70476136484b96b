"""The populations of a result, and those before the calibration."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.plots.ensemble import read_before, read_result, supported


def test_an_optimum_has_its_sampling_distribution(optimum: prb.Optimum) -> None:
    ensemble = read_result(optimum, None, "test", 200)
    np.testing.assert_array_equal(ensemble.center, optimum.theta[None])
    assert len(ensemble.thetas) > 190
    np.testing.assert_allclose(np.cov(ensemble.thetas.T), optimum.covariance, rtol=0.4, atol=2e-3)
    np.testing.assert_allclose(ensemble.thetas.mean(axis=0), optimum.theta, atol=0.03)
    np.testing.assert_array_equal(ensemble.every, np.vstack([optimum.theta, ensemble.thetas]))
    unknown = replace(optimum, covariance=np.full((2, 2), np.inf))
    assert read_result(unknown, None, "test").thetas.shape == (0, 2)


def test_a_posterior_has_its_draws(
    optimum: prb.Optimum, posterior: xr.DataTree, known: SimpleNamespace
) -> None:
    ensemble = read_result(posterior, optimum.model, "test", 300)
    expected = np.column_stack([known.mu.ravel(), np.log(known.sigma.ravel())])
    np.testing.assert_allclose(ensemble.thetas, expected)
    assert ensemble.center.shape == (0, 2)
    assert len(read_result(posterior, optimum.model, "test").thetas) == 200


def test_a_model_is_given_or_on_the_context(posterior: xr.DataTree) -> None:
    with pytest.raises(TypeError, match="test: got no model on the context"):
        read_result(posterior, None, "test")


def test_before_is_the_initial_point_the_start_or_a_given_point(
    optimum: prb.Optimum, caplog: pytest.LogCaptureFixture
) -> None:
    evaluator = optimum.evaluator
    theta, text = read_before(optimum, evaluator, None, "test")
    np.testing.assert_array_equal(theta[0], evaluator.hyperparameters.initial)
    assert text == "prior's initial point"
    path = {"theta": np.array([[0.5, -0.5], [1.0, 0.0]])}
    started = replace(optimum, search=replace(optimum.search, n_screened=0, trace=path))
    theta, text = read_before(started, evaluator, None, "test")
    np.testing.assert_allclose(theta, [[0.5, -0.5]])
    assert text == "optimiser's first point"
    theta, text = read_before(optimum, evaluator, {"mu": 2.0, "sigma": 1.0}, "test")
    np.testing.assert_allclose(theta, [[2, 0]])
    assert text == "as given"
    assert len(read_before(optimum, evaluator, False, "test")[0]) == 0
    assert len(read_before(optimum, evaluator, {"mu": 50.0, "sigma": 0.1}, "test")[0]) == 0
    assert "stored responses do not reach there" in caplog.text


def test_populations_beyond_the_design_are_not_supported(
    optimum: prb.Optimum, build: Callable[..., pm.Model]
) -> None:
    thetas = np.array([[1.0, -0.7], [60.0, -0.7], [np.nan, 0.0], [1.0, -9.0]])
    found = supported(optimum.evaluator, thetas)
    np.testing.assert_array_equal(found, [True, False, False, False])
    everywhere = supported(Evaluator.of(build(prb.Resimulated(64))), thetas)
    np.testing.assert_array_equal(everywhere, [True, True, False, True])
