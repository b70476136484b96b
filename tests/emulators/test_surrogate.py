"""Surrogates: ranges, failures, stores, models, coarse responses, several outputs and noise."""

import logging
import pickle
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
from bent_response import BOX, bent

import prbayes as prb
from prbayes.emulators.surrogate import hashed_rows
from prbayes.model.evaluator import Evaluator
from prbayes.propagation.base import DesignError
from prbayes.response.failures import Abort, Replace, ResponseError


@pytest.fixture(scope="module")
def surrogate() -> prb.Surrogate:
    return prb.Surrogate.fit(bent, BOX, 64)


def uniform(size: Any, seed: int = 1) -> tuple[Any, Any]:
    """Return points of the ranges."""
    u = np.random.default_rng(seed).random((2, *np.atleast_1d(size)))
    return 3 * u[0], 1 + u[1]


# -- ranges, failures and stores -------------------------------------------------------------------


def test_outside_it_returns_nan_with_one_warning_or_raises(
    caplog: pytest.LogCaptureFixture,
) -> None:
    found = prb.Surrogate.fit(bent, BOX, 64)
    with caplog.at_level(logging.INFO, "prbayes"):
        values = found(np.array([1.0, 3.001, -0.001, np.nan, 3.0]), 1.5)
        assert np.isnan(values).tolist() == [False, True, True, True, False]
        assert "3 of 5 points outside its design: x from" in caplog.text
        caplog.clear()
        assert np.isnan(found(4.0, 1.5))
    assert not caplog.text
    with pytest.raises(ValueError, match=r"1 of 2 points outside .* y from 2.5 to 2.5, expected 1"):
        prb.Surrogate.fit(bent, BOX, 32, outside=Abort())(1.0, np.array([1.5, 2.5]))
    assert prb.Surrogate.fit(bent, BOX, 32, outside=Replace(np.inf))(5.0, 1.5) == np.inf
    with pytest.raises(TypeError, match="got 1 inputs, expected 2: x, y"):
        found(1.0)


def test_executors_give_the_same_and_a_store_computes_nothing_twice(tmp_path: Path) -> None:
    plain = prb.Surrogate.fit(bent, BOX, 32, random_seed=2)
    assert plain.n_runs == 32
    names = set()

    def named_thread(x: float, y: float) -> float:
        names.add(threading.current_thread().name)
        return float(bent(x, y))

    with ThreadPoolExecutor(2) as executor:
        response = prb.scalar(named_thread)
        other = prb.Surrogate.fit(response, BOX, 32, random_seed=2, executor=executor)
    np.testing.assert_array_equal(other.responses, plain.responses)
    assert threading.main_thread().name not in names
    folder = tmp_path / "runs"
    # Three stored runs are computed again, unless there is a version.
    assert [prb.Surrogate.fit(bent, BOX, n, store=folder).n_runs for n in (32, 48)] == [32, 19]
    again = prb.Surrogate.fit(bent, BOX, 48, store=folder, model=prb.surrogate.Polynomial(3))
    assert again.n_runs == 3
    with pytest.raises(prb.response.StoreError, match="its variables have changed"):
        prb.Surrogate.fit(lambda x, y: 2 * bent(x, y), BOX, 48, store=folder)
    for n_runs in (32, 0):
        versioned = prb.Surrogate.fit(bent, BOX, 32, store=folder, version="1")
        assert versioned.n_runs == n_runs


def test_a_response_that_raises_stops_or_is_left_out() -> None:
    def sometimes(x: float, y: float) -> float:
        if x > 2.8:
            raise RuntimeError("the solver diverged")
        return float(bent(x, y))

    with pytest.raises(ResponseError, match=r"crest: the response failed .* the solver diverged"):
        prb.Surrogate.fit(prb.scalar(sometimes), BOX, 64, name="crest")
    found = prb.Surrogate.fit(prb.scalar(sometimes), BOX, 64, on_failure=Replace())
    failed = found.points[np.isnan(found.responses)]
    assert len(failed) > 2
    assert np.isnan(found(*failed.T)).all()
    with pytest.raises(ResponseError, match="too few"):
        prb.Surrogate.fit(lambda x, y: np.full(x.shape, np.nan), BOX, 64)


def scattered(x: Any, y: Any) -> Any:
    return bent(x, y) + GENERATOR.normal(0, 0.1, np.shape(x))


class Hot:
    """A solver that starts from its last result."""

    last = 0.0

    def __call__(self, x: float, y: float) -> float:
        self.last = 0.5 * self.last + float(bent(x, y))
        return self.last


