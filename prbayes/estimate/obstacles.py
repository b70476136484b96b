"""What a model's metrics and propagations do not allow: sampling distributions, refits."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from prbayes.metrics.base import Minimum
from prbayes.model.evaluator import Evaluator


class Cause(Enum):
    """Why a model cannot be calibrated to other data sets.

    Attributes
    ----------
    RANDOM
        A simulator's discrepancy is drawn anew at every evaluation.
    COSTLY
        A metric declares nothing of its minimum, and its refits would compute responses.
    OTHER_TERMS
        There are likelihood terms or potentials besides the simulators.
    """

    RANDOM = "random"
    COSTLY = "costly"
    OTHER_TERMS = "other terms"


@dataclass(frozen=True)
class Obstacle:
    """Why something cannot be done."""

    cause: Cause
    reason: str  # in words, as the end of a sentence

    def __str__(self) -> str:
        """Return the reason."""
        return self.reason


def simulator_obstacle(evaluator: Evaluator, k: int) -> Obstacle | None:
    """Return why nothing is known of the minimiser of one simulator's discrepancy, or None."""
    node = evaluator.nodes[k]
    bound = node.bound
    if bound.random:
        reason = f"{node.name} has prb.Fresh, whose discrepancy is random"
        return Obstacle(Cause.RANDOM, reason)
    if node.metric.minimum is Minimum.UNKNOWN and not bound.stored:
        metric = type(node.metric).__name__
        reason = (
            f"{node.name} has a {metric}, of which nothing is known without refits, and these need "
            "stored responses: use propagation=prb.Reweighted()"
        )
        return Obstacle(Cause.COSTLY, reason)
    return None


def sampling_obstacle(evaluator: Evaluator) -> Obstacle | None:
    """Return why there is no sampling distribution of the minimiser, or None."""
    nodes = evaluator.nodes
    for k in range(len(nodes)):
        obstacle = simulator_obstacle(evaluator, k)
        if obstacle is not None:
            return obstacle
    # Where one simulator needs refits, all of them have to be refitted.
    computed = [node.name for node in nodes if not node.bound.stored]
    if computed and measured_by_refits(evaluator):
        names = ", ".join(computed)
        reason = f"another metric needs refits, and the responses of {names} are not stored"
        return Obstacle(Cause.COSTLY, reason)
    return None


def refit_obstacle(evaluator: Evaluator) -> Obstacle | None:
    """Return why the model cannot be calibrated to other data sets, or None."""
    obstacle = sampling_obstacle(evaluator)
    if obstacle is not None:
        return obstacle
    model = evaluator.model
    ordinary = len(model.observed_RVs) > len(evaluator.nodes)
    if ordinary or model.potentials:
        reason = "the model has likelihood terms or potentials besides its simulators"
        return Obstacle(Cause.OTHER_TERMS, reason)
    return None


def measured_by_refits(evaluator: Evaluator) -> bool:
    """Return whether a metric declares nothing of its minimum, so that refits have to tell."""
    minima = [node.metric.minimum for node in evaluator.nodes]
    return Minimum.UNKNOWN in minima
