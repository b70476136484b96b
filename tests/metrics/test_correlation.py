"""Marginal discrepancies and residuals of correlations."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Minimum, is_additive
from prbayes.metrics.correlation import MarginalCorrelation
from prbayes.metrics.density import is_differentiable
from prbayes.metrics.divergence import ProbabilityResidual

NAN = np.nan


def sample(n: int, seed: int) -> Any:
    y = np.random.default_rng(seed).standard_normal((n, 3))
    y[:, 1] += 2 * y[:, 0]
    return y * [1, 1e3, 1e-3] + [0, 5e3, 1]


def correlations(y: Any) -> Any:
    """Return the discrepancy of correlations alone."""
    part: Any = MarginalCorrelation(AreaMetric()).against(y).parts[-1]
    return part


def test_it_is_the_sum_that_is_documented_in_any_unit() -> None:
    x, y = sample(40, 0), sample(30, 1)
    w, u = np.random.default_rng(2).dirichlet(np.ones(40)), np.arange(1.0, 31.0) / 465
    metric = MarginalCorrelation(AreaMetric(), weights=(3.0, 0.5))
    d = metric.against(y, u)
    expected = 0.0
    for j in range(3):
        alone = AreaMetric().against(y[:, j], u)
        expected += 3 * alone(x[:, j], w) / alone.scale
        for i in range(j):
            simulated, observed = np.cov(x.T, aweights=w), np.cov(y.T, aweights=u)
            rho, r = (c[i, j] / np.sqrt(c[i, i] * c[j, j]) for c in (simulated, observed))
            expected += 0.5 * (rho - r) ** 2
    assert d(x, w) == pytest.approx(expected, rel=1e-9)
    assert [part.label for part in d.parts] == ["output 0", "output 1", "output 2", "correlations"]
    for scale in ([-1, 1, -1], [1e-150, 1e140, 1]):
        assert metric.against(y * scale, u)(x * scale, w) == pytest.approx(expected, rel=1e-9)


def test_a_correlation_has_the_specimens_that_have_both() -> None:
    x, y = sample(40, 0), sample(30, 1)
    y[:10, 0] = NAN
    y[5:15, 2] = NAN
    expected = [
        np.corrcoef(y[10:, 1], y[10:, 0])[0, 1],
        np.corrcoef(y[15:, 2], y[15:, 0])[0, 1],
        np.corrcoef(np.delete(y, np.s_[5:15], 0)[:, 1:].T)[0, 1],
    ]
    np.testing.assert_allclose(correlations(y).target.correlations, expected, rtol=1e-10)
    y[:28, 0] = NAN
    with pytest.raises(ValueError, match="2 specimens that have both output 1 and output 0"):
        MarginalCorrelation(AreaMetric()).against(y)
    assert np.isfinite(MarginalCorrelation(AreaMetric()).against(y[:, 1:])(x[:, 1:]))


def test_a_data_set_without_a_pair_leaves_its_correlation_out() -> None:
    x, y = sample(40, 0), sample(30, 1)
    y[:10, 0] = NAN
    part = correlations(y)
    target = part.target.with_observed(part.observed_of(y)[0][:10])
    r, rho = np.corrcoef(y[:10, 1:].T)[0, 1], np.corrcoef(x[:, 1:].T)[0, 1]
    assert target.of(part.of(x), np.full(40, 1 / 40)) == pytest.approx((rho - r) ** 2)


def test_a_population_that_is_one_number_has_no_correlation() -> None:
    part = correlations(sample(30, 1))
    expected = (part.target.correlations**2).sum()
    found = part.target.of(part.of(np.ones((9, 3))), np.full(9, 1 / 9))
    assert found == pytest.approx(expected, rel=1e-3)


def test_declarations() -> None:
    quadratic, absolute = (MarginalCorrelation(m) for m in (ProbabilityResidual(), AreaMetric()))
    assert (quadratic.minimum, absolute.minimum) == (Minimum.QUADRATIC, Minimum.UNKNOWN)
    y = sample(20, 0)
    assert [is_differentiable(m.against(y)) for m in (quadratic, absolute)] == [True, False]
    assert not is_additive(quadratic.against(y))
    assert quadratic.like(AreaMetric()) == absolute
