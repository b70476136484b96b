"""Log-likelihoods of specimens from points, against closed forms and quadrature."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

from prbayes._validate import Floats
from prbayes.metrics.readings import Readings
from prbayes.propagation.base import DesignError
from prbayes.propagation.population_density import normal_log_density
from prbayes.propagation.specimen_emulation import (
    Emulation,
    EmulationProblem,
    PointOptions,
    _narrowing,
    emulate,
    specimen_roots,
    surface_near,
)
from prbayes.propagation.specimen_points import SpecimenPoints, draw_points

Density = Callable[[Floats], Floats]


def cube(d: int, half_width: float = 1.0) -> Floats:
    return np.stack([np.full(d, -half_width), np.full(d, half_width)])


def readings(y: Floats, error: float = 0.0) -> Readings:
    return replace(Readings.exact(y), error=np.full_like(y, error))


def points_of(
    run: Callable[[Floats], Floats],
    y: Floats,
    d: int,
    *,
    error: float = 0.0,
    unit: float = 1.0,
    seed: int = 0,
    options: PointOptions = PointOptions(),  # noqa: B008 (frozen)
) -> tuple[Emulation, SpecimenPoints]:
    boxes = unit * cube(d), unit * cube(d, 1.5)
    problem = EmulationProblem(run, readings(y, error), options, seed=seed)
    return drawn(problem, *boxes)


def drawn(
    problem: EmulationProblem, box: Floats, search_box: Floats
) -> tuple[Emulation, SpecimenPoints]:
    emulation, roots = emulate(problem, box, search_box)
    points = draw_points(emulation, problem.readings, roots, problem.options, seed=problem.seed)
    return emulation, points


def log_likelihoods(points: SpecimenPoints, density: Density) -> Floats:
    return np.asarray(logsumexp(density(points.z) + points.log_a, axis=1))


def normal(mean: Any, covariance: Any) -> Density:
    root = np.linalg.cholesky(np.atleast_2d(covariance))
    return lambda z: normal_log_density(z, np.atleast_1d(mean), root)


class Linear:
    def __init__(self, d: int, m: int, n: int = 12) -> None:
        rng = np.random.default_rng([d, m])
        self.matrix, self.offset = rng.normal(size=(m, d)), rng.normal(size=m)
        self.x = 0.3 * rng.normal(size=(n, d))
        self.y = self(self.x)

    def __call__(self, z: Floats) -> Floats:
        return z @ self.matrix.T + self.offset

    def sharp(self, mean: Floats, covariance: Floats, sd: Floats) -> Floats:
        """Return the log-density of the outputs with errors that are small, where p is constant."""
        scaled = self.matrix / sd[:, None]
        log_mass = -np.linalg.slogdet(scaled.T @ scaled)[1] / 2 - np.log(sd).sum()
        log_mass -= (len(sd) - len(mean)) / 2 * np.log(2 * np.pi)
        return normal_log_density(self.x, mean, np.linalg.cholesky(covariance)) + log_mass


def populations(d: int, count: int = 4) -> list[tuple[Floats, Floats]]:
    rng = np.random.default_rng(d)
    result = []
    for _ in range(count):
        factor = 0.2 * rng.normal(size=(d, d))
        result.append((0.2 * rng.normal(size=d), factor @ factor.T + 0.05 * np.eye(d)))
    return result


@pytest.mark.parametrize(("d", "m"), [(1, 1), (2, 3), (3, 4)])
def test_a_linear_response_of_normal_inputs(d: int, m: int) -> None:
    problem = Linear(d, m)
    emulation, points = points_of(problem, problem.y, d)
    assert points.n_roots.tolist() == [1] * len(problem.y)
    ours, exact = (
        np.array([f(mean, cov) for mean, cov in populations(d)])
        for f in (
            lambda mean, cov: log_likelihoods(points, normal(mean, cov)),
            lambda mean, cov: problem.sharp(mean, cov, emulation.error),
        )
    )
    # The mass around a root is measured by 256 quasi-random points.
    assert np.allclose(ours, exact, atol=3e-2)
    assert np.allclose(ours.mean(axis=1), exact.mean(axis=1), atol=1e-2)
    # That error is the same for all populations.
    differences = [(a - a[0])[1:] for a in (ours, exact)]
    assert np.abs(differences[0] - differences[1]).max() < 1e-4
    assert np.abs(np.mean(differences[0] - differences[1])) < 1e-6


def test_a_missing_output_is_integrated_over() -> None:
    """One output of three is missing: the others determine both inputs."""
    d = 2
    problem = Linear(d, d + 1)
    y = problem.y.copy()
    y[::3, 0] = np.nan
    emulation, points = points_of(problem, y, d)
    mean, covariance = populations(d)[0]
    exact = problem.sharp(mean, covariance, emulation.error)
    some = Linear(d, d + 1)
    some.matrix = some.matrix[1:]
    exact[::3] = some.sharp(mean, covariance, emulation.error[1:])[::3]
    assert np.allclose(log_likelihoods(points, normal(mean, covariance)), exact, atol=3e-2)


def square(z: Floats) -> Floats:
    return z**2


def test_a_folded_normal_population() -> None:
    x = 0.15 + 0.3 * np.random.default_rng(0).normal(size=20)
    x = x[np.abs(x) > 0.02]
    _, points = points_of(square, x[:, None] ** 2, 1)
    assert set(points.n_roots) == {2}
    for mean, sd in ((0.15, 0.3), (0.0, 0.2), (-0.3, 0.25)):
        # p(y) = [p(x) + p(-x)] / |2 x|
        exact = np.logaddexp(norm.logpdf(x, mean, sd), norm.logpdf(-x, mean, sd))
        exact -= np.log(2 * np.abs(x))
        ours = log_likelihoods(points, normal(mean, sd**2))
        assert np.allclose(ours, exact, atol=2e-2)
        # Beside the fold the density is not constant over the emulator's error.
        assert ours.sum() == pytest.approx(exact.sum(), abs=3e-2)


def two_roots(z: Floats) -> Floats:
    """Sum and product of two stiffnesses, which are the same when these are exchanged."""
    k, g = np.exp(z[:, 0]), np.exp(z[:, 1])
    return np.stack([k + g, k * g], axis=1)


def test_a_response_with_a_mirror_root() -> None:
    rng = np.random.default_rng(1)
    x = np.array([0.3, -0.4]) + 0.15 * rng.normal(size=(15, 2))
    _, points = points_of(two_roots, two_roots(x), 2)
    assert set(points.n_roots) == {2}
    k, g = np.exp(x).T
    log_det = np.log(np.abs(k - g) * k * g)
    for mean in ([0.3, -0.4], [0.0, 0.0], [-0.2, 0.1]):
        covariance = np.array([[0.05, 0.02], [0.02, 0.08]])
        p = multivariate_normal(mean, covariance)
        exact = np.logaddexp(p.logpdf(x), p.logpdf(x[:, ::-1])) - log_det
        assert np.allclose(log_likelihoods(points, normal(mean, covariance)), exact, atol=2e-2)


def turned(y: float, error: float, mean: float, sd: float) -> float:
    """Return the log-density of a reading of z^2 of a normal population, by quadrature."""

    def integrand(z: float) -> float:
        return float(norm.pdf(y, z**2, error) * norm.pdf(z, mean, sd))

    return float(np.log(quad(integrand, -1.5, 1.5, points=[-0.3, 0.0, 0.3], limit=200)[0]))


@pytest.mark.long
@pytest.mark.parametrize("error", [0.02, 0.1])
def test_readings_around_a_turning_point(error: float) -> None:
    """y = z^2 + error: near zero both roots merge, and some readings are beyond the response."""
    rng = np.random.default_rng(2)
    x = 0.1 + 0.25 * rng.normal(size=20)
    y = (x**2 + error * rng.normal(size=20))[:, None]
    _, points = points_of(square, y, 1, error=error)
    differences = []
    for mean, sd in ((0.1, 0.25), (0.0, 0.15), (0.3, 0.3)):
        exact = [turned(value, error, mean, sd) for value in y[:, 0]]
        ours = log_likelihoods(points, normal(mean, sd**2))
        differences.append(ours.sum() - np.sum(exact))
        assert np.abs(ours - exact).max() < 0.3
    assert np.abs(differences).max() < 0.6


def test_the_end_of_a_support_jumps_at_the_largest_specimen() -> None:
    """The likelihood of a uniform population's end is theta^-N above the largest x, else zero."""
    x = np.random.default_rng(0).uniform(-0.8, 0.6, 30)
    _, points = points_of(lambda z: np.exp(z), np.exp(x)[:, None], 1)

    def total(end: float) -> float:
        with np.errstate(divide="ignore"):
            inside = np.log((points.z[..., 0] > -1) & (points.z[..., 0] < end))
        terms = inside - np.log(end + 1) + points.log_a
        return float(logsumexp(terms, axis=1).sum())

    above, far = x.max() + 1e-4, x.max() + 0.3
    assert total(above) - total(far) == pytest.approx(
        30 * np.log((far + 1) / (above + 1)), abs=1e-6
    )
    assert total(above) == pytest.approx(-30 * np.log(above + 1) - x.sum(), abs=0.05)
    assert total(x.max() - 1e-3) == -np.inf


