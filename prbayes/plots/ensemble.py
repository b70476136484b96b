"""Populations of a result: of posterior draws, or around an optimum; and those before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._display import percentage
from prbayes._finding import Finding, report
from prbayes._validate import (
    AT_ONCE,
    Bools,
    Floats,
    NamedValues,
    complete_rows,
    positive_integer,
    wrong_type,
)
from prbayes.model.evaluator import VISIBLE, Evaluator, supports_each
from prbayes.model.fingerprint import Level
from prbayes.model.parameters import in_support, unconstrained
from prbayes.optimize.optimum import Optimum, require_of_model
from prbayes.plots.canvas import BLUE, fill
from prbayes.plots.curves import pointwise_band
from prbayes.propagation.base import DesignError
from prbayes.response.inputs import model_on_context
from prbayes.results.predict import thetas_of
from prbayes.results.products import model_of_product, one_posterior

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False)
class Ensemble:
    """The calibrated population of a result, and populations that show its uncertainty."""

    evaluator: Evaluator
    center: Floats  # (0 or 1, d): the optimum; a posterior has none
    # (P, d): draws of the posterior, or of the optimum's sampling distribution; empty if that is
    # unknown
    thetas: Floats
    label: str  # name of the curve in the middle of the band
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

    With ``free`` the picture computes no response, and stored responses need not support them.
    """
    if isinstance(result, Optimum) and (model is None or model is result.model):
        evaluator = result.evaluator
    else:
        model = model_on_context(model, caller)
        require_of_model(result, model, caller, Level.POPULATIONS)
        result = one_posterior(result, caller)
        evaluator = Evaluator.of(model_of_product(result, model))
    cost = 0 if free else evaluator.responses_per_theta
    if n_draws is not None:
        positive_integer(n_draws, "n_draws")
    else:
        # The sides of a band are quantiles. The standard error of the probability beyond one side
        # of an 89% band is 1.6% with 200 curves, and 3.6% with 40.
        n_draws = max(8, min(40, AT_ONCE // cost)) if cost else 200
    thetas = thetas_of(result, evaluator, n_draws, caller)
    if isinstance(result, Optimum):
        around = thetas[:0]
        if np.isfinite(result.covariance).all():
            draws = np.random.default_rng(0).multivariate_normal(
                thetas[0], result.covariance, size=n_draws, method="eigh"
            )
            if free:
                ok = in_support(evaluator.hyperparameters, draws)
            else:
                ok = supported(evaluator, draws)
            around = draws[ok] if ok.mean() > 0.5 else around
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


def supported(evaluator: Evaluator, thetas: Floats) -> Bools:
    """Return which populations stored responses support well enough to be drawn, shape (P,)."""
    out = np.zeros(len(thetas), dtype=bool)
    indices = np.flatnonzero(complete_rows(thetas))
    if indices.size:
        indices = indices[in_support(evaluator.hyperparameters, thetas[indices])]
    if not indices.size:
        return out
    ok = np.ones(indices.size, dtype=bool)
    for name, support in evaluator.support(thetas[indices]).items():
        bound = evaluator.reweighted[name]
        ok &= supports_each(support, bound.required_ess, bound.max_lost, VISIBLE)
    out[indices] = ok
    return out


def read_before(
    result: Optimum | xr.DataTree,
    evaluator: Evaluator,
    before: NamedValues | bool | None,
    caller: str,
) -> tuple[Floats, str]:
    """Return theta before a calibration, shape (1, d) or (0, d) for none, and its name.

    By default it is the optimiser's first point, if the optimiser was given a start or did not
    screen for one; otherwise the prior's initial point, where PyMC's samplers start. A point that
    stored responses do not support is left out, with a finding.
    """
    theta = evaluator.hyperparameters.initial[None]
    if before is False:
        return theta[:0], ""
    if isinstance(before, Mapping):
        try:
            theta = unconstrained(evaluator.hyperparameters, dict(before))[None]
        except (KeyError, TypeError, ValueError) as error:
            raise type(error)(f"before: {error.args[0]}") from None
        name = "as given"
    elif before not in (None, True):
        expected = "a dict with a value for each hyperparameter, None or False"
        raise wrong_type(before, "before", expected)
    else:
        name = "prior's initial point"
        if isinstance(result, Optimum) and not result.search.n_screened:
            path = result.search.trace.get("theta")
            if path is not None and len(path):
                theta, name = path[:1], "optimiser's first point"
    if not supported(evaluator, theta)[0]:
        reason = "left out, because stored responses do not reach there."
        report(Finding("population-left-out", f"{caller}: before ({name}): {reason}"))
        theta = theta[:0]
    return theta, name


def middle_of(curves: Floats, ensemble: Ensemble) -> Floats:
    """Return the optimum's curve, (g,), or the mean of the posterior's, (P, g)."""
    return curves[0] if len(ensemble.center) else curves.mean(axis=0)


def draw_calibrated(
    axis: Axes,
    grid: Floats,
    curves: Floats,
    ensemble: Ensemble,
    prob: float,
    *,
    name: str = "calibrated",
    alpha: float = 0.25,
) -> float:
    """Draw the middle of curves, (P, g), of ``ensemble.every`` in its band; return the top."""
    middle = middle_of(curves, ensemble)
    top = float(middle.max())
    spread = curves[len(ensemble.center) :]
    if len(spread):
        sides = pointwise_band(spread, prob)
        top = max(top, float(sides[1].max()))
        text = f"{percentage(prob)} band of the {ensemble.spread}"
        fill(axis, grid, *sides, alpha=alpha, label=text, gid="band")
    text = f"{name}: {ensemble.label}"
    axis.plot(grid, middle, color=BLUE, linewidth=2.2, label=text, gid="after")
    return top
