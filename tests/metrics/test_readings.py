"""Densities of readings: exact, with an error, rounded, censored and missing, against quadrature."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytensor
import pytensor.tensor as pt
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from prbayes.metrics.readings import Readings, averaged, log_interval_probability

NAN, INF = np.nan, np.inf
PYTHON = pytensor.compile.mode.Mode(linker="py", optimizer="fast_compile")


def readings(values: Any, **given: Any) -> Readings:
    """Return readings, (N, m); fields that are not given are those of exact ones."""
    arrays = {name: np.array(field, dtype=float) for name, field in given.items()}
    return replace(Readings.exact(np.array(values, dtype=float)), **arrays)


def test_outputs_of_all_kinds_multiply_and_missing_ones_have_no_influence() -> None:
    y = readings(
        [[1.0, 2.0, NAN, 5.0], [NAN, NAN, NAN, 5.0]],
        error=[[0.1, 0.0, 0.2, 0.0], [0.1, 0.0, 0.2, 0.0]],
        step=[[0.0, 1.0, 0.0, 0.0]] * 2,
        lower=[[NAN, NAN, 3.0, NAN], [NAN] * 4],
        upper=[[NAN, NAN, INF, NAN], [NAN] * 4],
    )
    error = np.array([0.3, 0.4, 0.5, 2.0])
    points = np.array([[[1.2, 2.4, 2.8, 6.0]], [[1.2, 2.4, 2.8, 6.0]]])
    exact = norm.logpdf(5.0, 6.0, 2.0)
    expected = (
        norm.logpdf(1.0, 1.2, np.hypot(0.3, 0.1))
        + np.log(norm.cdf(2.5, 2.4, 0.4) - norm.cdf(1.5, 2.4, 0.4))
        + norm.logsf(3.0, 2.8, np.hypot(0.5, 0.2))
        + exact
    )
    np.testing.assert_allclose(y.log_density(points, error)[:, 0], [expected, exact], rtol=1e-9)
    assert np.isinf(y.comparison_sd(error)[:, :2]).tolist() == [[False, False], [True, True]]
    index = np.array([1, 0])
    some = y.rows(index)
    assert len(some) == 2
    whole = y.log_density(points, error)
    np.testing.assert_array_equal(some.log_density(points[index], error), whole[index])
    # A point without response has no density.
    points[0, 0, 1] = NAN
    assert y.log_density(points, error)[0, 0] == -INF


def test_variances_of_reading_emulator_and_rounding_add() -> None:
    absolute = readings([[1.0], [-2.0]], error=[[0.3], [0.1]])
    points, error = np.array([[[1.2], [-0.5]], [[-1.5], [0.0]]]), np.array([0.4])
    share = replace(absolute, error=0 * absolute.error, relative=absolute.error)
    for y, size in ((absolute, 1.0), (share, None)):
        own = absolute.error * (np.abs(points[..., 0]) if size is None else size)
        expected = norm.logpdf(y.values, points[..., 0], np.hypot(0.4, own))
        np.testing.assert_allclose(y.log_density(points, error), expected, rtol=1e-12)
        # Roots are searched with the error at the reading.
        at_reading = absolute.error * (np.abs(y.values) if size is None else size)
        np.testing.assert_allclose(y.comparison_sd(error), np.hypot(0.4, at_reading))
    rounded = readings([[1.0]], error=[[0.3]], step=[[0.6]])
    assert rounded.comparison_sd(error) == pytest.approx(np.sqrt(0.25 + 0.36 / 12))


@pytest.mark.parametrize("unit", [1.0, 1e4])
@pytest.mark.parametrize("step", [1e-5, 0.5, 5.0])
def test_a_rounded_reading_has_the_mean_density_over_its_step(step: float, unit: float) -> None:
    for output in (0.0, 0.7, 3.0):
        y = readings([[unit]], step=[[step * unit]])
        density = y.log_density(np.array([[[output * unit]]]), np.array([0.2 * unit]))
        ends = 1 - step / 2, 1 + step / 2
        is_inside = ends[0] < output < ends[1]
        options: dict[str, Any] = {"points": [output]} if is_inside else {"epsabs": 0}
        mean, _ = quad(lambda x, at=output: norm.pdf(x, at, 0.2) / step, *ends, **options)
        assert density[0, 0] == pytest.approx(np.log(mean / unit), rel=1e-6, abs=1e-8)


@pytest.mark.parametrize(("lower", "upper"), [(1.0, INF), (-INF, 0.5), (-1.0, 0.5), (3.0, 3.1)])
def test_a_censored_reading_has_the_probability_of_its_interval(lower: float, upper: float) -> None:
    y = readings([[NAN]], lower=[[lower]], upper=[[upper]])
    assert (y.is_censored.all(), y.is_measured.any()) == (True, False)
    for output in (-1.0, 0.4, 2.0):
        density = y.log_density(np.array([[[output]]]), np.array([0.3]))[0, 0]
        ends = max(lower, output - 12), min(upper, output + 12)
        probability, _ = quad(norm(output, 0.3).pdf, *ends, epsabs=0, limit=200)
        assert density == pytest.approx(np.log(probability), rel=1e-6, abs=1e-9)


def test_probabilities_of_all_readings_sum_to_one() -> None:
    ends = np.concatenate([[-INF], np.linspace(-4, 6, 41), [INF]])
    values = np.arange(-40, 41)[:, None] * 0.25
    censored = readings(np.full((42, 1), NAN), lower=ends[:-1, None], upper=ends[1:, None])
    rounded = readings(values, step=np.full(values.shape, 0.25))
    for y, unit in ((censored, 1.0), (rounded, 0.25)):
        densities = np.exp(y.log_density(np.full((len(y), 1, 1), 0.7), np.array([0.8])))
        assert unit * densities.sum() == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("away", [10.0, 40.0, 1e3])
def test_deep_tails_have_finite_densities(away: float) -> None:
    # log(Phi(b) - Phi(a)) ~ log pdf(a) - log a, to 1 / a^2
    for low, high in ((away, away + 1), (-away - 1, -away), (away, INF), (-INF, -away)):
        value = log_interval_probability(np.array(low), np.array(high))
        assert value == pytest.approx(norm.logpdf(away) - np.log(away), abs=1.1 / away**2 + 1e-4)


def test_intervals_and_their_mirror_images() -> None:
    low = np.random.default_rng(0).uniform(-30, 30, 200)
    high = low + np.random.default_rng(1).exponential(size=200)
    value = log_interval_probability(low, high)
    np.testing.assert_allclose(value, log_interval_probability(-high, -low), rtol=1e-12)
    near = np.abs(low) < 4
    exact = np.log(norm.cdf(high[near]) - norm.cdf(low[near]))
    np.testing.assert_allclose(value[near], exact, rtol=1e-8)
    graph = log_interval_probability(pt.as_tensor(low), pt.as_tensor(high), pt)
    np.testing.assert_allclose(graph.eval(mode=PYTHON), value, rtol=1e-9)
    narrow = log_interval_probability(low[near], low[near] + 1e-9)
    np.testing.assert_allclose(narrow, norm.logpdf(low[near]) + np.log(1e-9), rtol=1e-5)


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
    mean, combined, repeats = averaged(readings(y, error=error * scale), scale, numbers, count)
    np.testing.assert_allclose(mean.error, error * combined, rtol=1e-12)
    outputs = np.array([0.3, -0.2, 1.0])
    density = mean.log_density(outputs[:, None, None], np.zeros(1))[:, 0]
    density += repeats.log_density(np.array([error]), np)
    each = norm.logpdf(y[:, 0], outputs[numbers], error * scale[:, 0])
    np.testing.assert_allclose(density, np.bincount(numbers, each), rtol=1e-12)
