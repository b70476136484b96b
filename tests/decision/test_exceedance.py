"""Probabilities of exceedance beside closed forms: common, rare, and with intervals."""

import logging
import re
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest
from decisions import doubled, jeffreys, normal, posterior, same
from one_input import posterior_of
from scipy.special import ndtr, ndtri

import prbayes as prb
from prbayes._finding import from_json
from prbayes._validate import Floats
from prbayes.decision.exceedance import rare_event, weighted_share
from prbayes.decision.populations import (
    InverseTransform,
    probability_bounds,
    share_error,
)
from prbayes.decision.quantities import extreme_places, interval_grid
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
    table = ask(2.8, n_points=2000, n_draws=2000)
    expected, interval = exact(2.8)
    assert expected < 2e-4
    assert abs(float(table.probability) - expected) < 4 * float(table.error)
    assert float(table.error) < 0.1 * expected
    np.testing.assert_allclose([table.lower, table.upper], interval, rtol=0.2)
    assert (table.attrs["responses"], table.attrs["source"]) == (2000, "importance points")
    # The error includes that draws are few.
    few = ask(2.8, n_points=2000, n_draws=50)
    scatter = float(few.by_draw.std(ddof=1)) / np.sqrt(50)
    assert float(few.error) > scatter > 2 * float(table.error)
    assert abs(float(few.probability) - expected) < 3 * float(few.error)


def test_a_requirement_is_met_or_not_or_not_decided() -> None:
    table = ask(2.0)
    assert "verdict" not in table.attrs
    low, high, error = float(table.lower), float(table.upper), float(table.error)
    for requirement, verdict in (
        (high + 2.3 * error, "met"),
        (max(low - 2 * error, 1e-9), "not met"),
        (high + 1.5 * error, "not decided"),
        (high - error, "not decided"),
    ):
        attributes = ask(2.0, requirement=requirement, n_points=0).attrs
        assert (attributes["requirement"], attributes["verdict"]) == (requirement, verdict)


@pytest.mark.parametrize("points", [0, 500])
def test_below_is_above_of_the_opposite_and_of_one_of_several_outputs(points: int) -> None:
    below = ask(0.2, below=True, n_points=points)
    above = ask(-0.2, lambda x: np.stack([-x, x], axis=-1), output=0, n_points=points)
    np.testing.assert_allclose(below.by_draw, above.by_draw, rtol=1e-9)


def test_the_error_of_equal_points_is_that_of_their_blocks_means() -> None:
    values, blocks = np.arange(64.0), np.arange(64) % 8
    sample: Any = SimpleNamespace(
        values=values,
        blocks=blocks,
        mean_weights=np.full(64, 1 / 64),
        emulated=lambda points: [],
        points=[],
    )
    error = share_error(sample, lambda y: y[:, None] > np.array([42.0, -1.0, 64.0]))
    means = [(values[blocks == b] > 42).mean() for b in range(8)]
    # Of all points, and of none: one over their number.
    np.testing.assert_allclose(error, [np.std(means, ddof=1) / np.sqrt(8), 1 / 64, 1 / 64])


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
    by_points = ask(1.5, shifted, interval, n_points=1000, steps=2)
    np.testing.assert_allclose(by_points.probability, ends, rtol=0.2)
    assert by_points.attrs["at"] == ["-0.5", "0.5"]


INSIDE: dict[str, Any] = {
    "narrow": lambda x, k: x / (1 + ((k - 0.37) / 0.05) ** 2),
    "parabola": lambda x, k: x * (1 - 8 * (k - 0.37) ** 2),
    "several": lambda x, k: x * np.sin(20 * k),
    "valley": lambda x, k: x - 9 + 9 * np.abs(k - 0.63),
    "two inputs": lambda x, k, j: x - 4 * (k - 0.37) ** 2 - 4 * (j - 0.81) ** 2,
}


