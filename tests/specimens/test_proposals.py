"""Integrals over the inputs of specimens by importance points, against closed forms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from scipy.special import logsumexp, ndtri
from scipy.stats import multivariate_normal, ncx2, norm, rice
from scipy.stats import t as student

from prbayes._validate import Floats
from prbayes.numerics.points import sobol
from prbayes.specimens.proposals import (
    Modes,
    Normal,
    Proposals,
    Residuals,
    find_modes,
    mixing_weights,
    with_covered_fibres,
    without_covered,
)


def differentiated(function: Callable[[Any], Any]) -> Callable[[Floats], tuple[Floats, Floats]]:
    """Return the response z -> (values, Jacobian) of an analytic function, by complex steps."""

    def response(z: Floats) -> tuple[Floats, Floats]:
        columns = [function(z + 1e-30j * e).imag / 1e-30 for e in np.eye(z.shape[1])]
        return function(z), np.stack(columns, axis=-1)

    return response


def linear(a: Floats) -> Callable[[Floats], tuple[Floats, Floats]]:
    return lambda z: (z @ a.T, np.broadcast_to(a, (len(z), *a.shape)))


def independent(mean: Any, sd: Any) -> Normal:
    return Normal(np.asarray(mean, dtype=float), np.diag(np.asarray(sd, dtype=float)))


def residuals_of(
    response: Any, y: Floats, sd: Any, reference: Normal, known: Floats | None = None
) -> Residuals:
    nothing = np.full((len(y), len(reference.mean)), np.nan)
    sd = np.broadcast_to(np.asarray(sd, dtype=float), y.shape)
    known = nothing if known is None else known
    return Residuals(response, y, np.zeros_like(y), sd, np.zeros_like(y), reference, known)


def proposals_of(residuals: Residuals, scales: tuple[float, ...] = (1.0,)) -> Proposals:
    d = len(residuals.free)
    starts = np.tile(1.5 * ndtri(sobol(16, d, 0)), (len(residuals.target), 1, 1))
    modes = Modes.joined([find_modes(residuals, starts, scale=scale) for scale in scales])
    return Proposals.at_modes(residuals, modes)


def log_likelihoods(
    proposals: Proposals, population: Normal, count: int, seed: int = 1, scale: float = 1.0
) -> Floats:
    """Return log p(y_i | theta), (N,), of a normal population, by equation (1)."""
    residuals = proposals.residuals
    z, log_q, _ = proposals.draw(count, seed)
    n, k, d = z.shape
    values = residuals.response(z.reshape(-1, d))[0].reshape(n, k, -1)
    sd = scale * residuals.error[:, None]
    sd = np.hypot(sd, scale * residuals.relative[:, None] * values)
    log_y = norm(0, sd).logpdf(residuals.target[:, None] - values)
    log_y = np.where(np.isinf(sd), 0.0, log_y).sum(axis=2)
    free = z[..., residuals.free].reshape(n * k, -1)
    covariance = population.root @ population.root.T
    log_p = multivariate_normal(population.mean, covariance).logpdf(free).reshape(n, k)
    terms = np.where(np.isfinite(log_q), log_p + log_y - log_q, -np.inf)
    return np.asarray(logsumexp(terms, axis=1))


@dataclass(frozen=True)
class Problem:
    """A response, readings, a population, and the exact log-densities of the readings."""

    response: Any
    y: Floats
    sd: Floats | float
    reference: Normal
    population: Normal
    exact: Floats

    def proposals(self) -> Proposals:
        return proposals_of(residuals_of(self.response, self.y, self.sd, self.reference))


def linear_problem(d: int, m: int, size: float) -> Problem:
    rng = np.random.default_rng([d, m])
    a = rng.standard_normal((m, d))
    sd = size * np.linspace(1, 2, m)
    y = rng.standard_normal((8, d)) @ a.T + sd * rng.standard_normal((8, m))
    population = independent(np.full(d, 0.1), np.linspace(0.8, 0.9, d))
    cov = a @ population.root**2 @ a.T + np.diag(sd**2)
    exact = multivariate_normal(a @ population.mean, cov).logpdf(y)
    return Problem(linear(a), y, sd, independent(np.zeros(d), np.ones(d)), population, exact)


EXACT = 1e-5  # error of a reading that is next to exact


def curved_problem(name: str) -> Problem:
    mean, sd = np.array([0.3, -0.2]), 0.9
    population = independent(mean, [sd, sd])
    reference = independent([0.0, 0.0], [1.0, 1.0])
    if name == "radius":
        y = np.linspace(0.3, 2.5, 12)
        response = differentiated(lambda z: np.sqrt((z**2).sum(axis=1, keepdims=True)))
        exact = rice(np.hypot(*mean) / sd, scale=sd).logpdf(y)
    elif name == "ring":
        y = np.linspace(0.3, 6, 12)
        response = differentiated(lambda z: (z**2).sum(axis=1, keepdims=True))
        exact = ncx2(2, (mean**2).sum() / sd**2, scale=sd**2).logpdf(y)
    elif name == "parabola":  # two branches of the first input for each value of the second
        y = np.linspace(-1, 3, 12)
        response = differentiated(lambda z: z[:, :1] ** 2 + z[:, 1:])
        grid = np.linspace(-9, 9, 20_001)
        density = norm(0.3, sd).pdf(grid) * norm(-0.2, sd).pdf(y[:, None] - grid**2)
        exact = np.log(density.sum(axis=1) * (grid[1] - grid[0]))
    else:  # three roots of 4 a^3 - 3 a = cos(3 angle), which are cosines
        angle = np.linspace(0.15, np.pi / 3 - 0.15, 12)
        y = np.cos(3 * angle)
        response = differentiated(lambda z: 4 * z**3 - 3 * z)
        roots = np.cos(angle[:, None] + 2 * np.pi / 3 * np.arange(3))
        population, reference = independent([0.3], [sd]), independent([0.0], [1.0])
        density = norm(0.3, sd).pdf(roots) / np.abs(12 * roots**2 - 3)
        exact = np.log(density.sum(axis=1))
    return Problem(response, y[:, None], EXACT, reference, population, exact)


LINEAR = pytest.mark.parametrize(("d", "m"), [(1, 1), (2, 1), (3, 2), (2, 3)])


@LINEAR
@pytest.mark.parametrize("size", [1e-3, 1.0])
def test_one_point_is_exact_of_a_linear_response_and_the_reference(
    d: int, m: int, size: float
) -> None:
    """The proposal is then the density of the inputs given the readings; Student's t widens it."""
    p = linear_problem(d, m, size)
    _, (a, *_) = p.response(np.zeros((1, d)))
    exact = multivariate_normal(cov=a @ a.T + np.diag(np.square(p.sd))).logpdf(p.y)
    proposals = p.proposals()
    z, *_ = proposals.draw(1, 1)
    mode = np.arange(len(p.y))
    xi, _ = proposals.mapped(mode, proposals.residuals.whitened(z[:, 0]))
    open_axes = np.where(proposals.open_axes, norm.logpdf(xi) - student.logpdf(xi, 5), 0.0)
    exact += open_axes.sum(axis=1)
    np.testing.assert_allclose(log_likelihoods(proposals, p.reference, 1), exact, rtol=1e-6)


