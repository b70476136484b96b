"""Visual predictive checks: percentiles of readings beside those of replicates."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from prbayes._display import percentage
from prbayes._stats import INTERVAL
from prbayes._validate import Floats, Indices, Labels, flag, positive_integer, share
from prbayes.plots.canvas import (
    BLUE,
    GREY,
    check_options,
    fill,
    finish,
    ink,
    named,
    panels,
    refuse_labels,
)
from prbayes.plots.individuals import specimen_groups
from prbayes.plots.selection import Coords, FilterVars, VarNames, select_variables

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_predictive_check(
    individuals: xr.DataTree,
    *,
    bins: int = 8,
    corrected: bool = False,
    var_names: VarNames | None = None,
    filter_vars: FilterVars | None = None,
    coords: Coords | None = None,
    prob: float = INTERVAL,
    labels: Labels | None = None,
    **pc_kwargs: Any,
) -> Figure:
    r"""Draw percentiles of the readings beside intervals of those of replicates.

    Readings are sorted into bins of the horizontal axis, such as time, by Ward's clusters. Lines
    are the 5, 50 and 95 % percentiles of the readings in each bin. Bands contain those of
    replicates of all specimens under their own conditions. A right model has lines within the
    bands. With different doses the percentiles mix doses; a prediction-corrected check [1]_
    replaces readings and replicates by

    .. math:: y_{ij} \frac{\tilde m_k}{m_{ij}},

    where :math:`m_{ij}` is the mean of the replicates of the reading, and :math:`\tilde m_k` the
    median of :math:`m_{ij}` in bin k. Readings whose replicates have a mean within ten standard
    errors of zero, such as those before a dose, are left out, and counted in the title.

    Parameters
    ----------
    individuals : xarray.DataTree
        From `individuals`.
    bins : int
        Largest number of bins.
    corrected : bool
        Whether the check is prediction-corrected.
    var_names : str or sequence of str, optional
        Simulators, in this order; by default all with a horizontal axis: numbers of outputs, such
        as times, or a condition.
    filter_vars : {None, "like", "regex"}
        How ``var_names`` are read, as by ArviZ.
    coords : mapping, optional
        Labels of specimens and outputs by dimension, such as the specimens of one dose.
    prob : float
        Probability of the bands.
    labels : mapping, optional
        Labels of simulators, conditions and dimensions by name, with units.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, ``col_wrap`` panels in a row, and ``figure_kwargs`` for
        ``matplotlib.pyplot.figure``.

    Returns
    -------
    matplotlib.figure.Figure
        With a panel for each simulator, whose label is its name.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, or no simulator has a horizontal axis.

    References
    ----------
    .. [1] Bergstrand, M., A. C. Hooker, J. E. Wallin and M. O. Karlsson (2011),
       Prediction-corrected visual predictive checks for diagnosing nonlinear mixed-effects models,
       AAPS J. 13, 143-151, doi:10.1208/s12248-011-9255-z.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> time = np.array([0.5, 1.0, 2.0])
    >>> def decay(rate, time):
    ...     return np.exp(-np.multiply.outer(rate, time))
    >>> data = decay(np.array([0.8, 0.9, 1.0, 1.1, 1.3]), time)
    >>> with pm.Model() as model:
    ...     rate = pm.LogNormal.dist(pm.Normal("mu", 0, 0.5), pm.HalfNormal("sigma", 0.5))
    ...     metric = prb.LogLikelihood(error=0.02)
    ...     times = prb.response.condition("time", np.tile(time, (5, 1)))
    ...     y = prb.Simulator("y", decay, rate, times, observed=data, metric=metric)
    >>> subjects = prb.individuals(prb.minimize(model))
    >>> prb.plots.plot_predictive_check(subjects).axes[0].get_label()
    'y'
    """
    check_options(labels, pc_kwargs)
    share(prob, "prob")
    positive_integer(bins, "bins")
    flag(corrected, "corrected")
    groups = specimen_groups(individuals, coords)
    conditions = groups.get("constant_data", xr.Dataset())
    observed = groups["observed_data"]
    horizontal = {
        str(name): axis
        for name, y in observed.data_vars.items()
        if (axis := _horizontal_axis(y, conditions)) is not None
    }
    if not horizontal:
        raise ValueError(
            "individuals: got readings without a horizontal axis, expected outputs whose labels "
            "are numbers, such as times, or a condition; use prb.plots.plot_individuals"
        )
    names = select_variables(list(horizontal), var_names, filter_vars)
    refuse_labels(labels, [*names, *(title for title, _ in horizontal.values())])
    figure, axes = panels(names, size=(6.0, 4.2), pc_kwargs=pc_kwargs)
    for name, panel in axes.items():
        title, x = horizontal[name]
        y = observed[name].values
        is_read = np.isfinite(y)
        stacked = groups["posterior_predictive"][name].stack(sample=("chain", "draw"))
        replicates = stacked.transpose("sample", ...).values[:, is_read]
        x, y = np.broadcast_to(x, is_read.shape)[is_read], y[is_read]
        places = _bins(x, bins)
        if corrected:
            factor = _correction(replicates, places)
            y, replicates = y * factor, replicates * factor
            n_left_out = int(np.isnan(factor).sum())
            if n_left_out:
                panel.set_title(f"{n_left_out} of {y.size} readings without prediction left out")
        panel.scatter(x, y, 8, color=GREY, label="measured", gid="observed")
        is_shown = np.isfinite(y)
        x, y, replicates, places = (
            x[is_shown],
            y[is_shown],
            replicates[:, is_shown],
            places[is_shown],
        )
        if y.size:
            _draw_percentiles(panel, x, y, replicates, places, prob)
        label = named(name, labels)
        panel.set(
            xlabel=named(title, labels),
            ylabel=f"{label}, prediction-corrected" if corrected else label,
        )
    return finish(figure)


def _horizontal_axis(y: xr.DataArray, conditions: xr.Dataset) -> tuple[str, Floats] | None:
    """Return the name and the values of the horizontal axis, which broadcast to the readings."""
    dim = str(y.dims[-1])
    if y.ndim == 2 and y[dim].dtype.kind in "iuf" and y.sizes[dim] > 1:
        return dim, y[dim].values.astype(float)
    for name, x in conditions.data_vars.items():
        if x.dims == y.dims[:1]:
            return str(name), x.values.reshape(-1, *[1] * (y.ndim - 1))
    return None


def _bins(x: Floats, bins: int) -> Indices:
    """Return the bin of each value: clusters of values, which wide gaps separate."""
    from scipy.cluster.hierarchy import fcluster, linkage  # heavy, and only needed here

    values, inverse = np.unique(x, return_inverse=True)
    if values.size <= bins:
        return inverse
    clusters = fcluster(linkage(values[:, None], "ward"), bins, "maxclust")
    return np.asarray(clusters[inverse])


def _correction(replicates: Floats, places: Indices) -> Floats:
    """Return the factor of each reading, (n,), from replicates (P, n); NaN without a prediction."""
    mean = replicates.mean(axis=0)
    standard_error = replicates.std(axis=0) / np.sqrt(len(replicates))
    # A mean close to zero, such as before the first dose, would be a factor without meaning.
    is_positive = mean > 10 * standard_error
    factor = np.full(mean.shape, np.nan)
    for k in np.unique(places):
        rows = is_positive & (places == k)
        if rows.any():
            factor[rows] = np.median(mean[rows]) / mean[rows]
    return factor


def _draw_percentiles(
    axis: Any, x: Floats, y: Floats, replicates: Floats, places: Indices, prob: float
) -> None:
    """Draw percentiles of readings as lines, and those of replicates as bands, over the bins."""
    of_bins = [places == k for k in np.unique(places)]
    of_bins.sort(key=lambda rows: np.median(x[rows]))
    middles = [np.median(x[rows]) for rows in of_bins]
    tail = (1 - prob) / 2
    for level, color, style in ((0.05, GREY, "--"), (0.5, BLUE, "-"), (0.95, GREY, "--")):
        measured = [np.quantile(y[rows], level) for rows in of_bins]
        drawn = [np.quantile(replicates[:, rows], level, axis=1) for rows in of_bins]
        low, high = np.quantile(drawn, [tail, 1 - tail], axis=1)
        is_median = level == 0.5
        text = "median" if is_median else "5 and 95 % percentile"
        band = f"{text} of replicates: {percentage(prob)}"
        fill(axis, middles, low, high, color=color, label=band, gid=f"band {level:g}")
        axis.plot(middles, measured, style, color=ink(), label=text, gid=f"measured {level:g}")
