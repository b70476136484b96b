"""The discrepancy over a grid of one or two hyperparameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prbayes._validate import Floats
from prbayes.model.elements import single_elements, variable_of
from prbayes.model.evaluator import Evaluator
from prbayes.model.labels import labelled
from prbayes.optimize.optimum import Optimum
from prbayes.plots._ensemble import supported
from prbayes.plots._objective import free_elements, objective

# How far an axis goes from the optimum, in standard errors: the discrepancy is far above its lowest
# there, and the normal approximation has no probability (6e-5). By judgement.
_STANDARD_ERRORS = 4.0


@dataclass(frozen=True, eq=False)
class Landscape:
    """Heights over a grid in the user's own units."""

    axes: list[Floats]  # (n,): one for each hyperparameter
    # (n,) or (n, n): the sum of d_k / s_k, the first hyperparameter along the first axis; NaN where
    # stored responses do not support a population or the priors exclude it.
    heights: Floats
    # (m, 1 or 2): where the optimiser went, and other optima.
    path: Floats
    rivals: Floats
    optimum: Floats  # (1, 1 or 2)


@dataclass(frozen=True, eq=False)
class _Plane:
    """The plane along one or two hyperparameters through an optimum, where all others stand."""

    evaluator: Evaluator
    names: list[str]  # of the hyperparameters along the axes
    center: dict[str, Floats]  # (1,): the optimum, by element name
    shapes: dict[str, tuple[int, ...]]  # of the free variables

    def thetas(self, places: Floats) -> Floats:
        """Return thetas of places, shape (P, 1 or 2); NaN outside the priors' support."""
        size = len(places)
        at: dict[str, list[Floats]] = {}
        for name, value in self.center.items():
            if name in self.names:
                values = places[:, self.names.index(name)]
            else:
                values = np.repeat(value, size)
            at.setdefault(variable_of(name), []).append(values)
        draws = []
        for variable, shape in self.shapes.items():
            rows = np.column_stack(at[variable])
            draws.append(rows.reshape(size, *shape))
        with np.errstate(all="ignore"):
            return self.evaluator.hyperparameters.thetas_of(draws)

    def within_support(self, name: str, end: float) -> float:
        """Return how far an axis can go from the optimum towards an end within the support."""
        start = self.center[name][0]
        # With 33 points the axis ends short of the support's end by less than a 32nd.
        steps = np.linspace(start, end, 33)
        places = np.tile(_columns(self.center, self.names), (steps.size, 1))
        places[:, self.names.index(name)] = steps
        thetas = self.thetas(places)
        ok = np.isfinite(thetas).all(axis=1)
        ok[ok] = self.evaluator.hyperparameters.in_support(thetas[ok])
        outside = np.flatnonzero(~ok)
        if not outside.size:
            return float(steps[-1])
        last_inside = max(outside[0] - 1, 0)
        return float(steps[last_inside])


def landscape(optimum: Optimum, evaluator: Evaluator, names: list[str], points: int) -> Landscape:
    """Evaluate the objective on a grid of ``points`` along each of one or two hyperparameters."""
    plane = _plane(optimum, evaluator, names)

    # What is marked, by element
    path = free_elements(evaluator, optimum.search.trace["theta"])
    others = np.array([rival["theta"] for rival in optimum.rivals])
    others = others.reshape(-1, optimum.theta.size)
    rivals = free_elements(evaluator, others)
    prior = free_elements(evaluator, evaluator.hyperparameters.prior_thetas(1000, 0))

    # Axes
    axes = []
    for name in names:
        # Of the path only what is inside the prior's bulk: ten draws lie beyond each end
        bulk = np.quantile(prior[name], (0.01, 0.99))
        marked = np.append(np.clip(path[name], *bulk), rivals[name])
        error = _standard_error(optimum, name, bulk)
        low, high = _ends(plane.center[name], error, marked)
        low = plane.within_support(name, low)
        high = plane.within_support(name, high)
        axes.append(np.linspace(low, high, points))

    # Heights where there is a population to judge
    coordinates = np.meshgrid(*axes, indexing="ij")
    places = np.column_stack([c.ravel() for c in coordinates])
    thetas = plane.thetas(places)
    ok = supported(evaluator, thetas)
    heights = np.full(len(thetas), np.nan)
    heights[ok] = objective(optimum, evaluator, thetas[ok])
    heights[~np.isfinite(heights)] = np.nan
    shape = coordinates[0].shape

    return Landscape(
        axes,
        heights.reshape(shape),
        path=_columns(path, names),
        rivals=_columns(rivals, names),
        optimum=_columns(plane.center, names),
    )


def _plane(optimum: Optimum, evaluator: Evaluator, names: list[str]) -> _Plane:
    center = optimum.theta[None]
    values = evaluator.hyperparameters.constrained(center)
    shapes = {}
    for rv in evaluator.model.free_RVs:
        name = str(rv.name)
        shapes[name] = values[name].shape[1:]
    return _Plane(evaluator, names, free_elements(evaluator, center), shapes)


def _standard_error(optimum: Optimum, name: str, bulk: Floats) -> float:
    """Return the standard error, or if it is unknown what makes the axis as wide as the prior."""
    errors = labelled(optimum.evaluator, optimum.stderr, {})
    error = single_elements(errors.data_vars)[name]
    if np.isfinite(error) and error > 0:
        return error
    low, high = bulk
    return float((high - low) / (2 * _STANDARD_ERRORS))


def _ends(center: Floats, error: float, marked: Floats) -> tuple[float, float]:
    """Return where an axis should end: beyond some standard errors, and beyond what is marked."""
    reach = _STANDARD_ERRORS * error
    first = center[0] - reach
    last = center[0] + reach
    lowest = marked.min()
    highest = marked.max()
    # About the size of a marker.
    margin = 0.04 * (max(last, highest) - min(first, lowest))
    low = min(first, lowest - margin)
    high = max(last, highest + margin)
    return low, high


def _columns(elements: dict[str, Floats], names: list[str]) -> Floats:
    """Return the elements of some names side by side, shape (m, names)."""
    return np.stack([elements[name] for name in names], axis=-1)


def rooted(heights: Floats) -> tuple[Floats, float, float]:
    """Return the root of heights over the lowest, one where nine tenths are below; and the two.

    Even levels of the root crowd towards the optimum, and are evenly spaced around it where it is a
    parabola.
    """
    finite = heights[np.isfinite(heights)]
    low = float(finite.min())
    high = float(np.quantile(finite, 0.9))
    unit = max(high - low, 1e-300)
    above = np.maximum(heights - low, 0.0)
    return np.sqrt(above / unit), low, high
