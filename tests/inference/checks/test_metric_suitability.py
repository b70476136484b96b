"""Populations without a mean, and data between runs."""

from typing import Any

import numpy as np
import pymc as pm
import pytest
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
