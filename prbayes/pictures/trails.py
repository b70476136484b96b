"""Pictures of how a result was reached: `plot_optimizer`, `plot_landscape`, `plot_stages`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._checks import Floats, positive_integer
from prbayes.estimate.optimum import Optimum
from prbayes.model.evaluator import Evaluator
from prbayes.pictures.canvas import (
    BLUE,
    CROSS,
    CYCLE,
    DASHDOT,
    DASHED,
    DIAMOND,
    DOTTED,
    GREY,
    INK,
    SOLID,
    VERMILION,
    Canvas,
    named,
)
from prbayes.pictures.curves import log_ticks, spans_decades
from prbayes.pictures.landscape import Landscape, elements, landscape, rooted

_STAGES = {
    "beta": "beta (1: posterior)",
    "accept_rate": "acceptance rate",
    "n_steps": "steps per stage",
    "log_marginal_likelihood": "log marginal likelihood",
}

_METRICS = {
    "AreaMetric": "area metric",
    "KullbackLeibler": "Kullback-Leibler",
    "LogLikelihood": "log-likelihood",
    "ProbabilityResidual": "probability residual",
}


def plot_optimizer(
    optimum: Optimum,
    *,
    labels: Mapping[str, str] | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the objective and the hyperparameters that an optimiser asked for, against the number of evaluations.

    The first panel has the objective, the sum of d_k / s_k, of each point and the lowest so far, with logarithmic
    ticks where it falls over more than a decade; a panel for each hyperparameter follows, in the user's own units,
    with the optimum as a dashed line. With `Reweighted` the objective is that of the final design and scales,
    evaluated anew without a response; elsewhere it is what the optimiser saw, and with several simulators, whose
    scales may have changed on the way, nothing says which was lowest.

    Parameters
    ----------
    optimum : Optimum
        From `minimize`.
    labels : mapping, optional
        What a reader calls a hyperparameter, by its name, with units.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        For ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``asked`` and ``path``, ``best`` (first panel) and ``optimum`` (the others).

    Raises
    ------
    TypeError, ValueError
        If it is no optimum, or one without a trace.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0])
    >>> list(prb.plot_optimizer(prb.minimize(model), backend="none").viz["asked"])
    ['discrepancy', 'mu']
    """
    check_optimum(optimum, "plot_optimizer")
    evaluator, x = optimum.evaluator, optimum.trace["evaluations"].astype(np.float64)
    scales = np.array([optimum.scales[n.name] for n in evaluator.nodes])
    free = not evaluator.responses_per_theta
    values = evaluator.total(optimum.trace["theta"], scales) if free else optimum.trace["discrepancy"]
    path = elements(optimum.evaluator, optimum.trace["theta"])
    canvas = Canvas(["discrepancy", *path], size=(4.6, 3.4), backend=backend, pc_kwargs=pc_kwargs)
    shown = np.where(np.isfinite(values), values, np.nan)
    best = np.fmin.accumulate(shown)
    ticks = log_ticks(shown) if spans_decades(shown) else None
    if ticks is not None:
        shown, best = np.log10(shown), np.log10(best)
    known = np.isfinite(shown)
    canvas.points("discrepancy", "asked", x[known], shown[known], GREY, size=16, legend="evaluated")
    if free or len(scales) == 1:
        canvas.line("discrepancy", "best", x[known], best[known], BLUE, legend="lowest so far")
    canvas.axes("discrepancy", x="evaluations", y=objective_of(optimum), yticks=ticks)
    ends = np.array([x[0], x[-1]])
    for name, at in path.items():
        canvas.line(name, "path", x, at, GREY, width=0.8)
        canvas.points(name, "asked", x, at, GREY, size=16, legend="evaluated")
        final = float(elements(optimum.evaluator, optimum.theta[None])[name][0])
        canvas.line(name, "optimum", ends, np.full(2, final), VERMILION, style=DASHED, legend="optimum")
        canvas.axes(name, x="evaluations", y=named(name, labels))
    return canvas.finish()


