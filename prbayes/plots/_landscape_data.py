"""The objective of an optimum, and its values over one or two hyperparameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from prbayes._validate import Floats
from prbayes.model.description import labelled
from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import (
    optimum_elements,
    single_elements,
    split_elements,
    variable_of,
)
from prbayes.optimize.optimum import Optimum
from prbayes.plots._ensemble import supported
from prbayes.plots._labels import metric_label

# Half-width of an axis in standard errors: the normal approximation has a probability of 6e-5
# beyond.
_STANDARD_ERRORS = 4.0


def check_optimum(optimum: Any, caller: str) -> None:
    """Raise if it is no optimum, or one without a trace."""
    if not isinstance(optimum, Optimum):
        raise TypeError(
            f"{caller}: got {type(optimum).__name__}, expected an Optimum; call prb.minimize() "
            "first"
        )
    if not len(optimum.search.trace.get("theta", ())):
        raise ValueError(
            f"{caller}: got an optimum without a trace, expected one as prb.minimize returns it"
        )


def objective_label(optimum: Optimum) -> str:
    """Return the label of the objective."""
    if not optimum.evaluator.nodes:
        return "minus log-posterior" if optimum.search.prior else "minus log-likelihood"
    if len(optimum.scales) > 1:
        return "sum of scaled discrepancies"
    metric = optimum.evaluator.nodes[0].metric
    name = repr(metric) if metric.takes_outputs else type(metric).__name__
    return f"discrepancy ({metric_label(name)})"


def objective(optimum: Optimum, evaluator: Evaluator, thetas: Floats) -> Floats:
    """Return the sum of d_k / s_k with the optimum's scales, shape (P,)."""
    scales = [optimum.scales[node.name] for node in evaluator.nodes]
    return evaluator.total(thetas, np.array(scales))


def free_elements(evaluator: Evaluator, thetas: Floats) -> dict[str, Floats]:
    """Return the free variables' elements in the user's own units, shape (P,), by element name."""
    values = evaluator.hyperparameters.constrained(thetas)
    free = {str(rv.name): values[str(rv.name)] for rv in evaluator.model.free_RVs}
    return split_elements(labelled(evaluator, free, {"draw": len(thetas)}).data_vars)


def free_names(optimum: Optimum) -> list[str]:
    """Return the names of these elements, without constants such as zeros of a factor."""
    point = {str(rv.name): optimum.point[str(rv.name)] for rv in optimum.model.free_RVs}
    return optimum_elements(labelled(optimum.evaluator, point, {}).data_vars, optimum.stderr)


@dataclass(frozen=True, eq=False)
class Landscape:
    """The objective over a grid in the user's own units."""

    axes: list[Floats]  # (n,): one for each hyperparameter
    # (n,) or (n, n): the first hyperparameter along the first axis; NaN where stored responses do
    # not support a population or the priors exclude it.
    heights: Floats
    path: Floats  # (m, 1 or 2): points of the optimiser
    local_optima: Floats  # (m, 1 or 2)
    optimum: Floats  # (1, 1 or 2)


@dataclass(frozen=True, eq=False)
class _Plane:
    """The plane along one or two hyperparameters through an optimum."""

    evaluator: Evaluator
    names: list[str]  # of the hyperparameters along the axes
    center: dict[str, Floats]  # (1,): the optimum, by element name
    shapes: dict[str, tuple[int, ...]]  # of the free variables

    @classmethod
    def of(cls, optimum: Optimum, evaluator: Evaluator, names: list[str]) -> _Plane:
        center = optimum.theta[None]
        values = evaluator.hyperparameters.constrained(center)
        shapes = {str(rv.name): values[str(rv.name)].shape[1:] for rv in evaluator.model.free_RVs}
        return cls(evaluator, names, free_elements(evaluator, center), shapes)

    def thetas(self, places: Floats) -> Floats:
        """Return thetas of places, shape (P, 1 or 2); NaN outside the priors' support."""
        n = len(places)
        columns: dict[str, list[Floats]] = {}
        for name, value in self.center.items():
            is_axis = name in self.names
            column = places[:, self.names.index(name)] if is_axis else np.repeat(value, n)
            columns.setdefault(variable_of(name), []).append(column)
        values = [
            np.column_stack(columns[variable]).reshape(n, *shape)
            for variable, shape in self.shapes.items()
        ]
        with np.errstate(all="ignore"):
            return self.evaluator.hyperparameters.thetas_of(values)

    def within_support(self, name: str, end: float) -> float:
        """Return how far an axis can go from the optimum towards an end within the support."""
        # The axis ends short of the support's end by less than a 32nd.
        steps = np.linspace(self.center[name][0], end, 33)
        places = np.tile(_columns(self.center, self.names), (steps.size, 1))
        places[:, self.names.index(name)] = steps
        thetas = self.thetas(places)
        ok = np.isfinite(thetas).all(axis=1)
        ok[ok] = self.evaluator.hyperparameters.in_support(thetas[ok])
        outside = np.flatnonzero(~ok)
        last = max(outside[0] - 1, 0) if outside.size else -1
        return float(steps[last])


