"""The trace of an optimiser, in the user's own units, and the stages of a sampler, by chain."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb


def test_the_trace_is_in_the_users_units(
    optimum: prb.Optimum, read: SimpleNamespace, drawn: Callable[..., Any]
) -> None:
    pc = drawn("optimizer")
    trace = optimum.search.trace
    np.testing.assert_allclose(
        read.xy(pc, "asked", "mu"), [trace["evaluations"], trace["theta"][:, 0]]
    )
    np.testing.assert_allclose(
        read.xy(pc, "path", "sigma"), [trace["evaluations"], np.exp(trace["theta"][:, 1])]
    )
    np.testing.assert_allclose(read.xy(pc, "optimum", "sigma")[1], optimum.point["sigma"])
    _, y = read.xy(pc, "best", "discrepancy")
    logarithmic = pc.viz["plot"]["discrepancy"].item().get_yticklabels()[0].get_text() not in (
        "",
        "0",
    )
    y = 10**y if y.min() < 0 and logarithmic else y
    assert y[-1] == pytest.approx(optimum.discrepancy, rel=1e-6)
    assert (np.diff(y) <= 0).all()


@pytest.mark.long
def test_the_objective_of_a_trace_is_that_of_the_final_scales(
    known: SimpleNamespace, read: SimpleNamespace
) -> None:
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 2))
        for name, factor in (("y", 1.0), ("z", 3.0)):
            prb.Simulator(
                name,
                lambda x, f: f * x,
                x,
                factor,
                metric=prb.AreaMetric(),
                observed=factor * known.observed,
            )
        found = prb.minimize()
    _, y = read.xy(prb.plot_optimizer(found), "best", "discrepancy")
    assert min(y[-1], 10 ** y[-1], key=lambda v: abs(v - found.discrepancy)) == pytest.approx(
        found.discrepancy
    )


def test_stages_by_chain(read: SimpleNamespace, drawn: Callable[..., Any]) -> None:
    pc = drawn("stages")
    np.testing.assert_allclose(read.xy(pc, "chain_0", "accept_rate"), [[1, 2, 3], [0.2, 0.3, 0.4]])
    np.testing.assert_allclose(read.xy(pc, "chain_1", "accept_rate"), [[1, 2], [0.5, 0.6]])
    np.testing.assert_allclose(read.xy(pc, "chain_0", "beta"), [[1, 2, 3], [-3, -1, 0]])
    ticks = pc.viz["plot"]["beta"].item()
    assert [t.get_text() for t in ticks.get_yticklabels()] == [
        f"{10.0**t:g}" for t in ticks.get_yticks()
    ]
    np.testing.assert_allclose(read.xy(pc, "chain_1", "log_marginal_likelihood"), [[2], [-4]])
    assert read.texts(pc) == ["chain 0", "chain 1"]


def test_wrong_arguments_are_refused(optimum: prb.Optimum, posterior: xr.DataTree) -> None:
    with pytest.raises(TypeError, match="got Optimum, expected the DataTree"):
        prb.plot_stages(optimum)  # type: ignore[arg-type]
    without = posterior.copy()
    without["sample_stats"] = xr.DataTree(xr.Dataset({"beta": ("chain", np.ones(2))}))
    with pytest.raises(ValueError, match="got sample_stats without dims"):
        prb.plot_stages(without)
