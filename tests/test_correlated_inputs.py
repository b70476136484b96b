"""Correlated inputs: standard deviations and correlation, with standard errors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from first_use import first_use
from scipy import stats

import prbayes as prb
from prbayes._validate import Floats
from prbayes.inference.asymptotics import Local, local_sampling
from prbayes.inference.refits import SamplingDistribution, sampling_of_functions
from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import unconstrained
from prbayes.optimize.optimum import point_and_stderr

MEAN = np.array([1.0, 2.0])
SDS = np.array([1.0, 0.7])
RHO = 0.6
COVARIANCE = np.outer(SDS, SDS) * np.array([[1.0, RHO], [RHO, 1.0]])
N = 50
# Responses y = a @ x, each measured on different specimens.
MIXED = {"sum": (1.0, 1.0), "difference": (1.0, -1.0), "first": (1.0, 0.0), "second": (0.0, 1.0)}

# Three of them are enough.
ENOUGH = {name: MIXED[name] for name in ("sum", "first", "second")}


def response(a: tuple[float, float]) -> Callable[[Any], Any]:
    return lambda x: x[..., 0] * a[0] + x[..., 1] * a[1]


def population(a: tuple[float, float]) -> Any:
    """Return the exact distribution of a response."""
    return stats.norm(MEAN @ a, np.sqrt(np.array(a) @ COVARIANCE @ a))


def model_of(
    measured: dict[str, tuple[float, float]],
    metric: prb.Metric,
    *,
    width: float = 1.0,
    **keywords: Any,
) -> pm.Model:
    """Return a model of data at the quantiles of the truth, which it fits best."""
    levels = (np.arange(N) + 0.5) / N
    with pm.Model() as model:
        mean = pm.Normal("mean", MEAN, width, shape=2)
        deviations = pm.HalfNormal.dist(width, shape=2)
        chol, _, _ = pm.LKJCholeskyCov("chol", n=2, eta=2, sd_dist=deviations)
        x = pm.MvNormal.dist(mean, chol=chol)
        for name, a in measured.items():
            given = {"observed": population(a).ppf(levels), "metric": metric}
            prb.Simulator(name, response(a), x, propagation=prb.Reweighted(**keywords), **given)
    return model


def exact_errors() -> tuple[Floats, float]:
    """Return the standard errors of sds and correlation by maximum likelihood, from Fisher's."""
    information = np.zeros((3, 3))
    first, second = SDS
    for a, b in ENOUGH.values():
        variance = population((a, b)).var()
        # Of a^2 s1^2 + 2 a b r s1 s2 + b^2 s2^2.
        slope = [
            2 * a**2 * first + 2 * a * b * RHO * second,
            2 * b**2 * second + 2 * a * b * RHO * first,
            2 * a * b * first * second,
        ]
        information += N * np.outer(slope, slope) / (2 * variance**2)
    *sds, correlation = np.sqrt(np.diag(np.linalg.inv(information)))
    return np.array(sds), float(correlation)


def sampling_at_truth(measured: dict[str, tuple[float, float]]) -> SamplingDistribution:
    """Return the sampling distribution of the minimiser at the truth."""
    evaluator = Evaluator.of(model_of(measured, prb.KullbackLeibler(), n=2048, emulator=None))
    factor = np.linalg.cholesky(COVARIANCE)[np.tril_indices(2)]
    theta = unconstrained(evaluator.hyperparameters, {"mean": MEAN, "chol": factor})
    return SamplingDistribution.of(evaluator, theta, np.ones(len(measured)))


def standard_errors(sampling: SamplingDistribution, functions: Local) -> dict[str, Any]:
    covariance = sampling.local.in_theta
    return point_and_stderr(sampling.evaluator, sampling.theta, covariance, functions)[1]


@pytest.mark.long
def test_standard_errors_are_those_of_fisher() -> None:
    sds, correlation = exact_errors()
    sampling = sampling_at_truth(ENOUGH)
    stderr = standard_errors(sampling, sampling_of_functions(sampling))
    # Functions of the factor are identified, unlike some of its elements.
    assert np.isinf(stderr["chol"][2])
    np.testing.assert_allclose(stderr["chol_stds"], sds, rtol=0.25)
    expected = [[0.0, correlation], [correlation, 0.0]]
    np.testing.assert_allclose(stderr["chol_corr"], expected, rtol=0.25)
    # The threshold of weakly identified directions does not matter.
    for faint in (3.0, 30.0):
        local = local_sampling(sampling.information, sampling.scales, faint)
        other = standard_errors(sampling, local)
        for name in ("chol_stds", "chol_corr"):
            np.testing.assert_allclose(other[name], stderr[name], rtol=1e-6)


