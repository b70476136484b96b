"""Surfaces: exact where they can be, and those of scikit-learn, of users and of two fidelities beside them."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF

import prbayes as prb
from prbayes._validate import Floats
from prbayes.emulators.gaussian_process import GaussianProcess
from prbayes.emulators.selection import (
    Runs,
    candidate_surfaces,
    left_out_predictions,
    predict_outputs,
    select_surfaces,
)
from prbayes.emulators.surfaces import (
    MultifidelityModel,
    Polynomial,
    RadialBasis,
    Surface,
    fit_multifidelity,
    fitted,
    predict,
)

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


X = np.random.default_rng(3).standard_normal((64, 2))
AT = np.random.default_rng(4).standard_normal((500, 2))


def rough(x: Floats) -> Floats:
    return np.sin(6 * x[:, 0]) * np.cos(5 * x[:, 1])


def fine(x: Floats) -> Floats:
    return 2 - 3 * rough(x) + 0.5 * x[:, 0] + 0.2 * x[:, 1] ** 2


def runs(function: Any = fine, coarse: Any = rough) -> Runs:
    n = len(X)
    y = np.asarray(function(X)).reshape(n, -1)
    return Runs(X, y, np.full(n, 1 / n), np.arange(n) * 8 // n, coarse(X).reshape(n, -1))


def error(known: Runs, function: Any = fine, coarse: Any = rough) -> float:
    models, _ = select_surfaces(candidate_surfaces(*known.x.shape), known)
    found = predict_outputs(models, known, AT, coarse=coarse(AT).reshape(len(AT), -1))[:, 0]
    return float(np.std(found - function(AT)) / np.std(function(AT)))


@pytest.mark.parametrize("joined", [False, True])
@pytest.mark.parametrize("model", [RadialBasis(), Polynomial(2), GaussianProcess("matern")])
def test_a_coarse_response_is_followed_with_its_sign(model: Any, joined: bool) -> None:
    surface = fit_multifidelity(MultifidelityModel(model, model, joined), X, fine(X), rough(X))
    if not joined:
        assert surface.rho == pytest.approx(-3, abs=0.2)
    off = surface(AT, rough(AT)) - fine(AT)
    assert off.std() < 0.15 * fine(AT).std()
    again = pickle.loads(pickle.dumps(surface))
    np.testing.assert_array_equal(again(AT, rough(AT)), surface(AT, rough(AT)))


def test_what_varies_over_short_distances_tells_rho() -> None:
    # A trend that goes with the coarse response is none of it: least squares alone would say more.
    def coarse(x: Floats) -> Floats:
        return rough(x) + x[:, 0]

    def trend(x: Floats) -> Floats:
        return coarse(x) + 4 * np.tanh(x[:, 0])

    tuned = GaussianProcess("matern", lengths=(1.0, 1.0), nugget=1e-6)
    for model in (tuned, RadialBasis()):
        following = MultifidelityModel(model, model, joined=False)
        rho = fit_multifidelity(following, X, trend(X), coarse(X)).rho
        assert rho == pytest.approx(1, abs=0.2)
    assert np.polyfit(coarse(X), trend(X), 1)[0] > 2


@pytest.mark.parametrize("joined", [False, True])
def test_rho_is_of_the_runs_that_are_kept(joined: bool) -> None:
    known = runs()
    models = [MultifidelityModel(RadialBasis(), RadialBasis(), joined)]
    said = left_out_predictions(models, known)
    block = known.blocks == 3
    other_y = np.where(block[:, None], 70.0, known.y)
    other = Runs(known.x, other_y, known.importance, known.blocks, known.coarse)
    np.testing.assert_array_equal(left_out_predictions(models, other)[block], said[block])
    assert np.abs(said - known.y).max() < 0.5 * np.ptp(known.y)


def test_a_coarse_response_makes_errors_far_smaller() -> None:
    known = runs()
    alone = Runs(known.x, known.y, known.importance, known.blocks)
    without, _ = select_surfaces(candidate_surfaces(*known.x.shape), alone)
    off = predict_outputs(without, alone, AT)[:, 0] - fine(AT)
    assert error(known) < 0.05 * off.std() / fine(AT).std()


def test_what_is_beside_may_depend_on_the_coarse_response() -> None:
    def scaled(x: Floats) -> Floats:
        return np.exp(0.3 * x[:, 0]) * rough(x)

    known = runs(scaled)
    models, _ = select_surfaces(candidate_surfaces(*known.x.shape), known)
    assert models[0].joined
    assert error(known, scaled) < 0.2


def test_one_that_tells_nothing_is_not_followed() -> None:
    def unrelated(x: Floats) -> Floats:
        return np.cos(40 * x[:, 0] + 30 * x[:, 1])

    def smooth(x: Floats) -> Floats:
        return x[:, 0] ** 2 + np.exp(0.3 * x[:, 1])

    known = runs(smooth, unrelated)
    alone = Runs(known.x, known.y, known.importance, known.blocks)
    models, said = select_surfaces(candidate_surfaces(*known.x.shape), known)
    without, same = select_surfaces(candidate_surfaces(*known.x.shape), alone)
    assert models == without
    np.testing.assert_array_equal(said, same)


def test_each_output_has_a_rho_of_its_own() -> None:
    known = runs(
        lambda x: np.stack([fine(x), x[:, 0]], axis=1),
        lambda x: np.stack([1e6 + 1e3 * rough(x), rough(x)], axis=1),
    )
    models, _ = select_surfaces(candidate_surfaces(*known.x.shape), known)
    assert isinstance(models[0], MultifidelityModel)
    coarse = np.stack([1e6 + 1e3 * rough(AT), np.full(len(AT), 1e9)], axis=1)
    found = predict_outputs(models, known, AT, coarse=coarse)
    assert np.std(found[:, 0] - fine(AT)) < 0.05 * fine(AT).std()


def test_where_there_is_no_coarse_response_the_surface_goes_on_without_it() -> None:
    def partly(x: Floats) -> Floats:
        return np.where(x[:, 0] > 1, np.nan, rough(x))

    known = runs(coarse=partly)
    models, _ = select_surfaces(candidate_surfaces(*known.x.shape), known)
    assert isinstance(models[0], MultifidelityModel)
    found = predict_outputs(models, known, AT, coarse=partly(AT)[:, None])
    without = AT[:, 0] > 1
    alone = predict_outputs([models[0].otherwise], known, AT)
    # Up to the last digit, in which sums over fewer points at a time differ.
    np.testing.assert_allclose(found[without], alone[without], rtol=1e-12)
    assert np.std(found[~without, 0] - fine(AT[~without])) < 0.1 * fine(AT).std()


def test_too_few_coarse_responses_are_none() -> None:
    known = runs(coarse=lambda x: np.where(np.arange(len(x)) < 60, np.nan, rough(x)))
    models, _ = select_surfaces([Polynomial(2)], known)
    assert models == (Polynomial(2),)


def test_a_constant_coarse_response_tells_nothing() -> None:
    process = MultifidelityModel(GaussianProcess(), GaussianProcess(), joined=False)
    surface = fit_multifidelity(process, X, fine(X), np.full(64, 3.0))
    assert surface.rho == pytest.approx(0, abs=1e-12)
    model = GaussianProcess("matern", lengths=(1.0, 1.0, 1.0), nugget=1e-6)
    constant = np.full(64, 3.0)
    following = MultifidelityModel(model, model, joined=True)
    found = predict(following, X, fine(X), AT, constant, np.full(len(AT), 3.0))
    assert np.isfinite(found).all()
