"""Goodness of fit: how often right families are called wrong, and wrong ones are seen."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
import pytest
from four_metrics import METRICS, R256, same

import prbayes as prb
from prbayes._validate import Floats
from prbayes.inference.goodness_of_fit import (
    UNLIKELY,
    FittedSets,
    population_misfit,
)
from prbayes.inference.refits import SamplingDistribution

Draw = Callable[[np.random.Generator, int], Floats]
FAMILIES: dict[str, Draw] = {
    "normal": lambda rng, n: rng.normal(1, 0.5, n),
    "t3": lambda rng, n: 1 + 0.5 * rng.standard_t(3, n),
    "bimodal": lambda rng, n: rng.choice([0.3, 1.7], n) + rng.normal(0, 0.25, n),
    "exponential": lambda rng, n: 0.5 + rng.exponential(0.5, n),
}


def optimum(name: str, family: str, seed: int, n: int = 50, **keywords: Any) -> prb.Optimum:
    """Fit a normal population to data of a family."""
    observed = FAMILIES[family](np.random.default_rng([7, seed, n]), n)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        keywords = {"propagation": R256} | keywords
        prb.Simulator("y", same, x, metric=METRICS[name], observed=observed, **keywords)
    return prb.minimize(model, starts=0)


def fit_probability(sampling: SamplingDistribution, n_sets: int = 200) -> float:
    fitted = FittedSets.of(sampling, n_sets, 0)
    assert fitted is not None
    return fitted.p_value


def probabilities(name: str, family: str, sets: int) -> Floats:
    found = []
    for seed in range(sets):
        sampling = optimum(name, family, seed).sampling()
        found.append(fit_probability(sampling))
    return np.array(found)


@pytest.mark.slow
def test_a_right_family_is_called_wrong_as_rarely_as_said() -> None:
    p = probabilities("pr", "normal", 60)
    # A binomial number of 60 with probability .05: 3, and eight or more once in 150 cases.
    assert (p < 0.05).sum() < 8
    assert (p < UNLIKELY).sum() < 4
    # Uniform: a mean of .5 with a standard error of .037.
    assert abs(p.mean() - 0.5) < 0.16


@pytest.mark.long
@pytest.mark.parametrize("name", [pytest.param("area", marks=pytest.mark.slow), "kl"])
def test_a_population_with_two_modes_is_no_normal_one(name: str) -> None:
    assert (probabilities(name, "bimodal", 3) < UNLIKELY).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(METRICS))
@pytest.mark.parametrize(
    ("family", "low", "high"),
    [
        ("normal", 0.0, 0.06),
        ("t3", 0.3, 1.0),
        ("bimodal", 0.95, 1.0),
        ("exponential", 0.8, 1.0),
    ],
)
def test_how_often_families_are_called_wrong(
    name: str, family: str, low: float, high: float
) -> None:
    share = (probabilities(name, family, 60) < UNLIKELY).mean()
    assert low <= share <= high


@pytest.mark.long
def test_diagnose_says_so_of_optima() -> None:
    wrong = optimum("pr", "bimodal", 0)
    said = "the inputs probably have another family"
    assert said in str(prb.diagnose(wrong))
    assert prb.diagnose(optimum("pr", "normal", 0)).ok


def test_it_costs_no_response() -> None:
    found = optimum("pr", "t3", 0)
    before = found.evaluator.n_responses
    fit_probability(found.sampling(), 50)
    assert found.evaluator.n_responses == before


def test_repeated_measurements_of_a_specimen_are_drawn_together() -> None:
    """Each of ten values twice is no normal sample of twenty, but is one of ten specimens."""
    values = np.repeat(np.random.default_rng(5).normal(1, 0.5, 10), 2)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        prb.Simulator(
            "y", same, x, metric=prb.AreaMetric(), observed=values, propagation=R256,
            specimens=np.repeat(np.arange(10), 2),
        )  # fmt: skip
    p = fit_probability(prb.minimize(model).sampling())
    assert p > 0.05


def test_where_it_is_not_looked_at_a_line_says_why() -> None:
    found = optimum("kl", "normal", 0, propagation=prb.Resimulated(256))
    before = found.evaluator.n_responses
    diagnosis = prb.diagnose(found)
    assert found.evaluator.n_responses == before
    assert diagnosis.ok
    said = "No problem was found.\nWhether the inputs have the right family was not looked at: "
    assert str(diagnosis).startswith(f"{said}it would take responses")
    keywords = {"model": found.model, "optimum": found, "progressbar": False}
    plain = prb.sample_smc(60, chains=2, adjustment=None, **keywords)
    width, note = prb.diagnose(plain).notes
    assert "as wide as epsilon makes them" in width
    assert "refits need an optimum; look at prb.diagnose of prb.minimize" in note
    (note,) = prb.diagnose(found.to_datatree()).notes
    assert "refits need the model; pass the Optimum itself" in note
    assert prb.diagnose(optimum("pr", "normal", 0)).notes == ()


def test_why_it_is_not_looked_at_with_other_terms() -> None:
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 2)
        prb.Simulator(
            "y", same, pm.Normal.dist(mu, 1.0), metric=METRICS["kl"],
            observed=FAMILIES["normal"](np.random.default_rng(1), 30), propagation=R256,
        )  # fmt: skip
        pm.Normal("other", mu, 1.0, observed=1.0)
    (note,) = prb.diagnose(prb.minimize(model, starts=0)).notes
    assert "the model has likelihood terms or potentials besides its simulators" in note


@pytest.mark.long
def test_an_optimum_that_the_prior_holds_away_from_the_data_is_told() -> None:
    """The residual is flat there: from the draws around it nothing could be seen."""

    def held(away: float) -> prb.Optimum:
        data = np.random.default_rng(1).normal(2.0, 1.0, 20)
        with pm.Model() as model:
            x = pm.Normal.dist(pm.Normal("mu", 2.0 - away, 0.2), pm.HalfNormal("sigma", 1))
            prb.Simulator(
                "y", same, x, metric=METRICS["pr"], observed=data, epsilon=1.0, propagation=R256
            )
        return prb.minimize(model, prior=True)

    assert "the prior, which is part of its objective, and the data contr" in str(
        prb.diagnose(held(3.0))
    )
    agreeing = prb.diagnose(held(0.0))
    assert agreeing.ok
    assert agreeing.notes == ()


def test_where_nothing_is_known_nothing_is_said() -> None:
    for with_prior in (False, True):
        assert population_misfit(np.nan, with_prior=with_prior) == []
