"""The test of the population's family: size, power, closed forms and findings."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from one_input import one_input
from scipy.special import ndtr, ndtri
from scipy.stats import norm

import prbayes as prb
from prbayes._stats import adjusted_p_values
from prbayes._validate import Floats
from prbayes.inference.checks.population import (
    PopulationTest,
    mixture_ratio,
    population_findings,
    population_statistics,
    population_test,
    power_text,
    replaced_findings,
    zhang_statistic,
)
from prbayes.model.evaluator import Evaluator

# The alternatives of the study: standardised inputs.


def two_modes(rng: np.random.Generator, shape: tuple[int, ...]) -> Floats:
    return 1.2 / 1.342 * np.sign(rng.random(shape) - 0.5) + 0.6 / 1.342 * rng.standard_normal(shape)


ALTERNATIVES: dict[str, Callable[[np.random.Generator, tuple[int, ...]], Floats]] = {
    "normal": lambda rng, shape: rng.standard_normal(shape),
    "skewness 1": lambda rng, shape: rng.gamma(4.0, 0.5, shape) - 2.0,
    "two modes": two_modes,
    "cut": lambda rng, shape: norm.ppf(0.7 * rng.random(shape)),
}


def exact_statistics(x: Floats) -> Floats:
    """Return the statistics of exactly known inputs (R, N) under normal populations fitted to them."""
    z = (x - x.mean(axis=1, keepdims=True)) / x.std(axis=1, keepdims=True)
    return np.array([population_statistics(v[:, None, None], np.ones((len(v), 1))) for v in z])


def rejected(statistics: Floats, null: Floats) -> float:
    return float(np.mean([adjusted_p_values(s, null).min() <= 0.05 for s in statistics]))


@pytest.mark.parametrize(
    ("alternative", "n", "power"),
    [
        ("normal", 50, 0.05),
        ("skewness 1", 50, 0.64),
        ("two modes", 50, 0.86),
        pytest.param("cut", 50, 0.80, marks=pytest.mark.slow),
    ],
)
def test_size_and_power_of_the_linear_problem(alternative: str, n: int, power: float) -> None:
    rng = np.random.default_rng([n, len(alternative)])
    # Scores of a fitted normal population are pivotal: all data sets share the bootstrap samples.
    null = exact_statistics(rng.standard_normal((399, n)))
    share = rejected(exact_statistics(ALTERNATIVES[alternative](rng, (200, n))), null)
    # Standard errors: .035 here, .035 of the study's 200, .02 of the shared samples
    se = np.sqrt(2 * max(power * (1 - power), 0.02) / 200 + 0.02**2)
    assert share == pytest.approx(power, abs=4.5 * se)


def test_zhang_of_exact_inputs_has_its_closed_form() -> None:
    # N = 2 and u = (1/4, 3/4): -(log(.25) / 1.5 + log(.75) / .5 + log(.75) / .5 + log(.25) / 1.5)
    z = ndtri(np.array([0.75, 0.25]))[:, None, None]
    expected = -2 * (np.log(0.25) / 1.5 + np.log(0.75) / 0.5)
    assert zhang_statistic(z, np.ones((2, 1))) == pytest.approx([expected])


def test_points_without_weight_and_the_order_of_specimens_and_inputs_change_nothing() -> None:
    rng = np.random.default_rng(1)
    z, weights = rng.standard_normal((30, 1, 3)), np.ones((30, 1))
    expected = population_statistics(z, weights)
    far = np.concatenate([z, np.full((30, 1, 3), np.inf)], axis=1)
    order = rng.permutation(30)
    for points, of_points in (
        (far, np.stack([np.ones(30), np.zeros(30)], axis=1)),
        (np.repeat(z, 3, axis=1), np.full((30, 3), 1 / 3)),  # equal points share their weight
        (z[order], weights),
        (-z, weights),  # a mirrored population: both statistics are symmetric
    ):
        assert population_statistics(points, of_points) == pytest.approx(expected)
    swapped = population_statistics(z[:, :, ::-1], weights).reshape(2, 3)
    assert swapped[:, ::-1].ravel() == pytest.approx(expected)


def test_drawn_inputs_take_the_weights() -> None:
    # Two roots, standard normal and shifted: the statistic grows with the weight of the wrong one.
    rng = np.random.default_rng(2)
    z = np.stack([rng.standard_normal(50), rng.standard_normal(50) + 4], axis=1)[..., None]
    values = [
        zhang_statistic(z, np.tile([1 - w, w], (50, 1)))[0] for w in (0.0, 0.1, 0.5, 0.9, 1.0)
    ]
    assert values == sorted(values)
    assert values[0] < values[1] < values[-1]


def test_the_mixture_ratio_is_small_at_the_center_and_large_for_two_modes() -> None:
    rng = np.random.default_rng(3)
    scores = ndtri((np.arange(100) + 0.5) / 100)[:, None, None]
    weights = np.ones((100, 1))
    assert 0 <= mixture_ratio(scores, weights)[0] < 1
    z = two_modes(rng, (100, 1, 1))
    assert mixture_ratio(z / z.std(), weights)[0] > 5


def test_small_samples_and_equal_inputs() -> None:
    rng = np.random.default_rng(1)
    for n in (1, 3):
        null = exact_statistics(rng.standard_normal((99, max(n, 2))))
        test = population_test(rng.standard_normal((n, 1, 1)), np.ones((n, 1)), null)
        assert 0 < test.p_value <= 1
        assert test.n == n
    null = exact_statistics(rng.standard_normal((199, 20)))
    assert population_test(np.zeros((20, 1, 1)), np.ones((20, 1)), null).p_value <= 0.01


def test_the_result_has_p_values_by_input() -> None:
    rng = np.random.default_rng(5)
    z = rng.standard_normal((50, 1, 2))
    z[:, 0, 1] = two_modes(rng, (50,))
    z = (z - z.mean(axis=0)) / z.std(axis=0)
    first, second = (exact_statistics(rng.standard_normal((199, 50))) for _ in range(2))
    null = np.stack([first[:, 0], second[:, 0], first[:, 1], second[:, 1]], axis=1)
    test = population_test(z, np.ones((50, 1)), list(null))
    assert test.mixture[1] <= 0.01 < test.mixture[0]
    single = [population_test(z[:, :, [j]], np.ones((50, 1)), null[:, [j, j + 2]]) for j in (0, 1)]
    assert test.zhang == pytest.approx([single[0].zhang[0], single[1].zhang[0]])
    assert test.mixture == pytest.approx([single[0].mixture[0], single[1].mixture[0]])
    assert test.p_value >= min(single[0].p_value, single[1].p_value)
    (finding,) = population_findings(test, ["C", "m"])
    assert finding.code == "population-misfit"
    assert "with the smallest p-value for m, expected p > 0.05; compare skewed" in finding.text


def test_a_fitting_family_is_no_finding() -> None:
    test = PopulationTest(0.051, np.array([0.04]), np.array([0.5]), 20)
    assert population_findings(test, ["C"]) == ()
    (finding,) = population_findings(test, ["C"], threshold=0.06)
    assert "got p = 0.051 for the inputs of 20 specimens" in finding.text


def test_the_power_is_that_of_the_study() -> None:
    at_50 = power_text(50)
    assert "0.59 for skewness 1, 0.84 for two modes, 0.76 for a population cut" in at_50
    assert "at 50 specimens a power of" in at_50
    assert "1.00 for skewness 1" in power_text(1000)
    assert "0.41 for skewness 1" in power_text(round(np.sqrt(20 * 50)))
    assert "less power than at 20: 0.23 for skewness 1" in power_text(8)
    assert "no power with fewer outputs (1) than inputs (3)" in power_text(50, inputs=3)


def responding(value: float, propagation: Any) -> tuple[Any, ...]:
    """Return the findings of a response that fails at x < -1, at the normal population of sd 1."""

    def response(x: float) -> float:
        if x < -1:
            raise ArithmeticError("no convergence")
        return x

    settings = propagation(64, on_failure=prb.response.Replace(value))
    data = np.linspace(-0.5, 2, 20)
    model = one_input(data, prb.KullbackLeibler(), settings, prb.scalar(response), sd=1.0)
    evaluator = Evaluator.of(model)
    evaluator.total(np.zeros((1, 1)), np.ones(1))
    return replaced_findings(evaluator, np.zeros(1))


@pytest.mark.parametrize("propagation", [prb.Reweighted, prb.Resimulated])
def test_numbers_in_place_of_responses_are_reported(propagation: Any) -> None:
    (finding,) = responding(-1.0, propagation)
    assert finding.code == "failed-responses"
    match = re.search(r"replaced by -1, which stands for ([\d.]+)% of the population", finding.text)
    assert match is not None
    assert float(match[1]) / 100 == pytest.approx(ndtr(-1), abs=0.02)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_other_replacements_are_lost_or_failed_specimens(value: float) -> None:
    assert responding(value, prb.Resimulated) == ()
