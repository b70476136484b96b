"""The node under samplers that compile it with other backends: nutpie, and NumPyro through PyMC's JAX backend."""

from __future__ import annotations

import numpy as np
import pymc as pm
import pytest

import prbayes as prb

METRICS = [prb.AreaMetric(), prb.ProbabilityResidual(), prb.KullbackLeibler(), prb.LogLikelihood()]


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning")
@pytest.mark.parametrize("metric", METRICS, ids=lambda m: type(m).__name__)
@pytest.mark.parametrize("sampler", ["nutpie", "numpyro"])
def test_the_posterior_is_that_of_sample_smc(sampler: str, metric: prb.Metric) -> None:
    pytest.importorskip(sampler)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        observed = np.random.default_rng(0).normal(2, 1, 50)
        prb.Simulator(
            "y", lambda x: 2 * x, x, metric=metric, observed=observed, epsilon=0.05, propagation=prb.Reweighted(256)
        )
        nuts = pm.sample(700, tune=500, chains=2, nuts_sampler=sampler, random_seed=1, progressbar=False)
    smc = prb.sample_smc(1000, chains=2, model=model, random_seed=1, progressbar=False)
    for name in ("mu", "sigma"):
        sd = float(smc.posterior[name].std())
        # Means of several hundred effective draws each: a standard error of .05 sd; sds to 4%.
        assert abs(float(nuts.posterior[name].mean() - smc.posterior[name].mean())) < 0.25 * sd
        np.testing.assert_allclose(nuts.posterior[name].std(), sd, rtol=0.2)