GENERATOR = np.random.default_rng(0)


@pytest.mark.parametrize("response", [scattered, prb.scalar(Hot())])
def test_a_response_with_scatter_or_a_state_is_refused(response: Any) -> None:
    with pytest.raises(ResponseError, match=r"inputs \(x = .*expected the same: it is random"):
        prb.Surrogate.fit(response, BOX, 64)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"inputs": {"x": 1, "y": 2}}, ValueError, "constants only"),
        ({"inputs": [pm.Normal.dist(0, 1), (1, 2)]}, TypeError, "no model on the context"),
        ({"n": 4}, ValueError, "n: got 4, expected an integer >="),
        ({"store": 3}, TypeError, "expected the path of a folder"),
        ({"prob": 99.0}, ValueError, "a number between 0 and 1"),
        ({"points": "predictive"}, ValueError, "got 'predictive' for inputs that are ranges"),
        ({"response": 3}, TypeError, "expected a function"),
        ({"coarse": 3}, TypeError, "coarse: got int 3, expected a function"),
        ({"coarse": lambda x, y: np.stack([x, y])}, ResponseError, "coarse: .* returned shape"),
        ({"coarse": lambda x: x}, ResponseError, "coarse: got no number at any of 64 points"),
    ],
)
def test_wrong_arguments_are_refused_before_the_response_is_computed(
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


# -- in a model ------------------------------------------------------------------------------------


def growth(x: Any) -> Any:
    return np.exp(0.3 * x)


def model_of(response: Any, propagation: Any = None) -> pm.Model:
    """Return a model whose response is made from its input."""
    observed = growth(np.random.default_rng(1).normal(1.0, 0.5, 40))
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0.8, 0.5), pm.HalfNormal("sigma", 0.6))
        data: dict[str, Any] = {"observed": observed, "propagation": propagation}
        prb.Simulator("y", response(x), x, metric=prb.AreaMetric(), **data)
    return model


@pytest.mark.long
def test_a_calibration_through_a_surrogate_agrees_with_one_without() -> None:
    direct = prb.minimize(model_of(lambda x: growth))
    through = prb.minimize(model_of(lambda x: prb.Surrogate.fit(growth, [x], 24)))
    for name in ("mu", "sigma"):
        tolerance = 0.02 * direct.stderr[name]
        assert through.point[name] == pytest.approx(direct.point[name], abs=tolerance)
    assert through.search.support["y"]["lost_mass"] < 0.01


@pytest.mark.long
def test_reweighted_refuses_an_answer_that_rests_on_points_outside() -> None:
    narrow = prb.Surrogate.fit(growth, {"x": (-1.5, 1.0)}, 24)
    with pytest.raises(DesignError, match=r"lost mass|no run has a finite response"):
        prb.minimize(model_of(lambda x: narrow))


def test_resimulated_stops_at_the_range_if_it_aborts() -> None:
    strict = prb.Surrogate.fit(growth, {"x": (-1.5, 1.0)}, 24, outside=Abort())
    model = model_of(lambda x: strict, propagation=prb.Resimulated(64))
    with pytest.raises(ResponseError, match="outside its design: x from"):
        Evaluator.of(model)(np.array([[1.0, 0.0]]))


# -- a coarse response -----------------------------------------------------------------------------


def wavy(x: Any, y: Any) -> Any:
    return bent(x, y) + 0.3 * np.sin(12 * x) * np.cos(9 * y)


def coarse_waves(x: Any, y: Any) -> Any:
    return 5 - 4 * wavy(x, y) + y * x


def test_a_coarse_response_is_followed(caplog: pytest.LogCaptureFixture) -> None:
    alone = prb.Surrogate.fit(wavy, BOX, 48)
    found = prb.Surrogate.fit(wavy, BOX, 48, coarse=coarse_waves)
    assert found.coarse is coarse_waves
    assert found.error.relative < 0.1 * alone.error.relative
    points = uniform(500)
    off, without = found(*points) - wavy(*points), alone(*points) - wavy(*points)
    assert off.std() < 0.1 * without.std()
    # The error is of surfaces, and of a rho, without the runs that are left out.
    assert 0.5 < found.error.rms / off.std() < 3
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(found))(*points), found(*points))
    # Where the coarse response fails, the surface of the response itself serves.
    partial = prb.Surrogate.fit(
        wavy, BOX, 48, coarse=lambda x, y: np.where(x > 2, np.nan, coarse_waves(x, y))
    )
    with caplog.at_level(logging.WARNING, "prbayes"):
        values = partial([1.0, 2.5], 1.5)
    assert "coarse: got no number at 1 of 2 points" in caplog.text
    assert values[1] == pytest.approx(alone(2.5, 1.5), rel=1e-12)
    assert values[0] == pytest.approx(wavy(1.0, 1.5), abs=0.05)


