"""Posteriors of the hyperparameters, beside optimum and prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from scipy.stats import norm

from prbayes._validate import Floats, share
from prbayes.model.elements import (
    read_elements,
    single_elements,
    split_elements,
    stacked_draws,
    told_elements,
    variable_of,
)
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import Level, require_together
from prbayes.model.labels import labelled
from prbayes.optimize.optimum import Optimum, identity_in, require_of_model
from prbayes.plots._canvas import (
    BLUE,
    DASHED,
    DIAMOND,
    DOTTED,
    GREY,
    VERMILION,
    Canvas,
    Panel,
    refuse_look,
)
from prbayes.plots._curves import bounded_density, central_levels
from prbayes.plots._names import named, refuse_labels
from prbayes.plots._ticks import round_ticks


def plot_posterior(
    posterior: xr.DataTree,
    *,
    optimum: Optimum | None = None,
    model: pm.Model | None = None,
    var_names: Sequence[str] | None = None,
    prob: float = 0.89,
    labels: Mapping[str, str] | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the posterior of each hyperparameter against the optimum and the prior.

    The bar below the posterior is its equal-tailed interval, with the mean as a dot; the bar and
    the diamond below that are the optimum and the interval of as much probability of the normal
    distribution with its standard error, which the dashed curve shows.

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
        Variables that are drawn, or elements of them, such as ``"mu[Adler]"``; all by default.
    prob : float
        Probability of the intervals.
    labels : mapping, optional
        What a reader calls a hyperparameter, by its name, with units.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        ``figsize=(8, 5)``, in inches, of the whole picture; others go to
        ``arviz.PlotCollection.wrap``, such as ``col_wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``posterior``, ``interval``, ``mean``, ``prior``, ``normal``,
        ``stderr`` and ``optimum``.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, or nothing is left to draw; if the optimum is of other
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
    >>> pc = prb.plot_posterior(posterior, optimum=optimum, model=model, backend="none")
    >>> list(pc.viz["posterior"])
    ['mu']
    """
    refuse_look(labels, backend, pc_kwargs)
    _check_results(posterior, optimum, model)
    share(prob, "prob")
    found = _wanted(_read_hyperparameters(posterior, optimum, model), var_names)
    evaluator = None if model is None else Evaluator.of(model)
    refuse_labels(labels, map(str, posterior["posterior"].data_vars), evaluator=evaluator)
    canvas = Canvas(list(found), size=(4.6, 3.6), backend=backend, pc_kwargs=pc_kwargs)
    for name, hyperparameter in found.items():
        panel = canvas.panel(name)
        top = _draw(panel, hyperparameter, prob)
        x = named(name, labels)
        panel.axes(x=x, y="density", yticks=round_ticks(0.0, top))
    return canvas.finish()


def _wanted(
    found: dict[str, _Hyperparameter], var_names: Sequence[str] | None
) -> dict[str, _Hyperparameter]:
    """Return those hyperparameters that were asked for; by default those that are read."""
    if var_names is None:
        return {name: found[name] for name in read_elements(found)}
    asked = [var_names] if isinstance(var_names, str) else list(var_names)
    unknown = [one for one in asked if not any(one in (name, variable_of(name)) for name in found)]
    if unknown or not asked:
        raise KeyError(
            f"plot_posterior: var_names: got {unknown or 'none'}, expected some of {list(found)}"
        )
    return {name: one for name, one in found.items() if name in asked or variable_of(name) in asked}


def _check_results(posterior: Any, optimum: Any, model: pm.Model | None) -> None:
    """Refuse what is of another kind, an optimum of other populations, and other priors."""
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