def landscape(optimum: Optimum, evaluator: Evaluator, names: list[str], points: int) -> Landscape:
    """Evaluate the objective on a grid of ``points`` along each of one or two hyperparameters."""
    plane = _Plane.of(optimum, evaluator, names)
    path = free_elements(evaluator, optimum.search.trace["theta"])
    local_optima = np.array([rival["theta"] for rival in optimum.rivals])
    rivals = free_elements(evaluator, local_optima.reshape(-1, optimum.theta.size))
    prior = free_elements(evaluator, evaluator.hyperparameters.prior_thetas(1000, 0))
    errors = single_elements(labelled(optimum.evaluator, optimum.stderr, {}).data_vars)

    axes = []
    for name in names:
        # The path beyond the prior's bulk, ten draws at each end, does not widen the axis.
        bulk = np.quantile(prior[name], (0.01, 0.99))
        marked = np.append(np.clip(path[name], *bulk), rivals[name])
        error = errors[name]
        if not (np.isfinite(error) and error > 0):  # unknown: an axis as wide as the prior
            error = float((bulk[1] - bulk[0]) / (2 * _STANDARD_ERRORS))
        low, high = _ends(plane.center[name], error, marked)
        low = plane.within_support(name, low)
        high = plane.within_support(name, high)
        axes.append(np.linspace(low, high, points))

    coordinates = np.meshgrid(*axes, indexing="ij")
    thetas = plane.thetas(np.column_stack([c.ravel() for c in coordinates]))
    ok = supported(evaluator, thetas)
    heights = np.full(len(thetas), np.nan)
    heights[ok] = objective(optimum, evaluator, thetas[ok])
    heights[~np.isfinite(heights)] = np.nan
    return Landscape(
        axes,
        heights.reshape(coordinates[0].shape),
        path=_columns(path, names),
        local_optima=_columns(rivals, names),
        optimum=_columns(plane.center, names),
    )


def _ends(center: Floats, error: float, marked: Floats) -> tuple[float, float]:
    """Return the ends of an axis: beyond some standard errors, and beyond all marked points."""
    reach = _STANDARD_ERRORS * error
    first = center[0] - reach
    last = center[0] + reach
    lowest = marked.min()
    highest = marked.max()
    # About the size of a marker.
    margin = 0.04 * (max(last, highest) - min(first, lowest))
    return min(first, lowest - margin), max(last, highest + margin)


def _columns(elements: dict[str, Floats], names: list[str]) -> Floats:
    """Return the elements of some names side by side, shape (m, names)."""
    return np.stack([elements[name] for name in names], axis=-1)


def rooted(heights: Floats) -> tuple[Floats, float, float]:
    """Return roots of heights above the lowest, 1 at their .9 quantile; lowest and quantile.

    Even levels of the root are evenly spaced around an optimum where heights are a parabola.
    """
    finite = heights[np.isfinite(heights)]
    low = float(finite.min())
    high = float(np.quantile(finite, 0.9))
    above = np.maximum(heights - low, 0.0)
    return np.sqrt(above / max(high - low, 1e-300)), low, high
