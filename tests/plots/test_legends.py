"""Each text stands once in the legend, on every backend."""

from types import SimpleNamespace

import matplotlib.pyplot as plt
import pytest

from prbayes.plots._legends import draw_legend, legend_entry


def test_on_plotly_the_first_of_a_text_shows_it_and_all_belong_together() -> None:
    first, second = (legend_entry("plotly", "data", first=f) for f in (True, False))
    assert first == {"name": "data", "legendgroup": "data", "showlegend": True}
    assert second == {"name": "data", "legendgroup": "data", "showlegend": False}
    assert legend_entry("none", "data", first=True) == {}


@pytest.mark.parametrize(("width", "columns"), [(3, 1), (5, 2), (12, 4)])
def test_entries_are_in_rows_of_equal_length_that_fit(width: float, columns: int) -> None:
    figure, axes = plt.subplots(1, 2, figsize=(width, 3), layout="constrained")
    for axis in axes:
        for text in ("a first entry", "a second entry", "a third entry", "a fourth one"):
            axis.plot([0, 1], label=text)
    draw_legend("matplotlib", figure, list(axes))
    (legend,) = figure.legends
    assert len(legend.get_texts()) == 4
    assert legend._ncols == columns


@pytest.mark.parametrize(("width", "columns"), [(800, 2), (200, 1)])
def test_on_bokeh_two_columns_if_they_fit(width: int, columns: int) -> None:
    items = [SimpleNamespace(label=SimpleNamespace(value="a" * n)) for n in (10, 20, 5)]
    legend, added = SimpleNamespace(items=items, ncols=None), []
    panel = SimpleNamespace(legend=[legend], width=width, add_layout=lambda *a: added.append(a))
    draw_legend("bokeh", None, [panel, SimpleNamespace(legend=[])])
    assert legend.ncols == columns
    assert added == [(legend, "below")]
