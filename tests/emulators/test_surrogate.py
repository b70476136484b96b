"""Surrogates: refusing outside, called like the response, honest in a model."""

import logging
import pickle
import threading
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.emulators.surrogate import hashed_rows
from prbayes.model.evaluator import Evaluator
from prbayes.propagation.base import DesignError
from prbayes.response.failures import Abort, Replace, ResponseError, Retry

BOX = {"x": (0.0, 3.0), "y": (1.0, 2.0)}


def bent(x: Any, y: Any) -> Any:
    return np.sin(x) * y


@pytest.fixture(scope="module")
def surrogate() -> prb.Surrogate:
    return prb.Surrogate.fit(bent, BOX, 64)


def test_outside_is_nan_with_one_warning_or_raises_but_is_never_a_number(
    caplog: pytest.LogCaptureFixture,
) -> None:
    surrogate = prb.Surrogate.fit(bent, BOX, 64)
    with caplog.at_level(logging.WARNING, "prbayes"):
        values = surrogate(np.array([1.0, 3.001, -0.001, np.nan, 3.0]), 1.5)
    assert np.isnan(values).tolist() == [False, True, True, True, False]
    assert "3 of 5 points outside its design: x from" in caplog.text
    assert "expected 0 to 3" in caplog.text
    caplog.clear()
    with caplog.at_level(logging.INFO, "prbayes"):
        assert np.isnan(surrogate(4.0, 1.5))
    assert not caplog.text
    strict = prb.Surrogate.fit(bent, BOX, 32, outside=Abort())
    with pytest.raises(
        ValueError, match=r"1 of 2 points outside its design: y from 2.5 to 2.5, expected 1 to 2"
    ):
        strict(1.0, np.array([1.5, 2.5]))
    failed = prb.Surrogate.fit(bent, BOX, 32, outside=Replace(np.inf))
    assert failed(5.0, 1.5) == np.inf


def test_where_the_nearest_design_point_failed_nothing_is_invented() -> None:
    def response(x: Any, y: Any) -> Any:
        return np.where(x > 2, np.inf, np.where(x < 0.5, np.nan, bent(x, y)))

    found = prb.Surrogate.fit(response, BOX, 128, on_failure=Replace())
    assert np.isnan(found(0.1, 1.5))
    assert found(2.6, 1.5) == np.inf
    assert found(1.2, 1.5) == pytest.approx(bent(1.2, 1.5), abs=0.05)
    assert np.isnan(found.error.residuals).sum() == (~np.isfinite(found.responses)).sum() > 20


def test_executors_give_the_same_and_a_store_computes_nothing_twice(tmp_path: Path) -> None:
    plain = prb.Surrogate.fit(bent, BOX, 32, random_seed=2)
    assert plain.n_runs == 32
    with ThreadPoolExecutor(2) as threads, ProcessPoolExecutor(2) as processes:
        names = set()

        def told(x: float, y: float) -> float:
            names.add(threading.current_thread().name)
            return float(bent(x, y))

        prb.Surrogate.fit(prb.scalar(told), BOX, 32, executor=threads)
        assert threading.main_thread().name not in names
        for executor, response in ((threads, prb.scalar(bent)), (processes, bent)):
            other = prb.Surrogate.fit(response, BOX, 32, random_seed=2, executor=executor)
            np.testing.assert_array_equal(other.responses, plain.responses)
    folder = tmp_path / "runs"
    assert prb.Surrogate.fit(bent, BOX, 32, store=folder).n_runs == 32
    assert prb.Surrogate.fit(bent, BOX, 48, store=folder).n_runs == 16 + 1
    again = prb.Surrogate.fit(bent, BOX, 48, store=folder, model=prb.surrogate.Polynomial(3))
    assert again.n_runs == 1
    with pytest.raises(prb.response.StoreError, match="its variables have changed"):
        prb.Surrogate.fit(lambda x, y: 2 * bent(x, y), BOX, 48, store=folder)
    for runs in (32, 0):
        versioned = prb.Surrogate.fit(bent, BOX, 32, store=folder, version="1")
        assert versioned.n_runs == runs
    assert again.error.rms > 0
    assert (folder / "responses.sqlite").exists()


