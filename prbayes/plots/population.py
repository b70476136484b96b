"""The calibrated population of each aleatory input, by margins."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import xarray as xr

from prbayes._display import percentage
from prbayes._stats import INTERVAL
from prbayes._validate import ArrayPair, Floats, Labels, complete_rows, share
from prbayes.model.evaluator import Evaluator
from prbayes.model.locking import locked
from prbayes.model.margins import Margin, margins
from prbayes.model.parameters import variable_of
from prbayes.optimize.optimum import Optimum
from prbayes.plots.canvas import BLUE, check_options, finish, panels, refuse_labels, with_label
from prbayes.plots.curves import GRID_POINTS, central_range, outlines, smooth_densities
from prbayes.plots.ensemble import Ensemble, draw_calibrated, read_result
from prbayes.plots.selection import Coords, FilterVars, VarNames, select
from prbayes.response.compile import compile_batched
from prbayes.response.distributions import MVNORMAL, PopulationSampler
from prbayes.response.inputs import Inputs

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@locked
def plot_population(
    result: Optimum | xr.DataTree,
    *,
    model: pm.Model | None = None,
    var_names: VarNames | None = None,
    filter_vars: FilterVars | None = None,
    coords: Coords | None = None,
    prob: float = INTERVAL,
    n_draws: int | None = None,
    labels: Labels | None = None,
    **pc_kwargs: Any,
) -> Figure:
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
    var_names : str or sequence of str, optional
        Inputs, or elements of them, in this order; all by default. The name of an input is that
        of its distribution or of the response's argument.
    filter_vars : {None, "like", "regex"}
        How ``var_names`` are read, as by ArviZ.
    coords : mapping, optional
        Labels by dimension: of groups, such as ``{"supplier": ["Adler"]}``; ``{"x_dim_0": [0]}``
        is the first element of a multivariate input.
    prob : float
        Share of the populations in the band.
    n_draws : int, optional
        Number of populations in the band; 200 by default.
    labels : mapping, optional
        Labels of inputs by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, ``col_wrap`` panels in a row, and ``figure_kwargs`` for
        ``matplotlib.pyplot.figure``.

    Returns
    -------
    matplotlib.figure.Figure
        With a panel for each input, whose label is its name, and for each pair.

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
    >>> prb.plots.plot_population(prb.minimize(model)).axes[0].get_label()
    'load'
    """
    check_options(labels, pc_kwargs)
    share(prob, "prob")
    ensemble = read_result(result, model, "prb.plots.plot_population", n_draws, free=True)
    available = {margin.name: margin for margin in margins(ensemble.evaluator)}
    elements = {
        name: (variable_of(name), _coordinates(ensemble.evaluator, margin))
        for name, margin in available.items()
    }
    names = select(elements, var_names, filter_vars, coords)
    shown = [available[name] for name in names]
    densities = margin_densities(ensemble.evaluator, shown, ensemble.every)
    refuse_labels(labels, names, evaluator=ensemble.evaluator)
    pairs = _pairs(shown)
    figure, axes = panels([*names, *pairs], size=(4.6, 3.9), pc_kwargs=pc_kwargs)
    for margin in shown:
        axis = axes[margin.name]
        grid, curves = densities[margin.name]
        draw_calibrated(axis, grid, curves, ensemble, prob)
        y = "probability" if margin.discrete else "density"
        axis.set(xlabel=with_label(margin.name, margin.unit, labels), ylabel=y)
    for name, (first, second) in pairs.items():
        correlation = _draw_pair(axes[name], ensemble, first, second, prob)
        x, y = (with_label(margin.name, margin.unit, labels) for margin in (first, second))
        axes[name].set(xlabel=x, ylabel=y, title=f"correlation {correlation:.2f}")
    return finish(figure)


def _coordinates(evaluator: Evaluator, margin: Margin) -> dict[str, Any]:
    """Return the coordinates of a margin: its group, and its index in a multivariate input."""
    variable = variable_of(margin.name)
    places = {f"{variable}_dim_{i}": x for i, x in enumerate(margin.index)}
    groups = evaluator.simulators[margin.node].inputs.groups
    if groups is not None and margin.group:
        places[groups.dim] = groups.labels[groups.names.index(margin.group)]
    return places


def _pairs(shown: list[Margin]) -> dict[str, tuple[Margin, Margin]]:
    """Return the pairs of the first three elements of each multivariate input, by name."""
    pairs = {}
    for x in shown:
        elements = [m for m in shown if m.dist is x.dist and m.group == x.group][:3]
        if x in elements and not x.discrete:
            for y in elements[elements.index(x) + 1 :]:
                pairs[f"{y.name}, {x.name}"] = (x, y)
    return pairs


