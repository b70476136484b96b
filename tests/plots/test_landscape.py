"""The landscape has the right height at the right place; the objective, its name, its refusals."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import figure_reader as read
import numpy as np
import pymc as pm
import pytest
from one_input import one_input

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import unconstrained
from prbayes.plots.landscape import (
    check_optimum,
    distinct_texts,
    landscape,
    objective,
    objective_label,
)


def test_the_landscape_is_not_turned_over(optimum: prb.Optimum, drawn: Callable[..., Any]) -> None:
    pc = drawn("landscape")
    trace, point = optimum.search.trace["theta"], optimum.point
    np.testing.assert_allclose(read.xy(pc, "path", "landscape"), [trace[:, 0], np.exp(trace[:, 1])])
    mark = read.xy(pc, "optimum", "landscape")[:, 0]
    np.testing.assert_allclose(mark, [point["mu"], point["sigma"]])
    axis = read.panel(pc, "landscape")
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("mu", "sigma")
    paths = read.artist(pc, "landscape", "landscape").get_paths()
    (x0, x1), (y0, y1) = axis.get_xlim(), axis.get_ylim()
    u, v = np.meshgrid([0.1, 0.3, 0.5, 0.62], [0.2, 0.45, 0.9])
    places = np.column_stack([x0 + u.ravel() * (x1 - x0), y0 + v.ravel() * (y1 - y0)])
    thetas = np.column_stack([places[:, 0], np.log(places[:, 1])])
    order = np.argsort(optimum.evaluator(thetas).discrepancies[:, 0])
    layers = [next((i for i, p in enumerate(paths) if p.contains_point(x)), 99) for x in places]
    assert (np.diff(np.array(layers)[order]) >= 0).all()
    assert len(set(layers)) > 3
    # The colours are of roots: the height above the lowest is the square of the place on the bar
    bar = pc.axes[-1]
    assert bar.get_ylabel() == "discrepancy (area metric)"
    values = np.array([text.get_text() for text in bar.get_yticklabels()], dtype=float)
    above = (values - values[0]) / (values[-1] - values[0])
    np.testing.assert_allclose(above, bar.get_yticks() ** 2, atol=0.005)  # three digits
    assert values[0] >= 0.995 * optimum.discrepancy


def test_a_curve_over_one_hyperparameter(optimum: prb.Optimum, drawn: Callable[..., Any]) -> None:
    pc = drawn("curve")
    x, y = read.xy(pc, "landscape", "landscape")
    thetas = np.column_stack([np.full(x.size, optimum.theta[0]), np.log(x)])
    np.testing.assert_allclose(y, optimum.evaluator(thetas).discrepancies[:, 0])
    assert read.panel(pc, "landscape").get_title() == "mu fixed at the optimum"
    np.testing.assert_allclose(read.xy(pc, "optimum", "landscape")[0], optimum.point["sigma"])
    assert not read.panels(pc, "evaluated")


def test_other_optima_are_marked() -> None:
    optimum = prb.minimize(_one(), starts=0)
    modes = ({"theta": -optimum.theta, "point": {}, "discrepancy": 1.0, "comparable": True},)
    pc = prb.plots.plot_landscape(replace(optimum, local_optima=modes), n_points=21)
    np.testing.assert_allclose(read.xy(pc, "local_optima", "landscape")[0], -optimum.theta)
    path = read.xy(pc, "evaluated", "landscape")[0]
    largest = np.abs(optimum.search.trace["theta"]).max()
    np.testing.assert_allclose(np.abs(path).max(), largest)


def test_a_landscape_that_costs_responses_says_how_many(build: Callable[..., pm.Model]) -> None:
    found = prb.minimize(build(prb.Resimulated(64)))
    match = "got max_responses=0, expected at least 1600: 25 points with 64 responses each"
    with pytest.raises(ValueError, match=match):
        prb.plots.plot_landscape(found, n_points=5)
    assert read.panels(prb.plots.plot_landscape(found, n_points=5, max_responses=1600), "landscape")


def test_the_landscape_of_another_metric(optimum: prb.Optimum, known: SimpleNamespace) -> None:
    other = one_input(known.observed, prb.ProbabilityResidual(), sigma=2)
    pc = prb.plots.plot_landscape(optimum, model=other, var_names="mu", n_points=9)
    x, y = read.xy(pc, "landscape", "landscape")
    thetas = np.column_stack([x, np.full(x.size, optimum.theta[1])])
    np.testing.assert_allclose(y, Evaluator.of(other)(thetas).discrepancies[:, 0])
    match = r"plot_landscape: .*hyperparameters: got sigma_log__, expected "
    with pytest.raises(ValueError, match=match):
        prb.plots.plot_landscape(optimum, model=_one())


def _one() -> pm.Model:
    return one_input([0.0, 1.0, 4.0], prb.AreaMetric(), response=np.square, sd=0.3)


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
        theta = unconstrained(evaluator.hyperparameters, {"mu": m[j], "sigma": s[i]})
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


def test_what_has_no_trace_is_refused(optimum: prb.Optimum) -> None:
    with pytest.raises(ValueError, match="test: got an optimum without a trace"):
        check_optimum(replace(optimum, search=replace(optimum.search, trace={})), "test")


@pytest.mark.parametrize(
    ("error", "high"),
    [
        (0.5, (2.4, 3.0)),  # ends within the support
        (np.inf, (2.0, 6.0)),  # unknown: as wide as the prior
    ],
)
def test_axes_end_within_support_or_prior(
    error: float, high: tuple[float, float], optimum: prb.Optimum
) -> None:
    changed = replace(optimum, stderr={"mu": 0.1, "sigma": error})
    (s,) = landscape(changed, changed.evaluator, ["sigma"], 9).axes
    assert 0 < s[0] < 0.1
    assert high[0] < s[-1] < high[1]


def test_the_objective_is_the_sum_of_discrepancies_over_scales(optimum: prb.Optimum) -> None:
    thetas = np.array([optimum.theta, optimum.theta + 0.3])
    expected = optimum.evaluator(thetas).discrepancies[:, 0]
    halved = replace(optimum, scales={"y": 2.0})
    np.testing.assert_allclose(objective(halved, optimum.evaluator, thetas), expected / 2)
    assert objective_label(optimum) == "discrepancy (area metric)"
    both = replace(optimum, scales={"y": 1.0, "z": 1.0})
    assert objective_label(both) == "sum of scaled discrepancies"
