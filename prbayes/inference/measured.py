"""The sampling distribution of a minimiser where its metric declares nothing: measured by refits.

Data sets are drawn from the model at the optimum, and the discrepancy of each is minimised by
itself. How far the minimisers scatter is their sampling distribution, whatever the metric.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from prbayes._validate import Floats
from prbayes.inference.asymptotics import Local
from prbayes.inference.batched_objective import BatchObjective
from prbayes.inference.identifiability import oriented
from prbayes.inference.resampling import SETS, simulated_sets
from prbayes.model.evaluator import Evaluator
from prbayes.numerics.batched_simplex import descend_by_simplex
from prbayes.numerics.derivatives import second_differences

# Largest steps, in prior standard deviations, over which it is looked whether the discrepancy
# rises.
_WIDEST = 0.5
# Standard errors along principal axes, as a share of the largest, that are taken apart.
_LEAST = 1e-4
# The middle 89%, ArviZ's interval, with the median; and the width of a normal distribution's in
# standard deviations.
_LEVELS = (0.055, 0.5, 0.945)
_WIDTH = 3.2


@dataclass(frozen=True, eq=False)
class _Along:
    """An objective in coordinates x along axes, in steps, around theta."""

    objective: BatchObjective
    theta: Floats  # (d,)
    prior_sd: Floats  # (d,)
    axes: Floats  # (d, d): as columns, in units of the prior's spread
    steps: Floats  # (d,): length of one unit of x along each

    def shifts(self, x: Floats) -> Floats:
        """Return coordinates (..., d) in units of the prior's spread."""
        stepped = x * self.steps
        return np.asarray(stepped @ self.axes.T)

    def __call__(self, x: Floats, rows: Any) -> Floats:
        """Return the values of data sets ``rows``, shapes (A, s, d), (A,) -> (A, s)."""
        shifts = self.shifts(x)
        thetas = self.theta + shifts * self.prior_sd
        return self.objective(thetas, rows)

    def mean(self, x: Floats) -> Floats:
        """Return the mean over all data sets at the same points, (1, s, d) -> (s,)."""
        values = self(x, slice(None))
        return np.asarray(values.mean(axis=0))


