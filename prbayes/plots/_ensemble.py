"""The populations that a result stands for: of a posterior, or around an optimum; and before it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from prbayes._validate import AT_ONCE, Floats
from prbayes.model.coverage import VISIBLE, supports_each
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import Level
from prbayes.optimize.optimum import Optimum, require_of_model
from prbayes.propagation.base import DesignError
from prbayes.response.inputs import model_on_context
from prbayes.results.predict import populations_of


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Populations of a result."""

    evaluator: Evaluator
    center: Floats  # (0 or 1, d): the optimum; a posterior has none
    # (P, d): draws of the posterior, or from the optimum's sampling distribution; none where
    # nothing is known of it.
    thetas: Floats
    label: str  # what the curve in the middle is called
    spread: str  # what the band is of

    @property
    def every(self) -> Floats:
        """All thetas, the centre first."""
        return np.vstack([self.center, self.thetas])


def supported(evaluator: Evaluator, thetas: Floats) -> NDArray[np.bool_]:
    """Return which populations stored responses support well enough to be drawn, shape (P,)."""
    out = np.zeros(len(thetas), dtype=bool)
    where = np.flatnonzero(np.isfinite(thetas).all(axis=1))
    if where.size:
        where = where[evaluator.hyperparameters.in_support(thetas[where])]
    if not where.size:
        return out
    good = np.ones(where.size, dtype=bool)
    for name, support in evaluator.support(thetas[where]).items():
        design = evaluator.designs[name]
        good &= supports_each(support, design.required_ess, design.config.max_lost, VISIBLE)
    out[where] = good
    return out


def read_result(
    result: Optimum | xr.DataTree,
    model: pm.Model | None,
    caller: str,
    draws: int | None = None,
    *,
    free: bool = False,
) -> Ensemble:
    """Return the populations of a result.

    Parameters
    ----------
    result : Optimum or xarray.DataTree
    model : pymc.Model or None
        That of the optimum, or the one on the context, by default.
    caller : str
        For messages.
    draws : int, optional
        Largest number of thetas.
    free : bool
        Whether what is asked for costs no response, whatever the propagation.

    Raises
    ------
    TypeError, KeyError
        If the result is of another type, or lacks a free variable of the model.
    ValueError
        If it is of other populations or data than the model.
    DesignError
        If stored responses do not support most of the populations.
    """
    evaluator = _evaluator_of(result, model, caller)
    cost = 0 if free else evaluator.responses_per_theta
    count = draws or _affordable(cost)
    points, _ = populations_of(result, evaluator.model, count, caller)
    values = [points[str(rv.name)] for rv in evaluator.model.free_RVs]
    thetas = evaluator.hyperparameters.thetas_of(values)
    if isinstance(result, Optimum):
        around = _around(result, evaluator, thetas[0], count, free=free)
        return Ensemble(evaluator, thetas, around, "optimum", "standard error")
    if not free:
        thetas = _supported_draws(evaluator, thetas, caller)
    return Ensemble(evaluator, thetas[:0], thetas, "posterior predictive", "posterior")


def _evaluator_of(result: Optimum | xr.DataTree, model: pm.Model | None, caller: str) -> Evaluator:
    """Return the optimum's own evaluator, or one of the model given or on the context."""
    if isinstance(result, Optimum) and (model is None or model is result.model):
        return result.evaluator
    found = model_on_context(model, caller)
    require_of_model(result, found, caller, Level.POPULATIONS)
    return Evaluator.of(found)


def _affordable(cost: int) -> int:
    """Return how many populations are drawn if each costs so many responses."""
    # The sides of a band are quantiles of so many curves: with 200 the standard error of the share
    # beyond one side of an 89% band is 1.6%, which a reader does not see; with 40 it is 3.6%.
    if not cost:
        return 200
    fitting = min(40, AT_ONCE // cost)
    return max(8, fitting)


def _supported_draws(evaluator: Evaluator, thetas: Floats, caller: str) -> Floats:
    """Return the draws of a posterior that stored responses support, which must be most."""
    ok = supported(evaluator, thetas)
    if ok.mean() < 0.5:
        raise DesignError(
            f"{caller}: the stored responses support {ok.sum()} of {len(ok)} populations of the "
            "posterior, expected most; call prb.refine(model) and sample again, or pass a larger n "
            "to prb.Reweighted"
        )
    return thetas[ok]


def _around(
    optimum: Optimum, evaluator: Evaluator, center: Floats, count: int, *, free: bool
) -> Floats:
    """Draw from the optimum's sampling distribution, or return none where it is not known.

    Draws without a population are left out; if they are most, the approximation is of no use.
    """
    nothing = np.empty((0, center.size))
    if not np.isfinite(optimum.covariance).all():
        return nothing
    rng = np.random.default_rng(0)
    drawn = rng.multivariate_normal(center, optimum.covariance, size=count, method="eigh")
    ok = evaluator.hyperparameters.in_support(drawn) if free else supported(evaluator, drawn)
    return drawn[ok] if ok.mean() > 0.5 else nothing


def read_before(
    result: Optimum | xr.DataTree,
    evaluator: Evaluator,
    before: Mapping[str, Any] | bool | None,
) -> tuple[Floats, str]:
    """Return theta before a calibration, shape (1, d) or (0, d) for none, and what it is.

    By default that is the optimiser's first point, if it was given a start or did not look for one;
    else the prior's initial point, where PyMC's samplers start.
    """
    if before is False:
        return np.empty((0, evaluator.hyperparameters.size)), ""
    if isinstance(before, Mapping):
        try:
            return evaluator.hyperparameters.unconstrained(dict(before))[None], "as given"
        except (KeyError, TypeError, ValueError) as error:
            raise type(error)(f"before: {error.args[0]}") from None
    if before not in (None, True):
        raise TypeError(
            f"before: got {type(before).__name__}, expected a dict with a value for each "
            "hyperparameter, None or False"
        )
    if isinstance(result, Optimum) and not result.search.n_screened:
        path = result.search.trace.get("theta")
        if path is not None and len(path):
            return path[:1], "optimiser's first point"
    return evaluator.hyperparameters.initial[None], "prior's initial point"
