"""Pictures of results: `plot_posterior`, `plot_comparison`, `plot_validity`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._checks import Floats, positive_number
from prbayes.estimate.optimum import Optimum
from prbayes.model.evaluator import Evaluator
from prbayes.pictures.canvas import BLUE, DASHED, DIAMOND, DOTTED, GREY, INK, VERMILION, Canvas, grid_settings, named
from prbayes.pictures.curves import bounded_density, normal_density, round_ticks
from prbayes.validation.validity import ValidityTest

_PRIOR_DRAWS = 4000
_TOLD = ("n_responses", "seconds")


def plot_posterior(
    posterior: xr.DataTree,
    optimum: Optimum | None = None,
    *,
    model: pm.Model | None = None,
    level: float = 0.89,
    labels: Mapping[str, str] | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the posterior of each hyperparameter against the optimum with its standard error, and the prior.

    The bar below the posterior is its equal-tailed interval, with the mean as a dot; the bar and the diamond below
    that are the optimum and the interval of as much probability of the normal distribution with its standard error,
    which the dashed curve shows.

    Parameters
    ----------
    posterior : xarray.DataTree
        With a ``posterior`` group, from any sampler.
    optimum : Optimum, optional
        From `minimize`.
    model : pymc.Model, optional
        Restricts the picture to the model's free variables and adds their prior; by default all variables that
        posterior and optimum share.
    level : float
        Probability of the intervals.
    labels : mapping, optional
        What a reader calls a hyperparameter, by its name, with units.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        For ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``posterior``, ``interval``, ``mean``, ``prior``, ``normal``, ``stderr`` and
        ``optimum``.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, or nothing is left to draw.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0])
    ...     optimum = prb.minimize()
    ...     posterior = prb.sample_smc(100, chains=2, optimum=optimum, random_seed=1, progressbar=False)
    >>> list(prb.plot_posterior(posterior, optimum, model=model, backend="none").viz["posterior"])
    ['mu']
    """
    if not isinstance(posterior, xr.DataTree) or "posterior" not in posterior:
        raise TypeError(f"plot_posterior: got {type(posterior).__name__}, expected a DataTree with a posterior group")
    if optimum is not None and not isinstance(optimum, Optimum):
        raise TypeError(f"plot_posterior: optimum: got {type(optimum).__name__}, expected an Optimum from prb.minimize")
    if positive_number(level, "level") >= 1:
        raise ValueError(f"level: got {level}, expected a number between 0 and 1")
    from scipy.special import ndtri  # takes longer to import than the whole package

    z = -float(ndtri((1 - level) / 2))
    group = posterior["posterior"].to_dataset()
    draws = _elements({str(n): v.stack(s=("chain", "draw")).transpose("s", ...).values for n, v in group.items()})
    best = {} if optimum is None else _elements({n: np.asarray(v)[None] for n, v in optimum.point.items()})
    sd = {} if optimum is None else _elements({n: np.asarray(v)[None] for n, v in optimum.stderr.items()})
    prior: dict[str, Floats] = {}
    if model is not None:
        evaluator = Evaluator(model)
        prior = _elements(evaluator.constrained(evaluator.prior_thetas(_PRIOR_DRAWS, 0)))
    free = None if model is None else {rv.name for rv in model.free_RVs}
    names = [n for n in draws if (free is None or n.partition("[")[0] in free) and (not best or n in best)]
    names = [n for n in names if np.ptp(draws[n]) > 0]
    if not names:
        raise ValueError(
            f"plot_posterior: got a posterior of {list(draws)}, expected hyperparameters of optimum and model"
        )
    canvas = Canvas(names, size=(4.6, 3.6), backend=backend, pc_kwargs=pc_kwargs)
    for name in names:
        x = draws[name]
        interval = np.quantile(x, [(1 - level) / 2, (1 + level) / 2])
        center, error = (float(best[name][0]), float(sd[name][0])) if best else (np.nan, np.nan)
        known = bool(np.isfinite(error) and error > 0)
        reach = [float(x.min()), float(x.max()), *([center] if best else [])]
        reach += [center - 3 * error, center + 3 * error] if known else []
        grid = np.linspace(min(reach), max(reach), 301)
        y = bounded_density(x, grid)
        top = float(y.max())
        if name in prior:
            canvas.line(name, "prior", grid, bounded_density(prior[name], grid), GREY, style=DOTTED, legend="prior")
        canvas.line(name, "posterior", grid, y, BLUE, width=2.2, legend="posterior")
        rows = np.array([-0.07, -0.15]) * top
        canvas.line(name, "interval", interval, np.repeat(rows[0], 2), BLUE, width=3, legend=f"{level:.0%} intervals")
        canvas.points(name, "mean", x.mean(), rows[0], BLUE, size=90, legend="posterior mean")
        if known:
            normal = normal_density(grid, center, error)
            canvas.line(
                name, "normal", grid, normal, VERMILION, style=DASHED, legend="normal with the optimum's standard error"
            )
            ends = center + z * error * np.array([-1, 1])
            canvas.line(name, "stderr", ends, np.repeat(rows[1], 2), VERMILION, width=3)
        if best:
            canvas.points(name, "optimum", center, rows[1], VERMILION, marker=DIAMOND, size=110, legend="optimum")
        canvas.axes(name, x=named(name, labels), y="density", yticks=round_ticks(0.0, top))
    return canvas.finish()


