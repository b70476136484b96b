"""Residuals, divergences and log-likelihoods of densities in closed form, and on bins."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from metric_samples import normal
from scipy.stats import norm

from prbayes._validate import Floats
from prbayes.metrics.base import Metric
from prbayes.metrics.density import GaussianKDE, Histogram
from prbayes.metrics.divergence import KullbackLeibler, ProbabilityResidual
from prbayes.metrics.likelihood import LogLikelihood

INF = np.inf


def prepared(metric: Metric, observed: Floats, weights: Floats | None = None) -> Any:
    return metric.against(observed, weights)


@pytest.mark.parametrize(
    ("m", "s", "mu", "sd"), [(0, 1, 0, 1.3), (0.5, 1, 0, 1), (-0.8, 0.8, 0.2, 1)]
)
@pytest.mark.parametrize(("a", "h"), [(1e-3, 0.4), (70.0, 0.6)])
def test_normal_densities(m: float, s: float, mu: float, sd: float, a: float, h: float) -> None:
    x, z = a * normal(m, s, 100_000), a * normal(mu, sd, 99_000)
    vp, vq, d = a**2 * (s**2 + h**2), a**2 * (sd**2 + h**2), a * (m - mu)
    kde = GaussianKDE(a * h)
    residual = prepared(ProbabilityResidual(kde), z)
    found = [
        residual(x) / residual.scale_factor * a,
        KullbackLeibler(kde)(x, z),
        KullbackLeibler(kde, reverse=True)(x, z),
        LogLikelihood(density=kde)(x, z),
    ]
    integral = (vp**-0.5 + vq**-0.5) / np.sqrt(4 * np.pi)
    expected = [
        a * (integral - 2 * norm.pdf(d, 0, np.sqrt(vp + vq))),
        (vq + d**2) / (2 * vp) - 0.5 + np.log(vp / vq) / 2,
        (vp + d**2) / (2 * vq) - 0.5 + np.log(vq / vp) / 2,
        np.log(2 * np.pi * vp) / 2 + (a**2 * sd**2 + d**2) / (2 * vp),
    ]
    np.testing.assert_allclose(found, expected, rtol=3e-3)


def test_with_a_histogram_they_are_sums_over_bins() -> None:
    d = prepared(ProbabilityResidual(Histogram(2), scale_base=1), np.array([0.0, 1.0, 3.0, 4.0]))
    # Two bins of width 2: q = (1/4, 1/4), and nothing outside; p = (1/6, 0), 1/6 below, 1/6 above.
    expected = (1 / 4 - 1 / 6) ** 2 + (1 / 4) ** 2 + 2 * (1 / 6) ** 2
    assert d([0.5, -9.0, 9.0]) == pytest.approx(expected)
    assert d.scale == pytest.approx(2 / 16)
    observed, simulated = [0.0, 0.5, 1.5, 4.0], [0.1, 3.0]
    # Two bins: q = (3/4, 1/4), p = (1/2, 1/2).
    forward = 3 / 4 * np.log(3 / 2) + 1 / 4 * np.log(1 / 2)
    reverse = 1 / 2 * np.log(2 / 3) + 1 / 2 * np.log(2)
    for is_reverse, divergence in ((False, forward), (True, reverse)):
        metric = KullbackLeibler(Histogram(2), reverse=is_reverse)
        assert metric(simulated, observed) == pytest.approx(divergence, abs=1e-7)
    # Two bins of width 2; 3 of 4 simulated values in the first.
    found = LogLikelihood(density=Histogram(2))([0.1, 0.2, 1.9, 3.0], [0.0, 1.0, 4.0])
    assert found == pytest.approx(-(2 * np.log(3 / 8) + np.log(1 / 8)) / 3, abs=1e-7)


@pytest.mark.parametrize(("sd", "power"), [(8e-5, 3), (80.0, -3), (0.3, 0), (0.03, 1)])
@pytest.mark.parametrize("base", [100.0, 10.0])
def test_scale_factor(sd: float, power: int, base: float) -> None:
    z = normal(5, sd)
    kde = GaussianKDE(sd / 50)
    d, plain = (prepared(ProbabilityResidual(kde, scale_base=c), z) for c in (base, 1))
    assert 10**power <= d.density.max() < 10 ** (power + 1)
    assert d.scale_factor == pytest.approx(base**-power)
    np.testing.assert_allclose(d(z + sd), plain(z + sd) * base**-power, rtol=1e-12)
    without_density = d(np.full(3, INF)) - d.scale_factor / d.cells.widths[-1]
    np.testing.assert_allclose(d.scale, without_density, rtol=1e-10)


def test_other_observed_values_keep_the_scale_factor_and_the_cells() -> None:
    metric = ProbabilityResidual(GaussianKDE(0.01))
    d, tight = prepared(metric, np.linspace(0, 1, 40)), np.full(5, 0.5)
    other = d.with_observed(tight)
    assert d.scale_factor == other.scale_factor == other.rows(slice(None)).scale_factor == 1
    assert prepared(metric, np.append(tight, 0.5001)).scale_factor < 1
    assert other.cells is d.cells
    np.testing.assert_allclose(other.density, d.cells.density(tight, np.full(5, 0.2)))


def test_mass_away_from_the_data_costs_the_floor_in_reverse() -> None:
    d = prepared(KullbackLeibler(GaussianKDE(0.4), reverse=True), np.array([0.0, 1.0, 2.0]))
    widths = d.cells.widths
    # Grids end where a kernel has no more of its mass than that left.
    assert 0 < d.density[-1] * widths[-1] < 1e-9
    expected = -np.log(d.density[-1] * widths[-1] + 1e-9 * widths[-1] / widths.sum())
    assert d([1e3, 1e4]) == pytest.approx(expected, rel=1e-6)
