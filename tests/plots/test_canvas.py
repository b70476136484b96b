"""What all pictures have in common: labels, size, legend, colour bar, ticks."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from matplotlib.image import imread

import prbayes as prb
from prbayes.plots.canvas import (
    draw_legend,
    log_ticks,
    metric_label,
    named,
    round_ticks,
    spans_decades,
)

PICTURES = (
    "responses",
    "ecdf",
    "outputs",
    "population",
    "posterior",
    "optimizer",
    "landscape",
    "curve",
    "stages",
    "comparison",
    "scores",
)


@pytest.mark.parametrize("picture", PICTURES)
def test_every_picture_comes_out(picture: str, tmp_path: Path, drawn: Callable[..., Any]) -> None:
    drawn(picture).savefig(tmp_path / "picture.png", dpi=60)
    image = imread(tmp_path / "picture.png")[..., :3]
    assert min(image.shape[:2]) > 100
    assert (image.min(axis=2) < 0.9).mean() > 0.01


@pytest.mark.parametrize("picture", PICTURES)
def test_labels_reach_the_axes(picture: str, pictures: dict[str, Callable[..., Any]]) -> None:
    labels = {
        "mu": "MEAN",
        "y": "RESPONSE",
        "x": "INPUT",
        "accept_rate": "RATE",
        "AreaMetric": "AREA",
        "sigma": "SD",
    }
    if picture == "outputs":
        labels = {"frame": "FRAME", "first": "FIRST", "mu": "MEAN"}
    pc = pictures[picture](labels=labels)
    panels = [pc.get_target(name, {}) for name in pc.data.data_vars]
    found = {text for panel in panels for text in (panel.get_xlabel(), panel.get_ylabel())}
    assert found & set(labels.values())
    assert not found & (set(labels) - {"x", "y"})


def test_settings_of_the_collection_are_passed_on(posterior: xr.DataTree) -> None:
    pc = prb.plot_posterior(posterior, col_wrap=1, figure_kwargs={"figsize": (3, 7)})
    assert tuple(pc.viz["figure"].item().get_size_inches()) == (3, 7)
    assert pc.viz["row_index"]["sigma"].item() == 1


def test_the_size_is_in_inches(posterior: xr.DataTree) -> None:
    figure = prb.plot_posterior(posterior, figsize=(9, 3)).viz["figure"]
    assert tuple(figure.item().get_size_inches()) == (9, 3)
    with pytest.raises(ValueError, match=r"figsize: got 'wide', expected width and height"):
        prb.plot_posterior(posterior, figsize="wide")


def test_another_backend_is_refused(posterior: xr.DataTree) -> None:
    with pytest.raises(TypeError, match=r"backend: got str 'plotly', expected none"):
        prb.plot_posterior(posterior, backend="plotly")


# -- legend ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("width", "columns"), [(3, 1), (5, 2), (12, 4)])
def test_entries_are_in_rows_of_equal_length_that_fit(width: float, columns: int) -> None:
    figure, axes = plt.subplots(1, 2, figsize=(width, 3), layout="constrained")
    for axis in axes:
        for text in ("a first entry", "a second entry", "a third entry", "a fourth one"):
            axis.plot([0, 1], label=text)
    draw_legend(figure, list(axes))
    (legend,) = figure.legends
    assert len(legend.get_texts()) == 4
    assert legend._ncols == columns


# -- colour bar ------------------------------------------------------------------------------


def test_the_bar_undoes_what_was_done_to_the_heights(
    optimum: prb.Optimum, drawn: Callable[..., Any]
) -> None:
    """The colours are of roots: the height above the lowest goes with the square of the place."""
    bar = drawn("landscape").viz["figure"].item().axes[-1]
    assert bar.get_ylabel() == "discrepancy (area metric)"
    values = np.array([text.get_text() for text in bar.get_yticklabels()], dtype=float)
    above = (values - values[0]) / (values[-1] - values[0])
    np.testing.assert_allclose(above, bar.get_yticks() ** 2, atol=0.005)  # three digits
    assert values[0] >= 0.995 * optimum.discrepancy


# -- ticks -----------------------------------------------------------------------------------


def test_ticks_are_few_and_round() -> None:
    assert round_ticks(1.06, 1.22)[1] == ["1.1", "1.15", "1.2"]
    assert round_ticks(-1.0, 1.0)[1] == ["-1", "-0.5", "0", "0.5", "1"]
    for low, high in ((0.0, 13.0), (1e-6, 3e-6), (-3.0, 1e5)):
        at, labels = round_ticks(low, high)
        assert 2 <= len(at) <= 6
        np.testing.assert_allclose(at, [float(text) for text in labels], rtol=1e-9)


def test_zero_is_called_zero() -> None:
    at, labels = round_ticks(-0.3, 0.3)
    assert labels[len(labels) // 2] == "0"
    assert min(at) >= -0.3
    assert max(at) <= 0.3


def test_ticks_of_logarithms_stand_where_their_labels_say() -> None:
    for values in (np.array([0.011, 0.4]), np.array([1e-9, 1.0]), np.array([3.0, 70.0, np.nan])):
        assert spans_decades(values)
        at, labels = log_ticks(values)
        assert 2 <= len(at) <= 7
        np.testing.assert_allclose(10 ** np.array(at), [float(text) for text in labels])


def test_a_logarithm_needs_positive_values_of_different_orders() -> None:
    assert spans_decades(np.array([1.0, 20.1]))
    assert not spans_decades(np.array([1.0, 20.0]))
    assert not spans_decades(np.array([-1.0, 500.0]))
    assert not spans_decades(np.array([0.0, 500.0]))
    assert not spans_decades(np.array([np.nan, np.inf]))


# -- labels ----------------------------------------------------------------------------------


def test_elements_take_the_label_of_their_variable() -> None:
    labels = {"mu": "mean", "mu[1]": "second mean"}
    found = [named(name, labels) for name in ("mu[0]", "mu[1]", "nu", "nu[0]", "mu")]
    assert found == ["mean[0]", "second mean", "nu", "nu[0]", "mean"]
    assert named("mu[0]", None) == "mu[0]"


LABELLED = ("responses", "population", "posterior", "optimizer", "landscape", "comparison")


@pytest.mark.parametrize("picture", LABELLED)
def test_a_label_of_nothing_is_refused(
    picture: str, pictures: dict[str, Callable[..., Any]]
) -> None:
    with pytest.raises(KeyError, match=r"labels: got 'crak', which is no name of what is shown"):
        pictures[picture](labels={"crak": "crack length (mm)"})


def test_one_mapping_serves_all_pictures_of_a_model(
    pictures: dict[str, Callable[..., Any]],
) -> None:
    labels = {"mu": "mean", "y": "response", "x": "input"}
    for picture in LABELLED:
        pictures[picture](labels=labels)
    with pytest.raises(KeyError, match="'nu'"):
        pictures["responses"](labels=labels | {"nu": "typing error"})


def test_metrics_of_several_outputs_are_called_by_that_of_one() -> None:
    area = prb.AreaMetric()
    assert metric_label(repr(area)) == "area metric"
    assert metric_label(repr(prb.Joint(area))) == "joint area metric"
    other = prb.MarginalCorrelation(prb.KullbackLeibler())
    assert (
        metric_label(repr(other)) == "Kullback-Leibler divergence of marginals, with correlations"
    )
    assert metric_label("Mine(Other(3))") == "Mine"