def _elements(values: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return one-dimensional arrays by names such as 'mu[1]', of arrays of shape (n, *shape)."""
    return {
        f"{name}[{','.join(map(str, i))}]" if i else name: np.asarray(v)[(slice(None), *i)]
        for name, v in values.items()
        for i in np.ndindex(np.shape(v)[1:])
    }


def plot_comparison(
    comparison: xr.Dataset,
    *,
    scores: bool = False,
    labels: Mapping[str, str] | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the estimate and the interval of each result, one row per result and one panel per hyperparameter.

    Parameters
    ----------
    comparison : xarray.Dataset
        From `compare`.
    scores : bool
        Draw in their place the discrepancy of each result's population under each metric, one panel per metric; the
        smaller the better, each metric in its own units.
    labels : mapping, optional
        What a reader calls a hyperparameter, by its name, with units; also a result or a score.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        For ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``estimate`` and ``interval_0``, ``interval_1`` and so on by result; or ``score``.

    Raises
    ------
    TypeError, ValueError
        If it is no comparison, or has no scores.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0])
    >>> table = prb.compare({"optimum": prb.minimize(model)}, model=model)
    >>> list(prb.plot_comparison(table, backend="none").viz["estimate"])
    ['mu']
    """
    if not isinstance(comparison, xr.Dataset) or not {"estimate", "lower", "upper"} <= set(comparison.data_vars):
        raise TypeError(f"plot_comparison: got {type(comparison).__name__}, expected the Dataset of prb.compare")
    results = [str(r) for r in comparison.result.values]
    rows = np.arange(len(results), dtype=np.float64)[::-1]
    panels = [str(h) for h in comparison.hyperparameter.values]
    if scores:
        panels = [str(n) for n, v in comparison.data_vars.items() if v.dims == ("result",) and n not in _TOLD]
        if not panels:
            raise ValueError("plot_comparison: got no scores, expected those of prb.compare(results, model=model)")
    interval = f"{comparison.attrs.get('interval', 0.89):.0%} interval"
    height = 1.6 + 0.34 * len(results)
    canvas = Canvas(panels, size=(4.8, height), backend=backend, pc_kwargs=pc_kwargs)
    for name in panels:
        if scores:
            at = comparison[name].values
            known = np.isfinite(at)
            canvas.points(name, "score", at[known], rows[known], BLUE, size=45)
        else:
            row = comparison.sel(hyperparameter=name)
            first = row.estimate.values[:1]
            if len(results) > 1:
                text = f"estimate of {named(results[0], labels)}"
                canvas.line(
                    name,
                    "first",
                    np.repeat(first, 2),
                    [-0.6, len(results) - 0.4],
                    GREY,
                    style=DOTTED,
                    width=1.2,
                    legend=text,
                )
            for i, (low, high) in enumerate(zip(row.lower.values, row.upper.values, strict=True)):
                if np.isfinite([low, high]).all():
                    canvas.line(name, f"interval_{i}", [low, high], [rows[i]] * 2, BLUE, width=3, legend=interval)
            canvas.points(name, "estimate", row.estimate.values, rows, INK, size=45, legend="estimate")
        known = comparison[name].values if scores else np.concatenate([row.lower, row.upper, row.estimate])
        known = known[np.isfinite(known)]
        low, high = (known.min(), known.max()) if known.size else (0.0, 1.0)
        room = 0.06 * (high - low) or 0.01 * max(abs(low), 1.0)
        limits = (float(low - room), float(high + room))
        ticks = (rows.tolist(), [named(r, labels) for r in results])
        canvas.axes(
            name,
            x=named(name, labels),
            xlim=limits,
            xticks=round_ticks(*limits),
            yticks=ticks,
            ylim=(-0.6, len(results) - 0.4),
        )
    return canvas.finish()


def plot_validity(
    tests: ValidityTest | Mapping[str, ValidityTest],
    *,
    envelope: bool = True,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the ECDF of the u-values against the identity, with the area between them and the verdict.

    The shaded area is the statistic. The title has the critical value and the verdict; the band holds the whole
    ECDF with probability 1 - level if the null is true, calibration uncertainty included.

    Parameters
    ----------
    tests : ValidityTest or mapping
        From `area_test`; several by name, one panel each.
    envelope : bool
        Whether the band is drawn.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        For ``arviz.PlotCollection.wrap``, such as ``figure_kwargs`` or ``col_wrap``.

    Returns
    -------
    arviz.PlotCollection
        With ``savefig``; its ``viz`` has the artists ``area``, ``envelope``, ``identity`` and ``ecdf``.

    Raises
    ------
    TypeError
        If a test is no `ValidityTest`.

    Examples
    --------
    >>> import numpy as np, prbayes as prb
    >>> rng = np.random.default_rng(1)
    >>> predicted = rng.normal(rng.normal(0, 0.2, (200, 1)), 1.0, (200, 500))
    >>> test = prb.area_test(rng.normal(0, 1, 20), predicted)
    >>> prb.plot_validity(test, backend="none").viz["ecdf"].name
    'ecdf'
    """
    by_name = dict(tests) if isinstance(tests, Mapping) else {"": tests}
    if not by_name or not all(isinstance(t, ValidityTest) for t in by_name.values()):
        got = ", ".join(sorted({type(t).__name__ for t in by_name.values()})) or "nothing"
        raise TypeError(f"plot_validity: got {got}, expected a ValidityTest from prb.area_test, or several by name")
    # Heavy, and partly annotated.
    arviz: Any = import_module("arviz")
    visuals: Any = import_module("arviz_plots.visuals")
    # One variable, of a dimension of its own, for each panel: tests differ in size.
    data = xr.Dataset({name or "u": (f"{name} rank", _tested(test)) for name, test in by_name.items()})
    pc = arviz.PlotCollection.wrap(data, **grid_settings(len(by_name), (4.6, 4.8), backend, pc_kwargs))

    def draw(what: str, function: Any, keywords: Callable[[str, ValidityTest], dict[str, Any]], **same: Any) -> None:
        own = {name or "u": keywords(name, test) for name, test in by_name.items()}

        def one(da: Any, target: Any, var_name: str, sel: Any, isel: Any) -> Any:
            return function(da, target, **own[var_name], **same)

        pc.map(one, what, subset_info=True, ignore_aes="all", store_artist=function in pictures)

    pictures = (visuals.fill_between_y, visuals.line_xy)
    diagonal = np.array([0.0, 1.0])
    if envelope:
        draw("envelope", visuals.fill_between_y, lambda _, t: _band(t), color="B3", alpha=0.4)
    draw("area", visuals.fill_between_y, lambda _, t: _between(t) | {"color": _color(t)}, alpha=0.4)
    draw("identity", visuals.line_xy, lambda _, t: {"x": diagonal, "y": diagonal}, color=INK, linestyle=DASHED)
    draw("ecdf", visuals.line_xy, lambda _, t: _ecdf(t) | {"color": _color(t)})
    draw("title", visuals.labelled_title, lambda name, t: {"text": _title(name, t)})
    draw("xlabel", visuals.labelled_x, lambda _, t: {"text": "|2u - 1|" if t.folded else "u-value"})
    draw("ylabel", visuals.labelled_y, lambda _, t: {"text": f"share of {t.u_values.size} values"})
    return pc


def _tested(test: ValidityTest) -> Floats:
    return np.sort(np.abs(2 * test.u_values - 1) if test.folded else test.u_values)


def _color(test: ValidityTest) -> str:
    return VERMILION if test.rejected else BLUE


def _title(name: str, test: ValidityTest) -> str:
    sign, verdict = (">", "rejected") if test.rejected else ("<", "not rejected")
    first = f"{name}, p = {test.p_value:.2g}" if name else f"p = {test.p_value:.2g}, level {test.level:.0%}"
    return f"{first}\narea {test.statistic:.3f} {sign} critical {test.critical_value:.3f}: {verdict}"


def _corners(values: Floats) -> tuple[Floats, Floats]:
    """Return the corners of the ECDF of sorted values on [0, 1]."""
    height = np.arange(values.size + 1) / values.size
    return np.concatenate([[0.0], np.repeat(values, 2), [1.0]]), np.repeat(height, 2)


def _ecdf(test: ValidityTest) -> dict[str, Floats]:
    x, y = _corners(_tested(test))
    return {"x": x, "y": y}


def _between(test: ValidityTest) -> dict[str, Floats]:
    """Return the area between the ECDF and the identity, with the points where they cross."""
    x, y = _corners(_tested(test))
    crossing = (x[:-1] < y[:-1]) & (y[:-1] < x[1:])
    at = np.flatnonzero(crossing) + 1
    x, y = np.insert(x, at, y[at - 1]), np.insert(y, at, y[at - 1])
    return {"x": x, "y_bottom": np.minimum(x, y), "y_top": np.maximum(x, y)}


def _band(test: ValidityTest) -> dict[str, Floats]:
    """Return the ECDFs of the envelope's two sides at the corners of both."""
    low, high = test.envelope
    x = np.repeat(np.unique(np.concatenate([[0.0], low, high, [1.0]])), 2)
    bottom, top = (
        np.where(np.arange(x.size) % 2, *(np.searchsorted(v, x, side=s) for s in ("right", "left"))) / v.size
        for v in (high, low)
    )
    return {"x": x, "y_bottom": bottom, "y_top": top}
