"""The error of a surrogate: what points that were left out show."""

from typing import Any

import numpy as np
import pytest

import prbayes as prb
from prbayes.emulators.cross_validation import (
    FOLDS,
    CrossValidation,
    cross_validated,
    points_needed,
)
from prbayes.emulators.surfaces import Surface

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
