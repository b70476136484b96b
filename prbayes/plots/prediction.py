"""Measured responses that a calibration has not seen, beside what it predicts of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from prbayes._stats import INTERVAL
from prbayes._validate import Floats, share
from prbayes.plots._canvas import BLUE, INK, Canvas, Panel, refuse_look
from prbayes.plots._curves import (
    GRID_POINTS,
    central_range,
    distribution_functions,
    pointwise_band,
    staircase,
)
from prbayes.plots._names import named, refuse_labels
from prbayes.validation.conditions import Comparable, comparables


def plot_prediction(
    observed: Any,
    predicted: xr.DataArray | Mapping[str, xr.DataArray],
    *,
    prob: float = INTERVAL,
    labels: Mapping[str, str] | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the distribution functions of measured responses and of what was predicted of them.

    The steps are those of the measured values; the curve is the predicted distribution of all
    populations together, and the band holds the share ``prob`` of the populations at each
    response. Steps that leave the band over a long stretch are what `area_test` tests. Specimens
    that failed (+inf) are what the steps lack of one at the right.

    Parameters
    ----------
    observed : array_like, shape (n,) or (n, m), or a mapping of such
        Of specimens that were not used in the calibration; by condition, if by name.
    predicted : xarray.DataArray, or a mapping of such
        From `predict`: dims (chain, draw, sample), and one of outputs; by the same names.
    prob : float
        Share of the populations in the band.
    labels : mapping, optional
        What a reader calls a condition or an output, by its name, with units.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        ``figsize=(8, 5)``, in inches, of the whole picture; others go to
        ``arviz.PlotCollection.wrap``, such as ``col_wrap``.

    Returns
    -------
    arviz.PlotCollection
        A panel for each condition and output; of more than eight outputs eight from the first to
        the last. Its ``viz`` has the artists ``band``, ``predicted`` and ``measured``.

    Raises
    ------
    TypeError, ValueError, KeyError
        If an argument is not as described, or measured and predicted are of different conditions or
        outputs.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", np.exp, x, metric=prb.AreaMetric(), observed=[1.0, 2.0, 4.0])
    >>> later = prb.predict(prb.minimize(model), lambda x: 2 * np.exp(x), x, name="later")
    >>> list(prb.plots.plot_prediction([2.5, 3.0, 9.0], later, backend="none").viz["measured"])
    ['later']
    """
    refuse_look(labels, backend, pc_kwargs)
    prob = share(prob, "prob")
    found = comparables(observed, predicted, "plot_prediction")
    names = [one.name for one in found]
    refuse_labels(labels, names)
    canvas = Canvas(names, size=(5.0, 3.9), backend=backend, pc_kwargs=pc_kwargs)
    for one in found:
        panel = canvas.panel(one.name)
        _draw(panel, _Distributions.of(one), prob)
        failed = np.count_nonzero(np.isinf(one.measured))
        title = f"{one.measured.size} measured values" + (f", {failed} failed" if failed else "")
        panel.axes(x=named(one.name, labels), y="share of specimens", title=title)
    return canvas.finish()


@dataclass(frozen=True, eq=False)
class _Distributions:
    """Distribution functions on a grid, shapes (g,) and (P, g), and the steps of the data."""

    grid: Floats
    of_populations: Floats
    steps: tuple[Floats, Floats]

    @classmethod
    def of(cls, one: Comparable) -> _Distributions:
        weights = one.weights
        low, high = central_range(one.predicted, weights, tail=0.005)
        finite = one.measured[np.isfinite(one.measured)]
        if finite.size:
            low = min(low, float(finite.min()))
            high = max(high, float(finite.max()))
        margin = 0.03 * (high - low) or 0.01 * max(abs(low), 1.0)
        grid = np.linspace(low - margin, high + margin, GRID_POINTS)
        curves = distribution_functions(one.predicted, weights, grid)
        equal = np.full(one.measured.size, 1 / one.measured.size)
        return cls(grid, curves, staircase(one.measured, equal, grid[0], grid[-1]))


def _draw(panel: Panel, found: _Distributions, prob: float) -> None:
    """Draw the band and the curve of what was predicted, and the steps of what was measured."""
    if len(found.of_populations) > 1:
        band = pointwise_band(found.of_populations, prob)
        text = f"{prob:.0%} of the populations"
        panel.band("band", found.grid, band, BLUE, legend=text)
    middle = found.of_populations.mean(axis=0)
    panel.line("predicted", found.grid, middle, BLUE, width=2.2, legend="predicted")
    panel.line("measured", *found.steps, INK, width=1.4, legend="measured")
