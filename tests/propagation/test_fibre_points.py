"""Points on fibres, and of specimens with fewer readings than inputs: against closed forms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from scipy.special import logsumexp, ndtr
from scipy.stats import multivariate_normal, ncx2, norm

from prbayes._validate import Floats
from prbayes.metrics.readings import Readings
from prbayes.propagation.base import DesignError
from prbayes.propagation.charts import ReferencePopulation
from prbayes.propagation.fibre_points import fibre_points, fit_fibres, with_errors, without_errors
from prbayes.propagation.specimen_emulation import Emulation, EmulationProblem, PointOptions
from prbayes.propagation.specimen_points import SpecimenPoints

Array = np.ndarray[Any, np.dtype[np.float64]]


def differentiated(function: Callable[[Any], Any]) -> Any:
    """Return the response x -> (values, Jacobians) of an analytic function, by complex steps."""

    def response(x: Array) -> tuple[Array, Array]:
        columns = [function(x + 1e-30j * e).imag / 1e-30 for e in np.eye(x.shape[1])]
        return function(x), np.stack(columns, axis=-1)

    return response


def linear(a: Array) -> Any:
    return lambda x: (x @ a.T, np.broadcast_to(a, (len(x), *a.shape)))


@dataclass(frozen=True)
class NormalDraws:
    """Draws of the means and standard deviations of independent normal inputs."""

    means: Floats  # (S, d)
    sds: Floats  # (S, d)

    @property
    def thetas(self) -> Floats:
        return np.concatenate([self.means, self.sds], axis=1)

    def log_likelihoods(self, z: Floats, log_a: Floats) -> Floats:
        standard = (z - self.means[:, None, None]) / self.sds[:, None, None]
        log_p = -0.5 * (standard**2).sum(axis=-1) - z.shape[-1] / 2 * np.log(2 * np.pi)
        log_p -= np.log(self.sds).sum(axis=1)[:, None, None]
        return np.asarray(logsumexp(log_p + log_a, axis=2))

    def specimens(self) -> Floats:
        rng = np.random.default_rng(0)
        z = self.means + self.sds * rng.standard_normal((64, *self.means.shape))
        return z.reshape(-1, self.means.shape[1])

    def posterior(self, z: Floats, log_a: Floats, smoothing: Floats | None) -> NormalDraws:
        return self


def log_likelihoods(points: tuple[Array, Array], mean: Array, sd: Array) -> Array:
    """Return log p(y_i | theta) for independent normal inputs, (N,)."""
    return NormalDraws(mean[None], sd[None]).log_likelihoods(*points)[0]


@dataclass(frozen=True)
class Problem:
    """A response, measured outputs, a population of theta, and the exact log-likelihoods."""

    response: Any
    y: Array
    reference: ReferencePopulation
    mean: Array
    sd: Array
    exact: Array
    options: dict[str, int]


def linear_problem(d: int, m: int) -> Problem:
    rng = np.random.default_rng(0)
    a = rng.standard_normal((m, d)) / np.sqrt(d) / 0.5
    y = (0.25 * np.random.default_rng(1).standard_normal((20, d))) @ a.T
    reference = ReferencePopulation(np.full(d, 2.0), np.diag(np.full(d, 0.25)))
    y += reference.mean @ a.T
    mean, sd = np.full(d, 2.1), 0.25 * np.linspace(0.8, 1.2, d)
    exact = multivariate_normal(mean @ a.T, a * sd**2 @ a.T).logpdf(y)
    return Problem(linear(a), y, reference, mean, sd, exact, {})


def nonlinear_problem(name: str) -> Problem:
    mean, sd = np.array([0.3, -0.2]), np.full(2, 0.9)
    options: dict[str, int] = {}
    grid = np.linspace(-9, 9, 20_001)
    step = grid[1] - grid[0]
    if name in ("circle", "sphere"):
        # |x|^2 / sd^2 of normal inputs with another mean is non-central chi-square.
        y = np.linspace(0.3, 8, 12)
        response = differentiated(lambda x: (x**2).sum(axis=1, keepdims=True))
        if name == "sphere":
            y, mean, sd = y + 2, np.r_[mean, 0, 0, 0], np.full(5, 0.9)
            options = {"rounds": 10, "tries": 256, "most_charts": 12}
        exact = ncx2(len(mean), 0.13 / 0.81, scale=0.81).logpdf(y)
    elif name == "exponential":
        y = np.exp(np.linspace(-2, 2, 9))
        response = differentiated(lambda x: np.exp(x[:, :1]))
        exact = norm(0.3, 0.9).logpdf(np.log(y)) - np.log(y)
    else:
        y = np.linspace(-0.3, 5, 12)
        response = differentiated(lambda x: (x[:, :1] + 0.5) ** 2 + 0.2 * x[:, 1:])
        x2 = (y[:, None] - (grid + 0.5) ** 2) / 0.2
        density = norm(0.3, 0.9).pdf(grid) * norm(-0.2, 0.9).pdf(x2) / 0.2
        exact = np.log(density.sum(axis=1) * step)
    reference = ReferencePopulation(np.zeros(len(mean)), np.eye(len(mean)))
    return Problem(response, y[:, None], reference, mean, sd, exact, options)


def problem(name: str) -> Problem:
    if name.startswith("linear"):
        _, d, m = name.split()
        return linear_problem(int(d), int(m))
    return nonlinear_problem(name)


# Standard errors of log L with 4096 points: largest root mean square error of a specimen, 6 seeds.
STANDARD_ERRORS = {
    "linear 3 2": 1.7e-4,
    "linear 8 4": 3.1e-3,
    "linear 8 1": 9.8e-3,
    "circle": 2.5e-3,
    "sphere": 1.5e-2,
    "exponential": 1.2e-4,
    "fold": 2.0e-3,
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.long if name == "sphere" else [])
        for name in STANDARD_ERRORS
    ],
)
def test_log_likelihood_equals_the_closed_form(name: str) -> None:
    p = problem(name)
    points = fit_fibres(p.response, p.y, p.reference, **p.options).draw(4096, seed=1)
    assert np.abs(log_likelihoods(points, p.mean, p.sd) - p.exact).max() < 5 * STANDARD_ERRORS[name]


def test_proposals_of_different_seeds_agree_on_fibres_with_turns() -> None:
    # Charts that turn during adaptation can leave a piece of these fibres without a chart.
    rng = np.random.default_rng(0)
    a = rng.standard_normal((2, 3)) / np.sqrt(3)
    b = rng.standard_normal((2, 3, 3)) / 3

    def curved(z: Any) -> Any:
        product = np.stack([z[:, 0] * z[:, 1], z[:, 1] * z[:, 2]], axis=1)
        quadratic = np.einsum("nd,mde,ne->nm", z, b, z)
        return np.exp(0.35 * z @ a.T) + 0.3 * quadratic + 0.3 * np.sin(product)

    response = differentiated(curved)
    population = ReferencePopulation(np.zeros(3), np.full(3, 0.5) * np.eye(3))
    y = response(0.5 * np.random.default_rng([1, 50]).standard_normal((50, 3)))[0][[7, 20]]
    values = [
        log_likelihoods(
            fit_fibres(response, y, population, seed=seed).draw(4096, seed=seed),
            population.mean,
            np.diag(population.root),
        )
        for seed in range(3)
    ]
    away = values - np.mean(values, axis=0)
    assert np.abs(away).max() < 5 * 0.0022  # standard error from seeds .0022


@pytest.mark.parametrize("scale", [1e-9, 1e6])
def test_points_do_not_depend_on_units(scale: float) -> None:
    p = problem("fold")
    of_x, of_y = np.array([3.0, 0.01]) * scale, 0.2 / scale
    shift = 7 * of_y

    def in_units(x: Array) -> tuple[Array, Array]:
        values, jacobian = p.response(x / of_x - 5)
        return values * of_y + shift, jacobian * of_y / of_x

    population = ReferencePopulation(5 * of_x, np.diag(of_x))
    x, log_a = fit_fibres(p.response, p.y, p.reference).draw(128, seed=1)
    scaled, log_b = fit_fibres(in_units, p.y * of_y + shift, population).draw(128, seed=1)
    same = np.isfinite(log_a)
    np.testing.assert_array_equal(same, np.isfinite(log_b))
    np.testing.assert_allclose((scaled / of_x - 5)[same], x[same], atol=1e-6)
    expected = log_a + np.log(of_x).sum() - np.log(of_y)
    np.testing.assert_allclose(log_b[same], expected[same], atol=1e-6)


def test_points_are_the_same_for_a_seed_in_any_batch() -> None:
    p = problem("fold")
    proposal = fit_fibres(p.response, p.y, p.reference)
    x, log_a = proposal.draw(64, seed=1)
    again = fit_fibres(p.response, p.y, p.reference).draw(64, seed=1)
    np.testing.assert_array_equal(x, again[0])
    np.testing.assert_array_equal(log_a, again[1])
    assert not np.array_equal(x, proposal.draw(64, seed=2)[0])
    chosen = [7, 2]
    alone = fit_fibres(p.response, p.y[chosen], p.reference, numbers=np.array(chosen))
    few = alone.draw(64, seed=1)
    np.testing.assert_allclose(few[0], x[chosen], atol=1e-7)
    np.testing.assert_allclose(few[1], log_a[chosen], atol=1e-7)
    # Blocks of specimens
    many = fit_fibres(p.response, np.tile(p.y, (10, 1)), p.reference).draw(64, seed=1)[1]
    np.testing.assert_allclose(many[:12], log_a, atol=1e-7)
    assert not np.allclose(many[12:24], log_a)


def test_inputs_where_the_response_has_no_value_have_weight_zero() -> None:
    limit = 0.4

    def partial(x: Array) -> tuple[Array, Array]:
        values = np.where(x[:, :1] <= limit, x.sum(axis=1, keepdims=True), np.nan)
        return values, np.ones((len(x), 1, 2))

    y = np.array([-1.0, 0.0, 1.0, 2.0])
    population = ReferencePopulation(np.zeros(2), np.eye(2))
    points = fit_fibres(partial, y[:, None], population).draw(4096, seed=1)
    assert (points[0][np.isfinite(points[1])][:, 0] <= limit).all()
    exact = norm(0, np.sqrt(2)).logpdf(y) + norm(y / 2, np.sqrt(0.5)).logcdf(limit)
    error = log_likelihoods(points, np.zeros(2), np.ones(2)) - exact
    assert np.abs(error).max() < 5 * 0.0022  # standard error from seeds .0022


@pytest.mark.parametrize("bad", [np.inf, 1e300])
def test_infinite_and_huge_responses_are_no_points(bad: float) -> None:
    def response(x: Array) -> tuple[Array, Array]:
        values = np.where(x[:, :1] > 1, bad, x[:, :1] * x[:, 1:])
        jacobian = np.where(x[:, :1] > 1, bad, x[:, ::-1])
        return values, jacobian[:, None, :]

    population = ReferencePopulation(np.zeros(2), np.eye(2))
    x, log_a = fit_fibres(response, np.array([[0.5], [-2.0]]), population).draw(64, seed=1)
    assert np.isfinite(log_a).any(axis=1).all()
    assert (x[np.isfinite(log_a)][:, 0] <= 1).all()


def test_specimens_without_a_root_are_values() -> None:
    p = problem("exponential")
    y = np.array([[1.0], [-1.0], [2.0], [np.nan]])
    x, log_a = fit_fibres(p.response, y, p.reference).draw(64, seed=1)
    np.testing.assert_array_equal(np.isfinite(log_a).all(axis=1), [True, False, True, False])
    assert np.isneginf(log_a[1::2]).all()
    assert np.isfinite(x).all()
    others = fit_fibres(p.response, y[::2], p.reference, numbers=np.array([0, 2])).draw(64, seed=1)
    np.testing.assert_allclose(log_a[::2], others[1], atol=1e-7)
    # A response without a value, or without influence
    for fill in (np.nan, 1.0):
        constant = lambda x, fill=fill: (np.full((len(x), 1), fill), np.zeros((len(x), 1, 2)))  # noqa: E731
        _, log_a = fit_fibres(constant, np.zeros((2, 1)), p.reference).draw(8, seed=0)
        assert np.isneginf(log_a).all()


@pytest.mark.parametrize(("d", "m"), [(2, 1), (3, 2), (2, 2), (1, 3)])
@pytest.mark.parametrize("size", [0.02, 1.0])
def test_reading_errors_give_the_closed_form(d: int, m: int, size: float) -> None:
    rng = np.random.default_rng(d + 10 * m)
    a = rng.standard_normal((m, d))
    error = size * np.linspace(1, 2, m)
    y = rng.standard_normal((6, d)) @ a.T + error * rng.standard_normal((6, m))
    population = ReferencePopulation(np.zeros(d), np.eye(d))
    response, both = with_errors(linear(a), population, error)
    points = without_errors(*fit_fibres(response, y, both).draw(1024, seed=1), m)
    mean, sd = np.full(d, 0.1), np.full(d, 0.9)
    exact = multivariate_normal(a @ mean, a * sd**2 @ a.T + np.diag(error**2)).logpdf(y)
    difference = log_likelihoods(points, mean, sd) - exact
    assert np.abs(difference).max() < 5 * 0.0019  # standard error from seeds .0019


def test_a_population_of_a_sample_has_its_moments_in_any_units() -> None:
    rng = np.random.default_rng(0)
    x = rng.standard_normal((50, 3)) @ rng.standard_normal((3, 3)) * [1e-9, 1, 1e9] + 3
    population = ReferencePopulation.from_sample(x)
    np.testing.assert_allclose(population.mean, x.mean(axis=0))
    covariance = np.cov(x.T, ddof=0)
    np.testing.assert_allclose(population.root @ population.root.T, covariance)
    with pytest.raises(ValueError, match="got a singular matrix from 2 points, expected 3"):
        ReferencePopulation.from_sample(x[:2])
    with pytest.raises(ValueError, match="that vary"):
        ReferencePopulation.from_sample(x * [1, 0, 1])


N = 8


def draws_of(d: int, mean_sd: float = 0.03, sd: float = 0.15, size: int = 16) -> NormalDraws:
    """Return populations around a mean of .1, by default as 30 specimens determine them."""
    rng = np.random.default_rng(d)
    means = 0.1 + mean_sd * rng.standard_normal((size, d))
    return NormalDraws(means, sd * np.exp(0.1 * rng.standard_normal((size, d))))


def specimens_of(draws: NormalDraws, n: int = N) -> Floats:
    """Return inputs of n specimens of the middle population."""
    rng = np.random.default_rng(7)
    mean, sd = draws.means.mean(axis=0), draws.sds.mean(axis=0)
    return np.asarray(mean + sd * rng.standard_normal((n, len(mean))))


def points_of(
    response: Callable[[Floats], Floats], readings: Readings, draws: NormalDraws, **options: Any
) -> tuple[Emulation, SpecimenPoints]:
    d = draws.means.shape[1]
    prior = 0.4 * np.random.default_rng(1).standard_normal((2048, d))
    settings = {"n": 16 * d + 32} | options
    bounds = np.stack([prior.min(axis=0), prior.max(axis=0)])
    problem = EmulationProblem(response, readings, **settings)
    return fibre_points(problem, bounds, prior, draws.posterior)


def linear_response(d: int, m: int) -> tuple[Floats, Callable[[Floats], Floats]]:
    a = np.random.default_rng(10 * d + m).standard_normal((m, d))
    return a, lambda z: z @ a.T


def linear_log_likelihoods(a: Floats, readings: Readings, draws: NormalDraws) -> Floats:
    """Return the exact log-likelihoods of what was measured of each specimen, (S, N)."""
    result = np.zeros((len(draws.means), len(readings)))
    for i, (y, error) in enumerate(zip(readings.values, readings.error, strict=True)):
        some = np.isfinite(y)
        if not some.any():
            continue
        rows, noise = a[some], np.diag(error[some] ** 2)
        for s, (mean, sd) in enumerate(zip(draws.means, draws.sds, strict=True)):
            population = multivariate_normal(rows @ mean, rows * sd**2 @ rows.T + noise)
            result[s, i] = population.logpdf(y[some])
    return result


def errors(points: SpecimenPoints, exact: Floats, draws: NormalDraws) -> Floats:
    return np.asarray(draws.log_likelihoods(points.z, points.log_a) - exact)


# Standard errors of log L: largest root mean square error of a specimen and population, six seeds.
PATTERNS = {(2, 0.1): 1.1e-2, (3, 0.0): 2.5e-2}


def patterned(y: Floats) -> Floats:
    """Return readings of two outputs of which one, both or none are missing."""
    y = y.copy()
    y[1::4, 0] = np.nan
    y[2::4, 1] = np.nan
    y[3::4] = np.nan
    return y


@pytest.mark.parametrize(("d", "size"), PATTERNS)
def test_patterns_of_missing_outputs(d: int, size: float) -> None:
    draws = draws_of(d)
    a, response = linear_response(d, 2)
    y = response(specimens_of(draws))
    y += size * np.random.default_rng(3).standard_normal(y.shape)
    readings = replace(Readings.exact(patterned(y)), error=np.full(y.shape, size))
    _, points = points_of(response, readings, draws)
    assert points.z.shape == (N, 256, d)
    assert points.difference <= 0.15
    if size == 0:
        away = np.abs(points.outputs - readings.values[:, None])
        assert np.nanmax(away) < 1e-3
    error = errors(points, linear_log_likelihoods(a, readings, draws), draws)
    assert np.abs(error).max() < 5 * PATTERNS[d, size]


def test_rounded_and_censored_readings_have_the_probability_of_their_interval() -> None:
    draws, step = draws_of(2), 0.2
    a, response = linear_response(2, 1)
    y = response(specimens_of(draws))
    low = np.round(y / step) * step - step / 2
    mean, sd = draws.means @ a.T, np.sqrt(draws.sds**2 @ a.T**2)
    exact = np.log(ndtr((low.T + step - mean) / sd) - ndtr((low.T - mean) / sd))
    is_censored = np.arange(N)[:, None] % 2 == 0
    readings = replace(
        Readings.exact(np.where(is_censored, np.nan, low + step / 2)),
        step=np.full(y.shape, step),
        lower=np.where(is_censored, low, np.nan),
        upper=np.where(is_censored, low + step, np.nan),
    )
    _, points = points_of(response, readings, draws)
    exact[:, 1::2] -= np.log(step)  # the mean density of the step
    assert np.abs(errors(points, exact, draws)).max() < 5 * 0.074


def test_the_log_proposal_serves_another_error() -> None:
    # As for an error that is a model variable: the density of the readings is added later.
    draws = draws_of(2)
    a, response = linear_response(2, 1)
    y = response(specimens_of(draws))
    readings = replace(Readings.exact(y), error=np.full(y.shape, 0.1))
    emulation, points = points_of(response, readings, draws)
    other = readings.scaled(1.3)
    log_a = other.log_density(points.outputs, emulation.error) - points.log_proposal
    error = draws.log_likelihoods(points.z, log_a) - linear_log_likelihoods(a, other, draws)
    assert np.abs(error).max() < 5 * PATTERNS[2, 0.1]


def test_points_are_doubled_until_both_halves_agree() -> None:
    # Means along the fibre are not identified, and populations are narrow.
    draws = draws_of(2, mean_sd=0.0, sd=0.02)
    along = np.linspace(-0.4, 0.4, len(draws.means))[:, None] * [[1.0, -1.0]]
    draws = replace(draws, means=draws.means + along)
    a = np.ones((1, 2))
    readings = Readings.exact(specimens_of(draws) @ a.T)
    _, points = points_of(lambda z: z @ a.T, readings, draws)
    assert 256 < points.z.shape[1] < 4096
    assert points.difference <= 0.15
    error = errors(points, linear_log_likelihoods(a, readings, draws), draws).sum(axis=1)
    assert error.std() < 0.15
    with pytest.raises(DesignError, match=r"got two halves of 256 points .*ProbabilityResidual"):
        points_of(lambda z: z @ a.T, readings, draws, options=PointOptions(most_points=256))


@dataclass(frozen=True)
class PriorSample(NormalDraws):
    """Populations of the prior, from which the posterior is resampled."""

    is_smoothed: list[bool] = field(default_factory=list)

    def posterior(self, z: Floats, log_a: Floats, smoothing: Floats | None) -> NormalDraws:
        self.is_smoothed.append(smoothing is not None)
        d = z.shape[-1]
        total = np.empty(len(self.means))
        for s, (mean, sd) in enumerate(zip(self.means, self.sds, strict=True)):
            covariance = np.diag(sd**2) + (0 if smoothing is None else smoothing)
            root = np.linalg.cholesky(covariance)
            standard = (z - mean) @ np.linalg.inv(root).T
            log_p = -0.5 * (standard**2).sum(axis=-1) - np.log(np.diag(root)).sum()
            total[s] = logsumexp(log_p - d / 2 * np.log(2 * np.pi) + log_a, axis=1).sum()
        weights = np.exp(total - logsumexp(total))
        chosen = np.random.default_rng(0).choice(len(weights), 32, p=weights)
        return NormalDraws(self.means[chosen], self.sds[chosen])


@pytest.mark.long
def test_populations_that_happen_to_lie_near_points_do_not_decide() -> None:
    # The difference of the means is not identified, over eighty widths of a population.
    rng = np.random.default_rng(5)
    prior = PriorSample(0.4 * rng.standard_normal((400, 2)), np.full((400, 2), 0.01))
    prior.means[:, 0] = 0.2 - prior.means[:, 1] + 0.005 * rng.standard_normal(400)
    a = np.ones((1, 2))
    readings = Readings.exact(0.2 + 0.01 * np.sqrt(2) * rng.standard_normal((N, 1)))
    _, points = points_of(lambda z: z @ a.T, readings, prior)
    assert prior.is_smoothed[:2] == [False, True]
    assert prior.is_smoothed[-3:] == [False] * 3
    exact = linear_log_likelihoods(a, readings, prior).sum(axis=1)
    estimate = prior.log_likelihoods(points.z, points.log_a).sum(axis=1)
    mean, sd = moments_of(prior.means[:, 0], exact)
    mean_of_points, sd_of_points = moments_of(prior.means[:, 0], estimate)
    assert sd > 20 * 0.01
    assert mean_of_points == pytest.approx(mean, abs=0.15 * sd)
    assert sd_of_points == pytest.approx(sd, rel=0.15)


def moments_of(values: Floats, log_weights: Floats) -> tuple[float, float]:
    weights = np.exp(log_weights - logsumexp(log_weights))
    mean = weights @ values
    return float(mean), float(np.sqrt(weights @ (values - mean) ** 2))


def test_a_response_with_a_jump_is_refused() -> None:
    draws = draws_of(2)
    readings = Readings.exact(specimens_of(draws).sum(axis=1, keepdims=True))

    def response(z: Floats) -> Floats:
        return np.asarray(z.sum(axis=1, keepdims=True) + np.sign(z[:, :1]))

    with pytest.raises(DesignError, match=r"(?s)got an emulator.*metric=prb.ProbabilityResidual"):
        points_of(response, readings, draws, n=32)


def test_runs_are_made_at_first_and_in_batches_near_the_specimens() -> None:
    draws = draws_of(2)
    _, response = linear_response(2, 1)
    batches: list[Floats] = []

    def recorded(z: Floats) -> Floats:
        batches.append(z)
        return response(z)

    readings = Readings.exact(response(specimens_of(draws)))
    emulation, _ = points_of(recorded, readings, draws, n=64)
    assert [len(z) for z in batches] == [64, 32, 32]
    assert len(emulation.z) == 128
    assert batches[0].std() > 2 * batches[1][:16].std()
