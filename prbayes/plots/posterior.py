"""Posteriors of the hyperparameters, beside optimum and prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from scipy.stats import norm

from prbayes._stats import INTERVAL
from prbayes._validate import Floats, share
from prbayes.model.description import labelled
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import Level, require_together
from prbayes.model.parameters import (
    readable_elements,
    single_elements,
    split_elements,
    stacked_draws,
    table_elements,
    variable_of,
)
from prbayes.optimize.optimum import Optimum, identity_in, require_of_model
from prbayes.plots.canvas import (
    BLUE,
    DASHED,
    DIAMOND,
    DOTTED,
    GREY,
    VERMILION,
    Canvas,
    Panel,
    named,
    refuse_labels,
    refuse_look,
    round_ticks,
)
from prbayes.plots.curves import bounded_density, central_levels


def plot_posterior(
    posterior: xr.DataTree,
    *,
    optimum: Optimum | None = None,
    model: pm.Model | None = None,
    var_names: Sequence[str] | None = None,
    prob: float = INTERVAL,
    labels: Mapping[str, str] | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the posterior of each hyperparameter against the optimum and the prior.

    The bar below the posterior is its equal-tailed interval, with the mean as a dot. The bar and
    the diamond below are the optimum and the interval of the normal distribution with its standard
    error, which is the dashed curve.

    Parameters
    ----------
    posterior : xarray.DataTree
        With a ``posterior`` group, from any sampler.
    optimum : Optimum, optional
        From `minimize`.
    model : pymc.Model, optional
        Restricts the picture to the model's variables, its deterministics among them, and adds
        their prior; by default all variables that posterior and optimum share.
    var_names : sequence of str, optional
        Variables, or elements of them, such as ``"mu[Adler]"``; all by default.
    prob : float
        Probability of the intervals.
    labels : mapping, optional
        Labels of hyperparameters by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, and keywords of ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``posterior``, ``interval``, ``mean``, ``prior``, ``normal``,
        ``stderr`` and ``optimum``.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, or no variable is left; if the optimum is of other
        populations or data than the posterior, or the model has other priors.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
    ...     )
    ...     optimum = prb.minimize()
    ...     posterior = prb.sample_smc(
    ...         100, chains=2, optimum=optimum, random_seed=1, progressbar=False
    ...     )
    >>> pc = prb.plots.plot_posterior(posterior, optimum=optimum, model=model)
    >>> list(pc.viz["posterior"])
    ['mu']
    """
    refuse_look(labels, pc_kwargs)
    if not isinstance(posterior, xr.DataTree) or "posterior" not in posterior:
        raise TypeError(
            f"plot_posterior: got {type(posterior).__name__}, expected a DataTree with a "
            "posterior group"
        )
    if optimum is not None and not isinstance(optimum, Optimum):
        raise TypeError(
            f"plot_posterior: optimum: got {type(optimum).__name__}, expected an Optimum from "
            "prb.minimize"
        )
    identities = {"posterior": identity_in(posterior), "optimum": identity_in(optimum)}
    require_together(identities, "plot_posterior")
    if model is not None:
        require_of_model(posterior, model, "plot_posterior", Level.PRIORS)
    share(prob, "prob")
    evaluator = None if model is None else Evaluator.of(model)

    # Elements of the variables that posterior, optimum and model share
    stacked = stacked_draws(posterior["posterior"])
    draws = split_elements(stacked)
    shared = {name for name in table_elements(stacked) if np.ptp(draws[name]) > 0}
    best, errors = {}, {}
    if optimum is not None:
        best = single_elements(labelled(optimum.evaluator, optimum.point, {}).data_vars)
        errors = single_elements(labelled(optimum.evaluator, optimum.stderr, {}).data_vars)
        shared &= set(best)
    prior: dict[str, Floats] = {}
    if evaluator is not None:
        # 4000 draws give a normal density's peak within 2%.
        thetas = evaluator.hyperparameters.prior_thetas(4000, 0)
        values = evaluator.hyperparameters.constrained(thetas)
        prior = split_elements(labelled(evaluator, values, {"draw": len(thetas)}).data_vars)
        shared &= set(prior)
    if not shared:
        raise ValueError(
            f"plot_posterior: got a posterior of {list(draws)}, expected hyperparameters of "
            "optimum and model"
        )
    names = _select([name for name in draws if name in shared], var_names)
    refuse_labels(labels, map(str, posterior["posterior"].data_vars), evaluator=evaluator)
    canvas = Canvas(names, size=(4.6, 3.6), pc_kwargs=pc_kwargs)
    for name in names:
        panel = canvas.panels[name]
        estimate = (best[name], errors.get(name, np.nan)) if name in best else None
        top = _draw(panel, draws[name], prior.get(name), estimate, prob)
        panel.axes(x=named(name, labels), y="density", yticks=round_ticks(0.0, top))
    return canvas.finish()


def _select(names: list[str], var_names: Sequence[str] | None) -> list[str]:
    """Return the hyperparameters of the picture; by default those that a reader wants."""
    if var_names is None:
        return list(readable_elements(names))
    is_list = isinstance(var_names, Sequence) and not isinstance(var_names, str)
    selection = list(var_names) if is_list else [var_names]
    unknown = set(selection) - {*names, *map(variable_of, names)}
    if unknown or not selection:
        got = [name for name in selection if name in unknown] or "none"
        raise KeyError(f"plot_posterior: var_names: got {got}, expected some of {names}")
    return [name for name in names if {name, variable_of(name)} & set(selection)]


def _draw(
    panel: Panel,
    draws: Floats,
    prior: Floats | None,
    estimate: tuple[float, float] | None,
    prob: float,
) -> float:
    """Draw densities and intervals, of optimum and standard error too; return the top."""
    low = float(draws.min())
    high = float(draws.max())
    best, error = estimate or (0.0, np.nan)
    has_error = 0 < error < np.inf
    if estimate is not None:
        reach = 3 * error if has_error else 0.0
        low = min(low, best - reach)
        high = max(high, best + reach)
    grid = np.linspace(low, high, 301)
    density = bounded_density(draws, grid)
    top = float(density.max())
    # Far enough apart that the diamond of one does not touch the dot of the other
    posterior_row, optimum_row = np.array([-0.07, -0.15]) * top

    if prior is not None:
        density_before = bounded_density(prior, grid)
        panel.line("prior", (grid, density_before), GREY, style=DOTTED, legend="prior")
    panel.line("posterior", (grid, density), BLUE, width=2.2, legend="posterior")
    levels = central_levels(prob)
    row = np.repeat(posterior_row, 2)
    text = f"{prob:.0%} intervals"
    panel.line("interval", (np.quantile(draws, levels), row), BLUE, width=3, legend=text)
    panel.points("mean", (draws.mean(), posterior_row), BLUE, size=90, legend="posterior mean")
    if has_error:
        normal = norm(best, error)
        text = "normal with the optimum's standard error"
        panel.line("normal", (grid, normal.pdf(grid)), VERMILION, style=DASHED, legend=text)
        panel.line("stderr", (normal.ppf(levels), np.repeat(optimum_row, 2)), VERMILION, width=3)
    if estimate is not None:
        look: dict[str, Any] = {"marker": DIAMOND, "size": 110, "legend": "optimum"}
        panel.points("optimum", (best, optimum_row), VERMILION, **look)
    return top
