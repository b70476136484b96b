"""The gradient of the objective of many data sets at once, on stored responses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.gradient import NullTypeGradError

from prbayes._checks import Floats
from prbayes._threads import one_thread
from prbayes.estimate.batch_objective import BatchObjective
from prbayes.metrics.base import Cellwise
from prbayes.response.compilation import compiled, untraced

# Hyperparameters from which on it pays for the second or so that its graphs take to compile:
# differences take a value for each (benchmarks/gradients.py: half of the time with four, a quarter
# with nine).
WORTH_A_GRADIENT = 4
# Step of differences, in spreads of the prior, where a gradient is no number: central ones are off
# by about its square, and rounding by 1e-16 over it.
_UNTOLD_STEP = 1e-4


@dataclass(frozen=True, eq=False)
class BatchGradient:
    """An objective with its gradient, about as dear as three of its values.

    Differences take a value for each hyperparameter.
    """

    objective: BatchObjective
    sums: list[Cellwise]
    slopes: list[Any]  # of what each cell adds, compiled, by simulator that counts

    @classmethod
    def of(cls, objective: BatchObjective) -> BatchGradient | None:
        """Prepare it; None where a discrepancy is no sum over cells, or has no gradient."""
        sums = [over for over in objective.sums if over is not None]
        if any(map(np.any, objective.blocks)) or len(sums) < len(objective.sums):
            return None
        try:
            found = cls(objective, sums, [_compiled(over) for over in sums])
            found(objective.evaluator.initial[None], slice(0, 1))
        except (NotImplementedError, NullTypeGradError):
            return None  # a distribution has none
        return found

    @one_thread()
    def __call__(self, thetas: Floats, rows: Any) -> tuple[Floats, Floats]:
        """Return values and gradients of data sets at one theta each, (A, d) -> (A,), (A, d)."""
        objective = self.objective
        values = np.empty(len(thetas))
        gradients = np.empty(thetas.shape)
        numbers = np.arange(objective.n_sets)[rows]
        for some in objective.portions(len(thetas)):
            values[some], gradients[some] = self._of_some(thetas[some], numbers[some])
        # Some distributions' gradients are no numbers, as of a normal cut off on one side.
        untold = np.isfinite(values) & ~np.isfinite(gradients).all(axis=1)
        if untold.any():
            gradients[untold] = self._by_differences(thetas[untold], numbers[untold])
        return values, gradients

    def _by_differences(self, thetas: Floats, rows: Any) -> Floats:
        step = _UNTOLD_STEP * self.objective.evaluator.prior_sd
        up, down = (
            self.objective(thetas[:, None] + sign * np.diag(step), rows) for sign in (1, -1)
        )
        with np.errstate(invalid="ignore"):
            return np.asarray((up - down) / (2 * step))

    def _of_some(self, thetas: Floats, rows: Any) -> tuple[Floats, Floats]:
        objective = self.objective
        total: Any = 0.0
        gradient: Any = 0.0
        for i, k in enumerate(objective.simulators):
            node = objective.evaluator.nodes[k]
            design = objective.evaluator.designs[node.name]
            target, basis = objective.targets[i], objective.bases[i]
            weights = objective.weights(thetas[:, None], rows, i)
            (density,) = target.from_basis(weights, basis, np)
            over = self.sums[i].rows(rows)
            total = total + over.outer(density, xp=np) / objective.scales[k]
            # Backwards: from cells to weights of points, to roots, to hyperparameters.
            (slopes,) = self.slopes[i](density, *over.constants)
            by_density = slopes * over.shares / objective.scales[k]
            by_weights = target.pulled_back(basis[0], by_density[:, 0])
            roots = objective.evaluator.roots(thetas, k)
            by_roots = design.pulled_back(roots, weights[:, 0], by_weights)
            gradient = gradient + objective.evaluator.pulled_back(thetas, k, by_roots)
        values = np.nan_to_num(total[:, 0], nan=np.inf, posinf=np.inf)
        return np.asarray(values), np.asarray(gradient)


def _compiled(over: Cellwise) -> Any:
    """Return the derivative of what cells add, compiled, for densities and constants."""
    with untraced():
        density = pt.tensor(dtype="float64", shape=(None, None, None))
        constants = tuple(_symbol(constant) for constant in over.constants)
        added = over.of.terms(density, constants, pt)
        return compiled([density, *constants], [pt.grad(added.sum(), density)])


def _symbol(constant: Any) -> Any:
    """Return a symbol for a constant: one of any data sets, by cell, or a number."""
    shape = [None if n > 1 or axis == 0 else 1 for axis, n in enumerate(np.shape(constant))]
    return pt.tensor(dtype="float64", shape=shape)
