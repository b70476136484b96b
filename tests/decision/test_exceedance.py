"""Probabilities of exceedance beside closed forms: common, rare, and with intervals."""

import logging
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest
from decisions import doubled, normal, posterior, same
from scipy.special import ndtr, ndtri

import prbayes as prb
from prbayes._validate import Floats
from prbayes.decision.exceedance import _jackknife_error, rare_event
from prbayes.decision.populations import InverseTransform
from prbayes.response.inputs import read_inputs

MU, SIGMA = (posterior().posterior[name].values[0] for name in ("mu", "sigma"))
THINNED = np.unique(np.linspace(0, 3999, 2000).round().astype(int))


def exact(limit: float, prob: float = 0.89) -> tuple[float, Any]:
    """Return the probability of a new specimen, and the interval over the posterior."""
    by_draw = ndtr((MU[THINNED] - limit) / SIGMA[THINNED])
    return float(by_draw.mean()), np.quantile(by_draw, [(1 - prob) / 2, (1 + prob) / 2])


def ask(limit: float, response: Any = same, *more: Any, n_draws: int = 200, **options: Any) -> Any:
    model, x = normal()
    options |= {"model": model, "n_draws": n_draws}
    return prb.exceedance(posterior(), response, limit, x, *more, **options)


def test_from_stored_responses() -> None:
    for limit in (1.0, 2.0):
        table = ask(limit, n_draws=2000)
        expected, interval = exact(limit)
        assert abs(float(table.probability) - expected) < 2 * float(table.error)
        assert float(table.error) < 0.12 * expected
        np.testing.assert_allclose([table.lower, table.upper], interval, rtol=0.1)
        assert table.attrs["responses"] == 0
    assert float(ask(4.0, doubled).probability) == pytest.approx(float(ask(2.0).probability))


def test_from_points_near_the_limit() -> None:
    table = ask(2.8, points=2000, n_draws=2000)
    expected, interval = exact(2.8)
    assert expected < 2e-4
    assert abs(float(table.probability) - expected) < 4 * float(table.error)
    assert float(table.error) < 0.1 * expected
    np.testing.assert_allclose([table.lower, table.upper], interval, rtol=0.2)
    assert (table.attrs["responses"], table.attrs["source"]) == (2000, "importance points")
    # The error includes that draws are few.
    few = ask(2.8, points=2000, n_draws=50)
    scatter = float(few.by_draw.std(ddof=1)) / np.sqrt(50)
    assert float(few.error) > scatter > 2 * float(table.error)
    assert abs(float(few.probability) - expected) < 3 * float(few.error)


def test_a_requirement_is_met_or_not_or_not_decided() -> None:
    table = ask(2.0)
    assert "verdict" not in table.attrs
    low, high = float(table.lower), float(table.upper)
    for requirement, verdict in (
        (1.01 * high, "met"),
        (0.99 * low, "not met"),
        (1.01 * low, "not decided"),
        (0.99 * high, "not decided"),
    ):
        attributes = ask(2.0, requirement=requirement).attrs
        assert (attributes["requirement"], attributes["verdict"]) == (requirement, verdict)
    with pytest.raises(ValueError, match="requirement"):
        ask(2.0, requirement=1.5)


@pytest.mark.parametrize("points", [0, 500])
def test_below_is_above_of_the_opposite_and_of_one_of_several_outputs(points: int) -> None:
    below = ask(0.2, below=True, points=points)
    above = ask(-0.2, lambda x: np.stack([-x, x], axis=-1), output=0, points=points)
    np.testing.assert_allclose(below.by_draw, above.by_draw, rtol=1e-9)


def test_the_error_of_equal_points_is_that_of_their_blocks_means() -> None:
    values, blocks = np.arange(64.0), np.arange(64) % 8
    weights = np.full(64, 1 / 64)
    sample: Any = SimpleNamespace(values=values, blocks=blocks, mean_weights=lambda: weights)
    quantity = prb.decision.Exceedance(same, normal()[1], limit=42.0)
    means = [(values[blocks == b] > 42).mean() for b in range(8)]
    expected = np.std(means, ddof=1) / np.sqrt(8)
    assert _jackknife_error(sample, quantity) == pytest.approx(expected)


def shifted(x: Any, by: Any) -> Any:
    return x + by


