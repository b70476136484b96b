"""Outputs as lines: those measured, one for each specimen, in a band of the population."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prbayes._stats import INTERVAL
from prbayes._validate import Floats
from prbayes.plots._canvas import BLUE, DASHED, GREY, VERMILION, Limits, Panel
from prbayes.plots._curves import central_levels
from prbayes.plots._ensemble import Ensemble
from prbayes.plots._panels import Output, is_curve
from prbayes.plots._populations import calibrated
from prbayes.plots._ticks import Ticks


@dataclass(frozen=True, eq=False)
class Axis:
    """Where the outputs stand, and in what units: of many with names, each in its own spread."""

    output: Output
    places: Floats  # (m,)
    order: NDArray[np.intp]  # (m,): of the places
    center: Floats  # (m,)
    unit: Floats  # (m,)

    @classmethod
    def of(cls, output: Output) -> Axis:
        """Return the axis of all outputs of a simulator."""
        outputs = output.node.outputs
        m = len(outputs.labels)
        if is_curve(outputs):
            places = np.array(outputs.labels, dtype=np.float64)
            order = np.argsort(places)
            return cls(output, places, order, np.zeros(m), np.ones(m))
        observed = output.node.observed
        finite = np.where(np.isfinite(observed), observed, np.nan)
        center = np.nanmean(finite, axis=0)
        spread = np.nanstd(finite, axis=0)
        unit = np.where(spread > 0, spread, 1.0)
        places = np.arange(m, dtype=np.float64)
        return cls(output, places, np.arange(m), center, unit)

    def scaled(self, values: Floats) -> Floats:
        """Return values, (..., m), as they are drawn, from left to right."""
        found = (values - self.center) / self.unit
        return np.asarray(found[..., self.order])

    @property
    def x(self) -> Floats:
        """The places from left to right."""
        return self.places[self.order]

    def texts(self, labels: Mapping[str, str] | None) -> tuple[str, str]:
        """Return what stands along the two axes."""
        outputs = self.output.node.outputs
        name = self.output.text(labels)
        if is_curve(outputs):
            return outputs.dim, name
        return outputs.dim, f"{name}, standard deviations from the mean"

    def ticks(self) -> Ticks | None:
        """Return the names of outputs that are not numbers."""
        outputs = self.output.node.outputs
        return None if is_curve(outputs) else (self.places.tolist(), list(outputs.names))


def quantiles(values: Floats, weights: Floats, levels: Floats) -> Floats:
    """Return quantiles of outputs of populations, (P, n, m), (P, n), (L,) -> (P, L, m).

    A specimen without a response counts nowhere, one that failed above all others.
    """
    populations, _, m = values.shape
    out = np.empty((populations, len(levels), m))
    stored = values.strides[0] == 0  # the same values for all populations, sorted once
    for j in range(m):
        for i in range(populations):
            if not (stored and i):
                own = values[i, :, j]
                order = np.argsort(own, kind="stable")
                order = order[: np.count_nonzero(~np.isnan(own))]
                ascending = own[order]
            w = weights[i, order]
            middles = np.cumsum(w) - w / 2
            at = np.searchsorted(middles, levels * w.sum())
            out[i, :, j] = ascending[np.minimum(at, ascending.size - 1)]
    return out


def draw_lines(
    panel: Panel,
    axis: Axis,
    shown: Ensemble,
    after: Floats,
    before: Floats | None,
    prob: float,
    what: str,
) -> Limits:
    """Draw measured lines, and the median and most of the population; return what the axis covers.

    Parameters
    ----------
    panel : Panel
    axis : Axis
    shown : Ensemble
    after : ndarray, shape (P, 3, m)
        Quantiles at `LEVELS` of the populations of ``shown.every``.
    before : ndarray, shape (3, m), or None
    prob : float
        Share of the populations within the band of the median.
    what : str
        What is before.
    """
    measured = axis.scaled(axis.output.node.observed)
    of_populations = axis.scaled(after)
    earlier = None if before is None else axis.scaled(before)
    ylim = _limits(measured, of_populations, earlier)

    # Where the specimens of a line have failed it leaves the picture
    of_populations = _cut(of_populations, ylim)
    lower, median, upper = (calibrated(of_populations[:, i], shown, prob) for i in range(3))
    x = axis.x
    text = f"{INTERVAL:.0%} of the calibrated population"
    panel.band("population", x, (lower.middle, upper.middle), BLUE, alpha=0.25, legend=text)
    panel.line("measured", *_one_line(x, measured), GREY, width=0.5, legend="measured")
    if earlier is not None:
        # The median, and the same share of the population
        at, y = _one_line(x, _cut(earlier, ylim))
        panel.line("before", at, y, VERMILION, style=DASHED, legend=f"before: {what}")
    if median.band is not None:
        text = f"{prob:.0%} band of the {shown.spread}"
        panel.band("band", x, median.band, BLUE, alpha=0.55, legend=text)
    text = f"median, calibrated: {shown.label}"
    panel.line("after", x, median.middle, BLUE, width=2.2, legend=text)
    return ylim


# Of the lines of a population: those that hold most of it, and the median.
LEVELS = np.array([*central_levels(INTERVAL), 0.5])[[0, 2, 1]]


def _one_line(x: Floats, rows: Floats) -> tuple[Floats, Floats]:
    """Return several lines, (n, m), as one with gaps between them; what is not finite is left out.

    A line goes on behind a value that was not measured, and ends where the specimen has failed.
    """
    at, y = [], []
    for row in rows:
        known = np.isfinite(row)
        at.append(np.append(x[known], np.nan))
        y.append(np.append(row[known], np.nan))
    return np.concatenate(at)[:-1], np.concatenate(y)[:-1]


def _limits(measured: Floats, after: Floats, before: Floats | None) -> Limits:
    """Return what the axis covers: data and population, and the one before unless it is far off."""
    typical = np.median(after, axis=0)
    together = np.concatenate([measured.ravel(), typical.ravel()])
    finite = together[np.isfinite(together)]
    low = float(finite.min())
    high = float(finite.max())
    if before is not None:
        # It widens the axis by at most half on each side
        room = 0.5 * (high - low)
        known = before[np.isfinite(before)]
        first = float(known.min(initial=low))
        last = float(known.max(initial=high))
        low = min(low, max(first, low - room))
        high = max(high, min(last, high + room))
    margin = 0.03 * (high - low)
    return low - margin, high + margin


def _cut(line: Floats, limits: Limits) -> Floats:
    """Return a line that ends somewhat outside what the axis covers."""
    low, high = limits
    room = high - low
    return np.clip(line, low - room, high + room)
