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

from prbayes._checks import Floats
from prbayes.estimate.batch_objective import BatchObjective
from prbayes.estimate.batch_simplex import descend_by_simplex
from prbayes.estimate.curvature import second_differences
from prbayes.estimate.data_sets import simulated_sets
from prbayes.estimate.sampling import Local
from prbayes.model.evaluator import Evaluator

# Data sets: standard errors from their middle 89% then have an error of 6%.
_SETS = 200
# First edges of the simplex, in prior standard deviations: a step that priors mean to be ordinary.
_FIRST = 0.5
# Largest steps, in prior standard deviations, over which it is looked whether the discrepancy
# rises.
_WIDEST = 0.5
# Standard errors along principal axes, as a share of the largest, that are taken apart.
_LEAST = 1e-4
_REMEMBERED = 4  # refits: the optimum's, and for epsilon one for each of a few simulators
_LEVELS = (0.055, 0.5, 0.945)
_WIDTH = 3.2  # of the middle 89% of a normal distribution, in standard deviations


@dataclass(frozen=True, eq=False)
class Refits:
    """Data sets drawn from the model at one theta, and the minimiser of each.

    Attributes
    ----------
    objective : BatchObjective
        Of the data sets.
    theta : ndarray, shape (d,)
    prior_sd : ndarray, shape (d,)
    shifts : ndarray, shape (n_sets, d)
        Minimisers less theta, in units of the prior's spread.
    gain : float
        By how much the minimisers are better than theta, on average.
    """

    objective: BatchObjective
    theta: Floats
    prior_sd: Floats
    shifts: Floats
    gain: float

    @classmethod
    def at(
        cls,
        evaluator: Evaluator,
        theta: Floats,
        scales: Floats,
        *,
        simulators: Sequence[int] | None = None,
        n_sets: int = _SETS,
        seed: int = 0,
    ) -> Refits:
        """Draw data sets at theta and minimise the discrepancy of each; no response is computed.

        What was found last is remembered: an optimum's standard errors, its epsilon and the
        adjustment of draws rest on the same refits.
        """
        chosen = tuple(range(len(evaluator.nodes)) if simulators is None else simulators)
        # Minimisers depend on the ratios of scales only; of one simulator they do not at all.
        ratios = scales / scales[chosen[0]]
        designs = tuple(hash(design.values.tobytes()) for design in evaluator.designs.values())
        return _refits(evaluator, tuple(theta), tuple(ratios), chosen, n_sets, seed, designs)

    @classmethod
    def made(
        cls,
        evaluator: Evaluator,
        theta: Floats,
        scales: Floats,
        simulators: tuple[int, ...],
        n_sets: int,
        seed: int,
    ) -> Refits:
        """Draw and minimise."""
        sets = simulated_sets(evaluator, theta, n_sets, seed)
        objective = BatchObjective.of(evaluator, scales, sets, simulators=simulators)
        prior_sd = evaluator.prior_sd

        def value(shifts: Floats, rows: Any) -> Floats:
            return objective(theta + shifts * prior_sd, rows)

        start = np.zeros((n_sets, theta.size))
        before = value(start[:, None], np.arange(n_sets))[:, 0]
        # The first simplices know no more than the prior, the second ones know the principal axes.
        shifts, _, _ = descend_by_simplex(value, start, sizes=[_FIRST])
        axes, sd = principal_axes(shifts)

        def along(x: Floats, rows: Any) -> Floats:
            return value((x * sd) @ axes.T, rows)

        x, after, _ = descend_by_simplex(along, shifts @ axes / sd, sizes=[1.0])
        gain = float((before - after)[np.isfinite(before)].mean())
        return cls(objective, theta, prior_sd, (x * sd) @ axes.T, gain)

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
        curvatures, vectors = curvatures[::-1], vectors[:, ::-1]
        number = np.arange(1, curvatures.size + 1)
        rises = curvatures * weakest**2 > 2 * self.gain / number
        rank = int(number[rises].max(initial=0))
        axes, sd = principal_axes(self.shifts @ vectors[:, :rank])
        narrow = sd < weakest
        identified = vectors[:, :rank] @ axes[:, narrow]
        wide = vectors[:, :rank] @ axes[:, ~narrow]
        unidentified = np.concatenate([vectors[:, rank:], wide], axis=1)
        return Local(self.prior_sd, identified, unidentified, np.diag(sd[narrow] ** 2))

    def hessian(self) -> Floats:
        """Return second differences of the discrepancy at theta, averaged over data sets, (d, d).

        In units of the prior's spread. Steps are the minimisers' own standard errors, over which
        kinks at different places average out, and wide where the minimisers hardly know where to
        go.
        """
        axes, sd = principal_axes(self.shifts)
        steps = np.minimum(np.where(sd > _WIDEST / 5, _WIDEST, sd), _WIDEST)

        def mean(x: Floats) -> Floats:
            thetas = self.theta + (x * steps) @ axes.T * self.prior_sd
            values = self.objective(thetas, slice(None))
            return np.asarray(values.mean(axis=0))

        differences = second_differences(mean, steps.size)
        along = axes / steps
        return np.asarray(along @ np.nan_to_num(differences) @ along.T)


@lru_cache(maxsize=_REMEMBERED)
def _refits(
    evaluator: Evaluator,
    theta: tuple[float, ...],
    scales: tuple[float, ...],
    simulators: tuple[int, ...],
    n_sets: int,
    seed: int,
    designs: tuple[int, ...],
) -> Refits:
    """Return refits on designs as they are now, of which ``designs`` has fingerprints."""
    return Refits.made(evaluator, np.array(theta), np.array(scales), simulators, n_sets, seed)


def principal_axes(points: Floats) -> tuple[Floats, Floats]:
    """Return principal axes of points, (n, d), as columns (d, d), and standard deviations along them.

    Robust: points count no farther out than three standard deviations, and those are what the
    middle 89% tell, so that a few minimisers that ran away do not decide.
    """
    d = points.shape[1]
    if d == 0:
        return np.empty((0, 0)), np.empty(0)
    low, middle, high = np.quantile(points, _LEVELS, axis=0)
    reach = 3 * (high - low) / _WIDTH
    counted = np.clip(points, middle - reach, middle + reach)
    _, axes = np.linalg.eigh(np.cov(counted, rowvar=False).reshape(d, d))
    low, _, high = np.quantile(points @ axes, _LEVELS, axis=0)
    sd = (high - low) / _WIDTH
    least = _LEAST * sd.max() if sd.max() > 0 else 1.0
    return axes, np.maximum(sd, least)
