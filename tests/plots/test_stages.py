"""The stages of a sampler, by chain."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import xarray as xr

import prbayes as prb


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
