"""Modes of specimens where an emulator without runs reaches the readings, and the response does not."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.model.emulated import emulated_simulators
from prbayes.model.specimen_preparation import prepared


def model_of(
    response: Callable[..., Any], prior: tuple[Any, Any], x: Any, error: float | None = None
) -> Any:
    """Return the model of specimens with inputs (N, d)."""
    d = x.shape[1]
    with pm.Model() as model:
        mu = pm.Normal("mu", *prior, shape=d)
        sigma = pm.HalfNormal("sigma", 1, shape=d)
        inputs = [pm.Normal.dist(mu[k], sigma[k]) for k in range(d)]
        metric = prb.LogLikelihood(error=error)
        prb.Simulator("y", response, *inputs, observed=response(*x.T), metric=metric)
    return model


def points(*arguments: Any, error: float | None = None) -> Any:
    """Return the likely inputs of specimens, (N * K,) each, and the shape (N, K, d)."""
    model = model_of(*arguments, error=error)
    (simulator,) = emulated_simulators(model)
    likelihood = simulator.likelihood
    found = prepared(likelihood).points
    z = np.where(np.isfinite(found.log_a)[..., None], found.z, np.nan)
    return likelihood.coordinates.inputs(z.reshape(-1, z.shape[2])), z.shape


ONE_INPUT: dict[str, tuple[Callable[[Any], Any], int, float, float, tuple[float, float]]] = {
    "increasing": (lambda x: np.log1p(np.exp(x)), 34, 1.67, 0.17, (1.54, 3.0)),
    "decreasing": (lambda x: 5 * np.exp(-x), 29, 3.47, 0.29, (3.39, 2.0)),
}


@pytest.mark.parametrize("name", ONE_INPUT)
def test_a_monotone_response_has_one_input_for_each_reading(name: str) -> None:
    response, n, mean, sd, prior = ONE_INPUT[name]
    x = np.random.default_rng(0).normal(mean, sd, (n, 1))
    (found,), shape = points(response, prior, x)
    np.testing.assert_array_less(np.nan_to_num(abs(found.reshape(shape[:2]) - x)), 1e-2)


def test_readings_with_errors_have_inputs_beside_the_true_ones() -> None:
    response, n, mean, sd, prior = ONE_INPUT["increasing"]
    x = np.random.default_rng(0).normal(mean, sd, (n, 1))
    (found,), shape = points(response, prior, x, error=0.01)
    np.testing.assert_array_less(np.nan_to_num(abs(found.reshape(shape[:2]) - x)), 0.2)


def test_an_unknown_error_leaves_no_inputs_that_only_the_emulator_has() -> None:
    rng = np.random.default_rng(47)
    specimens = np.repeat(np.arange(12), rng.integers(1, 6, 12))
    y = np.exp(rng.normal(1.0, 0.4, 12))[specimens] + rng.normal(0, 0.5, len(specimens))
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        metric = prb.LogLikelihood(error=pm.HalfNormal("e", 2))
        prb.Simulator("y", np.exp, x, observed=y, specimens=specimens, metric=metric)
    (simulator,) = emulated_simulators(model)
    found = prepared(simulator.likelihood)
    is_point = np.isfinite(found.points.log_a)
    (inputs,) = simulator.likelihood.coordinates.inputs(found.points.z[is_point])
    away = abs(found.points.outputs[is_point][:, 0] - np.exp(inputs))
    # Points of the largest errors reach outputs of 25, five times the readings. Beyond 30 readings
    # are more than five times the largest error of the central 98 % of its prior away.
    allowed = np.maximum(0.2, 0.05 * np.exp(inputs))
    is_possible = (inputs > -5) & (np.exp(inputs) < 30)
    np.testing.assert_array_less((away / allowed)[is_possible], 1.0)


def test_two_inputs_have_one_mode_for_each_specimen() -> None:
    def response(a: Any, b: Any) -> Any:
        return np.stack([np.exp(0.5 * a), np.log1p(np.exp(b)) + 0.5 * a], axis=-1)

    x = np.random.default_rng(6).normal([2.4, 1.8], [0.3, 0.4], (18, 2))
    found, shape = points(response, ([2.4, 1.6], 2.0), x)
    distance = abs(np.stack(found, axis=-1).reshape(shape) - x[:, None])
    np.testing.assert_array_less(np.nan_to_num(distance), 2e-2)


@pytest.mark.parametrize(("sd", "seed"), [(0.01, 0), (0.01, 2), (1e-3, 2), (1e-4, 2)])
def test_a_narrow_population_is_not_sought_where_only_the_emulator_has_it(
    sd: float, seed: int
) -> None:
    """A far population without runs may seem likelier than the one that runs have confirmed."""

    def response(a: Any, b: Any) -> Any:
        runs.append(np.size(a))
        first = np.logaddexp(0, 3 * a) + 0.2 * b
        return np.stack([first, b + 0.3 * np.tanh(2 * a)], axis=-1)

    x = np.random.default_rng(seed).normal([0.3, -0.2], sd, (20, 2))
    runs: list[int] = []
    model = model_of(response, ([0.0, 0.0], 1.4), x)
    (simulator,) = emulated_simulators(model)
    likelihood = simulator.likelihood
    found = prepared(likelihood)
    assert sum(runs) <= 170
    at = likelihood.coordinates.of(list(x.T), 1)
    away = np.where(np.isfinite(found.points.log_a)[..., None], found.points.z - at[:, None], 0.0)
    width = likelihood.coordinates.half_width
    np.testing.assert_array_less(abs(away) * width, 0.3 * sd)
    # Newton's method finds no inputs of outputs whose rounding errors are as large as the error,
    # which is 1000 times that at a typical run; at specimens close together it is larger.
    emulation, step = found.emulation, 1e-9
    change = emulation.values(at - step) - 2 * emulation.values(at) + emulation.values(at + step)
    assert (np.median(abs(change), axis=0) < 0.1 * emulation.error).all()


def test_modes_that_exist_stay() -> None:
    """A response with two inputs for each reading, one of them far from the runs."""
    x = np.random.default_rng(0).normal(2.0, 0.2, (20, 1))
    (found,), shape = points(lambda x: x**2, (2.0, 2.0), x)
    roots = found.reshape(shape[:2])
    np.testing.assert_allclose(np.nanmax(roots, axis=1), x[:, 0], atol=1e-3)
    np.testing.assert_allclose(np.nanmin(roots, axis=1), -x[:, 0], atol=1e-3)


@pytest.mark.parametrize(
    ("steepness", "error", "is_reported"),
    [(1.0, None, False), (5.0, None, True), (5.0, 1.0, False)],
)
def test_exact_readings_that_leave_their_input_open_are_reported(
    steepness: float, error: float | None, is_reported: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """Small readings of a response over many orders of magnitude are within the emulator's error."""
    x = np.random.default_rng(16).normal(1.0, 0.8, (40, 1))
    points(lambda x: np.exp(steepness * x), (0.0, 2.0), x, error=error)
    assert ("got an exact reading of specimen" in caplog.text) == is_reported


