"""What a model's metrics and propagations do not allow: sampling distributions, refits.

An obstacle is a reason in words, as the end of a sentence.
"""

from __future__ import annotations

from prbayes.metrics.base import Minimum
from prbayes.model.evaluator import Evaluator, has_other_terms


def simulator_obstacle(evaluator: Evaluator, k: int) -> str | None:
    """Return why nothing is known of the minimiser of one simulator's discrepancy, or None."""
    node = evaluator.nodes[k]
    bound = node.bound
    if bound.random:
        return f"{node.name} has prb.Fresh, whose discrepancy is random"
    if node.metric.minimum is Minimum.UNKNOWN and not bound.stored:
        metric = type(node.metric).__name__
        return (
            f"{node.name} has a {metric}, of which nothing is known without refits, and these need "
            "stored responses: use propagation=prb.Reweighted()"
        )
    return None


def sampling_obstacle(evaluator: Evaluator) -> str | None:
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
        return f"another metric needs refits, and the responses of {names} are not stored"
    return None


def refit_obstacle(evaluator: Evaluator) -> str | None:
    """Return why the model cannot be calibrated to other data sets, or None."""
    obstacle = sampling_obstacle(evaluator)
    if obstacle is not None:
        return obstacle
    if has_other_terms(evaluator):
        return "the model has likelihood terms or potentials besides its simulators"
    return None


def measured_by_refits(evaluator: Evaluator) -> bool:
    """Return whether a metric declares nothing of its minimum, so that refits have to tell."""
    minima = [node.metric.minimum for node in evaluator.nodes]
    return Minimum.UNKNOWN in minima
