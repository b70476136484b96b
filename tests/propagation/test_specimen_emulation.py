"""Coordinates in which a response is emulated, and guards: their numbers and what they flag."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
import pytest
from scipy.stats import norm

from prbayes._validate import Floats
from prbayes.propagation.specimen_emulation import (
    Coordinates,
    half_difference,
    missing_share,
    predicted_bias,
)
from prbayes.response.inputs import read_inputs


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


# Round trip: simulated specimens should get their inputs back as roots.

BOX = np.array([[-1.0], [4.5]])


def folded(x: Floats) -> Floats:
    return (x - 1) ** 2


def both_roots(y: Floats) -> list[Floats]:
    return [np.array([[1 - root], [1 + root]]) for root in np.sqrt(y[:, 0])]


def upper_root(y: Floats) -> Floats:
    return 1 + np.sqrt(y)[:, None]


def specimens(n: int, seed: int) -> Floats:
    return folded(np.random.default_rng(seed).normal(2, 0.5, (n, 1)))


def test_no_root_is_missing_where_all_are_returned() -> None:
    shares = [missing_share(both_roots, folded, BOX, specimens(20, s), seed=s) for s in range(3)]
    assert shares == [0.0] * 3


def test_the_share_is_that_of_the_missing_root() -> None:
    shares = [missing_share(upper_root, folded, BOX, specimens(20, s), seed=s) for s in range(16)]
    # Responses at inputs of the box near the data: about half of them are at lower roots. Standard
    # error of one share .044, of the mean .011 and more, as the data differ.
    assert np.mean(shares) == pytest.approx(0.469, abs=0.05)
    assert min(shares) > 0.3


def test_a_share_of_failed_searches_is_counted() -> None:
    def find(y: Floats) -> list[Floats]:
        empty = np.empty((0, 1))
        return [empty if i % 4 == 0 else root for i, root in enumerate(both_roots(y))]

    assert missing_share(find, folded, BOX, specimens(20, 0)) == 0.25


def test_only_responses_near_the_data_count() -> None:
    sizes: list[int] = []

    def find(y: Floats) -> list[Floats]:
        sizes.append(len(y))
        assert ((y >= 0.9) & (y <= 2.1)).all()  # a tenth of the range beyond the data
        return both_roots(y)

    missing_share(find, folded, BOX, np.array([[1.0], [2.0], [np.nan]]), n=64)
    assert sizes == [64]
    assert np.isnan(missing_share(find, folded, BOX, np.array([[100.0], [101.0], [102.0]])))


def test_two_outputs_that_are_far_from_all_specimens_together() -> None:
    # Both outputs are in the range of the data everywhere, near them on the diagonal alone.
    y = np.repeat(np.linspace(0, 1, 50)[:, None], 2, axis=1)
    simulated: list[Floats] = []

    def find(values: Floats) -> Floats:
        simulated.append(values)
        return values[:, None]

    assert missing_share(find, lambda x: x, np.array([[0.0, 0.0], [1.0, 1.0]]), y) == 0
    (values,) = simulated
    assert np.abs(values[:, 0] - values[:, 1]).max() < 2 * y[:, 0].std()


# Monte Carlo error: two independent halves of the points.


def test_a_tilt_of_the_log_likelihood_is_half_its_size() -> None:
    rng = np.random.default_rng(0)
    theta = rng.standard_normal(32)
    log_likelihood = rng.standard_normal((32, 20))
    tilted = log_likelihood + 0.3 * (theta / theta.std())[:, None] / 20
    assert half_difference(log_likelihood, tilted) == pytest.approx(0.15)
    assert half_difference(tilted, log_likelihood) == pytest.approx(0.15)
    assert half_difference(log_likelihood, log_likelihood) == 0
    # a constant does not move the posterior, nor does the order of draws and specimens matter
    assert half_difference(log_likelihood + 7, tilted) == pytest.approx(0.15)
    assert half_difference(log_likelihood[::-1, ::-1], tilted[::-1, ::-1]) == pytest.approx(0.15)


# Emulator error: the bias that fresh runs at the roots predict.


def test_a_constant_error_moves_the_mean() -> None:
    x = np.random.default_rng(1).normal(10, 2, (16, 1))
    bias = predicted_bias(np.full((16, 1), 0.3), np.full((16, 1, 1), 1.5), x, 50)
    # The true root is at x - .2: the estimate of the mean is .2 too large.
    assert bias[0] == pytest.approx(0.2 / x.std() * np.sqrt(50))
    assert bias[1] == pytest.approx(0, abs=1e-12)


def test_biases_are_those_of_the_true_roots() -> None:
    rng = np.random.default_rng(2)
    x = rng.normal(0, [1.0, 3.0], (4000, 2))
    jacobian = np.array([[2.0, 0.5], [0.3, -1.0], [1.0, 1.0]])
    true = 0.1 + x * [0.95, 1.02]
    misfit = -(true - x) @ jacobian.T  # run - emulator, both linear
    bias = predicted_bias(misfit, np.tile(jacobian, (4000, 1, 1)), x, 50)
    mean = (x.mean(axis=0) - true.mean(axis=0)) / x.std(axis=0) * np.sqrt(50)
    variance = (1 - true.var(axis=0) / x.var(axis=0)) / 2 * np.sqrt(100)
    assert bias[0] == pytest.approx(mean)
    assert bias[1] == pytest.approx(variance)
    sd = (1 - true.std(axis=0) / x.std(axis=0)) * np.sqrt(100)
    assert bias[1] == pytest.approx(sd, abs=0.03)  # of second order in the change of the sd


def test_bias_has_no_unit() -> None:
    rng = np.random.default_rng(3)
    misfit, x = rng.normal(0, 0.1, (16, 2)), rng.standard_normal((16, 2))
    jacobian = np.eye(2) + 0.2 * rng.standard_normal((16, 2, 2))
    expected = predicted_bias(misfit, jacobian, x, 30)
    outputs, inputs = np.array([1e3, 1e-2]), np.array([10.0, 1e-4])
    scaled = predicted_bias(misfit * outputs, jacobian * outputs[:, None] / inputs, x * inputs, 30)
    assert scaled == pytest.approx(expected)
    order = rng.permutation(16)
    assert predicted_bias(misfit[order], jacobian[order], x[order], 30) == pytest.approx(expected)


def test_roots_at_one_place_have_an_unknown_bias() -> None:
    x, jacobian = np.ones((4, 1)), np.ones((4, 1, 1))
    assert np.isinf(predicted_bias(np.full((4, 1), 0.1), jacobian, x, 20)).all()
