"""Calibration on counts, errors with two parts, a bias and limits, beside quadrature."""

from __future__ import annotations

import numpy as np
import pymc as pm
import pytest
from one_input import one_input
from scipy import optimize

import prbayes as prb
from benchmarks import kinds_of_readings as study
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator


def model_of(case: study.Case) -> pm.Model:
    with pm.Model() as model:
        variables = {p.name: p.variable() for p in case.priors}
        population = case.population(variables)
        metric = case.metric(variables)
        prb.Simulator("y", case.response, population, metric=metric, observed=case.observed)
    return model


def exact_log_likelihood(case: study.Case, natural: Floats) -> Floats:
    values = {p.name: natural[:, k, None, None] for k, p in enumerate(case.priors)}
    return case.log_likelihood(values).sum(axis=1)


@pytest.mark.long
@pytest.mark.parametrize(
    "cell", ["gaver", "poisson", "binomial", "negative binomial", "combined", "bias"]
)
def test_log_likelihoods_are_exact(cell: str) -> None:
    case = study.case_of(cell, 0)
    evaluator = Evaluator.of(model_of(case))
    middle, sd = study.exact(case, 2**8)
    u = np.random.default_rng(0).uniform(-1, 1, (40, len(middle)))
    natural = np.maximum(middle + sd * u, 0.3 * np.abs(middle))
    is_log = np.array([p.is_log for p in case.priors])
    theta = np.where(is_log, np.log(np.where(is_log, natural, 1.0)), natural)
    names = [p.name for p in case.priors]
    assert [name.removesuffix("_log__") for name in evaluator.hyperparameters.names] == names
    difference = evaluator(theta).log_other - exact_log_likelihood(case, natural)
    # A tilt of .1 nats over two posterior standard deviations moves a mean by .05 of them.
    assert difference.std() < 0.05


@pytest.mark.long
def test_failure_rates_of_pumps() -> None:
    case = study.case_of("gaver", 0)

    def loss(theta: Floats) -> float:
        return -float(exact_log_likelihood(case, np.exp(theta)[None])[0])

    exact = optimize.minimize(loss, [0.0, 0.0])
    np.testing.assert_allclose(np.exp(exact.x), [0.822, 1.259], atol=5e-4)
    found = prb.minimize(model_of(case), progressbar=False)
    stderr = np.sqrt(np.diag(exact.hess_inv))
    estimates = np.log([float(found.point[name]) for name in ("alpha", "beta")])
    assert (np.abs(estimates - exact.x) < 0.1 * stderr).all()
    posterior = prb.sample(2000, optimum=found, model=found.model, progressbar=False)
    mean, sd = study.exact(case)
    for k, name in enumerate(("alpha", "beta")):
        draws = posterior.posterior[name].values
        assert abs(draws.mean() - mean[k]) < 0.1 * sd[k]
        assert 0.9 < draws.std() / sd[k] < 1.1
    # Replicates of counts are counts, with the exposure of the same pump.
    pumps = prb.individuals(posterior, model=found.model)["posterior_predictive"]["y"].values
    assert (pumps == np.round(pumps)).all()
    ratio = pumps.mean(axis=(0, 1)) / study.HOURS
    assert ratio.max() < 2 * ratio.min()


@pytest.mark.parametrize(
    "cell",
    [
        *(pytest.param(cell, marks=pytest.mark.slow) for cell in ("binomial", "bias")),
        pytest.param("limit", marks=pytest.mark.long),
    ],
)
def test_posteriors_are_exact(cell: str) -> None:
    row = study.row(cell, 1)
    assert np.abs(row["offset"]).max() < 0.1
    assert 0.9 < min(row["width"]) <= max(row["width"]) < 1.1


def test_a_known_bias_is_a_shift_of_the_readings() -> None:
    y = np.random.default_rng(3).normal(2.0, 1.0, 12)

    def estimates(observed: Floats, bias: float | None) -> list[float]:
        metric = prb.LogLikelihood(error=0.2, bias=bias)
        model = one_input(observed, metric, mu=(0, 3), sigma=3)
        point = prb.minimize(model, starts=0, progressbar=False).point
        return [float(point[name]) for name in ("mu", "sigma")]

    assert estimates(y + 0.7, 0.7) == pytest.approx(estimates(y, None), rel=1e-6)
