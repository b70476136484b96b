"""Error of an optimum by the finite design: by its points, and by its emulators."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from prbayes._validate import Floats, complete_rows
from prbayes.inference.refits import (
    BatchObjective,
    SamplingDistribution,
    descent_of,
    is_stored,
    minimise_sets,
)
from prbayes.inference.resampling import observed_set
from prbayes.model.evaluator import have_emulated_points
from prbayes.model.random_variable import Node
from prbayes.numerics.batched_minimisers import Descent
from prbayes.propagation.base import N_BLOCKS


@dataclass(frozen=True)
class DesignErrors:
    """Distance between the optima of two independent designs, in standard errors."""

    points: float  # distance because of the points; NaN if not known
    emulators: float  # distance because of the emulators' error; NaN without emulators

    @property
    def whole(self) -> float:
        """Both distances together; NaN if neither is known."""
        errors = [e for e in (self.points, self.emulators) if not np.isnan(e)]
        return float(np.linalg.norm(errors)) if errors else np.nan


def design_error(sampling: SamplingDistribution) -> DesignErrors:
    """Return the distance to the optimum of another design along the worst axis."""
    points = emulators = np.nan
    if is_stored(sampling.evaluator):
        nodes, designs = sampling.evaluator.nodes, sampling.evaluator.reweighted
        on_line = {name for name, bound in designs.items() if bound.design.on_line}
        # The difference of two designs has the error of one times the root of two. Points on a line
        # cut it into parts of equal mass, and count as exact.
        if [node for node in nodes if node.bound.blocks.any() and node.name not in on_line]:
            points = float(np.sqrt(2) * _error_of_points(sampling).max(initial=0.0))
        emulators = float(np.sqrt(2) * _error_of_emulators(sampling).max(initial=0.0))
    return DesignErrors(points, emulators)


def _error_of_emulators(sampling: SamplingDistribution) -> Floats:
    """Return the error of the optimum by emulators, (r,); NaN if no design has an emulator.

    It is the spread of minima by emulators that lack a block of the runs, around the minimum by all
    runs. The same descent finds that minimum, because it may differ from the optimum for other
    reasons.
    """
    evaluator, scales = sampling.evaluator, sampling.scales
    left_out = [
        node.reweighted.design.without_each_block() if node.reweighted else []
        for node in evaluator.nodes
    ]
    if not any(left_out):
        return np.full(sampling.stderr.size, np.nan)
    observed = observed_set(evaluator)
    whole = BatchObjective.of(evaluator, scales, observed)
    descent = descent_of(sampling, whole, is_rough=True)
    minimum = _minimum(sampling, whole, descent)
    minimum = np.where(np.isfinite(minimum), minimum, 0.0)
    shifts = []
    for b in range(max(map(len, left_out))):
        stored = [values[b] if values else None for values in left_out]
        objective = BatchObjective.of(evaluator, scales, observed, stored=stored)
        shifts.append(_minimum(sampling, objective, descent) - minimum)
    return np.sqrt(np.square(shifts).sum(axis=0))


def _error_of_points(sampling: SamplingDistribution) -> Floats:
    """Return the error of the optimum by the design's points, (r,).

    It is bounded by the spread of the minima by blocks of the design, as if these were independent.
    """
    evaluator = sampling.evaluator
    observed = observed_set(evaluator)
    minima = []
    descent = None
    for b in range(N_BLOCKS):
        nodes = tuple(_on_block(node, b) for node in evaluator.nodes)
        part = replace(evaluator, nodes=nodes, has_graph=False)
        objective = BatchObjective.of(part, sampling.scales, observed)
        if descent is None:
            descent = descent_of(sampling, objective, is_rough=True)
        minima.append(_minimum(sampling, objective, descent))
    x = np.array(minima)
    is_usable = complete_rows(x)
    if is_usable.sum() < N_BLOCKS / 2:
        return np.full(sampling.stderr.size, np.inf)
    rate = 0.5
    if have_emulated_points(evaluator):
        # This is the rate of points that fill d dimensions evenly, for functions with a jump along
        # a surface. The rate of smooth functions is up to 1/2 + 1/d (He and Owen 2016,
        # doi:10.1111/rssb.12132).
        rate += 0.5 / max(node.bound.inputs.dimensions for node in evaluator.nodes)
    return np.asarray(x[is_usable].std(axis=0, ddof=1) / N_BLOCKS**rate)


def _on_block(node: Node, block: int) -> Node:
    """Return a simulator on one block of its design; points on a line remain together."""
    bound = node.reweighted
    if bound is None or bound.design.on_line:
        return node
    return replace(node, bound=bound.copied(bound.design.rows(bound.blocks == block)))


def _minimum(sampling: SamplingDistribution, objective: BatchObjective, descent: Descent) -> Floats:
    """Return the minimiser of one data set along the axes, (r,); infinite if not converged."""
    x, converged = minimise_sets(sampling, objective, descent)
    return x[0] if converged[0] else np.full(sampling.stderr.size, np.inf)
