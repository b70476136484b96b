"""What all propagations share: valid parameters, populations, specimens, errors and missing shares."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from first_use import first_use
from one_input import one_input

import prbayes as prb
from prbayes.propagation.base import Bound, Missing, Propagation, discrepancy_error

OBSERVED = [0.5, 1.0, 1.5, 1.9]
KINDS = [prb.Reweighted, prb.Resimulated, prb.Fresh]


def response(x: Any) -> Any:
    """Return the input; NaN above 2, a failure below 0."""
    return np.where(x > 2.0, np.nan, np.where(x < 0.0, np.inf, x))


@cache
def bound(propagation: Propagation, response: Any = np.positive) -> Bound:
    model = one_input(
        OBSERVED, prb.AreaMetric(), response=response, propagation=propagation, mu=(1.0, 0.5)
    )
    (node,) = first_use(model).values()
    return node.bound


def at(mu: list[float], sigma: list[float]) -> list[Any]:
    return [np.array(mu), np.array(sigma)]


@pytest.mark.parametrize("kind", KINDS)
def test_a_population_of_each_propagation(kind: Any) -> None:
    found = bound(kind(128))
    assert found.stored == (kind is prb.Reweighted)
    assert found.random == (kind is prb.Fresh)
    assert found.n_points == 128
    assert found.n_per_theta == (0 if found.stored else 128)
    # Invalid parameters are infinitely far, and do not affect others.
    params = at([1.0, 1.0, 1.0], [0.5, -1.0, 0.5])
    np.testing.assert_array_equal(found.valid(params), [True, False, True])
    distances = found.discrepancies(params, found.target)
    np.testing.assert_array_equal(np.isinf(distances), [False, True, False])
    # Of 128 random draws; stored and common points are far closer.
    values, weights = found.populations(at([1.2], [0.4]))
    mean = (values * weights).sum()
    sd = np.sqrt((weights * (values - mean) ** 2).sum())
    assert mean == pytest.approx(1.2, abs=5 * 0.4 / np.sqrt(128))
    assert sd == pytest.approx(0.4, abs=5 * 0.4 / np.sqrt(256))


def test_specimens_are_drawn_from_the_population_and_never_without_a_response() -> None:
    found = bound(prb.Reweighted(256, max_lost=0.9), lambda x: np.where(x < 1.0, np.nan, x))
    rng = np.random.default_rng(0)
    assert found.draw(rng, 500, [np.float64(1.0), np.float64(0.5)]).min() >= 1.0
    assert np.isnan(found.draw(rng, 3, [np.float64(1.0), np.float64(-0.5)])).all()


def test_the_error_of_random_draws_is_that_of_repetitions() -> None:
    found = bound(prb.Fresh(512))
    params = at([1.5], [0.7])
    repeated = [found.discrepancies(params, found.target)[0] for _ in range(60)]
    estimated = np.mean([discrepancy_error(found, params) for _ in range(60)])
    # Standard errors: of a standard deviation of 60 values 9%, of the mean of 60 jackknives 4%.
    assert estimated == pytest.approx(np.std(repeated), rel=0.45)
    assert np.isnan(discrepancy_error(bound(prb.Fresh(15)), at([1.0], [0.5])))  # too few points


def test_missing_shares_of_weighted_values() -> None:
    values, weights = np.full((1, 10), 1.0), np.full((1, 10), 0.1)
    values[0, :2], values[0, 2:6] = np.nan, np.inf
    missing = Missing.of(values, weights)
    np.testing.assert_allclose((missing.lost[0], missing.failed[0]), (0.2, 0.5))
    computed = bound(prb.Resimulated(128), response).missing(at([1.0], [1.0]))
    np.testing.assert_allclose(computed.lost, 0.159, atol=0.02)
    np.testing.assert_allclose(computed.failed, 0.159 / 0.841, atol=0.02)
    support = bound(prb.Reweighted(512), response).support(at([1.0], [1.0]))  # type: ignore[attr-defined]
    np.testing.assert_allclose(support["lost_mass"], 0.159, atol=0.02)
    np.testing.assert_allclose(support["failed_mass"], 0.159 / 0.841, atol=0.02)


def test_the_population_evaluated_last_is_not_computed_again() -> None:
    found = bound(prb.Resimulated(64), response)
    found.discrepancies(at([1.0], [1.0]), found.target)
    count = found.responses.count
    found.missing(at([1.0], [1.0]))
    assert found.responses.count == count
    # At invalid parameters there is no population.
    found.discrepancies(at([1.0], [-1.0]), found.target)
    assert found.missing(at([1.0], [-1.0])).lost == [1.0]
