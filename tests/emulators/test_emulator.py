"""The emulator: identities of its surfaces, derivatives, left-out errors, variance and units."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from prbayes._validate import Floats
from prbayes.emulators import kriging
from prbayes.emulators.emulator import CANDIDATES, fit_emulator
from prbayes.emulators.gaussian_process import GaussianProcess
from prbayes.emulators.kriging import (
    KERNELS,
    Kriging,
    Polynomials,
    fit_kriging,
    negative_log_likelihood,
)
from prbayes.emulators.radial_basis import RadialBasis
from prbayes.emulators.surfaces import Polynomial, Surface
from prbayes.numerics.points import sobol

RUNS = {1: 16, 2: 48, 3: 80, 8: 120}


LOWEST = {
    "squared_exponential": 0,
    "matern": 0,
    "linear": 0,
    "thin_plate_spline": 1,
    "cubic": 1,
    "quintic": 2,
}


def design(n: int, d: int, seed: int = 0) -> Floats:
    return 4 * sobol(n, d, seed) - 2


def smooth(z: Floats) -> Floats:
    """Return two outputs of any number of inputs, (n, d) -> (n, 2)."""
    projected = z @ (1 / np.arange(1, z.shape[1] + 1))
    return np.stack([np.exp(0.5 * projected), np.sin(projected) + z[:, 0] ** 2], axis=1)


SURFACES = (
    *(GaussianProcess(kernel) for kernel in ("squared_exponential", "matern")),
    GaussianProcess(degree=2),
    *(RadialBasis(kernel) for kernel in ("cubic", "thin_plate_spline", "quintic")),
)


@pytest.mark.parametrize("d", RUNS)
@pytest.mark.parametrize("model", SURFACES, ids=str)
def test_runs_are_interpolated_and_the_jacobian_is_the_derivative(model: Surface, d: int) -> None:
    z = design(RUNS[d], d)
    emulator = fit_emulator(z, smooth(z), tried=(model,))
    # To the nugget, which is far below the error between runs.
    left_out = np.sqrt((emulator.left_out**2).mean(axis=0))
    at_runs = np.abs(emulator.values(z) - smooth(z)).max(axis=0)
    assert (at_runs < 1e-7 * smooth(z).std(axis=0) + 0.05 * left_out).all()
    points = np.random.default_rng(0).uniform(-2.2, 2.2, (20, d))
    if model != RadialBasis("thin_plate_spline"):  # whose curvature at a run is infinite
        points = np.concatenate([points, z[:5]])
    values, jacobian = emulator(points)
    np.testing.assert_allclose(values, emulator.values(points), rtol=1e-6, atol=1e-6)
    # Shorter ones, with rounding, where the third derivative jumps at runs.
    size = 1e-2 if model in (GaussianProcess(), GaussianProcess(degree=2)) else 1e-4
    steps = size * np.eye(d)
    for a, step in enumerate(steps):
        by_step = [
            emulator.values(points + s * step) - emulator.values(points - s * step) for s in (1, 2)
        ]
        difference = (8 * by_step[0] - by_step[1]) / (12 * size)
        np.testing.assert_allclose(jacobian[:, :, a], difference, rtol=1e-6, atol=5e-6)


SYSTEMS = [(kernel, degree) for kernel, lowest in LOWEST.items() for degree in {lowest, 2}]


@pytest.mark.parametrize(("kernel", "degree"), SYSTEMS)
def test_left_out_errors_are_those_of_refits(kernel: str, degree: int) -> None:
    z, points = design(60, 2), design(10, 2, seed=5)
    y = smooth(z)[:, 0] + 0.1 * np.sin(9 * z[:, 0])

    def fit(rows: Any) -> Kriging:
        weights = np.full(len(rows), 1 / len(rows))
        surface = fit_kriging(z[rows], y[rows], weights, kernel, np.ones(2), [degree], [1e-9])
        assert surface is not None
        return surface

    surface = fit(np.arange(60))
    for block in ([0], [59], [7, 20, 31]):
        mask = np.isin(np.arange(60), block)
        refit = fit(np.flatnonzero(~mask))
        (without,) = surface.without_each(mask[None])
        for at in (points, z[block]):
            np.testing.assert_allclose(without.values(at), refit.values(at), atol=1e-5)
        if len(block) == 1:
            error = y[block] - refit.values(z[block])
            np.testing.assert_allclose(surface.left_out[block], error, atol=1e-5)


@pytest.mark.parametrize(("kernel", "degree"), SYSTEMS)
def test_means_and_variances_are_those_of_the_closed_form(kernel: str, degree: int) -> None:
    """Predictions are u' y, and their errors have the variance k(0) - 2 u' k + u' K u."""
    z, points = design(40, 2), design(16, 2, seed=5)
    y, weights = smooth(z)[:, 0], np.full(40, 1 / 40)
    surface = fit_kriging(z, y, weights, kernel, np.ones(2), [degree], [1e-9])
    assert surface is not None
    polynomials = Polynomials.of(z, degree)

    def kernels(a: Floats, b: Floats) -> Floats:
        return KERNELS[kernel](((a[:, None] - b) ** 2).sum(axis=2))[0]

    matrix, terms = kernels(z, z), polynomials(z)
    matrix += 1e-9 * np.abs(matrix).max() * np.eye(40)
    system = np.block([[matrix, terms.T], [terms, np.zeros((len(terms),) * 2)]])
    right = np.concatenate([kernels(z, points), polynomials(points)])
    solution = np.linalg.solve(system, right)
    np.testing.assert_allclose(surface.values(points), solution[:40].T @ y, atol=1e-6)
    variance = kernels(points[:1], points[:1])[0] - (right * solution).sum(axis=0)
    expected = variance * surface.scale
    np.testing.assert_allclose(surface.variance(points), expected, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("tried", [*CANDIDATES, Polynomial(3)], ids=str)
def test_the_variance_is_zero_at_runs_and_grows_between(tried: Surface) -> None:
    z = np.linspace(-2, 2, 12)[:, None]
    emulator = fit_emulator(z, np.sin(4 * z), tried=[tried])
    between = (z[1:] + z[:-1]) / 2
    at_runs, at_middle = emulator.variance(z), emulator.variance(between)
    assert (at_runs[1:] < 1e-2 * at_middle).all()
    # Larger beyond the runs, and of the size of the squared errors.
    assert (emulator.variance(2.0 + np.array([[0.5], [1.0]])) > at_middle[-1]).all()
    errors = emulator.values(between) - np.sin(4 * between)
    assert 0.05 < np.sqrt((errors**2).mean() / at_middle.mean()) < 5


@pytest.mark.parametrize("kernel", ["squared_exponential", "matern"])
def test_the_gradient_of_the_likelihood_is_its_derivative(kernel: str) -> None:
    z = design(30, 3)
    basis, root = np.linalg.qr(Polynomials.of(z, 1)(z).T)
    y = smooth(z)[:, 0] - basis @ (basis.T @ smooth(z)[:, 0])
    problem = KERNELS[kernel], z, y, basis, root
    at = np.log([1.3, 2.0, 3.5, 1e-4])
    _, gradient = negative_log_likelihood(at, *problem)
    for a, step in enumerate(1e-5 * np.eye(4)):
        ends = [negative_log_likelihood(at + s, *problem)[0] for s in (step, -step)]
        assert gradient[a] == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-5, abs=1e-6)