def test_a_response_that_raises_stops_or_is_left_out(tmp_path: Path) -> None:
    def sometimes(x: float, y: float) -> float:
        if x > 2.8:
            raise RuntimeError("the solver diverged")
        return float(bent(x, y))

    with pytest.raises(
        ResponseError, match=r"crest: the response failed at .* the solver diverged"
    ):
        prb.Surrogate.fit(prb.scalar(sometimes), BOX, 64, name="crest")
    found = prb.Surrogate.fit(prb.scalar(sometimes), BOX, 64, on_failure=Replace())
    failed = found.points[np.isnan(found.responses)]
    assert len(failed) > 2
    assert np.isnan(found(*failed.T)).all()
    with pytest.raises(ResponseError, match="too few"):
        prb.Surrogate.fit(lambda x, y: np.full(x.shape, np.nan), BOX, 64)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"inputs": {}}, TypeError, r"expected a dict such as"),
        ({"inputs": {"x": (3, 0), "y": (1, 2)}}, ValueError, "x: got 3.0 to 0.0, expected a range"),
        ({"inputs": {"x": (0, np.inf), "y": (1, 2)}}, ValueError, "x: got"),
        (
            {"inputs": {"x": (0, 1, 2), "y": (1, 2)}},
            ValueError,
            r"x: got shape \(3,\), expected a range",
        ),
        ({"inputs": {"x": 1, "y": 2}}, ValueError, "constants only"),
        ({"inputs": [pm.Normal.dist(0, 1), (1, 2)]}, TypeError, "no model on the context"),
        ({"n": 4}, ValueError, "n: got 4, expected an integer >="),
        ({"model": prb.surrogate.Polynomial}, TypeError, "an object, not a class"),
        ({"model": "gp"}, TypeError, "expected prb.surrogate.RadialBasis"),
        ({"outside": Retry()}, TypeError, r"expected prb.response.Replace\(\) or"),
        ({"store": 3}, TypeError, "expected the path of a folder"),
        ({"prob": 99.0}, ValueError, "a number between 0 and 1"),
        ({"points": "sobol"}, ValueError, r"points: got 'sobol', expected one of \('even'"),
        ({"points": "predictive"}, ValueError, "got 'predictive' for inputs that are ranges"),
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


def model_with(response: Any, propagation: Any = None) -> pm.Model:
    observed = np.exp(0.3 * np.random.default_rng(1).normal(1.0, 0.5, 40))
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 0.8, 0.5), pm.HalfNormal("sigma", 0.6)
        x = pm.Normal.dist(mu, sigma)
        metric = prb.AreaMetric()
        prb.Simulator(
            "y", response(x), x, metric=metric, observed=observed, propagation=propagation
        )
    return model


@pytest.mark.long
def test_a_calibration_through_a_surrogate_agrees_with_one_without() -> None:
    direct = prb.minimize(model_with(lambda x: lambda x: np.exp(0.3 * x)))
    through = prb.minimize(
        model_with(lambda x: prb.Surrogate.fit(lambda x: np.exp(0.3 * x), [x], 24))
    )
    for name in ("mu", "sigma"):
        assert through.point[name] == pytest.approx(
            direct.point[name], abs=0.02 * direct.stderr[name]
        )
    assert through.support["y"]["lost_mass"] < 0.01


@pytest.mark.long
def test_reweighted_refuses_an_answer_that_rests_on_points_outside() -> None:
    narrow = prb.Surrogate.fit(lambda x: np.exp(0.3 * x), {"x": (-1.5, 1.0)}, 24)
    with pytest.raises(DesignError, match="lost mass"):
        prb.minimize(model_with(lambda x: narrow))


