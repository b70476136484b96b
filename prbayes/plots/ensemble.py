"""Populations of a result: of posterior draws, or around an optimum; and those before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from prbayes._finding import Finding, report
from prbayes._validate import AT_ONCE, Floats, positive_integer
from prbayes.model.evaluator import VISIBLE, Evaluator, supports_each
from prbayes.model.fingerprint import Level
from prbayes.optimize.optimum import Optimum, require_of_model
from prbayes.plots.canvas import BLUE, Panel
from prbayes.plots.curves import pointwise_band
from prbayes.propagation.base import DesignError
from prbayes.response.inputs import model_on_context
from prbayes.results.predict import populations_of


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Populations of a result."""

    evaluator: Evaluator
    center: Floats  # (0 or 1, d): the optimum; a posterior has none
    # (P, d): draws of the posterior, or from the optimum's sampling distribution; none where that
    # is unknown.
    thetas: Floats
    label: str  # of the curve in the middle
    spread: str  # name of the distribution that the band shows

    @property
    def every(self) -> Floats:
        """All thetas, the centre first."""
        return np.vstack([self.center, self.thetas])

    @property
    def mixture(self) -> Floats:
        """The thetas of the calibrated population: the optimum, or all draws of a posterior."""
        return self.center if len(self.center) else self.thetas


def read_result(
    result: Optimum | xr.DataTree,
    model: pm.Model | None,
    caller: str,
    n_draws: int | None = None,
    *,
    free: bool = False,
) -> Ensemble:
    """Return at most ``n_draws`` populations of a result.

    The model is by default that of the optimum, or the one on the context. With ``free``, the
    populations cost no response, whatever the propagation. Raise a `TypeError` or `KeyError` for
    another kind of result or one without a free variable of the model, a `ValueError` if it is of
    other populations or data, a `DesignError` if stored responses do not support most populations.
    """
    if isinstance(result, Optimum) and (model is None or model is result.model):
        evaluator = result.evaluator
    else:
        model = model_on_context(model, caller)
        require_of_model(result, model, caller, Level.POPULATIONS)
        evaluator = Evaluator.of(model)
    cost = 0 if free else evaluator.responses_per_theta
    if n_draws is not None:
        positive_integer(n_draws, "n_draws")
    else:
        # The sides of a band are quantiles: with 200 curves the standard error of the probability
        # beyond one side of an 89% band is 1.6%, with 40 it is 3.6%.
        n_draws = max(8, min(40, AT_ONCE // cost)) if cost else 200
    points, _ = populations_of(result, evaluator.model, n_draws, caller)
    values = [points[str(rv.name)] for rv in evaluator.model.free_RVs]
    thetas = evaluator.hyperparameters.thetas_of(values)
    if isinstance(result, Optimum):
        around = _around(result, evaluator, thetas[0], n_draws, free=free)
        return Ensemble(evaluator, thetas, around, "optimum", "standard error")
    if not free:
        ok = supported(evaluator, thetas)
        if ok.mean() < 0.5:
            raise DesignError(
                f"{caller}: the stored responses support {ok.sum()} of {len(ok)} populations of "
                "the posterior, expected most; call prb.refine(model) and sample again, or pass a "
                "larger n to prb.Reweighted"
            )
        thetas = thetas[ok]
    return Ensemble(evaluator, thetas[:0], thetas, "posterior predictive", "posterior")


def supported(evaluator: Evaluator, thetas: Floats) -> NDArray[np.bool_]:
    """Return which populations stored responses support well enough to be drawn, shape (P,)."""
    out = np.zeros(len(thetas), dtype=bool)
    indices = np.flatnonzero(np.isfinite(thetas).all(axis=1))
    if indices.size:
        indices = indices[evaluator.hyperparameters.in_support(thetas[indices])]
    if not indices.size:
        return out
    ok = np.ones(indices.size, dtype=bool)
    for name, support in evaluator.support(thetas[indices]).items():
        bound = evaluator.reweighted[name]
        ok &= supports_each(support, bound.required_ess, bound.max_lost, VISIBLE)
    out[indices] = ok
    return out


def _around(
    optimum: Optimum, evaluator: Evaluator, center: Floats, n_draws: int, *, free: bool
) -> Floats:
    """Draw from the optimum's sampling distribution, unless it is unknown or unsupported."""
    nothing = np.empty((0, center.size))
    if not np.isfinite(optimum.covariance).all():
        return nothing
    rng = np.random.default_rng(0)
    draws = rng.multivariate_normal(center, optimum.covariance, size=n_draws, method="eigh")
    ok = evaluator.hyperparameters.in_support(draws) if free else supported(evaluator, draws)
    return draws[ok] if ok.mean() > 0.5 else nothing


def read_before(
    result: Optimum | xr.DataTree,
    evaluator: Evaluator,
    before: Mapping[str, Any] | bool | None,
) -> tuple[Floats, str]:
    """Return theta before a calibration, shape (1, d) or (0, d) for none, and its name.

    By default it is the optimiser's first point, if the optimiser was given a start or did not
    screen for one; otherwise the prior's initial point, where PyMC's samplers start.
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


def if_supported(evaluator: Evaluator, theta: Floats, name: str) -> Floats:
    """Return theta, (0 or 1, d), or none and a finding if stored responses do not support it."""
    if not len(theta) or supported(evaluator, theta)[0]:
        return theta
    text = f"{name}: left out, because stored responses do not reach there."
    report(Finding("population-left-out", text))
    return theta[:0]


@dataclass(frozen=True, eq=False)
class Calibrated:
    """The calibrated curve, shape (g,), and the two sides of its band, if there is one."""

    middle: Floats
    band: tuple[Floats, Floats] | None

    @classmethod
    def of(cls, curves: Floats, ensemble: Ensemble, prob: float) -> Calibrated:
        """Summarise curves, (P, g), of ``ensemble.every``.

        The middle is the optimum's curve, or else the mean of the posterior's; the band contains
        the share ``prob`` of the draws' curves at each point.
        """
        n = len(ensemble.center)
        middle = curves[0] if n else curves[n:].mean(axis=0)
        return cls(middle, pointwise_band(curves[n:], prob) if len(curves) > n else None)

    @property
    def top(self) -> float:
        """The largest value."""
        top = float(self.middle.max())
        return top if self.band is None else max(top, float(self.band[1].max()))

    def draw(self, panel: Panel, grid: Floats, ensemble: Ensemble, prob: float) -> None:
        """Draw the calibrated curve in its band."""
        if self.band is not None:
            text = f"{prob:.0%} band of the {ensemble.spread}"
            panel.band("band", grid, self.band, BLUE, legend=text)
        text = f"calibrated: {ensemble.label}"
        panel.line("after", grid, self.middle, BLUE, width=2.2, legend=text)