def test_an_interval_gives_bounds_and_no_distribution() -> None:
    interval = prb.decision.Interval(-0.5, 0.5)
    table = ask(1.5, shifted, interval)
    low, high = (ask(1.5, shifted, by) for by in (-0.5, 0.5))
    ends = [float(low.probability), float(high.probability)]
    np.testing.assert_allclose(table.probability, ends)
    assert table.attrs["at"] == ["-0.5", "0.5"]
    assert (float(table.lower), float(table.upper)) == (float(low.lower), float(high.upper))
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
    with pytest.raises(TypeError, match="without stored responses"):
        prb.exceedance(posterior(), same, 2.5, x, model=model)
    with pytest.raises(TypeError, match="got a model variable as an input"):
        prb.exceedance(posterior(), shifted, 2.5, x, model["mu"], model=model, points=100)


def test_uncertain_probabilities_are_reported(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, logger="prbayes"):
        table = ask(9.0, lambda x: np.minimum(x, 5.0))
    assert float(table.probability) == 0
    assert float(table.error) > 0
    assert "pass points=1000" in caplog.text
    with pytest.raises(prb.propagation.DesignError, match="lost mass"):
        ask(2.0, lambda x: np.where(x < 1, np.nan, x), points=200)


# -- rare events -----------------------------------------------------------------------------------

SEEDS = 12


def rare_events(
    size: int, respond: Callable[[Floats], Any], limit: float, mu: Any = (0.0,)
) -> tuple[Floats, Floats, Floats]:
    """Return probabilities of responses of independent normal inputs, errors and lost mass, by seed."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu") * np.ones(size), 1.0)
    transform = InverseTransform("f", read_inputs("f", [x], model), [np.zeros(1)])
    roots = [np.asarray(mu, dtype=float)]
    events = [
        rare_event(transform, roots, respond, limit, 1000, np.random.default_rng(seed))
        for seed in range(SEEDS)
    ]
    columns = [[event.by_draw, event.error, event.lost] for event in events]
    by_draw, error, lost = (np.array(column) for column in zip(*columns, strict=True))
    return by_draw, error, lost


CASES: dict[str, tuple[int, Callable[[Floats], Any], float, float]] = {
    "one": (1, lambda z: z[:, 0], ndtri(1 - 1e-5), 1e-5),
    "ten": (10, lambda z: z.sum(axis=1) / np.sqrt(10), ndtri(1 - 1e-4), 1e-4),
    "two sides": (1, lambda z: np.abs(z[:, 0]), ndtri(1 - 5e-5), 1e-4),
    "common": (2, lambda z: z[:, 0] + z[:, 1], 0.0, 0.5),
    "of another size": (1, lambda z: 1e6 + 3e-3 * z[:, 0], 1e6 + 3e-3 * ndtri(1 - 1e-4), 1e-4),
    "failed": (1, lambda z: np.where(z[:, 0] > 3.0, np.inf, z[:, 0]), 3.0, ndtr(-3.0)),
}


@pytest.mark.parametrize("case", CASES)
def test_probabilities_and_their_errors(case: str) -> None:
    size, respond, limit, expected = CASES[case]
    by_draw, errors, _ = rare_events(size, respond, limit)
    values = by_draw[:, 0]
    assert (errors < 0.25 * expected).all()
    # In units of the error: a standard deviation of one, known to 1 / sqrt(2 SEEDS).
    assert np.sqrt(np.mean(((values - expected) / errors) ** 2)) < 1 + 4 / np.sqrt(2 * SEEDS)
    assert abs(values.mean() - expected) < 4 * np.sqrt(np.mean(errors**2) / SEEDS)


def test_populations_share_their_points() -> None:
    mu = np.array([-0.5, 0.0, 0.5])
    by_draw, _, _ = rare_events(1, lambda z: z[:, 0], 4.0, mu)
    np.testing.assert_allclose(by_draw.mean(axis=0), ndtr(mu - 4.0), rtol=0.1)


def test_lost_mass_is_counted_and_an_unreached_limit_has_an_error() -> None:
    by_draw, _, lost = rare_events(1, lambda z: np.where(z[:, 0] < 0, np.nan, z[:, 0]), 3.0)
    assert lost[0] == pytest.approx(0.5, abs=0.2)
    assert by_draw[0, 0] == pytest.approx(ndtr(-3.0), rel=0.3)
    by_draw, errors, _ = rare_events(1, lambda z: np.clip(z[:, 0], -1, 1), 2.0)
    assert (by_draw == 0).all()
    assert (errors > 0).all()
