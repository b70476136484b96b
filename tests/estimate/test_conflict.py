"""Conflicts of prior and data: how often they are seen, and how often where there is none."""

from functools import cache

import numpy as np
import pymc as pm
import pytest
from scipy.stats import binom, norm

import prbayes as prb
from prbayes._checks import Floats
from prbayes.estimate.conflict import least_probability, of_conflict, prior_probabilities
from prbayes.estimate.goodness import UNLIKELY
from prbayes.estimate.refit import SamplingDistribution
from prbayes.model.evaluator import Evaluator

PRIOR_SD = 0.5


@cache
def sampling(metric: prb.Metric) -> SamplingDistribution:
    """Return a sampling distribution of a mean and a spread."""
    observed = 1 + 0.5 * norm.ppf((np.arange(20) + 0.5) / 20)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, PRIOR_SD), pm.LogNormal("sigma", -1, PRIOR_SD))
        prb.Simulator(
            "y", np.positive, x, metric=metric, observed=observed, propagation=prb.Reweighted(256)
        )
    return SamplingDistribution.of(Evaluator(model), np.array([1.0, np.log(0.5)]), np.ones(1))


def standard(n: int, seed: int) -> Floats:
    return np.random.default_rng(seed).standard_normal((n, 2))


@pytest.mark.parametrize("metric", [prb.KullbackLeibler(), prb.AreaMetric()])
@pytest.mark.parametrize("away", [-6.0, 0.3, 4.0])
def test_of_normals_they_are_those_of_normals(metric: prb.Metric, away: float) -> None:
    at = sampling(metric)
    theta = np.array([1.0 + away * PRIOR_SD, -1.0])
    center, _ = at.coordinates(theta)
    found = prior_probabilities(at, center, standard(2000, 1), 0)
    assert list(found) == ["mu", "sigma", ""]
    error = at.stderr @ np.abs(at.axes[0]) ** 2 * at.local.prior_sd[0]
    expected = 2 * norm.sf(abs(away) * PRIOR_SD / np.hypot(PRIOR_SD, error))
    # 4096 draws, and the bias of 2000 shifts.
    assert found["mu"] == pytest.approx(expected, abs=0.05)
    assert found["sigma"] > 0.85
    conflict = expected < UNLIKELY / 3
    assert (least_probability(found) < UNLIKELY) == conflict
    said = of_conflict(found)
    assert bool(said) == conflict
    assert all("contradict each other (mu)" in line for line in said)


def test_truths_from_the_prior_are_called_a_conflict_as_rarely_as_said() -> None:
    at = sampling(prb.KullbackLeibler())
    truths = at.evaluator.prior_thetas(600, 9)
    estimates, _ = at.coordinates(truths)
    estimates = estimates + standard(600, 2)
    shifts = standard(400, 3)
    found = [prior_probabilities(at, center, shifts, 0) for center in estimates]
    for name in ("mu", "sigma", ""):
        p = np.array([each[name] for each in found])
        # Uniform, with four standard errors of a mean and of a number of 600.
        assert abs(p.mean() - 0.5) < 4 * np.sqrt(1 / 12 / 600)
        assert (p < 0.05).sum() < binom.ppf(0.9999, 600, 0.05)
    alarms = sum(least_probability(each) < UNLIKELY for each in found)
    assert alarms < binom.ppf(0.9999, 600, UNLIKELY)


def test_what_is_unlikely_together_alone_is_seen() -> None:
    found = {"a": 0.2, "b": 0.3, "": 0.001}
    assert least_probability(found) == pytest.approx(0.003)
    assert "(the hyperparameters together)" in of_conflict(found)[0]


def test_where_nothing_is_known_nothing_is_said() -> None:
    assert np.isnan(least_probability({}))
    assert of_conflict({}) == []
