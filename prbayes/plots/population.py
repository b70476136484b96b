"""The calibrated population of each input."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._stats import INTERVAL
from prbayes._validate import share
from prbayes.model.locking import locked
from prbayes.optimize.optimum import Optimum
from prbayes.plots._canvas import BLUE, DASHED, SOLID, Canvas, Panel, refuse_look
from prbayes.plots._ensemble import Calibrated, Ensemble, read_result
from prbayes.plots._labels import named, refuse_labels
from prbayes.plots._margins import Margin, margin_densities, margins, select_margins
from prbayes.plots._regions import outlines
from prbayes.response.distributions import PopulationSampler


@locked
def plot_population(
    result: Optimum | xr.DataTree,
    *,
    model: pm.Model | None = None,
    inputs: Sequence[Any] | None = None,
    prob: float = INTERVAL,
    n_draws: int | None = None,
    labels: Mapping[str, str] | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the calibrated population of each aleatory input, with its uncertainty.

    The curve is the posterior predictive density of the input, or its density at the optimum; the
    band contains the share ``prob`` of the densities at each value. Each pair of the first three
    elements of a multivariate input has a panel too, with the smallest regions that contain half
    of the population, and the share ``prob``. No response is computed.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`; or with a ``posterior`` group, from any sampler.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    inputs : sequence, optional
        Names, or ``.dist()`` objects; all by default. The name of an input is that of the
        response's argument.
    prob : float
    n_draws : int, optional
        Number of populations in the band; 200 by default.
    labels : mapping, optional
        Labels of inputs by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, and keywords of ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``band`` and ``after``; of pairs, ``half`` and ``region``.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, an input is unknown, or the result lacks a free
        variable, or is of other populations or data than the model.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y", lambda load: 2 * load, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
    ...     )
    >>> list(prb.plot_population(prb.minimize(model)).viz["after"])
    ['load']
    """
    refuse_look(labels, pc_kwargs)
    share(prob, "prob")
    ensemble = read_result(result, model, "prb.plot_population", n_draws, free=True)
    shown = select_margins(margins(ensemble.evaluator), inputs)
    densities = margin_densities(ensemble.evaluator, shown, ensemble.every)
    names = [margin.name for margin in shown]
    refuse_labels(labels, names, evaluator=ensemble.evaluator)
    pairs = _pairs(shown)
    canvas = Canvas([*names, *pairs], size=(4.6, 3.9), pc_kwargs=pc_kwargs)
    for margin in shown:
        panel = canvas.panel(margin.name)
        grid, curves = densities[margin.name]
        Calibrated.of(curves, ensemble, prob).draw(panel, grid, ensemble, prob)
        y = "probability" if margin.discrete else "density"
        panel.axes(x=named(margin.name, labels), y=y)
    for name, (first, second) in pairs.items():
        panel = canvas.panel(name)
        correlation = _draw_pair(panel, ensemble, first, second, prob)
        title = f"correlation {correlation:.2f}"
        panel.axes(x=named(first.name, labels), y=named(second.name, labels), title=title)
    return canvas.finish()


def _pairs(shown: list[Margin]) -> dict[str, tuple[Margin, Margin]]:
    """Return the pairs of the first three elements of each multivariate input, by name."""
    pairs = {}
    for x in shown:
        elements = [m for m in shown if m.dist is x.dist and m.group == x.group][:3]
        if x in elements and not x.discrete:
            for y in elements[elements.index(x) + 1 :]:
                pairs[f"{y.name}, {x.name}"] = (x, y)
    return pairs


def _draw_pair(panel: Panel, ensemble: Ensemble, x: Margin, y: Margin, prob: float) -> float:
    """Draw outlines of regions of the calibrated population; return the correlation within it."""
    thetas = ensemble.mixture
    evaluator = ensemble.evaluator
    sampler = PopulationSampler(evaluator.simulators[x.node].inputs)
    roots = evaluator.roots(thetas, x.node)
    # 200 000 specimens in all make a smooth line.
    n = max(2, 200_000 // len(thetas))
    aleatory, _ = sampler(roots, n, np.random.default_rng(0))
    values: Any = aleatory[x.position]  # (P, n, *event)
    points = np.column_stack([values[(..., *margin.index)].ravel() for margin in (x, y)])
    points = points[np.isfinite(points).all(axis=1)]
    weights = np.full(len(points), 1 / len(points))
    regions = {"half": (0.5, DASHED), "region": (prob, SOLID)}
    lines = outlines(points, weights, tuple(p for p, _ in regions.values()))
    for (visual, (p, style)), (across, up) in zip(regions.items(), lines, strict=True):
        text = f"{p:.0%} of the calibrated population: {ensemble.label}"
        panel.line(visual, across, up, BLUE, style=style, width=1.5, legend=text)
    correlations: Any = np.corrcoef(points.T)
    return float(correlations[0, 1])
