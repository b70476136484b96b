"""Measured responses beside those of the calibrated population."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._stats import INTERVAL
from prbayes._validate import Floats, flag, share
from prbayes.model.locking import locked
from prbayes.optimize.optimum import Optimum
from prbayes.plots._canvas import DASHED, INK, VERMILION, Canvas, Limits, Panel, refuse_look
from prbayes.plots._curves import (
    GRID_POINTS,
    axis_range,
    central_range,
    distribution_functions,
    histogram,
    smooth_densities,
    staircase,
)
from prbayes.plots._ensemble import Calibrated, Ensemble, if_supported, read_before, read_result
from prbayes.plots._labels import refuse_labels
from prbayes.plots._panels import (
    LEVELS,
    Axis,
    Output,
    draw_lines,
    in_one_panel,
    panels_of,
    quantiles,
)


@locked
def plot_responses(
    result: Optimum | xr.DataTree,
    *,
    model: pm.Model | None = None,
    before: Mapping[str, Any] | bool | None = None,
    ecdf: bool = False,
    prob: float = INTERVAL,
    n_draws: int | None = None,
    labels: Mapping[str, str] | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the responses before and after a calibration against the measured ones.

    Measured responses are a histogram with a mark for each, or steps. The calibrated curve is the
    posterior predictive distribution, or the optimum's population. The band contains the share
    ``prob`` of the populations at each response: those of the posterior's draws, or of the
    optimum's sampling distribution if it is known.

    Each of several outputs has a panel. A curve, whose labels are numbers, and more than eight
    outputs have one panel: a line for each specimen, 89% of the calibrated population at each
    place, and its median in the band; dashed lines are the population before. More than eight
    outputs with names are in standard deviations of each.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`; or with a ``posterior`` group, from any sampler.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    before : dict or bool, optional
        Hyperparameters before the calibration, in the user's own units; False for none. By default
        the optimiser's first point, if it was given a start or did not screen for one, otherwise
        the prior's initial point; the legend names it.
    ecdf : bool
        Draw distribution functions, which need no bandwidth, instead of densities; without effect
        on lines.
    prob : float
    n_draws : int, optional
        Number of populations in the band; by default 200 where they cost no response
        (`Reweighted`), otherwise 40, each of which costs n responses per simulator.
    labels : mapping, optional
        Labels of simulators or outputs by name, with units: ``{"crack": "relative length"}``.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, and keywords of ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``measured``, ``rug`` (densities only), ``before``, ``band`` and
        ``after``; with lines, ``population``. The panel of an output has the name of an element of
        the simulator, ``"frame[first]"``.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, or the result lacks a free variable of the model, or is
        of other populations or data.
    DesignError
        If stored responses do not support the populations.

    Notes
    -----
    Densities of responses are Gaussian kernel densities with Silverman's bandwidth, wider where
    weights are uneven. The area under a curve is the share of specimens that have not failed.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
    ...     )
    >>> prb.plot_responses(prb.minimize(model)).viz["after"].name
    'after'
    """
    refuse_look(labels, pc_kwargs)
    flag(ecdf, "ecdf")
    share(prob, "prob")
    ensemble = read_result(result, model, "prb.plot_responses", n_draws)
    evaluator = ensemble.evaluator
    start, text = read_before(result, evaluator, before)
    start = if_supported(evaluator, start, f"plot_responses: before ({text})")
    by_simulator = panels_of(evaluator.simulators)
    names = [output.name for panels in by_simulator for output in panels]
    refuse_labels(labels, names, evaluator=evaluator)
    has_lines = any(in_one_panel(node.outputs) for node in evaluator.simulators)
    size = (7.2, 4.8) if has_lines else (5.4, 4.2)
    canvas = Canvas(names, size=size, pc_kwargs=pc_kwargs)
    picture = _Picture(ensemble, text, prob, labels, ecdf=ecdf)
    limits: dict[str, Limits] = {}  # by axis: panels of groups have one
    contents = []
    for k, panels in enumerate(by_simulator):
        populations = evaluator.populations(ensemble.every, k)
        earlier = evaluator.populations(start, k) if len(start) else None
        for output in panels:
            sample = _Sample.of(output, populations)
            first = None if earlier is None else _Sample.of(output, earlier)
            contents.append((output, sample, first))
            if sample.values.ndim == 2:
                low, high = _axis_limits(output, sample, first)
                least, most = limits.get(output.axis, (low, high))
                limits[output.axis] = min(low, least), max(high, most)
    for output, sample, first in contents:
        panel = canvas.panel(output.name)
        if sample.values.ndim == 2:
            picture.distribution(panel, output, sample, first, limits[output.axis])
        else:
            picture.lines(panel, output, sample, first)
    return canvas.finish()


