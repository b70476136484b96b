"""Populations without a mean, data between runs, and kernels that are too wide."""

from typing import Any

import numpy as np
import pymc as pm
import pytest
from four_metrics import same
from scipy.stats import norm

import prbayes as prb
from prbayes.inference.checks.metric_suitability import data_between_runs
from prbayes.model.evaluator import Evaluator


@pytest.mark.long
def test_an_area_of_a_population_without_a_mean_is_warned_of() -> None:
    def minimum(metric: prb.Metric, make: Any, observed: Any) -> prb.Optimum:
        with pm.Model() as model:
            x = make(pm.HalfNormal("scale", 2))
            prb.Simulator(
                "y", lambda x: x, x, metric=metric, observed=observed,
                propagation=prb.Reweighted(256),
            )  # fmt: skip
        return prb.minimize(model)

    observed = np.abs(np.random.default_rng(1).standard_cauchy(30))
    said = "one or less has no mean"
    area = minimum(prb.AreaMetric(), pm.HalfCauchy.dist, observed)
    assert said in "".join(map(str, area.findings))
    assert said in str(prb.diagnose(area))
    other = minimum(prb.KullbackLeibler(), pm.HalfCauchy.dist, observed)
    assert said not in "".join(map(str, other.findings))
    observed = np.random.default_rng(1).exponential(1.0, 30)
    short = minimum(prb.AreaMetric(), lambda s: pm.Exponential.dist(scale=s), observed)
    assert said not in "".join(map(str, short.findings))


@pytest.mark.parametrize(("largest", "said"), [(2.2, False), (9.0, True)])
def test_a_value_between_responses_far_apart_is_told_of(largest: float, said: bool) -> None:
    """A kernel as narrow as the data want sees none of the few responses in a long tail."""
    observed = np.append(np.exp(norm.ppf((np.arange(59) + 0.5) / 59, 0, 0.2)), largest)
    with pm.Model() as model:
        x = pm.LogNormal.dist(pm.Normal("mu", 0, 0.5), pm.HalfNormal("sigma", 0.5))
        prb.Simulator(
            "y",
            np.positive,
            x,
            metric=prb.LogLikelihood(density=prb.GaussianKDE()),
            observed=observed,
        )
    evaluator = Evaluator.of(model)
    found = data_between_runs(evaluator, np.array([0.0, np.log(0.3)]))
    assert len(found) == said
    if said:
        assert "1 of 60 observed values (9) lie between responses" in found[0].text
    # A metric that smooths both sides takes no value by itself.
    with pm.Model() as model:
        x = pm.LogNormal.dist(pm.Normal("mu", 0, 0.5), pm.HalfNormal("sigma", 0.5))
        prb.Simulator("y", np.positive, x, metric=prb.KullbackLeibler(), observed=observed)
    assert data_between_runs(Evaluator.of(model), np.array([0.0, np.log(0.3)])) == []


N = 40
INPUTS = 0.3 + norm.ppf((np.arange(N) + 0.5) / N)


def branches(x: Any) -> Any:
    """Return a response with two branches, far apart."""
    return np.where(x > 0, 10 + x, x)


def optimum(response: Any, metric: prb.Metric) -> prb.Optimum:
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 2))
        propagation = prb.Reweighted(512)
        observed = response(INPUTS)
        prb.Simulator("y", response, x, metric=metric, observed=observed, propagation=propagation)
        return prb.minimize(progressbar=False)


def told(result: prb.Optimum) -> list[str]:
    return [finding.text for finding in result.findings if finding.code == "smoothing-bias"]


def test_a_kernel_that_is_wide_beside_a_branch_is_told_of() -> None:
    found = optimum(branches, prb.LogLikelihood(density=prb.GaussianKDE()))
    assert found.point["sigma"] < INPUTS.std() - found.stderr["sigma"]
    (line,) = told(found)
    assert "y: the kernel of the log-likelihood is wide" in line
    assert "sigma is off by more than a standard error" in line
    # What is proposed mends it.
    width = float(line.split("GaussianKDE(")[1].split(")")[0])
    mended = optimum(branches, prb.LogLikelihood(density=prb.GaussianKDE(width)))
    assert not told(mended)
    assert mended.point["sigma"] == pytest.approx(INPUTS.std(), rel=0.02)


@pytest.mark.parametrize("width", [0.2, 0.4])
def test_the_bias_is_that_of_the_kernel_s_variance(width: float) -> None:
    found = optimum(same, prb.LogLikelihood(density=prb.GaussianKDE(width)))
    # The smoothed population has the data's variance.
    sigma = np.sqrt(INPUTS.var() - width**2)
    assert found.point["sigma"] == pytest.approx(sigma, rel=2e-3)
    bias = (INPUTS.std() - sigma) / found.stderr["sigma"]
    lines = told(found)
    assert bool(lines) == (bias > 0.5)
    if lines:
        number = float(lines[0].split("off by about ")[1].split()[0])
        assert number == pytest.approx(bias, abs=0.1)


@pytest.mark.parametrize(
    "metric",
    [
        prb.LogLikelihood(density=prb.Histogram(9)),
        prb.KullbackLeibler(prb.GaussianKDE(0.9)),
        prb.LogLikelihood(density=prb.GaussianKDE()),
    ],
)
def test_others_are_not(metric: prb.Metric) -> None:
    assert not told(optimum(same, metric))
