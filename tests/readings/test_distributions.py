"""Distributions of readings: densities against SciPy, draws, and refused arguments."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from scipy import stats

import prbayes as prb
from prbayes._validate import Floats
from prbayes.metrics.readings import Readings, add_errors, with_values
from prbayes.readings import Binomial, Combined, NegativeBinomial, Poisson, ReadingDistribution

PYTHON = pytensor.compile.mode.Mode(linker="py", optimizer="fast_compile")
SIZE = np.array([0.5, 2.0, 8.0, 20.0])
TRIALS = np.array([1.0, 5.0, 12.0, 30.0])
COUNTS = np.array([0.0, 1.0, 7.0, 12.0])


def poisson(y: Any, f: Any) -> Floats:
    return np.asarray(stats.poisson.logpmf(y, SIZE * f))


def negative_binomial(y: Any, f: Any) -> Floats:
    return np.asarray(stats.nbinom.logpmf(y, 3.0, 3.0 / (3.0 + SIZE * f)))


def binomial(y: Any, f: Any) -> Floats:
    return np.asarray(stats.binom.logpmf(y, TRIALS, f))


CASES: list[tuple[ReadingDistribution, Any]] = [
    (Poisson(SIZE), poisson),
    (NegativeBinomial(3.0, SIZE), negative_binomial),
    (Binomial(TRIALS), binomial),
]
NAMES = ["poisson", "negative binomial", "binomial"]


def read(distribution: ReadingDistribution, y: Floats = COUNTS, **options: Any) -> Readings:
    return prb.LogLikelihood(error=distribution, **options).readings(y[:, None])


@pytest.mark.parametrize(("distribution", "exact"), CASES, ids=NAMES)
def test_counts_have_the_density_of_scipy(distribution: ReadingDistribution, exact: Any) -> None:
    readings = read(distribution)
    for f in (0.03, 0.4, 0.97):
        outputs = np.full((4, 1, 1), f)
        density = readings.log_density(outputs, np.array([0.01]))[:, 0]
        np.testing.assert_allclose(density, exact(COUNTS, f), rtol=1e-10, atol=1e-12)
        graph = readings.symbolic_log_density(outputs, np.ones((1, 1)), pt, pt.as_tensor([3.0]))
        np.testing.assert_allclose(graph.eval(mode=PYTHON)[:, 0], density, rtol=1e-10, atol=1e-12)
    # Beyond the range of a mean there is no density to speak of; without a response none at all.
    outside = readings.log_density(np.full((4, 1, 1), -0.1), np.array([0.0]))[:, 0]
    assert (outside[1:] < -300).all()
    assert (readings.log_density(np.full((4, 1, 1), np.nan), np.array([0.0])) == -np.inf).all()


@pytest.mark.parametrize(("distribution", "exact"), CASES, ids=NAMES)
def test_probabilities_of_counts_sum_to_one(distribution: ReadingDistribution, exact: Any) -> None:
    total = np.zeros(4)
    for count in range(400):
        y = np.full(4, float(count))
        if isinstance(distribution, Binomial):
            y = np.minimum(y, TRIALS)
        density = np.exp(read(distribution, y).log_density(np.full((4, 1, 1), 0.6), np.zeros(1)))
        total += np.where(y == count, density[:, 0], 0.0)
    np.testing.assert_allclose(total, 1.0, rtol=1e-10)


# The likelihood of a negative binomial mean has no second moment at this alpha.
@pytest.mark.parametrize(("distribution", "exact"), CASES[::2], ids=NAMES[::2])
def test_the_normal_approximation_has_the_width_of_the_likelihood(
    distribution: ReadingDistribution, exact: Any
) -> None:
    readings = read(distribution)
    f = np.linspace(1e-4, 1 - 1e-4 if isinstance(distribution, Binomial) else 40, 4001)
    logs = np.array([exact(COUNTS, x) for x in f])
    w = np.exp(logs - logs.max(axis=0))
    w /= w.sum(axis=0)
    mean = (w * f[:, None]).sum(axis=0)
    sd = np.sqrt((w * (f[:, None] - mean) ** 2).sum(axis=0))
    ratio = readings.error[:, 0] / sd
    assert ratio.min() > 0.9
    assert ratio.max() < 1.1
    with_count = COUNTS / np.atleast_1d(distribution.size)  # type: ignore[attr-defined]
    np.testing.assert_allclose(readings.values[:, 0], with_count)


@pytest.mark.parametrize("distribution", [c[0] for c in CASES], ids=NAMES)
def test_draws_have_the_mean_and_the_variance(distribution: ReadingDistribution) -> None:
    readings, f, n = read(distribution), 0.4, 20000
    drawn = add_errors(readings, np.random.default_rng(0), np.full((n, 4, 1), f))[..., 0]
    frozen = {
        "Poisson": stats.poisson(SIZE * f),
        "NegativeBinomial": stats.nbinom(3.0, 3.0 / (3.0 + SIZE * f)),
        "Binomial": stats.binom(TRIALS, f),
    }[type(distribution).__name__]
    error = frozen.std() / np.sqrt(n)
    assert (np.abs(drawn.mean(axis=0) - frozen.mean()) < 5 * error).all()
    kurtosis = np.asarray(frozen.stats("k"))
    error = frozen.var() * np.sqrt((kurtosis + 2) / n)
    assert (np.abs(drawn.var(axis=0) - frozen.var()) < 5 * error).all()
    assert (with_values(readings, drawn[:1].T).values * readings.size == drawn[:1].T).all()


def test_a_large_alpha_is_the_poisson_distribution() -> None:
    outputs = np.full((4, 1, 1), 0.7)
    few = read(NegativeBinomial(1e9, SIZE)).log_density(outputs, np.zeros(1))
    np.testing.assert_allclose(
        few, read(Poisson(SIZE)).log_density(outputs, np.zeros(1)), rtol=1e-6
    )


def test_parts_of_a_combined_error_add_and_a_bias_shifts() -> None:
    y, f = np.array([1.0, -2.0, 5.0, 2.2]), 1.7
    metric = prb.LogLikelihood(error=Combined(0.3, 0.2), bias=0.5, censored=(None, 4.0))
    readings = metric.readings(y[:, None])
    density = readings.log_density(np.full((4, 1, 1), f), np.array([0.1]))[:, 0]
    sd = np.sqrt(0.1**2 + 0.3**2 + (0.2 * f) ** 2)
    expected = stats.norm.logpdf(y, f + 0.5, sd)
    expected[2] = stats.norm.logsf(4.0, f + 0.5, sd)
    np.testing.assert_allclose(density, expected, rtol=1e-12)
    drawn = add_errors(readings, np.random.default_rng(0), np.full((20000, 4, 1), f))
    assert drawn.mean() == pytest.approx(f + 0.5, abs=5 * 0.46 / np.sqrt(80000))
    assert drawn.std() == pytest.approx(np.hypot(0.3, 0.2 * f), rel=0.02)
    np.testing.assert_allclose(with_values(readings, y[:, None]).values[:2, 0], y[:2] - 0.5)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Poisson(-1.0), "expected positive numbers"),
        (lambda: Binomial("ten"), "expected real numbers"),
        (lambda: prb.LogLikelihood(error=Poisson(), relative=True), "leave relative= out"),
        (lambda: prb.LogLikelihood(error=Poisson(), rounded=1.0), "leave rounded= out"),
        (lambda: prb.LogLikelihood(error=Combined(1, 1), relative=True), "leave relative= out"),
        (lambda: prb.LogLikelihood(bias=np.nan), "expected finite numbers"),
        (lambda: prb.LogLikelihood(bias=pt.dscalar("b")), "a variable without error="),
        (lambda: read(Poisson(), np.array([1.5, 2.0])), "expected whole numbers from 0"),
        (lambda: read(Poisson(), np.array([-1.0, 2.0])), "expected whole numbers from 0"),
        (lambda: read(Binomial(4), np.array([5.0, 2.0])), "up to 4"),
        (lambda: read(Poisson([1.0, 2.0, 3.0])), "got shape"),
    ],
)
def test_refused_arguments(make: Any, text: str) -> None:
    with pytest.raises((TypeError, ValueError), match=text):
        make()


@pytest.mark.parametrize(
    "metric",
    [
        lambda e: prb.LogLikelihood(error=e),
        lambda e: prb.LogLikelihood(error=Combined(0.1, e)),
        lambda e: prb.LogLikelihood(error=1.0, bias=e),
        lambda e: prb.LogLikelihood(error=NegativeBinomial(e)),
    ],
)
def test_an_unknown_parameter_of_each_reading_is_refused(metric: Any) -> None:
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), 1.0)
        unknown = metric(pm.HalfNormal("e", 1.0, shape=3))
        with pytest.raises(ValueError, match=r"got a variable of shape \(3,\), expected a scalar"):
            prb.Simulator("y", np.exp, x, observed=[1, 2, 5], metric=unknown)


def test_exposures_in_another_order_are_refused() -> None:
    observed = pd.Series([1.0, 2.0, 5.0], index=["a", "b", "c"])
    hours = pd.Series([3.0, 2.0, 1.0], index=["c", "b", "a"])
    metric = prb.LogLikelihood(error=Poisson(hours))
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), 1.0)
        with pytest.raises(ValueError, match="order"):
            prb.Simulator("y", np.exp, x, observed=observed, metric=metric)
