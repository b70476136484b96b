"""Common properties of all pictures: labels, size, legend, ticks."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.image import imread

import prbayes as prb
from prbayes.plots.canvas import finish, metric_label, named, round_ticks, scale_by_decades

PICTURES = ["responses", "ecdf", "outputs", "population", "posterior", "optimizer"]
PICTURES += ["landscape", "curve", "stages", "comparison", "scores"]


@pytest.mark.parametrize("picture", PICTURES)
def test_every_picture_is_drawn_with_labels(
    picture: str, tmp_path: Path, pictures: dict[str, Callable[..., Any]]
) -> None:
    labels = {"mu": "MEAN", "y": "RESPONSE", "x": "INPUT", "accept_rate": "RATE"}
    labels |= {"AreaMetric": "AREA", "sigma": "SD"}
    if picture == "outputs":
        labels = {"frame": "FRAME", "first": "FIRST", "mu": "MEAN"}
    pc = pictures[picture](labels=labels)
    figure = pc if isinstance(pc, Figure) else pc.viz["figure"].item()
    texts = {
        x for axis in figure.axes for x in (axis.get_xlabel(), axis.get_ylabel(), axis.get_title())
    }
    assert texts & set(labels.values())
    assert not texts & (set(labels) - {"x", "y"})
    pc.savefig(tmp_path / "picture.png", dpi=60)
    image = imread(tmp_path / "picture.png")[..., :3]
    assert min(image.shape[:2]) > 100
    assert (image.min(axis=2) < 0.9).mean() > 0.01
    if picture in ("responses", "population", "posterior", "optimizer", "landscape", "comparison"):
        # Names of the model that this picture does not show are accepted.
        others = {"mu": "mean"} if picture == "responses" else {}
        with pytest.raises(KeyError, match="labels: got 'crak', expected names that the picture"):
            pictures[picture](labels=others | {"crak": "crack length (mm)"})


def test_settings_of_the_collection_are_passed_on(posterior: xr.DataTree) -> None:
    pc = prb.plots.plot_posterior(posterior, col_wrap=1, figure_kwargs={"figsize": (3, 7)})
    assert tuple(pc.viz["figure"].item().get_size_inches()) == (3, 7)
    assert pc.viz["row_index"]["sigma"].item() == 1
    figure = prb.plots.plot_posterior(posterior, figsize=(9, 3)).viz["figure"]
    assert tuple(figure.item().get_size_inches()) == (9, 3)
    sizes = {"figsize": (9, 3), "col_wrap": 1, "figure_kwargs": {"facecolor": "0.9"}}
    drawn = prb.plots.plot_stages(posterior, **sizes)
    assert tuple(drawn.get_size_inches()) == (9, 3)
    assert drawn.axes[1].get_subplotspec().rowspan.start == 1
    assert drawn.get_facecolor()[0] == pytest.approx(0.9)
    with pytest.raises(TypeError, match=r"backend: got str 'plotly', expected figsize, col_wrap"):
        prb.plots.plot_stages(posterior, backend="plotly")


def test_a_notebook_shows_a_figure_once(
    monkeypatch: pytest.MonkeyPatch, posterior: xr.DataTree
) -> None:
    """IPython displays the last value of a cell, then pyplot its open figures."""
    own = plt.figure()
    figure: Any = prb.plots.plot_stages(posterior)
    with pytest.raises(NotImplementedError):
        figure._ipython_display_()
    assert plt.fignum_exists(figure.number)
    monkeypatch.setattr("matplotlib.get_backend", lambda: "inline")
    with pytest.raises(NotImplementedError):
        figure._ipython_display_()
    assert plt.get_fignums() == [own.number]


@pytest.mark.parametrize(("width", "columns"), [(3, 1), (5, 2), (12, 4)])
def test_legend_entries_are_in_rows_of_equal_length_that_fit(width: float, columns: int) -> None:
    figure, axes = plt.subplots(1, 2, figsize=(width, 3), layout="constrained")
    for axis in axes:
        for text in ("a first entry", "a second entry", "a third entry", "a fourth one"):
            axis.plot([0, 1], label=text)
    finish(figure)
    (legend,) = figure.legends
    assert len(legend.get_texts()) == 4
    assert legend._ncols == columns


def test_ticks_are_few_and_round() -> None:
    assert round_ticks(1.06, 1.22)[1] == ["1.1", "1.15", "1.2"]
    assert round_ticks(-1.0, 1.0)[1] == ["-1", "-0.5", "0", "0.5", "1"]
    assert "0" in round_ticks(-0.3, 0.3)[1]
    for low, high in ((0.0, 13.0), (1e-6, 3e-6), (-3.0, 1e5)):
        places, labels = round_ticks(low, high)
        assert 2 <= len(places) <= 6
        np.testing.assert_allclose(places, [float(text) for text in labels], rtol=1e-9)


@pytest.mark.parametrize(
    ("values", "texts"),
    [
        ([0.011, 0.4], ["0.01", "0.02", "0.05", "0.1", "0.2"]),
        ([3.0, 700.0, np.nan], ["10", "100"]),
        ([1.0, 20.0], None),
        ([-1.0, 500.0], None),
        ([0.0, 500.0], None),
        ([np.nan, np.inf], None),
    ],
)
def test_an_axis_is_logarithmic_for_positive_values_of_different_orders(
    values: list[float], texts: list[str] | None
) -> None:
    figure, axis = plt.subplots()
    axis.plot(values)
    scale_by_decades(axis, np.array(values))
    assert axis.get_yscale() == ("linear" if texts is None else "log")
    if texts is not None:
        figure.canvas.draw()
        low, high = axis.get_ylim()
        ticks = zip(axis.get_yticks(), axis.get_yticklabels(), strict=True)
        assert [text.get_text() for place, text in ticks if low <= place <= high] == texts
    plt.close(figure)


def test_elements_take_the_label_of_their_variable() -> None:
    labels = {"mu": "mean", "mu[1]": "second mean"}
    texts = [named(name, labels) for name in ("mu[0]", "mu[1]", "nu", "nu[0]", "mu")]
    assert texts == ["mean[0]", "second mean", "nu", "nu[0]", "mean"]
    assert named("mu[0]", None) == "mu[0]"


@pytest.mark.parametrize(
    ("metric", "label"),
    [
        (repr(prb.AreaMetric()), "area metric"),
        (repr(prb.Joint(prb.AreaMetric())), "joint area metric"),
        ("Mine(Other(3))", "Mine"),
    ],
)
def test_metrics_of_several_outputs_are_called_by_that_of_one(metric: str, label: str) -> None:
    assert metric_label(metric) == label
