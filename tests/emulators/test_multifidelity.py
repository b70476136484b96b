"""A response follows a coarse one: rho is found on the runs that are kept, a surface tells the rest."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from prbayes._validate import Floats
from prbayes.emulators.gaussian_process import GaussianProcess
from prbayes.emulators.multifidelity import MultifidelityModel, fit_multifidelity, predict
from prbayes.emulators.selection import (
    Runs,
    candidate_surfaces,
    left_out_predictions,
    predict_outputs,
    select_surfaces,
)
from prbayes.emulators.surfaces import Polynomial, RadialBasis

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
    surface = fit_multifidelity(model, X, fine(X), rough(X), joined=joined)
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
        rho = fit_multifidelity(model, X, trend(X), coarse(X), joined=False).rho
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
    surface = fit_multifidelity(GaussianProcess(), X, fine(X), np.full(64, 3.0), joined=False)
    assert surface.rho == pytest.approx(0, abs=1e-12)
    model = GaussianProcess("matern", lengths=(1.0, 1.0, 1.0), nugget=1e-6)
    constant = np.full(64, 3.0)
    following = MultifidelityModel(model, model, joined=True)
    found = predict(following, X, fine(X), AT, constant, np.full(len(AT), 3.0))
    assert np.isfinite(found).all()