@pytest.mark.parametrize("case", INSIDE)
@pytest.mark.parametrize("below", [False, True])
def test_the_worst_place_inside_an_interval_is_found(case: str, below: bool) -> None:
    """The extreme response of a specimen of one is that of a dense grid, above as below."""
    d = 2 if case == "two inputs" else 1
    inputs = [0.0, *[prb.decision.Interval(0.0, 1.0)] * d]
    axis = np.linspace(0, 1, 501)
    dense = INSIDE[case](1.0, *np.meshgrid(*[axis] * d))
    specimens = 1 + 0.1 * np.linspace(-1, 1, 8)
    sign = -1.0 if below else 1.0
    limit = float(dense.max())
    grid = interval_grid(inputs, 5)
    places = grid + extreme_places(
        inputs, grid, lambda place: sign * INSIDE[case](specimens, *place[1:]), [sign * limit]
    )
    best = max(float(INSIDE[case](1.0, *place[1:])) for place in places)
    assert best == pytest.approx(limit, abs=0.01 * np.ptp(dense))


def test_a_bound_inside_an_interval_is_that_of_its_place() -> None:
    def narrow(x: Any, k: Any) -> Any:
        return x / (1 + ((k - 0.37) / 0.05) ** 2)

    table = ask(1.5, narrow, prb.decision.Interval(0.0, 1.0))
    assert float(table.probability[1]) == pytest.approx(float(ask(1.5).probability), rel=0.02)
    assert float(table.attrs["at"][1]) == pytest.approx(0.37, abs=0.003)


def test_a_population_without_stored_responses_takes_points() -> None:
    observed = np.random.default_rng(1).normal(1.0, 0.5, 50)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        given: Any = {"metric": prb.AreaMetric(), "propagation": prb.Resimulated(64)}
        prb.Simulator("y", same, x, observed=observed, **given)
    table = prb.exceedance(posterior(), same, 2.5, x, model=model, n_points=1000)
    assert float(table.probability) == pytest.approx(exact(2.5)[0], rel=0.3)
    with pytest.raises(TypeError, match=r"without stored responses.*n_points=1000"):
        prb.exceedance(posterior(), same, 2.5, x, model=model)
    with pytest.raises(TypeError, match="got a model variable as an input"):
        prb.exceedance(posterior(), shifted, 2.5, x, model["mu"], model=model, n_points=100)


def test_points_are_refused_where_the_support_moves() -> None:
    observed = np.random.default_rng(1).uniform(0, 3, 40)
    with pm.Model() as model:
        x = pm.Uniform.dist(0.0, pm.HalfNormal("end", 5))
        prb.Simulator("y", same, x, observed=observed)
    ends = np.random.default_rng(2).normal(3.0, 0.1, (1, 500))
    result = posterior_of(end=ends)
    # The central population ends at 3: its points have no response above 3, unlike the others.
    with pytest.raises(TypeError, match=r"support moves .* leave n_points= out"):
        prb.exceedance(result, same, 3.05, x, model=model, n_points=500)
    table = prb.exceedance(result, same, 3.05, x, model=model)
    expected = float(np.maximum(1 - 3.05 / ends, 0).mean())
    assert abs(float(table.probability) - expected) < 3 * float(table.error)


def narrow_prior() -> tuple[pm.Model, Any, Any]:
    """Return a model of eight specimens whose runs end at 3.2, and draws."""
    observed = np.random.default_rng(3).normal(0.0, 1.0, 8)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", same, x, observed=observed)
    return model, x, jeffreys(observed, 1000)


def test_a_limit_beyond_the_range_of_the_runs_is_not_decided() -> None:
    model, x, result = narrow_prior()
    draws = result["posterior"]
    by_draw = ndtr((draws["mu"].values - 4.5) / draws["sigma"].values)
    table = prb.exceedance(result, same, 4.5, x, model=model, requirement=0.003)
    assert float(table.probability) == 0
    assert by_draw.mean() < 4 * float(table.error)
    assert (np.quantile(by_draw, 0.945) > 0.003, table.attrs["verdict"]) == (True, "not decided")


