"""The sampling distribution of a minimiser, and refits: the minimisers of many data sets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._progress import progress
from prbayes._validate import AT_ONCE, Floats
from prbayes.inference.asymptotics import Local, first_order_shifts, local_sampling
from prbayes.inference.batched_objective import BatchObjective
from prbayes.inference.identifiability import oriented
from prbayes.inference.measured import Refits
from prbayes.inference.requirements import measured_by_refits
from prbayes.inference.resampling import SETS, DataSets, observed_set, one_set
from prbayes.inference.sandwich import Information
from prbayes.model.evaluator import Evaluator
from prbayes.numerics.batched_bfgs import Descent
from prbayes.numerics.batched_simplex import descend_by_simplex
from prbayes.numerics.derivatives import second_differences
from prbayes.propagation.base import N_BLOCKS
from prbayes.propagation.reweighted import designs_restored

# Step of differences, in standard errors.
_REFIT_STEP = 0.02
# Gain, in units of the curvature along a standard error, that is left on the table: the minimiser
# is then known to about a hundredth of a standard error.
_TOLERANCE = 1e-4
# The same where only the error of a design is asked for, of which a tenth matters: three hundredths
# of a standard error, of each of eight minimisers; or how thousands of minimisers scatter.
_ROUGHLY = 1e-3
# Share of refits that has to converge before anything is told from them. Those that do not are not
# a random part of all: without the outermost tenth at one end a normal sampling distribution is too
# narrow by 16%, without a fifth by 24%, and without half by 40%.
ARRIVED = 0.9
# Standard error, in spreads of the prior, up to which a direction of theta counts where functions
# of theta are looked at, each of which is then held against its own prior. Of a correlation and its
# standard deviations any value in [3, 30] gives the same (tests/test_correlated_inputs.py).
_FAINT = 10.0
# Ratio of standard errors from one step of the differences and from its double.
_STEADY = 1.5


@dataclass(frozen=True)
class DesignErrors:
    """How far the optima of two independent designs are apart, in standard errors."""

    points: float  # by their points; NaN if not known
    emulators: float  # by what emulators say of them; NaN without emulators

    @property
    def whole(self) -> float:
        """Both together; NaN if nothing is known."""
        known = [e for e in (self.points, self.emulators) if not np.isnan(e)]
        return float(np.linalg.norm(known)) if known else np.nan


@dataclass(frozen=True, eq=False)
class SamplingDistribution:
    """How the minimiser scatters around an optimum, over data sets that could be observed."""

    evaluator: Evaluator
    theta: Floats  # (d,)
    scales: Floats  # (k,): by which the simulators' discrepancies are divided before they are added
    information: list[Information]  # by simulator
    local: Local
    # (d, r): principal axes of the sampling distribution along the directions that the data
    # identify, orthonormal in units of the prior's spread.
    axes: Floats
    stderr: Floats  # (r,): standard errors along them

    @classmethod
    def of(
        cls, evaluator: Evaluator, theta: Floats, scales: Floats, weakest: float = 1.0
    ) -> SamplingDistribution:
        """Return the distribution at theta.

        From the metrics' derivatives, to first order; from refits where a metric declares nothing.
        Directions with a standard error above ``weakest`` prior standard deviations are not
        identified.
        """
        number = len(evaluator.nodes)
        information = [Information(evaluator, k, theta, n_sets=SETS) for k in range(number)]
        if measured_by_refits(evaluator):
            local = Refits.at(evaluator, theta, scales).local(weakest)
        else:
            local = local_sampling(information, scales, weakest)
        variances, vectors = np.linalg.eigh(local.covariance)
        axes = oriented(local.identified @ vectors)
        # Rounding may leave a variance of zero or less.
        positive = np.maximum(variances, 1e-300)
        return cls(
            evaluator,
            theta,
            scales,
            information,
            local,
            axes,
            stderr=np.sqrt(positive),
        )

    @property
    def of_functions(self) -> Local:
        """The same to first order with directions that are known faintly.

        The data may tell much of a function of theta, such as a standard deviation, and little of
        the elements that it is made of, such as those of a Cholesky factor.
        """
        if not self.local.unidentified.size or measured_by_refits(self.evaluator):
            return self.local
        return local_sampling(self.information, self.scales, _FAINT)

    def unsettled(self) -> list[int]:
        """Return the simulators whose discrepancy jumps here, if that matters.

        It does if twice the step of the differences gives other errors: second differences over a
        jump are the smaller the wider the step, those of a smooth function are not.
        """
        jumping = [one.k for one in self.information if one.jumps]
        if not jumping:
            return []
        wider = [replace(one, widened=2.0) for one in self.information]
        local = local_sampling(self.information, self.scales)
        other = local_sampling(wider, self.scales)
        variances = np.diag(local.in_theta)
        others = np.diag(other.in_theta)
        ratio = np.sqrt(variances / others)
        settled = (ratio > 1 / _STEADY) & (ratio < _STEADY)
        return [] if settled.all() else jumping

    def coordinates(self, thetas: Floats) -> Floats:
        """Return coordinates of thetas along the axes, in standard errors, (..., d) -> (..., r)."""
        shifts = (thetas - self.theta) / self.local.prior_sd
        return np.asarray(shifts @ self.axes / self.stderr)

    def thetas(self, x: Floats) -> Floats:
        """Return thetas, (..., d), of coordinates (..., r)."""
        shifts = (x * self.stderr) @ self.axes.T
        return np.asarray(self.theta + shifts * self.local.prior_sd)

    def refit(
        self, sets: DataSets, start: Floats | None = None, *, roughly: bool = False
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the minimiser of each data set, (n_sets, r) in coordinates, and which converged.

        With designs the minimisation is exact, from ``start`` on, (n_sets, r), which is the optimum
        by default; and else of first order. No response is computed with designs. ``roughly`` is
        to a few hundredths of a standard error, in half of the time.
        """
        if not self._stored:
            shifts = first_order_shifts(self.information, self.scales, self.axes, sets)
            converged = np.ones(len(shifts), dtype=bool)
            return shifts / self.stderr, converged
        n_sets = len(sets.weights[0])
        at_once = self._at_once(sets)
        begin = np.zeros((n_sets, self.stderr.size)) if start is None else start
        descent = None
        minimisers = []
        arrived = []
        with progress("refits", n_sets) as report:
            for i in range(0, n_sets, at_once):
                weights = [w[i : i + at_once] for w in sets.weights]
                some = DataSets(sets.values, weights)
                objective = BatchObjective.of(self.evaluator, self.scales, some)
                if descent is None:  # that of some serves all of them
                    descent = self._descent(objective, roughly=roughly)
                x, converged = self._minimise(objective, descent, begin[i : i + at_once])
                minimisers.append(x)
                arrived.append(converged)
                report(len(converged), "")
        return np.concatenate(minimisers), np.concatenate(arrived)

    @property
    def prepares(self) -> bool:
        """Whether the metric takes its coordinates from the data, as with several outputs.

        False unless responses are stored and the metric declares its minimum.
        """
        several = any(node.target.event for node in self.evaluator.nodes)
        return several and self._stored and not measured_by_refits(self.evaluator)

    def refit_prepared(
        self, sets: DataSets, minimisers: Floats
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the minimiser of the metric prepared for each data set, and which converged.

        Parameters
        ----------
        sets : DataSets
        minimisers : ndarray, shape (n_sets, r)
            Those of the metric prepared for the observed data (`refit`). They remain where the
            metric cannot be prepared, as for specimens that are all alike.
        """
        result = minimisers.copy()
        is_converged = np.zeros(len(minimisers), dtype=bool)
        shared = BatchObjective.of(self.evaluator, self.scales, observed_set(self.evaluator))
        descent = self._descent(shared, roughly=True)
        with progress("refits", len(minimisers)) as report:
            for i, minimiser in enumerate(minimisers):
                report(1, "")
                objective = self._objective_anew(sets, i)
                if objective is None:
                    continue
                starts = np.stack([np.zeros_like(minimiser), minimiser])
                (values,) = objective(self.thetas(starts)[None], slice(1))
                x, converged = self._minimise(objective, descent, starts[[values.argmin()]])
                if converged[0]:
                    result[i], is_converged[i] = x[0], True
        return result, is_converged

    def _objective_anew(self, sets: DataSets, i: int) -> BatchObjective | None:
        """Return the objective of the metric prepared for a data set; None where it cannot be."""
        data, weights = one_set(self.evaluator, sets, i)
        try:
            other = self.evaluator.observing(data, weights=weights)
        except ValueError:  # as where all its specimens are alike
            return None
        return BatchObjective.of(other, self.scales, observed_set(other))

    def _at_once(self, sets: DataSets) -> int:
        """Return how many data sets fit into memory."""
        points = 0
        for node, values in zip(self.evaluator.nodes, sets.values, strict=True):
            here = len(node.target.parts) * max(node.bound.n_points, len(values))
            points = max(points, here)
        return max(1, 2 * AT_ONCE // points)

    def design_error(self) -> DesignErrors:
        """Return how far the optimum of another design would be, by its points and emulators.

        In standard errors, along the worst axis.
        """
        if not self._stored:
            return DesignErrors(np.nan, np.nan)
        # Two designs differ by the root of two of one's error.
        points = np.sqrt(2) * self._error_of_points().max(initial=0.0)
        emulators = np.sqrt(2) * self._error_of_emulators().max(initial=0.0)
        return DesignErrors(float(points), float(emulators))

    def _error_of_emulators(self) -> Floats:
        """Return how far the optimum is off by the emulators' error, (r,); NaN without emulators.

        The minimum of each emulator that lacks a block of the runs is found, and how far it is from
        that of the whole: where a descent ends differs from the optimum for other reasons, too.
        """
        each = [
            node.reweighted.design.without_each_block() if node.reweighted else []
            for node in self.evaluator.nodes
        ]
        number = max(map(len, each))
        if not number:
            return np.full(self.stderr.size, np.nan)
        observed = observed_set(self.evaluator)
        whole = BatchObjective.of(self.evaluator, self.scales, observed)
        descent = self._descent(whole, roughly=True)
        end = self._only(whole, descent)
        end = np.where(np.isfinite(end), end, 0.0)
        found = []
        for b in range(number):
            stored = [values[b] if values else None for values in each]
            objective = BatchObjective.of(self.evaluator, self.scales, observed, stored=stored)
            found.append(self._only(objective, descent) - end)
        return np.asarray(np.sqrt(np.square(found).sum(axis=0)))

    def _error_of_points(self) -> Floats:
        """Return how far the optimum is off by the design's points, (r,); NaN if not known.

        The design is taken apart into blocks, each a coarser design of the same kind, and the
        minimum of each is found: their spread, as if they were independent, bounds the error of the
        whole. Points of clouds, which are many, fill space better together. Points on a line, which
        cut it into parts of equal mass, are far better than their parts tell: they count as exact.
        """
        blocks = self._blocks()
        if not any(block.any() for block in blocks):
            return np.full(self.stderr.size, np.nan)
        observed = observed_set(self.evaluator)
        if self._of_clouds:
            spread = self._spread_of_parts(observed)
            return np.asarray(spread / N_BLOCKS**self._rate_of_clouds)
        # The observed responses against each block.
        every = np.zeros(N_BLOCKS, dtype=int)
        repeated = [w[every] for w in observed.weights]
        sets = DataSets(observed.values, repeated)
        objective = BatchObjective.of(self.evaluator, self.scales, sets, blocks=blocks)
        x, converged = self._minimise(objective, self._descent(objective))
        if converged.sum() < N_BLOCKS / 2:
            return np.full(self.stderr.size, np.inf)
        spread = x[converged].std(axis=0, ddof=1)
        return np.asarray(spread / N_BLOCKS**0.5)

    def _spread_of_parts(self, observed: DataSets) -> Floats:
        """Return by how much the minima of an eighth of the points each scatter, (r,)."""
        designs = [(bound, bound.design) for bound in self.evaluator.reweighted.values()]
        found = []
        descent = None
        for b in range(N_BLOCKS):
            with designs_restored(bound for bound, _ in designs):
                for bound, design in designs:
                    bound.design = design.rows(design.sample.blocks == b)
                objective = BatchObjective.of(self.evaluator, self.scales, observed)
                descent = descent or self._descent(objective, roughly=True)
                found.append(self._only(objective, descent))
        arrived = np.array([x for x in found if np.isfinite(x).all()])
        if len(arrived) < N_BLOCKS / 2:
            return np.full(self.stderr.size, np.inf)
        return np.asarray(arrived.std(axis=0, ddof=1))

    @property
    def _rate_of_clouds(self) -> float:
        """The power of its size with which the error of a cloud falls.

        That of points that fill d dimensions evenly, for functions with a jump along a surface,
        1/2 + 1/(2d); smooth ones have up to 1/2 + 1/d, so that this claims rather too much
        (benchmarks/clouds.py).

        References
        ----------
        .. [1] He, Z. and A. B. Owen (2016), Extensible grids: uniform sampling on a space filling
           curve, J. R. Stat. Soc. B 78, 917-931, doi:10.1111/rssb.12132.
        """
        dimensions = max(node.bound.inputs.dimensions for node in self.evaluator.nodes)
        return 0.5 + 0.5 / dimensions

    @property
    def _of_clouds(self) -> bool:
        """Whether all responses are those of clouds."""
        bounds = [node.reweighted for node in self.evaluator.nodes]
        return all(bound is not None and bound.design.is_emulated for bound in bounds)

    @property
    def _stored(self) -> bool:
        """Whether no simulator's responses are computed anew."""
        return all(node.bound.stored for node in self.evaluator.nodes)

    def _blocks(self) -> list[NDArray[np.intp]]:
        """Return by simulator the block of each point of its design; none if not all have one."""
        if not self._stored:
            return []
        blocks = []
        for node in self.evaluator.nodes:
            own = node.bound.blocks
            # Points on a line are one block.
            blocks.append(np.zeros_like(own) if node.bound.is_line else own)
        return blocks

    def _descent(self, objective: BatchObjective, *, roughly: bool = False) -> Descent:
        """Return how data sets are fitted whose objectives have about the same curvature."""

        def typical(x: Floats) -> Floats:
            # The minimiser does not depend on this guess: some data sets will do.
            values = objective(self.thetas(x), slice(50))
            return np.asarray(values.mean(axis=0))

        r = self.stderr.size
        if r == 0 or measured_by_refits(self.evaluator):  # then nothing follows it
            return Descent(np.eye(r), 0.0, _REFIT_STEP)
        root = self._root
        across = np.linalg.inv(root)
        curvature = across.T @ _mean_hessian(lambda z: typical(z @ root.T), r) @ across
        inverse = np.linalg.inv(curvature)
        # What an error of one standard error costs, in whichever direction: where estimates hang
        # together the mean curvature is that of the direction across, in which next to none is.
        cost = r / np.trace(inverse)
        gain = (_ROUGHLY if roughly else _TOLERANCE) * cost
        return Descent(curvature, gain, _REFIT_STEP)

    @property
    def _root(self) -> Floats:
        """Steps of one standard error that lead across each other, in coordinates, (r, r).

        Along axes whose estimates hang together the curvature across them would hide that along.
        """
        local = self.local
        along = self.axes.T @ local.identified / self.stderr[:, None]
        try:
            return np.asarray(np.linalg.cholesky(along @ local.covariance @ along.T))
        except np.linalg.LinAlgError:  # a variance that rounding made nothing
            return np.eye(self.stderr.size)

    def _only(self, objective: BatchObjective, descent: Descent) -> Floats:
        """Return the minimiser of one data set along the axes, (r,): inf where none was found."""
        x, converged = self._minimise(objective, descent)
        return x[0] if converged[0] else np.full(self.stderr.size, np.inf)

    def _minimise(
        self, objective: BatchObjective, descent: Descent, start: Floats | None = None
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the minimisers of data sets, by default from the optimum on, along the axes."""

        def value(x: Floats, rows: Any) -> Floats:
            return objective(self.thetas(x), rows)

        r = self.stderr.size
        if start is None:
            start = np.zeros((objective.n_sets, r))
        if r == 0:  # the data tell nothing: there is no direction to go
            return start, np.ones(len(start), dtype=bool)
        if measured_by_refits(self.evaluator):
            # In standard errors; the second one starts where the first has ended.
            x, _, converged = descend_by_simplex(value, start, sizes=(1.0, -0.5))
            return x, converged
        minima = descent(value, start)
        return minima.x, minima.converged


def _mean_hessian(value: Callable[[Floats], Floats], r: int) -> Floats:
    """Return the Hessian at zero by differences of one unit, made positive definite."""
    differences = second_differences(value, r)
    curvatures, vectors = np.linalg.eigh(differences)
    largest = max(np.nanmax(curvatures), 1e-300)
    # As a first guess, no direction is flatter than a twentieth of the steepest.
    lowest = 0.05 * largest
    known = np.nan_to_num(curvatures)
    positive = np.maximum(known, lowest)
    return np.asarray((vectors * positive) @ vectors.T)
