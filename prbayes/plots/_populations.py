"""What pictures of populations share: the calibrated curve in its band."""

from __future__ import annotations

from dataclasses import dataclass

from prbayes._validate import Floats
from prbayes.plots._canvas import BLUE, Panel
from prbayes.plots._curves import pointwise_band
from prbayes.plots._ensemble import Ensemble


@dataclass(frozen=True, eq=False)
class Calibrated:
    """The calibrated curve, shape (g,), and the two sides of its band, if there is one."""

    middle: Floats
    band: tuple[Floats, Floats] | None

    @property
    def top(self) -> float:
        """How high it reaches."""
        top = float(self.middle.max())
        if self.band is None:
            return top
        _, upper = self.band
        return max(top, float(upper.max()))


def calibrated(curves: Floats, shown: Ensemble, prob: float) -> Calibrated:
    """Return the optimum's curve, or else the mean of the posterior's, and the band of the others.

    Parameters
    ----------
    curves : ndarray, shape (P, g)
        Of ``shown.every``: the first is the optimum's, if there is one.
    shown : Ensemble
    prob : float
        Share of the curves within the band, at each point.
    """
    count = len(shown.center)
    others = curves[count:]
    middle = curves[0] if count else others.mean(axis=0)
    band = pointwise_band(others, prob) if len(others) else None
    return Calibrated(middle, band)


def draw_calibrated(
    panel: Panel, grid: Floats, found: Calibrated, shown: Ensemble, prob: float
) -> None:
    """Draw the calibrated curve in its band."""
    if found.band is not None:
        text = f"{prob:.0%} band of the {shown.spread}"
        panel.band("band", grid, found.band, BLUE, legend=text)
    text = f"calibrated: {shown.label}"
    panel.line("after", grid, found.middle, BLUE, width=2.2, legend=text)
