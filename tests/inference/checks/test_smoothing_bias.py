"""Likelihoods whose kernel is wide beside what it smooths."""

from typing import Any

import numpy as np
import pymc as pm
import pytest
from four_metrics import same
from scipy.stats import norm

import prbayes as prb

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
