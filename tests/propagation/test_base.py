"""What all propagations share: validity of parameters, draws of specimens, the discrepancy's own error."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.model.random_variable import nodes
from prbayes.propagation.base import Bound, Missing, Propagation, discrepancy_error

OBSERVED = [0.5, 1.0, 1.5, 2.5]
PROPAGATIONS = [prb.Reweighted(128), prb.Resimulated(128), prb.Fresh(128)]


def bound(propagation: Propagation, response: Any = np.positive, **priors: Any) -> Bound:
    with pm.Model() as model:
        mu = pm.Normal("mu", 1.0, 0.5)
        sigma = priors.get("sigma") or pm.HalfNormal("sigma", 1.0)
        x = pm.Normal.dist(mu, sigma)
        prb.Simulator(
            "y", response, x, metric=prb.AreaMetric(), observed=OBSERVED, propagation=propagation
        )
    (node,) = nodes(model).values()
    return node.bound


def at(mu: list[float], sigma: list[float]) -> list[Any]:
    return [np.array(mu), np.array(sigma)]


@pytest.mark.parametrize("propagation", PROPAGATIONS, ids=lambda p: type(p).__name__)
def test_what_a_bound_declares(propagation: Propagation) -> None:
    found = bound(propagation)
    name = type(propagation).__name__
    assert found.stored == (name == "Reweighted")
    assert found.random == (name == "Fresh")
    assert found.is_line == (name == "Reweighted")
    assert found.n_points == 128
    assert found.n_per_theta == (0 if found.stored else 128)


@pytest.mark.parametrize("propagation", PROPAGATIONS, ids=lambda p: type(p).__name__)
def test_invalid_parameters_are_infinitely_far_and_leave_others_alone(
    propagation: Propagation,
) -> None:
    found = bound(propagation)
    params = at([1.0, 1.0, 1.0], [0.5, -1.0, 0.5])
    np.testing.assert_array_equal(found.valid(params), [True, False, True])
    values = found.discrepancies(params, found.target)
    assert np.isinf(values[1])
    assert np.isfinite(values[[0, 2]]).all()


@pytest.mark.parametrize("propagation", PROPAGATIONS, ids=lambda p: type(p).__name__)
def test_populations_have_their_mean_and_spread(propagation: Propagation) -> None:
    values, weights = bound(propagation).populations(at([1.2], [0.4]))
    mean = (values * weights).sum()
    sd = np.sqrt((weights * (values - mean) ** 2).sum())
    # Of 128 random draws; stored and common points are far closer.
    assert mean == pytest.approx(1.2, abs=5 * 0.4 / np.sqrt(128))
    assert sd == pytest.approx(0.4, abs=5 * 0.4 / np.sqrt(256))


def test_specimens_are_drawn_from_the_population_and_never_without_a_response() -> None:
    def half(x: Any) -> Any:
        return np.where(x < 1.0, np.nan, x)

    found = bound(prb.Reweighted(256, max_lost=0.9), half)
    rng = np.random.default_rng(0)
    drawn = found.draw(rng, 500, [np.float64(1.0), np.float64(0.5)])
    assert drawn.min() >= 1.0
    assert np.isnan(found.draw(rng, 3, [np.float64(1.0), np.float64(-0.5)])).all()


def test_the_error_of_random_draws_is_that_of_repetitions() -> None:
    found = bound(prb.Fresh(512))
    params = at([1.5], [0.7])
    repeated = [found.discrepancies(params, found.target)[0] for _ in range(60)]
    told = np.mean([discrepancy_error(found, params) for _ in range(60)])
    # Standard errors: of a standard deviation of 60 values 9%, of the mean of 60 jackknives about
    # 4%.
    assert told == pytest.approx(np.std(repeated), rel=0.45)


def test_few_points_have_no_error() -> None:
    assert np.isnan(discrepancy_error(bound(prb.Fresh(15)), at([1.0], [0.5])))


def test_priors_that_are_never_valid_are_refused() -> None:
    def build() -> Bound:
        with pm.Model() as model:
            sigma = pm.Normal("sigma", -50.0, 0.1)
            x = pm.Normal.dist(0.0, sigma)
            prb.Simulator("y", np.square, x, metric=prb.AreaMetric(), observed=OBSERVED)
        return next(iter(nodes(model).values())).bound

    with pytest.raises(
        ValueError, match=r"invalid parameters of the inputs at all .* draws of sigma"
    ):
        build()


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"executor": 3}, "executor: got int"),
        ({"store": 3}, "store: got int"),
        ({"on_failure": "abort"}, "on_failure: got str 'abort'"),
    ],
)
@pytest.mark.parametrize("kind", [prb.Reweighted, prb.Resimulated, prb.Fresh])
def test_what_is_no_executor_folder_or_policy_is_refused(
    kind: Any, keywords: Any, words: str
) -> None:
    with pytest.raises(TypeError, match=words):
        kind(64, **keywords)


def half(x: Any) -> Any:
    return np.where(x > 2.0, np.nan, np.where(x < 0.0, np.inf, x))


@pytest.mark.parametrize("propagation", PROPAGATIONS, ids=lambda p: type(p).__name__)
def test_shares_without_numbers_are_told(propagation: Propagation) -> None:
    found = bound(propagation, half)
    params = at([1.0], [1.0])
    missing = found.missing(params)
    values, weights = np.full((1, 10), 1.0), np.full((1, 10), 0.1)
    values[0, :2], values[0, 2:6] = np.nan, np.inf
    told = Missing.of(values, weights)
    np.testing.assert_allclose((told.lost[0], told.failed[0]), (0.2, 0.5))
    # Of a normal population, with five standard errors of 128 random draws.
    assert abs(missing.lost[0] - 0.159) < 0.16
    assert abs(missing.failed[0] - 0.159 / 0.841) < 0.18


def test_what_was_looked_at_last_is_not_computed_again() -> None:
    found = bound(prb.Resimulated(64), half)
    found.discrepancies(at([1.0], [1.0]), found.target)
    count = found.responses.count
    found.missing(at([1.0], [1.0]))
    assert found.responses.count == count
    # At parameters that are not valid there is no population.
    found.discrepancies(at([1.0], [-1.0]), found.target)
    assert found.missing(at([1.0], [-1.0])).lost == [1.0]


def test_the_failed_share_of_a_design_is_that_of_its_populations() -> None:
    found = bound(prb.Reweighted(512), half)
    support = found.support(at([1.0], [1.0]))  # type: ignore[attr-defined]
    np.testing.assert_allclose(support["lost_mass"], 0.159, atol=0.02)
    np.testing.assert_allclose(support["failed_mass"], 0.159 / 0.841, atol=0.02)
