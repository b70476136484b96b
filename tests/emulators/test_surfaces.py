"""Surfaces: exact where they can be, and those of scikit-learn and of users beside them."""

from typing import Any

import numpy as np
import pytest
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF

import prbayes as prb
from prbayes.emulators.surfaces import Surface, fitted

BOX = {"x": (0.0, 3.0), "y": (1.0, 2.0)}


def bent(x: Any, y: Any) -> Any:
    return np.sin(x) * y


def fresh_points(n: int = 500) -> tuple[Any, Any]:
    u = np.random.default_rng(3).random((2, n))
    return 3 * u[0], 1 + u[1]


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_a_polynomial_repeats_a_polynomial_of_its_degree_and_no_higher_one(degree: int) -> None:
    def response(x: Any, y: Any) -> Any:
        return 5.0 - 2 * x**degree + 3 * y ** (degree - 1) * x

    exact = prb.Surrogate.fit(response, BOX, 40, model=prb.surrogate.Polynomial(degree))
    x, y = fresh_points()
    np.testing.assert_allclose(exact(x, y), response(x, y), atol=1e-10)
    assert exact.error.largest < 1e-10
    if degree > 1:
        poor = prb.Surrogate.fit(response, BOX, 40, model=prb.surrogate.Polynomial(degree - 1))
        assert poor.error.rms > 0.01


@pytest.mark.parametrize("kernel", ["thin_plate_spline", "cubic", "quintic"])
def test_radial_basis_passes_through_its_points_and_repeats_a_plane(kernel: str) -> None:
    found = prb.Surrogate.fit(bent, BOX, 40, model=prb.surrogate.RadialBasis(kernel))
    np.testing.assert_allclose(found(*found.points.T), found.responses, atol=1e-8)
    plane = prb.Surrogate.fit(
        lambda x, y: 2 * x - y + 7, BOX, 40, model=prb.surrogate.RadialBasis(kernel)
    )
    x, y = fresh_points()
    np.testing.assert_allclose(plane(x, y), 2 * x - y + 7, atol=1e-8)


def test_smoothing_recovers_a_response_below_its_noise() -> None:
    rng = np.random.default_rng(5)
    settings = prb.surrogate.RadialBasis("thin_plate_spline", smoothing=1e-2)
    noisy = prb.Surrogate.fit(
        lambda x, y: bent(x, y) + rng.normal(0, 0.05, x.shape), BOX, 256, model=settings
    )
    x, y = fresh_points()
    assert np.sqrt(np.mean((noisy(x, y) - bent(x, y)) ** 2)) < 0.03
    assert noisy.error.rms == pytest.approx(0.05, rel=0.2)  # se of an rms of 256 is 4%


def test_a_regressor_of_scikit_learn_serves_and_is_left_unfitted() -> None:
    # The length of greatest likelihood is .60; it is not searched for. Responses without noise
    # leave a matrix of condition 4e9, hence a likelihood that is rounded at 2e-7: whether the
    # gradient falls below scikit-learn's tolerance, or the search ends with a warning, is then up
    # to the last digits of the processor's kernels.
    regressor = GaussianProcessRegressor(RBF(0.6), alpha=1e-8, optimizer=None)
    found = prb.Surrogate.fit(lambda x, y: 1e6 + 1e4 * bent(x, y), BOX, 64, model=regressor)
    x, y = fresh_points()
    assert np.sqrt(np.mean((found(x, y) - 1e6 - 1e4 * bent(x, y)) ** 2)) < 10
    assert not hasattr(regressor, "X_train_")


class Plane(Surface):
    """Least squares with one coefficient for each input and one for all."""

    def terms(self, dimensions: int) -> int:
        return dimensions + 1

    def through(self, x: Any, y: Any) -> Any:
        def basis(at: Any) -> Any:
            return np.column_stack([np.ones(len(at)), at])

        coefficients = np.linalg.lstsq(basis(x), y)[0]
        return lambda at: basis(at) @ coefficients


def test_a_surface_of_ones_own_is_that_which_ships() -> None:
    own = prb.Surrogate.fit(bent, BOX, 32, model=Plane())
    ships = prb.Surrogate.fit(bent, BOX, 32, model=prb.surrogate.Polynomial(1))
    x, y = fresh_points()
    np.testing.assert_allclose(own(x, y), ships(x, y), atol=1e-12)
    np.testing.assert_allclose(own.error.residuals, ships.error.residuals, atol=1e-12)


def test_a_surface_that_says_nothing_is_refused() -> None:
    with pytest.raises(TypeError, match="abstract"):
        Surface()  # type: ignore[abstract]


def test_surfaces_are_fitted_to_responses_of_mean_0_and_spread_1() -> None:
    class Told(Plane):
        def through(self, x: Any, y: Any) -> Any:
            told.append(y)
            return super().through(x, y)

    told: list[Any] = []
    x = np.random.default_rng(0).random((20, 2))
    y = 1e6 + 1e4 * x[:, 0]
    np.testing.assert_allclose(fitted(Told(), x, y)(x), y)
    assert told[0].mean() == pytest.approx(0, abs=1e-9)
    assert told[0].std() == pytest.approx(1)
    # A constant has no spread.
    np.testing.assert_array_equal(fitted(Plane(), x, np.full(20, 7.0))(x), 7.0)


@pytest.mark.parametrize(
    ("kernel", "degree", "terms"),
    [("linear", None, 1), ("cubic", None, 3), ("quintic", None, 6), ("cubic", 3, 10)],
)
def test_terms_of_two_inputs(kernel: str, degree: int | None, terms: int) -> None:
    assert prb.surrogate.RadialBasis(kernel, degree=degree).terms(2) == terms


def test_refusals() -> None:
    with pytest.raises(ValueError, match="kernel: got 'gauss'"):
        prb.surrogate.RadialBasis("gauss")
    with pytest.raises(ValueError, match="degree: got 0"):
        prb.surrogate.RadialBasis("cubic", degree=0)
    with pytest.raises(ValueError, match="smoothing: got -1"):
        prb.surrogate.RadialBasis(smoothing=-1)
    with pytest.raises(ValueError, match="degree: got 0"):
        prb.surrogate.Polynomial(0)


def test_a_polynomial_says_the_same_of_many_points_at_once() -> None:
    x = np.random.default_rng(0).random((6000, 2))
    predict = prb.surrogate.Polynomial(3).through(x[:50], np.exp(x[:50, 0]) * x[:50, 1])
    pieces = [predict(x[i : i + 1000]) for i in range(0, 6000, 1000)]
    np.testing.assert_allclose(predict(x), np.concatenate(pieces), rtol=1e-12)
