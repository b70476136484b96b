"""Goodness of fit: size and power for families, and which outputs and correlations misfit."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
from four_metrics import METRICS, R256, same
from one_input import one_input

import prbayes as prb
from prbayes._validate import Floats
from prbayes.inference.goodness_of_fit import (
    UNLIKELY,
    FittedSets,
    _fit_distances,
    output_misfits,
    population_misfit,
    spread_out,
    unpredicted_failures,
    worst_p_value,
)
from prbayes.inference.refits import SamplingDistribution
from prbayes.model.evaluator import Evaluator

Draw = Callable[[np.random.Generator, int], Floats]
FAMILIES: dict[str, Draw] = {
    "normal": lambda rng, n: rng.normal(1, 0.5, n),
    "t3": lambda rng, n: 1 + 0.5 * rng.standard_t(3, n),
    "bimodal": lambda rng, n: rng.choice([0.3, 1.7], n) + rng.normal(0, 0.25, n),
    "exponential": lambda rng, n: 0.5 + rng.exponential(0.5, n),
}


def optimum(name: str, observed: Any, **keywords: Any) -> prb.Optimum:
    """Fit a normal population."""
    keywords = {"propagation": R256} | keywords
    return prb.minimize(one_input(observed, METRICS[name], response=same, **keywords), starts=0)


@cache
def of_family(name: str, family: str, seed: int, **keywords: Any) -> prb.Optimum:
    observed = FAMILIES[family](np.random.default_rng([7, seed, 50]), 50)
    return optimum(name, observed, **keywords)


def p_value(found: prb.Optimum, n_sets: int = 200) -> float:
    fitted = FittedSets.of(found.sampling(), n_sets, 0)
    assert fitted is not None
    return fitted.p_value


def p_values(name: str, family: str, sets: int) -> Floats:
    return np.array([p_value(of_family(name, family, seed)) for seed in range(sets)])


@pytest.mark.slow
def test_a_right_family_is_called_wrong_as_rarely_as_said() -> None:
    p = p_values("pr", "normal", 60)
    # A binomial number of 60 with probability .05: 3, and eight or more once in 150 cases.
    assert (p < 0.05).sum() < 8
    assert (p < UNLIKELY).sum() < 4
    # Uniform: a mean of .5 with a standard error of .037.
    assert abs(p.mean() - 0.5) < 0.16


def test_repeated_measurements_of_a_specimen_are_drawn_together() -> None:
    """Each of ten values twice is no normal sample of twenty, but is one of ten specimens."""
    values = np.repeat(np.random.default_rng(5).normal(1, 0.5, 10), 2)
    fitted = optimum("area", values, specimens=np.repeat(np.arange(10), 2))
    before = fitted.evaluator.n_responses
    assert p_value(fitted) > 0.05
    assert fitted.evaluator.n_responses == before


def test_the_largest_of_standardised_statistics_is_compared() -> None:
    drawn = np.random.default_rng(0).standard_normal((999, 2)) * [1.0, 100.0]
    assert worst_p_value(np.array([5.0, 0.0]), drawn) == pytest.approx(0.001)
    assert worst_p_value(np.array([0.0, 5.0]), drawn) > 0.3
    assert worst_p_value(np.array([-5.0, 0.0]), drawn) > 0.3
    assert worst_p_value(np.array([-5.0, 0.0]), drawn, two_sided=True) == pytest.approx(0.001)
    unknown = np.where(np.arange(999)[:, None] < 998, np.nan, drawn)
    assert worst_p_value(np.array([5.0, 0.0]), unknown) == 1.0
    assert worst_p_value(np.array([np.nan, 0.0]), drawn) == 1.0


def test_distances_of_a_fit_leave_out_points_without_a_finite_response() -> None:
    simulated, masses = np.array([1.0, 2.0, 3.0, 4.0]), np.array([[0.4, 0.3, 0.2, 0.1]])
    data = np.array([2.5, 1.5]), np.array([[0.25, 0.75]])
    # F is .4 at 1.5, and .7 at 2.5; the middles of the steps of the data are .375 and .875.
    squares = np.array([0.75, 0.25]) * np.square([0.375 - 0.4, 0.875 - 0.7])
    expected = np.log([squares.sum(), (squares / [0.4 * 0.6, 0.7 * 0.3]).sum()])
    np.testing.assert_allclose(_fit_distances(simulated, masses, *data), [expected])
    simulated, masses = np.append(simulated, [np.inf, np.nan]), np.append(masses / 2, [[0.3, 0.2]])
    np.testing.assert_allclose(_fit_distances(simulated, masses[None], *data), [expected])


def test_cheap_responses_are_computed_for_the_test() -> None:
    """At most 200 data sets of 256 responses."""
    optima = [
        of_family("kl", family, 0, propagation=prb.Resimulated(256))
        for family in ("bimodal", "normal")
    ]
    # Also where the machine is busy.
    wrong, right = (replace(o, search=replace(o.search, seconds=1.0)) for o in optima)
    (finding,) = prb.diagnose(wrong).findings
    assert finding.code == "population-misfit"
    diagnosis = prb.diagnose(right)
    assert str(diagnosis) == "No problem was found."


def test_where_it_is_not_looked_at_a_line_says_why() -> None:
    found = of_family("kl", "normal", 0, propagation=prb.Resimulated(256))
    slow_search = replace(found.search, seconds=1.0 * found.n_responses)
    slow_optimum = replace(found, search=slow_search)
    before = found.evaluator.n_responses
    diagnosis = prb.diagnose(slow_optimum)
    assert found.evaluator.n_responses == before
    assert diagnosis.ok
    said = "No problem was found by the tests that were run.\nThe family of the inputs "
    assert str(diagnosis).startswith(f"{said}was not tested: it would take 51200 resp")
    keywords = {"model": found.model, "optimum": found, "progressbar": False}
    plain = prb.diagnose(prb.sample_smc(60, chains=2, adjustment=None, **keywords))
    assert "width-of-epsilon" in [finding.code for finding in plain.findings]
    assert "refits need an optimum; look at prb.diagnose of prb.minimize" in plain.notes[0]
    (note,) = prb.diagnose(found.to_datatree()).notes
    assert "refits need the model; pass the Optimum itself" in note
    assert prb.diagnose(of_family("pr", "normal", 0)).notes == ()


# -- ties and failures --


def test_ties_are_spread_over_their_steps() -> None:
    exact = np.random.default_rng(0).normal(10, 2, 200)
    spread = spread_out(exact.round(0))
    assert np.unique(spread).size == 200
    np.testing.assert_allclose(np.sort(spread), np.sort(exact), atol=1.0)
    np.testing.assert_array_equal(spread.round(6).round(0), exact.round(0))
    # Without a step, as of three significant digits, over half of the way to the neighbours.
    assert spread_out(np.array([1.0, 1.1, 1.1, 2.7183])).round(4).tolist() == [
        1.0, 1.075, 1.5046, 2.7183,
    ]  # fmt: skip
    for same_values in (exact, np.full(3, 2.0), np.array([1.0, np.inf, np.inf, 3.0])):
        np.testing.assert_array_equal(spread_out(same_values), same_values)


@pytest.mark.parametrize(
    ("family", "step", "code", "words"),
    [
        ("normal", 0.7, "rounded-data", "45 of 50 values of y equal others, all of them multipl"),
        ("bimodal", 0.35, "population-misfit", "Rounding does not explain it (4"),
        ("bimodal", 1e-9, "population-misfit", "the inputs probably have another family"),
    ],
)
def test_rounding_is_named_before_another_family(
    family: str, step: float, code: str, words: str
) -> None:
    exact = FAMILIES[family](np.random.default_rng([7, 0, 50]), 50)
    (finding,) = prb.diagnose(optimum("kl", np.round(exact / step) * step)).findings
    assert finding.code == code
    assert words in finding.text
    assert ("another family, or" in finding.text) == (code == "population-misfit")


def test_a_failed_specimen_of_a_population_that_never_fails_is_named() -> None:
    exact = FAMILIES["normal"](np.random.default_rng(0), 25)

    def failures(observed: Any) -> Any:
        model = one_input(observed, METRICS["area"], R256, same)
        return unpredicted_failures(Evaluator.of(model), np.zeros(2))

    assert not failures(exact)
    (finding,) = failures(np.append(exact, np.inf))
    assert "y: 1 of 26 measured values are +inf" in finding.text


def test_why_it_is_not_looked_at_with_other_terms() -> None:
    observed = FAMILIES["normal"](np.random.default_rng(1), 30)
    model = one_input(observed, METRICS["kl"], R256, same, sd=1.0)
    with model:
        pm.Normal("other", model["mu"], 1.0, observed=1.0)
    (note,) = prb.diagnose(prb.minimize(model, starts=0)).notes
    assert "the model has likelihood terms or potentials besides its simulators" in note


@pytest.mark.long
def test_an_optimum_that_the_prior_holds_away_from_the_data_is_reported() -> None:
    """The residual is flat there: from the draws around it nothing could be seen."""
    data = np.random.default_rng(1).normal(2.0, 1.0, 20)
    text = "the prior, which is part of its objective, and the data contr"
    for away, is_reported in ((3.0, True), (0.0, False)):
        prior = {"mu": (2.0 - away, 0.2), "epsilon": 1.0}
        model = one_input(data, METRICS["pr"], R256, same, **prior)
        assert (text in str(prb.diagnose(prb.minimize(model, prior=True)))) == is_reported


def test_where_nothing_is_known_nothing_is_said() -> None:
    for with_prior in (False, True):
        assert population_misfit(np.nan, with_prior=with_prior) == []


# -- by output -------------------------------------------------------------------------------------


def three(a: Any, b: Any, c: Any) -> Any:
    return np.stack([a, 0.8 * a + 0.6 * b, c], axis=-1)


DATA = three(*np.random.default_rng(1).standard_normal((3, 60)))
WRONG_OUTPUT = DATA * [1.0, 1.0, 2.0]
WRONG_CORRELATION = np.column_stack([DATA[:, 0], DATA[::-1, 1], DATA[:, 2]])
WITH_FAILURES = np.where((np.arange(60) < 6)[:, None] & [True, False, False], np.inf, DATA)


def model_of(data: Any) -> pm.Model:
    with pm.Model() as model:
        mu = pm.Normal("mu", 0.0, 0.3)
        inputs = [pm.Normal.dist(mu, 1.0), pm.Normal.dist(0.0, 1.0), pm.Normal.dist(0.0, 1.0)]
        metric = prb.Joint(prb.ProbabilityResidual(), directions=6)
        few = prb.Reweighted(128, max_points=768)
        prb.Simulator("y", three, *inputs, metric=metric, observed=data, propagation=few)
    return model


def misfit(data: Any) -> str:
    """Return the finding of data against the population at zero."""
    evaluator = Evaluator.of(model_of(data))
    sampling = SamplingDistribution.of(evaluator, np.zeros(1), np.ones(1))
    (finding,) = output_misfits(FittedSets.at_theta(sampling, 200, 0))
    return finding.text


@pytest.mark.long
def test_outputs_and_pairs_that_misfit_are_named() -> None:
    # Without the last output of some specimens.
    lost = (np.arange(60) < 10)[:, None] & [False, False, True]
    text = misfit(np.where(lost, np.nan, WRONG_OUTPUT))
    assert text.startswith("y: these disagree with the best population: outputs 2 (p = 0.0")
    assert "correlations" not in text
    text = misfit(np.where(lost, np.nan, WRONG_CORRELATION))
    assert "outputs" not in text
    assert "correlations 0 with 1 (measured " in text
    assert ", calibrated 0.8" in text
    assert " with 2" not in text


def test_failures_that_the_model_does_not_predict_are_named() -> None:
    assert "outputs 0 (p" in misfit(WITH_FAILURES)


@pytest.mark.long
def test_of_right_data_nothing_is_named() -> None:
    assert misfit(DATA).startswith("y: no single output and no correlation of two disagrees")


@pytest.mark.long
def test_a_diagnosis_names_what_disagrees() -> None:
    found = prb.minimize(model_of(WRONG_CORRELATION), starts=0)
    before = found.evaluator.n_responses
    diagnosis = prb.diagnose(found)
    assert found.evaluator.n_responses == before
    assert any("farther from their best population" in text for text in diagnosis.messages)
    assert "y: these disagree with the best population" in str(diagnosis)
