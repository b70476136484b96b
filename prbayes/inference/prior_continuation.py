"""Continuation of populations beyond the ends of bounded priors.

The population of an input often exists beyond the end of a uniform prior, and minimisers of
synthetic data sets lie there as well. Only the posterior contains the prior.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import expit, logit

from prbayes._validate import Bools, Floats
from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import THETAS, Hyperparameters


@dataclass(frozen=True, eq=False)
class Continuation:
    """Coordinates of theta in which bounded elements continue beyond an end of their prior.

    An element in the interval (a, b) has the value v = a + (b - a) / (1 + exp(-theta)). Its
    coordinate is v if populations exist beyond both ends, log(v - a) if only beyond b, -log(b - v)
    if only beyond a, and theta if beyond none.
    """

    lower: Floats  # (d,): lower ends a; NaN of elements without ends
    upper: Floats  # (d,): upper ends b; NaN of elements without ends
    below: Bools  # (d,): whether populations exist below the lower end
    above: Bools

    @property
    def is_continued(self) -> Bools:
        """Which elements continue beyond an end, (d,)."""
        return self.below | self.above

    def coordinates(self, thetas: Floats) -> Floats:
        """Return coordinates of thetas, (S, d)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            width = self.upper - self.lower
            distance = width * expit(thetas)
            remaining = width * expit(-thetas)
            result = np.where(self.below & self.above, self.lower + distance, thetas)
            result = np.where(self.above & ~self.below, np.log(distance), result)
            result = np.where(self.below & ~self.above, -np.log(remaining), result)
        return result

    def values(self, coordinates: Floats) -> Floats:
        """Return values of continued elements, NaN of others, (S, d)."""
        with np.errstate(over="ignore"):
            result = np.where(self.below & self.above, coordinates, np.nan)
            above = self.lower + np.exp(coordinates)
            below = self.upper - np.exp(-coordinates)
        result = np.where(self.above & ~self.below, above, result)
        return np.where(self.below & ~self.above, below, result)

    def within(self, coordinates: Floats, margin: float = 1e-3) -> Floats:
        """Return thetas of coordinates, moved within the ends, (S, d)."""
        return self._thetas(self._shares(coordinates, margin), coordinates)

    def _unbounded_shares(self, coordinates: Floats) -> Floats:
        """Return values as fractions of the interval; those beyond its ends are not clipped."""
        return (self.values(coordinates) - self.lower) / (self.upper - self.lower)

    def _shares(self, coordinates: Floats, margin: float) -> Floats:
        """Return values as shares of the interval, a margin away from ends that are passed."""
        shares = self._unbounded_shares(coordinates)
        least = np.where(self.below, margin, 1e-300)
        return np.clip(shares, least, np.where(self.above, 1 - margin, 1 - 1e-16))

    def _thetas(self, shares: Floats, coordinates: Floats) -> Floats:
        return np.where(self.is_continued, logit(shares), coordinates)

    def parents(self, evaluator: Evaluator, coordinates: Floats, k: int) -> list[Floats]:
        """Return the parents of the k-th simulator, continued linearly beyond the ends."""
        margin = 1e-3  # part of the interval from whose slope the parents are extrapolated
        shares = self._shares(coordinates, margin)
        base = evaluator.parents(self._thetas(shares, coordinates), k)
        parents = list(base)
        beyond = self._unbounded_shares(coordinates) - shares
        for i in np.flatnonzero(self.is_continued):
            passed = np.abs(beyond[:, i]) > 1e-12
            if not passed.any():
                continue
            inside = shares.copy()
            steps = -margin * np.sign(beyond[:, i])
            inside[:, i] += steps
            moved = evaluator.parents(self._thetas(inside, coordinates), k)
            factors = np.where(passed, beyond[:, i] / np.where(passed, steps, 1.0), 0.0)
            for j, (value, inner) in enumerate(zip(base, moved, strict=True)):
                column = factors.reshape(-1, *np.ones(value.ndim - 1, dtype=int))
                parents[j] = parents[j] + column * (inner - value)
        return parents


@dataclass(frozen=True, eq=False, kw_only=True)
class ContinuedHyperparameters(Hyperparameters):
    """Hyperparameters with coordinates of a `Continuation` in place of theta."""

    continuation: Continuation
    inner: Hyperparameters

    @cached_property
    def prior_sd(self) -> Floats:
        """The prior's standard deviation of each coordinate, (d,)."""
        points = self.continuation.coordinates(self.inner.prior_thetas(THETAS, 0))
        upper, lower = np.quantile(points, [0.84, 0.16], axis=0)
        spread = (upper - lower) / 2
        return np.where(self.continuation.is_continued, spread, self.inner.prior_sd)

    def prior_points(self, size: int, seed: int) -> Floats:
        """Return coordinates spread evenly over the prior, (size, d)."""
        return self.continuation.coordinates(self.inner.prior_points(size, seed))


