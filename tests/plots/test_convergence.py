"""The trace of an optimiser, in the user's units, and the stages of a sampler, by chain."""

from typing import Any

import figure_reader as read
import numpy as np
import pytest
import xarray as xr

import prbayes as prb


def test_the_trace_is_in_the_users_units(optimum: prb.Optimum, drawn: Any) -> None:
    pc = drawn("optimizer")
    trace = optimum.search.trace
    evaluations, theta = trace["evaluations"], trace["theta"]
    np.testing.assert_allclose(read.xy(pc, "evaluated", "mu"), [evaluations, theta[:, 0]])
    np.testing.assert_allclose(read.xy(pc, "path", "sigma"), [evaluations, np.exp(theta[:, 1])])
    np.testing.assert_allclose(read.xy(pc, "optimum", "sigma")[1], optimum.point["sigma"])
    _, y = read.xy(pc, "lowest", "discrepancy")
    assert y[-1] == pytest.approx(optimum.discrepancy, rel=1e-6)
    assert (np.diff(y) <= 0).all()


def test_stages_by_chain(drawn: Any) -> None:
    pc = drawn("stages")
    np.testing.assert_allclose(read.xy(pc, "chain_0", "accept_rate"), [[1, 2, 3], [0.2, 0.3, 0.4]])
    np.testing.assert_allclose(read.xy(pc, "chain_1", "accept_rate"), [[1, 2], [0.5, 0.6]])
    np.testing.assert_allclose(read.xy(pc, "chain_0", "beta"), [[1, 2, 3], [1e-3, 0.1, 1]])
    assert read.panel(pc, "beta").get_yscale() == "log"
    np.testing.assert_allclose(read.xy(pc, "chain_1", "log_marginal_likelihood"), [[2], [-4]])
    assert read.texts(pc) == ["chain 0", "chain 1"]


def test_statistics_that_are_not_by_stage_are_refused(posterior: xr.DataTree) -> None:
    without = posterior.copy()
    without["sample_stats"] = xr.DataTree(xr.Dataset({"beta": ("chain", np.ones(2))}))
    with pytest.raises(ValueError, match="got sample_stats without dims"):
        prb.plots.plot_stages(without)
