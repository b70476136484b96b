"""Posteriors of the hyperparameters, beside optimum and prior."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import pymc as pm
import xarray as xr
from scipy.stats import norm

from prbayes._display import percentage
from prbayes._stats import INTERVAL
from prbayes._validate import Floats, Labels, share, wrong_type
from prbayes.model.description import labelled
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import Level, require_together
from prbayes.model.parameters import (
    readable_elements,
    single_elements,
    split_elements,
    stacked_draws,
    table_elements,
)
from prbayes.optimize.optimum import Optimum, identity_in, require_of_model
from prbayes.plots.canvas import (
    BLUE,
    GREY,
    VERMILION,
    check_options,
    layout,
    named,
    refuse_labels,
)
from prbayes.plots.curves import bounded_density, central_levels
from prbayes.plots.selection import Coords, FilterVars, VarNames, elements_of, select
from prbayes.results.products import with_chains

if TYPE_CHECKING:
    from arviz_plots.plot_collection import PlotCollection

# colour, and ArviZ's codes of line style and marker, of each distribution
_LOOKS = {
    "posterior": (BLUE, "C0", "C0"),
    "optimum": (VERMILION, "C1", "C4"),
    "prior": (GREY, "C2", "C0"),
}


def plot_posterior(
    posterior: xr.DataTree,
    *,
    optimum: Optimum | None = None,
    model: pm.Model | None = None,
    var_names: VarNames | None = None,
    filter_vars: FilterVars | None = None,
    coords: Coords | None = None,
    prob: float = INTERVAL,
    backend: str | None = None,
    labels: Labels | None = None,
    **pc_kwargs: Any,
) -> PlotCollection:
    """Draw the posterior of each hyperparameter against the optimum and the prior, by ArviZ.

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
    var_names : str or sequence of str, optional
        Variables, or elements of them, such as ``"mu[Adler]"``, in this order; all by default.
    filter_vars : {None, "like", "regex"}
        How ``var_names`` are read, as by ArviZ.
    coords : mapping, optional
        Labels of the variables by dimension, such as ``{"supplier": ["Adler"]}``.
    prob : float
        Probability of the intervals.
    backend : {"matplotlib", "plotly", "bokeh"}, optional
        Library that ArviZ draws with; that of ``arviz.rcParams`` by default.
    labels : mapping, optional
        Labels of hyperparameters by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, and keywords of ``arviz.PlotCollection.wrap``, such as
        ``col_wrap``.

    Returns
    -------
    arviz.PlotCollection
        Of `arviz.plot_dist`: its visuals ``dist``, ``credible_interval`` and ``point_estimate``
        have the dimension ``distribution``, with the labels posterior, optimum and prior.

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
    >>> list(pc.viz["dist"])
    ['mu']
    """
    check_options(labels, pc_kwargs, by_arviz=True)
    posterior = with_chains(posterior)
    if not isinstance(posterior, xr.DataTree) or "posterior" not in posterior:
        raise wrong_type(posterior, "plot_posterior", "a DataTree with a posterior group")
    if optimum is not None and not isinstance(optimum, Optimum):
        raise wrong_type(optimum, "plot_posterior: optimum", "an Optimum from prb.minimize")
    identities = {"posterior": identity_in(posterior), "optimum": identity_in(optimum)}
    require_together(identities, "plot_posterior")
    if model is not None:
        require_of_model(posterior, model, "plot_posterior", Level.PRIORS)
    share(prob, "prob")
    if backend not in (None, "matplotlib", "plotly", "bokeh", "none"):
        raise ValueError(
            f"backend: got {backend!r:.60}, expected 'matplotlib', 'plotly', 'bokeh' or 'none'"
        )
    evaluator = None if model is None else Evaluator.of(model)

    # The picture shows elements that posterior, optimum and model have in common.
    stacked = stacked_draws(posterior["posterior"])
    draws = split_elements(stacked)
    shared = {name for name in table_elements(stacked) if np.ptp(draws[name]) > 0}
    best, errors = {}, {}
    if optimum is not None:
        best = single_elements(labelled(optimum.evaluator, optimum.point, {}).data_vars)
        errors = single_elements(labelled(optimum.evaluator, optimum.stderr, {}).data_vars)
        shared &= set(best)
    prior = {}
    if evaluator is not None:
        # With 4000 draws the peak of a normal density has an error of 2%.
        thetas = evaluator.hyperparameters.prior_thetas(4000, 0)
        values = evaluator.hyperparameters.constrained(thetas)
        prior = split_elements(labelled(evaluator, values, {"draw": len(thetas)}).data_vars)
        shared &= set(prior)
    if not shared:
        raise ValueError(
            f"plot_posterior: got a posterior of {list(draws)}, expected hyperparameters of "
            "optimum and model"
        )
    elements = elements_of(stacked)
    available = {name: elements[name] for name in draws if name in shared}
    names = select(available, var_names, filter_vars, coords)
    if var_names is None:
        # A reader wants standard deviations and correlations, and no packed Cholesky factor.
        names = list(readable_elements(names))
    refuse_labels(labels, map(str, posterior["posterior"].data_vars), evaluator=evaluator)
    summaries = {}
    for name in names:
        estimate = (best[name], errors.get(name, np.nan)) if name in best else None
        # ArviZ stores names as paths of a tree, in which a slash would be another level.
        key = name.replace("/", "\u2215")
        summaries[key] = _summary(draws[name], prior.get(name), estimate, prob)
    texts = {name.replace("/", "\u2215"): named(name, labels) for name in names}
    return _draw(summaries, texts, prob, backend, pc_kwargs)


def _summary(
    draws: Floats, prior: Floats | None, estimate: tuple[float, float] | None, prob: float
) -> xr.Dataset:
    """Return what ArviZ draws of posterior, optimum and prior: densities, intervals and points."""
    best, error = estimate or (np.nan, np.nan)
    # All numbers of the normal distribution are NaN if the standard error is unknown.
    normal = norm(best, error if 0 < error < np.inf else np.nan)
    levels = central_levels(prob)
    reach = 3 * normal.std()
    shown = [draws.min(), draws.max(), best, best - reach, best + reach]
    grid = np.linspace(np.nanmin(shown), np.nanmax(shown), 301)
    density = bounded_density(draws, grid)
    # A row has draws, density, ends of the interval, point, and the height of interval and point
    # below zero. The heights are far enough apart that the markers do not touch.
    rows: dict[str, tuple[Any, ...]] = {
        "posterior": (draws, density, np.quantile(draws, levels), draws.mean(), -0.07)
    }
    if estimate is not None:
        rows["optimum"] = (np.array([best]), normal.pdf(grid), normal.ppf(levels), best, -0.17)
    if prior is not None:
        rows["prior"] = (prior, bounded_density(prior, grid), np.full(2, np.nan), np.nan, 0.0)
    samples, curves, ends, points, places = zip(*rows.values(), strict=True)
    size = max(map(len, samples))
    padded = [np.append(x, np.full(size - len(x), np.nan)) for x in samples]
    along = "distribution"
    # ArviZ does not draw a line of NaN.
    lines = [[np.where(np.isnan(curve), np.nan, grid), curve] for curve in curves]
    return xr.Dataset(
        {
            "draws": ((along, "sample"), padded),
            "density": ((along, "plot_axis", "kde_dim"), lines, {"kind": "kde"}),
            "interval": ((along, "ci_bound"), np.array(ends)),
            "point": (along, np.array(points)),
            "place": (along, np.array(places) * float(density.max())),
        },
        coords={along: list(rows), "plot_axis": ["x", "y"], "ci_bound": ["lower", "upper"]},
    )


def _draw(
    summaries: Mapping[str, xr.Dataset],
    texts: dict[str, str],
    prob: float,
    backend: str | None,
    pc_kwargs: dict[str, Any],
) -> PlotCollection:
    """Return the picture that ArviZ draws of summaries by hyperparameter."""
    import arviz as az  # heavy, and only needed for pictures

    def by_name(key: str) -> xr.Dataset:
        return xr.Dataset({name: summary[key] for name, summary in summaries.items()})

    backend = backend or az.rcParams["plot.backend"]
    columns, options = layout(len(summaries), (4.6, 3.6), pc_kwargs)
    if backend != "matplotlib":
        options.pop("layout")
        if "figsize" not in pc_kwargs.get("figure_kwargs", {}):
            # The other libraries measure in dots, 100 per inch.
            width, height = options["figsize"]
            options |= {"figsize": (100 * width, 100 * height), "figsize_units": "dots"}
    rest = {key: value for key, value in pc_kwargs.items() if key != "figsize"}
    shown = next(iter(summaries.values())).distribution.values.tolist()
    colors, styles, markers = zip(*(_LOOKS[name] for name in shown), strict=True)
    along = ["distribution"]
    place = {"y": by_name("place")}
    settings = {
        "cols": ["__variable__"],
        "col_wrap": columns,
        "aes": {"color": along, "linestyle": along, "marker": along},
        "color": list(colors),
        "linestyle": list(styles),
        "marker": list(markers),
    }
    drawn = az.plot_dist(
        by_name("draws"),
        kind="kde",
        sample_dims="sample",
        backend=backend,
        labeller=az.labels.MapLabeller(var_name_map=texts),
        aes_by_visuals={
            "dist": ["color", "linestyle"],
            "credible_interval": ["color"],
            "point_estimate": ["color", "marker"],
        },
        visuals={
            "dist": {"width": 2},
            "credible_interval": place | {"width": 3},
            "point_estimate": place | {"size": 90},
            "point_estimate_text": False,
        },
        stats={
            "dist": by_name("density"),
            "credible_interval": by_name("interval"),
            "point_estimate": by_name("point"),
        },
        **(settings | rest | {"figure_kwargs": options}),
    )
    look = {"loc": "outside lower center", "ncols": len(shown), "frameon": False}
    drawn.add_legend(
        "distribution",
        aes=["color", "linestyle"],
        title=f"{percentage(prob)} intervals, with the mean or the optimum",
        **(look if backend == "matplotlib" else {}),
    )
    collection: PlotCollection = drawn
    return collection
