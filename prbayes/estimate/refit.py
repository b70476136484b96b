"""Minimises the discrepancy for many data sets at once, on stored responses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats
from prbayes._progress import progress
from prbayes.estimate.batch_bfgs import descend
from prbayes.estimate.data_sets import DataSets, observed_set
from prbayes.estimate.sampling import Local, first_order_shifts, local_sampling
from prbayes.estimate.sandwich import Information
from prbayes.metrics.base import Minimum
from prbayes.model.evaluator import Evaluator
from prbayes.propagation.base import N_BLOCKS

_STEP = 0.02  # of differences, in standard errors
_TOLERANCE = 1e-4  # gain, in units of the curvature along a standard error, that is left on the table
_TYPICAL = 50  # data sets from which the curvature is guessed
_BLOCK = 1 << 23  # weights held at a time
_SETTLED = 1.5  # ratio of standard errors from one step of the differences and from its double


@dataclass(frozen=True, eq=False)
class Neighbourhood:
    """An optimum, the directions that data see from there, and the standard errors along them.

    Attributes
    ----------
    evaluator : Evaluator
    theta : ndarray, shape (d,)
    scales : ndarray, shape (k,)
        By which the simulators' discrepancies are divided before they are added.
    parts : list of Information
    local : Local
    frame : ndarray, shape (d, r)
        Principal directions of the sampling distribution, orthonormal in units of the prior's spread.
    sd : ndarray, shape (r,)
        Standard errors along them.
    """

    evaluator: Evaluator
    theta: Floats
    scales: Floats
    parts: list[Information]
    local: Local
    frame: Floats
    sd: Floats

    @classmethod
    def of(
        cls, evaluator: Evaluator, theta: Floats, scales: Floats, scale: Floats, weakest: float = 1.0
    ) -> Neighbourhood:
        """Look around theta; ``scale`` is the prior's spread, ``weakest`` the largest standard error in units of it."""
        parts = [Information(evaluator, k, theta, scale) for k in range(len(evaluator.nodes))]
        local = local_sampling(parts, scales, weakest)
        values, vectors = np.linalg.eigh(local.covariance)
        return cls(
            evaluator, theta, scales, parts, local, local.directions @ vectors, np.sqrt(np.maximum(values, 1e-300))
        )

    def unsettled(self) -> list[int]:
        """Return the simulators whose discrepancy jumps here, if that matters: twice the step gives other errors.

        Second differences over a jump are the smaller the wider the step, those of a smooth function are not.
        """
        jumping = [p.k for p in self.parts if p.jumps]
        if not jumping:
            return []
        wider = local_sampling([replace(p, wide=2 * p.wide) for p in self.parts], self.scales)
        ratio = np.sqrt(np.diag(local_sampling(self.parts, self.scales).in_theta) / np.diag(wider.in_theta))
        return [] if ((ratio > 1 / _SETTLED) & (ratio < _SETTLED)).all() else jumping

    def coordinates(self, thetas: Floats) -> tuple[Floats, Floats]:
        """Return coordinates along the frame in standard errors, (..., r), and what is left in theta, (..., d)."""
        t = (thetas - self.theta) / self.local.scale
        x = t @ self.frame
        return x / self.sd, (t - x @ self.frame.T) * self.local.scale

    def thetas(self, x: Floats, rest: Floats | float = 0.0) -> Floats:
        """Return thetas, (..., d), of coordinates (..., r) and what is left."""
        return np.asarray(self.theta + (x * self.sd) @ self.frame.T * self.local.scale + rest)

    def refit(self, sets: DataSets) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the minimiser of each data set, shape (n_sets, r) in coordinates, and whether it converged.

        With designs the minimisation is exact, and else of first order; no response is computed with designs.
        """
        if not all(n.bound.stored for n in self.evaluator.nodes):
            shifts = first_order_shifts(self.parts, self.scales, self.frame, sets) / self.sd
            return shifts, np.ones(len(shifts), dtype=bool)
        size = len(sets.weights[0])
        points = max(n.bound.n_points + v.size for n, v in zip(self.evaluator.nodes, sets.values, strict=True))
        block = max(1, _BLOCK // (points * (2 * self.sd.size + 1)))
        found = []
        with progress("refits", size) as report:
            for i in range(0, size, block):
                found.append(self._refit(sets, np.arange(i, min(i + block, size))))
                report(len(found[-1][1]), "")
        return np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])

    def design_error(self) -> float:
        """Return how far the optimum of an independent design would be, in standard errors; NaN if not known.

        The design is taken apart into blocks, each a coarser design of the same kind, and the minimum of each
        is found: their spread, as if they were independent, bounds the error of the whole. The largest over the
        frame is returned. Points on a line, which cut it into parts of equal mass, are far better together than
        their parts tell: they count as exact.
        """
        bounds = [n.bound for n in self.evaluator.nodes]
        blocks = [b.blocks * (not b.is_line) for b in bounds if b.stored]
        if len(blocks) < len(bounds) or all((b == 0).all() for b in blocks):
            return np.nan
        x, converged = self._refit(observed_set(self.evaluator), np.zeros(N_BLOCKS, dtype=int), blocks)
        if converged.sum() < N_BLOCKS / 2:
            return np.inf
        spread = x[converged].std(axis=0, ddof=1) / np.sqrt(N_BLOCKS)
        return float(np.sqrt(2) * spread.max(initial=0.0))

    def _refit(
        self, sets: DataSets, which: NDArray[np.intp], blocks: Sequence[NDArray[np.intp]] = ()
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """Return minimisers for some of the data sets; with blocks, each on one block of the designs."""
        nodes = self.evaluator.nodes
        designs = list(self.evaluator.designs.values())
        targets = [
            n.target.with_observed(v, w[which, None]) for n, v, w in zip(nodes, sets.values, sets.weights, strict=True)
        ]
        bases = [t.basis(d.values) for t, d in zip(targets, designs, strict=True)]
        every = np.arange(which.size)

        def value(x: Floats, rows: Any) -> Floats:
            thetas = self.thetas(x)
            total = 0.0
            for k, (target, basis) in enumerate(zip(targets, bases, strict=True)):
                _, weights = self.evaluator.populations(thetas.reshape(-1, thetas.shape[-1]), k)
                weights = weights.reshape(*thetas.shape[:-1], -1)
                if blocks and blocks[k].any():
                    weights = weights * (blocks[k] == every[rows, None, None])
                    with np.errstate(invalid="ignore"):
                        weights = weights / weights.sum(axis=-1, keepdims=True)
                total = (
                    total
                    + target.rows(rows).outer(*target.rows(rows).from_basis(weights, basis, np), xp=np) / self.scales[k]
                )
            return np.asarray(np.nan_to_num(total, nan=np.inf, posinf=np.inf))

        r = self.sd.size
        curvature = _mean_hessian(lambda x: np.asarray(value(x, slice(_TYPICAL)).mean(axis=0)), r)
        start = np.zeros((which.size, r))
        tolerance = _TOLERANCE * np.trace(curvature) / r
        x, _, converged = descend(value, start, np.linalg.inv(curvature), step=_STEP, tolerance=tolerance)
        return x, converged


def _mean_hessian(value: Callable[[Floats], Floats], r: int) -> Floats:
    """Return the Hessian at zero by differences of one unit, made positive definite."""
    unit = np.eye(r)
    corners = [(i, j) for i in range(r) for j in range(i)]
    rows = [np.zeros(r), *unit, *-unit]
    rows += [a * unit[i] + b * unit[j] for i, j in corners for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
    f = value(np.array(rows)[None])
    out = np.diag(f[1 : 1 + r] - 2 * f[0] + f[1 + r : 1 + 2 * r])
    for n, (i, j) in enumerate(corners):
        pp, pm, mp, mm = f[1 + 2 * r + 4 * n :][:4]
        out[i, j] = out[j, i] = (pp - pm - mp + mm) / 4
    values, vectors = np.linalg.eigh(out)
    values = np.maximum(np.nan_to_num(values), 0.05 * max(np.nanmax(values), 1e-300))
    return np.asarray((vectors * values) @ vectors.T)


def inapplicable(evaluator: Evaluator) -> str:
    """Say why draws of a model cannot be adjusted; empty if they can."""
    for node in evaluator.nodes:
        if node.metric.minimum is Minimum.UNKNOWN:
            return f"{node.name} has a {type(node.metric).__name__}, of which nothing is known"
        if node.bound.random:
            return f"{node.name} has prb.Fresh, whose discrepancy is random"
    if evaluator.model.potentials or len(evaluator.model.observed_RVs) > len(evaluator.nodes):
        return "the model has likelihood terms or potentials besides its simulators"
    return ""
