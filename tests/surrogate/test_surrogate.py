"""Surrogates: exact where a surface can be, refusing outside, saved without pickle, honest about their error."""

from __future__ import annotations

import logging
import threading
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF
from sklearn.linear_model import Ridge

import prbayes as prb


def bent(x: Any, y: Any) -> Any:
    return np.sin(x) * y


BOX = {"x": (0.0, 3.0), "y": (1.0, 2.0)}


def fresh_points(n: int = 500) -> tuple[Any, Any]:
    u = np.random.default_rng(3).random((2, n))
    return 3 * u[0], 1 + u[1]


@pytest.fixture(scope="module")
def surrogate() -> prb.Surrogate:
    return prb.Surrogate.fit(bent, BOX, 64)


# Surfaces


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_a_polynomial_repeats_a_polynomial_of_its_degree_and_no_higher_one(degree: int) -> None:
    def response(x: Any, y: Any) -> Any:
        return 5.0 - 2 * x**degree + 3 * y ** (degree - 1) * x

    exact = prb.Surrogate.fit(response, BOX, 40, model=prb.Polynomial(degree))
    x, y = fresh_points()
    np.testing.assert_allclose(exact(x, y), response(x, y), atol=1e-10)
    assert exact.error.largest < 1e-10
    if degree > 1:
        poor = prb.Surrogate.fit(response, BOX, 40, model=prb.Polynomial(degree - 1))
        assert poor.error.rms > 0.01


@pytest.mark.parametrize("kernel", ["thin_plate_spline", "cubic", "quintic"])
def test_radial_basis_passes_through_its_points_and_repeats_a_plane(kernel: str) -> None:
    found = prb.Surrogate.fit(bent, BOX, 40, model=prb.RadialBasis(kernel))
    np.testing.assert_allclose(found(*found.points.T), found.responses, atol=1e-8)
    plane = prb.Surrogate.fit(lambda x, y: 2 * x - y + 7, BOX, 40, model=prb.RadialBasis(kernel))
    x, y = fresh_points()
    np.testing.assert_allclose(plane(x, y), 2 * x - y + 7, atol=1e-8)


def test_smoothing_recovers_a_response_below_its_noise() -> None:
    rng = np.random.default_rng(5)
    settings = prb.RadialBasis("thin_plate_spline", smoothing=1e-2)
    noisy = prb.Surrogate.fit(lambda x, y: bent(x, y) + rng.normal(0, 0.05, x.shape), BOX, 256, model=settings)
    x, y = fresh_points()
    assert np.sqrt(np.mean((noisy(x, y) - bent(x, y)) ** 2)) < 0.03
    assert noisy.error.rms == pytest.approx(0.05, rel=0.2)  # se of an rms of 256 is 4%


def test_neighbors_are_near_the_whole_surface(surrogate: prb.Surrogate) -> None:
    local = prb.Surrogate.fit(bent, BOX, 64, model=prb.RadialBasis(neighbors=30))
    x, y = fresh_points()
    assert 0 < np.abs(local(x, y) - surrogate(x, y)).max() < 0.05


def test_a_regressor_of_scikit_learn_serves_and_is_left_unfitted() -> None:
    regressor = GaussianProcessRegressor(RBF(0.5), alpha=1e-8, random_state=0)
    found = prb.Surrogate.fit(lambda x, y: 1e6 + 1e4 * bent(x, y), BOX, 64, model=regressor)
    x, y = fresh_points()
    assert np.sqrt(np.mean((found(x, y) - 1e6 - 1e4 * bent(x, y)) ** 2)) < 100
    assert not hasattr(regressor, "X_train_")


# Error


def test_the_error_is_what_left_out_points_show() -> None:
    """The residuals are those of fits without each tenth of the points, done here by hand with a plane."""
    found = prb.Surrogate.fit(bent, BOX, 20, model=prb.Polynomial(1), seed=4)
    order = np.random.default_rng(4).permutation(20)
    a = np.column_stack([np.ones(20), found.points])
    for fold in np.array_split(order, 10):
        rest = np.setdiff1d(np.arange(20), fold)
        plane = np.linalg.lstsq(a[rest], found.responses[rest])[0]
        np.testing.assert_allclose(found.error.residuals[fold], found.responses[fold] - a[fold] @ plane, atol=1e-12)
    assert found.error.relative == pytest.approx(found.error.rms / found.responses.std())
    assert "% of the population's sd" in str(found.error)