def test_an_unrelated_coarse_response_is_not_followed(surrogate: prb.Surrogate) -> None:
    found = prb.Surrogate.fit(bent, BOX, 64, coarse=lambda x, y: np.sin(70 * x + 60 * y))
    assert found.coarse is None
    assert found(1.0, 1.5) == surrogate(1.0, 1.5)
    np.testing.assert_array_equal(found.error.residuals, surrogate.error.residuals)
    with pytest.raises(ResponseError, match=r"beside a response of 2 outputs.*to each output"):
        prb.Surrogate.fit(two, BOX, 48, coarse=bent)


# -- several outputs -------------------------------------------------------------------------------


def two(x: Any, y: Any) -> Any:
    return np.stack([bent(x, y), 40 * np.cos(x) - y], axis=-1)


def named(x: Any, y: Any) -> Any:
    return {"bent": bent(x, y), "other": 40 * np.cos(x) - y}


def test_each_of_several_outputs_has_a_surface_through_the_same_runs(
    surrogate: prb.Surrogate,
) -> None:
    plain = prb.Surrogate.fit(two, BOX, 64)
    noisy = plain.with_error(1)
    other = prb.Surrogate.fit(lambda x, y: two(x, y)[..., 1], BOX, 64)
    points = uniform((5, 3))
    values = plain(*points)
    assert (plain.n_runs, values.shape) == (64, (5, 3, 2))
    for k, alone in enumerate((surrogate, other)):
        np.testing.assert_allclose(values[..., k], alone(*points), rtol=1e-11)
        local = noisy.local_error(*points)[..., k]
        np.testing.assert_allclose(local, alone.local_error(*points), rtol=1e-9)
        for name in ("rms", "relative", "largest"):
            found, expected = getattr(noisy.error, name)[k], getattr(alone.error, name)
            np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert str(plain.error) == f"{surrogate.error}; {other.error}"
    # The error that is added is that of one run, in all its outputs.
    added = (noisy(*points) - values).reshape(-1, 2)
    runs = np.concatenate([noisy.error.residuals, -noisy.error.residuals])
    nearest = np.abs((added[:, None] - runs) / noisy.error.rms).max(axis=-1).min(axis=1)
    assert (nearest < 1e-9).all()
    assert np.isnan(plain(5.0, 1.5)).all()


def test_outputs_keep_their_names_also_from_a_store(tmp_path: Path) -> None:
    versioned: dict[str, Any] = {"store": tmp_path, "version": "1"}
    found = prb.Surrogate.fit(named, BOX, 32, **versioned)
    expected = dict(zip(["bent", "other"], prb.Surrogate.fit(two, BOX, 32)(1.0, 1.5), strict=True))
    assert found(1.0, 1.5) == expected
    # A store contains numbers: one run gives the names.
    again = prb.Surrogate.fit(named, BOX, 32, **versioned)
    assert (again.n_runs, again(1.0, 1.5)) == (1, expected)
    for n in (32, 48):
        with pytest.raises(prb.response.StoreError, match="stored in another order"):
            prb.Surrogate.fit(lambda x, y: dict(reversed(named(x, y).items())), BOX, n, **versioned)
    # Refused before it was stored: with more runs all are in their places.
    more = prb.Surrogate.fit(named, BOX, 48, **versioned)
    assert more.n_runs == 16 + 1
    np.testing.assert_array_equal(more.responses, prb.Surrogate.fit(two, BOX, 48).responses)
    # The observed outputs may have another order.
    with pm.Model() as model:
        x, y = pm.Normal.dist(pm.Normal("m", 1.0, 0.1), 0.1), pm.Uniform.dist(1.4, 1.6)
        prb.Simulator(
            *("z", found, x, y),
            metric=prb.Joint(prb.AreaMetric()),
            observed={"other": [20.0, 25.0, 30.0, 22.0], "bent": [1.0, 1.1, 1.2, 1.0]},
            propagation=prb.Reweighted(64, emulator=None),
            progressbar=False,
        )
    means = Evaluator.of(model).nodes[0].bound.first_responses.mean(axis=0)
    assert 15 < means[0] < 25
    assert 1 < means[1] < 2