def _draw_pair(axis: Axes, ensemble: Ensemble, x: Margin, y: Margin, prob: float) -> float:
    """Draw outlines of regions of the calibrated population; return the correlation within it."""
    # With 200 000 specimens in all the line is smooth.
    n = max(2, 200_000 // len(ensemble.mixture))
    draws = _draws(ensemble.evaluator, x.node, ensemble.mixture, n, seed=0)
    points = np.column_stack([_values(draws, margin).ravel() for margin in (x, y)])
    points = points[complete_rows(points)]
    weights = np.full(len(points), 1 / len(points))
    half, region = outlines(points, weights, (0.5, prob))
    for gid, p, line, style in (("half", 0.5, half, "--"), ("region", prob, region, "-")):
        text = f"{percentage(p)} of the calibrated population: {ensemble.label}"
        axis.plot(*line, style, color=BLUE, linewidth=1.5, label=text, gid=gid)
    correlations: Any = np.corrcoef(points.T)
    return float(correlations[0, 1])


# -- margins ---------------------------------------------------------------------------------


def margin_densities(
    evaluator: Evaluator, shown: list[Margin], thetas: Floats
) -> dict[str, ArrayPair]:
    """Return by margin a grid, shape (g,), and densities at thetas, shape (P, g); or probabilities.

    They are exact where the input has an elementwise density or is a multivariate normal, otherwise
    kernel densities, or shares, of random draws. No response is computed. The populations of
    several groups have one grid.
    """
    nodes = sorted({margin.node for margin in shown})
    # Specimens of 40 populations show the range of each axis.
    ranges: dict[Any, tuple[float, float]] = {}
    thinned = thetas[:: max(1, len(thetas) // 40)]
    few = {k: _draws(evaluator, k, thinned, 400, seed=0) for k in nodes}
    for margin in shown:
        values = _values(few[margin.node], margin)
        first, last = central_range(values, np.full(values.shape, 1 / values.shape[1]), tail=0.002)
        low, high = ranges.get(margin.axis, (first, last))
        ranges[margin.axis] = min(low, first), max(high, last)

    # Specimens of all populations, by simulator. They are drawn for kernel densities alone.
    many = {}
    densities = {}
    for margin in shown:
        k = margin.node
        low, high = ranges[margin.axis]
        grid = np.linspace(low, high, GRID_POINTS)
        if margin.discrete:
            grid = np.arange(np.floor(low), np.ceil(high) + 1)
        y = _exact(evaluator.simulators[k].inputs, margin, evaluator.parents(thetas, k), grid)
        if y is None:
            if k not in many:
                many[k] = _draws(evaluator, k, thetas, 1600, seed=1)
            values = _values(many[k], margin)
            if margin.discrete:
                y = np.column_stack([(values == x).mean(axis=1) for x in grid])
            else:
                weights = np.full(values.shape, 1 / values.shape[1])
                y = smooth_densities(values, weights, grid)
        densities[margin.name] = grid, y
    return densities


def _draws(evaluator: Evaluator, k: int, thetas: Floats, n: int, seed: int) -> Any:
    """Return n specimens of each population of the k-th simulator's aleatory inputs."""
    sampler = PopulationSampler(evaluator.simulators[k].inputs)
    return sampler(evaluator.parents(thetas, k), n, np.random.default_rng(seed))[0]


def _values(draws: Any, margin: Margin) -> Floats:
    """Return the draws of a margin, shape (P, n)."""
    return np.asarray(draws[margin.position][(..., *margin.index)], dtype=np.float64)


def _exact(inputs: Inputs, margin: Margin, parents: list[Floats], grid: Floats) -> Floats | None:
    """Return the densities of a margin, (P, g); None if PyMC has no density of one element."""
    if inputs.nested or inputs.covariates:
        return None
    symbols = inputs.placeholders()
    dists, *_ = inputs.rebuilt(symbols)
    dist = dists[margin.position]
    x = pt.lvector("x") if margin.discrete else pt.dvector("x")
    if isinstance(dist.owner.op, MVNORMAL):
        mean, covariance = dist.owner.op.dist_params(dist.owner)
        (i,) = margin.index
        logp = pm.logp(pm.Normal.dist(mean[i], pt.sqrt(covariance[i, i])), x)
    else:
        # All elements have the same value, because the density of each is evaluated by itself.
        columns = pt.shape_padright(x, dist.type.ndim)
        try:
            logp = pm.logp(dist, columns + pt.zeros_like(dist), warn_rvs=False)
        except NotImplementedError:
            return None
        if logp.type.ndim != 1 + dist.type.ndim:
            return None  # The density is one of all elements together.
        logp = logp[(slice(None), *margin.index)]
    function = compile_batched(symbols, [pt.exp(logp)], extra=[x])
    (density,) = function(*parents, grid.astype(x.dtype))
    return np.broadcast_to(np.nan_to_num(density), (len(parents[0]), grid.size))
