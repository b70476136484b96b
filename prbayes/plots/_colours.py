"""A bar beside a panel that says which numbers its colours mean, on each backend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class ColourScale:
    """What colours mean: places on the scale that was drawn, what stands there, and a name."""

    places: tuple[float, ...]
    texts: tuple[str, ...]
    name: str


def draw_colour_bar(
    backend: str, figure: Any, target: Any, artist: Any, scale: ColourScale
) -> None:
    """Draw the bar of filled contours, ``artist``, beside their panel, ``target``."""
    if backend == "matplotlib":
        bar = figure.colorbar(artist, ax=target)
        bar.set_ticks(scale.places, labels=scale.texts)
        bar.set_label(scale.name)
    elif backend == "plotly":
        bar = {
            "tickvals": scale.places,
            "ticktext": scale.texts,
            "title": {"text": scale.name, "side": "right"},
        }
        # The figure has a copy of the artist, the first of its contours
        contours = next(trace for trace in figure.data if trace.type == "contour")
        contours.update(showscale=True, colorbar=bar)
    elif backend == "bokeh":
        texts = dict(zip(scale.places, scale.texts, strict=True))
        bar = artist.construct_color_bar(major_label_overrides=texts, title=scale.name)
        bar.ticker.ticks = list(scale.places)
        target.add_layout(bar, "right")
