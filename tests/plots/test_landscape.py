"""The landscape has the right height at the right place; the objective, its name, its refusals."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from scipy import stats

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.plots.landscape import (
    check_optimum,
    distinct_texts,
    free_elements,
    landscape,
    objective,
    objective_label,
    rooted,
)

QUANTILES = stats.norm.ppf((np.arange(30) + 0.5) / 30)


def test_the_landscape_is_not_turned_over(optimum: prb.Optimum, read: SimpleNamespace) -> None:
    pc = prb.plot_landscape(optimum, points=31)
    trace, point = optimum.search.trace["theta"], optimum.point
    np.testing.assert_allclose(read.xy(pc, "path", "landscape"), [trace[:, 0], np.exp(trace[:, 1])])
    np.testing.assert_allclose(
        read.xy(pc, "optimum", "landscape")[:, 0], [point["mu"], point["sigma"]]
    )
    axis = pc.viz["plot"]["landscape"].item()
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("mu", "sigma")
    layers = read.artist(pc, "landscape", "landscape")
    evaluator = optimum.evaluator
    (x0, x1), (y0, y1) = axis.get_xlim(), axis.get_ylim()
    places = np.array(
        [
            [x0 + u * (x1 - x0), y0 + v * (y1 - y0)]
            for u in (0.1, 0.3, 0.5, 0.62)
            for v in (0.2, 0.45, 0.9)
        ]
    )
    thetas = np.column_stack([places[:, 0], np.log(places[:, 1])])
    heights = evaluator(thetas).discrepancies[:, 0]
    layer = [
        next((i for i, p in enumerate(layers.get_paths()) if p.contains_point(xy_)), 99)
        for xy_ in places
    ]
    order = np.argsort(heights)
    assert (np.diff(np.array(layer)[order]) >= 0).all()
    assert len(set(layer)) > 3


def test_a_curve_over_one_hyperparameter(
    optimum: prb.Optimum, read: SimpleNamespace, drawn: Callable[..., Any]
) -> None:
    pc = drawn("curve")
    x, y = read.xy(pc, "landscape", "landscape")
    thetas = np.column_stack([np.full(x.size, optimum.theta[0]), np.log(x)])
    np.testing.assert_allclose(y, optimum.evaluator(thetas).discrepancies[:, 0])
    assert pc.viz["plot"]["landscape"].item().get_title() == "mu fixed at the optimum"
    np.testing.assert_allclose(read.xy(pc, "optimum", "landscape")[0], optimum.point["sigma"])
    assert "asked" not in pc.viz


def test_other_optima_are_marked(read: SimpleNamespace) -> None:
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.3)
        prb.Simulator(
            "y", np.square, x, metric=prb.AreaMetric(), observed=(1 + 0.3 * QUANTILES) ** 2
        )
        found = prb.minimize()
    pc = prb.plot_landscape(found)
    assert (
        abs(
            read.xy(pc, "local_optima", "landscape")[0] + read.xy(pc, "optimum", "landscape")[0]
        ).min()
        < 0.05
    )
    np.testing.assert_allclose(
        np.sort(np.abs(read.xy(pc, "asked", "landscape")[0]))[-1],
        np.abs(found.search.trace["theta"]).max(),
    )


def test_a_landscape_that_costs_responses_says_how_many(build: Callable[..., pm.Model]) -> None:
    model = build(prb.Resimulated(64))
    found = prb.minimize(model)
    with pytest.raises(
        ValueError,
        match=r"got responses=0, expected at least 1600: 25 points with 64 responses each",
    ):
        prb.plot_landscape(found, points=5)
    assert "landscape" in prb.plot_landscape(found, points=5, responses=1600).viz
    with pytest.raises(
        KeyError, match=r"pair: got \['mu', 'nu'\], expected one or two of \['mu', 'sigma'\]"
    ):
        prb.plot_landscape(found, pair=["mu", "nu"])


def test_the_landscape_of_another_metric(
    optimum: prb.Optimum, known: SimpleNamespace, read: SimpleNamespace
) -> None:
    with pm.Model() as other:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 2))
        prb.Simulator(
            "y", np.positive, x, metric=prb.ProbabilityResidual(), observed=known.observed
        )
    pc = prb.plot_landscape(optimum, model=other, pair="mu", points=9)
    x, y = read.xy(pc, "landscape", "landscape")
    thetas = np.column_stack([x, np.full(x.size, optimum.theta[1])])
    np.testing.assert_allclose(y, Evaluator.of(other)(thetas).discrepancies[:, 0])
    with pytest.raises(
        ValueError, match=r"plot_landscape: .*hyperparameters: got mu, sigma_log__, expected mu"
    ):
        prb.plot_landscape(optimum, model=_one())


def _one() -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.3)
        prb.Simulator("y", np.square, x, metric=prb.AreaMetric(), observed=[0.0, 1.0, 4.0])
    return model


def test_values_of_a_flat_landscape_are_told_apart() -> None:
    assert distinct_texts(np.array([0.002, 0.5, 12.345])) == ["0.002", "0.5", "12.3"]
    assert distinct_texts(np.array([1.00001, 1.00002])) == ["1.00001", "1.00002"]
    assert distinct_texts(np.array([1.0, 1.0])) == ["1", "1"]


# -- the objective and its values on a grid --------------------------------------------------


def test_the_landscape_has_the_objective_at_its_places(optimum: prb.Optimum) -> None:
    evaluator = optimum.evaluator
    before = evaluator.n_responses
    found = landscape(optimum, evaluator, ["sigma", "mu"], 9)
    assert evaluator.n_responses == before
    s, m = found.axes
    for i, j in ((4, 4), (2, 7), (7, 3)):
        theta = evaluator.hyperparameters.unconstrained({"mu": m[j], "sigma": s[i]})
        height = evaluator(theta[None]).discrepancies[0, 0]
        assert found.heights[i, j] == pytest.approx(height)
    np.testing.assert_allclose(found.optimum, [[optimum.point["sigma"], optimum.point["mu"]]])
    np.testing.assert_allclose(found.path[:, 1], optimum.search.trace["theta"][:, 0])
    assert s[0] > 0
    assert s[0] < optimum.point["sigma"] - 2 * optimum.stderr["sigma"]
    assert np.nanmin(found.heights) >= optimum.discrepancy - 1e-9
    (only,) = landscape(optimum, evaluator, ["mu"], 9).axes
    np.testing.assert_allclose(only, m)


def test_the_landscape_is_blank_where_the_design_does_not_reach(optimum: prb.Optimum) -> None:
    wide = replace(optimum, stderr={"mu": 0.1, "sigma": 0.12})
    found = landscape(wide, wide.evaluator, ["mu", "sigma"], 9)
    m, s = found.axes
    thetas = np.array([[x, np.log(y)] for x in m for y in s])
    ess = wide.evaluator.support(thetas)["y"]["weight_ess"].reshape(9, 9)
    assert 0 < np.isnan(found.heights).sum() < 40
    assert np.isnan(found.heights[ess < 10]).all()
    assert np.isfinite(found.heights[ess > 40]).all()


def test_an_axis_ends_within_the_support(optimum: prb.Optimum) -> None:
    wide = replace(optimum, stderr={"mu": 0.1, "sigma": 0.5})
    (s,) = landscape(wide, wide.evaluator, ["sigma"], 9).axes
    assert 0 < s[0] < 0.1
    assert s[-1] >= optimum.point["sigma"] + 2.0 - 1e-9


def test_an_axis_of_unknown_standard_error_is_as_wide_as_the_prior(optimum: prb.Optimum) -> None:
    unknown = replace(optimum, stderr={"mu": np.nan, "sigma": np.inf})
    (m,) = landscape(unknown, unknown.evaluator, ["mu"], 9).axes
    assert np.ptp(m) == pytest.approx(2 * 2 * 2.326, rel=0.15)  # between the 1% and 99% quantiles


def test_roots_of_heights_are_even_around_a_parabola() -> None:
    x = np.linspace(-2, 2, 41)
    roots, low, high = rooted(3 + x**2)
    assert low == pytest.approx(3)
    np.testing.assert_allclose(roots, np.abs(x) / np.sqrt(high - low), atol=1e-12)
    assert (roots <= 1).mean() == pytest.approx(0.9, abs=0.05)


def test_the_objective_is_the_discrepancy_over_its_scale(optimum: prb.Optimum) -> None:
    thetas = np.array([optimum.theta, optimum.theta + 0.3])
    expected = optimum.evaluator(thetas).discrepancies[:, 0]
    halved = replace(optimum, scales={"y": 2.0})
    np.testing.assert_allclose(objective(halved, optimum.evaluator, thetas), expected / 2)


def test_the_objective_is_called_by_its_metric(optimum: prb.Optimum) -> None:
    assert objective_label(optimum) == "discrepancy (area metric)"
    assert (
        objective_label(replace(optimum, scales={"y": 1.0, "z": 1.0}))
        == "sum of scaled discrepancies"
    )


def test_elements_are_in_the_users_own_units(optimum: prb.Optimum) -> None:
    found = free_elements(optimum.evaluator, np.array([[1.0, np.log(0.5)], [2.0, 0.0]]))
    assert list(found) == ["mu", "sigma"]
    np.testing.assert_allclose(found["mu"], [1, 2])
    np.testing.assert_allclose(found["sigma"], [0.5, 1])


def test_what_has_no_trace_is_refused(optimum: prb.Optimum, posterior: xr.DataTree) -> None:
    check_optimum(optimum, "test")
    with pytest.raises(TypeError, match="test: got DataTree, expected an Optimum"):
        check_optimum(posterior, "test")
    with pytest.raises(ValueError, match="test: got an optimum without a trace"):
        check_optimum(replace(optimum, search=replace(optimum.search, trace={})), "test")
    for plot in (prb.plot_optimizer, prb.plot_landscape):
        with pytest.raises(TypeError, match=f"{plot.__name__}: got DataTree"):
            plot(posterior)  # type: ignore[arg-type]