FOLDED = [0.649, 0.495, 1.824, 0.250, -0.002, 1.334, 0.108, 2.102, 0.348, 1.446, 0.564, -0.102]


@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_inaccurate_readings_at_a_fold_have_inputs_on_both_sides(scale: float) -> None:
    """Mirrored populations have the same likelihood."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", -1.9, 1.9), pm.HalfNormal("sigma", 0.7))
        metric = prb.LogLikelihood(error=0.22 * scale)
        observed = scale * np.array(FOLDED)
        prb.Simulator("y", lambda x: scale * x**2, x, observed=observed, metric=metric)
    logp = model.compile_fn(model.observedlogp)
    for mu, sigma in ((0.8, 0.6), (0.5, 0.4), (1.2, 0.3)):
        both = [logp({"mu": sign * mu, "sigma_log__": np.log(sigma)}) for sign in (1, -1)]
        assert abs(both[0] - both[1]) < 0.05


def test_accurate_readings_have_points_around_modes_far_from_the_population() -> None:
    """Mirrored populations that are narrow: points of the other side were at its lower edge."""
    x = -1.5 + 0.066 * np.random.default_rng(9).standard_normal(24)
    observed = x**2 + 0.041 * np.random.default_rng(10).standard_normal(24)
    with pm.Model() as model:
        inputs = pm.Normal.dist(pm.Normal("mu", -2.0, 2.2), pm.HalfNormal("sigma", 1.0))
        metric = prb.LogLikelihood(error=0.041)
        prb.Simulator("y", lambda x: x**2, inputs, observed=observed, metric=metric)
    logp = model.compile_fn(model.observedlogp)
    for mu, sigma in ((1.5, 0.066), (1.48, 0.05), (1.52, 0.09)):
        both = [logp({"mu": sign * mu, "sigma_log__": np.log(sigma)}) for sign in (1, -1)]
        assert abs(both[0] - both[1]) < 0.05


def test_runs_with_other_outputs_do_not_confirm_a_mode_beside_them() -> None:
    x = np.random.default_rng(0).normal(1.016, 0.0645, (29, 1))
    (found,), shape = points(lambda x: x / np.sqrt(1 + x**2), (1.09, 2.71), x, error=0.002)
    np.testing.assert_array_less(np.nan_to_num(abs(found.reshape(shape[:2]) - x)), 0.1)
