"""The path of the optimiser, and the stages of a sampler from the prior to the posterior."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from prbayes._validate import Labels, Record, wrong_type
from prbayes.optimize.optimum import Optimum
from prbayes.plots.canvas import (
    BLUE,
    CYCLE,
    GREY,
    STATISTIC_LABELS,
    VERMILION,
    check_options,
    finish,
    named,
    panels,
    refuse_labels,
    scale_by_decades,
)
from prbayes.plots.landscape import (
    check_optimum,
    free_elements,
    objective,
    objective_label,
    select_free,
)
from prbayes.plots.selection import Coords, FilterVars, VarNames, select_variables, subset

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_optimizer(
    optimum: Optimum,
    *,
    var_names: VarNames | None = None,
    filter_vars: FilterVars | None = None,
    coords: Coords | None = None,
    labels: Labels | None = None,
    **pc_kwargs: Any,
) -> Figure:
    """Draw the objective and the hyperparameters of an optimiser's evaluations.

    The first panel has the objective, the sum of d_k / s_k, of each point and the lowest so far,
    with logarithmic ticks if it falls over more than a decade. A panel for each hyperparameter
    follows, in the user's own units, with the optimum as a dashed line. With `Reweighted` the
    objective is recomputed with the final design and scales, without a response. Otherwise it is
    the one that the optimiser used; with several simulators, whose scales may have changed, the
    lowest is not shown.

    Parameters
    ----------
    optimum : Optimum
        From `minimize`.
    var_names : str or sequence of str, optional
        Hyperparameters, or elements of them, in this order; all by default.
    filter_vars : {None, "like", "regex"}
        How ``var_names`` are read, as by ArviZ.
    coords : mapping, optional
        Labels of the hyperparameters by dimension, such as ``{"supplier": ["Adler"]}``.
    labels : mapping, optional
        Labels of hyperparameters by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, ``col_wrap`` panels in a row, and ``figure_kwargs`` for
        ``matplotlib.pyplot.figure``.

    Returns
    -------
    matplotlib.figure.Figure
        Its panels have the labels ``discrepancy`` and those of the hyperparameters.

    Raises
    ------
    TypeError, KeyError, ValueError
        If it is no optimum, has no trace, or an argument is not as described.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
    ...     )
    >>> figure = prb.plots.plot_optimizer(prb.minimize(model))
    >>> [axis.get_label() for axis in figure.axes]
    ['discrepancy', 'mu']
    """
    check_options(labels, pc_kwargs)
    check_optimum(optimum, "plot_optimizer")
    path = free_elements(optimum.evaluator, optimum.search.trace["theta"])
    final = free_elements(optimum.evaluator, optimum.theta[None])
    hyperparameters = select_free(optimum, var_names, filter_vars, coords)
    refuse_labels(labels, hyperparameters, evaluator=optimum.evaluator)
    names = ["discrepancy", *hyperparameters]
    figure, axes = panels(names, size=(4.6, 3.4), pc_kwargs=pc_kwargs)
    evaluations = optimum.search.trace["evaluations"].astype(np.float64)

    # Designs and scales change during the search. The objective is recomputed with the final ones
    # if that costs no response, so that all values can be compared.
    is_free = not optimum.evaluator.responses_per_theta
    values = optimum.search.trace["discrepancy"]
    if is_free:
        values = objective(optimum, optimum.evaluator, optimum.search.trace["theta"])
    finite = np.isfinite(values)
    x, values = evaluations[finite], values[finite]
    axis = axes["discrepancy"]
    axis.scatter(x, values, 16, color=GREY, label="evaluated", gid="evaluated")
    # Values with different scales cannot be compared: then there is no lowest one.
    if is_free or len(optimum.scales) == 1:
        lowest = np.minimum.accumulate(values)
        axis.plot(x, lowest, color=BLUE, label="lowest so far", gid="lowest")
    axis.set(xlabel="evaluations", ylabel=objective_label(optimum))
    scale_by_decades(axis, values)

    for name in hyperparameters:
        axis = axes[name]
        axis.plot(evaluations, path[name], color=GREY, linewidth=0.8, gid="path")
        axis.scatter(evaluations, path[name], 16, color=GREY, label="evaluated", gid="evaluated")
        axis.axhline(
            final[name][0], color=VERMILION, linestyle="--", label="optimum", gid="optimum"
        )
        axis.set(xlabel="evaluations", ylabel=named(name, labels))
    return finish(figure)


def plot_stages(
    posterior: xr.DataTree,
    *,
    var_names: VarNames | None = None,
    filter_vars: FilterVars | None = None,
    coords: Coords | None = None,
    labels: Labels | None = None,
    **pc_kwargs: Any,
) -> Figure:
    """Draw the stages of a sequential Monte Carlo run, a line per chain, a panel per statistic.

    A statistic of the last stage alone, such as the log marginal likelihood, is drawn by chain.
    Beta goes from the prior, 0, to the posterior, 1. Chains with very different numbers of stages
    or log marginal likelihoods have not sampled the same posterior.

    Parameters
    ----------
    posterior : xarray.DataTree
        From `sample_smc`, with a ``sample_stats`` group of dims (chain, stage).
    var_names : str or sequence of str, optional
        Statistics, in this order; all by default.
    filter_vars : {None, "like", "regex"}
        How ``var_names`` are read, as by ArviZ.
    coords : mapping, optional
        Such as ``{"chain": [0, 1]}``.
    labels : mapping, optional
        Labels of statistics or simulators by name.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, ``col_wrap`` panels in a row, and ``figure_kwargs`` for
        ``matplotlib.pyplot.figure``.

    Returns
    -------
    matplotlib.figure.Figure
        Its panels have the labels of the statistics.

    Raises
    ------
    TypeError, KeyError, ValueError
        If there is no group with statistics by stage, or an argument is not as described.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
    ...     )
    ...     posterior = prb.sample_smc(100, chains=2, random_seed=1, progressbar=False)
    >>> figure = prb.plots.plot_stages(posterior, var_names=["beta", "accept_rate"])
    >>> [axis.get_label() for axis in figure.axes]
    ['beta', 'accept_rate']
    """
    check_options(labels, pc_kwargs)
    if not isinstance(posterior, xr.DataTree) or "sample_stats" not in posterior:
        expected = "the DataTree of prb.sample_smc, with sample_stats"
        raise wrong_type(posterior, "plot_stages: posterior", expected)
    stages = posterior["sample_stats"].to_dataset()
    # NaN marks an unknown value, or a stage after the last one of a chain.
    statistics = {
        str(name): values.transpose("chain", "stage").astype(np.float64)
        for name, values in subset(stages, coords).data_vars.items()
        if set(values.dims) == {"chain", "stage"}
    }
    if not statistics:
        raise ValueError(
            "plot_stages: got sample_stats without dims (chain, stage), expected those of "
            "prb.sample_smc"
        )
    refuse_labels(labels, statistics)
    # Statistics with a value in the last stage alone are the last panels.
    is_once = {name: values.count("stage").values.max() <= 1 for name, values in statistics.items()}
    names = sorted(statistics, key=lambda name: is_once[name])
    names = select_variables(names, var_names, filter_vars)
    figure, axes = panels(names, size=(4.6, 3.4), pc_kwargs=pc_kwargs)
    for name, axis in axes.items():
        rows = statistics[name].values
        chains = [str(chain) for chain in statistics[name].chain.values.tolist()]
        for c, (chain, row) in enumerate(zip(chains, rows, strict=True)):
            look: Record = {"color": CYCLE[c % len(CYCLE)], "gid": f"chain_{chain}"}
            at = np.flatnonzero(np.isfinite(row))
            if is_once[name]:
                axis.scatter([c + 1.0], row[at][-1:], 45, **look)
            else:
                # Five colours and four styles distinguish twenty chains.
                style = ("-", "--", ":", "-.")[c % 4]
                axis.plot(at + 1.0, row[at], style, label=f"chain {chain}", **look)
        ticks = chains if is_once[name] else [str(stage + 1) for stage in range(rows.shape[1])]
        step = -(-len(ticks) // 10)  # More than ten labels would overlap.
        axis.set_xticks(np.arange(1, len(ticks) + 1, step), ticks[::step])
        y = named(name, STATISTIC_LABELS | dict(labels or {}))
        axis.set(xlabel="chain" if is_once[name] else "stage", ylabel=y)
        if name == "beta":  # Beta grows by orders of magnitude.
            scale_by_decades(axis, rows)
    return finish(figure)