@dataclass(frozen=True, eq=False, kw_only=True)
class ContinuedEvaluator(Evaluator):
    """An evaluator of populations at coordinates of a `Continuation` in place of theta."""

    continuation: Continuation
    inner: Evaluator

    @classmethod
    def continuing(cls, evaluator: Evaluator, continuation: Continuation) -> ContinuedEvaluator:
        """Return an evaluator with the simulators and compiled functions of another."""
        fields = {
            f.name: getattr(evaluator, f.name) for f in dataclasses.fields(Evaluator) if f.init
        }
        inner = evaluator.hyperparameters
        fields["hyperparameters"] = ContinuedHyperparameters(
            inner.model, inner.point, continuation=continuation, inner=inner
        )
        return cls(**fields, continuation=continuation, inner=evaluator)

    def parents(self, thetas: Floats, k: int) -> list[Floats]:
        """Return the values of the parents of the k-th simulator, shapes (P, *shape)."""
        return self.continuation.parents(self.inner, thetas, k)


def continuation_of(evaluator: Evaluator, thetas: Floats) -> Continuation:
    """Return the continuation beyond those ends where populations of thetas, (S, d), exist.

    An element is bounded if its value is the logistic function of theta between fixed ends.
    """
    hyperparameters = evaluator.hyperparameters
    d = hyperparameters.size
    base = hyperparameters.prior_thetas(2, 0)
    _, lower, upper = ends_of_prior(hyperparameters, base[0])
    expected = lower + (upper - lower) * expit(base)
    if np.isfinite(expected).any():
        values = _free_values(hyperparameters, base)
        is_logistic = np.isclose(values, expected, rtol=1e-9).all(axis=0)
        lower, upper = (np.where(is_logistic, ends, np.nan) for ends in (lower, upper))
    bounded = np.isfinite(upper - lower)
    below, above = bounded.copy(), bounded.copy()
    for side, sign in ((below, -1), (above, 1)):
        for i in np.flatnonzero(bounded):
            alone = np.arange(d) == i
            side[i] = False
            trial = Continuation(lower, upper, below=alone, above=alone)
            points = trial.coordinates(np.nan_to_num(thetas, posinf=30, neginf=-30))
            middle, half = (upper[i] + lower[i]) / 2, (upper[i] - lower[i]) / 2
            points[:, i] = middle + sign * 1.05 * half
            continued = ContinuedEvaluator.continuing(evaluator, trial)
            # A population exists there if its weights are finite and not all zero.
            weights = [continued.populations(points, k)[1] for k in range(len(evaluator.nodes))]
            side[i] = all(np.isfinite(w).all() and bool((w.sum(axis=1) > 0).all()) for w in weights)
    return Continuation(lower, upper, below, above)


def ends_of_prior(hyperparameters: Hyperparameters, theta: Floats) -> tuple[Floats, Floats, Floats]:
    """Return values of elements in the users' own units, and the ends of their ranges, (d,) each.

    They are NaN where there is no end, and for all elements if one variable is a simplex.
    """
    d = theta.size
    # A transform has reached its end if a point far out and one much farther out have the same
    # value.
    spread = np.diag(hyperparameters.prior_sd)
    far = [theta + size * spread for size in (-1e6, -1e3, 1e3, 1e6)]
    with np.errstate(over="ignore", invalid="ignore"):
        values = _free_values(hyperparameters, np.vstack([theta, *far]))
    if values.shape[1] != d:
        unknown = np.full(d, np.nan)
        return unknown, unknown, unknown
    outermost, low, high, uppermost = np.diagonal(values[1:].reshape(4, d, d), axis1=1, axis2=2)
    lower = np.where((low == outermost) & np.isfinite(low), low, np.nan)
    upper = np.where((high == uppermost) & np.isfinite(high), high, np.nan)
    return values[0], lower, upper


def _free_values(hyperparameters: Hyperparameters, thetas: Floats) -> Floats:
    """Return the values of the free variables, (S, d), or (S, k) with a simplex among them."""
    variables = hyperparameters.constrained(thetas)
    names = [str(rv.name) for rv in hyperparameters.model.free_RVs]
    return np.column_stack([variables[name].reshape(len(thetas), -1) for name in names])