def test_cross_validation_tells_the_error_on_fresh_points_within_a_factor(surrogate: prb.Surrogate) -> None:
    x, y = fresh_points(2000)
    true = np.sqrt(np.mean((surrogate(x, y) - bent(x, y)) ** 2))
    assert true < surrogate.error.rms < 8 * true  # points at the edge, left out, are predicted worse than fresh ones


def test_the_local_error_is_larger_where_the_response_is_rougher() -> None:
    rough = prb.Surrogate.fit(lambda x: np.where(x > 2, np.sin(12 * x), 0.0), {"x": (0.0, 4.0)}, 40)
    smooth, wild = rough.local_error(np.array([0.5, 3.5]))
    assert smooth < 0.05 * wild
    assert rough.local_error(np.zeros((2, 3))).shape == (2, 3)


def test_noise_is_the_residuals_nearby_and_the_same_for_the_same_input() -> None:
    plain = prb.Surrogate.fit(bent, BOX, 64, model=prb.Polynomial(2))
    noisy = plain.with_error(1)
    x, y = fresh_points(4000)
    added = noisy(x, y) - plain(x, y)
    np.testing.assert_array_equal(noisy(x[::-1], y[::-1])[::-1], noisy(x, y))
    assert noisy(x[7], y[7]) == noisy(x, y)[7]
    np.testing.assert_allclose(
        np.abs(np.abs(added[:, None]) - np.abs(plain.error.residuals)).min(axis=1), 0, atol=1e-12
    )
    assert abs(added.mean()) < 5 * added.std() / np.sqrt(4000)
    assert np.sqrt(np.mean(added**2)) == pytest.approx(np.sqrt(np.mean(plain.local_error(x, y) ** 2)), rel=0.06)
    assert np.mean(plain.with_error(2)(x, y) == noisy(x, y)) < 0.2
    assert len(np.unique(added.round(12))) > 50


def test_noise_widens_a_population_by_the_error() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(1.5, 0.3, 20_000), rng.normal(1.5, 0.1, 20_000)
    plain = prb.Surrogate.fit(bent, BOX, 64, model=prb.Polynomial(1), outside=prb.Abort())
    x, y = np.clip(x, 0, 3), np.clip(y, 1, 2)
    more = plain.with_error()(x, y).var() - plain(x, y).var()
    local = np.mean(plain.local_error(x, y) ** 2)
    assert more == pytest.approx(local, rel=0.1)
    assert plain.with_error()(x, y).std() > 1.5 * plain(x, y).std()


# Shapes and inputs


def test_any_leading_shape_and_broadcasting(surrogate: prb.Surrogate) -> None:
    assert surrogate(1.0, 1.5).shape == ()
    grid = surrogate(np.linspace(0, 3, 4)[:, None], np.linspace(1, 2, 5))
    assert grid.shape == (4, 5)
    assert grid[2, 3] == pytest.approx(float(surrogate(2.0, 1.75)), rel=1e-12)


def test_a_multivariate_input_has_its_event_axis_last() -> None:
    with pm.Model():
        mean = pm.Normal("mean", 0, 1, shape=2)
        pair = pm.MvNormal.dist(mean, np.eye(2))
        found = prb.Surrogate.fit(lambda v, a: v[..., 0] - a * v[..., 1], [pair, 3.0], 40, model=prb.Polynomial(1))
    v = np.random.default_rng(0).normal(size=(3, 4, 2))
    np.testing.assert_allclose(found(v, 3.0), v[..., 0] - 3 * v[..., 1], atol=1e-9)
    with pytest.raises(ValueError, match=r"got shape \(4, 3\)"):
        found(np.zeros((4, 3)), 3.0)


