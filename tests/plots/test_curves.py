"""Numbers behind the pictures, against closed forms."""

from dataclasses import replace
from functools import cache

import numpy as np
import pymc as pm
import pytest
from scipy import stats

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.plots import _curves as curves
from prbayes.plots._ensemble import read_before, read_result, supported
from prbayes.plots._grid import elements, landscape, rooted
from prbayes.plots._margins import chosen, margin_densities, margins
from prbayes.propagation.base import Propagation

QUANTILES = stats.norm.ppf((np.arange(1000) + 0.5) / 1000)
EQUAL = np.full(1000, 1e-3)
GRID = np.linspace(-5, 9, 301)


# -- densities -------------------------------------------------------------------------------------------


def test_a_weighted_density_is_that_of_the_target() -> None:
    """Values of N(0, 2) with weights of N(1, 1) over N(0, 2): smoothed, the density of N(1, sqrt(1 + h^2))."""
    x = 2 * QUANTILES
    w = stats.norm.pdf(x, 1, 1) / stats.norm.pdf(x, 0, 2)
    w /= w.sum()
    found = curves.densities(x, w, GRID, 0.3)
    np.testing.assert_allclose(found, stats.norm.pdf(GRID, 1, np.hypot(1, 0.3)), atol=2e-3)
    assert np.trapezoid(found, GRID) == pytest.approx(1, abs=1e-3)


def test_what_is_not_finite_is_missing_from_the_area() -> None:
    x = QUANTILES.copy()
    x[:100], x[-50:] = np.inf, np.nan
    assert np.trapezoid(curves.densities(x, EQUAL, GRID, 0.2), GRID) == pytest.approx(0.85, abs=2e-3)
    found = curves.distribution_functions(x[None], EQUAL[None], np.array([-9.0, 9.0]))
    np.testing.assert_allclose(found, [[0, 0.85]], atol=1e-12)


def test_rows_have_their_own_weights_and_values() -> None:
    mixed = np.random.default_rng(1).permutation(QUANTILES)
    shared = np.broadcast_to(mixed, (2, 1000))
    tilted = np.exp(0.7 * mixed)
    weights = np.stack([EQUAL, tilted / tilted.sum()])
    expected = stats.norm.cdf(GRID - np.array([[0], [0.7]]))
    np.testing.assert_allclose(curves.distribution_functions(shared, weights, GRID), expected, atol=6e-3)
    own = np.stack([QUANTILES, QUANTILES[::-1] + 0.7])
    np.testing.assert_allclose(curves.distribution_functions(own, np.stack([EQUAL, EQUAL]), GRID), expected, atol=2e-3)
    both = curves.densities(own, np.stack([EQUAL, EQUAL]), GRID, 0.1)
    np.testing.assert_allclose(both, stats.norm.pdf(GRID, [[0], [0.7]], np.hypot(1, 0.1)), atol=4e-3)


def test_the_bandwidth_is_silvermans_of_the_effective_number() -> None:
    weights = np.where(np.arange(1000) % 2, 2e-3, 0.0)
    expected = 0.9 * 1000**-0.2, 0.9 * 500**-0.2
    found = [curves.typical_bandwidth(QUANTILES, w[None]) for w in (EQUAL, weights)]
    np.testing.assert_allclose(found, expected, rtol=0.02)
    with_inf = np.append(QUANTILES, [np.inf, np.nan])
    assert curves.typical_bandwidth(with_inf, np.full((3, 1002), 1 / 1002)) == pytest.approx(expected[0], rel=0.02)


def test_a_density_does_not_dip_at_a_bound() -> None:
    draws = np.abs(QUANTILES)
    found = curves.bounded_density(draws, np.array([-0.1, 0.01, 0.5, 1.0]))
    np.testing.assert_allclose(found, [0, *(2 * stats.norm.pdf([0.01, 0.5, 1.0]))], atol=0.03)


def test_the_band_has_the_quantiles_of_the_level() -> None:
    rows = np.arange(101.0)[:, None] * np.array([1.0, -2.0])
    low, high = curves.pointwise_band(rows, 0.9)
    np.testing.assert_allclose([low, high], [[5, -190], [95, -10]])


def test_ranges_are_quantiles_of_most_samples() -> None:
    rows = np.stack([QUANTILES + k for k in range(11)])
    found = curves.central_range(rows, np.full(rows.shape, 1e-3), 0.05)
    np.testing.assert_allclose(found, [1 - 1.645, 9 + 1.645], atol=0.02)


# -- data ------------------------------------------------------------------------------------------------


def test_the_histogram_has_the_area_of_what_is_finite() -> None:
    data = np.array([0.0, 0.1, 0.2, 0.9, 1.0, np.inf])
    x, y = curves.histogram(data, np.full(6, 1 / 6))
    assert np.trapezoid(y, x) == pytest.approx(5 / 6)
    assert x.min() == 0
    assert x.max() == 1
    np.testing.assert_allclose(y[1::4] * np.diff(x)[1::4], [2 / 6, 1 / 6, 0, 0, 2 / 6], atol=1e-12)
    x, y = curves.histogram(np.array([3.0, 3.0]), np.full(2, 0.5))
    assert np.trapezoid(y, x) == pytest.approx(1)
    assert x.mean() == pytest.approx(3)


