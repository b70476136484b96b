"""The discrepancy over a grid of two hyperparameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from prbayes._checks import Floats
from prbayes.estimate.optimum import Optimum
from prbayes.model.evaluator import Evaluator
from prbayes.plots._ensemble import supported

_SDS, _DRAWS, _STEPS = 4.0, 1000, 33


@dataclass(frozen=True, eq=False)
class Landscape:
    """Heights over a grid in the user's own units.

    Attributes
    ----------
    axes : list of ndarray, shape (n,)
        One for each hyperparameter.
    heights : ndarray, shape (n,) or (n, n)
        The sum of d_k / s_k, the first hyperparameter along the first axis; NaN where stored responses do not support
        a population or the priors exclude it.
    path, rivals : ndarray, shape (m, 1 or 2)
        Where the optimiser went, and other optima.
    optimum : ndarray, shape (1, 1 or 2)
    """

    axes: list[Floats]
    heights: Floats
    path: Floats
    rivals: Floats
    optimum: Floats


def elements(evaluator: Evaluator, thetas: Floats) -> dict[str, Floats]:
    """Return the elements of the free variables, in the user's own units, shape (P,), by names such as 'mu[1]'."""
    values = evaluator.constrained(thetas)
    found: dict[str, Floats] = {}
    for rv in evaluator.model.free_RVs:
        name = str(rv.name)
        for i in np.ndindex(values[name].shape[1:]):
            found[f"{name}[{','.join(map(str, i))}]" if i else name] = values[name][(slice(None), *i)]
    return found


def landscape(optimum: Optimum, evaluator: Evaluator, names: list[str], points: int) -> Landscape:
    """Evaluate the objective on a grid of ``points`` along each of one or two hyperparameters."""
    center = elements(evaluator, optimum.theta[None])

    def thetas(places: Floats) -> Floats:
        """Return thetas of places, shape (P, m)."""
        at = {name: np.repeat(value, len(places)) for name, value in center.items()}
        at |= dict(zip(names, places.T, strict=True))
        draws = []
        for rv in evaluator.model.free_RVs:
            own = [v for n, v in at.items() if n.partition("[")[0] == rv.name]
            draws.append(np.stack(own, axis=-1).reshape(len(places), *map(int, rv.shape.eval())))
        with np.errstate(all="ignore"):  # outside the support
            return evaluator.thetas_of(draws)

    def along(name: str, end: float) -> float:
        """Return how far the axis of a hyperparameter can go towards an end without leaving the priors' support."""
        steps = np.linspace(center[name][0], end, _STEPS)
        places = np.array([np.repeat(center[n][0], _STEPS) if n != name else steps for n in names]).T
        rows = thetas(places)
        ok = np.isfinite(rows).all(axis=1)
        ok[ok] = evaluator.in_support(rows[ok])
        return float(steps[max(int(np.argmin(np.append(ok, False))) - 1, 0)])

    path, prior = elements(evaluator, optimum.trace["theta"]), elements(evaluator, evaluator.prior_thetas(_DRAWS, 0))
    rivals = elements(evaluator, np.array([r["theta"] for r in optimum.rivals]).reshape(-1, optimum.theta.size))
    axes = []
    for name in names:
        low, high = np.quantile(prior[name], [0.01, 0.99])
        sd = _stderr(optimum, name)
        sd = sd if np.isfinite(sd) and sd > 0 else (high - low) / (2 * _SDS)
        seen = np.concatenate([np.clip(path[name], low, high), rivals[name]])
        near = center[name][0] + _SDS * sd * np.array([-1, 1])
        room = 0.04 * np.ptp(np.append(near, seen))
        ends = min(near[0], seen.min() - room), max(near[1], seen.max() + room)
        axes.append(np.linspace(along(name, ends[0]), along(name, ends[1]), points))
    rows = thetas(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(names)))
    ok = supported(evaluator, rows)
    heights = np.full(len(rows), np.nan)
    heights[ok] = evaluator.total(rows[ok], np.array([optimum.scales[n.name] for n in evaluator.nodes]))
    heights = np.where(np.isfinite(heights), heights, np.nan).reshape([points] * len(names))
    where = (np.stack([found[n] for n in names], axis=-1) for found in (path, rivals, center))
    return Landscape(axes, heights, *where)


def _stderr(optimum: Optimum, name: str) -> float:
    stem, bracket, rest = name.partition("[")
    index = tuple(map(int, rest[:-1].split(","))) if bracket else ()
    return float(np.asarray(optimum.stderr[stem])[index])


def rooted(heights: Floats) -> tuple[Floats, float, float]:
    """Return the root of heights over the lowest, in units of where nine tenths of the plane are below; and both.

    Even levels of the root crowd towards the optimum, and are evenly spaced around it where it is a parabola.
    """
    finite = heights[np.isfinite(heights)]
    low, high = float(finite.min()), float(np.quantile(finite, 0.9))
    return np.sqrt(np.maximum(heights - low, 0.0) / max(high - low, 1e-300)), low, high


_METRICS = {
    "AreaMetric": "area metric",
    "KullbackLeibler": "Kullback-Leibler",
    "LogLikelihood": "log-likelihood",
    "ProbabilityResidual": "probability residual",
}


def objective_of(optimum: Optimum) -> str:
    if len(optimum.scales) > 1:
        return "sum of d / s"
    name = type(optimum.evaluator.nodes[0].metric).__name__
    return f"discrepancy ({_METRICS.get(name, name)})"


def check_optimum(optimum: Any, caller: str) -> None:
    if not isinstance(optimum, Optimum):
        raise TypeError(f"{caller}: got {type(optimum).__name__}, expected an Optimum; call prb.minimize() first")
    if not len(optimum.trace.get("theta", ())):
        raise ValueError(f"{caller}: got an optimum without a trace, expected one as prb.minimize returns it")