def test_ranges_cover_the_prior_predictive_and_the_sd_is_its() -> None:
    """x given mu is N(mu, 1), mu is N(5, 2): together N(5, sd sqrt(5))."""
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 5, 2), 1.0)
        found = prb.Surrogate.fit(lambda x: 2 * x, [x], 20, model=prb.Polynomial(1), coverage=0.9)
    low, high = found.ranges[found.names[0]]
    # 512 populations: se of the mean 0.09, of the sd 3%
    assert (low + high) / 2 == pytest.approx(5, abs=0.4)
    assert (high - low) / 2 == pytest.approx(1.645 * np.sqrt(5), rel=0.12)
    trimmed = 2 * np.sqrt(5) * 0.79  # sd of a normal between its 5% and 95% quantiles
    assert found.error.population_sd == pytest.approx(trimmed, rel=0.12)


def test_a_model_variable_and_a_range_beside_a_distribution() -> None:
    with pm.Model():
        common = pm.Uniform("common", 1, 2)
        x = pm.Normal.dist(common, 1.0)
        found = prb.Surrogate.fit(lambda x, c, r: x + c * r, {"x": x, "c": common, "r": (0, 1)}, 40)
    assert found.names == ("x", "c", "r")
    low, high = found.ranges["c"]
    assert (low, high) == pytest.approx((1, 2), abs=0.02)
    assert found.ranges["r"] == (0, 1)


def test_a_constant_stays_constant() -> None:
    found = prb.Surrogate.fit(lambda x, m: x**m, {"x": (1, 2), "m": 3}, 32)
    assert found(1.5, 3) == pytest.approx(1.5**3, rel=1e-3)
    assert np.isnan(found(1.5, 2.5))


# Outside


def test_outside_is_nan_with_a_warning_or_raises_but_is_never_a_number(
    surrogate: prb.Surrogate, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "prbayes"):
        values = surrogate(np.array([1.0, 3.001, -0.001, np.nan, 3.0]), 1.5)
    assert np.isnan(values).tolist() == [False, True, True, True, False]
    assert "3 of 5 points outside its design: x from" in caplog.text
    assert "expected 0 to 3" in caplog.text
    strict = prb.Surrogate.fit(bent, BOX, 32, outside=prb.Abort())
    with pytest.raises(ValueError, match=r"1 of 2 points outside its design: y from 2.5 to 2.5, expected 1 to 2"):
        strict(1.0, np.array([1.5, 2.5]))
    failed = prb.Surrogate.fit(bent, BOX, 32, outside=prb.Replace(np.inf))
    assert failed(5.0, 1.5) == np.inf


def test_where_the_nearest_design_point_failed_nothing_is_invented() -> None:
    def response(x: Any, y: Any) -> Any:
        return np.where(x > 2, np.inf, np.where(x < 0.5, np.nan, bent(x, y)))

    found = prb.Surrogate.fit(response, BOX, 128, on_failure=prb.Replace())
    assert np.isnan(found(0.1, 1.5))
    assert found(2.6, 1.5) == np.inf
    assert found(1.2, 1.5) == pytest.approx(bent(1.2, 1.5), abs=0.05)
    assert np.isnan(found.error.residuals).sum() == (~np.isfinite(found.responses)).sum() > 20


# Calling


def test_executors_give_the_same_and_a_store_computes_nothing_twice(tmp_path: Path) -> None:
    plain = prb.Surrogate.fit(bent, BOX, 32, seed=2)
    assert plain.n_runs == 32
    with ThreadPoolExecutor(2) as threads, ProcessPoolExecutor(2) as processes:
        names = set()

        def told(x: float, y: float) -> float:
            names.add(threading.current_thread().name)
            return float(bent(x, y))

        prb.Surrogate.fit(prb.scalar(told), BOX, 32, executor=threads)
        assert threading.main_thread().name not in names
        for executor, response in ((threads, prb.scalar(bent)), (processes, bent)):
            other = prb.Surrogate.fit(response, BOX, 32, seed=2, executor=executor)
            np.testing.assert_array_equal(other.responses, plain.responses)
    folder = tmp_path / "runs"
    assert prb.Surrogate.fit(bent, BOX, 32, store=folder).n_runs == 32
    assert prb.Surrogate.fit(bent, BOX, 48, store=folder).n_runs == 16
    again = prb.Surrogate.fit(bent, BOX, 48, store=folder, model=prb.Polynomial(3))
    assert again.n_runs == 0
    assert again.error.rms > 0
    assert (folder / "responses.sqlite").exists()


