"""Few specimens: of all simulators together, and of each."""

import re
from typing import Any

import numpy as np
import pandas as pd
import pymc as pm
import pytest
from four_metrics import same
from one_input import one_input
from scipy.stats import norm

import prbayes as prb
from prbayes.inference.checks.sample_size import (
    few_for_bootstrap,
    few_specimens,
    interval_ratios,
    spread_in_common,
)
from prbayes.model.evaluator import Evaluator

N = 40
INPUTS = 0.3 + norm.ppf((np.arange(N) + 0.5) / N)


def test_intervals_of_two_specimens_are_those_of_a_cauchy_distribution() -> None:
    mean, spread = interval_ratios(2)
    z = norm.ppf(0.945)
    assert mean == pytest.approx(np.sqrt(2) * np.tan(np.pi * 0.445) / z)
    # The square of a standard normal number: sd / s is sqrt(2) over its size.
    ends = np.sqrt(2) / np.abs(norm.ppf([0.5 + 0.055 / 2, 0.5 + 0.945 / 2]))
    assert spread == pytest.approx((ends[0] - ends[1]) / z)


def warned(model: pm.Model) -> str:
    """Return the text of the finding, empty without one."""
    findings = few_specimens(Evaluator.of(model))
    assert {finding.code for finding in findings} <= {"few-specimens"}
    return findings[0].text if findings else ""


@pytest.mark.parametrize("metric", [prb.AreaMetric(), prb.LogLikelihood()])
def test_fewer_than_eight_specimens_are_reported_with_the_price(metric: prb.Metric) -> None:
    assert "are at least 2.1 times as wide as by standard errors" in warned(
        one_input([0, 1, 3], metric)
    )
    three = warned(one_input(INPUTS[:3], metric))
    assert "y: got 3 specimens" in three
    assert "its spread 3.4 times" in three
    assert "y: got 7 specimens" in warned(one_input(INPUTS[:7], metric))
    assert not warned(one_input(INPUTS[:8], metric))


def bootstrap_estimates(y: Any, parametric: bool, rng: np.random.Generator) -> tuple[Any, Any]:
    """Return means and standard deviations of bootstrap samples of normal specimens."""
    if parametric:
        sets = y.mean() + y.std() * rng.standard_normal((300, len(y)))
        return sets.mean(axis=1), sets.std(axis=1)
    weights = rng.dirichlet(np.ones(len(y)), 300)
    mean = weights @ y
    return mean, np.sqrt(weights @ y**2 - mean**2)


@pytest.mark.parametrize(("n", "parametric"), [(8, False), (20, True)])
def test_the_coverage_of_the_bootstrap_is_as_stated(n: int, parametric: bool) -> None:
    model = one_input(INPUTS[:n], prb.AreaMetric())
    (finding,) = few_for_bootstrap(Evaluator.of(model), parametric=parametric)
    match = re.search(r"in about (\d+)% of data sets, and the mean in (\d+)%", finding.text)
    assert match is not None
    rng = np.random.default_rng([n, parametric])
    within = []
    for _ in range(1000):
        estimates = bootstrap_estimates(rng.standard_normal(n), parametric, rng)
        for values, truth in zip(estimates, (0.0, 1.0), strict=True):
            low, high = np.quantile(values, [0.055, 0.945])
            within.append(low < truth < high)
    mean, spread = np.reshape(within, (-1, 2)).mean(axis=0)
    # Standard errors: .016 here, .009 of the study's 3000, and figures of two digits.
    np.testing.assert_allclose(np.array(match.groups(), float) / 100, [spread, mean], atol=0.07)


def test_fifty_specimens_are_enough_for_the_bootstrap() -> None:
    evaluator = Evaluator.of(one_input(np.arange(50.0), prb.AreaMetric()))
    assert few_for_bootstrap(evaluator, parametric=False) == []


def test_specimens_count_where_simulators_share_hyperparameters() -> None:
    def model(is_shared: bool, **keywords: Any) -> pm.Model:
        with pm.Model() as result:
            spread = pm.HalfNormal("sd", 1)
            for k in range(3):
                scale = spread if is_shared else pm.HalfNormal(f"sd{k}", 1)
                x = pm.Normal.dist(pm.Normal(f"mu{k}", 0, 2), scale)
                given = {"metric": prb.AreaMetric(), "observed": INPUTS[: 4 + 4 * (k > 0)]}
                prb.Simulator(f"y{k}", same, x, **given, **keywords)
        return result

    assert not warned(model(True))
    assert warned(model(False)).startswith("y0: got 4 specimens")


def test_groups_count_together_where_they_share_hyperparameters() -> None:
    def model(sizes: list[int], is_shared: bool) -> pm.Model:
        labels = np.repeat(["a", "b"], sizes)
        observed = pd.DataFrame({"y": INPUTS[-len(labels) :], "rig": labels})
        with pm.Model(coords={"rig": ["a", "b"]}) as result:
            rig = prb.response.group("rig")
            mu = pm.Normal("mu", pm.Normal("m", 0, 2), 1, dims="rig")
            spread = pm.HalfNormal("sd", 1, dims=None if is_shared else "rig")
            x = pm.Normal.dist(mu[rig], spread if is_shared else spread[rig])
            prb.Simulator("y", same, x, observed=observed)
        return result

    assert warned(model([20, 3], False)).startswith("y[b]: got 3 specimens")
    assert not warned(model([20, 3], True))
    # The sum of 1 / sum(w**2) is 8 but for rounding.
    assert "at least 8" not in warned(model([6, 2], True))


def test_a_spread_in_common_of_pairs_is_reported_with_its_bias() -> None:
    """The maximum of the likelihood is the root of half the variance (Neyman and Scott 1948)."""
    rigs = [f"rig {k}" for k in range(10)]

    def model(n: int) -> pm.Model:
        labels = np.repeat(rigs, n)
        values = np.random.default_rng(n).normal(0, 1, len(labels))
        observed = pd.DataFrame({"y": values, "rig": labels})
        with pm.Model(coords={"rig": rigs}) as result:
            mu = pm.Normal("mu", 0, 1, dims="rig")
            x = pm.Normal.dist(mu[prb.response.group("rig")], pm.HalfNormal("sd", 1))
            prb.Simulator("y", same, x, observed=observed)
        return result

    (finding,) = spread_in_common(Evaluator.of(model(2)))
    assert finding.code == "few-specimens"
    assert "20 specimens of 10 populations" in finding.text
    assert "by about 29%" in finding.text
    assert not spread_in_common(Evaluator.of(model(21)))
    assert not warned(model(2))


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"specimens": np.repeat(np.arange(4), 3)}, "got 4 specimens"),
        ({"weights": np.repeat([1.0, 0.0], [2, 10])}, "got 2 specimens"),
        ({"specimens": np.zeros(12, int)}, "got 1 specimen, expected at least 8: one"),
    ],
)
def test_readings_of_one_specimen_and_weights_do_not_count_as_specimens(
    given: Any, text: str
) -> None:
    assert text in warned(one_input(INPUTS[:12], prb.AreaMetric(), **given))


def test_draws_do_not_repeat_the_warning_of_their_optimum() -> None:
    model = one_input(INPUTS[::10], prb.KullbackLeibler(), prb.Reweighted(64), sd=1.0)
    optimum = prb.minimize(model, starts=0)
    assert [finding.code for finding in optimum.findings] == ["few-specimens"]
    assert not prb.diagnose(optimum).ok
    draws = prb.sample(50, chains=1, model=model, optimum=optimum)
    assert "few-specimens" not in {finding.code for finding in prb.diagnose(draws).findings}
