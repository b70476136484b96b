"""`p_box`: bounds of the distribution function of a response."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._stats import ENVELOPED, envelope
from prbayes._validate import AT_ONCE, Floats, positive_integer, share
from prbayes.decision.interval import intervals, variants
from prbayes.decision.populations import Populations, Told
from prbayes.model.fingerprint import as_attributes, identity_of_model
from prbayes.model.labels import versions
from prbayes.model.locking import in_turn
from prbayes.optimize.optimum import Optimum, identity_in
from prbayes.response.response import refuse_uncallable

# Places at which distribution functions are compared: those of a band, between which both are
# monotone, differ from those at twice as many by less than the eye sees.
_PLACES = 200
# Probability beyond the outermost places, on either side, of the mean distribution.
_BEYOND_PLACES = 1e-4


@in_turn
def p_box(
    result: Optimum | xr.DataTree,
    response: Callable[..., Any],
    *inputs: Any,
    model: pm.Model | None = None,
    output: Any = None,
    level: float = 0.9,
    draws: int = ENVELOPED,
    steps: int = 5,
) -> xr.Dataset:
    r"""Return bounds of the distribution function of a response over the population.

    Two bands from the same draws of the posterior. The *pointwise* one holds the share ``level``
    of the populations' distribution functions at each place by itself. The *simultaneous* one holds
    that share of them entirely: with this posterior probability the true one is nowhere outside.

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
        the bands then hold those of all places in it.
    model : pymc.Model, optional
        That of the optimum, or the one on the context, by default.
    output : label, optional
        Which output, where a run of the response gives several.
    level : float
        Probability of the bands.
    draws : int
        Largest number of populations, over all chains; the posterior's draws are thinned evenly.
    steps : int
        Places in each interval, its ends among them; at least 2.

    Returns
    -------
    xarray.Dataset
        Dimensions ``y``, in units of the response, and ``band``, "pointwise" and "simultaneous".
        Variables ``lower`` and ``upper``, distribution functions; ``mean``, that of a new specimen,
        with intervals between ``mean`` and ``mean_upper``. Attributes: ``level``, ``responses``
        (how many were computed) and ``identity``.

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
    refuse_uncallable(caller, response)
    level = share(level, "level")
    positive_integer(draws, "draws", minimum=2)
    positive_integer(steps, "steps", minimum=2)
    populations = Populations.of(result, model, draws, caller)
    told = [populations.told(response, place, output) for place in variants(inputs, steps)]
    y = _places(told)
    lows, highs, means = [], [], []
    for one in told:
        functions = _functions(one, y)
        low, high = np.quantile(functions, [(1 - level) / 2, (1 + level) / 2], axis=0)
        lowest, highest = envelope(functions, 1 - level)
        lows.append([low, lowest])
        highs.append([high, highest])
        means.append(functions.mean(axis=0))
    lower = np.min(lows, axis=0)
    upper = np.max(highs, axis=0)
    data: dict[str, Any] = {
        "lower": (["band", "y"], lower),
        "upper": (["band", "y"], upper),
        "mean": ("y", np.min(means, axis=0)),
    }
    if intervals(inputs):
        data["mean_upper"] = ("y", np.max(means, axis=0))
    identity = identity_in(result) or identity_of_model(populations.evaluator.model)
    return xr.Dataset(
        data,
        coords={"y": y, "band": ["pointwise", "simultaneous"]},
        attrs={
            "level": level,
            "responses": sum(one.responses.count for one in told),
            **as_attributes(identity),
            **versions(),
        },
    )


def _places(told: list[Told]) -> Floats:
    """Return places at even steps of the mean distributions, with tails, all different."""
    scores = np.linspace(0, 1, _PLACES // len(told) or 2)
    # More of them in the tails: even steps of the logit.
    reach = np.log(_BEYOND_PLACES)
    levels = 1 / (1 + np.exp(reach * (1 - 2 * scores)))
    found = []
    for one in told:
        finite = np.isfinite(one.values)
        weights = _mean_weights(one)[finite]
        middles = (np.cumsum(weights) - weights / 2) / weights.sum()
        found.append(np.interp(levels, middles, one.values[finite]))
    return np.unique(np.concatenate(found))


def _mean_weights(told: Told) -> Floats:
    """Return the weights of responses in the mean of all populations, (n,)."""
    weights = [np.nansum(part, axis=0) for part in _weights(told)]
    total = np.sum(weights, axis=0)
    return np.asarray(total / total.sum())


def _functions(told: Told, y: Floats) -> Floats:
    """Return the populations' distribution functions at places, (k, m)."""
    below = np.searchsorted(told.values, y, side="right")
    parts = []
    for weights in _weights(told):
        sums = np.cumsum(weights, axis=1)
        parts.append(np.where(below > 0, sums[:, np.maximum(below - 1, 0)], 0.0))
    found = np.concatenate(parts)
    return found[np.isfinite(found).all(axis=1)]


def _weights(told: Told) -> list[Floats]:
    """Return the weights of responses in all populations, some populations at a time."""
    thetas = told.populations.thetas
    step = max(1, AT_ONCE // told.design.n_points)
    return [told.weights(thetas[i : i + step]) for i in range(0, len(thetas), step)]
