"""The objective of many data sets at once, on stored responses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats
from prbayes.estimate.data_sets import DataSets
from prbayes.metrics.base import Discrepancy
from prbayes.model.evaluator import Evaluator


@dataclass(frozen=True, eq=False)
class BatchObjective:
    """The sum of d_k / scale_k against each of B data sets; no response is computed.

    Attributes
    ----------
    evaluator : Evaluator
        All its responses are stored.
    scales : ndarray, shape (K,)
        By simulator of the model.
    simulators : tuple of int
        Which of them count.
    targets : list of Discrepancy
        Of those, each against all B data sets.
    bases : list
        What turns weights of stored responses into features.
    blocks : sequence of ndarray, shapes (n_k,)
        Of those that count: the block that each point of the design belongs to. Where there are
        several, the b-th data set is compared with the b-th block alone.
    """

    evaluator: Evaluator
    scales: Floats
    simulators: tuple[int, ...]
    targets: list[Discrepancy]
    bases: list[tuple[NDArray[Any], ...]]
    blocks: Sequence[NDArray[np.intp]] = ()

    @classmethod
    def of(
        cls,
        evaluator: Evaluator,
        scales: Floats,
        sets: DataSets,
        *,
        simulators: Sequence[int] | None = None,
        blocks: Sequence[NDArray[np.intp]] = (),
    ) -> BatchObjective:
        """Prepare the observed sides of all data sets; of all simulators by default."""
        # Copied row by row: sums over rows then do not depend on how the weights lie in memory.
        every = np.arange(len(sets.weights[0]))
        chosen = tuple(range(len(evaluator.nodes)) if simulators is None else simulators)
        targets, bases = [], []
        for k in chosen:
            node = evaluator.nodes[k]
            design = evaluator.designs[node.name]
            target = node.target.with_observed(sets.values[k], sets.weights[k][every, None])
            targets.append(target)
            bases.append(target.basis(design.values))
        return cls(evaluator, scales, chosen, targets, bases, blocks)

    @property
    def n_sets(self) -> int:
        """Number of data sets."""
        return len(self.targets[0].weights)

    def __call__(self, thetas: Floats, rows: Any) -> Floats:
        """Return the values for data sets ``rows`` at several thetas each, (A, s, d) -> (A, s).

        With thetas of shape (1, s, d) all data sets are compared with the same populations. What is
        not a number, as where a design has no point, is infinite.
        """
        total: Any = 0.0
        for i, k in enumerate(self.simulators):
            target = self.targets[i].rows(rows)
            features = target.from_basis(self._weights(thetas, rows, i), self.bases[i], np)
            total = total + target.outer(*features, xp=np) / self.scales[k]
        return np.asarray(np.nan_to_num(total, nan=np.inf, posinf=np.inf))

    def _weights(self, thetas: Floats, rows: Any, i: int) -> Floats:
        """Return weights of the stored responses, (A, s, n), on the whole design or on blocks."""
        flat = thetas.reshape(-1, thetas.shape[-1])
        _, weights = self.evaluator.populations(flat, self.simulators[i])
        weights = weights.reshape(*thetas.shape[:-1], -1)
        if not self.blocks or not self.blocks[i].any():
            return weights
        own = np.arange(self.n_sets)[rows, None, None]
        weights = weights * (self.blocks[i] == own)
        with np.errstate(invalid="ignore"):
            return np.asarray(weights / weights.sum(axis=-1, keepdims=True))
