"""Measured responses beside those of the calibrated population."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._finding import Finding, report
from prbayes._validate import Floats, flag, positive_integer, share
from prbayes.model.evaluator import Evaluator
from prbayes.model.locking import locked
from prbayes.optimize.optimum import Optimum
from prbayes.plots._canvas import DASHED, INK, VERMILION, Canvas, Panel, refuse_look
from prbayes.plots._curves import (
    GRID_POINTS,
    central_range,
    distribution_functions,
    histogram,
    smooth_densities,
    staircase,
)
from prbayes.plots._ensemble import Ensemble, read_before, read_result, supported
from prbayes.plots._lines import LEVELS, Axis, draw_lines, quantiles
from prbayes.plots._names import refuse_labels
from prbayes.plots._panels import Output, in_one_panel, panels_of
from prbayes.plots._populations import calibrated, draw_calibrated


@locked
def plot_responses(
    result: Optimum | xr.DataTree,
    *,
    model: pm.Model | None = None,
    before: Mapping[str, Any] | bool | None = None,
    ecdf: bool = False,
    prob: float = 0.89,
    n_draws: int | None = None,
    labels: Mapping[str, str] | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the responses before and after a calibration against the measured ones.

    Measured responses are a histogram, in outline, with a mark for each, or steps. The calibrated
    curve is the posterior predictive distribution, or the optimum's population. The band holds the
    share ``prob`` of the populations at each response: those of the posterior's draws, or of the
    optimum's sampling distribution where it is known.

    Of several outputs each has a panel, with those that were measured. A curve, of which the
    outputs' labels are numbers, and more than eight outputs have one panel: a line for each
    specimen, with 89% of the calibrated population at each place, and its median in the band.
    Those of the population before are dashed. More than eight outputs with names are in standard
    deviations of each.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`; or with a ``posterior`` group, from any sampler.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    before : dict or bool, optional
        Hyperparameters before the calibration, in the user's own units; False for none. By default
        the optimiser's first point, if it was given a start or did not look for one, and else the
        prior's initial point; the legend says which.
    ecdf : bool
        Draw distribution functions, which need no bandwidth, in place of densities; of no effect
        on lines.
    prob : float
    n_draws : int, optional
        Number of populations in the band; 200 where they cost no response (`Reweighted`), 40
        elsewhere, where each costs n responses per simulator.
    labels : mapping, optional
        What a reader calls a simulator, or an output, by its name, with units: ``{"crack":
        "relative crack length"}``.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        ``figsize=(8, 5)``, in inches, of the whole picture; others go to
        ``arviz.PlotCollection.wrap``, such as ``col_wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``measured``, ``rug`` (densities only), ``before``, ``band`` and
        ``after``; with lines, ``population``. The panel of an output is called as an element of the
        simulator, ``"frame[first]"``.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, or the result lacks a free variable of the model, or is
        of other populations or data.
    DesignError
        If stored responses do not support the populations.

    Notes
    -----
    Densities of responses are Gaussian kernel densities with Silverman's bandwidth, widened where
    weights are uneven. Specimens that failed (+inf) are missing from the area under a curve.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
    ...     )
    >>> prb.plot_responses(prb.minimize(model), backend="none").viz["after"].name
    'after'
    """
    refuse_look(labels, backend, pc_kwargs)
    flag(ecdf, "ecdf")
    if n_draws is not None:
        positive_integer(n_draws, "n_draws")
    share(prob, "prob")
    shown = read_result(result, model, "prb.plot_responses", n_draws)
    start, what = read_before(result, shown.evaluator, before)
    if len(start) and not supported(shown.evaluator, start)[0]:
        report(
            Finding(
                "population-left-out",
                f"plot_responses: before ({what}): left out, because stored responses do not reach "
                "there.",
            )
        )
        start = start[:0]
    by_simulator = panels_of(shown.evaluator.simulators)
    names = [output.name for panels in by_simulator for output in panels]
    refuse_labels(labels, names, evaluator=shown.evaluator)
    lines = any(in_one_panel(node.outputs) for node in shown.evaluator.simulators)
    size = (7.2, 4.8) if lines else (5.4, 4.2)
    canvas = Canvas(names, size=size, backend=backend, pc_kwargs=pc_kwargs)
    drawing = _Drawing(shown, what, prob, labels, ecdf=ecdf)
    covered: dict[str, tuple[float, float]] = {}
    drawn = []
    for k, panels in enumerate(by_simulator):
        every = _simulate(shown.evaluator, shown.every, k)
        first = _simulate(shown.evaluator, start, k) if len(start) else None
        for output in panels:
            after = every.of(output)
            earlier = None if first is None else first.of(output)
            drawn.append((output, after, earlier))
            if after.values.ndim == 2:
                own = _covered(output.measured()[0], after, earlier)
                low, high = covered.get(output.axis, own)
                covered[output.axis] = min(low, own[0]), max(high, own[1])
    for output, after, earlier in drawn:
        panel = canvas.panel(output.name)
        if after.values.ndim == 2:
            drawing.distribution(panel, output, after, earlier, covered[output.axis])
        else:
            drawing.lines(panel, output, after, earlier)
    return canvas.finish()