def test_a_response_that_the_emulator_does_not_follow_is_reported() -> None:
    model, x, result = narrow_prior()

    def waves(x: Any) -> Any:
        return np.sin(20 * x)

    quantity = prb.decision.Quantile(waves, x, probability=0.1)
    tables = [
        prb.predict(result, waves, x, model=model, n_draws=50, n_samples=200),
        prb.exceedance(result, waves, 0.5, x, model=model),
        prb.decision.p_box(result, waves, x, model=model),
        prb.decision.evaluate(result, quantity, model=model),
    ]
    for table in tables:
        findings = from_json(table.attrs["findings"])
        assert "rough-prediction" in [finding.code for finding in findings]
        # More responses to the propagation would not improve an emulator.
        assert not any("to the propagation" in finding.text for finding in findings)
    computed = prb.exceedance(result, waves, 0.5, x, model=model, n_points=1000)
    codes = [finding.code for finding in from_json(computed.attrs["findings"])]
    assert "rough-prediction" not in codes


@pytest.mark.long
def test_quantiles_beyond_the_range_of_the_runs_are_reported() -> None:
    model, x, result = narrow_prior()
    draws = result["posterior"]
    # The stated error is far larger than the posterior's standard deviation as well.
    for probability, codes in ((0.8, []), (0.9999, ["beyond-runs", "rough-probability"])):
        quantity = prb.decision.Quantile(same, x, probability=probability)
        table = prb.decision.evaluate(result, quantity, model=model)
        expected = (draws["mu"] + ndtri(probability) * draws["sigma"]).mean()
        assert abs(float(table.estimate - expected)) < 2 * float(table.error)
        assert [finding.code for finding in from_json(table.attrs["findings"])] == codes
    condition = prb.decision.Condition(same, x)
    bounds = prb.population(result, condition, model=model, upper=True)
    (finding,) = from_json(bounds.attrs["findings"])
    assert finding.code == "beyond-runs"


def test_uncertain_probabilities_are_reported(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, logger="prbayes"):
        table = ask(9.0, lambda x: np.minimum(x, 5.0))
    assert float(table.probability) == 0
    assert float(table.error) > 0
    assert "pass n_points=1000" in caplog.text
    with pytest.raises(prb.propagation.DesignError, match="lost mass"):
        ask(2.0, lambda x: np.where(x < 1, np.nan, x), n_points=200)


@pytest.mark.parametrize(("points", "seeds"), [(0, 1), (4000, 3)])
def test_specimens_without_response_are_left_out_and_reported(points: int, seeds: int) -> None:
    at = float((MU - 1.8 * SIGMA).mean())
    lost = float(ndtr((at - MU) / SIGMA).mean())  # .038

    def weakest_lost(x: Any) -> Any:
        return np.where(x < at, np.nan, x)

    tables = [
        ask(float(MU.mean()), weakest_lost, n_points=points, below=below, random_seed=seed)
        for seed in range(seeds)
        for below in (False, True)
    ]
    total = sum(float(table.probability) for table in tables) / seeds
    # Five standard errors of three sums by importance points; the errors of stored ones cancel.
    assert total == pytest.approx(1.0, abs=0.028 if points else 1e-9)
    for table in tables:
        (finding,) = from_json(table.attrs["findings"])
        assert finding.code == "specimens-left-out"
        percent = float(re.findall(r"([\d.]+)% of specimens have no", finding.text)[0])
        assert percent == pytest.approx(100 * lost, rel=0.5)
        # The specimens without response are within the limit, or all beyond it.
        low, high = np.nanquantile(table.by_draw, [0.055, 0.945])
        share = percent / 100
        assert float(table.lower) == pytest.approx(low * (1 - share), rel=1e-3)
        assert float(table.upper) == pytest.approx(high * (1 - share) + share, rel=1e-3)


def test_a_requirement_counts_specimens_without_response() -> None:
    at = float((MU + 1.8 * SIGMA).mean())  # 3.8 % of the specimens are above
    answers = {
        response: ask(at, response, requirement=0.02, n_points=0).attrs["verdict"]
        for response in (lambda x: np.where(x > at, np.nan, x), lambda x: np.minimum(x, at))
    }
    assert list(answers.values()) == ["not decided", "met"]


