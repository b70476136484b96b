"""The objective of an optimum: its values on a grid, its name, its refusals."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

import prbayes as prb
from prbayes.plots._landscape_data import (
    check_optimum,
    free_elements,
    landscape,
    objective,
    objective_label,
    rooted,
)


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
