"""The populations that a result stands for: thetas of a posterior, or around an optimum; and the one before it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from prbayes._checks import Floats
from prbayes._predict import populations_of
from prbayes.estimate.optimum import Optimum
from prbayes.model.evaluator import Evaluator
from prbayes.model.node import model_on_context
from prbayes.model.support import DesignError

_FREE, _COSTLY = 200, 40  # populations in a band, where they cost no response and where they do
_MOST = 1 << 22  # responses held in memory
_THIN = 10.0  # weight effective sample size below which a curve is an artefact of the design


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Populations of a result.

    Attributes
    ----------
    evaluator : Evaluator
    center : ndarray, shape (1, d), or None
        The optimum.
    thetas : ndarray, shape (P, d)
        Draws of the posterior, or from the optimum's sampling distribution; none where nothing is known of it.
    label : str
        What the curve in the middle is called.
    spread : str
        What the band is of.
    """

    evaluator: Evaluator
    center: Floats | None
    thetas: Floats
    label: str
    spread: str


def supported(evaluator: Evaluator, thetas: Floats) -> NDArray[np.bool_]:
    """Return which populations the designs of `Reweighted` support well enough to be drawn, shape (P,)."""
    out = np.zeros(len(thetas), dtype=bool)
    where = np.flatnonzero(np.isfinite(thetas).all(axis=1))
    if where.size:
        where = where[evaluator.in_support(thetas[where])]
    if where.size:
        good = np.ones(where.size, dtype=bool)
        for name, found in evaluator.support(thetas[where]).items():
            good &= (found["weight_ess"] >= _THIN) & (found["mean_weight"] > 0.5) & (found["mean_weight"] < 2)
            good &= found["lost_mass"] <= max(evaluator.designs[name].config.max_lost, 1e-12)
        out[where[good]] = True
    return out


def read_result(
    result: Optimum | xr.DataTree, model: pm.Model | None, caller: str, draws: int | None = None, *, free: bool = False
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
    DesignError
        If stored responses do not support most of the populations.
    """
    if model is None and isinstance(result, Optimum):
        model = result.model
    model = model_on_context(model, caller)
    own = isinstance(result, Optimum) and result.model is model
    evaluator = result.evaluator if own and isinstance(result, Optimum) else Evaluator(model)
    cost = 0 if free else evaluator.responses_per_theta
    count = draws or (max(8, min(_COSTLY, _MOST // cost)) if cost else _FREE)
    points, _ = populations_of(result, model, count, caller)
    thetas = evaluator.thetas_of([points[str(rv.name)] for rv in model.free_RVs])
    if not isinstance(result, Optimum):
        ok = supported(evaluator, thetas) if not free else np.ones(len(thetas), dtype=bool)
        if ok.mean() < 0.5:
            raise DesignError(
                f"{caller}: the stored responses support {ok.sum()} of {len(ok)} populations of the posterior, "
                "expected most; call prb.refine(model) and sample again, or pass a larger n to prb.Reweighted"
            )
        return Ensemble(evaluator, None, thetas[ok], "posterior predictive", "posterior")
    around = np.empty((0, thetas.shape[1]))
    if np.isfinite(result.covariance).all():
        rng = np.random.default_rng(0)
        around = rng.multivariate_normal(thetas[0], result.covariance, size=count, method="eigh")
        ok = evaluator.in_support(around) if free else supported(evaluator, around)
        around = around[ok] if ok.mean() > 0.5 else around[:0]
    return Ensemble(evaluator, thetas, around, "optimum", "standard error")


def read_before(
    result: Optimum | xr.DataTree, evaluator: Evaluator, before: Mapping[str, Any] | bool | None
) -> tuple[Floats, str]:
    """Return theta before a calibration, shape (1, d) or (0, d) where there is none, and what it is.

    By default that is the optimiser's first point, if it was given a start or did not look for one; else the prior's
    initial point, where PyMC's samplers start.
    """
    if before is False:
        return np.empty((0, evaluator.size)), ""
    if isinstance(before, Mapping):
        return evaluator.unconstrained(dict(before))[None], "as given"
    if before not in (None, True):
        raise TypeError(
            f"before: got {type(before).__name__}, expected a dict with a value for each hyperparameter, None or False"
        )
    if isinstance(result, Optimum) and not result.n_screened and len(result.trace.get("theta", ())):
        return result.trace["theta"][:1], "optimiser's first point"
    return evaluator.initial[None], "prior's initial point"