@dataclass(frozen=True, eq=False)
class Refits:
    """Data sets drawn from the model at one theta, and the minimiser of each."""

    objective: BatchObjective  # of the data sets
    theta: Floats  # (d,)
    prior_sd: Floats  # (d,)
    shifts: Floats  # (n_sets, d): minimisers less theta, in units of the prior's spread
    gain: float  # by how much the minimisers are better than theta, on average

    @classmethod
    def at(
        cls,
        evaluator: Evaluator,
        theta: Floats,
        scales: Floats,
        *,
        simulators: Sequence[int] | None = None,
    ) -> Refits:
        """Draw data sets at theta and minimise the discrepancy of each; no response is computed.

        What was found last is remembered: an optimum's standard errors, its epsilon and the
        adjustment of draws rest on the same refits.
        """
        every = range(len(evaluator.nodes))
        chosen = tuple(every if simulators is None else simulators)
        # Minimisers depend on the ratios of scales only; of one simulator they do not at all.
        ratios = scales / scales[chosen[0]]
        fingerprints = []
        for bound in evaluator.reweighted.values():
            content = bound.design.sample.values.tobytes()
            fingerprints.append(hash(content))
        return _refits(
            evaluator,
            tuple(theta),
            tuple(ratios),
            chosen,
            tuple(fingerprints),
        )

    @classmethod
    def made(
        cls,
        evaluator: Evaluator,
        theta: Floats,
        scales: Floats,
        simulators: tuple[int, ...],
    ) -> Refits:
        """Draw and minimise."""
        sets = simulated_sets(evaluator, theta, SETS, seed=0)
        objective = BatchObjective.of(evaluator, scales, sets, simulators=simulators)
        prior_sd = evaluator.hyperparameters.prior_sd
        d = theta.size
        start = np.zeros((SETS, d))
        # The first simplices know no more than the prior.
        value = _Along(
            objective,
            theta,
            prior_sd,
            axes=np.eye(d),
            steps=np.ones(d),
        )
        rows = np.arange(SETS)
        first = value(start[:, None], rows)
        before = first[:, 0]
        # In spreads of the prior: a step that priors mean to be ordinary.
        shifts, _, _ = descend_by_simplex(value, start, sizes=[0.5])
        # The second ones know the principal axes.
        axes, sd = principal_axes(shifts)
        along = _Along(
            objective=objective,
            theta=theta,
            prior_sd=prior_sd,
            axes=axes,
            steps=sd,
        )
        begin = shifts @ axes / sd
        x, after, _ = descend_by_simplex(along, begin, sizes=[1.0])
        known = np.isfinite(before)
        gain = before[known] - after[known]
        return cls(
            objective,
            theta,
            prior_sd,
            along.shifts(x),
            float(gain.mean()),
        )

    def local(self, weakest: float = 1.0) -> Local:
        """Return the minimisers' covariance, along the directions that the data identify.

        A direction is identified if the minimisers scatter along it by less than ``weakest`` prior
        standard deviations, and if the discrepancy rises along it: its second derivative, averaged
        over data sets, is more than twice the mean gain of one identified direction over
        ``weakest**2``. For a quadratic discrepancy the two say the same; where it does not change
        at all, a minimiser stays close to where it started, and only the second one tells.
        """
        curvatures, vectors = np.linalg.eigh(self.hessian())
        # The largest curvature first.
        curvatures = curvatures[::-1]
        vectors = vectors[:, ::-1]
        number = np.arange(1, curvatures.size + 1)
        least = 2 * self.gain / number
        rises = curvatures * weakest**2 > least
        rank = int(number[rises].max(initial=0))
        rising = vectors[:, :rank]
        level = vectors[:, rank:]
        # Among those that rise, the ones along which the minimisers scatter little enough.
        axes, sd = principal_axes(self.shifts @ rising)
        narrow = sd < weakest
        identified = rising @ axes[:, narrow]
        wide = rising @ axes[:, ~narrow]
        unidentified = np.concatenate([level, wide], axis=1)
        covariance = np.diag(sd[narrow] ** 2)
        return Local(self.prior_sd, identified, unidentified, covariance)

    def hessian(self) -> Floats:
        """Return second differences of the discrepancy at theta, averaged over data sets, (d, d).

        In units of the prior's spread. Steps are the minimisers' own standard errors, over which
        kinks at different places average out, and wide where the minimisers hardly know where to
        go.
        """
        axes, sd = principal_axes(self.shifts)
        wide = sd > _WIDEST / 5
        steps = np.where(wide, _WIDEST, sd)
        steps = np.minimum(steps, _WIDEST)
        along = _Along(
            objective=self.objective,
            theta=self.theta,
            prior_sd=self.prior_sd,
            axes=axes,
            steps=steps,
        )
        differences = second_differences(along.mean, steps.size)
        known = np.nan_to_num(differences)
        # From differences along the axes to derivatives in units of the prior's spread.
        back = axes / steps
        return np.asarray(back @ known @ back.T)


@lru_cache(maxsize=4)  # the optimum's, and for epsilon one for each of a few simulators
def _refits(
    evaluator: Evaluator,
    theta: tuple[float, ...],
    scales: tuple[float, ...],
    simulators: tuple[int, ...],
    designs: tuple[int, ...],
) -> Refits:
    """Return refits on designs as they are now, of which ``designs`` has fingerprints."""
    at = np.array(theta)
    weights = np.array(scales)
    return Refits.made(evaluator, at, weights, simulators)


def principal_axes(points: Floats) -> tuple[Floats, Floats]:
    """Return principal axes of points, (n, d), as columns (d, d), and their spreads along them.

    Robust: points count no farther out than three standard deviations, and those are what the
    middle 89% tell, so that a few minimisers that ran away do not decide.
    """
    d = points.shape[1]
    if d == 0:
        return np.empty((0, 0)), np.empty(0)
    # Runaways are drawn in before they count in the covariance.
    counted = drawn_in(points, 3.0)
    covariance = np.cov(counted, rowvar=False).reshape(d, d)
    _, vectors = np.linalg.eigh(covariance)
    axes = oriented(vectors)
    # Spreads along the axes, none so small that a division by it fails.
    turned = points @ axes
    low, _, high = np.quantile(turned, _LEVELS, axis=0)
    sd = (high - low) / _WIDTH
    largest = sd.max()
    least = _LEAST * largest if largest > 0 else 1.0
    return axes, np.maximum(sd, least)


def drawn_in(points: Floats, most: float) -> Floats:
    """Return points, (n, d), at most so many standard deviations from the median.

    The middle 89% tell the standard deviation. A few in a thousand far out, as where a bounded
    parameter comes near its bound, would otherwise decide about all others.
    """
    low, middle, high = np.quantile(points, _LEVELS, axis=0)
    far = most * (high - low) / _WIDTH
    return np.clip(points, middle - far, middle + far)
