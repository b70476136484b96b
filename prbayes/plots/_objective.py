"""The objective of an optimum, as the pictures of the optimiser and of the landscape show it."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from prbayes._validate import Floats
from prbayes.model.elements import split_elements, told_of
from prbayes.model.evaluator import Evaluator
from prbayes.model.labels import labelled
from prbayes.optimize.optimum import Optimum

# What a reader calls a metric of the package; any other one goes by the name of its class.
METRIC_LABELS = {
    "AreaMetric": "area metric",
    "KullbackLeibler": "Kullback-Leibler divergence",
    "LogLikelihood": "log-likelihood",
    "ProbabilityResidual": "probability residual",
}
# Of several outputs, by a metric of one.
_LIFTED_LABELS = {
    "Joint": "joint {}",
    "MarginalCorrelation": "{} of marginals, with correlations",
}
_LIFTED = re.compile(r"(\w+)\((?:metric=)?(\w+)\(")


def metric_label(representation: str) -> str:
    """Return what a reader calls the metric of a representation, such as 'Joint(AreaMetric())'."""
    found = _LIFTED.match(representation)
    if found and found[1] in _LIFTED_LABELS:
        return _LIFTED_LABELS[found[1]].format(METRIC_LABELS.get(found[2], found[2]))
    name = representation.partition("(")[0]
    return METRIC_LABELS.get(name, name)


def check_optimum(optimum: Any, caller: str) -> None:
    """Refuse what is no optimum, or has no trace."""
    if not isinstance(optimum, Optimum):
        got = type(optimum).__name__
        raise TypeError(f"{caller}: got {got}, expected an Optimum; call prb.minimize() first")
    if not len(optimum.search.trace.get("theta", ())):
        raise ValueError(
            f"{caller}: got an optimum without a trace, expected one as prb.minimize returns it"
        )


def objective_label(optimum: Optimum) -> str:
    """Return what a reader calls the objective."""
    if not optimum.evaluator.nodes:
        return "minus log-posterior" if optimum.prior else "minus log-likelihood"
    if len(optimum.scales) > 1:
        return "sum of scaled discrepancies"
    metric = optimum.evaluator.nodes[0].metric
    known = repr(metric) if metric.takes_outputs else type(metric).__name__
    return f"discrepancy ({metric_label(known)})"


def objective(optimum: Optimum, evaluator: Evaluator, thetas: Floats) -> Floats:
    """Return the sum of d_k / s_k with the optimum's scales, shape (P,)."""
    scales = [optimum.scales[node.name] for node in evaluator.nodes]
    return evaluator.total(thetas, np.array(scales))


def free_elements(evaluator: Evaluator, thetas: Floats) -> dict[str, Floats]:
    """Return the free variables' elements in the user's own units, shape (P,), by element name."""
    values = evaluator.hyperparameters.constrained(thetas)
    names = [str(rv.name) for rv in evaluator.model.free_RVs]
    some = {name: values[name] for name in names}
    return split_elements(labelled(evaluator, some, {"draw": len(thetas)}).data_vars)


def free_names(optimum: Optimum) -> list[str]:
    """Return the names of the same, without what is the same everywhere, as zeros of a factor."""
    names = [str(rv.name) for rv in optimum.model.free_RVs]
    point = {name: optimum.point[name] for name in names}
    return told_of(labelled(optimum.evaluator, point, {}).data_vars, optimum.stderr)