def test_neither_order_nor_units_matter() -> None:
    z, elsewhere = design(48, 2), design(16, 2, seed=5)
    values, jacobian = fit_emulator(z, smooth(z))(elsewhere)
    rows = np.random.default_rng(0).permutation(len(z))
    of_inputs, at = np.array([1e3, 1e-4]), np.array([5.0, -2.0])
    unit, offset = np.array([1e6, 1e-6]), np.array([-3e6, 2e-6])
    other = fit_emulator(z[rows] * of_inputs + at, unit * smooth(z)[rows] + offset)
    other_values, other_jacobian = other(elsewhere * of_inputs + at)
    np.testing.assert_allclose((other_values - offset) / unit, values, atol=1e-4)
    np.testing.assert_allclose(other_jacobian * of_inputs / unit[:, None], jacobian, atol=1e-3)


def test_constant_equal_and_linear_outputs() -> None:
    z, elsewhere = design(24, 3), design(16, 3, seed=5)

    def outputs(z: Floats) -> Floats:
        y = smooth(z)[:, 0]
        return np.stack([np.full(len(z), 0.1), y, y, 1e8 + z[:, 0] - 2 * z[:, 1]], axis=1)

    for copies in (1, 3):  # with principal components too
        y = np.tile(outputs(z), copies)
        emulator = fit_emulator(z, y)
        assert (emulator.components is None) == (copies == 1)
        values, jacobian = emulator(elsewhere)
        np.testing.assert_array_equal(values[:, 0], 0.1)
        np.testing.assert_array_equal(jacobian[:, 0], 0.0)
        np.testing.assert_allclose(values[:, 1], values[:, 2], rtol=1e-9)
        np.testing.assert_allclose(values[:, 3], outputs(elsewhere)[:, 3], rtol=1e-12)
        np.testing.assert_allclose(jacobian[:, 3], [[1, -2, 0]] * 16, atol=1e-5)
        assert np.isfinite(emulator.variance(elsewhere)).all()


