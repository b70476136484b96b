"""A bar says which numbers the colours of a picture mean."""

from collections.abc import Callable
from typing import Any

import numpy as np

import prbayes as prb


def told(optimum: prb.Optimum, drawn: Callable[..., Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return where the bar of a landscape has texts, and the numbers they say."""
    figure = drawn("landscape", "matplotlib").viz["figure"].item()
    bar = figure.axes[-1]
    assert bar.get_ylabel() == "discrepancy (area metric)"
    texts = [text.get_text() for text in bar.get_yticklabels()]
    return bar.get_yticks(), np.array(texts, dtype=float)


def test_the_bar_undoes_what_was_done_to_the_heights(
    optimum: prb.Optimum, drawn: Callable[..., Any]
) -> None:
    """The colours are of roots: the height above the lowest goes with the square of the place."""
    places, values = told(optimum, drawn)
    above = (values - values[0]) / (values[-1] - values[0])
    np.testing.assert_allclose(above, places**2, atol=0.005)  # texts have three digits
    assert values[0] >= 0.995 * optimum.discrepancy


def test_the_bar_is_the_same_elsewhere(optimum: prb.Optimum, drawn: Callable[..., Any]) -> None:
    places, values = told(optimum, drawn)
    figure = drawn("landscape", "plotly").viz["figure"].item()
    bars = [t.colorbar for t in figure.data if t.type == "contour" and t.showscale]
    assert len(bars) == 1
    np.testing.assert_allclose(bars[0].tickvals, places)
    np.testing.assert_allclose(np.array(bars[0].ticktext, dtype=float), values)
    panel = drawn("landscape", "bokeh").get_target("landscape", {})
    (bar,) = panel.right
    np.testing.assert_allclose(bar.ticker.ticks, places)
    assert [float(text) for text in bar.major_label_overrides.values()] == values.tolist()
