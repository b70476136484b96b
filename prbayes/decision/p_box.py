"""Probability box: bounds of the distribution function of a response."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import replace
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._display import Table, View, percentage
from prbayes._finding import as_json, report, sentences_of
from prbayes._stats import ENVELOPED, INTERVAL, distribution_function, envelope, quantile
from prbayes._validate import (
    ArrayPair,
    Arrays,
    Floats,
    Function,
    StrPath,
    complete_rows,
    positive_integer,
    share,
)
from prbayes.decision.populations import (
    CentralSpecimens,
    Populations,
    ResponseSample,
    answers_by_family,
    left_out_findings,
    probability_bounds,
    rough_sample,
    share_error,
)
from prbayes.decision.quantities import extreme_places, interval_grid
from prbayes.model.locking import locked
from prbayes.model.random_variable import response_name
from prbayes.optimize.optimum import Optimum
from prbayes.response.discrepancy import findings_of
from prbayes.response.response import refuse_uncallable
from prbayes.results.predict import call_settings


@locked
def p_box(
    result: Optimum | xr.DataTree,
    response: Function,
    *inputs: Any,
    model: pm.Model | None = None,
    output: Any = None,
    prob: float = INTERVAL,
    n_draws: int = ENVELOPED,
    steps: int = 5,
    executor: Executor | None = None,
    store: StrPath | None = None,
    version: str | None = None,
) -> ProbabilityBox:
    r"""Return bounds of the distribution function of a response over the population.

    Two bands from the same draws of the posterior. The *pointwise* band contains the share ``prob``
    of the populations' distribution functions at each value by itself. The *simultaneous* band
    contains that share of them entirely: with this posterior probability the true distribution
    function is nowhere outside.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
        From `minimize`, with its sampling distribution; or with a ``posterior`` group, from any
        sampler.
    response : callable
        As for `predict`; +inf is a specimen that failed. Another response than a simulator's is
        computed once for each run of the design, unless `predict` did that before.
    *inputs
        As for `predict`. An `Interval` among them is a constant known only to lie between two ends:
        the bands then contain those at all points of the interval, whose extremes are searched as
        by `exceedance`.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    output : label, optional
        Which output, where a run of the response gives several.
    prob : float
        Probability of the bands.
    n_draws : int
        Largest number of populations, over all chains; the posterior's draws are thinned evenly.
    steps : int
        Number of values in each interval, its ends included; at least 2.
    executor : concurrent.futures.Executor, optional
        Where the response is computed.
    store : path-like, optional
        A folder that keeps every computed response, by its name.
    version : str, optional
        Of the response, for the store; as for `Reweighted`.

    Returns
    -------
    xarray.Dataset
        Dimensions ``y``, in units of the response, and ``band``, "pointwise" and "simultaneous".
        Variables ``lower`` and ``upper``, distribution functions; ``mean``, that of a new specimen,
        with intervals between ``mean`` and ``mean_upper``; and ``error``, the largest standard
        error of ``mean`` from the points, the emulator and the draws, which the bands do not
        include: of smaller tails ask `exceedance`. Where no point is below y, or none above, the
        bands have the bound of the effective number of points; they are wider by the share of
        specimens without response. It prints as quantiles; a notebook
        shows a table. Attributes: ``prob``, ``response`` (its name), ``responses`` (number
        computed), ``findings`` (as JSON) and ``identity``.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, the result is another model's, or the inputs have no
        stored responses.
    DesignError
        If the design does not support the populations, or too many responses are NaN.
    ResponseError
        If the response raises, or has the wrong shape.

    References
    ----------
    .. [1] Ferson, S. et al. (2003), Constructing probability boxes and Dempster-Shafer structures,
       Sandia report SAND2002-4015, doi:10.2172/809606.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
    ...     data = np.random.default_rng(1).normal(0, 1, 50)
    ...     y = prb.Simulator("y", lambda x: x, x, metric=prb.AreaMetric(), observed=data)
    >>> box = prb.decision.p_box(prb.minimize(model), np.exp, x)
    >>> wide = box.upper - box.lower
    >>> bool((wide.sel(band="simultaneous") >= wide.sel(band="pointwise")).all())
    True
    """
    caller = "prb.decision.p_box"
    refuse_uncallable(caller, response, order="p_box(result, response, *inputs)")
    prob = share(prob, "prob")
    positive_integer(n_draws, "n_draws", minimum=2)
    positive_integer(steps, "steps", minimum=2)
    populations = Populations.of(
        result, model, n_draws, caller, call_settings(executor, store, version)
    )
    places = interval_grid(inputs, steps)
    samples = [populations.sample(response, place, output) for place in places]
    y = _evaluation_points(samples)
    n_searched = 0
    if len(places) > 1:
        respond = CentralSpecimens(populations, response, output, samples[0].design.n_runs)
        # Limits beyond all responses lead to the places with the most extreme responses.
        limits = [2 * y[0] - y[-1], np.median(y), 2 * y[-1] - y[0]]
        extremes = extreme_places(inputs, places, respond, limits)
        samples += [populations.sample(response, place, output) for place in extremes]
        y = _evaluation_points(samples)
        n_searched = respond.count
    bands = [_bands(sample, y, prob) for sample in samples]
    lower, upper, means, errors = zip(*bands, strict=True)
    lowest, highest = outermost(lower, upper)
    name = response_name(response, output)
    lost = max(sample.lost for sample in samples)
    answer = "the mean is that of the others, and the bands contain them at either end"
    findings = findings_of(response) + left_out_findings(name, lost, answer)
    findings += report(*rough_sample(samples[0]))

    def tails(sample: ResponseSample) -> str:
        populations = sample.populations
        at_populations = [replace(x, populations=populations) for x in samples]
        functions = [_distribution_functions(x, y).mean(axis=0) for x in at_populations]
        low = min(_place(function, y, 0.01) for function in functions)
        high = max(_place(function, y, 0.99) for function in functions)
        return f"{low:.4g} and {high:.4g}"

    findings += answers_by_family(samples[0], "the 1% and 99% quantiles are", tails)
    data = {
        "lower": (["band", "y"], lowest),
        "upper": (["band", "y"], highest),
        "mean": ("y", np.min(means, axis=0)),
        "error": ("y", np.max(errors, axis=0)),
    }
    if len(places) > 1:
        data["mean_upper"] = ("y", np.max(means, axis=0))
    return ProbabilityBox(
        data,
        coords={"y": y, "band": ["pointwise", "simultaneous"]},
        attrs={
            "prob": prob,
            "response": name,
            "responses": n_searched + sum(sample.responses.count for sample in samples),
            "findings": as_json(findings),
            **populations.provenance(),
        },
    )


class ProbabilityBox(Table):
    """Bounds of a distribution function."""

    __slots__ = ()
    _parts = ("lower", "upper", "mean", "error", "y", "band", "prob", "response")
    _columns = ("lower", "upper", "mean", "error")

    def to_view(self) -> View:
        """Return what a reader sees."""
        y, rows = self["y"].values, []
        for p in (0.01, 0.05, 0.5, 0.95, 0.99):
            row = [f"{percentage(p)} quantile", f"{_place(self['mean'].values, y, p):.4g}"]
            for band in ("pointwise", "simultaneous"):
                bounds = self.sel(band=band)
                low, high = (_place(bounds[key].values, y, p) for key in ("upper", "lower"))
                row.append(f"{low:.4g} to {high:.4g}")
            rows.append(row)
        prob = percentage(self.attrs["prob"])
        heading = f"Distribution of {self.attrs['response']}, with {prob} bands"
        columns = ["", "new specimen", "pointwise", "simultaneous"]
        return View(heading, columns, rows, sentences_of(self.attrs))


def _place(function: Floats, y: Floats, probability: float) -> float:
    """Return the quantile of a distribution function given at y, (m,); infinite beyond y."""
    return float(np.interp(probability, function, y, left=-np.inf, right=np.inf))


def outermost(lower: Arrays, upper: Arrays) -> ArrayPair:
    """Return the outermost of bands, (band, y): a bound of a distribution function holds beyond."""
    lowest = np.min(np.maximum.accumulate(lower, axis=-1), axis=0)
    flipped = np.minimum.accumulate(np.flip(upper, -1), axis=-1)
    return lowest, np.max(flipped, axis=0)[:, ::-1]


def _evaluation_points(samples: list[ResponseSample]) -> Floats:
    """Return quantiles of the mean distributions, evenly spaced in the logit of the probability."""
    # Probabilities range from 1e-4 to 1 - 1e-4. Twice as many points look the same in a plot.
    steps = np.linspace(0, 1, 200 // len(samples) or 2)
    levels = 1 / (1 + np.exp(np.log(1e-4) * (1 - 2 * steps)))
    points = []
    for sample in samples:
        is_finite = np.isfinite(sample.values)
        weights = sample.mean_weights[is_finite]
        points.append(quantile(sample.values[is_finite], weights / weights.sum(), levels))
    return np.unique(np.concatenate(points))


def _bands(sample: ResponseSample, y: Floats, prob: float) -> tuple[Floats, ...]:
    """Return lower and upper ends of both bands at y, (2, m), the mean function and its error."""
    functions = _distribution_functions(sample, y)
    mean = functions.mean(axis=0)
    error = share_error(sample, lambda values: (values[:, None] <= y).astype(float))
    if sample.populations.are_draws:
        error = np.hypot(error, functions.std(axis=0, ddof=1) / np.sqrt(len(functions)))
    tail = (1 - prob) / 2
    least, most = probability_bounds(mean, error, tail)
    low, high = np.quantile(functions, [tail, 1 - tail], axis=0)
    lowest, highest = envelope(functions, 1 - prob)
    lower = np.where(mean > 1 - 1e-12, least, [low, lowest])
    upper = np.where(mean == 0, most, [high, highest])
    # Specimens without response may be above all values, or below them.
    lower, upper = lower * (1 - sample.lost), upper * (1 - sample.lost) + sample.lost
    return lower, upper, mean, error


def _distribution_functions(sample: ResponseSample, y: Floats) -> Floats:
    """Return the distribution functions of all valid populations at y, (k, m)."""
    functions = sample.evaluate(
        lambda values, weights: distribution_function(values, weights, y), sample.populations.thetas
    )
    return functions[complete_rows(functions)]
