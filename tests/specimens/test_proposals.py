"""Integrals over the inputs of specimens by importance points, against closed forms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from scipy.special import logsumexp, ndtri
from scipy.stats import multivariate_normal, ncx2, norm, rice

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


def residuals_of(response: Any, y: Floats, sd: Any, reference: Normal) -> Residuals:
    nothing = np.full((len(y), len(reference.mean)), np.nan)
    sd = np.broadcast_to(np.asarray(sd, dtype=float), y.shape)
    return Residuals(response, y, np.zeros_like(y), sd, np.zeros_like(y), reference, nothing)


def proposals_of(residuals: Residuals, scales: tuple[float, ...] = (1.0,)) -> Proposals:
    d = len(residuals.free)
    starts = np.tile(1.5 * ndtri(sobol(16, d, 0)), (len(residuals.target), 1, 1))
    residuals = replace(residuals, scales=np.array(scales)[:, None])
    rows = range(len(scales))
    modes = Modes.joined([find_modes(residuals, starts, scale=row) for row in rows])
    return Proposals.at_modes(residuals, modes)


def log_likelihoods(proposals: Proposals, population: Normal, count: int, seed: int = 1) -> Floats:
    """Return log p(y_i | theta), (N,), of a normal population, by equation (1)."""
    residuals = proposals.residuals
    z, log_q, _ = proposals.draw(count, seed)
    n, k, d = z.shape
    values = residuals.response(z.reshape(-1, d))[0].reshape(n, k, -1)
    sd = np.hypot(residuals.error[:, None], residuals.relative[:, None] * values)
    log_y = norm(0, sd).logpdf(residuals.target[:, None] - values).sum(axis=2)
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


LINEAR = pytest.mark.parametrize(("d", "m"), [(1, 1), (3, 2), (2, 3)])


# Standard errors of log L with 1024 points: largest root mean square error of a specimen, 8 seeds.
LINEAR_ERROR = 9e-4
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


@pytest.mark.parametrize(("low", "high"), [(-0.05, 0.05), (0.1, 0.5)])
def test_both_sides_of_a_turning_point(low: float, high: float) -> None:
    """Both roots of y = a^2 merge near zero, and some readings are beyond the response."""
    y, sd = np.linspace(low, high, 9)[:, None], 0.1
    grid = np.linspace(-6, 6, 20_001)
    density = norm(0.1, 0.6).pdf(grid) * norm(grid**2, sd).pdf(y)
    exact = np.log(density.sum(axis=1) * (grid[1] - grid[0]))
    residuals = residuals_of(differentiated(lambda z: z**2), y, sd, independent([0.0], [1.0]))
    error = log_likelihoods(proposals_of(residuals), independent([0.1], [0.6]), 8192) - exact
    assert np.abs(error).max() < 5 * TURNING_ERROR


@pytest.mark.parametrize("name", ["ring", "cubic"])
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
    of_one = log_likelihoods(once, p.population, 512)
    of_two = log_likelihoods(twice, p.population, 512)
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


def test_modes_for_other_errors_are_the_same_if_they_are_the_nearest() -> None:
    """y = a^2 has a mode on each side, for each error of the reading."""
    response = differentiated(lambda z: z**2)
    residuals = residuals_of(response, np.full((3, 1), 4.0), 0.05, independent([0.1], [1.0]))
    proposals = proposals_of(residuals, (4.0, 1.0, 0.5))
    modes, is_same = proposals.modes, proposals.is_same_mode
    assert len(modes.a) == 18
    for row in range(len(modes.a)):
        others = modes.table[modes.specimen[row]]
        np.testing.assert_array_equal(
            is_same[row], np.sign(modes.a[others, 0]) == np.sign(modes.a[row, 0])
        )


def test_small_terms_of_many_factors_are_one_percent_of_a_density_together() -> None:
    reference = independent([0.0], [1.0])
    residuals = residuals_of(linear(np.eye(1)), np.linspace(-1, 1, 5)[:, None], 0.05, reference)
    proposals = proposals_of(residuals, tuple(np.geomspace(40.0, 0.1, 48)))
    z, log_q, mode = proposals.draw(2048, 1)
    specimen = np.repeat(np.arange(5), 2048)
    weights = np.bincount(mode.ravel()).astype(float)
    # Without the proposals that drew the points no term is left out.
    exact = proposals.log_mixture(specimen, z.reshape(-1, 1), weights) - 0.5 * np.log(2 * np.pi)
    np.testing.assert_allclose(log_q.ravel(), exact, atol=1e-3)


def test_an_inaccurate_reading_at_a_turning_point() -> None:
    """y = a^2 with an error as large as the outputs of both sides: points are on both."""
    y, sd = np.array([[-0.1], [0.0], [0.1], [0.3]]), 0.15
    reference, population = independent([0.5], [0.9]), independent([-0.8], [0.4])
    residuals = residuals_of(differentiated(lambda z: z**2), y, sd, reference)
    starts = np.tile(1.5 * ndtri(sobol(16, 1, 0)), (len(y), 1, 1))
    modes = find_modes(residuals, starts)
    proposals = without_covered(Proposals.at_modes(residuals, modes))
    proposals = with_covered_fibres(proposals, starts, 0)
    grid = np.linspace(-4, 4, 20_001)
    density = norm(-0.8, 0.4).pdf(grid) * norm(0, sd).pdf(y - grid**2)
    exact = np.log(density.sum(axis=1) * (grid[1] - grid[0]))
    error = log_likelihoods(proposals, population, 512) - exact
    assert np.abs(error).max() < 0.05
