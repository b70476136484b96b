"""The error of surfaces by points that were left out, and their selection by it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import prbayes as prb
from prbayes._validate import Floats
from prbayes.emulators.gaussian_process import GaussianProcess
from prbayes.emulators.selection import (
    FOLDS,
    CrossValidation,
    Runs,
    candidate_surfaces,
    cross_validated,
    has_enough_runs,
    left_out_predictions,
    mixing_weight,
    points_needed,
    predict_outputs,
    predict_without_blocks,
    select_surfaces,
)
from prbayes.emulators.surfaces import Polynomial, RadialBasis, Surface

BOX = {"x": (0.0, 3.0), "y": (1.0, 2.0)}


def bent(x: Any, y: Any) -> Any:
    return np.sin(x) * y


def fresh_points(n: int = 500) -> tuple[Any, Any]:
    u = np.random.default_rng(3).random((2, n))
    return 3 * u[0], 1 + u[1]


@pytest.fixture(scope="module")
def surrogate() -> prb.Surrogate:
    return prb.Surrogate.fit(bent, BOX, 64)


def test_the_error_is_what_left_out_points_show() -> None:
    """The residuals are those of fits without each tenth, done here by hand with a plane."""
    found = prb.Surrogate.fit(bent, BOX, 20, model=prb.surrogate.Polynomial(1), random_seed=4)
    order = np.random.default_rng(4).permutation(20)
    a = np.column_stack([np.ones(20), found.points])
    for fold in np.array_split(order, 10):
        rest = np.setdiff1d(np.arange(20), fold)
        plane = np.linalg.lstsq(a[rest], found.responses[rest])[0]
        np.testing.assert_allclose(
            found.error.residuals[fold], found.responses[fold] - a[fold] @ plane, atol=1e-12
        )
    assert found.error.relative == pytest.approx(found.error.rms / found.responses.std())
    assert "% of the population's sd" in str(found.error)


def test_cross_validation_tells_the_error_on_fresh_points_within_a_factor(
    surrogate: prb.Surrogate,
) -> None:
    x, y = fresh_points(2000)
    true = np.sqrt(np.mean((surrogate(x, y) - bent(x, y)) ** 2))
    assert (
        true < surrogate.error.rms < 8 * true
    )  # points at the edge, left out, are predicted worse than fresh ones


def test_the_local_error_is_larger_where_the_response_is_rougher() -> None:
    rough = prb.Surrogate.fit(lambda x: np.where(x > 2, np.sin(12 * x), 0.0), {"x": (0.0, 4.0)}, 40)
    smooth, wild = rough.local_error(np.array([0.5, 3.5]))
    assert smooth < 0.05 * wild
    assert rough.local_error(np.zeros((2, 3))).shape == (2, 3)


class Nearest(Surface):
    """The response of the nearest point: exact where it was fitted, and nowhere else."""

    def terms(self, dimensions: int) -> int:
        return 1

    def through(self, x: Any, y: Any) -> Any:
        return lambda at: y[np.abs(at[:, None, 0] - x[:, 0]).argmin(axis=1)]


def test_no_point_is_in_the_fit_that_judges_it() -> None:
    x = np.linspace(0, 1, 30)[:, None]
    y = np.random.default_rng(0).normal(size=30)
    residuals = cross_validated(Nearest(), x, y, 1)
    assert (residuals != 0).all()
    # Where only the point itself is left out, its neighbours speak for it.
    few = cross_validated(Nearest(), x[:5], y[:5], 1)
    for i, residual in enumerate(few):
        neighbours = [y[k] for k in (i - 1, i + 1) if 0 <= k < 5]
        assert np.isclose(residual, y[i] - neighbours).any()


def test_residuals_are_responses_less_the_surface() -> None:
    x = np.linspace(0, 1, 20)[:, None]
    y = np.zeros(20)
    y[7] = 1.0
    residuals = cross_validated(Nearest(), x, y, 0)
    assert residuals[7] == pytest.approx(1.0)
    assert (np.delete(residuals, 7) <= 1e-12).all()


def test_figures_of_the_error() -> None:
    error = prb.surrogate.CrossValidation(np.array([3.0, -4.0, np.nan]), 5.0)
    assert error.rms == pytest.approx(np.sqrt(12.5))
    assert error.largest == 4.0
    assert error.relative == pytest.approx(np.sqrt(0.5))
    assert str(error) == "rms 3.54 (70.71% of the population's sd), largest 4"


@pytest.mark.parametrize("degree", [1, 2, 4])
def test_points_needed_leave_enough_for_every_fold(degree: int) -> None:
    model = prb.surrogate.Polynomial(degree)
    terms = model.terms(2)
    n = points_needed(model, 2)
    sizes = [len(fold) for fold in np.array_split(np.arange(n), FOLDS)]
    assert n - max(sizes) > terms
    assert n - 1 - -(-(n - 1) // FOLDS) <= terms


@pytest.mark.parametrize(("residual", "relative"), [(0.0, 0.0), (0.1, np.inf)])
def test_the_error_beside_a_response_that_is_a_constant(residual: float, relative: float) -> None:
    error = CrossValidation(np.full(4, residual), 0.0)
    assert error.relative == relative
    assert str(error).startswith(f"rms {residual:.3g} (")


def runs(y: Any, n: int = 64, d: int = 2) -> Runs:
    x = np.random.default_rng(3).standard_normal((n, d))
    return Runs(x, np.asarray(y(x)), np.full(n, 1 / n), np.arange(n) * 8 // n)


def two(x: Floats) -> Floats:
    return np.stack([x[:, 0] ** 2, 100 * np.exp(0.3 * x[:, 1])], axis=1)


def test_a_run_that_is_left_out_is_not_seen() -> None:
    known = runs(two)
    said = left_out_predictions([RadialBasis(), RadialBasis()], known)
    block = known.blocks == 3
    other = Runs(known.x, np.where(block[:, None], 7.0, known.y), known.importance, known.blocks)
    np.testing.assert_array_equal(
        left_out_predictions([RadialBasis(), RadialBasis()], other)[block], said[block]
    )
    assert np.abs(said - known.y).max() > 0


def test_each_output_has_the_surface_that_is_best_for_it() -> None:
    known = runs(lambda x: np.stack([x[:, 0] ** 2, np.abs(x[:, 1]) + (x[:, 0] > 0)], axis=1))
    models, said = select_surfaces([Polynomial(2), GaussianProcess("matern")], known)
    assert isinstance(models[0], Polynomial)
    assert isinstance(models[1], GaussianProcess)
    assert models[1].lengths is not None
    np.testing.assert_array_equal(said[:, 0], left_out_predictions(models, known)[:, 0])


def test_where_the_nearest_run_failed_there_is_no_number() -> None:
    known = runs(lambda x: np.where(x[:, :1] > 0.5, np.nan, x[:, :1]))
    at = np.array([[2.0, 0.0], [-1.0, 0.0]])
    found = predict_outputs([RadialBasis()], known, at)
    assert np.isnan(found[0]).all()
    assert found[1] == pytest.approx(-1, abs=1e-6)
    infinite = runs(lambda x: np.where(x[:, :1] > 0.5, np.inf, x[:, :1]))
    assert np.isposinf(predict_outputs([RadialBasis()], infinite, at)[0]).all()


def test_points_that_come_again_are_no_obstacle() -> None:
    known = runs(two)
    twice = Runs(
        np.concatenate([known.x, known.x]),
        np.concatenate([known.y, known.y]),
        np.full(128, 1 / 128),
        np.arange(128) * 8 // 128,
    )
    models = [RadialBasis(), RadialBasis()]
    np.testing.assert_allclose(
        predict_outputs(models, twice, known.x), known.y, rtol=1e-6, atol=1e-6
    )


def test_nothing_is_further_than_the_runs_are_from_each_other() -> None:
    known = runs(two)
    found = predict_outputs([RadialBasis("quintic")] * 2, known, np.full((1, 2), 1e3))
    assert (np.abs(found - known.y.mean(axis=0)) < 3 * np.ptp(known.y, axis=0)).all()


def test_of_too_many_runs_some_far_ones_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("prbayes.emulators.selection.MOST_RUNS", 20)
    known = runs(two)
    importance = np.linspace(0, 1, 64)
    importance /= importance.sum()
    some = Runs(known.x, known.y, importance, known.blocks).among(np.ones(64, dtype=bool))
    assert some.size == 20
    assert (some >= 54).sum() == 10
    assert some.min() == 0


def test_units_and_scales_do_not_matter() -> None:
    known = runs(two)
    other = Runs(1e6 * known.x + 5, 1e-9 * known.y, known.importance, known.blocks)
    models, said = select_surfaces(candidate_surfaces(*known.x.shape), known)
    others, again = select_surfaces(candidate_surfaces(*known.x.shape), other)
    assert [type(m) for m in models] == [type(m) for m in others]
    np.testing.assert_allclose(again * 1e9, said, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("n", "d"), [(16, 2), (32, 8), (256, 8), (200, 3)])
def test_a_polynomial_has_a_third_as_many_terms_as_there_are_runs(n: int, d: int) -> None:
    *_, spline = candidate_surfaces(n, d)
    assert isinstance(spline, RadialBasis)
    assert spline.terms(d) <= n / 3 or spline.degree == 2


def test_of_many_runs_only_processes_are_tried() -> None:
    assert all(isinstance(model, GaussianProcess) for model in candidate_surfaces(257, 2))


@pytest.mark.parametrize("kernel", ["squared_exponential", "matern"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, 0.0])
def test_a_process_without_a_block_is_that_of_the_other_runs(kernel: str, bad: float) -> None:
    # The short way, from one inverse, against a process that is made of each rest by itself. With a
    # nugget that leaves ten digits to both.
    model = GaussianProcess(kernel, lengths=(1.5, 1.5), nugget=1e-6)

    def response(x: Floats) -> Floats:
        return np.where(x[:, :1] > 1, bad, np.sin(2 * x[:, :1]) + x[:, 1:])

    known = runs(response)
    said = left_out_predictions([model], known)
    at = np.random.default_rng(4).standard_normal((50, 2))
    each = list(predict_without_blocks([model], known, at))
    assert len(each) == 8
    for number, values in enumerate(each):
        block = known.blocks == number
        alone = predict_outputs([model], known, at, ~block)
        np.testing.assert_allclose(values, alone, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(
            said[block],
            predict_outputs([model], known, known.x[block], ~block),
            rtol=1e-8,
            atol=1e-8,
        )


def test_runs_that_determine_no_surface_are_told() -> None:
    assert not has_enough_runs(Polynomial(3), 20, 3)
    assert has_enough_runs(Polynomial(1), 20, 3)
    with pytest.raises(np.linalg.LinAlgError):
        select_surfaces([Polynomial(9)], runs(two))


def test_a_surface_of_a_users_own_and_a_regressor_serve() -> None:
    class Mean(Surface):
        def terms(self, dimensions: int) -> int:
            return 1

        def through(self, x: Floats, y: Floats) -> Any:
            return lambda at: np.full(len(at), y.mean())

    class Regressor:
        def fit(self, x: Floats, y: Floats) -> None:
            self.value = y.mean()

        def predict(self, at: Floats) -> Floats:
            return np.full((len(at), 1), self.value)

    known = runs(two)
    for model in (Mean(), Regressor()):
        found = predict_outputs([model, model], known, known.x)
        np.testing.assert_allclose(found, np.broadcast_to(known.y.mean(axis=0), (64, 2)))
        assert not hasattr(model, "value")


N = 256
Y = np.random.default_rng(5).standard_normal((N, 1))
EVEN = np.full((3, N), 1 / N)
BLOCKS = np.arange(N) % 8


def test_an_emulator_that_is_right_is_trusted() -> None:
    assert mixing_weight(EVEN, Y, Y + 1e-9, BLOCKS) < 0.01


def test_scatter_around_the_response_is_no_bias() -> None:
    near = Y + 0.02 * np.random.default_rng(6).standard_normal((N, 1))
    assert mixing_weight(EVEN, Y, near, BLOCKS) < 0.1


def test_a_rounding_is_no_bias_where_many_specimens_have_one_value() -> None:
    capped = np.minimum(Y, 0.5)
    assert (capped == 0.5).mean() > 0.2
    off = 1e-3 * np.random.default_rng(7).standard_normal((N, 1))
    assert mixing_weight(EVEN, capped, capped + off, BLOCKS) < 0.01
    assert mixing_weight(EVEN, capped, capped + 0.5, BLOCKS) > 0.5


def test_levels_are_where_the_populations_are() -> None:
    # A tenth of the runs are where the populations are, a thousandth as wide as the others.
    here = np.arange(440)[:, None] >= 400
    z = np.random.default_rng(5).standard_normal((440, 1))
    y = np.where(here, 1e-3 * z, z)
    weights = np.repeat(here.T / 40, 3, axis=0)
    blocks = np.arange(440) % 8
    wider = np.where(here, 3 * y, y)
    wrong_elsewhere = np.where(here, y, y + 2.0)
    assert mixing_weight(weights, y, wider, blocks) > 0.5
    assert mixing_weight(weights, y, wrong_elsewhere, blocks) < 0.01


def test_an_emulator_that_is_wrong_is_not_trusted() -> None:
    assert mixing_weight(EVEN, Y, 0 * Y, BLOCKS) > 0.9
    assert mixing_weight(EVEN, Y, Y + 1.0, BLOCKS) > 0.9


def test_few_runs_leave_more_to_the_emulator() -> None:
    uneven = np.zeros((1, N))
    uneven[:, :16] = 1 / 16
    biased = Y + 0.3
    assert mixing_weight(uneven, Y, biased, BLOCKS) < mixing_weight(EVEN, Y, biased, BLOCKS)


@pytest.mark.parametrize("lost", [np.nan, np.inf])
def test_a_failure_that_the_emulator_does_not_know_of_is_a_bias(lost: float) -> None:
    failed = np.where(Y > 0.5, lost, Y)
    assert mixing_weight(EVEN, failed, Y, BLOCKS) >= 0.0
    assert mixing_weight(EVEN, Y, failed, BLOCKS) > 0.5
