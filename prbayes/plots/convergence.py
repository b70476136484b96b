"""The path of the optimiser, and the stages of a sampler from the prior to the posterior."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from prbayes.optimize.optimum import Optimum
from prbayes.plots.canvas import (
    BLUE,
    CYCLE,
    DASHDOT,
    DASHED,
    DOTTED,
    GREY,
    SOLID,
    STATISTIC_LABELS,
    VERMILION,
    Canvas,
    named,
    refuse_labels,
    refuse_look,
    scale_by_decades,
)
from prbayes.plots.landscape import (
    check_optimum,
    free_elements,
    free_names,
    objective,
    objective_label,
)


def plot_optimizer(
    optimum: Optimum,
    *,
    labels: Mapping[str, str] | None = None,
    **pc_kwargs: Any,
) -> Any:
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
    labels : mapping, optional
        Labels of hyperparameters by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, and keywords of ``arviz.PlotCollection.wrap``.

    Returns
    -------
    arviz.PlotCollection
        Its ``viz`` has the artists ``asked`` and ``path``, ``best`` (first panel) and ``optimum``
        (other panels).

    Raises
    ------
    TypeError, ValueError
        If it is no optimum, or one without a trace.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
    ...     )
    >>> list(prb.plots.plot_optimizer(prb.minimize(model)).viz["asked"])
    ['discrepancy', 'mu']
    """
    refuse_look(labels, pc_kwargs)
    check_optimum(optimum, "plot_optimizer")
    path = free_elements(optimum.evaluator, optimum.search.trace["theta"])
    final = free_elements(optimum.evaluator, optimum.theta[None])
    hyperparameters = free_names(optimum)
    refuse_labels(labels, hyperparameters, evaluator=optimum.evaluator)
    canvas = Canvas(["discrepancy", *hyperparameters], size=(4.6, 3.4), pc_kwargs=pc_kwargs)
    evaluations = optimum.search.trace["evaluations"].astype(np.float64)

    # The objective, recomputed with the final design and scales where that costs no response
    is_free = not optimum.evaluator.responses_per_theta
    values = optimum.search.trace["discrepancy"]
    if is_free:
        values = objective(optimum, optimum.evaluator, optimum.search.trace["theta"])
    finite = np.isfinite(values)
    x, values = evaluations[finite], values[finite]
    panel = canvas.panels["discrepancy"]
    panel.points("asked", (x, values), GREY, size=16, legend="evaluated")
    # Values of different scales cannot be compared
    if is_free or len(optimum.scales) == 1:
        panel.line("best", (x, np.minimum.accumulate(values)), BLUE, legend="lowest so far")
    panel.axes(x="evaluations", y=objective_label(optimum))
    scale_by_decades(panel.target, values)

    for name in hyperparameters:
        panel = canvas.panels[name]
        panel.line("path", (evaluations, path[name]), GREY, width=0.8)
        panel.points("asked", (evaluations, path[name]), GREY, size=16, legend="evaluated")
        level = np.repeat(final[name], 2)
        ends = evaluations[[0, -1]]
        panel.line("optimum", (ends, level), VERMILION, style=DASHED, legend="optimum")
        panel.axes(x="evaluations", y=named(name, labels))
    return canvas.finish()


def plot_stages(
    posterior: xr.DataTree,
    *,
    labels: Mapping[str, str] | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the stages of a sequential Monte Carlo run, a line per chain, a panel per statistic.

    A statistic of the last stage alone, such as the log marginal likelihood, is drawn by chain.
    Beta goes from the prior, 0, to the posterior, 1. Chains with very different numbers of stages
    or log marginal likelihoods have not sampled the same posterior.

    Parameters
    ----------
    posterior : xarray.DataTree
        From `sample_smc`, with a ``sample_stats`` group of dims (chain, stage).
    labels : mapping, optional
        Labels of statistics or simulators by name.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, and keywords of ``arviz.PlotCollection.wrap``.

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
    ...     y = prb.Simulator(
    ...         "y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
    ...     )
    ...     posterior = prb.sample_smc(100, chains=2, random_seed=1, progressbar=False)
    >>> "chain_1" in prb.plots.plot_stages(posterior).viz
    True
    """
    refuse_look(labels, pc_kwargs)
    if not isinstance(posterior, xr.DataTree) or "sample_stats" not in posterior:
        raise TypeError(
            f"plot_stages: posterior: got {type(posterior).__name__}, expected the DataTree of "
            "prb.sample_smc, with sample_stats"
        )
    # NaN is unknown, or after the last stage of a chain
    statistics = {
        str(name): values.transpose("chain", "stage").astype(np.float64)
        for name, values in posterior["sample_stats"].data_vars.items()
        if set(values.dims) == {"chain", "stage"}
    }
    if not statistics:
        raise ValueError(
            "plot_stages: got sample_stats without dims (chain, stage), expected those of "
            "prb.sample_smc"
        )
    refuse_labels(labels, statistics)
    # Those of one stage only come last
    is_once = {name: values.count("stage").values.max() <= 1 for name, values in statistics.items()}
    names = sorted(statistics, key=lambda name: is_once[name])
    canvas = Canvas(names, size=(4.6, 3.4), pc_kwargs=pc_kwargs)
    # Chains differ in colour and in style; five times four before they repeat
    styles = (SOLID, DASHED, DOTTED, DASHDOT)
    for name in names:
        panel = canvas.panels[name]
        rows = statistics[name].values
        chains = [str(chain) for chain in statistics[name].chain.values.tolist()]
        for c, (chain, row) in enumerate(zip(chains, rows, strict=True)):
            visual = f"chain_{chain}"
            color = CYCLE[c % len(CYCLE)]
            stages = np.flatnonzero(np.isfinite(row))
            if is_once[name]:
                panel.points(visual, ([c + 1.0], row[stages][-1:]), color, size=45)
            else:
                look: Any = {"style": styles[c % len(styles)], "legend": f"chain {chain}"}
                panel.line(visual, (stages + 1.0, row[stages]), color, **look)
        ticks = chains if is_once[name] else [str(stage + 1) for stage in range(rows.shape[1])]
        step = -(-len(ticks) // 10)  # at most ten
        places = [float(place + 1) for place in range(0, len(ticks), step)]
        y = named(name, STATISTIC_LABELS | dict(labels or {}))
        x = "chain" if is_once[name] else "stage"
        panel.axes(x=x, y=y, xticks=(places, ticks[::step]))
        if name == "beta":  # starts at a small value and grows by orders of magnitude
            scale_by_decades(panel.target, rows)
    return canvas.finish()
