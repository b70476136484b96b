"""The quintic interpolant: exactness, derivatives, left-out errors, close runs and convergence."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from prbayes._validate import Floats
from prbayes.emulators import interpolant
from prbayes.emulators.interpolant import fit_interpolant
from prbayes.numerics.points import sobol


def design(n: int, d: int, seed: int = 0) -> Floats:
    return 2 * sobol(n, d, seed) - 1


def smooth(z: Floats) -> Floats:
    """Return two outputs of any number of inputs, (n, d) -> (n, 2)."""
    projected = z @ (1 / np.arange(1, z.shape[1] + 1))
    return np.stack([np.exp(0.7 * projected), np.sin(1.5 * projected) + z[:, 0] ** 2], axis=1)


RUNS = {1: 24, 2: 48, 3: 96, 6: 200}
ELSEWHERE = design(16, 2, seed=5)


@pytest.mark.parametrize("d", RUNS)
def test_polynomials_of_degree_two_are_reproduced(d: int) -> None:
    rng = np.random.default_rng(d)
    constant, slope = rng.normal(size=3), rng.normal(size=(d, 3))
    curvature = rng.normal(size=(d, d, 3))

    def quadratic(z: Floats) -> Floats:
        return constant + z @ slope + np.einsum("na,abm,nb->nm", z, curvature, z)

    z = design(RUNS[d], d)
    surface = fit_interpolant(z, quadratic(z))
    elsewhere = rng.uniform(-1, 1, (50, d))
    values, jacobian = surface(elsewhere)
    np.testing.assert_allclose(values, quadratic(elsewhere), atol=1e-8)
    exact = slope.T + np.einsum("abm,nb->nma", curvature + curvature.swapaxes(0, 1), elsewhere)
    np.testing.assert_allclose(jacobian, exact, atol=1e-6)
    assert np.abs(surface.left_out).max() < 1e-7


def test_a_polynomial_of_degree_five_of_two_inputs_is_reproduced() -> None:
    def response(z: Floats) -> Floats:
        return z[:, :1] ** 3 * z[:, 1:] ** 2

    z = design(80, 2)
    surface = fit_interpolant(z, response(z))
    assert surface.powers.sum(axis=1).max() >= 5
    np.testing.assert_allclose(surface.values(ELSEWHERE), response(ELSEWHERE), atol=1e-8)


@pytest.mark.parametrize("d", RUNS)
def test_runs_are_interpolated_and_the_jacobian_is_the_derivative(d: int) -> None:
    z = design(RUNS[d], d)
    surface = fit_interpolant(z, smooth(z))
    np.testing.assert_allclose(surface.values(z), smooth(z), atol=1e-6)
    # Beside runs too, where the radial functions have their centers
    points = np.concatenate([np.random.default_rng(0).uniform(-1.2, 1.2, (20, d)), z[:5]])
    values, jacobian = surface(points)
    np.testing.assert_allclose(values, surface.values(points), rtol=1e-10, atol=1e-12)
    for a in range(d):
        shift = 1e-5 * np.eye(d)[a]
        difference = (surface.values(points + shift) - surface.values(points - shift)) / 2e-5
        np.testing.assert_allclose(jacobian[:, :, a], difference, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_left_out_errors_are_those_of_refits(d: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interpolant, "_degrees", lambda n, d: [2])  # the same one in refits
    z = design(RUNS[d], d)
    y = smooth(z) + 0.1 * np.sin(20 * z[:, :1])
    surface = fit_interpolant(z, y)
    for i in (0, 7, RUNS[d] - 1):
        others = np.delete(np.arange(len(z)), i)
        error = y[i] - fit_interpolant(z[others], y[others]).values(z[i : i + 1])[0]
        # To the nugget, 1e-16 to 1e-8 of the kernel.
        np.testing.assert_allclose(surface.left_out[i], error, rtol=1e-3, atol=1e-6)


def test_contradicting_close_runs_are_smoothed() -> None:
    """The last digits of a response must not become steep slopes."""
    z = design(40, 2)
    close = np.concatenate([z, z + 1e-6])
    noise = 1e-7 * np.random.default_rng(0).normal(size=(80, 2))
    values, jacobian = fit_interpolant(close, smooth(close) + noise)(z)
    assert np.abs(values - smooth(z)).max() < 1e-3
    assert np.abs(jacobian).max() < 10


@pytest.mark.parametrize(("d", "sizes"), [(1, (8, 12, 24)), (2, (24, 48, 96))])
def test_the_error_falls_with_the_number_of_runs(d: int, sizes: tuple[int, ...]) -> None:
    errors: list[Any] = []
    elsewhere = np.random.default_rng(2).uniform(-0.8, 0.8, (100, d))
    for n in sizes:
        z = design(n, d)
        off = fit_interpolant(z, smooth(z)).values(elsewhere) - smooth(elsewhere)
        errors.append(np.abs(off).max())
    assert errors[0] > 3 * errors[1] > 9 * errors[2]


def test_neither_order_nor_units_nor_a_constant_output_matter() -> None:
    z = design(48, 2)
    y = np.column_stack([smooth(z), np.full(48, 3.5)])
    values, jacobian = fit_interpolant(z, y)(ELSEWHERE)
    np.testing.assert_allclose(values[:, 2], 3.5, atol=1e-9)
    np.testing.assert_allclose(jacobian[:, 2], 0.0, atol=1e-8)
    rows = np.random.default_rng(0).permutation(len(z))
    unit, offset = np.array([1e6, 1e-6, 1.0]), np.array([-3e6, 2e-6, 0.0])
    other_values, other_jacobian = fit_interpolant(z[rows], (unit * y + offset)[rows])(ELSEWHERE)
    np.testing.assert_allclose((other_values - offset) / unit, values, atol=1e-8)
    np.testing.assert_allclose(other_jacobian / unit[:, None], jacobian, atol=1e-6)


def test_points_in_blocks_have_the_same_values(monkeypatch: pytest.MonkeyPatch) -> None:
    z = design(48, 2)
    surface = fit_interpolant(z, smooth(z))
    points = design(64, 2, seed=5)
    values, jacobian = surface(points)
    monkeypatch.setattr(interpolant, "IN_CACHE", 48 * 5)
    values_in_blocks, jacobian_in_blocks = surface(points)
    np.testing.assert_allclose(values_in_blocks, values, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(jacobian_in_blocks, jacobian, rtol=1e-10, atol=1e-12)
    assert [x.shape for x in surface(points[:0])] == [
        (0, values.shape[1]),
        (0, *jacobian.shape[1:]),
    ]
    assert surface.values(points[:0]).shape == (0, values.shape[1])


def test_runs_nearby_select_the_degree() -> None:
    """Far from the data a kink needs no polynomial, near them the response is one of degree five."""
    z = np.linspace(-1, 1, 60)[:, None]
    y = np.where(z > 0.5, np.abs(np.sin(25 * z)), 0.0) + z**5
    near = z[:, 0] < 0.2
    errors = [np.abs(fit_interpolant(z, y, rows).left_out[near]).max() for rows in (near, None)]
    assert errors[0] <= errors[1]


def test_too_few_points_are_refused() -> None:
    line = np.linspace(-1, 1, 10)
    with pytest.raises(np.linalg.LinAlgError, match="got 10 points that determine no surface of 2"):
        fit_interpolant(np.stack([line, np.zeros(10)], axis=1), line[:, None])


def test_pieces_of_one_input_are_the_radial_functions() -> None:
    z = np.sort(np.random.default_rng(3).uniform(-1, 1, 40))[:, None]
    surface = fit_interpolant(z, np.concatenate([np.exp(z), np.sin(5 * z)], axis=1))
    points = np.concatenate([np.linspace(-1.2, 1.2, 200)[:, None], z])
    radial = -(np.abs(points - z.T) ** 5) @ surface.weights
    u = (points[:, 0] - surface.center) / surface.half_width
    vander = np.polynomial.legendre.legvander(u, surface.powers.max())
    expected = radial + vander[:, surface.powers[:, 0]] @ surface.coefficients
    np.testing.assert_allclose(surface.values(points), expected, rtol=1e-10, atol=1e-11)