def test_marginal_responses_do_not_identify_the_correlation() -> None:
    sampling = sampling_at_truth({name: MIXED[name] for name in ("first", "second")})
    stderr = standard_errors(sampling, sampling_of_functions(sampling))
    np.testing.assert_allclose(stderr["chol_stds"], SDS / np.sqrt(2 * N), rtol=0.25)
    np.testing.assert_array_equal(stderr["chol_corr"], [[0.0, np.inf], [np.inf, 0.0]])


@pytest.mark.parametrize("propagation", [prb.Reweighted(64), prb.Resimulated(64), prb.Fresh(64)])
def test_a_factor_in_place_of_a_covariance_is_refused_before_any_response(propagation: Any) -> None:
    with pm.Model() as model:
        factor = pm.LKJCorr("factor", n=2, eta=2) * pm.HalfNormal("sds", 2.0, shape=2)
        x = pm.MvNormal.dist(np.zeros(2), factor)
        given = {"metric": prb.AreaMetric(), "observed": [0.0, 1.0]}
        prb.Simulator("y", lambda x: 1 / 0, x, propagation=propagation, **given)
    with pytest.raises(ValueError, match=r"y: got an input whose covariance is not symm"):
        first_use(model)


def by_correlations() -> Any:
    factor = pm.LKJCorr("factor", n=2, eta=1)
    deviations = pm.HalfNormal("sd", 2.0, shape=2)
    pm.Deterministic("rho", factor[1, 0])
    return pm.MvNormal.dist(pm.Normal("mu", 0, 3, shape=2), chol=deviations[:, None] * factor)


def by_hand() -> Any:
    deviations = pm.HalfNormal("sd", 2.0, shape=2)
    rho = pm.Uniform("rho", -1, 1)
    correlation = pt.stacklists([[1.0, rho], [rho, 1.0]])
    covariance = pt.outer(deviations, deviations) * correlation
    return pm.MvNormal.dist(pm.Normal("mu", 0, 3, shape=2), cov=covariance)


@pytest.mark.parametrize(
    ("inputs", "rho", "size"),
    [
        pytest.param(by_hand, 0.6, 50, marks=pytest.mark.long),
        pytest.param(by_correlations, 0.95, 20, marks=pytest.mark.slow),
    ],
)
def test_two_outputs_identify_the_correlation(
    inputs: Callable[[], Any], rho: float, size: int
) -> None:
    covariance = np.outer(SDS, SDS) * np.array([[1.0, rho], [rho, 1.0]])
    observed = np.random.default_rng(1).multivariate_normal(MEAN, covariance, size)
    with pm.Model() as model:
        metric = prb.Joint(prb.ProbabilityResidual())
        prb.Simulator("y", np.positive, inputs(), metric=metric, observed=observed)
    optimum = prb.minimize(model, starts=0, progressbar=False)
    assert optimum.converged
    assert "not-identified" not in {finding.code for finding in optimum.findings}
    found = optimum.point["rho"]
    exact = (1 - found**2) / np.sqrt(size)
    # A twentieth to a tenth more than maximum likelihood, and the error of 200 data sets.
    assert 0.85 < optimum.stderr["rho"] / exact < 1.35
    of_sample, _ = stats.pearsonr(*observed.T)
    assert abs(found - of_sample) < 2 * exact


@pytest.mark.long
def test_a_sum_does_not_identify_the_correlation() -> None:
    rng = np.random.default_rng(1)
    observed = rng.multivariate_normal(MEAN, COVARIANCE, N).sum(axis=1)
    with pm.Model() as model:
        metric = prb.KullbackLeibler()
        prb.Simulator("y", response((1.0, 1.0)), by_hand(), metric=metric, observed=observed)
        pm.Deterministic("mean of sums", model["mu"].sum())
    optimum = prb.minimize(model, starts=0, progressbar=False)
    assert optimum.converged
    assert np.isinf(optimum.stderr["rho"])
    assert "not-identified" in {finding.code for finding in optimum.findings}
    error = observed.std() / np.sqrt(N)
    assert optimum.stderr["mean of sums"] == pytest.approx(error, rel=0.25)
    assert abs(optimum.point["mean of sums"] - observed.mean()) < 0.5 * error
