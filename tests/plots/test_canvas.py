"""What all pictures have in common, on every backend."""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import arviz as az
import numpy as np
import pytest
import xarray as xr
from matplotlib.image import imread

import prbayes as prb

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
@pytest.mark.parametrize("backend", ["plotly", "bokeh"])
def test_every_backend_draws_the_same(
    picture: str, backend: str, read: SimpleNamespace, drawn: Callable[..., Any]
) -> None:
    ours, other = (drawn(picture, b) for b in ("matplotlib", backend))
    assert isinstance(other, az.PlotCollection)
    compared = 0
    for visual in ours.viz.children:
        if visual in {"plot", "row_index", "col_index", "band", "landscape_lines"}:
            continue
        for panel in ours.viz[visual].data_vars:
            if hasattr(read.artist(ours, visual, panel), "levels"):
                continue
            np.testing.assert_allclose(
                read.xy(other, visual, panel), read.xy(ours, visual, panel), err_msg=visual
            )
            compared += 1
            if hasattr(read.artist(ours, visual, panel), "get_sizes") and visual != "rug":
                found = read.artist(other, visual, panel)
                size = found.marker.size if backend == "plotly" else found.glyph.size
                assert size**2 == pytest.approx(read.artist(ours, visual, panel).get_sizes()[0])
    assert compared
    figure = other.viz["figure"].item()
    wanted = [
        t.get_text() for legend in ours.viz["figure"].item().legends for t in legend.get_texts()
    ]
    shaded = {"responses": 1, "ecdf": 1, "population": 1}.get(picture, 0)
    if backend == "plotly":
        assert [t.name for t in figure.data if t.showlegend] == wanted
        assert sum(getattr(t, "fill", None) == "tonexty" for t in figure.data) == shaded
    else:
        panels = list(figure.select({"type": import_module("bokeh.models").Plot}))
        assert {i.label.value for p in panels for legend in p.legend for i in legend.items} == set(
            wanted
        )
        glyphs = [type(getattr(r, "glyph", None)).__name__ for p in panels for r in p.renderers]
        assert glyphs.count("VArea") == shaded


@pytest.mark.parametrize("picture", PICTURES)
def test_every_picture_comes_out(picture: str, tmp_path: Path, drawn: Callable[..., Any]) -> None:
    drawn(picture, "matplotlib").savefig(tmp_path / "picture.png", dpi=60)
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
    pc = pictures[picture](backend="none", labels=labels)
    panels = [pc.get_target(name, {}) for name in pc.data.data_vars]
    calls = [call for panel in panels for call in panel]
    found = {call["string"] for call in calls if call["function"] in ("xlabel", "ylabel")}
    assert found & set(labels.values())
    assert not found & (set(labels) - {"x", "y"})


def test_settings_of_the_collection_are_passed_on(posterior: xr.DataTree) -> None:
    pc = prb.plot_posterior(
        posterior, backend="matplotlib", col_wrap=1, figure_kwargs={"figsize": (3, 7)}
    )
    assert tuple(pc.viz["figure"].item().get_size_inches()) == (3, 7)
    assert pc.viz["row_index"]["sigma"].item() == 1


def test_the_size_is_in_inches_on_every_backend(posterior: xr.DataTree) -> None:
    figure = prb.plot_posterior(posterior, backend="matplotlib", figsize=(9, 3)).viz["figure"]
    assert tuple(figure.item().get_size_inches()) == (9, 3)
    figure = prb.plot_posterior(posterior, backend="plotly", figsize=(9, 3)).viz["figure"]
    assert figure.item().layout.width == 900
    with pytest.raises(ValueError, match=r"figsize: got 'wide', expected width and height"):
        prb.plot_posterior(posterior, backend="none", figsize="wide")
