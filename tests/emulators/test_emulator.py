"""The emulator: identities of its surfaces, derivatives, left-out errors, variance and units."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from prbayes._validate import Floats
from prbayes.emulators import kriging
from prbayes.emulators.emulator import CANDIDATES, fit_emulator
from prbayes.emulators.kriging import (
    KERNELS,
    Polynomials,
    fit_kriging,
    negative_log_likelihood,
)
from prbayes.numerics.points import sobol

RUNS = {1: 16, 2: 48, 3: 80, 8: 120}


def design(n: int, d: int, seed: int = 0) -> Floats:
    return 4 * sobol(n, d, seed) - 2


def smooth(z: Floats) -> Floats:
    """Return two outputs of any number of inputs, (n, d) -> (n, 2)."""
    projected = z @ (1 / np.arange(1, z.shape[1] + 1))
    return np.stack([np.exp(0.5 * projected), np.sin(projected) + z[:, 0] ** 2], axis=1)


@pytest.mark.parametrize("d", RUNS)
@pytest.mark.parametrize("kernel", KERNELS)
def test_runs_are_interpolated_and_the_jacobian_is_the_derivative(kernel: str, d: int) -> None:
    z = design(RUNS[d], d)
    emulator = fit_emulator(z, smooth(z), tried=(kernel,))
    # To the nugget, which is far below the error between runs.
    left_out = np.sqrt((emulator.left_out**2).mean(axis=0))
    at_runs = np.abs(emulator.values(z) - smooth(z)).max(axis=0)
    assert (at_runs < 1e-7 * smooth(z).std(axis=0) + 0.05 * left_out).all()
    # Beside runs too, where radial functions have their centers.
    points = np.concatenate([np.random.default_rng(0).uniform(-2.2, 2.2, (20, d)), z[:5]])
    values, jacobian = emulator(points)
    np.testing.assert_allclose(values, emulator.values(points), rtol=1e-6, atol=1e-6)
    steps = 1e-2 * np.eye(d)
    for a, step in enumerate(steps):
        by_step = [
            emulator.values(points + s * step) - emulator.values(points - s * step) for s in (1, 2)
        ]
        difference = (8 * by_step[0] - by_step[1]) / 12e-2
        np.testing.assert_allclose(jacobian[:, :, a], difference, rtol=1e-6, atol=5e-6)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_left_out_errors_are_those_of_refits(kernel: str, degree: int) -> None:
    if kernel == "quintic" and degree < 2:
        pytest.skip("the quintic kernel needs a polynomial of degree two")
    z = design(60, 2)
    y = smooth(z) + 0.1 * np.sin(9 * z[:, :1])

    def fit(rows: NDArray[np.intp]) -> kriging.Kriging:
        weights = np.full(len(rows), 1 / len(rows))
        surface = fit_kriging(z[rows], y[rows], weights, kernel, np.ones(2), [degree], [1e-10])
        assert surface is not None
        return surface

    left_out = fit(np.arange(60)).left_out
    for i in (0, 7, 59):
        others = np.delete(np.arange(60), i)
        error = y[i] - fit(others).values(z[i : i + 1])[0]
        np.testing.assert_allclose(left_out[i], error, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_variance_is_that_of_the_closed_form(kernel: str) -> None:
    """With weights u, B' u = t, the error u' y - y(z) has variance k(0) - 2 u' k + u' K u."""
    z, points = design(40, 2), design(16, 2, seed=5)
    surface = fit_kriging(z, smooth(z), np.full(40, 1 / 40), kernel, np.ones(2), [2], [1e-12])
    assert surface is not None
    polynomials, values = Polynomials.of(z, 2), []

    def kernels(a: Floats, b: Floats) -> Floats:
        return KERNELS[kernel](((a[:, None] - b) ** 2).sum(axis=2))[0]

    matrix, terms = kernels(z, z), polynomials(z)
    matrix += 1e-12 * np.abs(matrix).max() * np.eye(40)
    system = np.block([[matrix, terms.T], [terms, np.zeros((len(terms),) * 2)]])
    right = np.concatenate([kernels(z, points), polynomials(points)])
    values = kernels(points[:1], points[:1])[0] - (right * np.linalg.solve(system, right)).sum(0)
    np.testing.assert_allclose(
        surface.variance(points), values[:, None] * surface.scales, rtol=1e-4, atol=1e-9
    )


@pytest.mark.parametrize("tried", [("squared_exponential",), ("quintic",)])
def test_the_variance_is_zero_at_runs_and_grows_between(tried: tuple[str, ...]) -> None:
    z = np.linspace(-2, 2, 12)[:, None]
    emulator = fit_emulator(z, np.sin(4 * z), tried=tried)
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
    basis = np.linalg.qr(Polynomials.of(z, 1)(z).T)[0]
    y = smooth(z)[:, 0] - basis @ (basis.T @ smooth(z)[:, 0])
    at = np.log([1.3, 2.0, 3.5, 1e-4])
    _, gradient = negative_log_likelihood(at, KERNELS[kernel], z, y, basis)
    for a, step in enumerate(1e-5 * np.eye(4)):
        ends = [
            negative_log_likelihood(at + s, KERNELS[kernel], z, y, basis)[0] for s in (step, -step)
        ]
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
    monkeypatch.setattr("prbayes.emulators.emulator.MOST_RUNS", 40)
    z = design(64, 2)
    near = (np.abs(z) < 1).all(axis=1)
    emulator = fit_emulator(z, smooth(z), near, tried=("quintic",))
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
    for kernel in CANDIDATES:
        emulator = fit_emulator(z, smooth(z), tried=(kernel,))
        values, jacobian = emulator(points)
        with monkeypatch.context() as patch:
            patch.setattr(kriging, "IN_CACHE", 48 * 5)
            for array, blocked in zip((values, jacobian), emulator(points), strict=True):
                np.testing.assert_allclose(blocked, array, rtol=1e-7, atol=1e-7)
        assert [x.shape for x in emulator(points[:0])] == [(0, 2), (0, 2, 2)]
        assert emulator.variance(points[:0]).shape == (0, 2)