def test_a_response_that_raises_stops_or_is_left_out(tmp_path: Path) -> None:
    def sometimes(x: float, y: float) -> float:
        if x > 2.8:
            raise RuntimeError("the solver diverged")
        return float(bent(x, y))

    with pytest.raises(prb.ResponseError, match=r"crest: the response failed at .* the solver diverged"):
        prb.Surrogate.fit(prb.scalar(sometimes), BOX, 64, name="crest")
    found = prb.Surrogate.fit(prb.scalar(sometimes), BOX, 64, on_failure=prb.Replace())
    failed = found.points[np.isnan(found.responses)]
    assert len(failed) > 2
    assert np.isnan(found(*failed.T)).all()
    with pytest.raises(prb.ResponseError, match="too few"):
        prb.Surrogate.fit(lambda x, y: np.full(x.shape, np.nan), BOX, 64)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"inputs": {}}, TypeError, r"expected a dict such as"),
        ({"inputs": {"x": (3, 0), "y": (1, 2)}}, ValueError, "x: got 3.0 to 0.0, expected a range"),
        ({"inputs": {"x": (0, np.inf), "y": (1, 2)}}, ValueError, "x: got"),
        ({"inputs": {"x": (0, 1, 2), "y": (1, 2)}}, ValueError, r"x: got shape \(3,\), expected a range"),
        ({"inputs": {"x": 1, "y": 2}}, ValueError, "constants only"),
        ({"inputs": [pm.Normal.dist(0, 1), (1, 2)]}, TypeError, "no model on the context"),
        ({"n": 4}, ValueError, "n: got 4, expected an integer >="),
        ({"model": prb.Polynomial}, TypeError, "an object, not a class"),
        ({"model": "gp"}, TypeError, "expected prb.RadialBasis"),
        ({"outside": prb.Retry()}, TypeError, r"expected prb.Replace\(\) or prb.Abort"),
        ({"store": 3}, TypeError, "expected the path of a folder"),
        ({"coverage": 99.0}, ValueError, "a share between 0 and 1"),
        ({"response": 3}, TypeError, "expected a function"),
    ],
)
def test_bad_input_is_refused_before_the_response_is_computed(
    change: dict[str, Any], error: type[Exception], message: str
) -> None:
    called = []

    def response(x: Any, y: Any) -> Any:
        called.append(1)
        return bent(x, y)

    arguments = {"response": response, "inputs": BOX, "n": 64} | change
    with pytest.raises(error, match=message):
        prb.Surrogate.fit(**arguments)
    assert not called


def test_wrong_number_of_inputs(surrogate: prb.Surrogate) -> None:
    with pytest.raises(TypeError, match="got 1 inputs, expected 2: x, y"):
        surrogate(1.0)
    with pytest.raises(ValueError, match="kernel: got 'gauss'"):
        prb.RadialBasis("gauss")
    with pytest.raises(ValueError, match="degree: got 0"):
        prb.RadialBasis("cubic", degree=0)


# Files


@pytest.mark.parametrize("model", [prb.RadialBasis("quintic", smoothing=1e-6), prb.Polynomial(3)])
def test_saved_and_loaded_it_is_the_same(tmp_path: Path, model: Any) -> None:
    found = prb.Surrogate.fit(bent, {"x": (0, 3), "y": (1, 2)}, 48, model=model, outside=prb.Replace(7.0)).with_error(3)
    found.save(tmp_path / "s.nc")
    back = prb.Surrogate.load(tmp_path / "s.nc")
    x, y = fresh_points()
    np.testing.assert_array_equal(back(x, y), found(x, y))
    assert back(99.0, 1.0) == 7.0
    assert (back.model, back.n_runs, back.names, back.ranges) == (model, 48, found.names, found.ranges)
    assert back.error.rms == found.error.rms
    assert back.error.population_sd == found.error.population_sd