@pytest.mark.parametrize(
    "scatter", [0.05, *(pytest.param(scatter, marks=pytest.mark.long) for scatter in (0.3, 1.0))]
)
def test_populations_of_readings_with_a_large_error(scatter: float) -> None:
    """y = z + error: the population is narrower than the error, as wide, or wider."""
    ranges = []
    for seed in range(3):
        rng = np.random.default_rng([5, seed])
        y = 0.2 + scatter * rng.normal(size=(20, 1)) + 0.3 * rng.normal(size=(20, 1))
        _, points = points_of(lambda z: z, y, 1, error=0.3, unit=3.0)
        differences = []
        for sd in (0.8 * scatter, scatter, 1.25 * scatter):
            exact = norm.logpdf(y[:, 0], 0.2, np.hypot(sd, 0.3)).sum()
            differences.append(log_likelihoods(points, normal(0.2, sd**2)).sum() - exact)
        ranges.append(np.ptp(differences))
    # A difference of .1 nats over one posterior standard deviation shifts the posterior by .1 of
    # it; these populations are about two apart.
    assert np.sqrt(np.mean(np.square(ranges))) < 0.2


@pytest.mark.parametrize(("measured", "mean", "sd"), [(1, 0.4, 0.5), (15, -0.45, 0.07)])
def test_censored_specimens_far_from_the_measured_ones(
    measured: int, mean: float, sd: float
) -> None:
    y = np.full((20, 1), np.nan)
    y[:measured, 0] = -0.5 + 0.1 * np.arange(measured) / measured
    lower = np.where(np.isnan(y), -0.4, np.nan)
    upper = np.where(np.isnan(y), np.inf, np.nan)
    data = replace(Readings.exact(y), lower=lower, upper=upper)
    problem = EmulationProblem(lambda z: z, data, PointOptions(half_difference=0.5))
    _, points = drawn(problem, cube(1), cube(1, 1.5))
    exact = norm.logpdf(y[:measured, 0], mean, sd).sum()
    exact += (20 - measured) * norm.logsf(-0.4, mean, sd)
    ours = log_likelihoods(points, normal(mean, sd**2)).sum()
    assert abs(ours - exact) < 0.1