# Standard errors of log L with 1024 points: largest root mean square error of a specimen, 8 seeds.
LINEAR_ERROR = 9e-4
KNOWN_ERROR, PARTIAL_ERROR, SCALE_ERROR = 4e-3, 8e-4, 4e-3
RELATIVE_ERROR = 1e-3
UNEVEN_ERROR, TURNING_ERROR = 3e-3, 4e-3  # the latter of 8192 points
CURVED_ERRORS = {"radius": 4.8e-3, "ring": 4.3e-3, "parabola": 2.0e-3, "cubic": 2e-5}


@LINEAR
@pytest.mark.parametrize("size", [0.05, 1.0])
def test_a_linear_response_of_another_population(d: int, m: int, size: float) -> None:
    p = linear_problem(d, m, size)
    error = log_likelihoods(p.proposals(), p.population, 1024) - p.exact
    assert np.abs(error).max() < 5 * LINEAR_ERROR


@pytest.mark.parametrize("name", CURVED_ERRORS)
def test_a_curved_response_has_its_closed_form(name: str) -> None:
    p = curved_problem(name)
    error = log_likelihoods(p.proposals(), p.population, 1024) - p.exact
    assert np.abs(error).max() < 5 * CURVED_ERRORS[name]


@pytest.mark.parametrize(("low", "high"), [(-0.3, -0.1), (-0.05, 0.05), (0.1, 0.5), (0.6, 1.0)])
def test_both_sides_of_a_turning_point(low: float, high: float) -> None:
    """Both roots of y = a^2 merge near zero, and some readings are beyond the response."""
    y, sd = np.linspace(low, high, 9)[:, None], 0.1
    grid = np.linspace(-6, 6, 20_001)
    density = norm(0.1, 0.6).pdf(grid) * norm(grid**2, sd).pdf(y)
    exact = np.log(density.sum(axis=1) * (grid[1] - grid[0]))
    residuals = residuals_of(differentiated(lambda z: z**2), y, sd, independent([0.0], [1.0]))
    error = log_likelihoods(proposals_of(residuals), independent([0.1], [0.6]), 8192) - exact
    assert np.abs(error).max() < 5 * TURNING_ERROR


