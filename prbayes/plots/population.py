"""The calibrated population of each input."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._validate import positive_integer, share
from prbayes.model.locking import locked
from prbayes.optimize.optimum import Optimum
from prbayes.plots._canvas import BLUE, DASHED, SOLID, Canvas, Panel, refuse_look
from prbayes.plots._ensemble import Ensemble, read_result
from prbayes.plots._margins import Margin, chosen, margin_densities, margins
from prbayes.plots._names import named, refuse_labels
from prbayes.plots._populations import calibrated, draw_calibrated
from prbayes.plots._regions import outlines
from prbayes.response.distributions import PopulationSampler

# Elements of a multivariate input that are drawn in pairs: three panels.
_IN_PAIRS = 3
# Specimens of which an outline is drawn: its line is smooth.
_OUTLINED = 200_000


@locked
def plot_population(
    result: Optimum | xr.DataTree,
    *,
    model: pm.Model | None = None,
    inputs: Sequence[Any] | None = None,
    prob: float = 0.89,
    n_draws: int | None = None,
    labels: Mapping[str, str] | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the calibrated population of each aleatory input, with its uncertainty.

    Of a multivariate input each margin has a panel, and so has each pair of its first three
    elements: outlines of the smallest regions that hold half of the population, and the share
    ``prob``.

    The curve is the posterior predictive density of the input, or its density at the optimum; the
    band holds the share ``prob`` of the densities at each value. It computes no response.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`; or with a ``posterior`` group, from any sampler.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    inputs : sequence, optional
        Names, or ``.dist()`` objects; all by default. An input is called as the response's argument
        that takes it.
    prob : float
    n_draws : int, optional
        Number of populations in the band; 200 by default.
    labels : mapping, optional
        What a reader calls an input, by its name, with units.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        ``figsize=(8, 5)``, in inches, of the whole picture; others go to
        ``arviz.PlotCollection.wrap``, such as ``col_wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``band`` and ``after``; of pairs, ``half`` and ``region``.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, there is no such input, or the result lacks a free
        variable, or is of other populations or data than the model.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y", lambda load: 2 * load, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
    ...     )
    >>> list(prb.plot_population(prb.minimize(model), backend="none").viz["after"])
    ['load']
    """
    refuse_look(labels, backend, pc_kwargs)
    if n_draws is not None:
        positive_integer(n_draws, "n_draws")
    share(prob, "prob")
    shown = read_result(result, model, "prb.plot_population", n_draws, free=True)
    wanted = chosen(margins(shown.evaluator), inputs)
    found = margin_densities(shown.evaluator, wanted, shown.every)
    names = [margin.name for margin in wanted]
    refuse_labels(labels, names, evaluator=shown.evaluator)
    pairs = _pairs(wanted)
    panels = [*names, *pairs]
    canvas = Canvas(panels, size=(4.6, 3.9), backend=backend, pc_kwargs=pc_kwargs)
    for margin in wanted:
        panel = canvas.panel(margin.name)
        grid, curves = found[margin.name]
        after = calibrated(curves, shown, prob)
        draw_calibrated(panel, grid, after, shown, prob)
        y = "probability" if margin.discrete else "density"
        panel.axes(x=named(margin.name, labels), y=y)
    for name, (x, other) in pairs.items():
        panel = canvas.panel(name)
        correlation = _draw_pair(panel, shown, x, other, prob)
        panel.axes(
            x=named(x.name, labels),
            y=named(other.name, labels),
            title=f"correlation {correlation:.2f}",
        )
    return canvas.finish()


def _pairs(wanted: list[Margin]) -> dict[str, tuple[Margin, Margin]]:
    """Return the pairs that are drawn, by name: of the first elements of a multivariate input."""
    found = {}
    for first in wanted:
        together = [m for m in wanted if m.dist is first.dist and m.group == first.group]
        together = together[:_IN_PAIRS]
        if first not in together or first.discrete:
            continue
        for other in together[together.index(first) + 1 :]:
            found[f"{other.name}, {first.name}"] = (first, other)
    return found


def _draw_pair(panel: Panel, shown: Ensemble, x: Margin, y: Margin, prob: float) -> float:
    """Draw the outlines of regions of a population, the posterior's mixture of them, or one.

    Return the correlation within it.
    """
    thetas = shown.center if len(shown.center) else shown.thetas
    evaluator = shown.evaluator
    sampler = PopulationSampler(evaluator.simulators[x.node].inputs)
    roots = evaluator.roots(thetas, x.node)
    number = max(2, _OUTLINED // len(thetas))
    aleatory, _ = sampler(roots, number, np.random.default_rng(0))
    values: Any = aleatory[x.position]  # (P, n, *event)
    points = np.column_stack([values[(..., *margin.index)].ravel() for margin in (x, y)])
    points = points[np.isfinite(points).all(axis=1)]
    weights = np.full(len(points), 1 / len(points))
    drawn = {"half": (0.5, DASHED), "region": (prob, SOLID)}
    lines = outlines(points, weights, tuple(held for held, _ in drawn.values()))
    for (visual, (held, style)), line in zip(drawn.items(), lines, strict=True):
        across, up = line
        text = f"{held:.0%} of the calibrated population: {shown.label}"
        panel.line(visual, across, up, BLUE, style=style, width=1.5, legend=text)
    correlations: Any = np.corrcoef(points.T)
    return float(correlations[0, 1])
