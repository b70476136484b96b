"""What pictures of populations share: level, band, the calibrated curves."""

from __future__ import annotations

from typing import Any

from prbayes._checks import Floats, positive_number
from prbayes.plots._canvas import BLUE, Canvas
from prbayes.plots._curves import (
    pointwise_band,
)
from prbayes.plots._ensemble import Ensemble


def check_level(level: float) -> None:
    if positive_number(level, "level") >= 1:
        raise ValueError(f"level: got {level}, expected a number between 0 and 1")


def middle_and_band(curves: Floats, centers: int, level: float) -> tuple[Floats, tuple[Floats, Floats] | None]:
    """Return the optimum's curve, or else the mean of the posterior's, and a band of the others."""
    others = curves[centers:]
    return curves[0] if centers else others.mean(axis=0), pointwise_band(others, level) if len(others) else None


def calibrated(
    canvas: Canvas, panel: str, grid: Floats, after: Floats, band: Any, shown: Ensemble, level: float
) -> None:
    if band is not None:
        canvas.band(panel, "band", grid, band, BLUE, legend=f"{level:.0%} band of the {shown.spread}")
    canvas.line(panel, "after", grid, after, BLUE, width=2.2, legend=f"calibrated: {shown.label}")
