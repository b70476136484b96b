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
from prbayes.metrics.multivariate import Joint

NAN = np.nan


def sample(n: int, seed: int) -> Any:
    y = np.random.default_rng(seed).standard_normal((n, 3))
    y[:, 1] += 2 * y[:, 0]
    return y * [1, 1e3, 1e-3] + [0, 5e3, 1]


def test_it_is_the_sum_that_is_documented() -> None:
    x, y = sample(40, 0), sample(30, 1)
    w, u = np.random.default_rng(2).dirichlet(np.ones(40)), np.arange(1.0, 31.0) / 465
    d = MarginalCorrelation(AreaMetric(), weights=(3.0, 0.5)).against(y, u)
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
    assert d.parts[-1].target.event == (3,)
    assert d.parts[-1].target.parts[0].target is d.parts[-1].target


def test_units_and_signs_of_outputs_do_not_matter() -> None:
    x, y = sample(40, 0), sample(30, 1)
    metric = MarginalCorrelation(AreaMetric())
    expected = metric.against(y)(x)
    for scale in ([-1, 1, -1], [1e-150, 1e140, 1]):
        assert metric.against(y * scale)(x * scale) == pytest.approx(expected, rel=1e-9)


def test_a_correlation_has_the_specimens_that_have_both() -> None:
    x, y = sample(40, 0), sample(30, 1)
    y[:10, 0] = NAN
    y[5:15, 2] = NAN
    target = MarginalCorrelation(AreaMetric()).against(y).parts[-1].target
    expected = [
        np.corrcoef(y[10:, 1], y[10:, 0])[0, 1],
        np.corrcoef(y[15:, 2], y[15:, 0])[0, 1],
        np.corrcoef(np.delete(y, np.s_[5:15], 0)[:, 1:].T)[0, 1],
    ]
    np.testing.assert_allclose(target.correlations, expected, rtol=1e-10)  # type: ignore[attr-defined]
    y[:28, 0] = NAN
    with pytest.raises(ValueError, match="2 specimens that have both output 1 and output 0"):
        MarginalCorrelation(AreaMetric()).against(y)
    assert np.isfinite(MarginalCorrelation(AreaMetric()).against(y[:, 1:])(x[:, 1:]))


def test_a_data_set_without_a_pair_leaves_its_correlation_out() -> None:
    x, y = sample(40, 0), sample(30, 1)
    y[:10, 0] = NAN
    part = MarginalCorrelation(AreaMetric()).against(y).parts[-1]
    seen, _ = part.observed_of(y)
    target = part.target.with_observed(seen[:10])
    r = np.corrcoef(y[:10, 1:].T)[0, 1]
    rho = np.corrcoef(x[:, 1:].T)[0, 1]
    assert target.of(part.of(x), np.full(40, 1 / 40)) == pytest.approx((rho - r) ** 2)


def test_a_population_that_is_one_number_has_no_correlation() -> None:
    d = MarginalCorrelation(AreaMetric()).against(sample(30, 1)).parts[-1]
    constant = np.ones((9, 3))
    r = d.target.correlations  # type: ignore[attr-defined]
    assert d.target.of(d.of(constant), np.full(9, 1 / 9)) == pytest.approx((r**2).sum(), rel=1e-3)


def test_what_is_declared() -> None:
    quadratic, absolute = (MarginalCorrelation(m) for m in (ProbabilityResidual(), AreaMetric()))
    assert (quadratic.minimum, absolute.minimum) == (Minimum.QUADRATIC, Minimum.UNKNOWN)
    assert not quadratic.additive
    y = sample(20, 0)
    assert is_differentiable(quadratic.against(y))
    assert not is_differentiable(absolute.against(y))
    assert not is_additive(quadratic.against(y))
    assert quadratic.like(AreaMetric()) == absolute


@pytest.mark.parametrize("weights", [1.0, (1.0,), [1.0, 1.0], (1.0, "a"), (1.0, True)])
def test_weights_that_are_no_pair_of_numbers_are_refused(weights: Any) -> None:
    with pytest.raises(TypeError, match="weights: got"):
        MarginalCorrelation(AreaMetric(), weights=weights)


@pytest.mark.parametrize("weights", [(0.0, 1.0), (1.0, -1.0), (np.inf, 1.0)])
def test_weights_are_positive(weights: Any) -> None:
    with pytest.raises(ValueError, match="expected a positive finite number"):
        MarginalCorrelation(AreaMetric(), weights=weights)


def test_an_output_with_equal_values_is_refused() -> None:
    with pytest.raises(ValueError, match="equal values of output 1"):
        MarginalCorrelation(AreaMetric()).against(sample(20, 0) * [1, 0, 1])
    with pytest.raises(TypeError, match="compares several outputs already"):
        MarginalCorrelation(Joint(AreaMetric()))
