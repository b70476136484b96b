"""Densities of readings: exact, with an error, rounded, censored and missing, against quadrature."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from prbayes._validate import Floats
from prbayes.metrics.readings import Readings, averaged, log_interval_probability

NAN = np.nan


def readings(values: list[list[float]], **fields: list[list[float]]) -> Readings:
    """Return readings; what is not given is as of exact ones."""
    exact = Readings.exact(np.array(values))
    given = {name: np.array(field, dtype=float) for name, field in fields.items()}
    return replace(exact, **given)


def outputs(points: list[list[list[float]]]) -> Floats:
    return np.array(points)


def test_exact_readings_are_compared_with_the_error_of_the_emulator() -> None:
    y = readings([[1.0, 20.0], [2.0, 30.0]])
    points = outputs([[[1.1, 19.0], [0.0, 25.0]], [[2.2, 30.0], [5.0, 60.0]]])
    error = np.array([0.5, 4.0])
    expected = norm.logpdf(y.values[:, None], points, error).sum(axis=2)
    assert np.allclose(y.log_density(points, error), expected, rtol=1e-12)


def test_variances_of_reading_and_emulator_add() -> None:
    y = readings([[1.0], [2.0]], error=[[0.3], [0.0]])
    points = outputs([[[1.2]], [[1.5]]])
    density = y.log_density(points, np.array([0.4]))
    assert np.allclose(density[:, 0], norm.logpdf([1.0, 2.0], [1.2, 1.5], [0.5, 0.4]))
    assert np.allclose(y.comparison_sd(np.array([0.4])), [[0.5], [0.4]])


def test_a_relative_error_is_a_share_of_the_output() -> None:
    absolute = readings([[1.0], [-2.0]], error=[[0.3], [0.1]])
    y = replace(absolute, is_relative=np.full((2, 1), True))
    points = outputs([[[1.2], [-0.5]], [[-1.5], [0.0]]])
    density = y.log_density(points, np.array([0.4]))
    sd = np.hypot(0.4, np.array([[0.3], [0.1]]) * np.abs(points[..., 0]))
    assert np.allclose(density, norm.logpdf(y.values, points[..., 0], sd), rtol=1e-12)
    # Roots are searched with the error at the reading.
    assert np.allclose(y.comparison_sd(np.array([0.4]))[:, 0], np.hypot(0.4, [0.3, 0.2]))


@pytest.mark.parametrize("output", [0.0, 0.7, 3.0])
@pytest.mark.parametrize("step", [1e-3, 0.5, 5.0])
def test_a_rounded_reading_has_the_mean_density_over_its_step(output: float, step: float) -> None:
    y = readings([[1.0]], step=[[step]])
    density = y.log_density(outputs([[[output]]]), np.array([0.2]))[0, 0]
    mean, _ = (
        quad(lambda x: norm.pdf(x, output, 0.2) / step, 1 - step / 2, 1 + step / 2, points=[output])
        if abs(output - 1) < step / 2
        else quad(lambda x: norm.pdf(x, output, 0.2) / step, 1 - step / 2, 1 + step / 2, epsabs=0)
    )
    assert density == pytest.approx(np.log(mean), rel=1e-6, abs=1e-8)


def test_a_small_step_is_an_exact_reading() -> None:
    points = outputs([[[0.9], [1.3], [4.0]]])
    exact = readings([[1.0]]).log_density(points, np.array([0.2]))
    rounded = readings([[1.0]], step=[[1e-5]]).log_density(points, np.array([0.2]))
    assert np.allclose(exact, rounded, atol=1e-6)


def test_rounding_has_the_variance_of_a_uniform_error() -> None:
    y = readings([[1.0]], error=[[0.3]], step=[[0.6]])
    assert y.comparison_sd(np.array([0.4])) == pytest.approx(np.sqrt(0.25 + 0.36 / 12))


@pytest.mark.parametrize(
    ("lower", "upper"), [(1.0, np.inf), (-np.inf, 0.5), (-1.0, 0.5), (3.0, 3.1)]
)
def test_a_censored_reading_has_the_probability_of_its_interval(lower: float, upper: float) -> None:
    y = readings([[NAN]], lower=[[lower]], upper=[[upper]])
    assert y.is_censored.tolist() == [[True]]
    assert y.is_measured.tolist() == [[False]]
    for output in (-1.0, 0.4, 2.0):
        density = y.log_density(outputs([[[output]]]), np.array([0.3]))[0, 0]
        low, high = max(lower, output - 12), min(upper, output + 12)
        probability, _ = quad(norm(output, 0.3).pdf, low, high, epsabs=0, limit=200)
        assert density == pytest.approx(np.log(probability), rel=1e-6, abs=1e-9)


def test_a_missing_output_has_no_influence() -> None:
    both = readings([[1.0, NAN], [NAN, 5.0], [1.0, 5.0]])
    error = np.array([0.5, 2.0])
    points = outputs([[[1.3, 6.0]], [[1.3, 6.0]], [[1.3, 6.0]]])
    first, second = norm.logpdf(1.0, 1.3, 0.5), norm.logpdf(5.0, 6.0, 2.0)
    assert np.allclose(both.log_density(points, error)[:, 0], [first, second, first + second])
    assert np.isinf(both.comparison_sd(error)).tolist() == [
        [False, True],
        [True, False],
        [False] * 2,
    ]


def test_outputs_of_different_kinds_multiply() -> None:
    y = readings(
        [[1.0, 2.0, NAN]],
        error=[[0.1, 0.0, 0.2]],
        step=[[0.0, 1.0, 0.0]],
        lower=[[NAN, NAN, 3.0]],
        upper=[[NAN, NAN, np.inf]],
    )
    error = np.array([0.3, 0.4, 0.5])
    density = y.log_density(outputs([[[1.2, 2.4, 2.8]]]), error)[0, 0]
    expected = (
        norm.logpdf(1.0, 1.2, np.hypot(0.3, 0.1))
        + np.log(norm.cdf(2.5, 2.4, 0.4) - norm.cdf(1.5, 2.4, 0.4))
        + norm.logsf(3.0, 2.8, np.hypot(0.5, 0.2))
    )
    assert density == pytest.approx(expected, rel=1e-9)


def test_a_point_without_response_has_no_density() -> None:
    y = readings([[1.0, 2.0]])
    points = outputs([[[NAN, 2.0], [1.0, 2.0]]])
    assert y.log_density(points, np.ones(2))[0, 0] == -np.inf
    assert np.isfinite(y.log_density(points, np.ones(2))[0, 1])


@pytest.mark.parametrize("away", [10.0, 40.0, 1e3])
def test_deep_tails_have_finite_densities(away: float) -> None:
    # log(Phi(b) - Phi(a)) ~ log pdf(a) - log a, to 1 / a^2
    for low, high in ((away, away + 1), (-away - 1, -away), (away, np.inf), (-np.inf, -away)):
        value = log_interval_probability(np.array(low), np.array(high))
        assert value == pytest.approx(norm.logpdf(away) - np.log(away), abs=1.1 / away**2 + 1e-4)


def test_an_interval_and_its_mirror_image_are_equally_probable() -> None:
    low = np.random.default_rng(0).uniform(-30, 30, 200)
    high = low + np.random.default_rng(1).exponential(size=200)
    value = log_interval_probability(low, high)
    assert np.allclose(value, log_interval_probability(-high, -low), rtol=1e-12)
    with np.errstate(divide="ignore"):
        exact = np.log(norm.cdf(high) - norm.cdf(low))
    near = np.abs(low) < 4
    assert np.allclose(value[near], exact[near], rtol=1e-8)


def test_narrow_intervals_have_the_density_times_the_width() -> None:
    low = np.array([-20.0, -3.0, 0.0, 3.0, 20.0])
    value = log_interval_probability(low, low + 1e-9)
    assert np.allclose(value, norm.logpdf(low) + np.log(1e-9), rtol=1e-5)


def test_probabilities_of_all_intervals_sum_to_one() -> None:
    ends = np.concatenate([[-np.inf], np.linspace(-4, 6, 41), [np.inf]])
    count = len(ends) - 1
    y = readings([[NAN]] * count, lower=ends[:-1, None].tolist(), upper=ends[1:, None].tolist())
    points = np.full((count, 1, 1), 0.7)
    total = np.exp(y.log_density(points, np.array([0.8]))).sum()
    assert total == pytest.approx(1.0, abs=1e-12)


def test_densities_of_all_rounded_readings_sum_to_one() -> None:
    values = np.arange(-40, 41) * 0.25
    step = [[0.25]] * len(values)
    y = readings(values[:, None].tolist(), step=step)
    points = np.full((len(values), 1, 1), 0.13)
    total = 0.25 * np.exp(y.log_density(points, np.array([0.8]))).sum()
    assert total == pytest.approx(1.0, abs=1e-12)


def test_units_shift_the_density_by_their_logarithm() -> None:
    unit = 1e4
    y, other = (
        readings([[1.0]], error=[[0.2]], step=[[0.1]]),
        readings([[unit]], error=[[0.2 * unit]], step=[[0.1 * unit]]),
    )
    points = outputs([[[0.8], [1.1]]])
    first = y.log_density(points, np.array([0.05]))
    second = other.log_density(unit * points, np.array([0.05 * unit]))
    assert np.allclose(second, first - np.log(unit), rtol=1e-9)


def test_rows_are_the_readings_of_some_specimens() -> None:
    y = readings(
        [[1.0], [NAN], [3.0]],
        error=[[0.1], [0.2], [0.3]],
        step=[[0.0], [0.0], [1.0]],
        lower=[[NAN], [2.0], [NAN]],
        upper=[[NAN], [np.inf], [NAN]],
    )
    index = np.array([2, 1])
    some = y.rows(index)
    assert len(some) == 2
    points = np.full((3, 2, 1), 1.4)
    whole = y.log_density(points, np.array([0.5]))
    assert np.array_equal(some.log_density(points[index], np.array([0.5])), whole[index])


def test_the_spread_is_that_of_measured_values_and_never_zero() -> None:
    y = readings([[1.0, 5.0, NAN], [3.0, 5.0, NAN], [NAN, 5.0, NAN]])
    assert y.spread().tolist() == [1.0, 1.0, 1.0]
    assert readings([[1.0], [5.0]]).spread().tolist() == [2.0]


@pytest.mark.parametrize("error", [0.5, 2.0])
def test_repeated_readings_have_the_density_of_their_mean_and_their_scatter(error: float) -> None:
    rng = np.random.default_rng(0)
    numbers = np.array([0, 1, 0, 2, 0, 1])
    y, scale = rng.normal(size=(6, 1)), rng.uniform(0.5, 2.0, (6, 1))
    count = np.bincount(numbers)[:, None]
    mean, combined, repeats = averaged(
        readings(y.tolist(), error=(error * scale).tolist()), scale, numbers, count
    )
    assert np.allclose(mean.error, error * combined, rtol=1e-12)
    outputs_of = np.array([0.3, -0.2, 1.0])
    density = mean.log_density(outputs_of[:, None, None], np.zeros(1))[:, 0]
    density += repeats.log_density(np.array([error]), np)
    each = norm.logpdf(y[:, 0], outputs_of[numbers], error * scale[:, 0])
    assert np.allclose(density, np.bincount(numbers, each), rtol=1e-12)