def test_too_few_points_are_refused() -> None:
    problem = Linear(1, 1, n=30)
    options = PointOptions(half_difference=1e-9, most_points=8)
    y = problem.y + 0.3 * np.random.default_rng(0).normal(size=problem.y.shape)
    with pytest.raises(DesignError, match=r"two halves of .* points a specimen that differ by .*"):
        points_of(problem, y, 1, error=0.3, options=options)


def test_a_response_that_cannot_be_emulated_is_refused() -> None:
    def rough(z: Floats) -> Floats:
        return z + 0.5 * np.sin(1e4 * z)

    y = rough(0.2 * np.random.default_rng(0).normal(size=(20, 1)))
    with pytest.raises(DesignError, match=r"metric=prb.ProbabilityResidual"):
        points_of(rough, y, 1)


def test_runs_far_from_the_data_do_not_count_as_errors() -> None:
    """A response that is steep beyond the data is emulated well at them."""

    def steep(z: Floats) -> Floats:
        return np.exp(np.exp(6 * z - 3.6))

    errors, misfits = [], []
    for seed in range(2):
        z = (np.log(np.random.default_rng(seed).uniform(0, 2, 25)) + 3.6) / 6
        y = steep(z[:, None])
        emulation, points = points_of(steep, y, 1)
        counts = points.log_a > points.log_a.max(axis=1, keepdims=True) - 10
        errors.append(emulation.error[0] / y.std())
        misfits.append(np.abs(points.outputs[..., 0] - y)[counts].max() / y.std())
    # Twice the error at 16 roots; at the steepest fresh run it is a thousand times the spread.
    assert max(errors) < 0.02
    assert max(misfits) < 0.1