@dataclass(frozen=True, eq=False)
class _Hyperparameter:
    """What is known of one hyperparameter."""

    draws: Floats  # (n,): of the posterior
    prior: Floats | None  # (m,), or None: draws of the prior
    # The optimum, and its standard error where it is known.
    best: float | None
    error: float | None

    @property
    def grid(self) -> Floats:
        """What the axis covers: all draws, and three standard errors around the optimum."""
        low = float(self.draws.min())
        high = float(self.draws.max())
        if self.best is not None:
            reach = 3 * (self.error or 0.0)
            low = min(low, self.best - reach)
            high = max(high, self.best + reach)
        return np.linspace(low, high, 301)


def _read_hyperparameters(
    posterior: xr.DataTree, optimum: Optimum | None, model: pm.Model | None
) -> dict[str, _Hyperparameter]:
    """Return by element what posterior, optimum and model share."""
    stacked = stacked_draws(posterior["posterior"])
    draws = split_elements(stacked)
    shared = {name for name in told_elements(stacked) if np.ptp(draws[name]) > 0}

    best, errors = {}, {}
    if optimum is not None:
        best = single_elements(labelled(optimum.evaluator, optimum.point, {}).data_vars)
        errors = single_elements(labelled(optimum.evaluator, optimum.stderr, {}).data_vars)
        shared &= set(best)
    prior: dict[str, Floats] = {}
    if model is not None:
        evaluator = Evaluator.of(model)
        # So many tell a normal density's peak within 2%.
        thetas = evaluator.hyperparameters.prior_thetas(4000, 0)
        drawn = labelled(
            evaluator, evaluator.hyperparameters.constrained(thetas), {"draw": len(thetas)}
        )
        prior = split_elements(drawn.data_vars)
        shared &= set(prior)

    found = {}
    for name, x in draws.items():
        if name in shared:
            error = errors.get(name, np.nan)
            known = np.isfinite(error) and error > 0
            found[name] = _Hyperparameter(
                draws=x,
                prior=prior.get(name),
                best=best.get(name),
                error=error if known else None,
            )
    if not found:
        raise ValueError(
            f"plot_posterior: got a posterior of {list(draws)}, expected hyperparameters of "
            "optimum and model"
        )
    return found


def _draw(panel: Panel, hyperparameter: _Hyperparameter, prob: float) -> float:
    """Draw densities, and the intervals below them; return how high the posterior reaches."""
    draws = hyperparameter.draws
    best = hyperparameter.best
    grid = hyperparameter.grid
    density = bounded_density(draws, grid)
    top = float(density.max())
    # So far apart that the diamond of one does not touch the dot of the other.
    posterior_row, optimum_row = np.array([-0.07, -0.15]) * top

    if hyperparameter.prior is not None:
        y = bounded_density(hyperparameter.prior, grid)
        panel.line("prior", grid, y, GREY, style=DOTTED, legend="prior")

    panel.line("posterior", grid, density, BLUE, width=2.2, legend="posterior")
    interval = np.quantile(draws, central_levels(prob))
    row = np.repeat(posterior_row, 2)
    text = f"{prob:.0%} intervals"
    panel.line("interval", interval, row, BLUE, width=3, legend=text)
    mean = draws.mean()
    panel.points("mean", mean, posterior_row, BLUE, size=90, legend="posterior mean")

    if best is not None:
        if hyperparameter.error is not None:
            _draw_normal(panel, grid, best, hyperparameter.error, prob, optimum_row)
        panel.points(
            "optimum",
            best,
            optimum_row,
            VERMILION,
            marker=DIAMOND,
            size=110,
            legend="optimum",
        )
    return top


def _draw_normal(
    panel: Panel, grid: Floats, best: float, error: float, prob: float, row: float
) -> None:
    """Draw the normal distribution of the optimum's standard error, and its interval."""
    normal = norm(best, error)
    text = "normal with the optimum's standard error"
    panel.line("normal", grid, normal.pdf(grid), VERMILION, style=DASHED, legend=text)
    ends = normal.ppf(central_levels(prob))
    panel.line("stderr", ends, np.repeat(row, 2), VERMILION, width=3)
