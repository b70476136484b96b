"""Posteriors of the hyperparameters, beside optimum and prior."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._checks import Floats, positive_number
from prbayes.estimate.optimum import Optimum
from prbayes.model.evaluator import Evaluator
from prbayes.plots._canvas import BLUE, DASHED, DIAMOND, DOTTED, GREY, VERMILION, Canvas, named
from prbayes.plots._curves import bounded_density, normal_density, round_ticks

_PRIOR_DRAWS = 4000


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