@dataclass(frozen=True, eq=False)
class _Sample:
    """Responses and weights of populations, shape (P, n) each; of outputs, values (P, n, m)."""

    values: Floats
    weights: Floats

    @classmethod
    def of(cls, output: Output, populations: tuple[Floats, Floats]) -> _Sample:
        values, weights = populations
        return cls(output.of(values), weights)

    def curves(self, grid: Floats, *, ecdf: bool) -> Floats:
        """Return distribution functions or densities on a grid, shape (P, g)."""
        function = distribution_functions if ecdf else smooth_densities
        return function(self.values, self.weights, grid)


def _axis_limits(output: Output, sample: _Sample, earlier: _Sample | None) -> Limits:
    """Return the range of the axis; more of the population before is beyond it."""
    widest = None if earlier is None else central_range(earlier.values, earlier.weights, tail=0.05)
    observed, _ = output.measured()
    return axis_range(observed, central_range(sample.values, sample.weights, tail=0.005), widest)


@dataclass(frozen=True, eq=False)
class _Picture:
    """Settings that all panels share."""

    ensemble: Ensemble
    start: str  # name of the population before
    prob: float
    labels: Mapping[str, str] | None
    ecdf: bool

    def distribution(
        self,
        panel: Panel,
        output: Output,
        sample: _Sample,
        earlier: _Sample | None,
        limits: Limits,
    ) -> None:
        """Draw the distribution of one output: data first, then the populations."""
        observed, weights = output.measured()
        grid = np.linspace(*limits, GRID_POINTS)
        curves = sample.curves(grid, ecdf=self.ecdf)
        calibrated = Calibrated.of(curves, self.ensemble, self.prob)
        if self.ecdf:
            x, y = staircase(observed, weights, *limits)
            panel.line("measured", x, y, INK, width=1.4, legend="measured")
        else:
            x, y = histogram(observed, weights)
            panel.line("measured", x, y, INK, width=0.9, legend="measured")
            finite = observed[np.isfinite(observed)]
            panel.points("rug", finite, 0.0, INK, marker="|", size=60)
        top = max(1.0 if self.ecdf else float(y.max()), calibrated.top)
        ylim = None
        if earlier is not None:
            (curve,) = earlier.curves(grid, ecdf=self.ecdf)
            text = f"before: {self.start}"
            panel.line("before", grid, curve, VERMILION, style=DASHED, legend=text)
            if curve.max() > 2 * top:  # a narrow peak before would dwarf all other curves
                ylim = (-0.05 * top, 2 * top)
        calibrated.draw(panel, grid, self.ensemble, self.prob)
        failed = np.count_nonzero(np.isinf(observed))
        panel.axes(
            x=output.text(self.labels),
            y="share of specimens" if self.ecdf else "density",
            title=f"{observed.size} measured values" + (f", {failed} failed" if failed else ""),
            xlim=limits,
            ylim=ylim,
        )

    def lines(self, panel: Panel, output: Output, sample: _Sample, earlier: _Sample | None) -> None:
        """Draw all outputs, a line for each specimen."""
        axis = Axis.of(output)
        start = None
        if earlier is not None:
            (start,) = quantiles(earlier.values, earlier.weights, LEVELS)
        lines = quantiles(sample.values, sample.weights, LEVELS)
        ylim = draw_lines(panel, axis, self.ensemble, lines, start, self.prob, self.start)
        observed = output.node.observed
        incomplete = np.count_nonzero(np.isnan(observed).any(axis=1))
        failed = np.count_nonzero(np.isinf(observed).any(axis=1))
        title = f"{len(observed)} measured specimens"
        title += f", {incomplete} incomplete" if incomplete else ""
        title += f", {failed} failed" if failed else ""
        x, y = axis.texts(self.labels)
        panel.axes(x=x, y=y, title=title, ylim=ylim, xticks=axis.ticks())