@dataclass(frozen=True, eq=False)
class _Drawing:
    """What the panels have in common."""

    shown: Ensemble
    what: str  # is before
    prob: float
    labels: Mapping[str, str] | None
    ecdf: bool

    def distribution(
        self,
        panel: Panel,
        output: Output,
        after: _Simulated,
        earlier: _Simulated | None,
        covered: tuple[float, float],
    ) -> None:
        """Draw the distribution of one output, from the data to what explains them."""
        observed, weights = output.measured()
        grid = np.linspace(*covered, GRID_POINTS)

        curves = after.curves(grid, ecdf=self.ecdf)
        found = calibrated(curves, self.shown, self.prob)
        data_top = _draw_measured(panel, observed, weights, covered, ecdf=self.ecdf)
        ylim = None
        if earlier is not None:
            (y,) = earlier.curves(grid, ecdf=self.ecdf)
            text = f"before: {self.what}"
            panel.line("before", grid, y, VERMILION, style=DASHED, legend=text)
            ylim = _cut(y, max(data_top, found.top))
        draw_calibrated(panel, grid, found, self.shown, self.prob)
        failed = np.count_nonzero(np.isinf(observed))
        panel.axes(
            x=output.text(self.labels),
            y="share of specimens" if self.ecdf else "density",
            title=f"{observed.size} measured values" + (f", {failed} failed" if failed else ""),
            xlim=covered,
            ylim=ylim,
        )

    def lines(
        self, panel: Panel, output: Output, after: _Simulated, earlier: _Simulated | None
    ) -> None:
        """Draw all outputs, a line for each specimen."""
        axis = Axis.of(output)
        start = None
        if earlier is not None:
            (start,) = quantiles(earlier.values, earlier.weights, LEVELS)
        found = quantiles(after.values, after.weights, LEVELS)
        ylim = draw_lines(panel, axis, self.shown, found, start, self.prob, self.what)
        observed = output.node.observed
        incomplete = np.count_nonzero(np.isnan(observed).any(axis=1))
        failed = np.count_nonzero(np.isinf(observed).any(axis=1))
        title = f"{len(observed)} measured specimens"
        title += f", {incomplete} incomplete" if incomplete else ""
        title += f", {failed} failed" if failed else ""
        x, y = axis.texts(self.labels)
        panel.axes(x=x, y=y, title=title, ylim=ylim, xticks=axis.ticks())


@dataclass(frozen=True, eq=False)
class _Simulated:
    """Responses and weights of populations, shape (P, n) each; of outputs, values (P, n, m)."""

    values: Floats
    weights: Floats

    def of(self, output: Output) -> _Simulated:
        """Return what is simulated of one output."""
        return _Simulated(output.of(self.values), self.weights)

    def curves(self, grid: Floats, *, ecdf: bool) -> Floats:
        """Return distribution functions or densities on a grid, shape (P, g)."""
        if ecdf:
            return distribution_functions(self.values, self.weights, grid)
        return smooth_densities(self.values, self.weights, grid)


def _simulate(evaluator: Evaluator, thetas: Floats, k: int) -> _Simulated:
    """Return the responses of the k-th simulator's populations."""
    return _Simulated(*evaluator.populations(thetas, k))


def _covered(
    observed: Floats, after: _Simulated, earlier: _Simulated | None
) -> tuple[float, float]:
    """Return what the axis covers: data and populations, the earlier one unless it is far off."""
    finite = observed[np.isfinite(observed)]
    # Hardly any of the calibrated population is beyond the axis; of the one before, which is there
    # to be compared, more, and it widens the axis by at most half on each side.
    low, high = central_range(after.values, after.weights, tail=0.005)
    low = min(low, finite.min())
    high = max(high, finite.max())
    if earlier is not None:
        first, last = central_range(earlier.values, earlier.weights, tail=0.05)
        room = 0.5 * (high - low)
        low = min(low, max(first, low - room))
        high = max(high, min(last, high + room))
    margin = 0.03 * (high - low)
    return float(low - margin), float(high + margin)


def _cut(before: Floats, top: float) -> tuple[float, float] | None:
    """Return where the axis ends if a narrow peak before would dwarf all else, up to ``top``."""
    tallest = 2 * top
    if before.max() <= tallest:
        return None
    return -0.05 * top, tallest


def _draw_measured(
    panel: Panel, observed: Floats, weights: Floats, covered: tuple[float, float], *, ecdf: bool
) -> float:
    """Draw the data; return how high they reach."""
    if ecdf:
        x, y = staircase(observed, weights, *covered)
        panel.line("measured", x, y, INK, width=1.4, legend="measured")
        return 1.0
    x, y = histogram(observed, weights)
    panel.line("measured", x, y, INK, width=0.9, legend="measured")
    each = observed[np.isfinite(observed)]
    panel.points("rug", each, 0.0, INK, marker="|", size=60)
    return float(y.max())