@pytest.mark.parametrize("name", ["ring", "parabola", "cubic"])
def test_modes_in_the_bulk_of_others_are_not_needed(name: str) -> None:
    p = curved_problem(name)
    # Two proposals at each mode: the copies go.
    all_modes = p.proposals()
    twice = Modes.joined([all_modes.modes] * 2)
    proposals = without_covered(Proposals.at_modes(all_modes.residuals, twice))
    assert len(proposals.modes.a) <= len(all_modes.modes.a)
    if name == "cubic":
        assert np.bincount(proposals.modes.specimen).tolist() == [3] * 12
    error = log_likelihoods(proposals, p.population, 1024) - p.exact
    assert np.abs(error).max() < 5 * CURVED_ERRORS[name]


def test_points_count_with_the_density_of_all_proposals_that_reach_them() -> None:
    """A proposal that is there twice changes neither the density nor the integral."""
    p = curved_problem("cubic")
    once = p.proposals()
    twice = Proposals.at_modes(once.residuals, Modes.joined([once.modes] * 2))
    of_one = log_likelihoods(once, p.population, 64)
    of_two = log_likelihoods(twice, p.population, 64)
    np.testing.assert_allclose(of_two, of_one, atol=5 * 4e-4)


def test_mixing_weights_change_the_points_and_not_the_integral() -> None:
    p = curved_problem("parabola")
    proposals = p.proposals()
    mass = np.arange(len(proposals.share)) % 2 * 1.0  # none of every other mode
    uneven = replace(proposals, share=mixing_weights(proposals.modes, mass))
    totals = np.bincount(uneven.modes.specimen, uneven.share)
    np.testing.assert_allclose(totals, 1)
    assert (uneven.share * np.bincount(uneven.modes.specimen)[uneven.modes.specimen] > 0.099).all()
    assert np.ptp(uneven.share) > 0.3
    error = log_likelihoods(uneven, p.population, 1024) - p.exact
    assert np.abs(error).max() < 5 * UNEVEN_ERROR


