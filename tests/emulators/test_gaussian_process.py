"""A Gaussian process is that of scikit-learn with the same lengths, and finds its own."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from prbayes._validate import Floats
from prbayes.emulators.gaussian_process import KERNELS, GaussianProcess, negative_log_likelihood


def points(n: int = 40) -> tuple[Floats, Floats]:
    x = np.random.default_rng(1).standard_normal((n, 3))
    return x, np.sin(x[:, 0]) + 0.3 * x[:, 1] ** 2


@pytest.mark.parametrize(("kernel", "nu"), [("matern", 2.5), ("squared_exponential", np.inf)])
def test_the_mean_is_that_of_scikit_learn(kernel: str, nu: float) -> None:
    process = pytest.importorskip("sklearn.gaussian_process")
    x, y = points()
    lengths, nugget = (1.0, 2.0, 5.0), 1e-3
    shape = process.kernels.Matern(lengths, nu=nu)
    same = process.GaussianProcessRegressor(shape, alpha=nugget, optimizer=None)
    same.fit(x, y - y.mean())
    at = np.random.default_rng(2).standard_normal((2000, 3))
    found = GaussianProcess(kernel, lengths=lengths, nugget=nugget).through(x, y)(at)
    np.testing.assert_allclose(found, y.mean() + same.predict(at), atol=1e-9)


@pytest.mark.parametrize("kernel", list(KERNELS))
def test_the_likelihood_has_the_gradient_that_it_says(kernel: str) -> None:
    x, y = points()
    runs = KERNELS[kernel], x, y - y.mean()
    at = np.log([0.8, 1.5, 4.0, 1e-2])
    expected = approx_fprime(at, lambda p: negative_log_likelihood(p, *runs)[0], 1e-6)
    np.testing.assert_allclose(
        negative_log_likelihood(at, *runs)[1], expected, rtol=1e-4, atol=1e-4
    )


def test_an_input_that_does_not_matter_gets_a_long_length() -> None:
    lengths = GaussianProcess().tuned(*points(60)).lengths
    assert lengths is not None
    assert lengths[2] > 10 * lengths[0]


def test_settings_that_were_found_are_kept_with_fewer_points() -> None:
    x, y = points()
    tuned = GaussianProcess("matern").tuned(x, y)
    assert tuned.tuned(x, y).kernel == "matern"
    at = x[:5] + 0.1
    np.testing.assert_array_equal(
        tuned.through(x, y)(at), GaussianProcess("matern").through(x, y)(at)
    )
    assert not np.array_equal(tuned.through(x[::2], y[::2])(at), tuned.through(x, y)(at))


def test_points_that_are_all_but_the_same_are_no_obstacle() -> None:
    x, y = points()
    twice = np.concatenate([x, x + 1e-12])
    found = GaussianProcess(lengths=(50.0, 50.0, 50.0), nugget=0.0).through(twice, np.tile(y, 2))
    assert np.isfinite(found(x)).all()


def test_it_is_pickled() -> None:
    x, y = points()
    surface = GaussianProcess().through(x, y)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(surface))(x), surface(x))


def test_a_constant_response_is_that_constant() -> None:
    x, _ = points()
    np.testing.assert_allclose(GaussianProcess().through(x, np.full(len(x), 3.0))(x + 1), 3.0)


def test_a_kernel_that_there_is_not_is_refused() -> None:
    with pytest.raises(ValueError, match="kernel: got 'cubic', expected one of"):
        GaussianProcess("cubic")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"kernel": "cubic"}, "kernel: got 'cubic'"),
        ({"lengths": (1.0, 2.0)}, "expected both, or neither"),
        ({"nugget": 0.1}, "expected both, or neither"),
        ({"lengths": (1.0, -2.0), "nugget": 0.1}, "lengths: got -2.0"),
        ({"lengths": (1.0, 2.0), "nugget": -0.1}, "nugget: got -0.1"),
    ],
)
def test_settings_that_are_none_are_refused(arguments: Any, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        GaussianProcess(**arguments)


def test_lengths_are_as_many_as_inputs() -> None:
    x = np.random.default_rng(0).random((20, 3))
    with pytest.raises(ValueError, match="got 2, expected one for each of 3 inputs"):
        GaussianProcess("matern", lengths=(1.0, 2.0), nugget=0.0).through(x, x[:, 0])
