"""Modes count as often as the truth is in them, by what fits of data sets in all of them tell."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
from numpy.typing import NDArray
from scipy.special import softmax

import prbayes as prb
from prbayes._checks import Floats
from prbayes.estimate.data_sets import observed_set
from prbayes.estimate.refit import SamplingDistribution
from prbayes.model.evaluator import Evaluator
from prbayes.posterior.adjustment import _with_overlooked
from prbayes.posterior.mode_weights import (
    Mode,
    _given_estimate,
    dealt_out,
    mode_weights,
    of_several_modes,
)

SCATTER = 0.5


def lopsided(x: Any) -> Any:
    """Return a response that two means explain, of which one has the smaller spread."""
    return x**2 + x**3 / 10


def mirrored(x: Any) -> Any:
    return x**2


def problem(
    response: Any,
    metric: prb.Metric,
    observed: Floats,
    propagation: Any = None,
    epsilon: float | None = 0.05,
) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2.5), SCATTER)
        prb.Simulator(
            "y",
            response,
            x,
            metric=metric,
            observed=observed,
            epsilon=epsilon,
            propagation=propagation or prb.Reweighted(512),
        )
    return model


def modes_of(response: Any, metric: prb.Metric, observed: Floats, means: Any) -> list[Mode]:
    evaluator = Evaluator(problem(response, metric, observed))
    samplings = []
    for mean in means:
        theta = np.array([mean])
        sampling = SamplingDistribution.of(evaluator, theta, evaluator.epsilon)
        (center,), _ = sampling.refit(observed_set(evaluator))
        place = sampling.thetas(center)
        samplings.append(SamplingDistribution.of(evaluator, place, evaluator.epsilon))
    # As exp(-d / epsilon) has them, and of the width that they should have.
    least = evaluator.discrepancies(np.array([s.theta for s in samplings]), 0)
    shares = softmax(-np.reshape(least, len(samplings)) / evaluator.epsilon)
    return [
        Mode(sampling, share, np.eye(1), np.zeros(1), np.eye(1))
        for sampling, share in zip(samplings, shares, strict=True)
    ]


def drawn(mean: float, size: int, seed: int) -> Floats:
    return np.asarray(lopsided(np.random.default_rng(seed).normal(mean, SCATTER, size)))


@cache
def two(metric: prb.Metric, mean: float) -> tuple[Mode, ...]:
    return tuple(modes_of(lopsided, metric, drawn(mean, 20, 4), (2.1, -2.8)))


def weights_of(modes: Any, n_sets: int = 100) -> Floats:
    found = mode_weights(modes, n_sets, np.random.default_rng(1))
    assert found is not None
    assert found.sum() == pytest.approx(1)
    return found


METRICS = [prb.ProbabilityResidual(), prb.KullbackLeibler(), prb.AreaMetric()]


@pytest.mark.parametrize("metric", METRICS, ids=lambda metric: type(metric).__name__)
def test_the_mode_that_the_data_are_from_counts_more(metric: prb.Metric) -> None:
    assert weights_of(two(metric, 2.0))[0] > 0.75
    assert weights_of(two(metric, -2.7))[1] > 0.75


def test_modes_count_alike_in_whichever_order() -> None:
    modes = two(METRICS[0], 2.0)
    there = weights_of(modes)
    back = weights_of(modes[::-1])
    # Both by 100 data sets a mode.
    np.testing.assert_allclose(back[::-1], there, atol=0.1)


@pytest.mark.parametrize("metric", METRICS, ids=lambda metric: type(metric).__name__)
def test_mirror_images_count_by_the_prior_and_their_volumes(metric: prb.Metric) -> None:
    rng = np.random.default_rng(2)
    observed = mirrored(rng.normal(2, SCATTER, 20))
    one, other = modes_of(mirrored, metric, observed, (2.0, -2.0))
    np.testing.assert_allclose(weights_of([one, other]), 0.5, atol=0.03)
    shared = [replace(one, share=0.8), replace(other, share=0.2)]
    np.testing.assert_allclose(weights_of(shared), [0.8, 0.2], atol=0.03)
    # Draws of one mode are twice as wide as they should be, and there are too many of them for it.
    wide = [replace(one, before=4 * np.eye(1)), other]
    np.testing.assert_allclose(weights_of(wide), [1 / 3, 2 / 3], atol=0.03)


def test_three_modes() -> None:
    # The same mode twice shares what it has.
    first, second = two(METRICS[0], 2.0)
    found = weights_of([first, second, first])
    np.testing.assert_allclose(found[0], found[2], rtol=0.2)
    assert found[1] < 0.2


@pytest.mark.parametrize("away", [False, True])
def test_nothing_is_told_where_fits_do_not_arrive(
    away: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    modes = two(METRICS[1], 2.0)
    refit = SamplingDistribution.refit

    def failing(self: Any, sets: Any) -> tuple[Floats, NDArray[np.bool_]]:
        x, converged = refit(self, sets)
        if len(x) == 1:
            return x, converged
        some = np.arange(len(x)) % 4 > 0
        return (np.where(some[:, None], 7.0, x), converged) if away else (x, converged & ~some)

    monkeypatch.setattr(SamplingDistribution, "refit", failing)
    assert mode_weights(modes, 100, np.random.default_rng(1)) is None


def test_draws_are_dealt_out() -> None:
    nearest = np.repeat([0, 1, 2], [600, 300, 100])
    rows, modes = dealt_out(nearest, np.array([0.1, 0.7, 0.2]), np.random.default_rng(1))
    assert np.bincount(modes).tolist() == [100, 700, 200]
    # Each stands for its own mode, those that are enough stay, and none is there without need.
    np.testing.assert_array_equal(nearest[rows], modes)
    kept = rows == np.arange(1000)
    assert kept.sum() == 100 + 300 + 100
    assert len(np.unique(rows[modes == 0])) == 100
    rows, modes = dealt_out(nearest, np.array([0.6, 0.3, 0.1]), np.random.default_rng(1))
    np.testing.assert_array_equal(rows, np.arange(1000))
    np.testing.assert_array_equal(modes, nearest)


def test_several_modes_are_said() -> None:
    rng = np.random.default_rng(1)
    modes = np.repeat([0, 2], [30, 70])
    centers = np.repeat([[1.0, 5.0, 0.1], [3.0, -5.0, 0.2]], [30, 70], axis=0)
    values = centers + rng.normal(0, [0.1, 0.1, 1.0], (100, 3))
    draws = {"mu": values[:, :2], "sigma": values[:, 2], "fixed": np.ones(100)}
    (said,) = of_several_modes(draws, modes, ", which count as epsilon says")
    medians = np.median(values[modes == 2], axis=0)
    # The one with more draws first, and what tells them apart best.
    assert said.startswith(
        "the posterior has 2 modes, which count as epsilon says: 70% of the draws around "
        f"mu[1] = {medians[1]:.3g}, mu[0] = {medians[0]:.3g}; "
        "30% of the draws around mu[1] = "
    )
    many = {f"x{i}": modes * (i + 2) + values[:, 2] for i in range(6)}
    (said,) = of_several_modes(many, modes, "")
    assert said.startswith("the posterior has 2 modes: 70% of the draws around x5 = ")
    assert said.count("=") == 8
    (said,) = of_several_modes({"mu": values[:, 2] + 0.5 * modes}, modes, "")
    assert "70% of the draws around mu = " in said
    assert of_several_modes(draws, np.zeros(100, dtype=int), "") == []


def posterior(model: pm.Model, **chosen: Any) -> Any:
    return prb.sample_smc(
        200, chains=2, model=model, random_seed=1, progressbar=False, **chosen
    ).posterior


def test_differences_are_those_of_data_sets_with_the_estimate() -> None:
    rng = np.random.default_rng(3)
    away = rng.normal(0.5, 1, (400, 1))
    differences = [2.0, -1.0] + away * [3.0, 1.0] + 0.1 * rng.standard_normal((400, 2))
    center, scatter = _given_estimate(differences, away)
    np.testing.assert_allclose(center, [2, -1], atol=0.03)
    np.testing.assert_allclose(scatter, 0.01 * np.eye(2), atol=0.003)


@pytest.mark.long
@pytest.mark.parametrize(("seed", "low", "high"), [(0, 0.1, 0.4), (4, 0.7, 0.99)])
@pytest.mark.parametrize("adjust", [prb.posterior.Affine(100), prb.posterior.GivenEstimate(100)])
def test_draws_of_the_posterior_are_of_such_shares(
    adjust: Any, seed: int, low: float, high: float
) -> None:
    # The exact posterior's shares of the positive mode are .18 and .95; those of epsilon .29 and
    # .55. Of the first data an optimum tells the other mode alone.
    observed = drawn(2.0, 8, seed)
    model = problem(lopsided, prb.ProbabilityResidual(), observed, epsilon=None)
    found = posterior(model, adjust=adjust)
    share = float((found["mu"] > 0).mean())
    assert low < share < high
    # Each draw is of its mode before that, and has its width.
    for side in (found["mu"].values > 0, found["mu"].values < 0):
        low, middle, high = np.quantile(found["mu"].values[side], [0.05, 0.5, 0.95])
        assert 0.12 < middle - low < 0.6
        assert 0.12 < high - middle < 0.6
    done = found.attrs["adjustment"]
    assert "2 modes each by itself, of shares" in done
    said = sorted(float(word) for word in done.split("of shares ")[1].split(" and "))
    np.testing.assert_allclose(said, sorted([share, 1 - share]), atol=0.01)
    *_, warning = found.attrs["warnings"].splitlines()
    assert warning.startswith("the posterior has 2 modes: ")
    middle = np.median(found["mu"].values[found["mu"].values > 0])
    assert f"{share:.0%} of the draws around mu = {middle:.3g}" in warning
    assert f"{1 - share:.0%} of the draws around mu = -" in warning


def test_epsilon_tells_where_responses_are_not_stored() -> None:
    model = problem(mirrored, METRICS[1], mirrored(drawn(2.0, 20, 4)), prb.Resimulated(256))
    with model:
        evaluator = Evaluator(model)
    modes = [SamplingDistribution.of(evaluator, np.array([m]), np.ones(1)) for m in (2.0, -2.0)]
    thetas = np.repeat([[2.0], [-2.0]], 60, axis=0)
    nearest = np.repeat([0, 1], 60)
    rows, there, said = prb.posterior.Affine()._dealt_out(modes, thetas, nearest)
    np.testing.assert_array_equal(rows, np.arange(120))
    assert there is nearest
    assert said == ", which count as epsilon says"
    # Of one mode, or where one has hardly any draws, nothing is to be said.
    assert prb.posterior.Affine()._dealt_out(modes[:1], thetas, 0 * nearest)[2] == ""
    assert (
        prb.posterior.Affine()._dealt_out(modes, thetas[30:], np.repeat([0, 1], [30, 60]))[2] == ""
    )


def test_only_what_is_a_mode_is_looked_for() -> None:
    one, other = (mode.sampling for mode in two(METRICS[0], 2.0))
    rng = np.random.default_rng(1)
    there = one.thetas(rng.standard_normal((200, 1)))
    elsewhere = other.thetas(rng.standard_normal((60, 1)))
    assert _with_overlooked([one], there) == [one]
    _, found = _with_overlooked([one], np.concatenate([there, elsewhere]))
    np.testing.assert_allclose(found.theta, other.theta, atol=0.1)
    assert _with_overlooked([one], np.concatenate([there, elsewhere[:49]])) == [one]
    # With draws all the way to it, it is none.
    between = np.linspace(one.theta, other.theta, 150)
    assert _with_overlooked([one], np.concatenate([there, elsewhere, between])) == [one]
    # A tail leads back, and is none.
    tail = one.thetas(np.linspace(7, 9, 60)[:, None])
    assert _with_overlooked([one], np.concatenate([there, tail])) == [one]
    # The likeliest of all that are far off leads to the other mode.
    assert len(_with_overlooked([one], np.concatenate([tail, there, elsewhere]))) == 2


@pytest.mark.parametrize(("number", "said"), [(30, False), (80, True)])
def test_modes_of_hardly_any_draws_are_not_said(number: int, said: bool) -> None:
    one, other = (mode.sampling for mode in two(METRICS[0], 2.0))
    rng = np.random.default_rng(1)
    draws = [
        one.thetas(rng.standard_normal((300, 1))),
        other.thetas(rng.standard_normal((number, 1))),
    ]
    optima = [one.theta, other.theta]
    found = prb.posterior.Affine(40)(one.evaluator, np.concatenate(draws), optima)
    assert any(line.startswith("the posterior has 2 modes") for line in found.warnings) == said
