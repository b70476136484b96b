"""A Gaussian process equals that of scikit-learn with the same lengths, and estimates its own."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from sklearn.gaussian_process import GaussianProcessRegressor, kernels

from prbayes._validate import Floats
from prbayes.emulators.gaussian_process import KERNELS, GaussianProcess, negative_log_likelihood


def points(n: int = 40) -> tuple[Floats, Floats]:
    x = np.random.default_rng(1).standard_normal((n, 3))
    return x, np.sin(x[:, 0]) + 0.3 * x[:, 1] ** 2


@pytest.mark.parametrize(("kernel", "nu"), [("matern", 2.5), ("squared_exponential", np.inf)])
def test_the_mean_is_that_of_scikit_learn(kernel: str, nu: float) -> None:
    x, y = points()
    lengths, nugget = (1.0, 2.0, 5.0), 1e-3
    same = GaussianProcessRegressor(kernels.Matern(lengths, nu=nu), alpha=nugget, optimizer=None)
    same.fit(x, y - y.mean())
    at = np.random.default_rng(2).standard_normal((2000, 3))
    found = GaussianProcess(kernel, lengths=lengths, nugget=nugget).through(x, y)
    np.testing.assert_allclose(found(at), y.mean() + same.predict(at), atol=1e-9)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(found))(x), found(x))


@pytest.mark.parametrize("kernel", list(KERNELS))
def test_the_gradient_of_the_likelihood_is_exact(kernel: str) -> None:
    x, y = points()
    runs = KERNELS[kernel], x, y - y.mean()
    at = np.log([0.8, 1.5, 4.0, 1e-2])
    expected = approx_fprime(at, lambda p: negative_log_likelihood(p, *runs)[0], 1e-6)
    _, gradient = negative_log_likelihood(at, *runs)
    np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-4)


def test_tuned_lengths_tell_which_inputs_matter_and_are_kept_with_fewer_points() -> None:
    x, y = points()
    tuned = GaussianProcess("matern").tuned(x, y)
    assert tuned.lengths is not None
    assert tuned.lengths[2] > 10 * tuned.lengths[0]
    at = x[:5] + 0.1
    alone = GaussianProcess("matern").through(x, y)
    np.testing.assert_array_equal(tuned.through(x, y)(at), alone(at))
    assert not np.array_equal(tuned.through(x[::2], y[::2])(at), alone(at))


def test_nearly_equal_points_and_constant_responses() -> None:
    x, y = points()
    twice = np.concatenate([x, x + 1e-12])
    found = GaussianProcess(lengths=(50.0, 50.0, 50.0), nugget=0.0).through(twice, np.tile(y, 2))
    assert np.isfinite(found(x)).all()
    np.testing.assert_allclose(GaussianProcess().through(x, np.full(len(x), 3.0))(x + 1), 3.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kernel": "cubic"}, "kernel: got 'cubic'"),
        ({"lengths": (1.0, 2.0)}, "expected both or neither"),
        ({"lengths": (1.0, -2.0), "nugget": 0.1}, "lengths: got -2.0"),
        ({"lengths": (1.0, 2.0), "nugget": -0.1}, "nugget: got -0.1"),
        ({"lengths": (1.0, 2.0), "nugget": 0.0}, "got 2, expected one for each of 3 inputs"),
    ],
)
def test_wrong_settings_are_refused(arguments: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GaussianProcess(**arguments).through(*points())
