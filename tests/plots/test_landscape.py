"""The landscape has the right height at the right place."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest
from scipy import stats

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.plots.landscape import distinct_texts

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
        abs(read.xy(pc, "rivals", "landscape")[0] + read.xy(pc, "optimum", "landscape")[0]).min()
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