def test_roots_on_a_steep_branch_are_not_missing() -> None:
    """The outputs of at least 12 runs on the flat branch are nearer than any on the steep one."""

    def cubic(z: Floats) -> Floats:
        x = 2.2 * z
        return x**3 - 3 * x

    y = np.linspace(1.9, 1.99, 12)[:, None]
    emulation, points = points_of(cubic, y, 1)
    assert points.n_roots.tolist() == [3] * 12
    roots = specimen_roots(emulation, readings(y), PointOptions(starts=1))
    assert np.bincount(roots.specimen).tolist() == [3] * 12


def test_starts_are_doubled_while_simulated_specimens_miss_their_inputs() -> None:
    """Two cubic outputs have up to nine roots, of which twelve starts miss one in twelve."""

    def cubic(z: Floats) -> Floats:
        return (1.8 * z) ** 3 - 2 * z + z[:, ::-1] * [0.3, 0.2]

    x = 0.1 + 0.3 * np.random.default_rng(0).standard_normal((25, 2))
    emulation, roots = emulate(EmulationProblem(cubic, readings(cubic(x))), cube(2), cube(2, 1.5))
    data = readings(cubic(x))
    few = specimen_roots(emulation, data, PointOptions())
    many = specimen_roots(emulation, data, PointOptions(starts=len(emulation.z)))
    assert len(few.z) < len(roots.z) == len(many.z)


def test_points_of_a_mirror_population_stay_at_its_roots() -> None:
    """One of two populations is as narrow as the error of the emulator; the other is wide."""

    def symmetric(z: Floats) -> Floats:
        a, b = np.exp(z[:, 0]), np.exp(z[:, 1])
        return np.stack([a * b, a + b], axis=1)

    rng = np.random.default_rng(5)
    x = np.stack([rng.normal(0.5, 0.3, 20), rng.normal(-0.5, 1e-4, 20)], axis=1)
    y = symmetric(x)
    data, box = readings(y), cube(2, 1.5)
    emulation, roots = emulate(EmulationProblem(symmetric, data), cube(2), box)
    emulation = replace(emulation, error=np.array([3e-4, 3e-4]))
    points = draw_points(emulation, data, roots, PointOptions())
    for side in (x, x[:, ::-1]):
        away = np.abs(points.z - side[:, None]).max(axis=2).min(axis=1)
        assert away.max() < 0.01


def test_runs_are_added_while_the_error_could_narrow_a_population() -> None:
    """A population that is narrow beside the emulator's error at a distant mirror population."""

    def cosh(z: Floats) -> Floats:
        return np.stack([z[:, 0] + 0.2 * z[:, 1], np.cosh(3 * z[:, 1] - 0.9)], axis=1)

    rng = np.random.default_rng(2)
    x = np.stack([rng.normal(0.2, 0.02, 15), rng.normal(0.35, 0.9, 15)], axis=1)
    data, box = readings(cosh(x)), cube(2, 2.0)
    problem = EmulationProblem(cosh, data)
    emulation, _ = emulate(problem, cube(2), box)
    rough, roots = emulate(replace(problem, options=PointOptions(bias=1e9)), cube(2), box)
    assert rough.bias < PointOptions().bias < _narrowing(rough, data, roots)
    assert len(emulation.z) > len(rough.z) == 128
    assert emulation.error[1] < rough.error[1] / 10


def test_the_search_covers_the_population_of_the_roots() -> None:
    x = np.random.default_rng(0).normal(0.6, 0.2, 20)
    problem = EmulationProblem(lambda z: 2 * z, readings(2 * x[:, None]))
    emulation, _ = emulate(problem, cube(1), cube(1, 1.2))
    assert emulation.box[0, 0] == -1.2
    # All of 20 specimens are below with a probability of 1 - 1 / 4097.
    end = x.mean() + norm.isf(1 / 4097 / 20) * x.std()
    assert emulation.box[1, 0] == pytest.approx(end, rel=1e-3)


