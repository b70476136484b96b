"""The stages of a sampler: how it came from the prior to the posterior."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from prbayes._validate import Floats
from prbayes.plots._canvas import CYCLE, DASHDOT, DASHED, DOTTED, SOLID, Canvas, Panel, refuse_look
from prbayes.plots._names import STATISTIC_LABELS, named, refuse_labels
from prbayes.plots._ticks import Ticks, log_ticks, spans_decades

# Chains differ in colour and in style; five times four before they repeat.
_STYLES = (SOLID, DASHED, DOTTED, DASHDOT)


def plot_stages(
    posterior: xr.DataTree,
    *,
    labels: Mapping[str, str] | None = None,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the stages of a sequential Monte Carlo run, a line per chain, a panel per statistic.

    A statistic that is known at the end only, such as the log marginal likelihood, stands against
    the chain. Beta goes from the prior, 0, to the posterior, 1; chains that need very different
    numbers of stages, or whose log marginal likelihoods end far apart, have not seen the same
    posterior.

    Parameters
    ----------
    posterior : xarray.DataTree
        From `sample_smc`, with a ``sample_stats`` group of dims (chain, stage).
    labels : mapping, optional
        What a reader calls a statistic or a simulator, by its name.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        ``figsize=(8, 5)``, in inches, of the whole picture; others go to
        ``arviz.PlotCollection.wrap``, such as ``col_wrap``.

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
    >>> "chain_1" in prb.plot_stages(posterior, backend="none").viz
    True
    """
    refuse_look(labels, backend, pc_kwargs)
    known = _read_statistics(posterior)
    # Those of the last stage only come last
    statistics = sorted(known, key=lambda statistic: statistic.once)
    names = [statistic.name for statistic in statistics]
    canvas = Canvas(names, size=(4.6, 3.4), backend=backend, pc_kwargs=pc_kwargs)
    all_labels = STATISTIC_LABELS | dict(labels or {})
    refuse_labels(labels, names)
    for statistic in statistics:
        panel = canvas.panel(statistic.name)
        _draw(panel, statistic, named(statistic.name, all_labels))
    return canvas.finish()


@dataclass(frozen=True, eq=False)
class _Statistic:
    """A statistic by chain and stage."""

    name: str
    chains: list[Any]  # names of the chains
    rows: Floats  # (chains, stages): NaN where it is not known, or after the last stage of a chain

    @property
    def once(self) -> bool:
        """Whether it is known at one stage only."""
        known = np.isfinite(self.rows).sum(axis=1)
        return bool((known <= 1).all())


def _read_statistics(posterior: xr.DataTree) -> list[_Statistic]:
    """Return the statistics by stage, by order of the group."""
    if not isinstance(posterior, xr.DataTree) or "sample_stats" not in posterior:
        raise TypeError(
            f"plot_stages: posterior: got {type(posterior).__name__}, expected the DataTree of "
            "prb.sample_smc, with sample_stats"
        )
    found = []
    for name, values in posterior["sample_stats"].data_vars.items():
        if set(values.dims) == {"chain", "stage"}:
            ordered = values.transpose("chain", "stage")
            rows = np.asarray(ordered, dtype=np.float64)
            chains = ordered.chain.values.tolist()
            found.append(_Statistic(str(name), chains, rows))
    if not found:
        raise ValueError(
            "plot_stages: got sample_stats without dims (chain, stage), expected those of "
            "prb.sample_smc"
        )
    return found


def _draw(panel: Panel, statistic: _Statistic, label: str) -> None:
    """Draw a statistic of each chain: by stage, or by chain if it is known once."""
    # Beta starts at a small value and grows by orders of magnitude
    ticks, rows = None, statistic.rows
    if statistic.name == "beta" and spans_decades(rows):
        ticks = log_ticks(rows)
        rows = np.log10(rows)

    for c, chain in enumerate(statistic.chains):
        visual = f"chain_{chain}"
        text = f"chain {chain}"
        color = CYCLE[c % len(CYCLE)]
        known = np.flatnonzero(np.isfinite(rows[c]))
        y = rows[c][known]
        if statistic.once:
            panel.points(visual, [c + 1.0], y[-1:], color, size=45)
        else:
            style = _STYLES[c % len(_STYLES)]
            panel.line(visual, known + 1.0, y, color, style=style, legend=text)

    if statistic.once:
        x = "chain"
        names = [str(chain) for chain in statistic.chains]
    else:
        x = "stage"
        names = [str(stage + 1) for stage in range(rows.shape[1])]
    panel.axes(x=x, y=label, xticks=_whole(names), yticks=ticks)


def _whole(names: list[str]) -> Ticks:
    """Return ticks at 1, 2 and so on, or at ten of them at most."""
    every = -(-len(names) // 10)
    at = [float(place + 1) for place in range(0, len(names), every)]
    return at, names[::every]
