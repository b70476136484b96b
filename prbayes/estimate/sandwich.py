"""The two halves of the sandwich at one theta: the Hessian, and the covariance of the gradient.

Everything is computed from the model's own population there, so that under `Reweighted` no response
is computed. Derivatives are central differences of stored weights, exact to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats
from prbayes._weighted import distribution_function, reached
from prbayes.estimate.data_sets import DataSets, dependent, simulated_sets, thinned
from prbayes.metrics.base import Discrepancy
from prbayes.model.evaluator import Evaluator
from prbayes.model.node import Node

# Of the prior's standard deviation; densities are twice differentiable.
_STEP = 1e-3
# Where a distribution function of simulated values, a step function, or a jump is differenced.
_WIDE_STEP = 0.05
# On which distribution functions are linearised.
_KNOTS = 400
# Numbers held at a time where data sets meet the features of a stencil: 8 MiB.
_BLOCK = 1 << 20
# Single observations over which the covariance of an additive gradient is taken.
_POINTS = 1000


@dataclass(frozen=True, eq=False)
class LinearArea:
    """The area metric of data sets, with distribution functions that are linear in theta.

    At theta + delta it is the sum over intervals of |gaps + delta @ slopes| lengths.

    Attributes
    ----------
    gaps : ndarray, shape (n_sets, m)
        Simulated less observed distribution function on each interval between knots.
    slopes : ndarray, shape (d, m)
        Derivatives of the simulated one.
    lengths : ndarray, shape (m,)
        Of the intervals.
    """

    gaps: Floats
    slopes: Floats
    lengths: Floats


@dataclass(frozen=True, eq=False)
class Stencil:
    """Populations around theta: at it, a step to either side along each element, and at corners.

    Attributes
    ----------
    share : float
        The step, in prior standard deviations.
    values, weights : ndarray, shape (s, n)
    """

    share: float
    values: Floats
    weights: Floats


@dataclass(frozen=True, eq=False)
class Information:
    """Information about theta in the data of one simulator, were they drawn from the model there.

    Parameters
    ----------
    evaluator : Evaluator
    k : int
        Which simulator.
    theta : ndarray, shape (d,)
    n_sets : int
        Number of simulated data sets, each of the observed size.
    seed : int
    wide : float
        Step in prior standard deviations where the discrepancy is a step function of theta, or
        jumps.
    """

    evaluator: Evaluator
    k: int
    theta: Floats
    n_sets: int = 200
    seed: int = 0
    wide: float = _WIDE_STEP

    @property
    def node(self) -> Node:
        """The simulator."""
        return self.evaluator.nodes[self.k]

    @property
    def prior_sd(self) -> Floats:
        """The prior's standard deviations, shape (d,)."""
        return self.evaluator.prior_sd

    @property
    def _target(self) -> Discrepancy:
        return self.node.target

    @property
    def jumps(self) -> bool:
        """Whether points lose their response close to theta, where a smooth discrepancy jumps."""
        return self._target.differentiable and self._stencil.share > _STEP

    @cached_property
    def _stencil(self) -> Stencil:
        """The populations around theta, as close as the discrepancy can be differenced."""
        if self.node.bound.stored:
            return self._around(_STEP)
        if self._target.differentiable:
            narrow = self._around(_STEP)
            finite = np.isfinite(narrow.values)
            if (finite == finite[0]).all():
                return narrow
        return self._around(self.wide)

    def _around(self, share: float) -> Stencil:
        steps = self._displacements(share)
        values, weights = self.evaluator.populations(self.theta + steps, self.k)
        return Stencil(share, values, weights)

    def _displacements(self, share: float) -> Floats:
        """Return displacements: none, +- each, and the four corners of each pair."""
        d = self.theta.size
        unit = share * np.diag(self.prior_sd)
        rows = [np.zeros(d)]
        for u in unit:
            rows += [u, -u]
        for i in range(d):
            for j in range(i):
                rows += [a * unit[i] + b * unit[j] for a in (1, -1) for b in (1, -1)]
        return np.array(rows)

    @property
    def _step(self) -> Floats:
        return self._stencil.share * self.prior_sd

    @cached_property
    def _center(self) -> tuple[Floats, Floats]:
        """The population at theta that could be observed: finite, with weights that sum to one."""
        values, weights = self._stencil.values[0], self._stencil.weights[0]
        finite = np.isfinite(values)
        w = weights[finite]
        return values[finite], w / w.sum()

    @cached_property
    def data_sets(self) -> DataSets:
        """Data sets drawn from the model at theta, for all simulators; the same for one seed."""
        return simulated_sets(self.evaluator, self.theta, self.n_sets, self.seed)

    @property
    def data_set(self) -> tuple[Floats, Floats]:
        """Values and weights of this simulator's data sets, shapes (n,), (n_sets, n)."""
        return self.data_sets.values[self.k], self.data_sets.weights[self.k]

    @cached_property
    def _features(self) -> Any:
        """Features at the stencil, of a metric whose features do not depend on the observed side."""
        return self._target.features(self._stencil.values, self._stencil.weights, np)

    def _along_stencil(self, observed: Floats, weights: Floats) -> Floats:
        """Return the discrepancies at the stencil, (s,) or (n_sets, s), some data sets at a time."""
        at_once = len(weights)
        if weights.ndim > 1:
            at_once = max(1, _BLOCK // sum(f.size for f in self._features))
        found = []
        for i in range(0, len(weights), at_once):
            target = self._target.with_observed(observed, weights[i : i + at_once])
            found.append(np.atleast_1d(target.outer(*self._features, xp=np)))
        return np.concatenate(found)

    @cached_property
    def noise_floor(self) -> float:
        """The mean discrepancy between the population at theta and data sets drawn from it."""
        first = self._stencil.values[:1], self._stencil.weights[:1]
        values, weights = thinned(*first, self.node)
        observed, data_sets = self.data_set
        found = []
        for w in data_sets:
            drawn = w > 0
            target = self._target.with_observed(observed[drawn], w[drawn])
            found.append(target.of(values, weights))
        return float(np.mean(found))

    def gradients(self, observed: Floats, weights: Floats) -> Floats:
        """Return the gradients of the discrepancy at theta for data sets, shape (n_sets, d).

        Parameters
        ----------
        observed : ndarray, shape (n,)
        weights : ndarray, shape (n_sets, n)
        """
        values = self._along_stencil(observed, weights[:, None])
        beside = values[:, 1 : 1 + 2 * self.theta.size]
        up, down = beside[:, 0::2], beside[:, 1::2]
        return np.asarray((up - down) / (2 * self._step))

    @cached_property
    def sampling_covariance(self) -> Floats:
        """J: the covariance of the gradient over data sets of the observed size, shape (d, d)."""
        if not self.node.metric.additive or dependent([self.node]):
            return np.atleast_2d(np.cov(self.gradients(*self.data_set), rowvar=False))
        # A mean over observations: of single ones, at equal steps of probability, the covariance by
        # N.
        slopes = self.gradients(self._quantiles(_POINTS), np.eye(_POINTS))
        return np.atleast_2d(np.cov(slopes, rowvar=False)) / self._target.n_effective

    def _quantiles(self, n: int) -> Floats:
        """Return values of the population at theta at n equal steps of probability."""
        values, weights = self._center
        order = np.argsort(values)
        levels = (np.arange(n) + 0.5) / n
        return np.asarray(values[order][reached(weights[order], levels)])

    @cached_property
    def hessian(self) -> Floats:
        """H: the Hessian of the discrepancy against the population at theta, shape (d, d)."""
        f = self._along_stencil(*self._center)
        d, h = self.theta.size, self._step
        up, down = f[1 : 1 + 2 * d : 2], f[2 : 2 + 2 * d : 2]
        out = np.diag((up - 2 * f[0] + down) / h**2)
        row = 1 + 2 * d
        for i in range(d):
            for j in range(i):
                pp, pm, mp, mm = f[row : row + 4]
                out[i, j] = out[j, i] = (pp - pm - mp + mm) / (4 * h[i] * h[j])
                row += 4
        return np.asarray(out)

    def area(
        self, observed: Floats, weights: Floats, among: NDArray[np.bool_] | None = None
    ) -> LinearArea:
        """Return a linear model of the area metric around theta.

        Parameters
        ----------
        observed : ndarray, shape (n,)
        weights : ndarray, shape (n_sets, n)
        among : ndarray of bool, optional
            The points of the population that count; all by default.
        """
        values, w = self._stencil.values, self._stencil.weights
        if among is not None:
            w = w * among / (w * among).sum(axis=-1, keepdims=True)
        # Knots are values that occur, so that the functions are exact there.
        finite = values[0][np.isfinite(values[0])]
        knots = np.unique(np.concatenate([finite, observed]))
        some = np.linspace(0, knots.size - 1, _KNOTS).astype(int)
        knots = knots[np.unique(some)]
        if np.array_equal(values[0], values[-1], equal_nan=True):
            values = values[0]
        cdf = distribution_function(values, w, knots, kind="quicksort")
        measured = distribution_function(observed, weights, knots, kind="quicksort")
        gaps = cdf[0] - measured
        d = self.theta.size
        up, down = cdf[1 : 1 + 2 * d : 2], cdf[2 : 2 + 2 * d : 2]
        slopes = (up - down) / (2 * self._step[:, None])
        return LinearArea(gaps[:, :-1], slopes[:, :-1], np.diff(knots))