def test_a_known_coordinate_is_not_integrated_over() -> None:
    """y = exp(b) a with known b; the population is that of a."""
    b = np.linspace(-1, 1, 7)
    y = np.linspace(-1.5, 2, 7)[:, None]
    response = differentiated(lambda z: z[:, 1:] * np.exp(z[:, :1]))
    known = np.stack([b, np.full(7, np.nan)], axis=1)
    residuals = residuals_of(response, y, 0.2, independent([0.0], [1.0]), known)
    proposals = proposals_of(residuals)
    z, *_ = proposals.draw(4, 0)
    assert (z[..., 0] == b[:, None]).all()
    exact = norm(0.2 * np.exp(b), np.hypot(0.8 * np.exp(b), 0.2)).logpdf(y[:, 0])
    error = log_likelihoods(proposals, independent([0.2], [0.8]), 1024) - exact
    assert np.abs(error).max() < 5 * KNOWN_ERROR


def test_outputs_without_a_reading_do_not_count() -> None:
    p = linear_problem(2, 3, 0.3)
    sd = np.tile(p.sd, (8, 1))
    sd[::2, 0] = np.inf
    sd[3] = np.inf
    _, (a, *_) = p.response(np.zeros((1, 2)))
    cov = a @ p.population.root**2 @ a.T + np.diag(np.square(p.sd))
    exact = p.exact.copy()
    some = multivariate_normal(a[1:] @ p.population.mean, cov[1:, 1:])
    exact[::2] = some.logpdf(p.y[::2, 1:])
    exact[3] = 0
    residuals = residuals_of(p.response, p.y, sd, p.reference)
    error = log_likelihoods(proposals_of(residuals), p.population, 1024) - exact
    assert np.abs(error).max() < 5 * LINEAR_ERROR


@pytest.mark.parametrize("scale", [0.5, 1.0, 4.0])
def test_points_serve_all_scales_of_an_unknown_error(scale: float) -> None:
    p = linear_problem(2, 3, 0.3)
    residuals = residuals_of(p.response, p.y, p.sd, p.reference)
    proposals = proposals_of(residuals, (0.5, 1.0, 4.0))
    assert set(proposals.modes.scale) == {0.5, 1.0, 4.0}
    _, (a, *_) = p.response(np.zeros((1, 2)))
    cov = a @ p.population.root**2 @ a.T + np.diag(np.square(scale * p.sd))
    exact = multivariate_normal(a @ p.population.mean, cov).logpdf(p.y)
    error = log_likelihoods(proposals, p.population, 1024, scale=scale) - exact
    assert np.abs(error).max() < 5 * SCALE_ERROR


def test_relative_errors_are_shares_of_the_output() -> None:
    """y = exp(a) (1 + .3 error), with readings that are improbable for every output."""
    y, share = np.array([0.3, 0.5, 1.0, 3.0, -0.05])[:, None], 0.3
    grid = np.linspace(-8, 8, 40_001)
    density = norm(0.2, 0.7).pdf(grid) * norm(np.exp(grid), share * np.exp(grid)).pdf(y)
    exact = np.log(density.sum(axis=1) * (grid[1] - grid[0]))
    residuals = residuals_of(differentiated(np.exp), y, 1e-6, independent([0.0], [1.0]))
    relative = replace(residuals, relative=np.full_like(y, share))
    error = log_likelihoods(proposals_of(relative), independent([0.2], [0.7]), 1024) - exact
    assert np.abs(error).max() < 5 * RELATIVE_ERROR


def test_inputs_without_a_response_are_no_points() -> None:
    """y = a + b exists for a < .4 only."""
    limit = 0.4

    def partial(z: Floats) -> tuple[Floats, Floats]:
        values = np.where(z[:, :1] <= limit, z.sum(axis=1, keepdims=True), np.nan)
        return values, np.ones((len(z), 1, 2))

    y = np.array([-1.0, 0.0, 1.0])
    population = independent([0.0, 0.0], [1.0, 1.0])
    proposals = proposals_of(residuals_of(partial, y[:, None], EXACT, population))
    z, log_q, _ = proposals.draw(1024, 1)
    assert (z[np.isfinite(log_q)][:, 0] <= limit).all()
    exact = norm(0, np.sqrt(2)).logpdf(y) + norm(y / 2, np.sqrt(0.5)).logcdf(limit)
    error = log_likelihoods(proposals, population, 1024) - exact
    assert np.abs(error).max() < 5 * PARTIAL_ERROR


