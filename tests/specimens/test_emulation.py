"""The emulator of a response near specimens, and what its error does to their populations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prbayes._validate import Floats
from prbayes.metrics.readings import Readings
from prbayes.propagation.base import DesignError
from prbayes.specimens.emulation import (
    DifferencedResponse,
    Emulation,
    fit_surface,
    half_difference,
    near_readings,
    predicted_bias,
)

DATA = Readings.exact(np.linspace(-0.5, 0.5, 9)[:, None])
NEAR = np.linspace(-0.5, 0.5, 11)[:, None]


def cubic(z: Floats) -> Floats:
    return z + z**3


def test_differences_are_the_jacobian() -> None:
    def response(z: Floats) -> Floats:
        return np.stack([np.exp(z[:, 0]) * z[:, 1], z[:, 0] ** 2], axis=1)

    z = np.random.default_rng(0).standard_normal((5, 2))
    values, jacobian = DifferencedResponse(response)(z)
    assert np.array_equal(values, response(z))
    e = np.exp(z[:, 0])
    exact = np.stack([e * z[:, 1], e, 2 * z[:, 0], 0 * e], axis=1).reshape(5, 2, 2)
    np.testing.assert_allclose(jacobian, exact, atol=1e-8)


def test_a_huge_response_and_equal_runs_cost_no_digits() -> None:
    z = np.linspace(-1, 1, 41)[:, None]
    y = cubic(z)
    y[-1] = 1e30
    # Twenty runs at one place, to the last digit but one.
    copies = 0.1 + 1e-16 * np.random.default_rng(0).standard_normal((20, 1))
    z, y = np.concatenate([z, copies]), np.concatenate([y, cubic(copies)])
    surface, left_out, is_near = fit_surface(z, y, DATA, "y")
    np.testing.assert_allclose(surface.values(NEAR), cubic(NEAR), atol=0.02)
    assert left_out.shape == y.shape
    assert np.isfinite(left_out).all()
    assert is_near[-20:].all()
    # Of a straight response over a wide prior all runs keep their values.
    z = np.linspace(-1, 1, 41)[:, None]
    surface, *_ = fit_surface(z, 1e9 * z, DATA, "y")
    np.testing.assert_allclose(surface.values(z), 1e9 * z, atol=1)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_there_is_no_response_where_the_nearest_run_has_none(bad: float) -> None:
    z = np.linspace(-1, 1, 21)[:, None]
    y = np.where(z > 0.45, bad, cubic(z))
    surface, left_out, _ = fit_surface(z, y, DATA, "y")
    emulation = Emulation(z, y, surface, np.ones(1), 0.0)
    assert np.isnan(left_out[z > 0.45]).all()
    points = np.array([[0.44], [0.46], [0.9]])
    values, jacobian = emulation(points)
    assert np.isnan(values).ravel().tolist() == [False, True, True]
    assert np.array_equal(values, emulation.values(points), equal_nan=True)
    assert np.array_equal(np.isnan(jacobian[:, 0]), np.isnan(values))
    # A specimen that failed, +inf, is no specimen without a response.
    assert emulation.fails(points).tolist() == [False, True, True]
    assert emulation.is_missing(points).tolist() == [False, np.isnan(bad), np.isnan(bad)]
    assert emulation.box.tolist() == [[-1], [1]]
    assert replace(emulation, ends=np.array([[-2.0], [2.0]])).box.tolist() == [[-2], [2]]


def test_a_response_that_hardly_exists_is_refused() -> None:
    y = np.where(np.arange(40) < 7, 0.1, np.nan)[:, None]
    with pytest.raises(DesignError, match="got 7 runs with a response of 40, expected at least 8"):
        fit_surface(np.linspace(0, 1, 40)[:, None], y, DATA, "y")


def test_runs_near_the_readings() -> None:
    y = np.linspace(-3, 3, 101)[:, None]
    # The range of the readings, and half of it on either side
    assert np.array_equal(near_readings(y, DATA), np.abs(y[:, 0]) < 1 + 1e-9)
    far = Readings.exact(100 + DATA.values)
    assert np.flatnonzero(near_readings(y, far)).tolist() == list(range(76, 101))


# Monte Carlo error: two independent halves of the points.


def test_a_tilt_of_the_log_likelihood_is_half_its_size() -> None:
    rng = np.random.default_rng(0)
    theta = rng.standard_normal(32)
    log_likelihood = rng.standard_normal((32, 20))
    tilted = log_likelihood + 0.3 * (theta / theta.std())[:, None] / 20
    assert half_difference(log_likelihood, tilted)[0] == pytest.approx(0.15)
    assert half_difference(tilted, log_likelihood)[0] == pytest.approx(0.15)
    assert half_difference(log_likelihood, log_likelihood) == (0, 0, 0)
    # a constant does not move the posterior: it counts by itself; nor does the order of draws and specimens matter
    assert half_difference(log_likelihood + 7, tilted)[0] == pytest.approx(0.15)
    assert half_difference(log_likelihood[::-1, ::-1], tilted[::-1, ::-1])[0] == pytest.approx(0.15)


def test_few_populations_with_a_large_error_count_in_the_first_number_alone() -> None:
    logs = np.random.default_rng(0).standard_normal((200, 3))
    other = logs + 0.02 * np.random.default_rng(1).standard_normal((200, 3))
    other[:10] += 5.0
    total, typical, _ = half_difference(logs, other)
    assert total > 0.5
    assert typical == pytest.approx(0.01 * np.sqrt(3), rel=0.3)


def test_a_specimen_without_a_point_in_one_half_is_left_out() -> None:
    logs = np.random.default_rng(0).standard_normal((32, 3))
    other = logs.copy()
    other[:, 1] = -np.inf
    assert half_difference(logs, other) == (0, 0, 0)


# Emulator error: the bias that shifts of the inputs cause.


def test_biases_are_those_of_the_true_inputs() -> None:
    rng = np.random.default_rng(2)
    x = rng.normal(0, [1.0, 3.0], (4000, 2))
    true = 0.1 + x * [0.95, 1.02]
    bias = predicted_bias(true - x, x, 50)
    mean = (x.mean(axis=0) - true.mean(axis=0)) / x.std(axis=0) * np.sqrt(50)
    variance = (1 - true.var(axis=0) / x.var(axis=0)) / 2 * np.sqrt(100)
    assert bias[0] == pytest.approx(mean)
    assert bias[1] == pytest.approx(variance)
    sd = (1 - true.std(axis=0) / x.std(axis=0)) * np.sqrt(100)
    assert bias[1] == pytest.approx(sd, abs=0.03)  # of second order in the change of the sd


def test_inputs_at_one_place_have_an_unknown_bias() -> None:
    assert np.isinf(predicted_bias(np.full((4, 1), 0.1), np.ones((4, 1)), 20)).all()


def test_no_input_is_beside_a_run_that_the_surface_misses() -> None:
    """The surface crosses the readings between the two sides of a pole."""
    z = np.array([*np.linspace(-0.5, 0.5, 11), 2.0, 2.99, 3.01, 4.0])[:, None]
    pole, jump = z.copy(), z.copy()
    pole[12:14], jump[12:14] = [[-1e4], [1e4]], [[-0.5], [0.5]]
    smooth, *_ = fit_surface(z, z, DATA, "y")
    near, *_ = fit_surface(z[:11], z[:11], DATA, "y")
    emulation = Emulation(z, pole, smooth, np.array([0.01]), 0.0)
    assert np.isnan(emulation.values(z)[:, 0]).tolist() == [False] * 12 + [True] * 2 + [False]
    assert np.isnan(emulation(z)[0][12:14]).all()
    # At a jump there are specimens on both sides, and beside runs that the surface leaves out
    # there may be another population.
    assert np.isfinite(replace(emulation, y=jump).values(z)).all()
    assert np.isfinite(replace(emulation, surface=near).values(z)).all()
