"""The objective of many data sets at once, on stored responses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats
from prbayes.inference.resampling import DataSets
from prbayes.metrics.base import Basis, Discrepancy
from prbayes.model.evaluator import Evaluator
from prbayes.numerics.threads import one_thread


@dataclass(frozen=True, eq=False)
class BatchObjective:
    """The sum of d_k / scale_k against each of B data sets; no response is computed."""

    evaluator: Evaluator  # all its responses are stored
    scales: Floats  # (K,): by simulator of the model
    simulators: tuple[int, ...]  # indices of the simulators in the sum
    targets: list[Discrepancy]  # by simulator in the sum, each against all B data sets
    values: list[Floats]  # (n_k,) or (n_k, m): the stored responses
    bases: list[Basis]  # from weights of stored responses to features
    # (n_k,): the block of each point of the design. If there are several, the b-th data set is
    # compared with the b-th block alone.
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
        stored: Sequence[Floats | None] = (),
    ) -> BatchObjective:
        """Prepare the observed sides of all data sets; of all simulators by default.

        ``stored``, by simulator, replaces the responses at the designs' points unless it is None.
        """
        if simulators is None:
            simulators = range(len(evaluator.nodes))
        # Copied row by row: sums over rows then do not depend on the layout of the weights.
        rows = np.arange(len(sets.weights[0]))
        targets, values, bases = [], [], []
        for k in simulators:
            node = evaluator.nodes[k]
            target = node.target.with_observed(sets.values[k], sets.weights[k][rows, None])
            replacement = stored[k] if stored else None
            if replacement is None:
                responses = evaluator.reweighted[node.name].design.sample.values
            else:
                responses = replacement
            targets.append(target)
            values.append(responses)
            bases.append(target.basis(responses))
        return cls(evaluator, scales, tuple(simulators), targets, values, bases, blocks)

    @property
    def n_sets(self) -> int:
        """Number of data sets."""
        return len(self.targets[0].weights)

    @one_thread()
    def __call__(self, thetas: Floats, rows: Any) -> Floats:
        """Return the values for data sets ``rows`` at several thetas each, (A, s, d) -> (A, s).

        With thetas of shape (1, s, d) all data sets are compared with the same populations. NaN,
        as where a design has no point, becomes infinite.
        """
        portions = self.portions(len(thetas), thetas.shape[1])
        if len(portions) < 2:
            return self._values(thetas, rows)
        numbers = np.arange(self.n_sets)[rows]
        return np.concatenate([self._values(thetas[p], numbers[p]) for p in portions])

    def portions(self, number: int, populations: int = 1) -> list[slice]:
        """Divide data sets, each with several populations, into portions of a million weights."""
        most = max(len(values) for values in self.values)
        at_once = max(1, (1 << 20) // (most * populations))
        return [slice(first, first + at_once) for first in range(0, number, at_once)]

    def _values(self, thetas: Floats, rows: Any) -> Floats:
        """Return the values for some data sets."""
        total: Any = 0.0
        for i, k in enumerate(self.simulators):
            features = self.bases[i].rows(rows).features(self.weights(thetas, rows, i))
            total = total + self.targets[i].rows(rows).outer(*features, xp=np) / self.scales[k]
        return np.asarray(np.nan_to_num(total, nan=np.inf, posinf=np.inf))

    def weights(self, thetas: Floats, rows: Any, i: int) -> Floats:
        """Return weights of the stored responses, (A, s, n), on the whole design or on blocks."""
        stacked = thetas.reshape(-1, thetas.shape[-1])
        _, weights = self.evaluator.populations(stacked, self.simulators[i])
        weights = weights.reshape(*thetas.shape[:-1], -1)
        if not self.blocks or not self.blocks[i].any():
            return weights
        block_of_set = np.arange(self.n_sets)[rows, None, None]
        weights = weights * (self.blocks[i] == block_of_set)
        total = weights.sum(axis=-1, keepdims=True)
        with np.errstate(invalid="ignore"):
            return np.asarray(weights / total)