def test_batches_of_runs_are_at_the_roots() -> None:
    sizes: list[int] = []

    def counted(z: Floats) -> Floats:
        sizes.append(len(z))
        return square(z)

    x = np.random.default_rng(0).uniform(0.2, 0.5, 20)
    emulation, _ = points_of(counted, x[:, None] ** 2, 1)
    assert sizes == [64, 32, 32]
    assert len(emulation.z) == 128
    fresh = np.abs(emulation.z[64:])
    # Within the roots' range, and .4 of a standard deviation of roots of both signs around it
    assert np.mean((fresh > 0.1) & (fresh < 0.7)) > 0.8


def of_folded(points: SpecimenPoints, unit: float = 1.0) -> Floats:
    density = normal(0.15 * unit, (0.3 * unit) ** 2)
    return log_likelihoods(points, density)


FOLDED = (0.2 + 0.1 * np.random.default_rng(4).random(12))[:, None] ** 2


@pytest.mark.parametrize("unit", [1e-6])
def test_units_of_inputs_and_outputs_shift_the_log_likelihood(unit: float) -> None:
    _, points = points_of(square, FOLDED, 1)
    _, other = points_of(lambda z: unit * square(z / unit), unit * FOLDED, 1, unit=unit)
    assert np.array_equal(points.n_roots, other.n_roots)
    assert np.allclose(of_folded(other, unit), of_folded(points) - np.log(unit), atol=1e-6)


def test_the_order_of_inputs_and_outputs_does_not_matter() -> None:
    problem = Linear(2, 3)
    _, points = points_of(problem, problem.y, 2)
    _, other = points_of(lambda z: problem(z[:, ::-1])[:, ::-1], problem.y[:, ::-1], 2)
    mean, covariance = populations(2)[0]
    first = log_likelihoods(points, normal(mean, covariance))
    second = log_likelihoods(other, normal(mean[::-1], covariance[::-1, ::-1]))
    assert np.allclose(first - first[0], second - second[0], atol=2e-2)


def test_the_same_seed_gives_the_same_bits() -> None:
    (_, first), (_, second), (_, third) = (points_of(square, FOLDED, 1, seed=s) for s in (0, 0, 1))
    for name in ("z", "outputs", "log_a", "log_proposal"):
        assert np.array_equal(getattr(first, name), getattr(second, name))
        assert not np.array_equal(getattr(first, name), getattr(third, name))


def test_a_response_of_a_part_of_the_box() -> None:
    def positive(z: Floats) -> Floats:
        return np.where(z > 0, z**2, np.nan)

    x = np.random.default_rng(3).uniform(0.15, 0.6, 20)
    _, points = points_of(positive, x[:, None] ** 2, 1)
    assert set(points.n_roots) == {1}
    exact = norm.logpdf(x, 0.3, 0.2) - np.log(2 * x)
    assert np.allclose(log_likelihoods(points, normal(0.3, 0.04)), exact, atol=2e-2)


def test_a_response_that_hardly_exists_is_refused() -> None:
    with pytest.raises(DesignError, match="got 0 runs with a response of 64, expected at least 8"):
        points_of(lambda z: np.full_like(z, np.nan), FOLDED, 1)


def test_a_run_with_a_huge_response_and_equal_runs_cost_no_digits() -> None:
    z = np.linspace(-1, 1, 41)[:, None]
    data = readings(np.linspace(-0.5, 0.5, 9)[:, None])
    y = z + z**3
    y[-1] = 1e30
    # Twenty runs at one place, to the last digit but one.
    rng = np.random.default_rng(0)
    copies = 0.1 + 1e-16 * rng.standard_normal((20, 1))
    z, y = np.concatenate([z, copies]), np.concatenate([y, copies + copies**3])
    surface, *_ = surface_near(z, y, data, "y")
    near = np.linspace(-0.5, 0.5, 11)[:, None]
    np.testing.assert_allclose(surface.values(near), near + near**3, atol=0.02)
    # Of a straight response over a wide prior all runs keep their values.
    z = np.linspace(-1, 1, 41)[:, None]
    surface, *_ = surface_near(z, 1e9 * z, data, "y")
    np.testing.assert_allclose(surface.values(z), 1e9 * z, atol=1)
