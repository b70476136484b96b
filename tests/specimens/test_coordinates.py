"""Coordinates of the inputs of specimens: their range, bounds and Jacobian."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
import pytest
from scipy.stats import norm

from prbayes.response.inputs import read_inputs
from prbayes.specimens.coordinates import Coordinates


def coordinates(write: Callable[..., list[Any]]) -> Coordinates:
    """Return the coordinates of inputs, which get a factor whose prior is nearly one."""
    with pm.Model() as model:
        inputs = write(pm.Normal("factor", 1.0, 1e-9))
        return Coordinates.of_prior(read_inputs("y", inputs, model))


def three_inputs(factor: Any) -> list[Any]:
    mu = pm.Normal("mu", 3.0, 0.5)
    covariance = np.array([[1.0, 0.6], [0.6, 2.0]])
    return [
        pm.Normal.dist(mu, 2.0),
        pm.LogNormal.dist(mu, 1.0),
        pm.MvNormal.dist(factor * np.array([10.0, -20.0]), covariance),
    ]


THREE = coordinates(three_inputs)


def test_inputs_and_coordinates_are_inverse() -> None:
    z = np.random.default_rng(0).uniform(-1.5, 1.5, (5, 7, 4))
    inputs = THREE.inputs(z)
    assert [x.shape for x in inputs] == [(5, 7), (5, 7), (5, 7, 2)]
    assert THREE.size == 4
    assert THREE.shapes == ((), (), (2,))
    assert np.allclose(THREE.of(inputs, 2), z, atol=1e-12)


def test_the_log_jacobian_is_that_of_differences() -> None:
    z = np.random.default_rng(0).uniform(-1, 1, (6, 4))

    def flat(z: Any) -> Any:
        return np.concatenate([x.reshape(len(z), -1) for x in THREE.inputs(z)], axis=1)

    step = 1e-6
    jacobian = np.stack(
        [(flat(z + step * e) - flat(z - step * e)) / (2 * step) for e in np.eye(4)], axis=2
    )
    assert np.allclose(THREE.log_jacobian(z), np.log(np.abs(np.linalg.det(jacobian))), atol=1e-7)


def test_the_prior_range_is_from_minus_one_to_one() -> None:
    one = coordinates(lambda factor: [pm.Normal.dist(pm.Normal("mu", 5.0, 3.0), 4.0 * factor)])
    # The prior predictive distribution is N(5, 5); its .005 quantile is -2.576. Standard error of
    # a quantile of 4096 draws: sqrt(.005 / 4096) / density(2.576) = .077 sd
    assert np.allclose(
        one.inputs(np.array([[-1.0], [1.0]]))[0], [5 - 12.88, 5 + 12.88], atol=5 * 0.39
    )
    assert one.bounds[0, 0] < -1
    assert one.bounds[1, 0] > 1


def test_the_bounds_are_those_of_data_sets_of_the_prior() -> None:
    with pm.Model() as model:
        mu = pm.Normal("mu", 0.0, 1.0)
        inputs = read_inputs("y", [pm.Normal.dist(mu, 1.0)], model)
    few, many = (Coordinates.of_prior(inputs, n, populations=512) for n in (1, 500))
    assert np.array_equal(few.center, many.center)
    assert np.array_equal(few.half_width, many.half_width)
    # The probability that a new data set of 500 specimens exceeds the upper end: 1 in 513 on
    # average over the draws, exponentially distributed.
    population = np.random.default_rng(0).normal(size=(1 << 16, 1))
    ends = np.array([few.inputs(few.bounds)[0][1], many.inputs(many.bounds)[0][1]])
    exceeded = -np.expm1(500 * norm.logcdf(ends, population, 1)).mean(axis=0)
    assert exceeded[0] > 20 / 513
    assert exceeded[1] < 5 / 513


@pytest.mark.parametrize(
    ("dist", "is_log"),
    [
        (lambda f: pm.LogNormal.dist(0.0, 0.2 * f), False),  # ratio of the ends exp(1.03) = 2.8
        (lambda f: pm.LogNormal.dist(0.0, 0.5 * f), True),  # exp(2.6) = 13
        (lambda f: pm.Normal.dist(0.0, 100.0 * f), False),  # has negative values
        (lambda f: pm.Gamma.dist(0.008 * f, 1.0), True),  # a few draws underflow
    ],
)
def test_positive_inputs_over_more_than_a_decade_are_logarithms(dist: Any, is_log: bool) -> None:
    one = coordinates(lambda factor: [dist(factor)])
    assert one.is_log.tolist() == [is_log]
    x = np.array([1.5])
    assert np.allclose(one.inputs(one.of([x], 1))[0], x)


def test_inputs_outside_the_log_range_have_no_number() -> None:
    one = coordinates(lambda factor: [pm.LogNormal.dist(0.0, factor)])
    z = one.of([np.array([-1.0, 0.0, 1.0])], 1).ravel()
    assert np.isnan(z[0])
    assert z[1] == -np.inf
    assert np.isfinite(z[2])


def test_shares_keep_both_ends() -> None:
    def inputs(factor: Any) -> list[Any]:
        even = pm.Uniform.dist(0.0, 1.0 - 1e-6 * factor**2)
        return [pm.Beta.dist(0.3 * factor, 0.3), pm.Beta.dist(2, 90 * factor), even]

    x = coordinates(inputs)
    assert x.is_log.tolist() == [False, True, False]
    of_range = x.inputs(x.ends[:, :1] * np.array([[1.0, 0.0, 0.0]]))[0]
    assert np.allclose(of_range, [0.0, 1.0], atol=1e-12)
    assert np.isinf(x.ends[:, 1:]).all()


def test_runs_stay_within_ends_that_are_the_same_for_all_populations() -> None:
    def write(factor: Any) -> list[Any]:
        return [
            pm.TruncatedNormal.dist(3 * factor, 1.0, lower=1.0, upper=5.0),
            pm.TruncatedNormal.dist(10 * factor, 20.0, lower=0.1, upper=40.0),
            pm.Beta.dist(2 * factor, 3.0),
            pm.Uniform.dist(0.0, factor),
            pm.Normal.dist(factor, 1.0),
        ]

    ended = coordinates(write)
    assert ended.is_log.tolist() == [False, True, False, False, False]
    far = np.array([[-50.0] * 5, [50.0] * 5])
    low, high = np.transpose(ended.inputs(ended.within(far)))
    np.testing.assert_allclose([low[:2], high[:2]], [[1.0, 0.1], [5.0, 40.0]], rtol=1e-7)
    assert low[0] > 1.0
    assert high[1] < 40.0
    # At the end of a Beta variable the density may be infinite, and the response too.
    assert 0 < low[2] < 0.01
    assert 0.9 < high[2] < 1
    assert low[3] == pytest.approx(0.0, abs=1e-7)
    assert high[3] > 10
    assert low[4] < -20
    inner = np.full((3, 5), 0.2)
    np.testing.assert_array_equal(ended.within(inner), inner)


@pytest.mark.parametrize(
    "dist",
    [
        lambda factor: pm.Truncated.dist(pm.Gamma.dist(factor, 1.0), upper=4.0),
        lambda _: pm.TruncatedNormal.dist(mu := pm.LogNormal("mu", 0, 2), 0.05 * mu, upper=90),
    ],
)
def test_a_logarithm_of_an_input_with_an_upper_end_has_no_lower_end(dist: Any) -> None:
    ended = coordinates(lambda factor: [dist(factor)])
    assert ended.is_log.all()
    far = np.array([[-2.0], [0.0], [50.0]])
    (x,) = ended.inputs(ended.within(far))
    assert np.isfinite(x).all()
    assert (x > 0).all()


def test_narrow_inputs_around_zero_have_no_ends() -> None:
    """They are below one as shares are, and have values below zero, as an unknown offset has."""
    x = coordinates(lambda factor: [pm.Normal.dist(0.0, 0.25 * factor)])
    assert np.isinf(x.ends).all()
