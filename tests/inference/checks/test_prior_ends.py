"""Hyperparameters that the data push to an end of their prior."""

from typing import Any

import numpy as np
import pymc as pm
import pytest
from four_metrics import METRICS, R256, same
from scipy.stats import norm

import prbayes as prb
from prbayes.inference.checks.prior_ends import PriorEnd, prior_ends
from prbayes.inference.refits import SamplingDistribution
from prbayes.model.evaluator import Evaluator

LEVELS = norm.ppf((np.arange(30) + 0.5) / 30)


def added(x: Any, z: Any) -> Any:
    return x + z


def model(
    observed: Any,
    mu: Any,
    sd: Any,
    metric: prb.Metric = METRICS["kl"],
    propagation: prb.Reweighted = R256,
) -> pm.Model:
    with pm.Model() as found:
        x = pm.Normal.dist(mu("mu"), sd("sd"))
        prb.Simulator("y", same, x, metric=metric, observed=observed, propagation=propagation)
    return found


def unit(name: str) -> Any:
    return pm.Uniform(name, 0, 1)


def narrow(name: str) -> Any:
    return pm.HalfNormal(name, 0.3)


def ends(found: pm.Model, theta: Any) -> list[PriorEnd]:
    evaluator = Evaluator.of(found)
    sampling = SamplingDistribution.of(evaluator, np.array(theta), np.ones(1))
    return prior_ends(sampling)


@pytest.mark.parametrize("name", sorted(METRICS))
@pytest.mark.parametrize(("place", "bound"), [(2.85, 1.0), (-1.85, 0.0)])
def test_data_beyond_a_prior_are_said_to_push_and_draws_stay_there(
    name: str, place: float, bound: float
) -> None:
    propagation = prb.Reweighted(1024)
    found = model(place + 0.3 * LEVELS, unit, narrow, METRICS[name], propagation)
    with found:
        optimum = prb.minimize(progressbar=False)
        # Refits of the area metric are at an edge, where its estimate has no density.
        adjustment: Any = None if name == "area" else "estimate"
        tree = prb.sample_smc(
            draws=300, chains=2, adjustment=adjustment, random_seed=1, progressbar=False
        )
    (finding,) = optimum.findings
    assert finding.code == "prior-end"
    assert "The data push mu to" in finding.text
    assert f"next to the end of its prior at {bound:.4g}" in finding.text
    # They went back to the prior, whose mean is a half, where estimates have no density.
    mean = float(tree.posterior["mu"].mean())
    assert abs(mean - bound) < 0.15


def test_the_middle_of_a_prior_is_no_end_and_nor_is_a_population_without_scatter() -> None:
    assert not ends(model(0.5 + 0.3 * LEVELS, unit, narrow), [0.0, np.log(0.3)])
    # A standard deviation that is small beside the kernel, whose prior ends at zero.
    assert not ends(model(0.5 + 0.01 * LEVELS, unit, narrow), [0.0, np.log(1e-5)])
    # At the other end than the data's the middle is better, so that these do not push there.
    assert not ends(model(2.85 + 0.3 * LEVELS, unit, narrow), [-6.0, np.log(1.8)])


def test_two_that_only_stand_for_each_other_are_not_pushed() -> None:
    with pm.Model() as found:
        x = pm.Normal.dist(pm.Uniform("a", 0, 1), 0.3)
        z = pm.Normal.dist(pm.Uniform("b", 0, 1), 0.3)
        prb.Simulator(
            "y", added, x, z, metric=METRICS["kl"], observed=1.2 + 0.42 * LEVELS, propagation=R256
        )
    # One at its upper end, the other at its lower one, or elsewhere.
    assert not ends(found, [4.0, -4.0])
    assert not ends(found, [4.0, 0.0])
