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

# Weights that are held at a time.
_NUMBERS = 1 << 20


@dataclass(frozen=True, eq=False)
class BatchObjective:
    """The sum of d_k / scale_k against each of B data sets; no response is computed."""

    evaluator: Evaluator  # all its responses are stored
    scales: Floats  # (K,): by simulator of the model
    simulators: tuple[int, ...]  # which of them count
    targets: list[Discrepancy]  # of those, each against all B data sets
    values: list[Floats]  # (n_k,) or (n_k, m): of those, the stored responses
    bases: list[Basis]  # from weights of stored responses to features
    # (n_k,): of those that count: the block that each point of the design belongs to. Where there
    # are several, the b-th data set is compared with the b-th block alone.
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

        With other responses at the designs' points, ``stored``, by simulator, where they are given.
        """
        every = range(len(evaluator.nodes))
        chosen = tuple(every if simulators is None else simulators)
        # Copied row by row: sums over rows then do not depend on how the weights lie in memory.
        rows = np.arange(len(sets.weights[0]))
        targets = []
        responses = []
        bases = []
        for k in chosen:
            node = evaluator.nodes[k]
            design = evaluator.reweighted[node.name].design
            weights = sets.weights[k][rows, None]
            values = sets.values[k]
            target = node.target.with_observed(values, weights)
            other = stored[k] if stored else None
            own = design.sample.values if other is None else other
            targets.append(target)
            responses.append(own)
            bases.append(target.basis(own))
        return cls(
            evaluator=evaluator,
            scales=scales,
            simulators=chosen,
            targets=targets,
            values=responses,
            bases=bases,
            blocks=blocks,
        )

    @property
    def n_sets(self) -> int:
        """Number of data sets."""
        return len(self.targets[0].weights)

    @one_thread()
    def __call__(self, thetas: Floats, rows: Any) -> Floats:
        """Return the values for data sets ``rows`` at several thetas each, (A, s, d) -> (A, s).

        With thetas of shape (1, s, d) all data sets are compared with the same populations. What is
        not a number, as where a design has no point, is infinite.
        """
        portions = self.portions(len(thetas), thetas.shape[1])
        if len(portions) < 2:
            return self._values(thetas, rows)
        numbers = np.arange(self.n_sets)[rows]
        parts = [self._values(thetas[some], numbers[some]) for some in portions]
        return np.concatenate(parts)

    def portions(self, number: int, each: int = 1) -> list[slice]:
        """Divide data sets, with so many populations each, lest their weights be far from hand."""
        most = max(len(values) for values in self.values)
        at_once = max(1, _NUMBERS // (most * each))
        return [slice(first, first + at_once) for first in range(0, number, at_once)]

    def _values(self, thetas: Floats, rows: Any) -> Floats:
        """Return the values for some data sets."""
        total: Any = 0.0
        for i, k in enumerate(self.simulators):
            weights = self.weights(thetas, rows, i)
            features = self.bases[i].rows(rows).features(weights)
            discrepancies = self.targets[i].rows(rows).outer(*features, xp=np)
            total = total + discrepancies / self.scales[k]
        values = np.nan_to_num(total, nan=np.inf, posinf=np.inf)
        return np.asarray(values)

    def weights(self, thetas: Floats, rows: Any, i: int) -> Floats:
        """Return weights of the stored responses, (A, s, n), on the whole design or on blocks."""
        stacked = thetas.reshape(-1, thetas.shape[-1])
        k = self.simulators[i]
        _, weights = self.evaluator.populations(stacked, k)
        weights = weights.reshape(*thetas.shape[:-1], -1)
        if not self.blocks:
            return weights
        blocks = self.blocks[i]
        if not blocks.any():
            return weights
        # The b-th data set sees the b-th block alone.
        numbers = np.arange(self.n_sets)
        own = numbers[rows, None, None]
        weights = weights * (blocks == own)
        total = weights.sum(axis=-1, keepdims=True)
        with np.errstate(invalid="ignore"):
            return np.asarray(weights / total)
