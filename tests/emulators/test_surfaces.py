"""Surfaces of one response, and of a response that follows a coarse one."""

from __future__ import annotations

import pickle
from functools import partial
from typing import Any

import numpy as np
import pytest
from bent_response import BOX, FRESH, bent

import prbayes as prb
from prbayes._validate import Floats
from prbayes.emulators.emulator import fit_emulator
from prbayes.emulators.following import Follower, fit_follower
from prbayes.emulators.gaussian_process import GaussianProcess
from prbayes.emulators.radial_basis import RadialBasis
from prbayes.emulators.surfaces import Polynomial, Surface


@pytest.mark.parametrize("degree", [1, 3])
def test_a_polynomial_reproduces_one_of_its_degree_and_no_higher_one(degree: int) -> None:
    def response(x: Any, y: Any) -> Any:
        return 5.0 - 2 * x**degree + 3 * y ** (degree - 1) * x

    exact = prb.Surrogate.fit(response, BOX, 40, model=Polynomial(degree))
    many = np.tile(FRESH, 12)  # several blocks
    np.testing.assert_allclose(exact(*many), response(*many), atol=1e-10)
    assert exact.error.largest < 1e-10
    if degree > 1:
        poor = prb.Surrogate.fit(response, BOX, 40, model=Polynomial(degree - 1))
        assert poor.error.rms > 0.01


@pytest.mark.parametrize("kernel", ["thin_plate_spline", "cubic", "quintic"])
def test_radial_basis_passes_through_its_points_and_reproduces_a_plane(kernel: str) -> None:
    fit = partial(prb.Surrogate.fit, inputs=BOX, n=40, model=RadialBasis(kernel))
    found = fit(bent)
    np.testing.assert_allclose(found(*found.points.T), found.responses, atol=1e-8)
    plane = fit(lambda x, y: 2 * x - y + 7)
    np.testing.assert_allclose(plane(*FRESH), 2 * FRESH[0] - FRESH[1] + 7, atol=1e-8)


def test_smoothing_recovers_a_response_below_its_noise() -> None:
    def scattered(x: Any, y: Any) -> Any:
        # The same number for the same point, and none that is near to it.
        return bent(x, y) + 0.05 * np.sqrt(2) * np.sin(1e5 * x + 3e5 * y)

    settings = RadialBasis("thin_plate_spline", smoothing=1e-2)
    noisy = prb.Surrogate.fit(scattered, BOX, 256, model=settings)
    assert np.sqrt(np.mean((noisy(*FRESH) - bent(*FRESH)) ** 2)) < 0.03
    assert noisy.error.rms == pytest.approx(0.05, rel=0.2)  # se of an rms of 256 is 4%


class Plane(Surface):
    """Least squares with one coefficient for each input and one for all."""

    def __init__(self) -> None:
        self.responses: list[Any] = []

    def terms(self, dimensions: int) -> int:
        return dimensions + 1

    def through(self, x: Any, y: Any) -> Any:
        def basis(at: Any) -> Any:
            return np.column_stack([np.ones(len(at)), at])

        self.responses.append(y)
        coefficients = np.linalg.lstsq(basis(x), y)[0]
        return lambda at: basis(at) @ coefficients


def test_a_users_surface_equals_the_shipped_one() -> None:
    own = prb.Surrogate.fit(bent, BOX, 32, model=Plane())
    ships = prb.Surrogate.fit(bent, BOX, 32, model=Polynomial(1))
    np.testing.assert_allclose(own(*FRESH), ships(*FRESH), atol=1e-12)
    np.testing.assert_allclose(own.error.residuals, ships.error.residuals, atol=1e-12)
    # It is fitted to responses of mean zero and unit spread; a constant has no spread.
    x = np.random.default_rng(0).random((20, 2))
    y, model = 1e6 + 1e4 * x[:, 0], Plane()
    np.testing.assert_allclose(fit_emulator(x, y[:, None], tried=[model]).values(x)[:, 0], y)
    (whole,) = [z for z in model.responses if len(z) == 20]
    moments = whole.mean(), whole.std()
    np.testing.assert_allclose(moments, [0, 1], atol=1e-9)
    constant = fit_emulator(x, np.full((20, 1), 7.0), tried=[Plane()])
    np.testing.assert_array_equal(constant.values(x), 7.0)


def test_settings() -> None:
    terms = [RadialBasis(kernel).terms(2) for kernel in ("linear", "cubic", "quintic")]
    assert [*terms, RadialBasis("cubic", degree=3).terms(2)] == [1, 3, 6, 10]
    for make, message in (
        (lambda: RadialBasis("gauss"), "kernel: got 'gauss'"),
        (lambda: RadialBasis("cubic", degree=0), "degree: got 0"),
        (lambda: RadialBasis(smoothing=-1), "smoothing: got -1"),
        (lambda: Polynomial(0), "degree: got 0"),
    ):
        with pytest.raises(ValueError, match=message):
            make()


# -- a coarse response -----------------------------------------------------------------------------

X = np.random.default_rng(3).standard_normal((64, 2))
AT = np.random.default_rng(4).standard_normal((500, 2))


def rough(x: Floats) -> Floats:
    return np.sin(6 * x[:, 0]) * np.cos(5 * x[:, 1])


def fine(x: Floats) -> Floats:
    return 2 - 3 * rough(x) + 0.5 * x[:, 0] + 0.2 * x[:, 1] ** 2


def follower(
    y: Floats, coarse: Floats, model: Surface, left_out: float = np.inf
) -> Follower | None:
    """Return an emulator of outputs at the runs; left-out errors without it are equal numbers."""
    return fit_follower(X, y, coarse, np.full(64, left_out), model)


@pytest.mark.parametrize(
    "model",
    [
        GaussianProcess("matern"),
        GaussianProcess("matern", lengths=(2.0, 2.0), nugget=1e-8),
        *(Polynomial(2), RadialBasis()),
    ],
    ids=str,
)
def test_a_coarse_response_is_followed_with_its_sign(model: Surface) -> None:
    found = follower(fine(X), rough(X), model)
    assert found is not None
    assert (found.values(AT, rough(AT)) - fine(AT)).std() < 0.15 * fine(AT).std()
    again = pickle.loads(pickle.dumps(found))
    np.testing.assert_array_equal(again.values(AT, rough(AT)), found.values(AT, rough(AT)))
    # A constant one, as an input, has no spread.
    constant = follower(fine(X), np.full(64, 3.0), model)
    assert constant is not None
    assert np.isfinite(constant.values(AT, np.full(500, 3.0))).all()
    # In any unit.
    other = follower(1e-3 * fine(X), 1e6 + 1e3 * rough(X), model)
    assert other is not None
    off = 1e3 * other.values(AT, 1e6 + 1e3 * rough(AT)) - fine(AT)
    assert off.std() < 0.15 * fine(AT).std()


def test_the_remainder_may_depend_on_the_coarse_response() -> None:
    def scaled(x: Floats) -> Floats:
        return np.exp(0.3 * x[:, 0]) * rough(x)

    found = follower(scaled(X), rough(X), GaussianProcess())
    assert found is not None
    assert np.std(found.values(AT, rough(AT)) - scaled(AT)) < 0.2 * np.std(scaled(AT))


def test_nothing_is_followed_that_saves_no_error() -> None:
    few = np.where(np.arange(64) < 60, np.nan, rough(X))
    assert follower(fine(X), few, Polynomial(2)) is None
    assert follower(fine(X), rough(X), RadialBasis(), left_out=1e-6) is None
    assert follower(fine(X), rough(X), RadialBasis(), left_out=0.0) is None
