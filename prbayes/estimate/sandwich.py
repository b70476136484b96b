"""The two halves of the sandwich at one theta: the Hessian, and the sampling covariance of the gradient.

Everything is computed from the model's own population there, so that under `Reweighted` no response is
computed. Derivatives are central differences of stored weights, exact to rounding.
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
from prbayes.model.evaluator import Evaluator

_STEP = 1e-3  # of the prior's standard deviation; densities are twice differentiable
_WIDE_STEP = 0.05  # where a distribution function of simulated values, a step function, or a jump is differenced
_KNOTS = 400  # on which distribution functions are linearised
_BLOCK = 1 << 20  # numbers held at a time where data sets meet the features of a stencil
_POINTS = 1000  # single observations over which the covariance of an additive gradient is taken


@dataclass(frozen=True, eq=False)
class Information:
    """Local information about theta in the data of one simulator, were they drawn from the model at ``theta``.

    Parameters
    ----------
    evaluator : Evaluator
    k : int
        Which simulator.
    theta : ndarray, shape (d,)
    scale : ndarray, shape (d,)
        The prior's standard deviations; sets the step of the differences.
    n_sets : int
        Number of simulated data sets, each of the observed size.
    seed : int
    wide : float
        Step in units of the scale where the discrepancy is a step function of theta, or jumps.
    """

    evaluator: Evaluator
    k: int
    theta: Floats
    scale: Floats
    n_sets: int = 200
    seed: int = 0
    wide: float = _WIDE_STEP

    @property
    def _smooth(self) -> bool:
        return self.evaluator.nodes[self.k].target.differentiable

    @property
    def jumps(self) -> bool:
        """Whether points lose their response close to theta, where a smooth discrepancy jumps."""
        return self._smooth and self._around[0] > _STEP

    @cached_property
    def _around(self) -> tuple[float, tuple[Floats, Floats]]:
        """The step, in prior standard deviations, and the populations around theta."""

        def look(step: float) -> tuple[float, tuple[Floats, Floats]]:
            return step, self.evaluator.populations(self.theta + self._stencil(step), self.k)

        if self.evaluator.nodes[self.k].bound.stored:
            return look(_STEP)
        if self._smooth:
            narrow = look(_STEP)
            finite = np.isfinite(narrow[1][0])
            if (finite == finite[0]).all():
                return narrow
        return look(self.wide)

    @property
    def _step(self) -> Floats:
        return self._around[0] * self.scale

    @property
    def _populations(self) -> tuple[Floats, Floats]:
        return self._around[1]

    def _stencil(self, step: float) -> Floats:
        """Displacements: none, +- each, and the four corners of each pair."""
        d = self.theta.size
        unit = step * np.diag(self.scale)
        rows = [np.zeros(d), *(s * u for u in unit for s in (1, -1))]
        for i in range(d):
            rows += [a * unit[i] + b * unit[j] for j in range(i) for a in (1, -1) for b in (1, -1)]
        return np.array(rows)

    @cached_property
    def _center(self) -> tuple[Floats, Floats]:
        """The population at theta that could be observed: finite responses, weights that sum to one."""
        values, weights = self._populations
        finite = np.isfinite(values[0])
        w = weights[0][finite]
        return values[0][finite], w / w.sum()

    @cached_property
    def data_sets(self) -> DataSets:
        """Data sets drawn from the model at theta, for all simulators; the same for all parts of one seed."""
        return simulated_sets(self.evaluator, self.theta, self.n_sets, self.seed)

    @property
    def data_set(self) -> tuple[Floats, Floats]:
        """The values and weights of this simulator's data sets, shapes (n,), (n_sets, n)."""
        return self.data_sets.values[self.k], self.data_sets.weights[self.k]

    @cached_property
    def _features(self) -> Any:
        """Features at the stencil, of a metric whose features do not depend on the observed side."""
        return self.evaluator.nodes[self.k].target.features(*self._populations, np)

    def _along_stencil(self, observed: Floats, weights: Floats) -> Floats:
        target = self.evaluator.nodes[self.k].target
        at_once = max(1, _BLOCK // sum(f.size for f in self._features)) if weights.ndim > 1 else len(weights)
        blocks = [weights[i : i + at_once] for i in range(0, len(weights), at_once)]
        return np.concatenate(
            [np.atleast_1d(target.with_observed(observed, w).outer(*self._features, xp=np)) for w in blocks]
        )

    @cached_property
    def noise_floor(self) -> float:
        """The mean discrepancy between the population at theta and data sets drawn from it."""
        target = self.evaluator.nodes[self.k].target
        values, weights = thinned(self._populations[0][:1], self._populations[1][:1], self.evaluator.nodes[self.k])
        observed, u = self.data_set
        return float(np.mean([target.with_observed(observed[v > 0], v[v > 0]).of(values, weights) for v in u]))

    def gradients(self, observed: Floats, weights: Floats) -> Floats:
        """Return the gradients of the discrepancy at theta for data sets (n,), (n_sets, n), shape (n_sets, d)."""
        values = self._along_stencil(observed, weights[:, None])[:, 1 : 1 + 2 * self.theta.size]
        return np.asarray((values[:, 0::2] - values[:, 1::2]) / (2 * self._step))

    @cached_property
    def sampling_covariance(self) -> Floats:
        """J: the covariance of the gradient over data sets of the observed size, shape (d, d)."""
        target = self.evaluator.nodes[self.k].target
        if not target.metric.additive or dependent([self.evaluator.nodes[self.k]]):
            return np.atleast_2d(np.cov(self.gradients(*self.data_set), rowvar=False))
        values, weights = self._center
        order = np.argsort(values)
        levels = (np.arange(_POINTS) + 0.5) / _POINTS
        points = values[order][reached(weights[order], levels)]
        slopes = self.gradients(points, np.eye(_POINTS))
        return np.atleast_2d(np.cov(slopes, rowvar=False)) / target.n_effective

    @cached_property
    def hessian(self) -> Floats:
        """H: the Hessian of the discrepancy at theta against the population at theta, shape (d, d)."""
        f = self._along_stencil(*self._center)
        d, h = self.theta.size, self._step
        out = np.diag((f[1 : 1 + 2 * d : 2] - 2 * f[0] + f[2 : 2 + 2 * d : 2]) / h**2)
        row = 1 + 2 * d
        for i in range(d):
            for j in range(i):
                pp, pm, mp, mm = f[row : row + 4]
                out[i, j] = out[j, i] = (pp - pm - mp + mm) / (4 * h[i] * h[j])
                row += 4
        return np.asarray(out)

    def area(
        self, observed: Floats, weights: Floats, among: NDArray[np.bool_] | None = None
    ) -> tuple[Floats, Floats, Floats]:
        """Return a linear model of the area metric for data sets (n,), (n_sets, n), from all points or from some.

        Returns
        -------
        tuple of ndarray
            Gaps between distribution functions (n_sets, m), their slopes (d, m), lengths (m,).
        """
        values, w = self._populations
        if among is not None:
            w = w * among / (w * among).sum(axis=-1, keepdims=True)
        knots = np.unique(np.concatenate([values[0][np.isfinite(values[0])], observed]))
        knots = knots[np.unique(np.linspace(0, knots.size - 1, _KNOTS).astype(int))]
        if np.array_equal(values[0], values[-1], equal_nan=True):
            values = values[0]
        cdf = distribution_function(values, w, knots, kind="quicksort")
        measured = distribution_function(observed, weights, knots, kind="quicksort")
        d = self.theta.size
        slopes = (cdf[1 : 1 + 2 * d : 2] - cdf[2 : 2 + 2 * d : 2]) / (2 * self._step[:, None])
        return (cdf[0] - measured)[:, :-1], slopes[:, :-1], np.diff(knots)