def test_principal_components_equal_separate_outputs_to_their_tolerance() -> None:
    z, elsewhere, t = design(40, 2), design(50, 2, seed=5), np.linspace(0, 1, 30)

    def curves(z: Floats) -> Floats:
        return np.exp(0.4 * z[:, :1] * t) + z[:, 1:] * np.sin(3 * t + z[:, :1])

    joint = fit_emulator(z, curves(z))
    assert joint.components is not None
    assert len(joint.components) < 15
    separate = np.concatenate(
        [fit_emulator(z, column[:, None]).values(elsewhere) for column in curves(z).T], axis=1
    )
    spread, exact = curves(z).std(axis=0), curves(elsewhere)
    errors = [np.sqrt(((v - exact) ** 2).mean()) for v in (joint.values(elsewhere), separate)]
    assert errors[0] < 3 * errors[1] + 1e-5
    # What is left at the runs is far below the left-out errors.
    at_runs = np.abs(joint.values(z) - curves(z)).max() / spread.max()
    assert at_runs < 0.3 * np.sqrt((joint.left_out**2).mean()) + 1e-6


def test_contradicting_close_runs_are_smoothed() -> None:
    """The last digits of a response must not become steep slopes."""
    z = design(40, 2)
    close = np.concatenate([z, z + 1e-6])
    noise = 1e-7 * np.random.default_rng(0).normal(size=(80, 2))
    values, jacobian = fit_emulator(close, smooth(close) + noise)(z)
    assert np.abs(values - smooth(z)).max() < 1e-3
    assert np.abs(jacobian).max() < 10


def test_runs_nearby_select_the_surface() -> None:
    """Far from the data a kink decides nothing."""
    z = np.linspace(-1, 1, 60)[:, None]
    y = np.where(z > 0.5, np.abs(np.sin(25 * z)), 0.0) + z**5
    near = z[:, 0] < 0.2
    errors = [np.abs(fit_emulator(z, y, rows).left_out[near]).max() for rows in (near, None)]
    assert errors[0] <= errors[1]


def test_earlier_lengths_are_a_start() -> None:
    z = design(120, 4)
    first = fit_emulator(z[:80], smooth(z[:80]))
    emulator = fit_emulator(z, smooth(z), start=first)
    elsewhere = design(200, 4, seed=3)
    cold = fit_emulator(z, smooth(z))
    errors = [np.abs(e.values(elsewhere) - smooth(elsewhere)).max() for e in (emulator, cold)]
    assert errors[0] < 2 * errors[1]


def test_runs_beyond_the_most_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("prbayes.emulators.kriging.MOST_RUNS", 40)
    z = design(64, 2)
    near = (np.abs(z) < 1).all(axis=1)
    emulator = fit_emulator(z, smooth(z), near, tried=[RadialBasis("quintic")])
    errors = smooth(z) - emulator.values(z)
    is_left = np.abs(errors).max(axis=1) > 1e-6
    assert is_left.sum() == 24
    np.testing.assert_allclose(emulator.left_out[is_left], errors[is_left], atol=1e-7)


@pytest.mark.parametrize(("n", "d"), [(8, 1), (8, 8), (10, 5)])
def test_few_runs_suffice(n: int, d: int) -> None:
    z = design(n, d)
    emulator = fit_emulator(z, smooth(z))
    np.testing.assert_allclose(emulator.values(z), smooth(z), atol=1e-4)
    assert np.isfinite(emulator.left_out).all()


def test_blocks_have_the_same_values(monkeypatch: pytest.MonkeyPatch) -> None:
    z, points = design(48, 2), design(64, 2, seed=5)
    for model in CANDIDATES:
        emulator = fit_emulator(z, smooth(z), tried=[model])
        values, jacobian = emulator(points)
        with monkeypatch.context() as patch:
            patch.setattr(kriging, "IN_CACHE", 48 * 5)
            for array, blocked in zip((values, jacobian), emulator(points), strict=True):
                np.testing.assert_allclose(blocked, array, rtol=1e-7, atol=1e-7)
        assert [x.shape for x in emulator(points[:0])] == [(0, 2), (0, 2, 2)]
        assert emulator.variance(points[:0]).shape == (0, 2)


def test_outputs_of_single_points_have_surfaces_of_their_own_if_components_are_many() -> None:
    z, elsewhere = design(24, 2), design(9, 2, seed=5)
    angles = np.linspace(0, np.pi, 8)
    phases = np.random.default_rng(1).uniform(0, 6, 8)

    def waves(z: Floats) -> Floats:
        return np.sin(1.2 * (z @ np.stack([np.cos(angles), np.sin(angles)])) + phases)

    tried = [GaussianProcess(degree=1)]
    joint = fit_emulator(z, waves(z), tried=tried, of_point=2)
    # An emulator of components is no start for surfaces of outputs.
    separate = fit_emulator(z, waves(z), tried=tried, of_point=1, start=joint)
    assert joint.components is not None
    assert separate.components is None
    columns = np.random.default_rng(0).integers(0, 8, (9, 2))
    rows = np.arange(9)[:, None]
    for emulator in (joint, separate):
        values, jacobian = emulator(elsewhere)
        own, slopes = emulator(elsewhere, columns)
        np.testing.assert_allclose(own, values[rows, columns], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(slopes, jacobian[rows, columns], rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(emulator.values(elsewhere, columns), own, rtol=1e-9, atol=1e-11)
    assert np.abs(separate.values(elsewhere) - waves(elsewhere)).max() < 0.02