def test_the_staircase_goes_up_by_the_weight_at_each_value() -> None:
    x, y = curves.staircase(np.array([2.0, 1.0, np.inf]), np.array([0.5, 0.2, 0.3]), 0.0, 4.0)
    np.testing.assert_allclose(x, [0, 1, 1, 2, 2, 4])
    np.testing.assert_allclose(y, [0, 0, 0.2, 0.2, 0.7, 0.7])


# -- ticks -----------------------------------------------------------------------------------------------


def test_ticks_are_few_and_round() -> None:
    assert curves.round_ticks(1.06, 1.22)[1] == ["1.1", "1.15", "1.2"]
    assert curves.round_ticks(-1.0, 1.0)[1] == ["-1", "-0.5", "0", "0.5", "1"]
    for low, high in ((0.0, 13.0), (1e-6, 3e-6), (-3.0, 1e5)):
        at, labels = curves.round_ticks(low, high)
        assert 2 <= len(at) <= 6
        np.testing.assert_allclose(at, [float(text) for text in labels], rtol=1e-9)


def test_ticks_of_logarithms_stand_where_their_labels_say() -> None:
    for values in (np.array([0.011, 0.4]), np.array([1e-9, 1.0]), np.array([3.0, 70.0, np.nan])):
        assert curves.spans_decades(values)
        at, labels = curves.log_ticks(values)
        assert 2 <= len(at) <= 7
        np.testing.assert_allclose(10 ** np.array(at), [float(text) for text in labels])
    assert not curves.spans_decades(np.array([0.1, 0.5]))
    assert not curves.spans_decades(np.array([-1.0, 5.0]))


# -- inputs ----------------------------------------------------------------------------------------------


def two_inputs(propagation: Propagation) -> tuple[pm.Model, list[object]]:
    def first(load: np.ndarray, gap: np.ndarray, factor: float) -> np.ndarray:
        return load[..., 0] * factor + gap + 0 * load[..., 1]

    rng = np.random.default_rng(1)
    with pm.Model() as model:
        mu, size = pm.Normal("mu", [1.0, 3.0], 1.0, shape=2), pm.HalfNormal("size", 1.0)
        load = pm.MvNormal.dist(mu, np.array([[0.04, 0.05], [0.05, 0.25]]))
        gap = pm.Gamma.dist(4.0, 4.0 / size)
        observed = rng.normal(3, 0.5, 20)
        prb.Simulator(
            "first", first, load, gap, 2.0, metric=prb.AreaMetric(), observed=observed, propagation=propagation
        )
        prb.Simulator(
            "second", lambda gap: gap**2, gap, metric=prb.AreaMetric(), observed=observed, propagation=propagation
        )
    return model, [load, gap]


def test_margins_are_the_closed_forms_and_named_as_the_response_names_them() -> None:
    model, (load, gap) = two_inputs(prb.Resimulated(64))
    evaluator = Evaluator(model)
    known = margins(evaluator)
    assert [m.name for m in known] == ["load[0]", "load[1]", "gap"]
    assert chosen(known, ["gap"]) == chosen(known, [gap]) == known[2:]
    assert chosen(known, "load") == chosen(known, [load]) == known[:2]
    with pytest.raises(KeyError, match=r"got nothing, expected some of \['load\[0\]'"):
        chosen(known, ["nothing"])
    thetas = np.array([evaluator.unconstrained({"mu": m, "size": s}) for m, s in (([1, 3], 1.0), ([1.2, 2.5], 1.5))])
    before = evaluator.n_responses
    found = margin_densities(evaluator, known, thetas)
    assert evaluator.n_responses == before
    exact = {
        "load[0]": lambda x: stats.norm.pdf(x, [[1], [1.2]], 0.2),
        "load[1]": lambda x: stats.norm.pdf(x, [[3], [2.5]], 0.5),
        "gap": lambda x: stats.gamma.pdf(x, 4, scale=np.array([[1], [1.5]]) / 4),
    }
    for name, (grid, y) in found.items():
        np.testing.assert_allclose(y, exact[name](grid), atol=1e-9)
        assert (np.trapezoid(y, grid) > 0.98).all()


def test_margins_without_a_density_of_their_own_are_drawn() -> None:
    with pm.Model() as model:
        mu = pm.HalfNormal("mu", 5.0)
        mean = pm.Normal.dist(mu, 0.6)
        x = pm.Normal.dist(mean, 0.8)
        n = pm.Poisson.dist(mu)
        prb.Simulator(
            "y",
            lambda x, n: x + n,
            x,
            n,
            metric=prb.AreaMetric(),
            observed=np.arange(9.0),
            propagation=prb.Fresh(50),
        )
    evaluator = Evaluator(model)
    found = margin_densities(evaluator, margins(evaluator), evaluator.unconstrained({"mu": 3.0})[None])
    grid, y = found["x"]
    np.testing.assert_allclose(y[0], stats.norm.pdf(grid, 3, 1), atol=0.06)
    grid, y = found["n"]
    np.testing.assert_array_equal(grid, np.round(grid))
    np.testing.assert_allclose(y[0], stats.poisson.pmf(grid, 3), atol=0.04)


