"""Probabilities of exceedance beside closed forms, with bounds where an input is an interval."""

import logging
from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest
from decisions import doubled, normal, posterior, same
from scipy.special import ndtr

import prbayes as prb
from prbayes.decision.exceedance import _jackknife_error

MU, SIGMA = (posterior().posterior[name].values[0] for name in ("mu", "sigma"))
THINNED = np.unique(np.linspace(0, 3999, 2000).round().astype(int))


def exact(limit: float, prob: float = 0.89) -> tuple[float, Any]:
    """Return the probability of a new specimen, and the interval over the posterior."""
    each = ndtr((MU[THINNED] - limit) / SIGMA[THINNED])
    return float(each.mean()), np.quantile(each, [(1 - prob) / 2, (1 + prob) / 2])


def ask(limit: float, response: Any = same, *more: Any, **given: Any) -> Any:
    model, x = normal()
    return prb.exceedance(posterior(), response, limit, x, *more, model=model, **given)


def test_from_stored_responses() -> None:
    for limit in (1.0, 2.0):
        table = ask(limit)
        expected, interval = exact(limit)
        assert abs(float(table.probability) - expected) < 2 * float(table.error)
        assert float(table.error) < 0.12 * expected
        np.testing.assert_allclose([table.lower, table.upper], interval, rtol=0.1)
        assert table.attrs["responses"] == 0
    assert float(ask(4.0, doubled).probability) == pytest.approx(float(ask(2.0).probability))


def test_from_points_where_it_matters() -> None:
    table = ask(2.8, points=2000)
    expected, interval = exact(2.8)
    assert expected < 2e-4
    assert abs(float(table.probability) - expected) < 4 * float(table.error)
    assert float(table.error) < 0.1 * expected
    np.testing.assert_allclose([table.lower, table.upper], interval, rtol=0.2)
    assert table.attrs["responses"] == 2000
    assert table.attrs["source"] == "importance points"


def test_the_error_counts_that_draws_are_few() -> None:
    few, many = (ask(2.8, points=2000, n_draws=draws) for draws in (50, 2000))
    scatter = float(few.by_draw.std(ddof=1)) / np.sqrt(50)
    assert float(few.error) > scatter > 2 * float(many.error)
    assert abs(float(few.probability) - exact(2.8)[0]) < 3 * float(few.error)


def test_a_requirement_is_met_or_not_or_not_decided() -> None:
    table = ask(2.0)
    assert "verdict" not in table.attrs
    low, high = float(table.lower), float(table.upper)
    for requirement, verdict in ((1.01 * high, "met"), (0.99 * low, "not met")):
        assert ask(2.0, requirement=requirement).attrs["verdict"] == verdict
    for requirement in (1.01 * low, 0.99 * high):
        assert ask(2.0, requirement=requirement).attrs["verdict"] == "not decided"
    assert ask(2.0, requirement=0.5).attrs["requirement"] == 0.5
    with pytest.raises(ValueError, match="requirement"):
        ask(2.0, requirement=1.5)


def test_below_is_above_of_the_opposite() -> None:
    for points in (0, 500):
        below = ask(0.2, below=True, points=points)
        above = ask(-0.2, lambda x: -x, points=points)
        np.testing.assert_allclose(below.by_draw, above.by_draw, rtol=1e-9)


def test_the_error_of_equal_points_is_that_of_their_blocks_means() -> None:
    values = np.arange(64.0)
    blocks = np.arange(64) % 8
    sample = SimpleNamespace(
        values=values,
        blocks=blocks,
        mean_weights=lambda: np.full(64, 1 / 64),
    )
    quantity = prb.decision.Exceedance(same, normal()[1], limit=42.0)
    means = [(values[blocks == b] > 42).mean() for b in range(8)]
    expected = np.std(means, ddof=1) / np.sqrt(8)
    assert _jackknife_error(sample, quantity) == pytest.approx(expected)  # type: ignore[arg-type]


def shifted(x: Any, by: Any) -> Any:
    return x + by


def test_an_interval_gives_bounds_and_no_distribution() -> None:
    interval = prb.decision.Interval(-0.5, 0.5)
    table = ask(1.5, shifted, interval)
    ends = [float(ask(1.5, shifted, by).probability) for by in (-0.5, 0.5)]
    np.testing.assert_allclose(table.probability, ends)
    assert table.attrs["at"] == ["-0.5", "0.5"]
    assert float(table.lower) == float(ask(1.5, shifted, -0.5).lower)
    assert float(table.upper) == float(ask(1.5, shifted, 0.5).upper)
    # An extreme inside is found at one of the places.
    inside = ask(1.5, lambda x, by: x - by**2, interval)
    assert inside.attrs["at"][1] == "0"
    by_points = ask(1.5, shifted, interval, points=1000, steps=2)
    np.testing.assert_allclose(by_points.probability, ends, rtol=0.2)
    assert by_points.attrs["responses"] == 2000


def test_a_population_without_stored_responses_takes_points() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        observed = np.random.default_rng(1).normal(1.0, 0.5, 50)
        propagation = prb.Resimulated(64)
        prb.Simulator(
            "y", same, x, metric=prb.AreaMetric(), observed=observed, propagation=propagation
        )
    table = prb.exceedance(posterior(), same, 2.5, x, model=model, points=1000)
    assert float(table.probability) == pytest.approx(exact(2.5)[0], rel=0.3)
    with pytest.raises(TypeError, match="has stored responses"):
        prb.exceedance(posterior(), same, 2.5, x, model=model)
    with pytest.raises(TypeError, match="got a model variable as an input"):
        prb.exceedance(posterior(), shifted, 2.5, x, model["mu"], model=model, points=100)


def test_what_is_hardly_known_is_said(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, logger="prbayes"):
        table = ask(9.0, lambda x: np.minimum(x, 5.0))
    assert float(table.probability) == 0
    assert float(table.error) > 0
    assert "pass points=1000" in caplog.text
    with pytest.raises(prb.propagation.DesignError, match="lost mass"):
        ask(2.0, lambda x: np.where(x < 1, np.nan, x), points=200)


def test_several_outputs() -> None:
    def both(x: Any) -> Any:
        return np.stack([x, -x], axis=-1)

    for points in (0, 300):
        first = ask(2.0, both, output=0, points=points)
        np.testing.assert_allclose(first.by_draw, ask(2.0, points=points).by_draw)
