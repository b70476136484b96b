"""The objective of an optimum: its name, its values, its refusals."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

import prbayes as prb
from prbayes.plots._objective import (
    check_optimum,
    free_elements,
    metric_label,
    objective,
    objective_label,
)


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


def test_metrics_of_several_outputs_are_called_by_that_of_one() -> None:
    area = prb.AreaMetric()
    assert metric_label(repr(area)) == "area metric"
    assert metric_label(repr(prb.Joint(area))) == "joint area metric"
    other = prb.MarginalCorrelation(prb.KullbackLeibler())
    assert (
        metric_label(repr(other)) == "Kullback-Leibler divergence of marginals, with correlations"
    )
    assert metric_label("Mine(Other(3))") == "Mine"
