from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import norm

from prbayes._validate import Floats
from prbayes.metrics.base import Minimum
from prbayes.metrics.density import (
    DensityEstimator,
    GaussianKDE,
    Histogram,
    likelihood_bandwidth,
    twice_silverman,
)
from prbayes.metrics.divergence import KullbackLeibler, ProbabilityResidual
from prbayes.metrics.likelihood import LikelihoodDiscrepancy, LogLikelihood, kernel_width
from prbayes.metrics.multivariate import Joint

Draw = Callable[..., tuple[Floats, Floats, Floats, Floats]]


@pytest.mark.parametrize(
    "case", [(0, 1, 0, 1.3), (0.5, 1, 0, 1), (-0.8, 0.8, 0.2, 1), (1, 1.2, 0, 1)]
)
@pytest.mark.parametrize("h", [0.4, 0.6])
@pytest.mark.parametrize("a", [1e-3, 1.0, 70.0])
def test_the_likelihood_of_a_normal_density(
    normal: Callable[..., Floats], case: tuple[float, ...], h: float, a: float
) -> None:
    m, s, mu, sd = case
    x, z = a * normal(m, s, 100_000), a * normal(mu, sd, 99_000)
    vp, d = a**2 * (s**2 + h**2), a * (m - mu)
    expected = np.log(2 * np.pi * vp) / 2 + (a**2 * sd**2 + d**2) / (2 * vp)
    np.testing.assert_allclose(LogLikelihood(density=GaussianKDE(a * h))(x, z), expected, rtol=3e-3)


def test_with_a_histogram_it_is_the_frequency_of_each_bin() -> None:
    # Two bins of width 2; 3 of 4 simulated values in the first.
    expected = -(2 * np.log(3 / 8) + np.log(1 / 8)) / 3
    found = LogLikelihood(density=Histogram(2))([0.1, 0.2, 1.9, 3.0], [0.0, 1.0, 4.0])
    assert found == pytest.approx(expected, abs=1e-7)


def test_other_observed_values_are_read_where_they_are(draw: Draw) -> None:
    x, w, z, u = draw(12)
    d = LogLikelihood(density=GaussianKDE(0.4)).against(z, u)
    other = d.with_observed(np.array([0.25]))
    assert isinstance(other, LikelihoodDiscrepancy)
    assert other(x, w) == pytest.approx(-np.log(w @ norm.pdf(x, 0.25, 0.4)), rel=1e-3)
    several = d.with_observed(z, np.stack([u, u[::-1]]))
    assert isinstance(several, LikelihoodDiscrepancy)
    np.testing.assert_array_equal(several.rows([1]).reading, several.reading[[1]])


def test_what_it_declares() -> None:
    assert LogLikelihood.minimum is Minimum.QUADRATIC
    assert LogLikelihood.likelihood
    assert LogLikelihood(density=GaussianKDE()).additive
    assert LogLikelihood(density=GaussianKDE()).against([0.0, 1.0, 5.0]).scale == 1


def test_a_kernel_without_bandwidth_has_the_rule_of_its_metric() -> None:
    kernel = GaussianKDE()
    z, w = np.array([0.0, 0.4, 1.0, 5.0]), np.full(4, 0.25)
    likelihood = LogLikelihood(density=kernel)
    assert likelihood == LogLikelihood(density=GaussianKDE(likelihood_bandwidth))
    assert hash(likelihood) == hash(LogLikelihood(density=kernel))
    assert likelihood != LogLikelihood(density=GaussianKDE(twice_silverman))
    assert repr(likelihood) == repr(LogLikelihood(density=GaussianKDE(likelihood_bandwidth)))
    assert kernel_width(likelihood.against(z)) == likelihood_bandwidth(z, w)
    for metric in (KullbackLeibler, ProbabilityResidual):
        assert metric(kernel) == metric() == metric(GaussianKDE(twice_silverman))
        assert repr(metric(kernel)) == repr(metric(GaussianKDE(twice_silverman)))
        target = metric(kernel).against(z)
        assert kernel_width(target) == 0
        assert target.cells.bandwidth == twice_silverman(z, w)
    assert getattr(kernel.cells(z, w), "bandwidth", None) == twice_silverman(z, w)
    assert kernel.bandwidth is None


@pytest.mark.parametrize("density", [GaussianKDE(0.4), GaussianKDE(twice_silverman), Histogram()])
def test_a_density_with_its_own_rule_stays(density: DensityEstimator) -> None:
    metric = LogLikelihood(density=density)
    assert metric.density is density


def test_the_kernel_form_needs_a_density() -> None:
    bare = LogLikelihood()
    assert bare.density is None
    assert bare == LogLikelihood(density=None) != LogLikelihood(density=GaussianKDE())
    message = r"density=None, expected prb.GaussianKDE.*pass .*density=prb.GaussianKDE\(\)"
    with pytest.raises(TypeError, match=message):
        bare.against([0.0, 1.0])
    with pytest.raises(TypeError, match=message):
        bare([0.0, 1.0], [0.0, 1.0])
    with pytest.raises(TypeError, match=message):
        Joint(bare).against(np.random.default_rng(0).normal(size=(9, 2)))
    with pytest.raises(TypeError, match="positional"):
        LogLikelihood(GaussianKDE())  # type: ignore[misc]


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("far", [12.0, 60.0])
def test_an_outlier_counts_alike_whether_it_was_there_at_first_or_in_a_refit(
    side: float, far: float
) -> None:
    rng = np.random.default_rng(3)
    observed = rng.normal(size=30)
    simulated = rng.normal(size=2000)
    with_outlier = np.append(observed, side * far)
    metric = LogLikelihood(density=GaussianKDE(0.3))
    inner = metric.against(observed)
    refitted = inner.with_observed(with_outlier)
    direct = metric.against(with_outlier)
    # The floor is spread over grids of two lengths.
    lengths = [d.cells.widths.sum() for d in (inner, direct)]
    per_value = abs(np.log(lengths[1] / lengths[0])) / with_outlier.size
    assert abs(refitted(simulated) - direct(simulated)) < per_value + 1e-4
    # And not better than without it.
    assert refitted(simulated) > inner(simulated) + 0.5
    # From weights of stored values just the same.
    basis = refitted.basis(simulated)
    (features,) = basis.features(np.full(2000, 1 / 2000))
    np.testing.assert_allclose(refitted.outer(features, xp=np), refitted(simulated), rtol=1e-9)


@pytest.mark.parametrize("spread", [0.7, 1.0, 1.4, 2.0])
def test_no_value_beyond_the_grid_improves_the_likelihood(spread: float) -> None:
    simulated = spread * norm.ppf((np.arange(2000) + 0.5) / 2000)
    observed = norm.ppf((np.arange(20) + 0.5) / 20)
    inner = LogLikelihood(density=GaussianKDE()).against(observed)
    assert isinstance(inner, LikelihoodDiscrepancy)
    for far in inner.cells.centers[-1] + np.array([0.01, 1.0, 100.0]):
        for value in (far, -far):
            more = inner.with_observed(np.append(observed, value))
            assert more(simulated) > inner(simulated)
    # As a weight among those of other data sets.
    values = np.append(observed, 99.0)
    weights = np.stack([np.append(np.full(20, 1 / 20), 0.0), np.full(21, 1 / 21)])
    several = inner.with_observed(values, weights)
    without, within = several.of(simulated[None], np.full((1, 2000), 1 / 2000))
    assert without == pytest.approx(inner(simulated), rel=1e-12)
    assert within > without
