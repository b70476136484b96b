"""The kernel log-likelihood: other observed values, bandwidths and outliers."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pymc as pm
import pytest
from metric_samples import draw
from scipy.stats import norm

from prbayes._validate import Floats
from prbayes.metrics.density import GaussianKDE, Histogram, likelihood_bandwidth, twice_silverman
from prbayes.metrics.divergence import KullbackLeibler, ProbabilityResidual
from prbayes.metrics.likelihood import LogLikelihood, kernel_width
from prbayes.metrics.multivariate import Joint
from prbayes.readings import Combined


def prepared(density: Any, observed: Floats, weights: Floats | None = None) -> Any:
    return LogLikelihood(density=density).against(observed, weights)


def test_other_observed_values_are_read_where_they_are() -> None:
    x, w, z, u = draw(12)
    d = prepared(GaussianKDE(0.4), z, u)
    other = d.with_observed(np.array([0.25]))
    assert other(x, w) == pytest.approx(-np.log(w @ norm.pdf(x, 0.25, 0.4)), rel=1e-3)
    several = d.with_observed(z, np.stack([u, u[::-1]]))
    np.testing.assert_array_equal(several.rows([1]).reading, several.reading[[1]])
    assert d.scale == 1


def test_a_kernel_without_bandwidth_has_the_rule_of_its_metric() -> None:
    kernel = GaussianKDE()
    z, w = np.array([0.0, 0.4, 1.0, 5.0]), np.full(4, 0.25)
    likelihood = LogLikelihood(density=kernel)
    assert likelihood == LogLikelihood(density=GaussianKDE(likelihood_bandwidth))
    assert hash(likelihood) == hash(LogLikelihood(density=kernel))
    assert repr(likelihood) == repr(LogLikelihood(density=GaussianKDE(likelihood_bandwidth)))
    assert kernel_width(likelihood.against(z)) == likelihood_bandwidth(z, w)
    for metric in (KullbackLeibler, ProbabilityResidual):
        assert metric(kernel) == metric() == metric(GaussianKDE(twice_silverman))
        target: Any = metric(kernel).against(z)
        assert (kernel_width(target), target.cells.bandwidth) == (0, twice_silverman(z, w))
    for density in (GaussianKDE(0.4), GaussianKDE(twice_silverman), Histogram()):
        assert LogLikelihood(density=density).density is density


def test_the_kernel_form_needs_a_density() -> None:
    assert LogLikelihood().density is None
    outputs = np.random.default_rng(0).normal(size=(9, 2))
    for metric, observed in ((LogLikelihood(), [0.0, 1.0]), (Joint(LogLikelihood()), outputs)):
        with pytest.raises(TypeError, match=r"density=None, expected .*density=prb.GaussianKDE"):
            metric.against(observed)


@pytest.mark.parametrize("spread", [0.7, 2.0])
def test_no_value_beyond_the_grid_improves_the_likelihood(spread: float) -> None:
    simulated = spread * norm.ppf((np.arange(2000) + 0.5) / 2000)
    observed = norm.ppf((np.arange(20) + 0.5) / 20)
    inner = prepared(GaussianKDE(), observed)
    for far in inner.cells.centers[-1] + np.array([0.01, 1.0, 100.0]):
        for value in (far, -far):
            more = inner.with_observed(np.append(observed, value))
            assert more(simulated) > inner(simulated)
    # As a weight among those of other data sets.
    weights = np.stack([np.append(np.full(20, 1 / 20), 0.0), np.full(21, 1 / 21)])
    several = inner.with_observed(np.append(observed, 99.0), weights)
    without, within = several.of(simulated[None], np.full((1, 2000), 1 / 2000))
    assert without == pytest.approx(inner(simulated), rel=1e-12)
    assert within > without


def test_each_combination_of_arguments_describes_the_readings_or_is_refused() -> None:
    with pm.Model():
        variable = pm.Beta("variable", 1, 9)
    arguments: dict[str, list[Any]] = {
        "error": [None, 0.1, variable, Combined(0.1, 0.05)],
        "relative": [False, True],
        "bias": [None, 0.05, variable],
        "gross_errors": [False, True, 0.05, variable],
        "rounded": [None, 0.01],
        "censored": [None, (None, 5.0)],
        "selected": [None, (-9.0, None)],
    }
    accepted, refused = [], []
    for values in itertools.product(*arguments.values()):
        options = dict(zip(arguments, values, strict=True))
        try:
            accepted.append(LogLikelihood(**options))
        except ValueError:
            refused.append(options)
    assert any(metric.gross_errors is variable for metric in accepted)
    assert not any(metric.gross_errors is variable and metric.selected for metric in accepted)
    assert not any(metric.bias is variable and metric.error is None for metric in accepted)
    assert any(options["relative"] for options in refused)
