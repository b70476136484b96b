"""The sampling distribution of a minimiser, and refits: the minimisers of many data sets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats
from prbayes._progress import progress
from prbayes.estimate.batch_bfgs import descend
from prbayes.estimate.batch_objective import BatchObjective
from prbayes.estimate.batch_simplex import descend_by_simplex
from prbayes.estimate.curvature import second_differences
from prbayes.estimate.data_sets import DataSets, observed_set
from prbayes.estimate.measured import Refits
from prbayes.estimate.obstacles import measured_by_refits
from prbayes.estimate.sampling import Local, first_order_shifts, local_sampling
from prbayes.estimate.sandwich import Information
from prbayes.model.evaluator import Evaluator
from prbayes.propagation.base import N_BLOCKS

_STEP = 0.02  # of differences, in standard errors
_TOLERANCE = (
    1e-4  # gain, in units of the curvature along a standard error, that is left on the table
)
_TYPICAL = 50  # data sets from which the curvature is guessed
_BLOCK = 1 << 23  # weights held at a time
_SETTLED = 1.5  # ratio of standard errors from one step of the differences and from its double
_LOWEST = (
    0.05  # curvature along an axis, as a share of the largest, that a first guess has at least
)
# First edges of simplices, in standard errors: the second one starts where the first came to rest.
_SIMPLICES = (1.0, -0.5)


@dataclass(frozen=True, eq=False)
class SamplingDistribution:
    """How the minimiser scatters around an optimum, over data sets that might have been observed.

    Attributes
    ----------
    evaluator : Evaluator
    theta : ndarray, shape (d,)
    scales : ndarray, shape (k,)
        By which the simulators' discrepancies are divided before they are added.
    information : list of Information
        By simulator.
    local : Local
    axes : ndarray, shape (d, r)
        Principal axes of the sampling distribution along the directions that the data identify,
        orthonormal in units of the prior's spread.
    stderr : ndarray, shape (r,)
        Standard errors along them.
    """

    evaluator: Evaluator
    theta: Floats
    scales: Floats
    information: list[Information]
    local: Local
    axes: Floats
    stderr: Floats

    @classmethod
    def of(
        cls, evaluator: Evaluator, theta: Floats, scales: Floats, weakest: float = 1.0
    ) -> SamplingDistribution:
        """Return the distribution at theta.

        From the metrics' derivatives, to first order; from refits where a metric declares nothing.
        Directions with a standard error above ``weakest`` prior standard deviations are not
        identified.
        """
        information = [Information(evaluator, k, theta) for k in range(len(evaluator.nodes))]
        if measured_by_refits(evaluator):
            local = Refits.at(evaluator, theta, scales).local(weakest)
        else:
            local = local_sampling(information, scales, weakest)
        variances, vectors = np.linalg.eigh(local.covariance)
        axes = local.identified @ vectors
        stderr = np.sqrt(np.maximum(variances, 1e-300))
        return cls(evaluator, theta, scales, information, local, axes, stderr)

    def unsettled(self) -> list[int]:
        """Return the simulators whose discrepancy jumps here, if that matters.

        It does if twice the step of the differences gives other errors: second differences over a
        jump are the smaller the wider the step, those of a smooth function are not.
        """
        jumping = [i.k for i in self.information if i.jumps]
        if not jumping:
            return []
        wider = [replace(i, wide=2 * i.wide) for i in self.information]
        variances = np.diag(local_sampling(self.information, self.scales).in_theta)
        others = np.diag(local_sampling(wider, self.scales).in_theta)
        ratio = np.sqrt(variances / others)
        settled = (ratio > 1 / _SETTLED) & (ratio < _SETTLED)
        return [] if settled.all() else jumping

    def coordinates(self, thetas: Floats) -> tuple[Floats, Floats]:
        """Return coordinates along the axes, and what remains of thetas (..., d).

        Returns
        -------
        x : ndarray, shape (..., r)
            In standard errors.
        remainder : ndarray, shape (..., d)
            In theta.
        """
        shifts = (thetas - self.theta) / self.local.prior_sd
        x = shifts @ self.axes
        remainder = (shifts - x @ self.axes.T) * self.local.prior_sd
        return x / self.stderr, remainder

    def thetas(self, x: Floats, remainder: Floats | float = 0.0) -> Floats:
        """Return thetas, (..., d), of coordinates (..., r) and what remains."""
        shifts = (x * self.stderr) @ self.axes.T
        return np.asarray(self.theta + shifts * self.local.prior_sd + remainder)

    def refit(self, sets: DataSets) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the minimiser of each data set, (n_sets, r) in coordinates, and which converged.

        With designs the minimisation is exact, and else of first order; no response is computed
        with designs.
        """
        if not all(n.bound.stored for n in self.evaluator.nodes):
            shifts = first_order_shifts(self.information, self.scales, self.axes, sets)
            return shifts / self.stderr, np.ones(len(shifts), dtype=bool)
        n_sets = len(sets.weights[0])
        at_once = self._at_once(sets)
        minimisers, converged = [], []
        with progress("refits", n_sets) as report:
            for i in range(0, n_sets, at_once):
                some = DataSets(sets.values, [w[i : i + at_once] for w in sets.weights])
                x, ok = self._minimise(BatchObjective.of(self.evaluator, self.scales, some))
                minimisers.append(x)
                converged.append(ok)
                report(len(ok), "")
        return np.concatenate(minimisers), np.concatenate(converged)

    def _at_once(self, sets: DataSets) -> int:
        """Return how many data sets fit into memory."""
        pairs = zip(self.evaluator.nodes, sets.values, strict=True)
        points = max(node.bound.n_points + values.size for node, values in pairs)
        return max(1, _BLOCK // (points * (2 * self.stderr.size + 1)))

    def design_error(self) -> float:
        """Return how far the optimum of an independent design would be; NaN if not known.

        In standard errors, along the worst axis. The design is taken apart into blocks, each a
        coarser design of the same kind, and the minimum of each is found: their spread, as if they
        were independent, bounds the error of the whole. Points on a line, which cut it into parts
        of equal mass, are far better together than their parts tell: they count as exact.
        """
        bounds = [n.bound for n in self.evaluator.nodes]
        blocks = [b.blocks * (not b.is_line) for b in bounds if b.stored]
        if len(blocks) < len(bounds) or all((b == 0).all() for b in blocks):
            return np.nan
        # The observed responses against each block.
        observed = observed_set(self.evaluator)
        repeated = [w[np.zeros(N_BLOCKS, dtype=int)] for w in observed.weights]
        sets = DataSets(observed.values, repeated)
        objective = BatchObjective.of(self.evaluator, self.scales, sets, blocks=blocks)
        x, converged = self._minimise(objective)
        if converged.sum() < N_BLOCKS / 2:
            return np.inf
        # Two designs differ by the root of two of one's error.
        error = x[converged].std(axis=0, ddof=1) / np.sqrt(N_BLOCKS)
        return float(np.sqrt(2) * error.max(initial=0.0))

    def _minimise(self, objective: BatchObjective) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the minimisers of data sets from the optimum on, along the axes."""

        def value(x: Floats, rows: Any) -> Floats:
            return objective(self.thetas(x), rows)

        r, n_sets = self.stderr.size, objective.n_sets
        start = np.zeros((n_sets, r))
        if measured_by_refits(self.evaluator):
            x, _, converged = descend_by_simplex(value, start, sizes=_SIMPLICES)
            return x, converged
        curvature = _mean_hessian(lambda x: value(x, slice(_TYPICAL)).mean(axis=0), r)
        tolerance = _TOLERANCE * np.trace(curvature) / r
        inverse = np.linalg.inv(curvature)
        x, _, converged = descend(value, start, inverse, step=_STEP, tolerance=tolerance)
        return x, converged


def _mean_hessian(value: Callable[[Floats], Floats], r: int) -> Floats:
    """Return the Hessian at zero by differences of one unit, made positive definite."""
    differences = second_differences(value, r)
    values, vectors = np.linalg.eigh(differences)
    lowest = _LOWEST * max(np.nanmax(values), 1e-300)
    values = np.maximum(np.nan_to_num(values), lowest)
    return np.asarray((vectors * values) @ vectors.T)
