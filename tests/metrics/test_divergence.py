from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from prbayes._validate import Floats
from prbayes.metrics.base import Minimum
from prbayes.metrics.density import GaussianKDE, Histogram
from prbayes.metrics.divergence import DivergenceDiscrepancy, KullbackLeibler


@pytest.mark.parametrize(
    "case", [(0, 1, 0, 1.3), (0.5, 1, 0, 1), (-0.8, 0.8, 0.2, 1), (1, 1.2, 0, 1)]
)
@pytest.mark.parametrize("h", [0.4, 0.6])
@pytest.mark.parametrize("a", [1e-3, 1.0, 70.0])
def test_the_divergence_of_normal_densities(
    normal: Callable[..., Floats], case: tuple[float, ...], h: float, a: float
) -> None:
    m, s, mu, sd = case
    x, z = a * normal(m, s, 100_000), a * normal(mu, sd, 99_000)
    vp, vq, d = a**2 * (s**2 + h**2), a**2 * (sd**2 + h**2), a * (m - mu)
    forward = (vq + d**2) / (2 * vp) - 0.5 + np.log(vp / vq) / 2
    reverse = (vp + d**2) / (2 * vq) - 0.5 + np.log(vq / vp) / 2
    kde = GaussianKDE(a * h)
    np.testing.assert_allclose(KullbackLeibler(kde)(x, z), forward, rtol=3e-3)
    np.testing.assert_allclose(KullbackLeibler(kde, reverse=True)(x, z), reverse, rtol=3e-3)


def test_with_a_histogram_it_is_the_sum_over_bins() -> None:
    observed, simulated = [0.0, 0.5, 1.5, 4.0], [0.1, 3.0]
    # Two bins: q = (3/4, 1/4), p = (1/2, 1/2).
    forward = 3 / 4 * np.log(3 / 2) + 1 / 4 * np.log(1 / 2)
    reverse = 1 / 2 * np.log(2 / 3) + 1 / 2 * np.log(2)
    bins = Histogram(2)
    assert KullbackLeibler(bins)(simulated, observed) == pytest.approx(forward, abs=1e-7)
    found = KullbackLeibler(bins, reverse=True)(simulated, observed)
    assert found == pytest.approx(reverse, abs=1e-7)


def test_what_it_declares() -> None:
    assert KullbackLeibler.minimum is Minimum.QUADRATIC
    assert KullbackLeibler.likelihood
    assert KullbackLeibler().additive
    assert not KullbackLeibler(reverse=True).additive
    assert KullbackLeibler().against([0.0, 1.0, 5.0]).scale == 1


def test_settings_that_are_no_density_are_refused() -> None:
    with pytest.raises(TypeError, match=r"density: got float 0\.3, expected prb"):
        KullbackLeibler(0.3)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"bandwidth: got 0 .*GaussianKDE\(bandwidth=.*AreaMetric"):
        KullbackLeibler()([0.0, 1.0], [0.1])


def test_mass_away_from_the_data_costs_the_floor_in_reverse() -> None:
    d = KullbackLeibler(GaussianKDE(0.4), reverse=True).against([0.0, 1.0, 2.0])
    assert isinstance(d, DivergenceDiscrepancy)
    widths = d.cells.widths
    # Grids end where a kernel has no more of its mass than that left.
    assert 0 < d.density[-1] * widths[-1] < 1e-9
    expected = -np.log(d.density[-1] * widths[-1] + 1e-9 * widths[-1] / widths.sum())
    assert d([1e3, 1e4]) == pytest.approx(expected, rel=1e-6)
