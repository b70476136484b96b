"""Whole numbers as weights of observed values are frequencies of specimens."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from one_input import one_input
from scipy.optimize import minimize
from scipy.stats import norm

import prbayes as prb
from prbayes.model.data_checks import data_findings
from prbayes.model.random_variable import simulators

SAMPLE = np.random.default_rng(0).normal(10, 2, 400)
COUNTS, EDGES = np.histogram(SAMPLE, bins=20)
MIDDLES = (EDGES[1:] + EDGES[:-1]) / 2
METRICS = [prb.AreaMetric(), prb.LogLikelihood(rounded=float(EDGES[1] - EDGES[0]))]


def model(metric: Any, observed: Any = MIDDLES, **given: Any) -> pm.Model:
    settings = {"observed": observed, "propagation": prb.Reweighted(128), **given}
    return one_input(metric=metric, response=lambda x: 1.0 * x, mu=(9, 3), sigma=3, **settings)


@pytest.mark.long
@pytest.mark.parametrize("metric", METRICS, ids=lambda metric: type(metric).__name__)
def test_a_histogram_is_as_many_specimens_as_it_counts(metric: Any) -> None:
    """The standard error of the mean is sd / sqrt(400) = .1, not that of twenty values."""
    counted = prb.minimize(model(metric, weights=COUNTS), starts=0)
    repeated = prb.minimize(model(metric, np.repeat(MIDDLES, COUNTS)), starts=0)
    assert counted.point == repeated.point
    assert counted.stderr == repeated.stderr
    if isinstance(metric, prb.LogLikelihood):
        assert counted.stderr["mu"] == pytest.approx(SAMPLE.std() / 20, rel=0.1)


@pytest.mark.long
def test_the_likelihood_of_bins_is_exact() -> None:
    """Rounding has the width of each bin: the likelihood is that of the bins' probabilities."""
    counts, edges = np.histogram(SAMPLE, bins=[3.0, 7.0, 8.0, 9.0, 10.0, 12.0, 17.0])
    metric = prb.LogLikelihood(rounded=np.diff(edges))
    optimum = prb.minimize(model(metric, (edges[1:] + edges[:-1]) / 2, weights=counts), starts=0)
    assert optimum.converged

    def minus_log_likelihood(theta: Any) -> float:
        shares = np.diff(norm.cdf(edges, theta[0], np.exp(theta[1])))
        return -float(counts @ np.log(shares))

    exact = minimize(minus_log_likelihood, [10.0, 0.7], method="BFGS")
    se = np.sqrt(np.diag(exact.hess_inv))
    assert optimum.point["mu"] == pytest.approx(exact.x[0], abs=0.15 * se[0])
    assert np.log(optimum.point["sigma"]) == pytest.approx(exact.x[1], abs=0.15 * se[1])


def test_a_table_of_counts_of_groups() -> None:
    data = xr.DataArray(
        [1.0, 2.0, 3.0], coords={"maker": ("specimen", ["a", "b", "a"])}, dims="specimen"
    )
    with pm.Model(coords={"maker": ["a", "b"]}) as built:
        mu = pm.Normal("mu", 0, 2, dims="maker")[prb.response.group("maker")]
        settings = {"metric": prb.AreaMetric(), "observed": data, "weights": [3, 4, 2]}
        prb.Simulator("y", lambda x: 1.0 * x, pm.Normal.dist(mu, 1.0), **settings)
    first, second = (item.target.observed for item in simulators(built).values())
    np.testing.assert_array_equal(first, [1, 1, 1, 3, 3])
    np.testing.assert_array_equal(second, [2, 2, 2, 2])


def test_relative_weights_are_floats() -> None:
    relative = COUNTS / COUNTS.sum()
    optimum = prb.minimize(model(prb.KullbackLeibler(), weights=relative), starts=0)
    kish = COUNTS.sum() ** 2 / (COUNTS**2).sum()
    assert optimum.stderr["mu"] == pytest.approx(SAMPLE.std() / np.sqrt(kish), rel=0.1)


def test_whole_numbers_of_type_float_are_reported(caplog: pytest.LogCaptureFixture) -> None:
    model(prb.KullbackLeibler(), weights=COUNTS / COUNTS.sum())
    model(prb.KullbackLeibler(), weights=(COUNTS > 1).astype(float))
    assert not caplog.records
    model(prb.KullbackLeibler(), weights=COUNTS.astype(float))
    assert "pass integers if they are frequencies" in caplog.text


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        ({"weights": COUNTS[1:]}, ValueError, "expected \\(20,\\) frequencies"),
        ({"weights": -COUNTS}, ValueError, "whole numbers from 0"),
        ({"weights": 0 * COUNTS}, ValueError, "whose sum is at least 2"),
        ({"weights": COUNTS, "specimens": MIDDLES}, TypeError, "beside specimens="),
    ],
)
def test_wrong_frequencies(given: Any, error: Any, words: str) -> None:
    with pytest.raises(error, match=f"y: weights: got .*{words}"):
        model(METRICS[0], **given)


@pytest.mark.parametrize("n_outputs", [1, 2])
def test_equal_specimens_of_a_frequency_are_neither_censored_nor_copies(n_outputs: int) -> None:
    values = np.random.default_rng(1).exponential(1.0, (12, n_outputs))
    counts = np.sort(np.random.default_rng(2).integers(2, 30, 12))[
        np.argsort(-values[:, 0]).argsort()
    ]
    rows = np.repeat(np.arange(12), counts)
    codes = {finding.code for finding in data_findings(values[rows])}
    assert "identical-specimens" in codes
    assert data_findings(values[rows], rows=rows) == ()
    # Copies among the observed rows remain.
    copied = np.concatenate([values, values[:4]])
    rows = np.repeat(np.arange(16), 3)
    copies = data_findings(copied[rows], rows=rows)
    assert [finding.code for finding in copies] == ["identical-specimens"]


def test_a_histogram_of_a_skewed_population_has_no_findings() -> None:
    middles, counts = np.array([0.3, 0.9, 1.7, 2.9, 5.0]), np.array([30, 12, 8, 5, 5])
    optimum = prb.minimize(model(prb.LogLikelihood(), middles, weights=counts), starts=0)
    codes = {finding.code for finding in optimum.findings}
    assert not codes & {"censored-data", "identical-specimens"}
