"""Requirements of sampling distributions and refits on metrics and propagations.

An obstacle is a reason in words, as the end of a sentence.
"""

from __future__ import annotations

from prbayes.metrics.base import Minimum
from prbayes.model.evaluator import Evaluator, has_other_terms


def simulator_obstacle(evaluator: Evaluator, k: int) -> str | None:
    """Return why the minimiser of one simulator's discrepancy has no sampling distribution."""
    node = evaluator.nodes[k]
    if node.bound.random:
        return f"{node.name} has prb.Fresh, whose discrepancy is random"
    if node.metric.minimum is Minimum.UNKNOWN and not node.bound.stored:
        return (
            f"{node.name} has a {type(node.metric).__name__}, whose standard errors need refits, "
            "and these need stored responses: use propagation=prb.Reweighted()"
        )
    return None


def sampling_obstacle(evaluator: Evaluator) -> str | None:
    """Return why there is no sampling distribution of the minimiser, or None."""
    for k in range(len(evaluator.nodes)):
        obstacle = simulator_obstacle(evaluator, k)
        if obstacle is not None:
            return obstacle
    # If one simulator needs refits, all of them are refitted.
    computed = [node.name for node in evaluator.nodes if not node.bound.stored]
    if computed and needs_refits(evaluator):
        names = ", ".join(computed)
        return f"another metric needs refits, and the responses of {names} are not stored"
    return None


def refit_obstacle(evaluator: Evaluator) -> str | None:
    """Return why the model cannot be calibrated to other data sets, or None."""
    obstacle = sampling_obstacle(evaluator)
    if obstacle is None and has_other_terms(evaluator):
        return "the model has likelihood terms or potentials besides its simulators"
    return obstacle


def needs_refits(evaluator: Evaluator) -> bool:
    """Return whether a metric declares nothing of its minimum, so that refits measure it."""
    return any(node.metric.minimum is Minimum.UNKNOWN for node in evaluator.nodes)