# -- results ---------------------------------------------------------------------------------------------


@cache
def normal_model(propagation: Propagation) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 2))
        observed = 1 + 0.5 * stats.norm.ppf((np.arange(30) + 0.5) / 30)
        prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=observed, propagation=propagation)
    return model


@cache
def normal_optimum() -> prb.Optimum:
    return prb.minimize(normal_model(prb.Reweighted(512)))


def test_an_optimum_stands_for_its_sampling_distribution() -> None:
    optimum = normal_optimum()
    shown = read_result(optimum, None, "test", 200)
    np.testing.assert_array_equal(shown.center, optimum.theta[None])
    assert len(shown.thetas) > 190
    np.testing.assert_allclose(np.cov(shown.thetas.T), optimum.covariance, rtol=0.4, atol=2e-3)
    np.testing.assert_allclose(shown.thetas.mean(axis=0), optimum.theta, atol=0.03)


def test_before_is_what_it_says() -> None:
    optimum = normal_optimum()
    model = optimum.model
    evaluator = optimum.evaluator
    theta, text = read_before(optimum, evaluator, None)
    np.testing.assert_array_equal(theta[0], evaluator.initial)
    assert text == "prior's initial point"
    started = prb.minimize(model, start={"mu": -1.0, "sigma": 1.5})
    theta, text = read_before(started, evaluator, None)
    np.testing.assert_allclose(theta[0], [-1, np.log(1.5)])
    assert text == "optimiser's first point"
    theta, text = read_before(optimum, evaluator, {"mu": 2.0, "sigma": 1.0})
    np.testing.assert_allclose(theta, [[2, 0]])
    assert len(read_before(optimum, evaluator, False)[0]) == 0
    with pytest.raises(TypeError, match="before: got float, expected a dict"):
        read_before(optimum, evaluator, 3.0)  # type: ignore[arg-type]


def test_what_the_design_does_not_reach_is_not_supported() -> None:
    evaluator = normal_optimum().evaluator
    thetas = np.array([[1.0, -0.7], [60.0, -0.7], [np.nan, 0.0], [1.0, -9.0]])
    np.testing.assert_array_equal(supported(evaluator, thetas), [True, False, False, False])
    everywhere = supported(Evaluator(normal_model(prb.Resimulated(64))), thetas)
    np.testing.assert_array_equal(everywhere, [True, True, False, True])


def test_the_landscape_has_the_objective_at_its_places() -> None:
    optimum = normal_optimum()
    evaluator = optimum.evaluator
    before = evaluator.n_responses
    found = landscape(optimum, evaluator, ["sigma", "mu"], 9)
    assert evaluator.n_responses == before
    s, m = found.axes
    for i, j in ((4, 4), (2, 7), (7, 3)):
        theta = evaluator.unconstrained({"mu": m[j], "sigma": s[i]})
        assert found.heights[i, j] == pytest.approx(evaluator(theta[None]).discrepancies[0, 0])
    np.testing.assert_allclose(found.optimum, [[optimum.point["sigma"], optimum.point["mu"]]])
    np.testing.assert_allclose(found.path[:, 1], optimum.trace["theta"][:, 0])
    assert s[0] > 0
    assert s[0] < optimum.point["sigma"] - 2 * optimum.stderr["sigma"]
    assert np.nanmin(found.heights) >= optimum.discrepancy - 1e-9
    (only,) = landscape(optimum, evaluator, ["mu"], 9).axes
    np.testing.assert_allclose(only, m)
    assert list(elements(evaluator, optimum.theta[None])) == ["mu", "sigma"]


def test_the_landscape_is_blank_where_the_design_does_not_reach() -> None:
    wide = replace(normal_optimum(), stderr={"mu": 0.1, "sigma": 0.12})
    found = landscape(wide, wide.evaluator, ["mu", "sigma"], 9)
    m, s = found.axes
    thetas = np.array([[x, np.log(y)] for x in m for y in s])
    ess = wide.evaluator.support(thetas)["y"]["weight_ess"].reshape(9, 9)
    assert 0 < np.isnan(found.heights).sum() < 40
    assert np.isnan(found.heights[ess < 10]).all()
    assert np.isfinite(found.heights[ess > 40]).all()


def test_roots_of_heights_are_even_around_a_parabola() -> None:
    x = np.linspace(-2, 2, 41)
    roots, low, high = rooted(3 + x**2)
    assert low == pytest.approx(3)
    np.testing.assert_allclose(roots, np.abs(x) / np.sqrt(high - low), atol=1e-12)