def test_probabilities_stay_between_zero_and_one() -> None:
    for limit, probability in ((-50.0, 1.0), (50.0, 0.0)):
        for options in ({}, {"n_points": 200}, {"n_points": 200, "below": True}, {"below": True}):
            table = ask(limit, **options)
            expected = 1 - probability if options.get("below") else probability
            assert (table.by_draw == expected).all()
            low, high = float(table.lower), float(table.upper)
            assert 0 <= low <= expected <= high <= 1
            # The bound of the points that were seen.
            assert high - low == pytest.approx(-np.log(0.055) * float(table.error))
            assert float(table.error) > 0


def test_a_requirement_takes_points_near_the_limit_where_the_error_matters() -> None:
    # No stored response is above 12: the requirement is not decided by them.
    stored = ask(12.0, requirement=1e-3, n_points=0)
    assert (float(stored.probability), stored.attrs["verdict"]) == (0.0, "not decided")
    assert stored.upper > 1e-3
    (finding,) = from_json(stored.attrs["findings"])
    assert finding.code == "rough-probability"
    assert all("n_points=" in text for text in (finding.text, prb.help(finding.code)))
    decided = ask(12.0, requirement=1e-3)
    assert (decided.attrs["verdict"], decided.attrs["source"]) == ("met", "importance points")
    assert exact(12.0)[1][1] < float(decided.upper) < 1e-6
    # Nor is one within two errors of the interval, and one far from it costs no response.
    table = ask(3.2, n_points=0)
    near, far = float(table.upper + table.error), float(100 * table.upper)
    assert ask(3.2, requirement=near, n_points=0).attrs["verdict"] == "not decided"
    assert ask(3.2, requirement=near).attrs["source"] == "importance points"
    enough = ask(3.2, requirement=far)
    assert (enough.attrs["verdict"], enough.attrs["responses"]) == ("met", 0)


def test_bounds_are_those_of_poisson_counts() -> None:
    # None of 100: the rule of three. Of one event, and of 100: Garwood (1936), table of chi2.
    tail = 0.025
    p, error = np.array([0.0, 0.01, 0.5, 0.99, 1.0]), np.array([0.01, 0.01, 1e-9, 0.01, 0.01])
    low, high = probability_bounds(p, error, tail)
    np.testing.assert_allclose(high[:2], [0.01 * -np.log(tail), 0.01 * 5.572], rtol=1e-3)
    np.testing.assert_allclose(low[:2], [0.0, 0.01 * 0.02532], rtol=1e-3)
    np.testing.assert_allclose([low[3:], high[3:]], [1 - high[1::-1], 1 - low[1::-1]])
    np.testing.assert_allclose(high[2] - 0.5, 1.96e-9, rtol=1e-3)
    many, _ = probability_bounds(0.1, 0.001, tail)
    assert many == pytest.approx(0.1 - 1.96 * 0.001, abs=2e-5)


def test_shares_of_weighted_points_sum_to_one() -> None:
    rng = np.random.default_rng(0)
    weights = rng.exponential(size=(3, 500))
    counts = rng.random(500) < 0.2
    shares, error = weighted_share(weights, counts)
    np.testing.assert_allclose(shares + weighted_share(weights, ~counts)[0], 1.0)
    assert error < (weights[0] * counts).std() / np.sqrt(500)
    everything, bound = weighted_share(weights, np.ones(500, dtype=bool))
    assert (everything == 1).all()
    assert 1 / bound == pytest.approx(weights[0].sum() ** 2 / (weights[0] ** 2).sum())


# -- rare events -----------------------------------------------------------------------------------

SEEDS = 8