def test_a_run_with_a_failed_output_has_the_others() -> None:
    def partly(x: Any, y: Any) -> Any:
        return np.where((x[..., None] > 2) & [False, True], np.inf, two(x, y))

    found = prb.Surrogate.fit(partly, BOX, 128)
    values = found([1.2, 2.6], 1.5)
    np.testing.assert_allclose(values[0], two(1.2, 1.5), atol=0.05)
    assert np.isfinite(values).tolist() == [[True, True], [True, False]]
    assert np.isnan(found.error.residuals).all(axis=1).sum() == (found.points[:, 0] > 2).sum()


# -- many inputs -----------------------------------------------------------------------------------


def many(*x: Any) -> Any:
    return np.exp(0.3 * sum(x)) + np.sin(x[0] * x[1])


def spread(surrogate: prb.Surrogate, x: Any) -> float:
    return float(np.std(surrogate(*x) - many(*x)))


def test_a_process_predicts_many_inputs_better_than_splines() -> None:
    ranges = [(-1.0, 1.0)] * 6
    process = prb.Surrogate.fit(many, ranges, 128, model=prb.surrogate.GaussianProcess())
    x = np.random.default_rng(0).uniform(-1, 1, (6, 1000))
    assert spread(process, x) < 0.5 * spread(prb.Surrogate.fit(many, ranges, 128), x)
    assert 0.5 < process.error.rms / spread(process, x) < 3


def test_a_design_where_populations_are_predicts_many_inputs_better() -> None:
    with pm.Model():
        m = pm.Normal("m", 0.0, 1.0, shape=5)
        inputs = [*(pm.Normal.dist(m[i], 0.5) for i in range(5)), (0.0, 1.0)]
        process = prb.surrogate.GaussianProcess()
        there, evenly = (
            prb.Surrogate.fit(many, inputs, 96, points=points, model=process)
            for points in ("predictive", "even")
        )
    assert there.ranges == evenly.ranges
    # Each by its own distribution, the last one evenly; inside the ranges, which is no warning.
    np.testing.assert_allclose(there.points.std(axis=0)[:5], np.sqrt(1.25), rtol=0.1)
    np.testing.assert_allclose(np.quantile(there.points[:, 5], [0.1, 0.9]), [0.1, 0.9], atol=0.02)
    x = [*(1.0 + 0.5 * np.random.default_rng(0).standard_normal((5, 1000))), 0.5]
    assert spread(there, x) < 0.7 * spread(evenly, x)


# -- noise -----------------------------------------------------------------------------------------


def test_noise_is_the_residuals_nearby_and_the_same_for_the_same_input() -> None:
    plain = prb.Surrogate.fit(bent, BOX, 64, model=prb.surrogate.Polynomial(2))
    noisy = plain.with_error(1)
    x, y = uniform(4000)
    added = noisy(x, y) - plain(x, y)
    np.testing.assert_array_equal(noisy(x[::-1], y[::-1])[::-1], noisy(x, y))
    assert noisy(x[7], y[7]) == noisy(x, y)[7]
    nearest = np.abs(np.abs(added[:, None]) - np.abs(plain.error.residuals)).min(axis=1)
    np.testing.assert_allclose(nearest, 0, atol=1e-12)
    assert abs(added.mean()) < 5 * added.std() / np.sqrt(4000)
    local = np.sqrt(np.mean(plain.local_error(x, y) ** 2))
    assert np.sqrt(np.mean(added**2)) == pytest.approx(local, rel=0.06)
    assert np.mean(plain.with_error(2)(x, y) == noisy(x, y)) < 0.2


def test_hashes_of_equal_rows_are_equal_and_their_bits_are_even() -> None:
    x = np.array([[0.0, 1.0], [-0.0, 1.0], [1.0, 0.0], [0.0, np.nextafter(1.0, 2.0)]])
    numbers = hashed_rows(x, 1)
    assert numbers[0] == numbers[1]
    assert len(set(numbers.tolist())) == 3
    assert (hashed_rows(x, 2) != numbers).all()
    numbers = hashed_rows(np.linspace(0, 1, 20_000)[:, None], 0)
    bits = numbers[:, None] >> np.arange(64, dtype=np.uint64) & np.uint64(1)
    # 64 shares with a standard error of .5 / sqrt(20000) = .0035.
    assert np.abs(bits.mean(axis=0) - 0.5).max() < 5 * 0.0035
