"""Populations without a mean, data between runs, and kernels that are too wide."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest
from four_metrics import same
from scipy.stats import norm

import prbayes as prb
from prbayes.inference.checks.metric_suitability import (
    data_between_runs,
    few_for_whitening,
    heavy_tails,
    refit_bias,
    small_simulators,
    smoothing_bias,
)
from prbayes.inference.refits import SamplingDistribution
from prbayes.model.evaluator import Evaluator

LOG_LIKELIHOOD = prb.LogLikelihood(density=prb.GaussianKDE())
N = 40
INPUTS = 0.3 + norm.ppf((np.arange(N) + 0.5) / N)


def evaluator_of(x: Any, metric: prb.Metric, observed: Any, response: Any = same) -> Evaluator:
    """Return the evaluator of a model of one input, ``x()``."""
    with pm.Model() as model:
        data = {"observed": observed, "propagation": prb.Reweighted(512)}
        prb.Simulator("y", response, x(), metric=metric, **data)
    return Evaluator.of(model)


def half_cauchy() -> Any:
    return pm.HalfCauchy.dist(pm.HalfNormal("scale", 2))


def exponential() -> Any:
    return pm.Exponential.dist(scale=pm.HalfNormal("scale", 2))


@pytest.mark.parametrize(
    ("x", "metric", "is_reported"),
    [
        (half_cauchy, prb.AreaMetric(), True),
        (half_cauchy, prb.KullbackLeibler(), False),
        (exponential, prb.AreaMetric(), False),
    ],
)
def test_an_area_of_a_population_without_a_mean_is_reported(
    x: Any, metric: prb.Metric, is_reported: bool
) -> None:
    observed = np.abs(np.random.default_rng(1).standard_cauchy(30))
    findings = heavy_tails(evaluator_of(x, metric, observed), np.zeros(1))
    assert [finding.code for finding in findings] == ["heavy-tail"] * is_reported
    assert all("one or less has no mean" in finding.text for finding in findings)


def test_the_advice_for_several_outputs_is_accepted() -> None:
    observed = np.abs(np.random.default_rng(1).standard_cauchy((30, 2)))

    def response(x: Any) -> Any:
        return np.stack([x, 2 * x], -1)

    evaluator = evaluator_of(half_cauchy, prb.Joint(prb.AreaMetric()), observed, response)
    (finding,) = heavy_tails(evaluator, np.zeros(1))
    for advised in ("ProbabilityResidual", "KullbackLeibler"):
        assert f"prb.Joint(prb.{advised}())" in finding.text
        metric = prb.Joint(getattr(prb, advised)())
        assert heavy_tails(evaluator_of(half_cauchy, metric, observed, response), np.zeros(1)) == []


def lognormal() -> Any:
    return pm.LogNormal.dist(pm.Normal("mu", 0, 0.5), pm.HalfNormal("sigma", 0.5))


@pytest.mark.parametrize(
    ("largest", "metric", "is_reported"),
    [
        (2.2, LOG_LIKELIHOOD, False),
        (9.0, LOG_LIKELIHOOD, True),
        # A metric that smooths both sides takes no value by itself.
        (9.0, prb.KullbackLeibler(), False),
    ],
)
def test_a_value_between_responses_far_apart_is_reported(
    largest: float, metric: prb.Metric, is_reported: bool
) -> None:
    """A kernel as narrow as the data want sees none of the few responses in a long tail."""
    observed = np.append(np.exp(norm.ppf((np.arange(59) + 0.5) / 59, 0, 0.2)), largest)
    evaluator = evaluator_of(lognormal, metric, observed)
    findings = data_between_runs(evaluator, np.array([0.0, np.log(0.3)]))
    assert len(findings) == is_reported
    for finding in findings:
        assert "1 of 60 observed values (9) lie between responses" in finding.text


def test_a_value_beside_a_response_on_either_side_is_not_reported() -> None:
    bulk, theta = np.exp(norm.ppf((np.arange(59) + 0.5) / 59, 0, 0.2)), np.array([0.0, -1.2])
    evaluator = evaluator_of(lognormal, LOG_LIKELIHOOD, bulk)
    low, high = np.sort(evaluator.populations(theta[None], 0)[0][0])[-2:]  # far apart
    for value, count in ((low + 0.01, 0), ((low + high) / 2, 1), (high - 0.01, 0)):
        evaluator = evaluator_of(lognormal, LOG_LIKELIHOOD, np.append(bulk, value))
        assert len(data_between_runs(evaluator, theta)) == count


@pytest.mark.parametrize(
    ("metric", "shared", "n", "is_reported"),
    [
        (prb.KullbackLeibler(), True, 12, True),
        (prb.AreaMetric(), True, 12, False),
        (prb.KullbackLeibler(), False, 12, False),
        (prb.KullbackLeibler(), True, 30, False),
    ],
)
def test_few_specimens_underestimate_a_spread_in_common(
    metric: prb.Metric, shared: bool, n: int, is_reported: bool
) -> None:
    with pm.Model() as model:
        spread = pm.HalfNormal("s", 1)
        for k, response in enumerate((same, np.negative)):
            x = pm.Normal.dist(0, spread if shared else pm.HalfNormal(f"s{k}", 1))
            prb.Simulator(f"y{k}", response, x, metric=metric, observed=INPUTS[k : k + n])
    findings = small_simulators(Evaluator.of(model))
    assert len(findings) == is_reported
    for finding in findings:
        assert f"the smallest with {n} specimens, expected at least 30" in finding.text


@pytest.mark.parametrize(
    ("metric", "response"),
    [(prb.KullbackLeibler(), same), (prb.KullbackLeibler(), np.negative), (LOG_LIKELIHOOD, same)],
)
def test_a_bandwidth_of_each_response_underestimates_a_spread_in_common(
    metric: prb.Metric, response: Any
) -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(0, pm.HalfNormal("s", 1))
        prb.Simulator("y0", same, x, metric=metric, observed=INPUTS[:12])
        prb.Simulator("y1", response, x, metric=metric, observed=INPUTS[:20])
    is_reported = response is not same
    assert len(small_simulators(Evaluator.of(model))) == is_reported


@pytest.mark.parametrize(
    ("n", "m", "enough"), [(6, 3, 18), (17, 3, 18), (18, 3, None), (9, 2, 10), (30, 5, 45)]
)
def test_few_specimens_for_the_outputs_are_reported(n: int, m: int, enough: int | None) -> None:
    outputs = np.random.default_rng(1).normal(size=(n, m)) * 10.0 ** np.arange(m)
    for metric in (prb.KullbackLeibler(), prb.AreaMetric()):
        texts = [f.text for f in few_for_whitening("y", prb.Joint(metric).against(outputs))]
        assert len(texts) == (enough is not None)
        for text in texts:
            assert f"y: got {n} specimens" in text
            assert f"at least {enough} for {m} white" in text
    assert not few_for_whitening("y", prb.AreaMetric().against(outputs[:, 0]))


@pytest.mark.parametrize("shift", [0.0, 0.3, -0.8])
def test_refits_that_are_off_on_average_are_reported(shift: float) -> None:
    x = np.array([[0.0, 1.0], [0.0, -1.0], [9.0, 9.0]]) + np.array([0, shift])
    fitted: Any = SimpleNamespace(
        x=x,
        center=np.zeros(2),
        converged=np.array([True, True, False]),
        sampling=SimpleNamespace(
            thetas=lambda x: 3 + 2 * x,
            evaluator=SimpleNamespace(
                hyperparameters=SimpleNamespace(readable_names=["mu", "sigma"])
            ),
        ),
    )
    texts = [finding.text for finding in refit_bias(fitted)]
    assert len(texts) == (abs(shift) > 0.5)
    assert all("a lower sigma, on average by 0.8 of their standard dev" in text for text in texts)


def branches(x: Any) -> Any:
    """Return a response with two branches, far apart."""
    return np.where(x > 0, 10 + x, x)


def normal() -> Any:
    return pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 2))


def biases(response: Any, metric: prb.Metric, sigma: float) -> tuple[list[str], float]:
    """Return the findings at the mean of the inputs, and the standard error of sigma."""
    evaluator = evaluator_of(normal, metric, response(INPUTS), response)
    theta, scales = np.array([0.3, np.log(sigma)]), np.ones(1)
    local = SamplingDistribution.of(evaluator, theta, scales).local
    findings = smoothing_bias(evaluator, theta, scales, local)
    assert smoothing_bias(evaluator, theta, scales, None) == []
    stderr = sigma * float(np.sqrt(local.in_theta[1, 1]))
    return [finding.text for finding in findings], stderr


@pytest.mark.long
def test_a_kernel_that_is_wide_beside_a_branch_is_reported() -> None:
    def optimum(metric: prb.Metric) -> prb.Optimum:
        observed = branches(INPUTS)
        evaluator = evaluator_of(normal, metric, observed, branches)
        return prb.minimize(evaluator.model, starts=0, progressbar=False)

    biased = optimum(LOG_LIKELIHOOD)
    assert biased.point["sigma"] < INPUTS.std() - biased.stderr["sigma"]
    (line,) = [f.text for f in biased.findings if f.code == "smoothing-bias"]
    assert "y: the kernel of the log-likelihood is wide" in line
    assert "shifts sigma by more than a standard error" in line
    # The proposed kernel has no bias.
    width = float(line.split("GaussianKDE(")[1].split(")")[0])
    mended = optimum(prb.LogLikelihood(density=prb.GaussianKDE(width)))
    assert "smoothing-bias" not in {finding.code for finding in mended.findings}
    assert mended.point["sigma"] == pytest.approx(INPUTS.std(), rel=0.02)


@pytest.mark.parametrize("width", [0.2, 0.4])
def test_the_bias_is_that_of_the_kernel_s_variance(width: float) -> None:
    # The smoothed population has the data's variance.
    sigma = float(np.sqrt(INPUTS.var() - width**2))
    metric = prb.LogLikelihood(density=prb.GaussianKDE(width))
    lines, stderr = biases(same, metric, sigma)
    bias = (INPUTS.std() - sigma) / stderr
    assert bool(lines) == (bias > 0.5)
    for line in lines:
        number = float(line.split("by about ")[1].split()[0])
        assert number == pytest.approx(bias, abs=0.1)
        proposed = float(line.split("GaussianKDE(")[1].split(")")[0])
        assert proposed == pytest.approx(width * np.sqrt(0.1 / number), rel=0.03)


@pytest.mark.parametrize(
    "metric",
    [
        prb.LogLikelihood(density=prb.Histogram(9)),
        prb.KullbackLeibler(prb.GaussianKDE(0.9)),
        LOG_LIKELIHOOD,
    ],
)
def test_other_metrics_have_no_bias(metric: prb.Metric) -> None:
    assert biases(same, metric, float(INPUTS.std()))[0] == []
