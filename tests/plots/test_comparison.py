"""Results side by side: a row for each."""

from collections.abc import Callable
from typing import Any

import figure_reader as read
import numpy as np
import pytest
import xarray as xr

import prbayes as prb


def test_a_comparison_has_a_row_for_each_result(
    optimum: prb.Optimum, comparison: xr.Dataset, drawn: Callable[..., Any]
) -> None:
    pc = drawn("comparison")
    table = comparison.sel(hyperparameter="sigma")
    for i, row in ((0, 1.0), (1, 0.0)):
        ends = [float(table[k][i]) for k in ("lower", "upper")]
        segment = read.artist(pc, "interval", "sigma").get_segments()[i]
        np.testing.assert_allclose(segment.T, [ends, [row, row]])
        np.testing.assert_allclose(
            read.xy(pc, "estimate", "sigma")[:, i], [float(table.estimate[i]), row]
        )
    axis = read.panel(pc, "sigma")
    at = dict(zip(axis.get_yticks(), [t.get_text() for t in axis.get_yticklabels()], strict=True))
    assert at == {1.0: "optimum", 0.0: "draws"}
    np.testing.assert_allclose(read.xy(pc, "first", "sigma")[0], optimum.point["sigma"])
    scores = drawn("scores")
    np.testing.assert_allclose(
        read.xy(scores, "score", "AreaMetric"), [comparison.AreaMetric.values, [1, 0]]
    )


def test_a_comparison_without_scores_is_refused(posterior: xr.DataTree) -> None:
    with pytest.raises(ValueError, match="got no scores"):
        prb.plots.plot_comparison(prb.compare({"draws": posterior}), scores=True)
