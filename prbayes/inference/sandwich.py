"""The two halves of the sandwich at one theta: the Hessian, and the covariance of the gradient.

Everything is computed from the model's own population there, so that under `Reweighted` no response
is computed. Derivatives are central differences of stored weights, exact to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._stats import distribution_function, quantile, reached
from prbayes._validate import AT_ONCE, Floats
from prbayes.inference.projections import one_dimensional
from prbayes.inference.resampling import (
    SETS,
    DataSets,
    dependent,
    observable,
    simulated_sets,
    thinned,
)
from prbayes.metrics.base import Discrepancy, is_additive
from prbayes.metrics.density import DensityDiscrepancy, is_differentiable
from prbayes.model.evaluator import Evaluator
from prbayes.model.random_variable import Node
from prbayes.numerics.derivatives import hessian_of, slopes, stencil

# Step of differences of densities, which are twice differentiable, in prior standard deviations.
_NARROW_STEP = 1e-3
# The same where a distribution function of simulated values, a step function, a jump or an edge of
# the support is differenced.
_WIDE_STEP = 0.05
# Distance between distribution functions that a step may make: a step of .6 standard deviations of
# a normal population, over which differences are right to a few percent. With ordinary priors the
# wide step makes a third of it.
_FAR_ENOUGH = 0.24
# Times that a step is shortened, each up to ten times: to 1e-11 of the prior's spread.
_SHORTENED = 8
# Knots on which distribution functions are linearised.
_KNOTS = 400
# Single observations over which the covariance of an additive gradient is taken: of one output, and
# of several, whose gradients have tails in all directions.
_SINGLE = 1000
_SINGLE_TOGETHER = 2000
# Instead of a zero that something is divided by.
_TINY = np.finfo(float).tiny


@dataclass(frozen=True, eq=False)
class LinearArea:
    """The area metric of data sets, with distribution functions that are linear in theta.

    At theta + delta it is the sum over intervals of |gaps + delta @ slopes| lengths.
    """

    # (n_sets, m): simulated less observed distribution function on each interval between knots.
    gaps: Floats
    slopes: Floats  # (d, m): derivatives of the simulated one
    lengths: Floats  # (m,): of the intervals


@dataclass(frozen=True, eq=False)
class Stencil:
    """Populations around theta, in the order of `curvature.stencil`."""

    share: float  # the step that was meant, in prior standard deviations
    step: Floats  # (d,): the step, shorter where the prior is wide beside the population
    values: Floats  # (s, n), or (s, n, m) of several outputs
    weights: Floats  # (s, n)
    blocks: NDArray[np.intp]  # (n,): of the design's points, which may change afterwards
    target: Discrepancy

    @cached_property
    def same(self) -> bool:
        """Whether the responses are the same at all points, as stored ones are."""
        return np.array_equal(self.values[0], self.values[-1], equal_nan=True)

    @cached_property
    def moves(self) -> Floats:
        """How far a step along each element moves a distribution function, at most, (d,)."""
        values = self.values[:1] if self.same else self.values
        parts = [self._moves_of(own) for own in one_dimensional(self.target, values)]
        return np.max(parts, axis=0)

    def _moves_of(self, values: Floats) -> Floats:
        """Return the same for numbers of each specimen, shape (s, n)."""
        d = self.step.size
        center = values[0]
        own = self.weights[0]
        known = np.isfinite(center) & (own > 0)
        if not known.any():
            return np.zeros(d)
        mass = own[known]
        mass = mass / mass.sum()
        levels = np.linspace(0.05, 0.95, 19)
        knots = quantile(center[known], mass, levels)
        across = slice(1 + 2 * d)
        simulated = values[0] if len(values) == 1 else values[across]
        below = distribution_function(simulated, self.weights[across], knots)
        gaps = np.abs(below[1:] - below[0]).max(axis=-1)
        either_side = np.nan_to_num(gaps).reshape(2, d)
        return np.asarray(either_side.max(axis=0))


@dataclass(frozen=True, eq=False)
class Information:
    """Information about theta in one simulator's data, were they drawn from the model there."""

    evaluator: Evaluator
    k: int  # which simulator
    theta: Floats  # (d,)
    n_sets: int = SETS  # number of simulated data sets, each of the observed size
    seed: int = 0
    # Factor of the step where the discrepancy is a step function of theta, or jumps.
    widened: float = 1.0

    @property
    def node(self) -> Node:
        """The simulator."""
        return self.evaluator.nodes[self.k]

    @property
    def prior_sd(self) -> Floats:
        """The prior's standard deviations, shape (d,)."""
        return self.evaluator.hyperparameters.prior_sd

    @property
    def _target(self) -> Discrepancy:
        return self.node.target

    @property
    def jumps(self) -> bool:
        """Whether points lose their response close to theta, where a smooth discrepancy jumps."""
        smooth = is_differentiable(self._target) and not self.node.bound.stored
        return smooth and self._stencil.share > _NARROW_STEP

    @cached_property
    def _stencil(self) -> Stencil:
        """The populations around theta, as close as the discrepancy can be differenced."""
        if self.node.bound.stored:
            # Over several points of those that an edge passes one after the other.
            moves = self.node.bound.support_moves
            return self._around(self.widened * _WIDE_STEP if moves else _NARROW_STEP)
        if is_differentiable(self._target):
            narrow = self._around(_NARROW_STEP)
            # Of several outputs one that failed is at the end of its scale, and does not jump.
            event = self._target.event
            finite = ~np.isnan(narrow.values) if event else np.isfinite(narrow.values)
            # Unless a point gains or loses its response within the step.
            unchanged = finite == finite[0]
            if unchanged.all():
                return narrow
        return self._around(self.widened * _WIDE_STEP)

    def _around(self, share: float) -> Stencil:
        """Return the populations within steps of a share of the prior's spread."""
        meant = self._within(share, share * self.prior_sd)
        if meant.moves.max(initial=0.0) <= _FAR_ENOUGH:
            return meant
        found = meant
        for _ in range(_SHORTENED):
            # Populations that do not overlap tell no more than that it is too far.
            factor = np.where(found.moves > 0.9, 0.1, 0.5 * _FAR_ENOUGH / found.moves.clip(1e-9))
            too_far = found.moves > _FAR_ENOUGH
            found = self._within(share, np.where(too_far, factor, 1.0) * found.step)
            if found.moves.max() <= _FAR_ENOUGH:
                return found
        # A population that is one number overlaps with no other.
        return meant

    def _within(self, share: float, step: Floats) -> Stencil:
        """Return the populations within given steps."""
        thetas = self.theta + stencil(step.size) * step
        values, weights = self.evaluator.populations(thetas, self.k)
        return Stencil(
            share=share,
            step=step,
            values=values,
            weights=weights,
            blocks=self.node.bound.blocks,
            target=self._target,
        )

    @property
    def blocks(self) -> NDArray[np.intp]:
        """The block of each point of the populations around theta, (n,)."""
        return self._stencil.blocks

    @property
    def _step(self) -> Floats:
        return self._stencil.step

    @property
    def _n_cross(self) -> int:
        """How many points of the stencil are theta and its neighbours along each element."""
        return 1 + 2 * self.theta.size

    @cached_property
    def _center(self) -> tuple[Floats, Floats]:
        """The population at theta that could be observed: finite, with weights that sum to one."""
        values = self._stencil.values[0]
        finite = observable(values, self._target)
        weights = self._stencil.weights[0]
        mass = weights[finite]
        return values[finite], mass / mass.sum()

    @cached_property
    def data_sets(self) -> DataSets:
        """Data sets drawn from the model at theta, for all simulators; the same for one seed."""
        return simulated_sets(self.evaluator, self.theta, self.n_sets, self.seed)

    @property
    def data_set(self) -> tuple[Floats, Floats]:
        """Values and weights of this simulator's data sets, shapes (n,), (n_sets, n)."""
        sets = self.data_sets
        return sets.values[self.k], sets.weights[self.k]

    @cached_property
    def _features(self) -> Any:
        """Features at the stencil; they do not depend on the observed side."""
        around = self._stencil
        target = self._target
        has_densities = [isinstance(part.target, DensityDiscrepancy) for part in target.parts]
        if around.same and len(has_densities) > 1 and all(has_densities):
            # Cells are filled once for all points, and not for each.
            return target.basis(around.values[0]).features(around.weights)
        return target.features(around.values, around.weights, np)

    def _along_stencil(
        self, observed: Floats, weights: Floats, points: slice = slice(None)
    ) -> Floats:
        """Return discrepancies at points of the stencil, (s,) or (n_sets, s), some at a time."""
        features = [feature[points] for feature in self._features]
        target = self._target.with_observed(observed, weights)
        n_sets = len(weights) if weights.ndim > 1 else 1
        size = sum(feature.size for feature in features)
        at_once = max(1, AT_ONCE // size)
        if n_sets <= at_once:
            return np.atleast_1d(target.outer(*features, xp=np))
        found = []
        for i in range(0, n_sets, at_once):
            some = target.rows(slice(i, i + at_once))
            found.append(some.outer(*features, xp=np))
        return np.concatenate(found)

    @cached_property
    def noise_floor(self) -> float:
        """The mean discrepancy between the population at theta and data sets drawn from it.

        Of a log-likelihood, what it is expected to gain on the way from the truth to its maximum:
        half for each hyperparameter, over N (Wilks 1938, doi:10.1214/aoms/1177732360).
        """
        if not self.node.metric.distance:
            return self.theta.size / (2 * self.node.n_specimens)
        at_theta = self.evaluator.populations(self.theta[None], self.k)
        values, weights = thinned(*at_theta, self.node)
        observed, data_sets = self.data_set
        found = []
        for own in data_sets:
            drawn = own > 0
            target = self._target.with_observed(
                observed[drawn],
                own[drawn],
            )
            distance = target.of(values, weights)
            found.append(distance)
        return float(np.mean(found))

    def gradients(self, observed: Floats, weights: Floats) -> Floats:
        """Return the gradients of the discrepancy at theta for data sets, shape (n_sets, d).

        Parameters
        ----------
        observed : ndarray, shape (n,)
        weights : ndarray, shape (n_sets, n)
        """
        across = self._along_stencil(observed, weights[:, None], slice(self._n_cross))
        return slopes(across.T, self._step)

    @cached_property
    def sampling_covariance(self) -> Floats:
        """J: the covariance of the gradient over data sets of the observed size, shape (d, d)."""
        if not is_additive(self._target) or dependent([self.node]):
            gradients = self.gradients(*self.data_set)
            covariance = np.cov(gradients, rowvar=False)
            return np.atleast_2d(covariance)
        # A mean over observations: the covariance of single ones, by N.
        single, mass = self._single
        # 64 at a time, as the work grows with their square.
        starts = range(0, len(single), 64)
        batches = [single[i : i + 64] for i in starts]
        each = [self.gradients(batch, np.eye(len(batch))) for batch in batches]
        covariance = np.cov(np.concatenate(each), rowvar=False, aweights=mass)
        return np.atleast_2d(covariance) / self._target.n_effective

    @property
    def _single(self) -> tuple[Floats, Floats]:
        """Specimens of the population at theta, and what each stands for, shapes (n, ...), (n,).

        Of one output at equal steps of probability. Of several, half are taken in proportion to the
        fourth power of their distance from the middle, since most of the mean square of gradients
        is theirs.
        """
        values, weights = self._center
        order = np.argsort(values.reshape(len(values), -1)[:, 0])
        n, mass = _SINGLE, weights
        if values.ndim > 1:
            n = _SINGLE_TOGETHER
            far = _squared_distances(self._target, values, weights) ** 2
            mass = weights * (1 + far / max(float(weights @ far), _TINY))
            mass = mass / mass.sum()
        levels = (np.arange(n) + 0.5) / n
        chosen = order[reached(mass[order], levels)]
        return values[chosen], weights[chosen] / mass[chosen]

    @cached_property
    def hessian(self) -> Floats:
        """H: the Hessian of the discrepancy against the population at theta, shape (d, d)."""
        values = self._along_stencil(*self._center)
        step = self._step
        differences = hessian_of(values, step.size)
        return differences / np.outer(step, step)

    def areas(
        self, observed: Floats, weights: Floats, among: NDArray[np.bool_] | None = None
    ) -> list[LinearArea]:
        """Return a linear model around theta of each area that the metric is a sum of.

        Parameters
        ----------
        observed : ndarray, shape (n,) or (n, m)
        weights : ndarray, shape (n_sets, n)
        among : ndarray of bool, optional
            The points of the population that count; all by default.
        """
        found = []
        for part in self._target.parts:
            seen, rows = part.observed_of(observed)
            some = weights[:, rows]
            if len(seen) < len(observed):
                some = some / some.sum(axis=1, keepdims=True)
            area = self._area(part.of(self._stencil.values), seen, some, among)
            found.append(replace(area, lengths=part.share * area.lengths))
        return found

    def _area(
        self,
        values: Floats,
        observed: Floats,
        weights: Floats,
        among: NDArray[np.bool_] | None,
    ) -> LinearArea:
        """Return the same for numbers of each specimen: simulated (s, n), observed (n,)."""
        own = self._stencil.weights
        if among is not None:
            counted = own * among
            total = counted.sum(axis=-1, keepdims=True)
            # Points that a population does not reach tell nothing of it: a function of zeros.
            own = counted / np.where(total > 0, total, 1.0)
        knots = self._knots(values[0], observed)
        # Stored responses are the same at all points of the stencil: they are sorted once.
        if np.array_equal(values[0], values[-1], equal_nan=True):
            values = values[0]
        simulated = distribution_function(values, own, knots, kind="quicksort")
        measured = distribution_function(observed, weights, knots, kind="quicksort")
        gaps = simulated[0] - measured
        across = simulated[: self._n_cross]
        derivatives = slopes(across, self._step).T
        # On the intervals between knots: what holds at their left ends.
        return LinearArea(
            gaps=gaps[:, :-1],
            slopes=derivatives[:, :-1],
            lengths=np.diff(knots),
        )

    def _knots(self, values: Floats, observed: Floats) -> Floats:
        """Return values that occur, where distribution functions are exact, some hundred of all."""
        occurring = np.concatenate([values, observed])
        knots = np.unique(occurring[np.isfinite(occurring)])
        places = np.linspace(0, knots.size - 1, _KNOTS)
        some = np.unique(places.astype(int))
        return np.asarray(knots[some])


def _squared_distances(target: Discrepancy, values: Floats, weights: Floats) -> Floats:
    """Return how far out each specimen is: mean squares of standardised projections, (n,)."""
    squares = [np.zeros(len(values))]
    for projected in one_dimensional(target, values):
        finite = np.isfinite(projected)
        known = np.where(finite, projected, 0.0)
        mass = np.where(finite, weights, 0.0)
        mass = mass / max(float(mass.sum()), _TINY)
        centered = np.where(finite, known - mass @ known, 0.0)
        variance = float(mass @ centered**2)
        squares.append(centered**2 / max(variance, _TINY))
    return np.asarray(np.mean(squares, axis=0))