@pytest.mark.parametrize("unit", [1e-6, 1e5])
def test_units_do_not_matter(unit: float) -> None:
    p = replace(curved_problem("parabola"), sd=0.05)
    of_z, of_y = np.array([3.0, 0.01]) * unit, 0.2 / unit

    def in_units(z: Floats) -> tuple[Floats, Floats]:
        values, jacobian = p.response(z / of_z - 5)
        return of_y * (values + 7), of_y * jacobian / of_z

    reference = independent(5 * of_z, of_z)
    other = residuals_of(in_units, of_y * (p.y + 7), of_y * p.sd, reference)
    z, log_q, mode = p.proposals().draw(64, 1)
    scaled_z, scaled_log_q, scaled_mode = proposals_of(other).draw(64, 1)
    assert (mode == scaled_mode).all()
    np.testing.assert_allclose(scaled_z / of_z - 5, z, atol=1e-6)
    np.testing.assert_allclose(scaled_log_q + np.log(of_z).sum(), log_q, atol=1e-6)


def test_points_are_those_of_the_seed_whatever_specimens_follow() -> None:
    p = curved_problem("parabola")
    proposals = p.proposals()
    first, again = proposals.draw(64, 1), p.proposals().draw(64, 1)
    for one, two in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, two)
    assert not np.array_equal(first[0], proposals.draw(64, 2)[0])
    few = replace(p, y=p.y[:5]).proposals().draw(64, 1)
    np.testing.assert_allclose(few[0], first[0][:5], atol=1e-9)
    np.testing.assert_allclose(few[1], first[1][:5], atol=1e-9)


def test_specimens_that_nothing_reaches_have_no_mode() -> None:
    def nowhere(z: Floats) -> tuple[Floats, Floats]:
        return np.full((len(z), 1), np.nan), np.full((len(z), 1, 1), np.nan)

    residuals = residuals_of(nowhere, np.zeros((2, 1)), 1.0, independent([0.0], [1.0]))
    assert len(find_modes(residuals, np.zeros((2, 3, 1))).a) == 0


def test_modes_are_the_roots_or_the_nearest_outputs() -> None:
    residuals = residuals_of(
        differentiated(lambda z: z**2),
        np.array([[4.0], [0.25], [-0.1]]),
        0.01,
        independent([0.0], [1.0]),
    )
    starts = np.tile(np.linspace(-3, 3, 8)[:, None], (3, 1, 1))
    modes = find_modes(residuals, starts)
    np.testing.assert_allclose(np.sort(modes.a[:4, 0]), [-2, -0.5, 0.5, 2], atol=1e-4)
    np.testing.assert_allclose(modes.misfit, [0, 0, 0, 0, 50], atol=1e-3)
    np.testing.assert_allclose(modes.a[4:], 0, atol=2e-3)
    assert modes.specimen.tolist() == [0, 0, 1, 1, 2]


@pytest.mark.parametrize(("sd", "count"), [(0.1, 2), (0.01, 1)])
def test_modes_within_the_gap_are_kept(sd: float, count: int) -> None:
    """The misfit of the mirror root in the second output is .2^2 / 2 sd^2: 2 nats, and 200."""
    response = differentiated(lambda z: np.concatenate([z**2, 0.1 * z], axis=1))
    residuals = residuals_of(response, np.array([[1.0, 0.1]]), sd, independent([0.0], [1.0]))
    starts = np.linspace(-3, 3, 8)[None, :, None]
    assert len(find_modes(residuals, starts).a) == count
    assert len(find_modes(residuals, starts, gap=1.0).a) == 1