def rare_events(
    size: int, respond: Callable[[Floats], Any], limit: float, mu: Any = (0.0,), seeds: int = SEEDS
) -> tuple[Floats, Floats, Floats]:
    """Return probabilities of responses of independent normal inputs, errors and lost mass, by seed."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu") * np.ones(size), 1.0)
    transform = InverseTransform("f", read_inputs("f", [x], model), [np.zeros(1)])
    roots = [np.asarray(mu, dtype=float)]
    events = [
        rare_event(transform, roots, respond, limit, 1000, np.random.default_rng(seed))
        for seed in range(seeds)
    ]
    columns = [[event.by_draw, event.error, event.lost] for event in events]
    by_draw, error, lost = (np.array(column) for column in zip(*columns, strict=True))
    return by_draw, error, lost


def unequal_sides(z: Floats) -> Any:
    return np.maximum(z[:, 0], 3 * (-z[:, 0] - 2.6))


def jump(z: Floats) -> Any:
    return np.where(z[:, 0] < -4, 9.0, z[:, 0])


UNEQUAL = float(ndtr(-4.5) + ndtr(-4.1))
CASES: dict[str, tuple[int, Callable[[Floats], Any], float, float]] = {
    "one": (1, lambda z: z[:, 0], ndtri(1 - 1e-5), 1e-5),
    "ten": (10, lambda z: z.sum(axis=1) / np.sqrt(10), ndtri(1 - 1e-4), 1e-4),
    "common": (2, lambda z: z[:, 0] + z[:, 1], 0.0, 0.5),
    "of another size": (1, lambda z: 1e6 + 3e-3 * z[:, 0], 1e6 + 3e-3 * ndtri(1 - 1e-4), 1e-4),
    "unequal sides": (1, unequal_sides, 4.5, UNEQUAL),
    "a jump on one side": (2, jump, 4.5, float(ndtr(-4.5) + ndtr(-4))),
    "two directions": (2, lambda z: np.maximum(z[:, 0], 3 * (z[:, 1] - 2.6)), 4.5, UNEQUAL),
    "ring": (2, lambda z: (z**2).sum(axis=1), 20.0, np.exp(-10.0)),
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


def test_no_region_is_left_out_beside_inputs_of_no_effect() -> None:
    by_draw, errors, _ = rare_events(5, jump, 4.5)
    expected = ndtr(-4.5) + ndtr(-4)
    is_wrong = by_draw[:, 0] + 4 * errors < expected
    assert is_wrong.sum() <= 1
    assert by_draw.mean() == pytest.approx(expected, rel=0.2)


def test_the_error_sees_a_region_that_the_last_proposals_miss(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def on_one_side(parts: Any, wide: Any) -> Any:
        return [max(parts, key=lambda part: part.proposal.mean[0]).proposal]

    monkeypatch.setattr(sys.modules[rare_event.__module__], "_mixture", on_one_side)
    by_draw, errors, _ = rare_events(1, unequal_sides, 4.5, seeds=4)
    assert (by_draw < 0.3 * UNEQUAL).all()
    # The first points see it roughly; the last ones alone would have an error below .02.
    assert (errors > 0.1 * UNEQUAL).all()


def test_populations_share_their_points() -> None:
    mu = np.array([-0.5, 0.0, 0.5])
    by_draw, _, _ = rare_events(1, lambda z: z[:, 0], 4.0, mu)
    np.testing.assert_allclose(by_draw.mean(axis=0), ndtr(mu - 4.0), rtol=0.1)


def test_lost_mass_is_counted_and_an_unreached_limit_has_an_error() -> None:
    lossy = lambda z: np.where(z[:, 0] < 0, np.nan, z[:, 0])  # noqa: E731
    by_draw, _, lost = rare_events(1, lossy, 3.0, seeds=1)
    assert lost[0] == pytest.approx(0.5, abs=0.2)
    assert by_draw[0, 0] == pytest.approx(ndtr(-3.0), rel=0.3)
    by_draw, errors, _ = rare_events(1, lambda z: np.clip(z[:, 0], -1, 1), 2.0, seeds=4)
    assert (by_draw == 0).all()
    assert (errors > 0).all()
