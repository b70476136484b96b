"""The error of surfaces by left-out points, their selection by it, and their mixing weight."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bent_response import BOX, bent

import prbayes as prb
from prbayes._validate import Floats
from prbayes.emulators.emulator import fit_emulator
from prbayes.emulators.gaussian_process import GaussianProcess
from prbayes.emulators.radial_basis import RadialBasis
from prbayes.emulators.selection import CrossValidation, TrainingRuns, points_needed, weight_of_runs
from prbayes.emulators.surfaces import FOLDS, Polynomial, Surface


def test_the_error_is_that_of_left_out_points() -> None:
    """The residuals are those of fits without each tenth, computed by hand with a plane."""
    found = prb.Surrogate.fit(bent, BOX, 20, model=Polynomial(1), random_seed=4)
    order = np.random.default_rng(4).permutation(20)
    a = np.column_stack([np.ones(20), found.points])
    for fold in np.array_split(order, 10):
        rest = np.setdiff1d(np.arange(20), fold)
        plane = np.linalg.lstsq(a[rest], found.responses[rest])[0]
        expected = found.responses[fold] - a[fold] @ plane
        np.testing.assert_allclose(found.error.residuals[fold], expected, atol=1e-12)
    assert found.error.relative == pytest.approx(found.error.rms / found.responses.std())


def test_local_errors_are_those_of_left_out_points_nearby() -> None:
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


def test_no_point_is_in_the_fit_of_its_own_residual() -> None:
    x = np.linspace(0, 1, 30)[:, None]
    y = np.random.default_rng(0).normal(size=30)

    def residuals(x: Floats, y: Floats, seed: int) -> Floats:
        return fit_emulator(x, y[:, None], tried=[Nearest()], seed=seed).left_out[:, 0]

    assert (residuals(x, y, 1) != 0).all()
    # Where only the point itself is left out, a neighbour predicts it.
    for i, residual in enumerate(residuals(x[:5], y[:5], 1)):
        neighbours = [y[k] for k in (i - 1, i + 1) if 0 <= k < 5]
        assert np.isclose(residual, y[i] - neighbours).any()
    peak = np.zeros(30)
    peak[7] = 1.0
    assert residuals(x, peak, 0)[7] == pytest.approx(1.0)
    assert (np.delete(residuals(x, peak, 0), 7) <= 1e-12).all()


def test_figures_of_the_error() -> None:
    error = CrossValidation(np.array([3.0, -4.0, np.nan]), 5.0)
    np.testing.assert_allclose([error.rms, error.largest, error.relative], [12.5**0.5, 4, 0.5**0.5])
    assert str(error) == "rms 3.54 (70.71% of the population's sd), largest 4"
    relative = [CrossValidation(np.full(4, r), 0.0).relative for r in (0.0, 0.1)]
    assert relative == [0.0, np.inf]  # of a constant response


@pytest.mark.parametrize("degree", [1, 4])
def test_points_needed_leave_enough_for_every_fold(degree: int) -> None:
    terms = Polynomial(degree).terms(2)
    n = points_needed(Polynomial(degree), 2)
    assert n - -(-n // FOLDS) > terms
    assert n - 1 - -(-(n - 1) // FOLDS) <= terms


# -- runs of an emulator ---------------------------------------------------------------------------


def runs(y: Any, n: int = 64, d: int = 2, importance: Any = None) -> TrainingRuns:
    x = np.random.default_rng(3).standard_normal((n, d))
    importance = np.full(n, 1 / n) if importance is None else importance
    return TrainingRuns(x, np.asarray(y(x)), importance, np.arange(n) * 8 // n)


def two(x: Floats) -> Floats:
    return np.stack([x[:, 0] ** 2, 100 * np.exp(0.3 * x[:, 1])], axis=1)


def test_each_output_has_the_surface_that_is_best_for_it() -> None:
    known = runs(lambda x: np.stack([x[:, 0] ** 2, np.abs(x[:, 1]) + (x[:, 0] > 0)], axis=1))
    quadratic, rough = known.fit([Polynomial(2), GaussianProcess("matern")]).surfaces
    assert getattr(quadratic, "model", None) == Polynomial(2)
    assert getattr(rough, "kernel", None) == "matern"


@pytest.mark.parametrize("lost", [np.nan, np.inf])
def test_where_the_nearest_run_failed_the_prediction_fails(lost: float) -> None:
    known = runs(lambda x: np.where(x[:, :1] > 0.5, lost, x[:, :1]))
    found = known.predict(known.fit([RadialBasis()]), np.array([[2.0, 0.0], [-1.0, 0.0]]))
    np.testing.assert_array_equal(found[0], [lost])
    assert found[1] == pytest.approx(-1, abs=1e-6)


def test_repeated_runs_and_far_points() -> None:
    known = runs(two)
    x, y, blocks = (np.concatenate([v, v]) for v in (known.x, known.y, known.blocks))
    twice = TrainingRuns(x, y, np.full(128, 1 / 128), blocks)
    found = twice.predict(twice.fit([RadialBasis()]), known.x)
    np.testing.assert_allclose(found, known.y, rtol=1e-6, atol=1e-6)
    # Far away predictions stay within the range of the runs beyond their ends.
    far = known.predict(known.fit([RadialBasis("quintic")]), np.full((1, 2), 1e3))
    assert (np.abs(far - known.y.mean(axis=0)) < 3 * np.ptp(known.y, axis=0)).all()


def test_of_too_many_runs_some_far_ones_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("prbayes.emulators.kriging.MOST_RUNS", 20)
    importance = np.linspace(0, 1, 64)
    known = runs(two, importance=importance / importance.sum())
    (surface, _) = known.fit([RadialBasis()]).surfaces
    rows = getattr(surface, "rows", None)
    assert rows is not None
    assert (rows.size, (rows >= 54).sum(), rows.min()) == (20, 10, 0)


@pytest.mark.parametrize(
    "model", [RadialBasis(), GaussianProcess("matern"), Polynomial(3)], ids=str
)
@pytest.mark.parametrize("bad", [np.inf, 0.0])
def test_predictions_without_a_block_are_those_of_the_remaining_runs(
    model: Surface, bad: float
) -> None:
    known = runs(lambda x: np.where(x[:, :1] > 1, bad, np.sin(2 * x[:, :1]) + x[:, 1:]))
    emulator = known.fit([model])
    left_out = known.left_out_predictions(emulator)
    at = np.random.default_rng(4).standard_normal((50, 2))
    blocks = list(known.predict_without_blocks(emulator, at))
    assert len(blocks) == 8
    (surface,) = emulator.surfaces
    if isinstance(model, GaussianProcess):
        model = replace(
            model,
            lengths=tuple(getattr(surface, "lengths", ())),
            nugget=getattr(surface, "nugget", 0),
        )
    for number, values in enumerate(blocks):
        block = known.blocks == number
        np.testing.assert_array_equal(left_out[block].shape, known.y[block].shape)
        rows = known.rows[~block[known.rows]]
        alone = fit_emulator(known.scaled(known.x[rows]), known.y[rows], tried=[model])
        low, high = known.y[rows].min(), known.y[rows].max()
        expected = np.clip(alone.values(known.scaled(at)), 2 * low - high, 2 * high - low)
        is_failed = ~np.isfinite(values)
        np.testing.assert_allclose(values[~is_failed], expected[~is_failed], rtol=1e-5, atol=1e-5)


def test_runs_that_determine_no_surface_are_refused() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        runs(two).fit([Polynomial(9)])


# -- the mixing weight of runs ---------------------------------------------------------------------

N = 256
Y = np.random.default_rng(5).standard_normal((N, 1))
EVEN = np.full((3, N), 1 / N)
BLOCKS = np.arange(N) % 8


def weight(predictions: Floats, y: Floats = Y, weights: Floats = EVEN) -> float:
    return weight_of_runs(weights, y, predictions, BLOCKS)


def test_an_emulator_counts_if_its_bias_is_small() -> None:
    noise = np.random.default_rng(6).standard_normal((N, 1))
    assert weight(Y + 1e-9) < 0.01
    assert weight(Y + 0.02 * noise) < 0.1
    assert min(weight(0 * Y), weight(Y + 1.0)) > 0.9
    # Few runs leave more to the emulator.
    uneven = np.zeros((1, N))
    uneven[:, :16] = 1 / 16
    assert weight(Y + 0.3, weights=uneven) < weight(Y + 0.3)
    # A rounding is no bias where many specimens have one value.
    capped = np.minimum(Y, 0.5)
    assert weight(capped + 1e-3 * noise, capped) < 0.01
    assert weight(capped + 0.5, capped) > 0.5


@pytest.mark.parametrize("lost", [np.nan, np.inf])
def test_a_failure_that_the_emulator_does_not_predict_is_a_bias(lost: float) -> None:
    failed = np.where(Y > 0.5, lost, Y)
    assert weight(Y, failed) >= 0.0
    assert weight(failed) > 0.5


def test_levels_are_where_the_populations_are() -> None:
    # A tenth of the runs are where the populations are, a thousandth as wide as the others.
    here = np.arange(440)[:, None] >= 400
    z = np.random.default_rng(5).standard_normal((440, 1))
    y = np.where(here, 1e-3 * z, z)
    weights, blocks = np.repeat(here.T / 40, 3, axis=0), np.arange(440) % 8
    assert weight_of_runs(weights, y, np.where(here, 3 * y, y), blocks) > 0.5
    assert weight_of_runs(weights, y, np.where(here, y, y + 2.0), blocks) < 0.01
