"""The stages of a sampler: how it came from the prior to the posterior."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from prbayes.plots._canvas import (
    CYCLE,
    DASHDOT,
    DASHED,
    DOTTED,
    SOLID,
    Canvas,
    named,
)
from prbayes.plots._curves import log_ticks, spans_decades

_STAGES = {
    "beta": "beta (1: posterior)",
    "accept_rate": "acceptance rate",
    "n_steps": "steps per stage",
    "log_marginal_likelihood": "log marginal likelihood",
}


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