def test_inputs_are_open_where_readings_say_less_than_the_population() -> None:
    reference = independent([0.0, 0.0], [1.0, 1.0])
    two, one = np.eye(2), np.eye(2)[:1]
    for a, sd, expected in ((two, 0.01, False), (two, [0.01, 0.7], True), (one, 0.01, True)):
        y = np.zeros((3, len(a)))
        assert proposals_of(residuals_of(linear(a), y, sd, reference)).is_open() is expected


def test_specimens_may_have_few_of_many_outputs() -> None:
    """Errors, slopes and modes from the outputs that a specimen has are those from all of them."""
    p = linear_problem(2, 3, 0.3)
    rng = np.random.default_rng(0)
    columns = np.sort([rng.permutation(3)[:2] for _ in p.y], axis=1)
    sd = np.full(p.y.shape, np.inf)
    np.put_along_axis(sd, columns, np.take_along_axis(np.tile(p.sd, (8, 1)), columns, 1), 1)
    whole = residuals_of(p.response, p.y, sd, p.reference)

    def of_columns(z: Floats, columns: Any = None) -> tuple[Floats, Floats]:
        values, jacobian = p.response(z)
        rows = np.arange(len(z))[:, None]
        return (
            (values, jacobian)
            if columns is None
            else (values[rows, columns], jacobian[rows, columns])
        )

    names = ("target", "emulator_error", "error", "relative")
    parts = {n: np.take_along_axis(getattr(whole, n), columns, axis=1) for n in names}
    few = replace(whole, response=of_columns, columns=columns, **parts)
    specimen, a = np.arange(8), rng.standard_normal((8, 2))
    for found, expected in zip(few.errors(specimen, a), whole.errors(specimen, a), strict=True):
        at = columns if expected.ndim == 2 else columns[:, :, None]
        np.testing.assert_allclose(found, np.take_along_axis(expected, at, axis=1), rtol=1e-12)
    starts = np.tile(ndtri(sobol(16, 2, 0)), (8, 1, 1))
    modes = [find_modes(r, starts).a for r in (few, whole)]
    np.testing.assert_allclose(modes[0], modes[1], atol=1e-6)


def test_modes_for_other_errors_are_the_same_if_they_are_the_nearest() -> None:
    """y = a^2 has a mode on each side, for each error of the reading."""
    response = differentiated(lambda z: z**2)
    residuals = residuals_of(response, np.full((3, 1), 4.0), 0.05, independent([0.1], [1.0]))
    proposals = proposals_of(residuals, (0.5, 1.0, 4.0))
    modes, is_same = proposals.modes, proposals.is_same_mode
    assert len(modes.a) == 18
    for row in range(len(modes.a)):
        others = modes.table[modes.specimen[row]]
        np.testing.assert_array_equal(
            is_same[row], np.sign(modes.a[others, 0]) == np.sign(modes.a[row, 0])
        )


@pytest.mark.parametrize("mean", [-0.8, 0.2, 0.8])
def test_an_inaccurate_reading_at_a_turning_point(mean: float) -> None:
    """y = a^2 with an error as large as the outputs of both sides: points are on both."""
    y, sd = np.array([[-0.1], [0.0], [0.1], [0.3]]), 0.15
    reference, population = independent([0.5], [0.9]), independent([mean], [0.4])
    residuals = residuals_of(differentiated(lambda z: z**2), y, sd, reference)
    starts = np.tile(1.5 * ndtri(sobol(16, 1, 0)), (len(y), 1, 1))
    modes = find_modes(residuals, starts)
    proposals = without_covered(Proposals.at_modes(residuals, modes))
    proposals = with_covered_fibres(proposals, starts, 1.0)
    grid = np.linspace(-4, 4, 20_001)
    density = norm(mean, 0.4).pdf(grid) * norm(0, sd).pdf(y - grid**2)
    exact = np.log(density.sum(axis=1) * (grid[1] - grid[0]))
    error = log_likelihoods(proposals, population, 512) - exact
    assert np.abs(error).max() < 0.05
