"""A Gaussian process equals that of scikit-learn with the same lengths, and estimates its own."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from sklearn.gaussian_process import GaussianProcessRegressor, kernels

from prbayes._validate import Floats
from prbayes.emulators.gaussian_process import GaussianProcess


def points(n: int = 40) -> tuple[Floats, Floats]:
    x = np.random.default_rng(1).standard_normal((n, 3))
    return x, np.sin(x[:, 0]) + 0.3 * x[:, 1] ** 2


@pytest.mark.parametrize(("kernel", "nu"), [("matern", 2.5), ("squared_exponential", np.inf)])
def test_the_mean_is_that_of_scikit_learn(kernel: str, nu: float) -> None:
    """With a constant, since there are fewer than twice as many points as a plane needs."""
    x, y = points(7)
    lengths, nugget = (1.0, 2.0, 5.0), 1e-3
    model = GaussianProcess(kernel, lengths=lengths, nugget=nugget)
    found = model.through(x, y)
    matrix = kernels.Matern(lengths, nu=nu)(x) + nugget * np.eye(7)
    constant = np.linalg.solve(matrix, np.ones(7)) @ y / np.linalg.solve(matrix, np.ones(7)).sum()
    same = GaussianProcessRegressor(kernels.Matern(lengths, nu=nu), alpha=nugget, optimizer=None)
    same.fit(x, y - constant)
    at = np.random.default_rng(2).standard_normal((2000, 3))
    np.testing.assert_allclose(found(at), constant + same.predict(at), atol=1e-9)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(found))(x), found(x))


def test_lengths_are_those_of_inputs_that_matter_and_remain_without_runs() -> None:
    x, y = points()
    surface = GaussianProcess("matern").fit(x, y, np.full(40, 1 / 40))
    assert surface is not None
    assert surface.lengths[2] > 10 * surface.lengths[0]
    at, mask = x[:5] + 0.1, np.arange(40) % 2 == 1
    np.testing.assert_array_equal(surface.values(at), GaussianProcess("matern").through(x, y)(at))
    (without,) = surface.without_each(mask[None])
    same = GaussianProcess("matern", lengths=tuple(surface.lengths), nugget=surface.nugget)
    np.testing.assert_allclose(without.values(at), same.through(x[~mask], y[~mask])(at), atol=1e-6)


def test_a_quadratic_trend_is_taken_where_runs_determine_it() -> None:
    x = np.random.default_rng(3).standard_normal((60, 6))
    y = x[:, 0] * x[:, 1] + x[:, 2] ** 2 + 0.05 * np.sin(2 * x[:, 3] * x[:, 4])
    at = np.random.default_rng(4).standard_normal((500, 6))
    exact = at[:, 0] * at[:, 1] + at[:, 2] ** 2 + 0.05 * np.sin(2 * at[:, 3] * at[:, 4])
    plane, quadratic, few = (
        GaussianProcess(degree=degree).fit(x[:n], y[:n], np.full(n, 1 / n))
        for degree, n in ((1, 60), (2, 60), (2, 40))
    )
    assert plane is not None
    assert quadratic is not None
    assert few is not None
    # 28 coefficients need 56 runs.
    assert (plane.degree, quadratic.degree, few.degree) == (1, 2, 1)
    errors = [np.abs(surface.values(at) - exact).mean() for surface in (plane, quadratic)]
    assert errors[1] < errors[0] / 2


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
