"""Log scores of specimens: against densities in closed form, and by specimen what the metric has together."""

import numpy as np
import pytest
from scipy.stats import norm

import prbayes as prb
from prbayes.validation.scores import log_scores, scoring_target

RNG = np.random.default_rng(4)
DATA = RNG.normal(3.0, 2.0, 40)
EQUAL = np.full(40, 1 / 40)
POPULATION = 3.0 + 2.0 * norm.ppf((np.arange(20_000) + 0.5) / 20_000)
ALIKE = np.full(20_000, 1 / 20_000)
EVERY = np.arange(40)


def test_a_score_is_the_log_density_of_a_normal_population() -> None:
    found = log_scores(scoring_target(DATA, EQUAL), POPULATION, ALIKE, EVERY)
    # A kernel of 0.14 standard deviations, and a hundredth of the population, are elsewhere.
    np.testing.assert_allclose(found, norm.logpdf(DATA, 3.0, 2.0), atol=0.15)
    assert found.mean() == pytest.approx(norm.logpdf(DATA, 3.0, 2.0).mean(), abs=0.02)


def test_differences_do_not_depend_on_the_unit() -> None:
    other = 1.3 * POPULATION
    mine, theirs = (
        log_scores(scoring_target(DATA, EQUAL), p, ALIKE, EVERY) for p in (POPULATION, other)
    )
    scaled = scoring_target(1000 * DATA, EQUAL)
    a, b = (log_scores(scaled, 1000 * p, ALIKE, EVERY) for p in (POPULATION, other))
    np.testing.assert_allclose(a - b, mine - theirs, atol=1e-9)


@pytest.mark.parametrize("outputs", [1, 3])
def test_their_sum_is_what_the_log_likelihood_has_of_all(
    outputs: int,
) -> None:
    mixing = RNG.normal(size=(3, 3)) + 2 * np.eye(3)
    weights = RNG.uniform(0.5, 1.5, 40)
    weights = weights / weights.sum()
    metric: prb.Metric = prb.LogLikelihood(density=prb.GaussianKDE())
    observed, simulated = DATA, POPULATION
    if outputs > 1:
        metric = prb.Joint(metric)
        observed = RNG.normal(size=(40, 3)) @ mixing
        observed[:9, 2] = np.nan  # not measured
        simulated = RNG.normal(size=(20_000, 3)) @ mixing
    found = log_scores(scoring_target(observed, weights), simulated, ALIKE, EVERY, gross=0.0)
    expected = -metric.against(observed, weights)(simulated)
    assert found.mean() == pytest.approx(expected, abs=0.01)


def test_rows_are_scored_by_themselves() -> None:
    scoring = scoring_target(DATA, EQUAL)
    every = log_scores(scoring, POPULATION, ALIKE, EVERY)
    rows = np.array([7, 2, 30])
    # Products of matrices of other shapes round differently.
    found = log_scores(scoring, POPULATION, ALIKE, rows)
    np.testing.assert_allclose(found, every[rows], rtol=1e-12)


def test_a_specimen_keeps_its_score_in_any_order() -> None:
    observed = RNG.normal(size=(40, 2))
    observed[[1, 5, 6, 20, 33], 0] = np.nan
    simulated = RNG.normal(size=(20_000, 2))
    found = log_scores(scoring_target(observed, EQUAL), simulated, ALIKE, EVERY)
    order = RNG.permutation(40)
    again = log_scores(scoring_target(observed[order], EQUAL), simulated, ALIKE, EVERY)
    np.testing.assert_allclose(again, found[order], atol=1e-6)
    assert np.ptp(found) > 1


def test_one_specimen_far_out_costs_a_bounded_amount() -> None:
    far = np.append(DATA, 60.0)
    found = log_scores(scoring_target(far, np.full(41, 1 / 41)), POPULATION, ALIKE, np.arange(41))
    # A hundredth of a Student's t density with three degrees of freedom, 29 units out.
    assert -22 < found[-1] < -10


def test_points_without_response_are_left_out_and_failures_are_not() -> None:
    scoring = scoring_target(DATA, EQUAL)
    half = np.concatenate([POPULATION, np.full(20_000, np.nan)])
    weights = np.full(40_000, 1 / 40_000)
    complete = log_scores(scoring, POPULATION, ALIKE, EVERY)
    np.testing.assert_allclose(log_scores(scoring, half, weights, EVERY), complete, atol=1e-9)
    failed = np.where(np.isnan(half), np.inf, half)
    lower = log_scores(scoring, failed, weights, EVERY) - complete
    # Half of the specimens fail, and half of the density is left, but for what is spread widely.
    np.testing.assert_allclose(lower, np.log(0.5), atol=0.15)


def test_data_without_a_density_are_refused() -> None:
    with pytest.raises(ValueError, match="bandwidth: got 0"):
        scoring_target(np.ones(9), np.full(9, 1 / 9))
