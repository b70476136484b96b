"""Stock `pymc.Simulator` with our metrics as its distance."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from scipy import stats

import prbayes as prb
from prbayes.response.compile import PLAIN

N, MU, SIGMA, EPSILON, POINTS = 30, 2.0, 0.8, 0.02, 128
OBSERVED = np.random.default_rng(3).permutation(
    0.75 * stats.norm(MU, SIGMA).ppf((np.arange(N) + 0.5) / N)
)
QUIET = {"progressbar": False}


def simulate(rng: np.random.Generator, mu: Any, sigma: Any, size: Any = None) -> Any:
    return 0.75 * rng.normal(mu, sigma, size=200)


STOCK = {
    "PR": (prb.ProbabilityResidual(), 0.01),
    "KLD": (prb.KullbackLeibler(), 1 / N),
    "LL": (prb.LogLikelihood(density=prb.GaussianKDE()), 1 / N),
    "area": (prb.AreaMetric(), 0.02),
}


@pytest.mark.long
@pytest.mark.parametrize("name", STOCK)
def test_stock_simulator_with_our_metrics(name: str) -> None:
    metric, epsilon = STOCK[name]
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 2, 1), pm.HalfNormal("sigma", 1)
        distance = prb.abc_distance(metric)
        pm.Simulator(
            "y", simulate, mu, sigma, distance=distance, epsilon=epsilon, observed=OBSERVED
        )
    cores = 2 if name == "area" else 1
    idata = pm.sample_smc(
        200,
        chains=cores,
        cores=cores,
        model=model,
        random_seed=4,
        compute_convergence_checks=False,
        **QUIET,
    )
    np.testing.assert_allclose(idata.posterior["mu"].mean(), MU, atol=0.1)
    np.testing.assert_allclose(idata.posterior["sigma"].mean(), SIGMA, atol=0.15)


@pytest.mark.parametrize("bad", [np.nan, -np.inf])
def test_stock_distance_of_invalid_samples(bad: float) -> None:
    observed, simulated = pt.dvector(), pt.dvector()
    epsilon = pt.dscalar()
    logp = prb.abc_distance(prb.AreaMetric())(epsilon, observed, simulated)
    sample = np.linspace(0, 3, 50)
    given = {epsilon: 0.1, observed: OBSERVED}
    for data in (OBSERVED, 2 * OBSERVED):  # the observed side is prepared once, for each data set
        expected = -prb.AreaMetric()(sample, data) / 0.1
        value = logp.eval(given | {simulated: sample, observed: data}, mode=PLAIN)
        np.testing.assert_allclose(value, expected, rtol=1e-12)
    assert logp.eval(given | {simulated: np.r_[sample, bad]}, mode=PLAIN) == -np.inf
    failed = logp.eval(given | {simulated: np.r_[sample, np.inf]}, mode=PLAIN)
    np.testing.assert_allclose(
        failed, -prb.AreaMetric()(np.r_[sample, np.inf], OBSERVED) / 0.1, rtol=1e-12
    )