def test_resimulated_stops_at_the_range_when_asked_to() -> None:
    strict = prb.Surrogate.fit(lambda x: np.exp(0.3 * x), {"x": (-1.5, 1.0)}, 24, outside=Abort())
    with pytest.raises(ResponseError, match="outside its design: x from"):
        prb.minimize(model_with(lambda x: strict, prb.Resimulated(64)))
    wide = prb.Surrogate.fit(lambda x: np.exp(0.3 * x), {"x": (-9, 9)}, 48, outside=Abort())
    assert prb.minimize(
        model_with(lambda x: wide, prb.Resimulated(64)), method="Nelder-Mead"
    ).converged


@pytest.mark.parametrize("surface", [None, prb.surrogate.Polynomial(3)])
def test_a_surrogate_survives_plain_pickle(surface: Any) -> None:
    fitted = prb.Surrogate.fit(bent, BOX, 32, model=surface).with_error()
    back = pickle.loads(pickle.dumps(fitted))
    x, y = np.random.default_rng(1).uniform((0, 1), (3, 2), (20, 2)).T
    np.testing.assert_array_equal(back(x, y), fitted(x, y))
    np.testing.assert_array_equal(back.local_error(x, y), fitted.local_error(x, y))


def test_a_model_whose_length_is_unknown_before_it_is_fitted_is_taken() -> None:
    ensemble = pytest.importorskip("sklearn.ensemble")
    forest = ensemble.RandomForestRegressor(n_estimators=5, random_state=0)
    found = prb.Surrogate.fit(bent, BOX, 64, model=forest)
    assert found(1.5, 1.5) == pytest.approx(bent(1.5, 1.5), abs=0.3)


def wavy(x: Any, y: Any) -> Any:
    return bent(x, y) + 0.3 * np.sin(12 * x) * np.cos(9 * y)


def coarse_waves(x: Any, y: Any) -> Any:
    return 5 - 4 * wavy(x, y) + y * x


def test_a_coarse_response_is_followed(surrogate: prb.Surrogate) -> None:
    alone = prb.Surrogate.fit(wavy, BOX, 48)
    found = prb.Surrogate.fit(wavy, BOX, 48, coarse=coarse_waves)
    assert found.coarse is coarse_waves
    assert found.error.relative < 0.1 * alone.error.relative
    x, y = np.random.default_rng(2).uniform([[0], [1]], [[3], [2]], (2, 500))
    off, without = found(x, y) - wavy(x, y), alone(x, y) - wavy(x, y)
    assert off.std() < 0.1 * without.std()
    # The error is of surfaces, and of a rho, that do not know the runs that are left out.
    assert 0.5 < found.error.rms / off.std() < 3
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(found))(x, y), found(x, y))
    assert surrogate.coarse is None


def test_a_coarse_response_that_tells_nothing_is_not_followed(surrogate: prb.Surrogate) -> None:
    found = prb.Surrogate.fit(bent, BOX, 64, coarse=lambda x, y: np.sin(70 * x + 60 * y))
    assert found.coarse is None
    assert found(1.0, 1.5) == surrogate(1.0, 1.5)
    np.testing.assert_array_equal(found.error.residuals, surrogate.error.residuals)