def test_multivariate_constant_and_abort_survive_a_file(tmp_path: Path) -> None:
    with pm.Model():
        pair = pm.MvNormal.dist(pm.Normal("m", 0, 1, shape=2), np.eye(2))
        found = prb.Surrogate.fit(lambda v, a: a * v.sum(-1), [pair, 2.0], 30, outside=prb.Abort())
    found.save(tmp_path / "s.nc")
    back = prb.Surrogate.load(tmp_path / "s.nc")
    v = np.array([[0.1, 0.2], [0.5, -1.0]])
    np.testing.assert_array_equal(back(v, 2.0), found(v, 2.0))
    with pytest.raises(ValueError, match="outside its design"):
        back(v, 1.0)


def test_a_regressor_is_passed_again_at_load(tmp_path: Path) -> None:
    regressor = Ridge(alpha=1e-6)
    found = prb.Surrogate.fit(bent, BOX, 48, model=regressor)
    found.save(tmp_path / "s.nc")
    with pytest.raises(TypeError, match="expected the Ridge it was fitted with; pass model="):
        prb.Surrogate.load(tmp_path / "s.nc")
    back = prb.Surrogate.load(tmp_path / "s.nc", model=Ridge(alpha=1e-6))
    x, y = fresh_points()
    np.testing.assert_allclose(back(x, y), found(x, y))
    with pytest.raises(ValueError, match="gives other values than the Ridge that was saved"):
        prb.Surrogate.load(tmp_path / "s.nc", model=Ridge(alpha=10.0))


def test_what_is_no_surrogate_is_refused(tmp_path: Path) -> None:
    (tmp_path / "s.nc").write_bytes(b"not a file of this kind")
    with pytest.raises(prb.StoreError, match="no surrogate that can be read"):
        prb.Surrogate.load(tmp_path / "s.nc")


# In a model


def model_with(response: Any, propagation: Any = None) -> pm.Model:
    observed = np.exp(0.3 * np.random.default_rng(1).normal(1.0, 0.5, 40))
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 0.8, 0.5), pm.HalfNormal("sigma", 0.6)
        x = pm.Normal.dist(mu, sigma)
        metric = prb.AreaMetric()
        prb.Simulator("y", response(x), x, metric=metric, observed=observed, propagation=propagation)
    return model


def test_a_calibration_through_a_surrogate_agrees_with_one_without() -> None:
    direct = prb.minimize(model_with(lambda x: lambda x: np.exp(0.3 * x)))
    through = prb.minimize(model_with(lambda x: prb.Surrogate.fit(lambda x: np.exp(0.3 * x), [x], 24)))
    for name in ("mu", "sigma"):
        assert through.point[name] == pytest.approx(direct.point[name], abs=0.02 * direct.stderr[name])
    assert through.support["y"]["lost_mass"] < 0.01


def test_reweighted_refuses_an_answer_that_rests_on_points_outside() -> None:
    narrow = prb.Surrogate.fit(lambda x: np.exp(0.3 * x), {"x": (-1.5, 1.0)}, 24)
    with pytest.raises(prb.DesignError, match="lost mass"):
        prb.minimize(model_with(lambda x: narrow))


def test_resimulated_stops_at_the_range_when_asked_to() -> None:
    strict = prb.Surrogate.fit(lambda x: np.exp(0.3 * x), {"x": (-1.5, 1.0)}, 24, outside=prb.Abort())
    with pytest.raises(prb.ResponseError, match="outside its design: x from"):
        prb.minimize(model_with(lambda x: strict, prb.Resimulated(64)))
    wide = prb.Surrogate.fit(lambda x: np.exp(0.3 * x), {"x": (-9, 9)}, 48, outside=prb.Abort())
    assert prb.minimize(model_with(lambda x: wide, prb.Resimulated(64)), method="Nelder-Mead").converged