def plot_landscape(
    optimum: Optimum,
    *,
    model: pm.Model | None = None,
    pair: Sequence[str] | None = None,
    points: int | None = None,
    responses: int = 0,
    labels: Mapping[str, str] | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the objective over two hyperparameters around the optimum, with the optimiser's path and other optima.

    Darker is lower; contours are at even steps of the root of the objective over its lowest value, so that they crowd
    towards the optimum; the title has the values at the ends. With one hyperparameter, or one name, it is a curve. All
    other hyperparameters stand at the optimum, as the title says. Where stored responses do not support a population
    the picture is blank. Path and other optima are those of all hyperparameters, projected.

    Parameters
    ----------
    optimum : Optimum
        From `minimize`.
    model : pymc.Model, optional
        That of the optimum; another one with the same hyperparameters may be given, such as one with another metric.
    pair : sequence of str, optional
        One or two names, such as ``("mu", "sigma")`` or ``("mu[0]", "mu[1]")``; the first two by default.
    points : int, optional
        Along each axis; 41, or 161 for a curve.
    responses : int
        Largest number of responses that may be computed. With `Reweighted` none is; with `Resimulated` and `Fresh`
        every point of the picture costs n for each simulator.
    labels : mapping, optional
        What a reader calls a hyperparameter, by its name, with units.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        For ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``landscape`` (``landscape_lines``), ``path``, ``optimum`` and ``rivals``.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, or it would compute more responses than allowed.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0])
    >>> prb.plot_landscape(prb.minimize(model), backend="none").viz["optimum"].name
    'optimum'
    """
    check_optimum(optimum, "plot_landscape")
    evaluator = optimum.evaluator if model is None or model is optimum.model else Evaluator(model)
    if evaluator.names != optimum.names or [n.name for n in evaluator.nodes] != list(optimum.scales):
        got = f"{evaluator.names} and {[n.name for n in evaluator.nodes]}"
        raise ValueError(
            f"model: got hyperparameters and simulators {got}, expected {optimum.names} and {list(optimum.scales)}"
        )
    known = list(elements(optimum.evaluator, optimum.theta[None]))
    wanted = list(known[:2] if pair is None else [pair] if isinstance(pair, str) else pair)
    if not 1 <= len(wanted) <= 2 or len(set(wanted)) != len(wanted) or not set(wanted) <= set(known):
        raise KeyError(f"pair: got {pair}, expected one or two of {known}")
    points = (41 if len(wanted) == 2 else 161) if points is None else positive_integer(points, "points", minimum=5)
    cost = points ** len(wanted) * evaluator.responses_per_theta
    if cost > responses:
        raise ValueError(
            f"plot_landscape: got responses={responses}, expected at least {cost}: {points ** len(wanted)} points with "
            f"{evaluator.responses_per_theta} responses each; pass responses={cost}, fewer points, or use "
            "prb.Reweighted(), whose pictures cost none"
        )
    found = landscape(optimum, evaluator, wanted, points)
    if not np.isfinite(found.heights).any():
        raise ValueError(
            "plot_landscape: got no finite objective, expected some around the optimum; look at its message"
        )
    canvas = Canvas(["landscape"], size=(6.4, 5.4), backend=backend, pc_kwargs=pc_kwargs)
    rest = [named(n, labels) for n in known if n not in wanted]
    held = f"{', '.join(rest)} held at the optimum" if rest else ""
    limits = [(float(axis[0]), float(axis[-1])) for axis in found.axes]
    if len(wanted) == 1:
        _curve(canvas, found, alone=not rest)
        y = objective_of(optimum)
    else:
        roots, low, high = rooted(found.heights)
        canvas.heights("landscape", "landscape", (found.axes[0], found.axes[1]), roots, np.linspace(0, 1, 11))
        x, y = found.path.T
        canvas.line("landscape", "path", x, y, INK, width=1.0)
        canvas.points("landscape", "asked", x, y, INK, size=14, legend="path of the optimiser")
        _marks(canvas, found.optimum.T, found.rivals.T)
        y = named(wanted[1], labels)
        held = "\n".join([f"{objective_of(optimum)}: {low:.3g} dark, {high:.3g} light", *([held] if held else [])])
    canvas.axes(
        "landscape",
        x=named(wanted[0], labels),
        y=y,
        title=held,
        xlim=limits[0],
        ylim=limits[1] if len(wanted) == 2 else None,
    )
    return canvas.finish()


def _curve(canvas: Canvas, found: Landscape, *, alone: bool) -> None:
    """Draw the objective over one hyperparameter; what lies on the curve only if there are no others."""
    (x,), heights = found.axes, found.heights
    known = np.isfinite(heights)
    canvas.line("landscape", "landscape", x[known], heights[known], BLUE)

    def on_curve(places: Floats) -> tuple[Floats, Floats]:
        at = places[:, 0][(places[:, 0] >= x[known][0]) & (places[:, 0] <= x[known][-1])]
        return at, np.interp(at, x[known], heights[known])

    if alone:
        canvas.points("landscape", "asked", *on_curve(found.path), INK, size=14, legend="path of the optimiser")
    _marks(canvas, on_curve(found.optimum), on_curve(found.rivals if alone else found.rivals[:0]))


def _marks(canvas: Canvas, optimum: Any, rivals: Any) -> None:
    """Mark the optimum and its rivals, each as x and y."""
    canvas.points("landscape", "optimum", optimum[0], optimum[1], VERMILION, marker=DIAMOND, size=90, legend="optimum")
    if np.size(rivals[0]):
        canvas.points(
            "landscape", "rivals", rivals[0], rivals[1], VERMILION, marker=CROSS, size=70, legend="other optima"
        )


def plot_stages(
    posterior: xr.DataTree,
    *,
    labels: Mapping[str, str] | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the stages of a sequential Monte Carlo run, one line per chain and one panel per statistic.

    A statistic that is known at the end only, such as the log marginal likelihood, stands against the chain.
    Beta goes from the prior, 0, to the posterior, 1; chains that need very different numbers of stages, or whose log
    marginal likelihoods end far apart, have not seen the same posterior.

    Parameters
    ----------
    posterior : xarray.DataTree
        From `sample_smc`, with a ``sample_stats`` group of dims (chain, stage).
    labels : mapping, optional
        What a reader calls a statistic or a simulator, by its name.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        For ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``chain_0``, ``chain_1`` and so on.

    Raises
    ------
    TypeError, ValueError
        If there is no group with statistics by stage.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0])
    ...     posterior = prb.sample_smc(100, chains=2, random_seed=1, progressbar=False)
    >>> "chain_1" in prb.plot_stages(posterior, backend="none").viz
    True
    """
    if not isinstance(posterior, xr.DataTree) or "sample_stats" not in posterior:
        raise TypeError(
            f"plot_stages: got {type(posterior).__name__}, expected the DataTree of prb.sample_smc, with sample_stats"
        )
    stats = {str(n): v for n, v in posterior["sample_stats"].data_vars.items() if set(v.dims) == {"chain", "stage"}}
    if not stats:
        raise ValueError("plot_stages: got sample_stats without dims (chain, stage), expected those of prb.sample_smc")
    tables = {n: np.asarray(v.transpose("chain", "stage"), dtype=np.float64) for n, v in stats.items()}
    single = {name: bool((np.isfinite(rows).sum(axis=1) <= 1).all()) for name, rows in tables.items()}
    names = sorted(stats, key=lambda name: single[name])
    canvas = Canvas(names, size=(4.6, 3.4), backend=backend, pc_kwargs=pc_kwargs)
    for name in names:
        rows, once, values = tables[name], single[name], stats[name]
        ticks = log_ticks(rows) if name == "beta" and spans_decades(rows) else None
        for c, (chain, row) in enumerate(zip(values.chain.values, rows, strict=True)):
            known = np.isfinite(row)
            y = np.log10(row[known]) if ticks is not None else row[known]
            color, style = CYCLE[c % len(CYCLE)], (SOLID, DASHED, DOTTED, DASHDOT)[c % 4]
            if once:
                canvas.points(name, f"chain_{chain}", [c + 1.0], y[-1:], color, size=45)
            else:
                x = np.flatnonzero(known) + 1.0
                canvas.line(name, f"chain_{chain}", x, y, color, style=style, legend=f"chain {chain}")
        count = len(rows) if once else rows.shape[1]
        whole = np.arange(1, count + 1, max(1, -(-count // 10)))
        x_axis = "chain" if once else "stage"
        numbers = (whole.tolist(), [str(values.chain.values[i - 1] if once else i) for i in whole])
        y_axis = named(name, _STAGES | dict(labels or {}))
        canvas.axes(name, x=x_axis, y=y_axis, xticks=numbers, yticks=ticks)
    return canvas.finish()


def objective_of(optimum: Optimum) -> str:
    if len(optimum.scales) > 1:
        return "sum of d / s"
    name = type(optimum.evaluator.nodes[0].metric).__name__
    return f"discrepancy ({_METRICS.get(name, name)})"


def check_optimum(optimum: Any, caller: str) -> None:
    if not isinstance(optimum, Optimum):
        raise TypeError(f"{caller}: got {type(optimum).__name__}, expected an Optimum; call prb.minimize() first")
    if not len(optimum.trace.get("theta", ())):
        raise ValueError(f"{caller}: got an optimum without a trace, expected one as prb.minimize returns it")