def test_where_there_is_no_coarse_response_the_surface_goes_on(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def partly(x: Any, y: Any) -> Any:
        return np.where(x > 2, np.nan, coarse_waves(x, y))

    alone = prb.Surrogate.fit(wavy, BOX, 48)
    found = prb.Surrogate.fit(wavy, BOX, 48, coarse=partly)
    with caplog.at_level(logging.WARNING, "prbayes"):
        values = found([1.0, 2.5], 1.5)
    assert "coarse: got no number at 1 of 2 points" in caplog.text
    assert values[1] == alone(2.5, 1.5)
    assert values[0] == pytest.approx(wavy(1.0, 1.5), abs=0.05)


@pytest.mark.parametrize(
    ("coarse", "error", "told"),
    [
        (3, TypeError, "surrogate: coarse: got int 3, expected a function"),
        (lambda x, y: np.stack([x, y]), ResponseError, r"surrogate: coarse: .* returned shape"),
        (lambda x: x, ResponseError, "surrogate: coarse: got no number at any of 48 points"),
    ],
)
def test_what_is_no_coarse_response_is_refused_before_any_run(
    coarse: Any, error: type[Exception], told: str
) -> None:
    calls: list[int] = []
    with pytest.raises(error, match=told):
        prb.Surrogate.fit(lambda x, y: calls.append(1) or bent(x, y), BOX, 48, coarse=coarse)
    assert not calls


def two(x: Any, y: Any) -> Any:
    return np.stack([bent(x, y), 40 * np.cos(x) - y], axis=-1)


def named(x: Any, y: Any) -> Any:
    return {"bent": bent(x, y), "other": 40 * np.cos(x) - y}


def test_each_of_several_outputs_has_a_surface_of_its_own_through_the_same_runs(
    surrogate: prb.Surrogate,
) -> None:
    found = prb.Surrogate.fit(two, BOX, 64).with_error(1)
    other = prb.Surrogate.fit(lambda x, y: two(x, y)[..., 1], BOX, 64)
    assert (found.n_runs, found.responses.shape) == (64, (64, 2))
    x, y = np.random.default_rng(1).uniform((0, 1), (3, 2), (3, 5, 2)).T
    plain = prb.Surrogate.fit(two, BOX, 64)(x, y)
    assert plain.shape == (5, 3, 2)
    for k, alone in enumerate((surrogate, other)):
        np.testing.assert_array_equal(plain[..., k], alone(x, y))
        near = alone.local_error(x, y)
        np.testing.assert_allclose(found.local_error(x, y)[..., k], near, rtol=1e-12)
        for name in ("rms", "relative", "largest"):
            of_alone = getattr(alone.error, name)
            np.testing.assert_allclose(getattr(found.error, name)[k], of_alone, rtol=1e-12)
    assert str(found.error) == f"{surrogate.error}; {other.error}"
    # The error that is added is that of one run, in all its outputs.
    added = (found(x, y) - plain).reshape(-1, 2)
    runs = np.concatenate([found.error.residuals, -found.error.residuals])
    nearest = np.abs((added[:, None] - runs) / found.error.rms).max(axis=-1).min(axis=1)
    assert (nearest < 1e-9).all()
    assert np.isnan(found(5.0, 1.5)).tolist() == [True, True]


def test_outputs_keep_their_names_also_from_a_store(tmp_path: Path) -> None:
    found = prb.Surrogate.fit(named, BOX, 32, store=tmp_path, version="1")
    assert list(found(1.0, 1.5)) == ["bent", "other"]
    plain = prb.Surrogate.fit(two, BOX, 32)(1.0, 1.5)
    assert list(found(1.0, 1.5).values()) == plain.tolist()
    # A store keeps numbers: one run tells the names.
    again = prb.Surrogate.fit(named, BOX, 32, store=tmp_path, version="1")
    assert (again.n_runs, list(again(1.0, 1.5))) == (1, ["bent", "other"])
    turned = lambda x, y: dict(reversed(named(x, y).items()))  # noqa: E731
    for n in (32, 48):
        with pytest.raises(prb.response.StoreError, match="stored in another order"):
            prb.Surrogate.fit(turned, BOX, n, store=tmp_path, version="1")
    # Refused before it was stored: with more runs all are in their places.
    more = prb.Surrogate.fit(named, BOX, 48, store=tmp_path, version="1")
    assert more.n_runs == 16 + 1
    np.testing.assert_array_equal(more.responses, prb.Surrogate.fit(two, BOX, 48).responses)
    prb.Surrogate.fit(named, BOX, 32, store=tmp_path / "unversioned")
    again = prb.Surrogate.fit(named, BOX, 32, store=tmp_path / "unversioned")
    assert (again.n_runs, list(again(1.0, 1.5))) == (1, ["bent", "other"])
    # So that what was observed may have another order.
    observed = {"other": [20.0, 25.0, 30.0, 22.0], "bent": [1.0, 1.1, 1.2, 1.0]}
    with pm.Model() as model:
        x, y = pm.Normal.dist(pm.Normal("m", 1.0, 0.1), 0.1), pm.Uniform.dist(1.4, 1.6)
        prb.Simulator(
            *("z", found, x, y),
            metric=prb.Joint(prb.AreaMetric()),
            observed=observed,
            propagation=prb.Reweighted(64, emulator=None),
            progressbar=False,
        )
    values = Evaluator.of(model).nodes[0].bound.first_responses
    assert 15 < values[:, 0].mean() < 25
    assert 1 < values[:, 1].mean() < 2


def test_where_one_of_several_outputs_failed_the_run_is_what_it_is() -> None:
    def partly(x: Any, y: Any) -> Any:
        found = two(x, y)
        found[..., 1] = np.where(x > 2, np.inf, found[..., 1])
        return found

    found = prb.Surrogate.fit(partly, BOX, 128)
    values = found([1.2, 2.6], 1.5)
    np.testing.assert_allclose(values[0], two(1.2, 1.5), atol=0.05)
    assert np.isfinite(values).tolist() == [[True, True], [True, False]]
    assert np.isnan(found.error.residuals).all(axis=1).sum() == (found.points[:, 0] > 2).sum()


def test_a_coarse_response_is_for_one_output() -> None:
    with pytest.raises(ResponseError, match=r"beside a response of 2 outputs.*Reweighted"):
        prb.Surrogate.fit(two, BOX, 48, coarse=bent)


def test_a_process_says_many_inputs_better_than_splines_and_as_well_as_it_claims() -> None:
    def many(*x: Any) -> Any:
        return np.exp(0.3 * sum(x)) + np.sin(x[0] * x[1])

    ranges = [(-1.0, 1.0)] * 6
    process = prb.Surrogate.fit(many, ranges, 128, model=prb.surrogate.GaussianProcess())
    splines = prb.Surrogate.fit(many, ranges, 128)
    x = np.random.default_rng(0).uniform(-1, 1, (6, 1000))
    off, of_splines = (np.std(s(*x) - many(*x)) for s in (process, splines))
    assert off < 0.5 * of_splines
    assert 0.5 < process.error.rms / off < 3


def test_a_design_where_populations_are_says_many_inputs_better() -> None:
    def many(*x: Any) -> Any:
        return np.exp(0.3 * sum(x)) + np.sin(x[0] * x[1])

    with pm.Model():
        m = pm.Normal("m", 0.0, 1.0, shape=5)
        inputs = [*(pm.Normal.dist(m[i], 0.5) for i in range(5)), (0.0, 1.0)]
        process = {"model": prb.surrogate.GaussianProcess()}
        there = prb.Surrogate.fit(many, inputs, 128, points="predictive", **process)
        evenly = prb.Surrogate.fit(many, inputs, 128, **process)
    assert there.ranges == evenly.ranges
    # Each by its own distribution, the last one evenly; inside the ranges, which is no warning.
    np.testing.assert_allclose(there.points.std(axis=0)[:5], np.sqrt(1.25), rtol=0.1)
    np.testing.assert_allclose(np.quantile(there.points[:, 5], [0.1, 0.9]), [0.1, 0.9], atol=0.02)
    x = [*(1.0 + 0.5 * np.random.default_rng(0).standard_normal((5, 1000))), 0.5]
    off, before = (np.std(s(*x) - many(*x)) for s in (there, evenly))
    assert off < 0.6 * before


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
